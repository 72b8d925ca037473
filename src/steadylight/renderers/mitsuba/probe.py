"""Prediction of a run's time from a few seconds of tracing.

It depends mainly on the time of a path in this scene on this machine, and on the number of records that the film needs,
which are dense where surfaces are small and near. Both differ tenfold between an empty room and a furnished one.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import mitsuba as mi

from steadylight.camera import Pose
from steadylight.renderers.mitsuba.image.path_tracing import path_traced
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling
from steadylight.renderers.mitsuba.quality import quality_of
from steadylight.renderers.mitsuba.records.filling import Points, RadiusBounds
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
from steadylight.renderers.mitsuba.survey import patches, points_of
from steadylight.renderers.mitsuba.view import View, diagonal
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

LOOKS, TIMED = 32, 4
"""Maximum number of frames, spread over the film, that are searched for surfaces, and in which paths are timed."""

SIZE, SPP = (64, 36), 64
"""Picture in which paths are timed; one untimed picture comes first, to compile the kernels."""

RECORDS_ON_PATCH = 6.0
"""Records per patch of the survey: 4.5 to 10 in six films (docs/performance.md)."""

OF_A_RECORD, OF_A_SAMPLE = 2.2, 0.6
"""Costs, in camera paths of a path tracer, from the same films: of each path that a record takes at least, with
everything else in making the cache; and of a camera sample of the second pass, audit and denoising included."""


def probed_seconds(description: SceneDescription, poses: Sequence[Pose], settings: RenderSettings) -> float:
    """Processor time of all rays of a run, seconds, without start-up and writing frames.

    Args:
        description: the scene.
        poses: camera pose of each frame.
        settings: of the animation.
    """
    scene = build_scene(description)
    samples = settings.width * settings.height * settings.spp * len(poses)
    of_path = _seconds_of_path(scene, description, _spread(poses, TIMED))
    if settings.mode == "path":
        return of_path * samples
    paths = OF_A_RECORD * quality_of(settings).records.paths_per_record[0]
    return of_path * (OF_A_SAMPLE * samples + paths * expected_records(scene, description, poses, settings))


def expected_records(
    scene: mi.Scene, description: SceneDescription, poses: Sequence[Pose], settings: RenderSettings
) -> float:
    """Approximate number of records that a run will make.

    Args:
        scene: built from `description`.
        description: the scene.
        poses: camera pose of each frame.
        settings: of the animation.
    """
    if settings.bounces == 0:
        return 0.0
    quality, size = quality_of(settings), (settings.width, settings.height)
    view = View(scene, Camera(build_sensor(description, poses[0], *size), size), settings.depth, quality)
    if settings.first_pass == "surface":
        view.ask_by_worth(settings.bounces)
    bounds = RadiusBounds(poses, settings.width, diagonal(scene), quality.records)
    looks = enumerate(_spread(poses, LOOKS))
    each = [patches(points_of(view, [pose], number), bounds) for number, pose in looks]
    if settings.mode == "single-pass":  # each frame makes its own records
        count = sum(len(some.position) for some in each) / len(each) * len(poses)
    else:
        count = len(patches(Points.concatenate(each), bounds).position)
    return RECORDS_ON_PATCH * count


def _spread(poses: Sequence[Pose], count: int) -> list[Pose]:
    """At most `count` of the poses, evenly spread."""
    count = min(count, len(poses))
    return [poses[(2 * k + 1) * len(poses) // (2 * count)] for k in range(count)]


def _seconds_of_path(scene: mi.Scene, description: SceneDescription, poses: Sequence[Pose]) -> float:
    """Processor time per camera path of Mitsuba's path tracer with all bounces."""
    camera = Camera(build_sensor(description, poses[0], *SIZE), SIZE)
    integrator = mi.load_dict({"type": "path", "max_depth": -1})
    path_traced(scene, camera, integrator, Sampling(SPP, 0))
    began = time.process_time()
    for number, pose in enumerate(poses):
        camera.look(pose)
        path_traced(scene, camera, integrator, Sampling(SPP, number))
    return (time.process_time() - began) / (SIZE[0] * SIZE[1] * SPP * len(poses))
