"""Tasks on the worker: pass files of the run directory to the renderer, and keep its output if complete."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from steadylight.animation.plan import SCENE_FILE, make_job
from steadylight.animation.provenance import RunRecord, read_run
from steadylight.atomic_file import Validator, atomic_write, storage_errors
from steadylight.engines import Task
from steadylight.errors import RunError, SceneError, SettingsError, StorageError
from steadylight.images import read_layers, validate_exr, write_exr, write_layers
from steadylight.renderers import find_renderer
from steadylight.renderers.base import (
    Box,
    Counts,
    Frame,
    PreparedRenderer,
    Renderer,
    SceneInspector,
    SceneRenderer,
    SurfaceRenderer,
)
from steadylight.scenes.archive import read_archive
from steadylight.settings import RenderSettings
from steadylight.storage import RunDirectory

Result = dict[str, Any]


def perform(task: Task, *, directory: str, threads: int | None) -> Mapping[str, Any]:
    """Do one task of a run, unless an earlier attempt that was believed lost has finished it.

    Args:
        task: from `plan.make_tasks`.
        directory: the run directory, as this worker sees it.
        threads: threads to use; all cores if None.

    Returns:
        Counts for `statistics.py`, and the task's seconds, not counting the loading of the scene.
    """
    place = _open(directory, threads)
    before = place.result_of(task)
    if before is not None:
        return before
    work = {"shade": _shade, "aovs": _aovs}.get(task.stage, _make_cache_file)
    scene = place.scene
    start = time.perf_counter()
    for file in place.paths(task.arguments["prepared"]):
        cast("PreparedRenderer", scene).use(file)
    counts = work(place, scene, task)
    result = {"seconds": time.perf_counter() - start, **counts}
    place.files.write_result(task.key, result, task.outputs)
    return result


class _Place:
    """A run directory as one worker process sees it, with the scene opened at most once."""

    def __init__(self, directory: str, record: Mapping[str, Any], threads: int | None) -> None:
        self.root = Path(directory)
        self.files = RunDirectory(self.root)
        self.run: RunRecord = read_run(self.files)
        self._renderer = find_renderer(self.run.settings.renderer)
        self._record = record
        self._threads = threads

    @cached_property
    def scene(self) -> SceneRenderer:
        """The scene of this run, opened by its renderer.

        Raises:
            SceneError: the scene file does not belong to this run.
        """
        # Safe to unpickle: our own file in the user's run directory, checked against the hash in run.json.
        scene = read_archive(self.root / SCENE_FILE)
        if scene.hash != self.run.scene_hash:
            raise SceneError(f"{self.root / SCENE_FILE}: does not belong to this run")
        run = self.run
        scene = replace(scene, camera=run.camera)
        job = make_job(scene, run.settings, run.variant, run.selected, run.survey)
        return self._renderer.open(job, self._threads)

    @cached_property
    def validators(self) -> dict[str, Validator]:
        """How each kind of output is read back and validated."""
        return validators_of(self._renderer, self.run.settings, self.run.scene_hash)

    def result_of(self, task: Task) -> Result | None:
        """The task's result if all its outputs exist and are valid, otherwise None.

        A task writes its result last, so on the first attempt this is a single check for a file.
        """
        if not (self.root / self.files.result_name(task.key)).exists():
            return None
        done, _ = self.files.is_done(task, self.validators)
        return self.files.read_result(task.key) if done else None

    def paths(self, names: list[str]) -> list[Path]:
        """Files of this run."""
        return [self.root / name for name in names]

    @contextmanager
    def output(self, name: str) -> Iterator[Path]:
        """A temporary path for an output of this run, renamed to it if the file is valid and the first one to finish.

        Raises:
            StorageError: the directory now belongs to another run. A worker believed dead may finish long after its
                run was abandoned and its folder reused.
        """
        with atomic_write(self.root / name, self.validators[Path(name).suffix], once=True) as temporary:
            yield temporary
            if _read_record(self.files) != self._record:
                raise StorageError(
                    f"{self.root}: now belongs to another run; the result of this task was discarded"
                )


def validators_of(renderer: Renderer, settings: RenderSettings, scene_hash: str) -> dict[str, Validator]:
    """How each kind of output is read back and validated, by suffix."""

    def made_by_renderer(path: Path) -> None:
        renderer.validate(path, scene_hash)

    def picture(path: Path) -> None:
        if path.parent.name == "aovs":
            read_layers(path, "Z", *(f"{name}.{axis}" for name in "NP" for axis in "XYZ"))
        else:
            validate_exr(path, settings.width, settings.height)

    return {
        ".exr": picture,
        renderer.capabilities.cache_suffix: made_by_renderer,
        renderer.capabilities.misses_suffix: made_by_renderer,
        renderer.capabilities.prepared_suffix: made_by_renderer,
    }


def open_scene(directory: Path) -> tuple[RunRecord, SceneRenderer]:
    """The scene of a run, opened by its renderer in this process.

    Raises:
        StorageError: there is no run.
        SceneError: the scene file does not belong to the run.
    """
    place = _open(str(directory), None)
    return place.run, place.scene


def _open(directory: str, threads: int | None) -> _Place:
    """Open the run directory; the scene of the previous task is reused if the run is the same.

    Raises:
        StorageError: the run does not exist on this machine.
    """
    if not RunDirectory(directory).run_file.exists():
        raise StorageError(
            f"{directory}: the machine {socket.gethostname()} finds no run there; all workers must see the run "
            "directory under the same path: choose an --output on a shared file system"
        )
    record = _read_record(RunDirectory(directory))
    return _place(directory, threads, json.dumps(record, sort_keys=True))


def _read_record(files: RunDirectory) -> dict[str, Any]:
    """The current content of `run.json`; on a worker, failure to read it is a storage error, not an input error."""
    try:
        return files.read_record()
    except SettingsError as error:
        raise StorageError(str(error)) from error


@lru_cache(maxsize=1)
def _place(directory: str, threads: int | None, record: str) -> _Place:
    # A worker may outlive a run and another run may reuse the directory, so the record is part of the key.
    return _Place(directory, json.loads(record), threads)


def _make_cache_file(place: _Place, scene: SceneRenderer, task: Task) -> Counts:
    """Do a task for which the renderer writes one file itself."""
    with place.output(task.outputs[0]) as temporary:
        return _CACHE_STAGES[task.stage](place, scene, task, temporary)


def _prepare(_place: _Place, scene: SceneRenderer, _task: Task, output: Path) -> Counts:
    return cast("PreparedRenderer", scene).prepare(output)


def _look(_place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    return cast("SurfaceRenderer", scene).look(task.arguments["frames"], output)


def _gather(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    if not task.arguments["frames"]:
        box = Box(task.arguments["part"], *task.arguments["box"])
        return cast("SurfaceRenderer", scene).gather_box(_by_window(place, task), box, output)
    (frame,) = task.arguments["frames"]
    return scene.gather(frame, output)


def _by_window(place: _Place, task: Task) -> dict[int, Path]:
    """The task's inputs by window: what was noted along the frames of each."""
    return dict(zip(task.arguments["windows"], place.paths(task.arguments["inputs"]), strict=True))


