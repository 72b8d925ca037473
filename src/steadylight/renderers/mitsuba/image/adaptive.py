"""Adaptive sampling: some pixels of a picture get many more camera rays than the others.

The audit does not follow these rays, so they are only for light that needs no records or rarely misses one.
"""

from __future__ import annotations

from math import isqrt
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, maximum_filter, uniform_filter

from steadylight.images import luminance
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling, sign_of_half
from steadylight.renderers.mitsuba.image.reconstruction import border_of, integral_of, shares
from steadylight.renderers.mitsuba.memory import SAMPLES_AT_ONCE
from steadylight.renderers.mitsuba.sampling import samples_of
from steadylight.renderers.mitsuba.upload import download, upload

FINER = 4
"""Minimum samples of these pixels, as a multiple of the picture's samples per pixel."""

MOST_STEPS = 3
"""No pixel gets more than 4 to this power times the samples of another: one lane sums up a whole pixel."""


class Refinement(NamedTuple):
    """Pixels of some rows that get more samples.

    Attributes:
        pixels: (M,) of the picture, in row-major order.
        rows: first and one past the last wanted row.
        fine: samples of each of these pixels, but at least FINER times those of the picture.
        share_of_rays: maximum number of these samples, as a fraction of the picture's in these rows; `fine` is halved
            to satisfy it.
    """

    pixels: NDArray[np.intp]
    rows: tuple[int, int]
    fine: int
    share_of_rays: float

    def spp(self, width: int, spp: int) -> int:
        """Samples of each of these pixels, in a picture of this width and samples per pixel."""
        few, most = FINER * spp, self.share_of_rays * width * (self.rows[1] - self.rows[0]) * spp
        fine = self.fine
        # Halve, since each number of samples needs a kernel of its own.
        while fine > few and len(self.pixels) * fine > most:
            fine //= 2
        return max(fine, few)


class Estimates(NamedTuple):
    """Estimates of some pixels from their samples.

    Attributes:
        taps: (M, neighbours, 3) contributions to themselves and their neighbours, in row-major order (see
            `border_of`): sums of filter times radiance, over the samples of a pixel.
        mean: (M, 3) of each pixel.
        noise: (M, 3) half the difference of the means of two halves of a pixel's samples: as large as the error of
            `mean`.
        error: (M,) standard error of the luminance of `mean`, assuming independent samples.
    """

    taps: NDArray[np.float32]
    mean: NDArray[np.float32]
    noise: NDArray[np.float32]
    error: NDArray[np.float32]

    @classmethod
    def nothing(cls, pixels: int, rfilter: mi.ReconstructionFilter) -> Estimates:
        """Zero estimates."""
        side = 2 * border_of(rfilter) + 1
        sizes = ((pixels, side * side, 3), (pixels, 3), (pixels, 3), (pixels,))
        return cls(*(np.zeros(size, np.float32) for size in sizes))

    def less(self, other: Estimates, weight: NDArray[np.float32]) -> Estimates:
        """Difference of both estimates, times (M,) weights. Its `error` is not that of the difference."""
        pairs = zip(self, other, strict=True)
        return Estimates(*((a - b) * weight.reshape(-1, *[1] * (a.ndim - 1)) for a, b in pairs))


def samples_by_error(
    error: NDArray[np.floating[Any]], threshold: float, spp: int, most: float
) -> NDArray[np.intp]:
    """Samples of each pixel in proportion to its standard error.

    This minimises the sum of squared errors for a given total of samples (Neyman 1934).

    Args:
        error: (M,) standard errors.
        threshold: pixels of this error get FINER times `spp`. It is raised until the samples do not exceed `most`.
        spp: samples per pixel of the picture.
        most: maximum total of samples; exceeded if needed to give each pixel FINER times `spp`.

    Returns:
        (M,): FINER times `spp`, or 4, 16, ... times as many.
    """
    few = FINER * spp
    # With a lower threshold, the worst would get more than 4 to the power of MOST_STEPS times as many as others.
    threshold = max(threshold, float(error.max()) / 4**MOST_STEPS, float(np.finfo(np.float32).tiny))
    while True:
        # Rounded to the nearest power of 4, by ratio, since each number of samples needs a kernel of its own.
        steps = np.rint(np.log2(np.maximum(error / threshold, 1)) / 2)
        samples = few * 4 ** np.minimum(steps, MOST_STEPS).astype(np.intp)
        if samples.sum() <= most or not steps.any():
            return np.asarray(samples)
        threshold *= 1.1


