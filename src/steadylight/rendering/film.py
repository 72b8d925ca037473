"""From samples to an image, in an order that never varies.

Mitsuba's image block adds samples to pixels with atomic operations, whose order (and so the last bit) changes from
run to run. Here each pixel collects the samples of its neighbourhood itself: the same filter, the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

LANES = 1 << 24
"""Samples in flight: bounds memory. A constant, so that the split does not depend on the machine."""

SPP_AT_ONCE = 64
"""More samples per pixel than this are taken in passes of equal size."""

Radiance = Callable[[Any, Any], tuple[Any, Any]]
"""(sampler, ray) -> (Color3f radiance, UInt32 count to be summed over the image)."""


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


def camera_rays(sensor: Any, sampler: Any, size: tuple[int, int], top: int, lanes: int) -> tuple[Any, Any]:
    """Camera rays of whole rows, samples of a pixel side by side.

    Args:
        sensor: mi.Sensor.
        sampler: seeded for `lanes` samples.
        size: width and height of the image, pixels.
        top: first row.
        lanes: rows * width * spp.

    Returns:
        Ray3f, weighted by nothing (the sensors we take have unit weight), and Point2f offset in the pixel.
    """
    width, height = size
    spp = sampler.sample_count()
    pixel = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, spp)
    w = dr.opaque(mi.UInt32, width)
    row = pixel // w
    column = pixel - row * w
    offset = sampler.next_2d()
    corner = mi.Point2f(mi.Float(column), mi.Float(row + dr.opaque(mi.UInt32, top)))
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
    width, height = size
    passes = math.ceil(spp / SPP_AT_ONCE)
    sampler = make_sampler(math.ceil(spp / passes))
    spp_pass = sampler.sample_count()
    border = math.ceil(rfilter.radius() - 0.5)
    rows = max(1, LANES // (width * spp_pass) - 2 * border)
    image = np.zeros((height, width, 3), np.float32)
    count = 0
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(top - border, 0), min(bottom + border, height)
        total = np.zeros((bottom - top, width, 4), np.float32)
        lanes = (last - first) * width * spp_pass
        for number in range(passes):
            sampler.seed(dr.opaque(mi.UInt32, seed_of(seed, top, number)), lanes)
            ray, offset = camera_rays(sensor, sampler, size, first, lanes)
            L, counted = radiance(sampler, ray)
            dr.eval(L, offset, counted)
            count += int(dr.sum(dr.select(counted > 0, mi.UInt64(counted), 0))[0])
            total += _reconstruct(L, offset, rfilter, width, (first, last), (top, bottom), spp_pass)
        image[top:bottom] = total[..., :3] / np.where(total[..., 3:] != 0, total[..., 3:], 1)
    return image, count


@dr.syntax
def _reconstruct(
    L: Any, offset: Any, rfilter: Any, width: int, have: tuple[int, int], want: tuple[int, int], spp: int
) -> Any:
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
    border = math.ceil(rfilter.radius() - 0.5)
    rows = want[1] - want[0]
    w = dr.opaque(mi.Int32, width)
    pixel = dr.arange(mi.Int32, rows * width)
    y = pixel // w
    x = pixel - y * w
    y += dr.opaque(mi.Int32, want[0] - have[0])
    height = dr.opaque(mi.Int32, have[1] - have[0])
    samples = dr.opaque(mi.Int32, spp)
    # ---- loop state ----------------------------------------------------------------------
    tap = mi.Int32(0)  # neighbour, row by row
    s = mi.Int32(0)  # sample of the neighbour
    total = mi.Color3f(0)
    weight = mi.Float(0)
    side = 2 * border + 1
    while tap < side * side:
        dy = tap // side - border
        dx = tap - (dy + border) * side - border
        there = (x + dx >= 0) & (x + dx < w) & (y + dy >= 0) & (y + dy < height)
        index = mi.UInt32(((y + dy) * w + x + dx) * samples + s)
        at = dr.gather(mi.Point2f, offset, index, there)
        away = mi.Point2f(mi.Float(dx) + at.x - 0.5, mi.Float(dy) + at.y - 0.5)
        f = rfilter.eval(away.x) * rfilter.eval(away.y)
        f = dr.select(there & dr.all(dr.abs(away) <= rfilter.radius()), f, 0)
        total += f * dr.gather(mi.Color3f, L, index, there)
        weight += f
        s += 1
        tap = dr.select(s == samples, tap + 1, tap)
        s = dr.select(s == samples, 0, s)
    dr.eval(total, weight)
    return np.stack([*np.array(total), np.array(weight)], axis=1).reshape(rows, width, 4)
