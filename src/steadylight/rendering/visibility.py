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
from steadylight.rendering.film import seed_of
from steadylight.rendering.scene import build_scene, build_sensor, set_pose
from steadylight.rendering.upload import upload
from steadylight.rendering.view import View, diagonal, draw
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

RAYS = 2048
"""Camera rays of each frame."""


class _Nothing:
    """Stands in for a cache that has no answer to anything."""

    def weight(self, _position: Any, _normal: Any, _longest: Any, _active: Any) -> Any:
        """Zero."""
        return mi.Float(0)


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
    seen = [_points_of(view, poses, seed_of(settings.seed, number)) for number, poses in enumerate(windows)]
    middle = central_box(np.concatenate(seen))
    spacing = settings.cache.maximum_spacing
    # What the film sees may be a small part of the scene, whose diagonal bounds the reach otherwise.
    reach = spacing * min(diagonal(scene), max(float(np.linalg.norm(middle[1] - middle[0])), 1e-6))
    box = scene.bbox()
    return divide_space(seen, settings.cache_parts, reach, np.array([box.min, box.max], np.float64))


def _points_of(view: View, poses: Sequence[Pose], seed: int) -> Floats:
    """(P, 3) surface points at which rays of some frames ask the cache, metres."""
    rays = []
    for number, pose in enumerate(poses):
        set_pose(view.sensor, pose)
        sobol = qmc.Sobol(2, rng=np.random.default_rng(seed_of(seed, number)))
        _, ray = view.rays_through(draw(sobol, RAYS), seed_of(seed, number))
        rays.append(np.stack([np.array(ray.o).T, np.array(ray.d).T]))
    origin, direction = (upload(mi.Point3f, part) for part in np.concatenate(rays, axis=1))
    lanes = RAYS * len(poses)

    def all_rays() -> tuple[Any, Any]:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), lanes)
        return sampler, mi.Ray3f(origin, mi.Vector3f(direction))

    points, _ = view.missed(all_rays, _Nothing(), lanes)
    return points.position
