"""Tasks that write real files without a renderer: what the run needs to be tested with."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.cache.file import CacheFile, encode_cache, encode_points
from steadylight.cache.partition import divide_space
from steadylight.cache.records import Records
from steadylight.camera import CameraPath, Keyframe
from steadylight.images import write_exr
from steadylight.scenes.description import SceneDescription
from steadylight.storage import RunDirectory

SCENE = SceneDescription(
    name="plain",
    content={},
    camera=CameraPath((Keyframe(0.0, (0, 0, 0), (1, 0, 0)), Keyframe(1.0, (1, 0, 0), (2, 1, 0)))),
    width=16,
    height=8,
    frames=9,
)

RESULTS = {
    "gather": {"rays": 256, "hits": 200, "misses": 20, "records": 20, "seconds": 0.1, "seconds_cpu": 0.2},
    "merge": {"records_in": 60, "records_out": 50, "seconds": 0.1},
    "audit": {"looked_up": 1000, "missed": 3, "seconds": 0.1},
    "cover": {"records": 4, "seconds": 0.1},
    "finish": {"seconds": 0.1},
    "join": {"seconds": 0.1},
    "shade": {"seconds": 0.25, "missed": 1, "new_records": 2},
}


def perform(task, *, directory, scene_hash=SCENE.hash, failing=()):
    """What the renderer's tasks do, with made-up light."""
    if task.key in failing:
        raise RuntimeError("no light today")
    run = RunDirectory(directory)
    for name in (*task.arguments["cache"], *task.arguments["inputs"]):
        assert (run.root / name).is_file(), f"{task.key} reads {name} too early"
    path = run.root / task.outputs[0]
    if path.suffix == ".exr":
        frame = task.arguments["frames"][0]
        write_exr(path, np.full((8, 16, 3), 0.1 * frame, np.float32))
    elif path.suffix == ".points":
        path.write_bytes(encode_points(*np.zeros((2, 0, 3), np.float32), np.zeros(0, np.float32), scene_hash))
    else:
        path.write_bytes(encode_cache(CacheFile(Records.empty(), scene_hash, {"task": task.key})))
    run.write_result(task.key, RESULTS[task.stage])
    return RESULTS[task.stage]


def survey(request):
    """Parts in a row, of which every window sees the first two."""
    corners = np.float32([[x, 0, 0] for x in range(20)])
    windows = [corners[: 20 if number else 9] for number in range(-(-len(request.settings.frames) // 8))]
    box = np.array([[0.0, 0, 0], [20, 1, 1]])
    return divide_space([corners, *windows][1:], request.settings.cache_parts, 0.5, box)


def session(directory, *, scene=SCENE, failing=(), variant="llvm_ad_rgb", survey=survey, **options):
    """A session of the fake renderer."""
    request = prepare(scene, output=directory, cluster="in-process", **options)
    request = dataclasses.replace(request, survey=survey)
    work = partial(perform, directory=directory, scene_hash=scene.hash, failing=failing)
    return Session(request, perform=work, check=lambda _: variant)


def rendered(directory, **options):
    """The finished run."""
    with session(directory, **options) as opened:
        for _ in opened:
            pass
        return opened.finish()


def names(directory):
    """Every file below a folder."""
    return {path.relative_to(directory).as_posix() for path in Path(directory).rglob("*") if path.is_file()}
