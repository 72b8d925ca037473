"""From samples to an image, in an order that never varies.

Mitsuba's image block adds samples to pixels with atomic operations, whose order (and so the last bit) changes from
run to run. Here each pixel collects the samples of its neighbourhood itself: the same filter, the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

import mitsuba as mi
from steadylight.renderers.mitsuba.upload import upload

LANES = 1 << 24
"""Samples in flight: bounds memory. A constant, so that the split does not depend on the machine."""

SPP_AT_ONCE = 64
"""More samples per pixel than this are taken in passes of equal size."""

Radiance = Callable[[Any, Any], tuple[Any, Any]]
"""(sampler, ray) -> (Color3f radiance, UInt32 count to be summed over the image)."""

NOISY = 0.2
"""Pixels are sampled again if the standard error of their direct light, or of a neighbour's, is greater than this part
of the picture there."""

MOST_AGAIN = 1 / 32
"""No more than this part of the pixels is sampled again for that; the noisiest are."""

DARK = np.float32(0.01)
"""An albedo below this tells nothing of the light."""


class Sampled(NamedTuple):
    """What camera rays see."""

    layers: Sequence[Any]  # Color3f of each image
    count: Any  # UInt32, to be summed over the image
    direct: Any = None  # Color3f, direct light on what the camera sees, which belongs to one of the images
    emitted: Any = None  # Color3f, what shines at the camera itself, which belongs to none


Seen = Callable[[Any, Any], Sampled]
"""(sampler, ray) -> what they see."""


class Emitted(NamedTuple):
    """What the samples of each pixel met that shines; see `emission.emission_image`."""

    mean: NDArray[np.float32]  # (height, width, 3) scene-linear RGB
    lowest: NDArray[np.float32]  # (height, width) luminance of the darkest sample
    highest: NDArray[np.float32]  # ... and of the brightest


class Noisy(NamedTuple):
    """Pixels of a band that lack their direct light, since few samples tell too little of it."""

    have: tuple[int, int]  # first and one past the last row that were sampled
    want: tuple[int, int]  # the rows that were filtered from them
    pixels: NDArray[np.intp]  # (M,) of the image, row by row


class Rendered(NamedTuple):
    """What `render_layers` made."""

    images: list[NDArray[np.float32]]  # (height, width, 3) each
    emitted: Emitted | None
    noisy: list[Noisy]  # of each band
    count: int  # sum of the counts


class Samples(NamedTuple):
    """Samples of some rows of an image that are taken together, in passes."""

    sampler: Any  # to be seeded for them
    seeds: tuple[int, ...]  # of the passes
    have: tuple[int, int]  # first and one past the last row that are sampled
    want: tuple[int, int]  # the rows that are filtered from them
    lanes: int  # samples in a pass

    def rays(self, sensor: Any, size: tuple[int, int], seed: int) -> tuple[Any, Any]:
        """Camera rays of one pass; see `camera_rays`."""
        self.sampler.seed(dr.opaque(mi.UInt32, seed), self.lanes)
        pixel = dr.arange(mi.UInt32, self.lanes) // dr.opaque(mi.UInt32, self.sampler.sample_count())
        return camera_rays(sensor, self.sampler, size, pixel + dr.opaque(mi.UInt32, self.have[0] * size[0]))


def samples_of_image(size: tuple[int, int], spp: int, seed: int, border: int) -> Iterator[Samples]:
    """All samples of an image, in bands of rows.

    Args:
        size: width and height, pixels.
        spp: samples per pixel, rounded up to what the sampler can do.
        seed: decides all random numbers.
        border: rows beyond its own that a band needs for filtering.
    """
    width, height = size
    passes = math.ceil(spp / SPP_AT_ONCE)
    sampler = make_sampler(math.ceil(spp / passes))
    rows = max(1, LANES // (width * sampler.sample_count()) - 2 * border)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        have = (max(top - border, 0), min(bottom + border, height))
        seeds = tuple(seed_of(seed, top, number) for number in range(passes))
        lanes = (have[1] - have[0]) * width * sampler.sample_count()
        yield Samples(sampler, seeds, have, (top, bottom), lanes)


def border_of(rfilter: Any) -> int:
    """Pixels beyond its own that a reconstruction filter reads."""
    return math.ceil(rfilter.radius() - 0.5)


def seed_of(*numbers: int) -> int:
    """A 32-bit seed from whole numbers, well mixed (SplitMix64)."""
    state = 0
    for number in numbers:
        state = (state + (number & 0xFFFFFFFFFFFFFFFF) + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state & 0xFFFFFFFF


def make_sampler(spp: int) -> Any:
    """A multijitter sampler (Kensler 2013); it may round the sample count up to a grid."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    mi.set_log_level(level)
    sampler.set_samples_per_wavefront(sampler.sample_count())
    return sampler


