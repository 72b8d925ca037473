"""What shines at the camera itself, antialiased finer than what it lights.

A lamp or a window is often a hundred times as bright as the wall beside it. The few camera rays of a pixel tell well
enough how much of it is wall and how much is floor; of an edge of the lamp the same uncertainty makes a ragged line,
which crawls when the camera moves and moves the brightness of the whole picture. To see a lamp takes a camera ray and
nothing else, but for mirrors and glass on its way, so edges of what shines get many more of them, in pixels where
neighbours differ.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

from steadylight.rendering.film import (
    LANES,
    Emitted,
    border_of,
    camera_rays,
    integral_of,
    make_sampler,
    seed_of,
    shares,
)
from steadylight.rendering.upload import upload

EDGE = 0.25
"""Pixels are sampled again if emission among their neighbours differs by this part of the picture's mean luminance."""

FINE, FINER = 256, 4
"""Samples of these pixels: so many, and at least so many times as many as all pixels have. With so many such pixels
that the former would be more rays than the picture's own, the latter alone."""


def emission_image(
    scene: Any,
    sensor: Any,
    rfilter: Any,
    size: tuple[int, int],
    spp: int,
    depth_limit: Any,
    seed: int,
    emitted: Emitted,
    brightness: float,
) -> NDArray[np.float32]:
    """The emitters that the camera sees, itself or by mirrors and clear glass, without what is lit by them.

    Args:
        scene: mi.Scene.
        sensor: mi.Sensor.
        rfilter: mi.ReconstructionFilter.
        size: width and height, pixels.
        spp: samples per pixel that `emitted` is from.
        depth_limit: UInt32, most mirrors and panes of glass on the way.
        seed: decides all random numbers.
        emitted: what the samples of the picture met.
        brightness: mean luminance of the picture, emission included.

    Returns:
        (height, width, 3) float32 scene-linear RGB.
    """
    width, height = size
    if not emitted.highest.any():
        return np.zeros((height, width, 3), np.float32)
    contrast = maximum_filter(emitted.highest, 3) - minimum_filter(emitted.lowest, 3)
    rows, columns = np.nonzero(contrast > EDGE * brightness)
    # Elsewhere a pixel is as bright all over as it is on average.
    image = emitted.mean.copy()
    image[rows, columns] = 0
    border = border_of(rfilter)
    weights = integral_of(rfilter)
    total = np.ones((height, width), np.float32)
    for axis in (0, 1):
        image = correlate1d(image, weights, axis, mode="constant")
        total = correlate1d(total, weights, axis, mode="constant")
    samples = FINER * spp if len(rows) * FINE > width * height * spp else max(FINE, FINER * spp)
    sampler = make_sampler(samples)
    at_once = max(1, LANES // sampler.sample_count())
    for begin in range(0, len(rows), at_once):
        y, x = rows[begin : begin + at_once], columns[begin : begin + at_once]
        lanes = len(y) * sampler.sample_count()
        sampler.seed(dr.opaque(mi.UInt32, seed_of(seed, height, begin)), lanes)
        sampled = _sampled(scene, sensor, sampler, rfilter, size, depth_limit, y * width + x)
        for tap, share in enumerate(np.moveaxis(sampled, 1, 0)):
            to_y, to_x = y + tap // (2 * border + 1) - border, x + tap % (2 * border + 1) - border
            there = (to_y >= 0) & (to_y < height) & (to_x >= 0) & (to_x < width)
            image[to_y[there], to_x[there]] += share[there]
    return np.asarray(image / total[..., None], np.float32)


def _sampled(
    scene: Any,
    sensor: Any,
    sampler: Any,
    rfilter: Any,
    size: tuple[int, int],
    depth_limit: Any,
    pixels: NDArray[np.intp],
) -> NDArray[np.float32]:
    """What the emission within some pixels gives to these and their neighbours.

    Args:
        scene: mi.Scene.
        sensor: mi.Sensor.
        sampler: seeded for all samples.
        rfilter: mi.ReconstructionFilter.
        size: width and height of the picture, pixels.
        depth_limit: UInt32, most mirrors and panes of glass on the way.
        pixels: (M,) row by row.

    Returns:
        (M, neighbours, 3) float32, neighbours row by row; see `border_of`.
    """
    lane = dr.arange(mi.UInt32, len(pixels) * sampler.sample_count())
    spp = dr.opaque(mi.UInt32, sampler.sample_count())
    pixel = dr.gather(mi.UInt32, upload(mi.UInt32, pixels.astype(np.uint32)), lane // spp)
    ray, offset = camera_rays(sensor, sampler, size, pixel)
    Le = _seen(scene, sampler, ray, depth_limit)
    dr.eval(Le, offset)
    columns = [total * dr.rcp(mi.Float(spp)) for total, _ in shares(Le, offset, rfilter, len(pixels), spp)]
    dr.eval(columns)
    # Channel by channel: a vector as a whole comes over by a kernel that is compiled for its length.
    by_column = [np.stack([np.array(channel) for channel in column], axis=-1) for column in columns]
    rows = [values.reshape(len(pixels), len(columns), 3) for values in by_column]
    return np.stack(rows, axis=2).reshape(len(pixels), -1, 3)


@dr.syntax
def _seen(scene: Any, sampler: Any, ray: Any, depth_limit: Any) -> Any:
    """What shines at the start of rays, itself or by mirrors and clear glass: `emitted` of `transport.trace`."""
    ctx = mi.BSDFContext()
    # ---- loop state ----------------------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)
    beta = mi.Color3f(1)
    depth = mi.UInt32(0)
    active = mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        emitter = si.emitter(scene)
        lit = active & (emitter != None)  # noqa: E711 - element-wise
        L = dr.select(lit, L + beta * emitter.eval(si, lit), L)
        bsdf = si.bsdf(ray)
        active &= si.is_valid() & (depth <= depth_limit) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        active &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & dr.any(weight != 0)
        beta *= weight
        ray = si.spawn_ray(si.to_world(bs.wo))
        depth += 1
    return L
