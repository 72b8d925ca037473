"""Adaptive sampling: some pixels of a picture get many more camera rays than the others.

Only for light that can be had without the cache, since the coverage audit does not know these rays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

import mitsuba as mi
from steadylight.renderers.mitsuba.image.reconstruction import (
    LANES,
    border_of,
    camera_rays,
    integral_of,
    make_sampler,
    seed_of,
    shares,
)
from steadylight.renderers.mitsuba.upload import upload

FINER = 4
"""These pixels have at least so many times as many samples as all have."""


def sampled_again(
    sensor: Any,
    rfilter: Any,
    size: tuple[int, int],
    spp: int,
    seed: int,
    pixels: NDArray[np.intp],
    seen: Callable[[Any, Any], Any],
    rows: tuple[int, int],
    fine: int,
    part: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What some pixels give to a picture when they get more samples.

    Args:
        sensor: mi.Sensor.
        rfilter: mi.ReconstructionFilter.
        size: width and height of the picture, pixels.
        spp: samples that all pixels have.
        seed: decides all random numbers.
        pixels: (M,) row by row.
        seen: (sampler, ray) -> Color3f.
        rows: first and one past the last that are wanted.
        fine: samples of each of the pixels, or FINER times `spp` if that is more.
        part: of the picture's rays: if `fine` samples were more than this, it is FINER times `spp`.

    Returns:
        (rows, width, 3) sums of filter times radiance, over the samples of a pixel in the mean: to be divided by
        `weight_of`; and (M, 3) means over each pixel.
    """
    width, height = size
    border = border_of(rfilter)
    side = 2 * border + 1
    given = np.zeros((rows[1] - rows[0], width, 3), np.float32)
    means = np.zeros((len(pixels), 3), np.float32)
    few = FINER * spp
    samples = few if len(pixels) * fine > part * width * height * spp else max(fine, few)
    sampler = make_sampler(samples)
    at_once = max(1, LANES // sampler.sample_count())
    for begin in range(0, len(pixels), at_once):
        some = pixels[begin : begin + at_once]
        lanes = len(some) * sampler.sample_count()
        sampler.seed(dr.opaque(mi.UInt32, seed_of(seed, height, rows[0], begin)), lanes)
        taps, means[begin : begin + at_once] = _sampled(sensor, sampler, rfilter, size, some, seen)
        y, x = some // width - rows[0], some % width
        for tap, share in enumerate(np.moveaxis(taps, 1, 0)):
            to_y, to_x = y + tap // side - border, x + tap % side - border
            there = (to_y >= 0) & (to_y < len(given)) & (to_x >= 0) & (to_x < width)
            given[to_y[there], to_x[there]] += share[there]
    return given, means


def weight_of(rfilter: Any, size: tuple[int, int]) -> NDArray[np.float64]:
    """(height, width) sum of a filter over a sample of each pixel in the mean: less at the margin of the picture."""
    width, height = size
    weights = integral_of(rfilter)
    total = np.ones((height, width))
    for axis in (0, 1):
        total = correlate1d(total, weights, axis, mode="constant")
    return total


def _sampled(
    sensor: Any,
    sampler: Any,
    rfilter: Any,
    size: tuple[int, int],
    pixels: NDArray[np.intp],
    seen: Callable[[Any, Any], Any],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What some pixels give to themselves and their neighbours.

    Args:
        sensor: mi.Sensor.
        sampler: seeded for all samples.
        rfilter: mi.ReconstructionFilter.
        size: width and height of the picture, pixels.
        pixels: (M,) row by row.
        seen: (sampler, ray) -> Color3f.

    Returns:
        (M, neighbours, 3), neighbours row by row (see `border_of`), and (M, 3) means.
    """
    spp = sampler.sample_count()
    lane = dr.arange(mi.UInt32, len(pixels) * spp)
    number = dr.opaque(mi.UInt32, spp)
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels.astype(np.uint32)), lane // number)
    ray, offset = camera_rays(sensor, sampler, size, pixel)
    L = seen(sampler, ray)
    dr.eval(L, offset)
    columns = [
        total * dr.rcp(mi.Float(number)) for total, _ in shares(L, offset, rfilter, len(pixels), number)
    ]
    means = [dr.block_reduce(dr.ReduceOp.Add, channel, spp) for channel in L]
    dr.eval(columns, means)
    # Channel by channel: a vector as a whole comes over by a kernel that is compiled for its length.
    by_column = [np.stack([np.array(channel) for channel in column], axis=-1) for column in columns]
    rows = [values.reshape(len(pixels), len(columns), 3) for values in by_column]
    taps = np.stack(rows, axis=2).reshape(len(pixels), -1, 3)
    return taps, np.stack([np.array(mean) for mean in means], axis=-1, dtype=np.float32) / np.float32(spp)