def camera_rays(sensor: Any, sampler: Any, size: tuple[int, int], pixel: Any) -> tuple[Any, Any]:
    """Camera rays through pixels.

    Args:
        sensor: mi.Sensor.
        sampler: seeded for as many samples; samples of a pixel side by side.
        size: width and height of the image, pixels.
        pixel: UInt32 of each sample, row by row.

    Returns:
        Ray3f, weighted by nothing (the sensors we take have unit weight), and Point2f offset in the pixel.
    """
    width, height = size
    w = dr.opaque(mi.UInt32, width)
    row = pixel // w
    column = pixel - row * w
    offset = sampler.next_2d()
    corner = mi.Point2f(mi.Float(column), mi.Float(row))
    scale = mi.Vector2f(dr.opaque(mi.Float, 1 / width), dr.opaque(mi.Float, 1 / height))
    aperture = mi.Point2f(0.5)
    if sensor.needs_aperture_sample():
        aperture = sampler.next_2d()
    ray, _ = sensor.sample_ray(0.0, sampler.next_1d(), (corner + offset) * scale, aperture)
    return ray, offset


def render_image(
    sensor: Any, rfilter: Any, size: tuple[int, int], spp: int, seed: int, radiance: Radiance
) -> tuple[NDArray[np.float32], int]:
    """Render an image in bands of rows.

    Args:
        sensor: mi.Sensor.
        rfilter: mi.ReconstructionFilter.
        size: width and height, pixels.
        spp: samples per pixel.
        seed: decides all random numbers.
        radiance: what a camera ray sees.

    Returns:
        (height, width, 3) float32 scene-linear RGB, and the sum of the counts.
    """

    def alone(sampler: Any, ray: Any) -> Sampled:
        L, counted = radiance(sampler, ray)
        return Sampled((L,), counted)

    rendered = render_layers(sensor, [rfilter], size, spp, seed, alone)
    return rendered.images[0], rendered.count


def integral_of(rfilter: Any) -> NDArray[np.float64]:
    """Integral of a filter along one axis over its own pixel and as many on each side as it reaches."""
    border = border_of(rfilter)
    t = (np.arange(512) + 0.5) / 512 - 0.5 + np.arange(-border, border + 1)[:, None]
    f = np.array(rfilter.eval(upload(mi.Float, t.ravel().astype(np.float32))), np.float64).reshape(t.shape)
    return np.where(np.abs(t) <= rfilter.radius(), f, 0).mean(axis=1)