def _merge(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    return scene.merge(place.paths(task.arguments["inputs"]), task.arguments["part"], output)


def _audit(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    caches = place.paths(task.arguments["cache"])
    return scene.audit(task.arguments["frames"], caches, task.arguments["round"], output)


def _fill(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    (cache,) = place.paths(task.arguments["cache"])
    part, audit_round = task.arguments["part"], task.arguments["round"]
    return scene.fill(cache, _by_window(place, task), part, audit_round, output)


def _smooth(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    own, *around = place.paths(task.arguments["cache"])
    if task.arguments["windows"]:
        part = task.arguments["part"]
        renderer = cast("SurfaceRenderer", scene)
        return renderer.smooth_and_stretch(own, around, _by_window(place, task), part, output)
    return scene.smooth(own, around, output)


def _concatenate(place: _Place, scene: SceneRenderer, task: Task, output: Path) -> Counts:
    return scene.concatenate(place.paths(task.arguments["cache"]), output)


def _shade(place: _Place, scene: SceneRenderer, task: Task) -> Counts:
    """Render one frame (second pass, or the only pass)."""
    mode = place.run.settings.mode
    (frame,) = task.arguments["frames"]
    done = scene.trace(frame) if mode == "path" else scene.shade(frame, _caches(place, task))
    _refuse_nan(frame, done)
    with place.output(task.outputs[0]) as temporary:
        write_exr(temporary, done.image, {"frame": frame, "mode": mode})
    own = {} if done.seconds is None else {"seconds": done.seconds}
    counts = {"missed": done.missed, "new_records": done.new_records, "firefly_loss": done.firefly_loss}
    return {**counts, "black": int(not done.image.any()), **own}


def _aovs(place: _Place, scene: SceneRenderer, task: Task) -> Counts:
    """Write depth, normal and position of each pixel of a frame, under the names that compositing programs use."""
    (frame,) = task.arguments["frames"]
    seen = cast("SceneInspector", scene).surfaces(frame)  # the request checked this
    layers = {"Z": seen.depth}
    layers |= {f"N.{axis}": seen.normal[..., i] for i, axis in enumerate("XYZ")}
    layers |= {f"P.{axis}": seen.position[..., i] for i, axis in enumerate("XYZ")}
    with storage_errors(place.root / task.outputs[0]):
        (place.root / task.outputs[0]).parent.mkdir(exist_ok=True)
    with place.output(task.outputs[0]) as temporary:
        write_layers(temporary, layers)
    return {}


def _caches(place: _Place, task: Task) -> list[Path] | None:
    """The files of the shared cache that the frame reads; None if each frame has its own cache."""
    return place.paths(task.arguments["cache"]) if place.run.settings.mode == "two-pass" else None


def _refuse_nan(number: int, frame: Frame) -> None:
    """Raise RunError if a pixel is not finite: a single one would spoil video and metrics."""
    bad = int(np.count_nonzero(~np.isfinite(frame.image)))
    if bad:
        raise RunError(
            f"frame {number} contains {bad} values that are not finite. This is a bug in the renderer: please report "
            "it with the scene. Another --seed may avoid it"
        )


_CACHE_STAGES: dict[str, Callable[[_Place, SceneRenderer, Task, Path], Counts]] = {
    "prepare": _prepare,
    "look": _look,
    "gather": _gather,
    "merge": _merge,
    "audit": _audit,
    "fill": _fill,
    "smooth": _smooth,
    "concatenate": _concatenate,
}