def worst_around(
    pixels: NDArray[np.intp], error: NDArray[np.floating[Any]], width: int
) -> NDArray[np.float64]:
    """Maximum error over each pixel and its neighbours among these pixels.

    Args:
        pixels: (M,) of the picture, in row-major order, ascending.
        error: (M,) of each.
        width: of the picture.

    Returns:
        (M,).
    """
    picture, own = _drawn(error, pixels, width)
    worst: NDArray[np.float64] = maximum_filter(picture, 3).ravel()[own]
    return worst


def control_weight(
    noise: NDArray[np.floating[Any]],
    control: NDArray[np.floating[Any]],
    pixels: NDArray[np.intp],
    width: int,
) -> NDArray[np.float32]:
    """Optimal weight of a control variate: covariance over variance, from the noise of the surrounding pixels.

    Where the control variate has a firefly of its own, the weight is near 0.

    Args:
        noise: (M, 3) of an estimate; see `Estimates.noise`.
        control: (M, 3) likewise, of the control variate with the same samples.
        pixels: (M,) of the picture, in row-major order, ascending.
        width: of the picture.

    Returns:
        (M,) from 0 to 1.
    """
    ours, theirs = luminance(noise), luminance(control)
    products = (_drawn(each * theirs, pixels, width) for each in (ours, theirs))
    covariance, variance = (uniform_filter(picture, 3).ravel()[own] for picture, own in products)
    weight = np.divide(covariance, variance, out=np.ones_like(variance), where=variance > 0)
    return np.clip(weight, 0, 1).astype(np.float32)