def as_filtered(image: NDArray[np.float32], rfilter: Any) -> NDArray[np.float32]:
    """A picture made with a box filter as it would look through a wider one: each pixel takes a part of its neighbours.

    The part is such that edges, wherever they lie in a pixel, differ least in the mean square from what the filter
    makes of them.

    Args:
        image: (height, width, channels).
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, channels).
    """
    radius = rfilter.radius() + 1.5  # pixels; beyond, edges are the same
    steps = round(512 * radius)
    t = ((np.arange(steps) + 0.5) / steps * 2 - 1) * radius
    f = np.array(rfilter.eval(upload(mi.Float, t.astype(np.float32))), np.float64) * (
        np.abs(t) <= rfilter.radius()
    )

    def boxed(pixels: int) -> NDArray[np.float64]:
        return np.clip(t - pixels + 0.5, 0, 1)

    spread = boxed(1) + boxed(-1) - 2 * boxed(0)
    lacking = (np.cumsum(f) - f / 2) / f.sum() - boxed(0)
    part = np.float32(round(float((lacking * spread).sum() / (spread**2).sum()), 5))
    for axis in (0, 1):
        padded = np.pad(image, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
        before, after = (padded.take(range(k, k + image.shape[axis]), axis) for k in (0, 2))
        image = (1 - 2 * part) * image + part * (before + after)
    return image


def lit_as_filtered(
    lit: NDArray[np.float32], albedo: NDArray[np.float32], filtered: NDArray[np.float32], rfilter: Any
) -> NDArray[np.float32]:
    """As `as_filtered`, with textures and outlines as sharp as the wider filter makes them.

    What softening makes of albedo differs from what the filter makes of it; times the light on it, this is what
    softening lacks of the picture. Light is taken as it is around each pixel, as far as the filter looks: gloss on
    something dark is not light that would make what is pale beside it as much brighter.

    Args:
        lit: (height, width, 3) light that surfaces scatter, by a box filter.
        albedo: (height, width, 3) theirs, by a box filter.
        filtered: (height, width, 3) the same by `rfilter`.
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, 3).
    """
    both = np.concatenate([lit, albedo], axis=2)
    softened, softened_albedo = np.split(as_filtered(both, rfilter), 2, axis=2)
    lit_around, albedo_around = np.split(uniform_filter(both, (5, 5, 1)), 2, axis=2)
    lacking = lit_around / np.maximum(albedo_around, DARK) * (filtered - softened_albedo)
    return np.maximum(softened + lacking, np.minimum(softened, 0))


def render_layers(
    sensor: Any,
    rfilters: Sequence[Any],
    size: tuple[int, int],
    spp: int,
    seed: int,
    seen: Seen,
    direct_to: int = 0,
) -> Rendered:
    """Render several images of the same camera rays in bands of rows.

    Args:
        sensor: mi.Sensor.
        rfilters: mi.ReconstructionFilter of each image. The widest decides the bands, and so the random numbers.
        size: width and height, pixels.
        spp: samples per pixel.
        seed: decides all random numbers.
        seen: what a camera ray sees, for each image.
        direct_to: the image to which direct light belongs. With those before it, it makes up the picture.

    Returns:
        The images, without what is emitted at the camera, and what is known of that; None where `seen` tells nothing.
        Direct light is in them, but for that of pixels where it is noisy.
    """
    width, height = size
    images = [np.zeros((height, width, 3), np.float32) for _ in rfilters]
    count = 0
    bands: list[Emitted] = []
    lacking: list[Noisy] = []
    for samples in samples_of_image(size, spp, seed, max(map(border_of, rfilters))):
        have, (top, bottom) = samples.have, samples.want
        spp_pass = samples.sampler.sample_count()
        totals = [np.zeros((bottom - top, width, 4), np.float32) for _ in rfilters]
        passes: list[Emitted] = []
        noisy: NDArray[np.bool_] | None = None
        for pass_seed in samples.seeds:
            ray, offset = samples.rays(sensor, size, pass_seed)
            layers, counted, direct, shining = seen(samples.sampler, ray)
            # At once; of a named tuple Dr.Jit would evaluate nothing.
            dr.eval(*layers, direct, shining, offset, counted)
            count += int(dr.sum(dr.select(counted > 0, mi.UInt64(counted), 0))[0])
            if direct is not None:
                if noisy is None:
                    picture = [*layers[: direct_to + 1], *([] if shining is None else [shining])]
                    noisy = _noisy_pixels(picture, direct, width, spp_pass)
                layers = list(layers)
                layers[direct_to] = layers[direct_to] + _without(direct, noisy, spp_pass)
                dr.eval(layers[direct_to])
            totals = [
                total + _reconstruct(L, offset, rfilter, width, have, samples.want, spp_pass)
                for total, L, rfilter in zip(totals, layers, rfilters, strict=True)
            ]
            if shining is not None:
                passes.append(_emitted(shining, width, have, samples.want, spp_pass))
        if noisy is not None:
            lacking.append(Noisy(have, (top, bottom), np.flatnonzero(noisy) + have[0] * width))
        if passes:
            means, lowest, highest = zip(*passes, strict=True)
            bands.append(Emitted(np.mean(means, axis=0), np.min(lowest, axis=0), np.max(highest, axis=0)))
        for image, total in zip(images, totals, strict=True):
            image[top:bottom] = total[..., :3] / np.where(total[..., 3:] != 0, total[..., 3:], 1)
    emitted = Emitted(*map(np.concatenate, zip(*bands, strict=True))) if bands else None
    return Rendered(images, emitted, lacking, count)


def _noisy_pixels(picture: Sequence[Any], direct: Any, width: int, spp: int) -> NDArray[np.bool_]:
    """Where the samples of direct light differ much.

    A pixel is judged by its neighbours too: by itself alone, one whose samples all missed a light would pass as quiet,
    and those that met it would be corrected, so that the picture would become too dark.

    Args:
        picture: Color3f, which with direct light add up to what the samples saw; those of a pixel side by side.
        direct: Color3f, direct light.
        width: pixels in a row.
        spp: samples per pixel.

    Returns:
        (rows, width) mask.
    """
    own = mi.luminance(direct)
    whole = own + sum(mi.luminance(part) for part in picture)
    sums = [dr.block_reduce(dr.ReduceOp.Add, values, spp) for values in (own, dr.square(own), whole)]
    dr.eval(sums)
    mean, square, seen = (np.array(values).reshape(-1, width) / np.float32(spp) for values in sums)
    error = np.sqrt(np.maximum(square - np.square(mean), 0) / spp)
    usual = uniform_filter(seen, 5) + 0.1 * seen.mean(dtype=np.float64)
    relative = maximum_filter(error / np.maximum(usual, np.finfo(np.float32).tiny), 3)
    most = int(relative.size * MOST_AGAIN)
    least = np.partition(relative.ravel(), -most - 1)[-most - 1]
    return relative > max(NOISY, float(least))


def _without(L: Any, pixels: NDArray[np.bool_], spp: int) -> Any:
    """Samples of all pixels, those of some made black."""
    if not pixels.any():
        return L
    black = upload(mi.UInt32, pixels.ravel().astype(np.uint32))
    pixel = dr.arange(mi.UInt32, dr.width(L)) // dr.opaque(mi.UInt32, spp)
    return dr.select(dr.gather(mi.UInt32, black, pixel) != 0, 0, L)


def _emitted(Le: Any, width: int, have: tuple[int, int], want: tuple[int, int], spp: int) -> Emitted:
    """What shines in each pixel of the wanted rows; arguments as those of `_reconstruct`."""
    luminance = mi.luminance(Le)
    values = [dr.block_reduce(dr.ReduceOp.Add, channel, spp) for channel in Le]
    values += [dr.block_reduce(op, luminance, spp) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max)]
    dr.eval(values)
    rows = slice(want[0] - have[0], want[1] - have[0])
    *channels, lowest, highest = (np.array(value).reshape(-1, width)[rows] for value in values)
    return Emitted(np.stack(channels, axis=-1) / np.float32(spp), lowest, highest)


