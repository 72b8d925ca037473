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
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

import mitsuba as mi
from steadylight.renderers.mitsuba.bsdf.lobes import LEFT, BSDFTraits
from steadylight.renderers.mitsuba.image.adaptive import sampled_again, weight_of
from steadylight.renderers.mitsuba.image.reconstruction import Emitted, integral_of

EDGE = 0.25
"""Pixels are sampled again if emission among their neighbours differs by this part of the picture's mean luminance."""

FINE, PART = 256, 0.4
"""They get so many samples, unless this were more than that part of the picture's own rays; see `sampled_again`."""

CHEAP = 1 << 18
"""Rays that are sent whatever part they are: edges are much of a small picture."""


def emission_image(
    scene: Any,
    bsdfs: BSDFTraits,
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
        bsdfs: of this scene.
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
    weights = integral_of(rfilter)
    for axis in (0, 1):
        image = correlate1d(image, weights, axis, mode="constant")
    total = weight_of(rfilter, size)

    def seen(sampler: Any, ray: Any) -> Any:
        return _seen(scene, bsdfs, sampler, ray, depth_limit)

    pixels = rows * width + columns
    part = max(PART, CHEAP / (width * height * spp))
    given, _ = sampled_again(sensor, rfilter, size, spp, seed, pixels, seen, (0, height), FINE, part)
    return np.asarray((image + given) / total[..., None], np.float32)


@dr.syntax
def _seen(scene: Any, bsdfs: BSDFTraits, sampler: Any, ray: Any, depth_limit: Any) -> Any:
    """What shines at the start of rays, itself or by mirrors and clear glass: `emitted` of `transport.trace`."""
    # ---- loop state ----------------------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)
    beta = mi.Color3f(1)
    depth = mi.UInt32(0)
    visit, more, met = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)  # as there
    first_ray = mi.Ray3f(ray)
    active = mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        emitter = si.emitter(scene)
        lit = active & (met >= visit) & (emitter != None)  # noqa: E711 - element-wise
        L = dr.select(lit, L + beta * emitter.eval(si, lit), L)
        bsdf = si.bsdf(ray)
        active &= si.is_valid() & (depth <= depth_limit) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        lobe, direction = sampler.next_1d(active), sampler.next_2d(active)
        coated, pane, mirrored = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        if dr.hint(bsdfs.some_coated, mode="scalar"):
            coated = bsdfs.coat(bsdf, active)
        if dr.hint(bsdfs.some_panes, mode="scalar"):
            pane, mirrored = bsdfs.pane(bsdf, visit, met, active)
            more += dr.select(pane & (visit == 0), mi.UInt32(1), 0)
        bs, weight = bsdfs.sample(bsdf, si, lobe, direction, active, coated, pane, mirrored)
        active &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & dr.any(weight != 0)
        beta *= weight
        ray = si.spawn_ray(si.to_world(bs.wo))
        depth += 1
        if dr.hint(bsdfs.some_panes, mode="scalar"):
            met = dr.select(pane & ~mirrored, met + 1, LEFT)
            back = ~active & (more > 0)
            more -= dr.select(back, mi.UInt32(1), 0)
            ray = dr.select(back, first_ray, ray)
            beta = dr.select(back, mi.Color3f(1), beta)
            depth = dr.select(back, mi.UInt32(0), depth)
            met = dr.select(back, mi.UInt32(0), met)
            visit += dr.select(back, mi.UInt32(1), 0)
            active |= back
    return L