def _drawn(
    values: NDArray[np.floating[Any]], pixels: NDArray[np.intp], width: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The rows of a picture that contain (M,) pixels, zero elsewhere; and the indices of these pixels in it."""
    own = pixels - pixels[0] // width * width
    picture = np.zeros((own[-1] // width + 1) * width)
    picture[own] = values
    return picture.reshape(-1, width), own


def refine_by_error(
    look: Look,
    rfilter: mi.ReconstructionFilter,
    sampling: Sampling,
    pixels: NDArray[np.intp],
    samples: NDArray[np.intp],
    bound: NDArray[np.float32] | None = None,
) -> Estimates:
    """Sample some pixels of a picture again, each with its own number of samples.

    Args:
        look: radiance seen by camera rays, Color3f; optionally with a mask of the rays where it is known.
        rfilter: of the picture.
        sampling: of the picture; the seed must differ from that of the samples that the pixels already have.
        pixels: (M,) of the picture, in row-major order.
        samples: (M,) of each.
        bound: (M,) on the luminance of one sample at the picture's samples per pixel; it grows in proportion to these.
    """
    found = Estimates.nothing(len(pixels), rfilter)
    for spp in np.unique(samples):
        some = np.flatnonzero(samples == spp)
        most = None if bound is None else bound[some] * np.float32(spp / sampling.spp)
        new = estimates(look, rfilter, Sampling(int(spp), sampling.seed), pixels[some], most)
        for every, part in zip(found, new, strict=True):
            every[some] = part
    return found


class Refined(NamedTuple):
    """What further samples of some pixels found.

    Attributes:
        given: (rows, width, 3) contributions to the picture, to be divided by `weight_of`.
        mean: (M, 3) of each of these pixels.
    """

    given: NDArray[np.float32]
    mean: NDArray[np.float32]


def refine(
    look: Look, rfilter: mi.ReconstructionFilter, sampling: Sampling, refinement: Refinement
) -> Refined:
    """Sample some pixels of a picture again, all with the same number of samples.

    Args:
        look: radiance seen by camera rays, Color3f; optionally with a mask of the rays where it is known.
        rfilter: of the picture.
        sampling: of the picture; the seed must differ from that of the samples that the pixels already have.
        refinement: which pixels, and how many samples.
    """
    width = look.camera.width
    again = Sampling(refinement.spp(width, sampling.spp), sampling.seed)
    top, bottom = refinement.rows
    total = np.zeros((bottom - top, width, 3), np.float32)
    means = [np.zeros((0, 3), np.float32)]
    for some in _pieces(refinement.pixels, again.spp):
        found = _sampled(look, rfilter, again, some, None)
        give(total, top, found.taps, some)
        means.append(found.mean)
    return Refined(total, np.concatenate(means))


def estimates(
    look: Look,
    rfilter: mi.ReconstructionFilter,
    sampling: Sampling,
    pixels: NDArray[np.intp],
    bound: NDArray[np.float32] | None = None,
) -> Estimates:
    """Sample (M,) pixels of a picture.

    Args:
        look: radiance seen by camera rays, Color3f; optionally with a mask of the rays where it is known.
        rfilter: of the picture.
        sampling: of these pixels. With the samples per pixel and seed of the picture, the rays are the same.
        pixels: of the picture, in row-major order.
        bound: (M,) on the luminance of a sample of each.
    """
    if not len(pixels):
        return Estimates.nothing(0, rfilter)
    found = [
        _sampled(look, rfilter, sampling, pixels[some], None if bound is None else bound[some])
        for some in _pieces(np.arange(len(pixels)), sampling.spp)
    ]
    return Estimates(*map(np.concatenate, zip(*found, strict=True)))


def give(total: NDArray[np.float32], top: int, taps: NDArray[np.float32], pixels: NDArray[np.intp]) -> None:
    """Splat the contributions of some pixels into a picture.

    Args:
        total: (rows, width, 3) of the picture, changed in place; to be divided by `weight_of`.
        top: the first of these rows.
        taps: (M, neighbours, 3); see `Estimates`.
        pixels: (M,) of the picture, in row-major order.
    """
    height, width, _ = total.shape
    side = isqrt(taps.shape[1])
    border = side // 2
    y, x = pixels // width - top, pixels % width
    for tap, share in enumerate(np.moveaxis(taps, 1, 0)):
        to_y, to_x = y + tap // side - border, x + tap % side - border
        there = (to_y >= 0) & (to_y < height) & (to_x >= 0) & (to_x < width)
        total[to_y[there], to_x[there]] += share[there]


def weight_of(rfilter: mi.ReconstructionFilter, size: tuple[int, int]) -> NDArray[np.float64]:
    """(height, width) expected sum of filter weights for one sample per pixel: less at the border of the picture."""
    width, height = size
    weights = integral_of(rfilter)
    total = np.ones((height, width))
    for axis in (0, 1):
        total = correlate1d(total, weights, axis, mode="constant")
    return total


def _pieces(pixels: NDArray[np.intp], spp: int) -> list[NDArray[np.intp]]:
    """Split into pieces that fit into memory."""
    at_once = max(1, SAMPLES_AT_ONCE // spp)
    return [pixels[begin : begin + at_once] for begin in range(0, len(pixels), at_once)]


def _sampled(
    look: Look,
    rfilter: mi.ReconstructionFilter,
    sampling: Sampling,
    pixels: NDArray[np.intp],
    bound: NDArray[np.float32] | None,
) -> Estimates:
    """`estimates` of pixels that are sampled in one launch."""
    lane = dr.arange(mi.UInt32, len(pixels) * sampling.spp)
    spp = dr.opaque(mi.UInt32, sampling.spp)
    within = lane // spp
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels.astype(np.uint32)), within)
    index = lane - within * spp
    samples = samples_of(dr.opaque(mi.UInt32, sampling.seed), pixel, index)
    found, offset = look(samples, pixel)
    L = found
    if isinstance(found, tuple):
        L, known = found
        L = _of_known(L, known, sampling.spp, within)
    if bound is not None:
        most, own = dr.gather(mi.Float, upload(mi.Float, bound), within), mi.luminance(L)
        L = L * dr.select(own > most, most / own, 1)
    own, signed = mi.luminance(L), L * sign_of_half(index, spp)
    square = dr.square(own)
    dr.eval(L, signed, own, square)  # in one kernel

    def mean_of(values: mi.Float) -> NDArray[np.float32]:
        return download(dr.block_reduce(dr.ReduceOp.Add, values, sampling.spp)) / np.float32(sampling.spp)

    error = np.sqrt(np.maximum(mean_of(square) - np.square(mean_of(own)), 0) / np.float32(sampling.spp))
    columns = shares(L, offset, rfilter, len(pixels), spp)
    dr.eval(columns)  # with the weights, so that it is the kernel of `reconstruct`
    rows = [download(total).reshape(len(pixels), len(columns), 3) for total, _ in columns]
    taps = np.stack(rows, axis=2).reshape(len(pixels), -1, 3) / np.float32(sampling.spp)
    mean, noise = (np.stack([mean_of(channel) for channel in each], axis=1) for each in (L, signed))
    return Estimates(taps, mean, noise, error)


def _of_known(L: mi.Color3f, known: mi.Bool, spp: int, within: mi.UInt32) -> mi.Color3f:
    """Samples whose sum over each pixel is as if its unknown samples were the mean of the known ones.

    Black in pixels where none is known.

    Args:
        L: radiance of the samples; those of a pixel are adjacent.
        known: whether it is known.
        spp: samples per pixel.
        within: number of each sample's pixel.
    """
    number = dr.select(known, dr.ones(mi.Float, dr.width(within)), 0)
    dr.eval(number)
    count = dr.block_reduce(dr.ReduceOp.Add, number, spp)
    # Opaque: one kernel for all numbers of samples.
    share = dr.opaque(mi.Float, spp) / dr.maximum(dr.gather(mi.Float, count, within), 1)
    return L * dr.select(known, share, 0)