def _reconstruct(
    L: Any, offset: Any, rfilter: Any, width: int, have: tuple[int, int], want: tuple[int, int], spp: int
) -> NDArray[np.float32]:
    """Filter-weighted sums of radiance, and of weights, for the wanted rows.

    Args:
        L: Color3f samples of the rows `have`.
        offset: Point2f position of each sample in its pixel.
        rfilter: separable reconstruction filter.
        width: pixels in a row.
        have: first and one past the last row that were sampled.
        want: the rows to make; neighbours outside `have` do not exist.
        spp: samples per pixel.

    Returns:
        (rows, width, 4) float32.
    """
    border = border_of(rfilter)
    given = shares(L, offset, rfilter, (have[1] - have[0]) * width, dr.opaque(mi.UInt32, spp))
    dr.eval(given)
    rows = want[1] - want[0]
    w = dr.opaque(mi.Int32, width)
    pixel = dr.arange(mi.Int32, rows * width)
    y = pixel // w
    x = pixel - y * w
    y += dr.opaque(mi.Int32, want[0] - have[0])
    height = dr.opaque(mi.Int32, have[1] - have[0])
    side = 2 * border + 1
    total, weight = mi.Color3f(0), mi.Float(0)
    for step in range(side * side):
        from_y, from_x = y + border - step // side, x + border - step % side
        there = (from_x >= 0) & (from_x < w) & (from_y >= 0) & (from_y < height)
        index = mi.UInt32((from_y * w + from_x) * side + step // side)
        color, f = given[step % side]
        total += dr.gather(mi.Color3f, color, index, there)
        weight += dr.gather(mi.Float, f, index, there)
    dr.eval(total, weight)
    return np.stack([*np.array(total), np.array(weight)], axis=1).reshape(rows, width, 4)


@dr.syntax
def shares(L: Any, offset: Any, rfilter: Any, pixels: int, spp: Any) -> list[tuple[Any, Any]]:
    """What the samples of each pixel give to it and to its neighbours: sums of the filter, and of it times radiance.

    A lane works for one pixel and one row of neighbours, so that it evaluates the filter once for that row and once
    for each column.

    Args:
        L: Color3f, samples of a pixel side by side.
        offset: Point2f position of each sample in its pixel.
        rfilter: separable reconstruction filter.
        pixels: how many.
        spp: UInt32, samples of each pixel.

    Returns:
        For each column of neighbours, from the left: Color3f and Float, rows of neighbours of a pixel side by side,
        from above.
    """
    border = border_of(rfilter)
    radius = rfilter.radius()
    side = 2 * border + 1
    lane = dr.arange(mi.UInt32, pixels * side)
    pixel = lane // side
    dy = mi.Float(mi.Int32(lane - pixel * side) - border)
    # ---- loop state ----------------------------------------------------------------------
    s = mi.UInt32(0)
    total = [mi.Color3f(0) for _ in range(side)]
    weight = [mi.Float(0) for _ in range(side)]
    while s < spp:
        index = pixel * spp + s
        color = dr.gather(mi.Color3f, L, index)
        at = dr.gather(mi.Point2f, offset, index) - 0.5
        away_y = at.y - dy
        fy = dr.select(dr.abs(away_y) <= radius, rfilter.eval(away_y), 0)
        for column in range(side):
            away_x = at.x - (column - border)
            f = dr.select(dr.abs(away_x) <= radius, fy * rfilter.eval(away_x), 0)
            total[column] += f * color
            weight[column] += f
        s += 1
    return list(zip(total, weight, strict=True))
