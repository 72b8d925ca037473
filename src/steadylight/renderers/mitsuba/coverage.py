"""Filling the cache for what cameras see: what makes records along a camera path, and a cache for a single view."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from steadylight.cache.placement import thin
from steadylight.cache.records import Records
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.light.grid import GridEmitterSampling, walk
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Gather, GatherContext
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.secondary import secondary_cache
from steadylight.renderers.mitsuba.sampling import seed_of
from steadylight.renderers.mitsuba.upload import upload
from steadylight.renderers.mitsuba.view import View, diagonal, on_host

SPARSE = (512, 4096, 32768)
"""Pixels looked through before every pixel is, when a cache is made from nothing."""

WALK_RAYS = 2048
WALK_CAMERAS = 16
"""Random walks that tell where gather rays end: how many from each camera, and cameras along the path at most."""

FULL_ROUNDS = 3
"""Times that every pixel is looked through, each time elsewhere in the pixel."""


def make_filler(view: View, poses: Sequence[Pose], bounces: int | None) -> Filler:
    """What makes records along a camera path, with all that makes the gather quiet.

    Random walks from cameras spread over the path tell where gather rays will end; there emitter sampling and the
    secondary cache are prepared.

    Args:
        view: its camera is moved.
        poses: all camera poses of the animation.
        bounces: indirect diffuse bounces; None for all.
    """
    quality, width, extent = view.quality, view.camera.width, diagonal(view.scene)
    cameras = min(WALK_CAMERAS, len(poses))
    chosen = sorted({round(k * (len(poses) - 1) / max(cameras - 1, 1)) for k in range(cameras)})
    sobol = qmc.Sobol(2, rng=np.random.default_rng(0))
    parts = []
    for number in chosen:
        view.camera.look(poses[number])
        _, ray = view.rays_through(draw(sobol, WALK_RAYS), number)
        parts.append(on_host(ray, WALK_RAYS))
    o, d = np.concatenate(parts, axis=1)
    rays = mi.Ray3f(upload(mi.Point3f, o), upload(mi.Vector3f, d))
    position, normal = walk(view.scene, rays, WALK_RAYS * len(chosen), view.panes)
    points = Points(position, normal, np.full(len(position), np.inf, np.float32))
    rays = quality.shading.emitter_rays
    grid = GridEmitterSampling(view.scene, view.environment, position, normal, rays, view.panes)

    bounds = RadiusBounds(poses, width, extent, quality.secondary)
    context = GatherContext(view.lit_by(grid, quality.secondary.emitter_samples))
    secondary = secondary_cache(Gather(quality.secondary, bounces, context), points, bounds)
    context = GatherContext(view.lit_by(grid, quality.records.emitter_samples), secondary)
    bounds = RadiusBounds(poses, width, extent, quality.records, view.longest)
    return Filler(Gather(quality.records, bounces, context), bounds)


def fill_view(view: View, filler: Filler, cache: DeviceCache, seed: int) -> DeviceCache:
    """The cache with private records wherever this view misses: sparse pixels first if it is empty, then all."""
    sobol = qmc.Sobol(2, rng=np.random.default_rng(seed))
    if len(cache.records) == 0:
        for number, pixels in enumerate(n for n in SPARSE if 2 * n < view.camera.pixels):
            points, _ = view.missed_through(draw(sobol, pixels), cache, seed_of(seed, 1, number))
            cache = _filled(filler, cache, points, seed_of(seed, 2, number))
    for number in range(FULL_ROUNDS):
        missed = view.missed_in_pixels(cache, seed_of(seed, 3, number))
        if missed.missed == 0:
            break
        cache = _filled(filler, cache, missed.points, seed_of(seed, 4, number))
    return cache


def _filled(filler: Filler, cache: DeviceCache, points: Points, seed: int) -> DeviceCache:
    if len(points.position) == 0:
        return cache
    made = filler.fill(thinned(points, filler.bounds), seed)
    return DeviceCache(Records.concatenate(cache.records, made))


def thinned(points: Points, bounds: RadiusBounds) -> Points:
    """Without points so close to another that one record answers both, as a rule."""
    return points.take(thin_rows(points, bounds))


def thin_rows(points: Points, bounds: RadiusBounds) -> NDArray[np.intp]:
    """Rows of the points that `thinned` keeps: the most demanding of each cell."""
    order = np.argsort(points.longest, kind="stable")
    if len(order) == 0:
        return order
    points = points.take(order)
    return order[thin(points.position, points.normal, bounds.at(points.position).smallest / 2)]


def draw(sobol: qmc.Sobol, count: int) -> NDArray[np.float32]:
    """The next `count` points of a Sobol' sequence in [0, 1)²."""
    with warnings.catch_warnings():
        # Balance holds for powers of two; the number of base rays is the user's.
        warnings.simplefilter("ignore", UserWarning)
        return np.minimum(sobol.random(count), np.float32(1 - 2**-24)).astype(np.float32)
