"""What the frames of a film look up, found before the run: from it follow the parts of the cache and who reads them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from steadylight.cache.partition import Partition, central_box, divide_space
from steadylight.cache.records import Floats
from steadylight.camera import Pose
from steadylight.rendering.demand import Demand
from steadylight.rendering.film import seed_of
from steadylight.rendering.scene import build_scene, build_sensor, set_pose
from steadylight.rendering.transport import trace
from steadylight.rendering.upload import upload
from steadylight.rendering.view import View, diagonal, draw
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

RAYS = 2048
"""Camera rays of each frame."""

CELLS, FINENESS = 1 << 20, 4096
"""Of a window's hash grid: places in it, and cells along the diagonal of the scene."""


class _Seen:
    """Stands in for a cache: it answers in cells where a point was found before, so that paths go on from there."""

    def __init__(self, cells_per_metre: Any) -> None:
        self._per_metre = cells_per_metre
        self._known = dr.zeros(mi.Float, CELLS)
        dr.make_opaque(self._known)

    def weight(self, position: Any, _normal: Any, _longest: Any, active: Any) -> Any:
        """One in known cells, else zero."""
        return dr.gather(mi.Float, self._known, self._place(position), active)

    def note(self, position: Any, active: Any) -> None:
        """These cells are known from now on."""
        dr.scatter(self._known, mi.Float(1), self._place(position), active)
        dr.eval(self._known)

    def _place(self, position: Any) -> Any:
        x, y, z = (mi.UInt32(mi.Int32(dr.floor(axis * self._per_metre))) for axis in position)
        return mi.sample_tea_32(x ^ (y * 0x9E3779B1), z)[0] & (CELLS - 1)


def survey(
    description: SceneDescription, windows: Sequence[Sequence[Pose]], settings: RenderSettings
) -> Partition:
    """The parts of the cache, and which of them each window of frames reads.

    Args:
        description: the scene.
        windows: camera poses of the frames of each window.
        settings: of the film.
    """
    scene = build_scene(description)
    sensor = build_sensor(description, windows[0][0], settings.width, settings.height)
    view = View(scene, sensor, (settings.width, settings.height), settings.depth, settings.cache)
    seen = [
        _points_of(view, poses, settings.depth, seed_of(settings.seed, number))
        for number, poses in enumerate(windows)
    ]
    middle = central_box(np.concatenate(seen))
    spacing = settings.cache.maximum_spacing
    # What the film sees may be a small part of the scene, whose diagonal bounds the reach otherwise.
    reach = spacing * min(diagonal(scene), max(float(np.linalg.norm(middle[1] - middle[0])), 1e-6))
    box = scene.bbox()
    return divide_space(seen, settings.cache_parts, reach, np.array([box.min, box.max], np.float64))


def _points_of(view: View, poses: Sequence[Pose], depth: int, seed: int) -> Floats:
    """(P, 3) surface points at which rays of some frames ask the cache, one to a ray and round at most, metres."""
    rays = []
    for number, pose in enumerate(poses):
        set_pose(view.sensor, pose)
        sobol = qmc.Sobol(2, rng=np.random.default_rng(seed_of(seed, number)))
        _, ray = view.rays_through(draw(sobol, RAYS), seed_of(seed, number))
        rays.append(np.stack([np.array(ray.o).T, np.array(ray.d).T]))
    origin, direction = (upload(mi.Point3f, part) for part in np.concatenate(rays, axis=1))
    extent = diagonal(view.scene)
    known = _Seen(dr.opaque(mi.Float, FINENESS / extent))
    nothing = dr.opaque(mi.Float, 1e-6 * extent)
    demand = Demand(
        origin, nothing, nothing, nothing
    )  # how near a record would have to be does not matter here
    found = []
    for _ in range(depth + 1):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), RAYS * len(poses))
        ray = mi.Ray3f(origin, mi.Vector3f(direction))
        depth_limit = view.depth
        asked = trace(view.scene, sampler, ray, known, None, view.sky, view.materials, depth_limit, demand)
        dr.eval(asked.position, asked.missed)
        new = np.array(asked.missed) > 0
        if not new.any():
            break
        found.append(np.array(asked.position).T[new].astype(np.float32))
        if view.materials.only_diffuse:
            break  # a path asks once
        known.note(asked.position, asked.missed > 0)
    return np.concatenate([np.zeros((0, 3), np.float32), *found])
