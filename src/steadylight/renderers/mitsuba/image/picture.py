"""Several pictures of the same camera rays: radiance in layers, with estimates of emission and noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from steadylight.renderers.mitsuba.image.fireflies import bounded, sample_limit
from steadylight.renderers.mitsuba.image.pixels import (
    Camera,
    Look,
    Pass,
    Rows,
    Sampling,
    passes,
    sign_of_half,
)
from steadylight.renderers.mitsuba.image.reconstruction import border_of, reconstruct
from steadylight.renderers.mitsuba.quality import AdaptiveSamples
from steadylight.renderers.mitsuba.upload import download, upload

_ALL: Final = np.ones((3, 3), np.bool_)

_BESIDE: Final = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.bool_)
"""The neighbours of a pixel, without itself. If a pixel were judged by itself too, one with a bright sample would lose
that sample, and one that missed it would stay as it is: a classroom became 0.15 % too dark. Direct and
cached light are judged by `_ALL`: they are not bounded, so even a single bright sample must be replaced."""

PROMINENT: Final = 3.0
"""A pixel is sampled again if the noise of some light there exceeds this many times the root mean square over the rows
that are processed together. It gets at least four times as many samples, and those of its direct or cached light are
discarded. At lower noise, the same time is better spent on samples of all pixels (docs/experiments.md)."""

Picture = NDArray[np.float32]
"""(height, width, 3) scene-linear RGB."""


class Sampled(NamedTuple):
    """What camera rays see: the result of the `Look` of `render_layers`.

    Attributes:
        layers: Color3f of each picture.
        count: to be summed over the picture.
        cached: noise-free part of the picture that direct light belongs to; None if there is none.
        direct: direct light on surfaces that the camera sees, to be added to one of the pictures; None if not separate.
        indirect: light from the cache on these surfaces, to be added to the first picture; None if not separate. Only
            with `direct`.
        emitted: emission that the camera sees, which belongs to none of them; None if not separate.
    """

    layers: Sequence[mi.Color3f]
    count: mi.UInt32
    cached: mi.Color3f | None = None
    direct: mi.Color3f | None = None
    indirect: mi.Color3f | None = None
    emitted: mi.Color3f | None = None


class SurfaceLight(NamedTuple):
    """Where light on the first surface goes, and which pixels are too noisy.

    Attributes:
        layer: the picture to which direct light is added. With those before it, it sums to the whole.
        direct: direct light of a pixel is omitted if its standard error, or a neighbour's, exceeds `threshold` relative
            to the surrounding picture, and PROMINENT times the root mean square of all; at most the fraction `pixels`
            of all pixels, the noisiest.
        rest: which pixels are too noisy in the other light of that picture; None to ignore it.
        indirect: as `direct`, for light from the cache, which goes to the first picture; None to omit it nowhere.
        worth: it is omitted only if the root mean square of these pixels' relative errors, over all pixels that are
            processed together, is at least this.
    """

    layer: int
    direct: AdaptiveSamples
    rest: AdaptiveSamples | None = None
    indirect: AdaptiveSamples | None = None
    worth: float = 0.0


class Emitted(NamedTuple):
    """Emission seen by the samples of each pixel; see `visible_emitters`.

    Attributes:
        mean: (height, width, 3) scene-linear RGB.
        lowest: (height, width) luminance of the darkest sample.
        highest: (height, width) luminance of the brightest sample.
    """

    mean: Picture
    lowest: NDArray[np.float32]
    highest: NDArray[np.float32]


class Uncertain(NamedTuple):
    """Pixels whose samples are too noisy.

    Attributes:
        pixels: (M,) of the picture, in row-major order.
        around: (M,) luminance of the picture around each.
        error: (M,) maximum standard error, relative to the surrounding picture, among the pixels that it is judged by.
        threshold: error above which a pixel is among these.
    """

    pixels: NDArray[np.intp]
    around: NDArray[np.float64]
    error: NDArray[np.float64]
    threshold: float

    @classmethod
    def nothing(cls) -> Uncertain:
        """No pixels."""
        return cls(np.zeros(0, np.intp), np.zeros(0), np.zeros(0), 0.0)

    def noise(self, count: int) -> float:
        """Root mean square of `error` over so many pixels; others than these count as zero."""
        return math.sqrt(np.square(self.error).sum() / count)


class Noisy(NamedTuple):
    """Pixels of a band that need more samples.

    Attributes:
        rows: of the band.
        direct: pixels whose direct light was omitted.
        indirect: pixels whose light from the cache was omitted.
        rest: pixels where the other light is noisy.
        bound: (M,) on the luminance of a sample of that light.
    """

    rows: Rows
    direct: Uncertain
    indirect: Uncertain
    rest: Uncertain
    bound: NDArray[np.float32]


class Rendered(NamedTuple):
    """Result of `render_layers`.

    Attributes:
        images: one for each filter.
        emitted: emission that the camera sees; None if not separate.
        noisy: pixels of each band that need more samples.
        count: sum of the counts.
        noise: (height, width, 3) half the difference between the means of two halves of a pixel's samples, in one
            picture: as large as the error of the mean. None if not requested.
        cut: (height, width, 3) what was clamped from fireflies, in the mean of each pixel.
    """

    images: list[Picture]
    emitted: Emitted | None
    noisy: list[Noisy]
    count: int
    noise: Picture | None
    cut: Picture


def render_layers(
    look: Look,
    rfilters: Sequence[mi.ReconstructionFilter],
    sampling: Sampling,
    surface: SurfaceLight | None = None,
    noise_of: int | None = None,
    firefly: float | None = None,
) -> Rendered:
    """Render several pictures of the same camera rays in bands of rows.

    Args:
        look: what a camera ray sees: `Sampled`.
        rfilters: of each picture. The widest determines the bands.
        sampling: samples per pixel, and the seed.
        surface: where light on the first surface goes, if `look` returns it.
        noise_of: picture whose noise is estimated, including the light on the first surface that is added to it.
        firefly: maximum contribution of one sample to its pixel in the picture that direct light goes to; see
            `fireflies`. None for no bound.

    Returns:
        The pictures, without visible emission, which is separate; None where `look` returns none. They contain light on
        the first surface except in pixels where it is noisy.
    """
    camera = look.camera
    width, height = camera.size
    images = [np.zeros((height, width, 3), np.float32) for _ in rfilters]
    count = 0
    bands: list[Emitted] = []
    noisy: list[Noisy] = []
    noise = None if noise_of is None else np.zeros((height, width, 3), np.float32)
    limit = None if firefly is None else sample_limit(firefly, sampling.spp)
    cut = np.zeros((height, width, 3), np.float32)
    band = _Band(camera, rfilters, surface, noise_of, limit)
    for part in passes(camera, sampling.spp, max(map(border_of, rfilters))):
        seen, offset = look(*part.samples(camera, sampling.seed))
        count += band.add(part, Sampled(*seen), offset)
        if not part.last:
            continue
        top, bottom = part.rows.want
        for image, total in zip(images, band.totals, strict=True):
            image[top:bottom] = total[..., :3] / np.where(total[..., 3:] != 0, total[..., 3:], 1)
        if noise is not None:
            assert band.difference is not None
            noise[top:bottom] = band.difference / np.float32(sampling.spp)
        if band.noisy is not None:
            noisy.append(band.noisy)
        if band.emitted is not None:
            bands.append(band.emitted)
        if band.cut is not None:
            cut[top:bottom] = band.cut / np.float32(sampling.spp)
        band = _Band(camera, rfilters, surface, noise_of, limit)
    emitted = Emitted(*map(np.concatenate, zip(*bands, strict=True))) if bands else None
    return Rendered(images, emitted, noisy, count, noise, cut)


class _Band:
    """Sums over the passes that sample a band of rows.

    Attributes:
        totals: (rows, width, 4) of each picture: filter-weighted radiance, and weights.
        emitted: visible emission.
        noisy: pixels that need more samples.
        difference: (rows, width, 3) sum of the first half of each pixel's samples minus that of the second.
        cut: (rows, width, 3) sum of what was clamped from fireflies.
    """

    def __init__(
        self,
        camera: Camera,
        rfilters: Sequence[mi.ReconstructionFilter],
        surface: SurfaceLight | None,
        noise_of: int | None,
        limit: float | None,
    ) -> None:
        self._camera, self._rfilters, self._surface, self._noise_of = camera, rfilters, surface, noise_of
        self._limit = limit
        self.cut: Picture | None = None
        self.difference: Picture | None = None
        self.totals: list[NDArray[np.float32]] = []
        self.emitted: Emitted | None = None
        self.noisy: Noisy | None = None
        self._spp = 0

    def add(self, part: Pass, sampled: Sampled, offset: mi.Point2f) -> int:
        """Add a pass; returns the sum of its counts."""
        layers, width = list(sampled.layers), self._camera.width
        if sampled.direct is not None and self._surface is not None:
            layers[self._surface.layer] = self._lit(part, sampled, sampled.direct, self._surface)
            if sampled.indirect is not None:
                assert self.noisy is not None
                layers[0] = layers[0] + _without(sampled.indirect, self.noisy.indirect.pixels, part, width)
        counts = self._wanted(part, sampled.count)
        signed = None if self._noise_of is None else _signed(layers[self._noise_of], part)
        brightness = None if sampled.emitted is None else mi.luminance(sampled.emitted)
        dr.eval(layers, counts, signed, brightness)  # in one kernel
        given = [
            reconstruct(L, offset, rfilter, part.rows, width)
            for L, rfilter in zip(layers, self._rfilters, strict=True)
        ]
        self.totals = [a + b for a, b in zip(self.totals, given, strict=True)] if self.totals else given
        if signed is not None:
            found = _sums(signed, part, width)
            self.difference = found if self.difference is None else self.difference + found
        if sampled.emitted is not None:
            self._add_emitted(_emitted(sampled.emitted, brightness, part, width), part.spp)
        return int(np.asarray(counts).sum(dtype=np.uint64))

    def _lit(self, part: Pass, sampled: Sampled, direct: mi.Color3f, goes: SurfaceLight) -> mi.Color3f:
        """The picture that direct light goes to, bounded, plus direct light except where it is noisy."""
        width, own = self._camera.width, sampled.layers[goes.layer]
        cached = [] if sampled.cached is None else [sampled.cached]
        emitted = [] if sampled.emitted is None else [sampled.emitted]
        indirect = [] if sampled.indirect is None else [sampled.indirect]
        rest = sum([*sampled.layers[: goes.layer], *emitted, *cached, *indirect], direct)
        bound, lost = np.float32(np.inf), None
        if self._limit is not None:
            own, lost, bound = bounded(own, rest, (width, part.spp), self._limit)
        seen, powers = None, []
        if self.noisy is None:
            seen = mi.luminance(rest + own)
            judged = (direct, own if goes.rest else None, sampled.indirect if goes.indirect else None)
            powers = [None if light is None else _powers(light) for light in judged]
        dr.eval(own, lost, seen, powers)  # in one kernel
        if lost is not None:
            cut = _sums(lost, part, width)
            self.cut = cut if self.cut is None else self.cut + cut
        if self.noisy is None:
            unlit = _uncertain(seen, powers[0], part, width, goes.direct)
            better = _uncertain(seen, powers[1], part, width, goes.rest, _BESIDE)
            edges = _uncertain(seen, powers[2], part, width, goes.indirect)
            if edges.noise(math.prod(part.shape(width))) < goes.worth:
                edges = Uncertain.nothing()
            bounds = np.broadcast_to(bound, part.shape(width)).ravel()
            bound = bounds[better.pixels - part.first_pixel(width)]
            self.noisy = Noisy(part.rows, unlit, edges, better, bound)
        return sum(cached, own) + _without(direct, self.noisy.direct.pixels, part, width)

    def _wanted(self, part: Pass, counts: mi.UInt32) -> mi.UInt32:
        """The counts in the wanted rows, 0 in others: rows beyond are also sampled by another band."""
        have, want = part.rows
        per_row = self._camera.width * part.spp
        lane = dr.arange(mi.UInt32, dr.width(counts))
        begin, end = (dr.opaque(mi.UInt32, (row - have[0]) * per_row) for row in want)
        return dr.select((lane >= begin) & (lane < end), counts, 0)

    def _add_emitted(self, found: Emitted, spp: int) -> None:
        before = self.emitted
        if before is not None:
            total = np.float32(self._spp + spp)
            mean = (before.mean * np.float32(self._spp) + found.mean * np.float32(spp)) / total
            lowest = np.minimum(before.lowest, found.lowest)
            found = Emitted(mean, lowest, np.maximum(before.highest, found.highest))
        self.emitted = found
        self._spp += spp


def _powers(light: mi.Color3f) -> tuple[mi.Float, mi.Float]:
    """Luminance of some light, and its square."""
    own = mi.luminance(light)
    return own, dr.square(own)


def _uncertain(
    picture: mi.Float,
    light: tuple[mi.Float, mi.Float] | None,
    part: Pass,
    width: int,
    quality: AdaptiveSamples | None,
    judges: NDArray[np.bool_] = _ALL,
) -> Uncertain:
    """Pixels where the samples of some light vary much.

    A pixel is judged by its neighbours too: by itself alone, one whose samples all missed a light would pass as free of
    noise, while those that found it would be corrected, and the picture would become too dark.

    Args:
        picture: luminance of the samples; those of a pixel are adjacent.
        light: `_powers` of the part that may be noisy; None if there is none.
        part: pass that sampled it.
        width: pixels per row.
        quality: which pixels are too noisy; None if none are.
        judges: footprint of the neighbours by which a pixel is judged.
    """
    if light is None or quality is None:
        return Uncertain.nothing()
    spp = part.spp
    sums = [dr.block_reduce(dr.ReduceOp.Add, values, spp) for values in (*light, picture)]
    mean, square, seen = (np.array(values).reshape(-1, width) / np.float32(spp) for values in sums)
    error = np.sqrt(np.maximum(square - np.square(mean), 0) / spp)
    around = uniform_filter(seen, 5) + 0.1 * seen.mean(dtype=np.float64)
    around = np.maximum(around, np.finfo(np.float32).tiny, dtype=np.float64)
    error /= around
    threshold = max(quality.threshold, PROMINENT * float(np.sqrt(np.square(error).mean())))
    relative = maximum_filter(error, footprint=judges)
    most = int(relative.size * quality.pixels)
    least = float(np.partition(relative.ravel(), -most - 1)[-most - 1]) if most < relative.size else 0.0
    noisy = np.flatnonzero(relative > max(threshold, least))
    return Uncertain(
        noisy + part.first_pixel(width), around.ravel()[noisy], relative.ravel()[noisy], threshold
    )


def _without(L: mi.Color3f, pixels: NDArray[np.intp], part: Pass, width: int) -> mi.Color3f:
    """Samples of all pixels, set to black in some."""
    if not len(pixels):
        return L
    mask = np.zeros(math.prod(part.shape(width)), np.uint32)
    mask[pixels - part.first_pixel(width)] = 1
    black = upload(mi.UInt32, mask)
    pixel = dr.arange(mi.UInt32, dr.width(L)) // dr.opaque(mi.UInt32, part.spp)
    return dr.select(dr.gather(mi.UInt32, black, pixel) != 0, 0, L)


def _signed(L: mi.Color3f, part: Pass) -> mi.Color3f:
    """The samples: those of the first half of each pixel as they are, those of the second negated."""
    spp = dr.opaque(mi.UInt32, part.spp)
    lane = dr.arange(mi.UInt32, dr.width(L))
    return L * sign_of_half(lane - lane // spp * spp, spp)


def _sums(values: mi.Color3f, part: Pass, width: int) -> Picture:
    """(rows, width, 3) sums over the samples of each pixel, of the wanted rows."""
    return np.stack([_by_pixel(dr.ReduceOp.Add, channel, part, width) for channel in values], axis=-1)


def _by_pixel(op: dr.ReduceOp, values: mi.Float, part: Pass, width: int) -> NDArray[np.float32]:
    """(rows, width) samples of each pixel reduced to one value, of the wanted rows."""
    return download(dr.block_reduce(op, values, part.spp)).reshape(-1, width)[part.rows.wanted]


def _emitted(Le: mi.Color3f, luminance: mi.Float, part: Pass, width: int) -> Emitted:
    """Visible emission in each pixel of the wanted rows, from the samples and their luminance."""
    lowest, highest = (_by_pixel(op, luminance, part, width) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max))
    return Emitted(_sums(Le, part, width) / np.float32(part.spp), lowest, highest)
