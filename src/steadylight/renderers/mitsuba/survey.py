"""What the frames see, found before the run: it decides the parts of the cache and which frames read them."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from steadylight.cache.partition import Partition, central_box, divide_space
from steadylight.cache.placement import thin
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.coverage import draw
from steadylight.renderers.mitsuba.image.pixels import Camera
from steadylight.renderers.mitsuba.quality import quality_of
from steadylight.renderers.mitsuba.records.filling import Points, RadiusBounds
from steadylight.renderers.mitsuba.sampling import Samples, samples_of, seed_of
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
from steadylight.renderers.mitsuba.upload import upload
from steadylight.renderers.mitsuba.view import View, diagonal, on_host
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

RAYS = 2048
"""Camera rays per frame."""

PATCH = 4.0
"""Edge of a patch of surface, in radii of a record there; patches measure the work in a part of the cache."""


def survey(
    description: SceneDescription, windows: Sequence[Sequence[Pose]], settings: RenderSettings
) -> Partition:
    """The parts of the cache, and which of them each window of frames reads.

    Args:
        description: the scene.
        windows: camera poses of the frames of each window.
        settings: of the animation.
    """
    quality = quality_of(settings)
    scene = build_scene(description)
    size = (settings.width, settings.height)
    camera = Camera(build_sensor(description, windows[0][0], *size), size)
    view = View(scene, camera, settings.depth, quality)
    if settings.first_pass == "surface":
        view.ask_by_worth(settings.bounces)
    every = [pose for poses in windows for pose in poses]
    bounds = RadiusBounds(every, settings.width, diagonal(scene), quality.records)
    points = [points_of(view, poses, seed_of(settings.seed, number)) for number, poses in enumerate(windows)]
    seen = [each.position for each in points]
    # Work goes with the number of records, which are dense where things are small and near, not with that of look-ups.
    pieces = patches(Points.concatenate([patches(each, bounds) for each in points]), bounds)
    middle = central_box(np.concatenate(seen))
    spacing = quality.records.maximum_spacing
    # The diagonal of the scene bounds the radius, but what the frames see may be a small part of the scene.
    radius = spacing * min(diagonal(scene), max(float(np.linalg.norm(middle[1] - middle[0])), 1e-6))
    box = scene.bbox()
    corners = np.array([box.min, box.max], np.float64)
    return divide_space(seen, settings.cache_parts, radius, corners, pieces.position)


def patches(points: Points, bounds: RadiusBounds) -> Points:
    """One point on each patch of surface, for which some records will be made.

    Args:
        points: as returned by `points_of`.
        bounds: of the records' radius.
    """
    smallest, largest = bounds.at(points.position)
    radius = np.clip(points.longest, smallest, largest)
    return points.take(thin(points.position, points.normal, PATCH * radius))


def points_of(view: View, poses: Sequence[Pose], seed: int) -> Points:
    """Surface points that rays of some frames look up in the cache, and how near to them an obstacle stands.

    Args:
        view: its camera is moved.
        poses: of the frames.
        seed: of the rays.
    """
    rays = []
    for number, pose in enumerate(poses):
        view.camera.look(pose)
        sobol = qmc.Sobol(2, rng=np.random.default_rng(seed_of(seed, number)))
        _, ray = view.rays_through(draw(sobol, RAYS), seed_of(seed, number))
        rays.append(on_host(ray, RAYS))
    origin, direction = (upload(mi.Point3f, part) for part in np.concatenate(rays, axis=1))
    lanes = RAYS * len(poses)

    def all_rays() -> tuple[Samples, mi.Ray3f]:
        samples = samples_of(dr.opaque(mi.UInt32, seed), dr.arange(mi.UInt32, lanes), mi.UInt32(0))
        return samples, mi.Ray3f(origin, mi.Vector3f(direction))

    # The rays come from several cameras, so the trusted radius must not depend on one camera's resolution.
    beside = view.trust()._replace(detail=dr.opaque(mi.Float, 0.0))
    points, _ = view.missed(all_rays, None, lanes, beside)
    return points
