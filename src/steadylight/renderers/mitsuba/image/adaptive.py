"""Adaptive sampling: some pixels of a picture get many more camera rays than the others.

Only for light that can be had without the cache, since the coverage audit does not know these rays.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from steadylight.renderers.mitsuba.image.pixels import Look, Sampling, sign_of_half
from steadylight.renderers.mitsuba.image.reconstruction import border_of, integral_of, shares
from steadylight.renderers.mitsuba.memory import SAMPLES_AT_ONCE
from steadylight.renderers.mitsuba.sampling import samples_of
from steadylight.renderers.mitsuba.upload import download, upload

FINER = 4
"""These pixels have at least so many times as many samples as all have."""


class Refinement(NamedTuple):
    """Pixels of some rows that get more samples.

    Attributes:
        pixels: (M,) of the picture, row by row.
        rows: first and one past the last row that are wanted.
        fine: samples of each of the pixels, or FINER times those of the picture if that is more.
        share_of_rays: of those of the picture in these rows: `fine` is halved while the samples would be more.
    """

    pixels: NDArray[np.intp]
    rows: tuple[int, int]
    fine: int
    share_of_rays: float

    def spp(self, width: int, spp: int) -> int:
        """Samples of each of the pixels, in a picture of this width and samples per pixel."""
        few, most = FINER * spp, self.share_of_rays * width * (self.rows[1] - self.rows[0]) * spp
        fine = self.fine
        # By halves, since each number of samples is a kernel of its own.
        while fine > few and len(self.pixels) * fine > most:
            fine //= 2
        return max(fine, few)


class Refined(NamedTuple):
    """What some pixels give to a picture when they get more samples.

    Attributes:
        given: (rows, width, 3) sums of filter times radiance, over the samples of a pixel in the mean: to be divided by
            `weight_of`.
        mean: (M, 3) of each pixel.
        noise: (M, 3) half the difference of the means of two halves of a pixel's samples: as large as the error of
            `mean`.
    """

    given: NDArray[np.float32]
    mean: NDArray[np.float32]
    noise: NDArray[np.float32]


def refine(
    look: Look,
    rfilter: mi.ReconstructionFilter,
    sampling: Sampling,
    refinement: Refinement,
) -> Refined:
    """Sample some pixels of a picture again, and more.

    Args:
        look: radiance that a camera ray sees, Color3f.
        rfilter: of the picture.
        sampling: of the picture; the seed must be another one than that of the samples that the pixels have already.
        refinement: which pixels, and how many samples.
    """
    pixels, (top, bottom) = refinement.pixels, refinement.rows
    camera = look.camera
    border, width = border_of(rfilter), camera.width
    side = 2 * border + 1
    given = np.zeros((bottom - top, width, 3), np.float32)
    mean_and_noise = np.zeros((2, len(pixels), 3), np.float32)
    spp = refinement.spp(width, sampling.spp)
    at_once = max(1, SAMPLES_AT_ONCE // spp)
    for begin in range(0, len(pixels), at_once):
        some = pixels[begin : begin + at_once]
        taps, mean_and_noise[:, begin : begin + at_once] = _sampled(
            look, rfilter, Sampling(spp, sampling.seed), some
        )
        y, x = some // width - top, some % width
        for tap, share in enumerate(np.moveaxis(taps, 1, 0)):
            to_y, to_x = y + tap // side - border, x + tap % side - border
            there = (to_y >= 0) & (to_y < len(given)) & (to_x >= 0) & (to_x < width)
            given[to_y[there], to_x[there]] += share[there]
    return Refined(given, *mean_and_noise)


def weight_of(rfilter: mi.ReconstructionFilter, size: tuple[int, int]) -> NDArray[np.float64]:
    """(height, width) sum of a filter over a sample of each pixel in the mean: less at the margin of the picture."""
    width, height = size
    weights = integral_of(rfilter)
    total = np.ones((height, width))
    for axis in (0, 1):
        total = correlate1d(total, weights, axis, mode="constant")
    return total


def _sampled(
    look: Look,
    rfilter: mi.ReconstructionFilter,
    sampling: Sampling,
    pixels: NDArray[np.intp],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What (M,) pixels give to themselves and their neighbours.

    Returns:
        (M, neighbours, 3), neighbours row by row (see `border_of`); and (2, M, 3) `mean` and `noise` of `Refined`.
    """
    lane = dr.arange(mi.UInt32, len(pixels) * sampling.spp)
    spp = dr.opaque(mi.UInt32, sampling.spp)
    within = lane // spp
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels.astype(np.uint32)), within)
    index = lane - within * spp
    samples = samples_of(dr.opaque(mi.UInt32, sampling.seed), pixel, index)
    L, offset = look(samples, pixel)
    columns = [total * dr.rcp(mi.Float(spp)) for total, _ in shares(L, offset, rfilter, len(pixels), spp)]
    sums = [
        mi.Color3f(*(dr.block_reduce(dr.ReduceOp.Add, channel * sign, sampling.spp) for channel in L))
        for sign in (mi.Float(1), sign_of_half(index, spp))
    ]
    dr.eval(columns, sums)
    rows = [download(column).reshape(len(pixels), len(columns), 3) for column in columns]
    taps = np.stack(rows, axis=2).reshape(len(pixels), -1, 3)
    return taps, np.stack([download(total) for total in sums]) / np.float32(sampling.spp)
