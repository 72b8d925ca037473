"""What a task does, on the worker: read its inputs from the run directory, light, write its outputs whole."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.animation.plan import AUDIT_ROUNDS, SCENE_FILE
from steadylight.animation.provenance import RunRecord, read_run
from steadylight.atomic_file import atomic_write
from steadylight.cache.file import CacheFile, encode_cache, encode_points, read_cache, read_points
from steadylight.cache.partition import concatenate_parts, merge_part, smooth_part
from steadylight.cache.records import Records
from steadylight.engines import Task
from steadylight.errors import RunError, SceneError, SettingsError, StorageError
from steadylight.images import validate_exr, write_exr
from steadylight.scenes.archive import read_archive
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from steadylight.renderers.mitsuba.records.lookup import DeviceCache, PartedCache
    from steadylight.renderers.mitsuba.renderer import Renderer
    from steadylight.settings import RenderSettings
    from steadylight.storage import Validator

Result = dict[str, Any]


def perform(task: Task, *, directory: str, threads: int | None) -> Mapping[str, Any]:
    """Do one task of a run, unless an attempt that was thought lost has done it.

    Args:
        task: from `plan.make_tasks`.
        directory: the run directory, as this worker sees it.
        threads: threads to use; all cores if None.

    Returns:
        What `statistics.py` sums up: counts, and the task's own seconds (loading the scene not included).
    """
    place = _open(directory, threads)
    before = place.result_of(task)
    if before is not None:
        return before
    result = _STAGES[task.stage](place, task)
    place.files.write_result(task.key, result, task.outputs)
    return result


class _Place:
    """A run directory as one worker process sees it, with the scene built at most once."""

    def __init__(self, directory: str, record: Mapping[str, Any], threads: int | None) -> None:
        self.root = Path(directory)
        self.files = RunDirectory(self.root)
        self.run: RunRecord = read_run(self.files)
        self._record = record
        self._threads = threads
        self._renderer: Renderer | None = None
        self._caches: dict[tuple[str, int], PartedCache] = {}

    @property
    def renderer(self) -> Renderer:
        """The renderer of this run's scene, built when first needed.

        Raises:
            SceneError: the scene file does not belong to this run.
        """
        if self._renderer is None:
            from steadylight.renderers.mitsuba.backend import use_variant

            use_variant(self.run.variant, threads=self._threads)
            from steadylight.renderers.mitsuba.renderer import Renderer

            # Our own file in the user's own run directory, and checked against the hash in run.json.
            scene = read_archive(self.root / SCENE_FILE)
            if scene.hash != self.run.scene_hash:
                raise SceneError(f"{self.root / SCENE_FILE}: does not belong to this run")
            settings = self.run.settings
            poses = self.run.camera.frame_poses(settings.frames, settings.fps)
            along = dict(zip(settings.frames, poses, strict=True))
            self._renderer = Renderer(scene, along, settings, self.run.partition)
        return self._renderer

    def result_of(self, task: Task) -> Result | None:
        """What the task returned, if all it writes is there and valid; None while there is something to do.

        The result is the last file that a task writes, so on the first attempt this is one look at the disk.
        """
        if not (self.root / self.files.result_name(task.key)).exists():
            return None
        done, _ = self.files.is_done(task, validators_of(self.run.settings, self.run.scene_hash))
        return self.files.read_result(task.key) if done else None

    def records(self, name: str) -> Records:
        """The records of a cache file of this run."""
        return read_cache(self.root / name, scene_hash=self.run.scene_hash).records

    def device_cache(self, task: Task) -> DeviceCache:
        """The cache that a task reads, on the device.

        What tasks of the same pass before have loaded is kept beside it, since those that follow read much the same;
        but only what this task names can answer.
        """
        renderer = self.renderer  # sets the variant, which the cache needs
        names, of = task.arguments["cache"], (task.stage, task.arguments["round"])
        cache = self._caches.get(of)
        lacking = [name for name in names if cache is None or name not in cache.names]
        if cache is None or lacking:
            if self.run.partition.count == 1:
                self._caches.clear()  # nobody looks at an earlier round again
            parts = {name: self.records(name) for name in lacking}
            cache = renderer.load(parts) if cache is None else cache.with_parts(parts)
            self._caches[of] = cache
        cache.show(names)
        return cache

    def write_cache(self, name: str, records: Records) -> None:
        """Write a cache file of this run."""
        _refuse_nan(f"{name}: records", *(getattr(records, field) for field in Records.SHAPES))
        with self.output(name) as temporary:
            temporary.write_bytes(encode_cache(CacheFile(records, self.run.scene_hash, {})))

    def write_points(self, name: str, position: Any, normal: Any, longest: Any) -> None:
        """Write a file of points that wait for a record."""
        with self.output(name) as temporary:
            temporary.write_bytes(encode_points(position, normal, longest, self.run.scene_hash))

    @contextmanager
    def output(self, name: str) -> Iterator[Path]:
        """A path to write an output of this run to, which becomes the output if it is whole and the first.

        Raises:
            StorageError: another run has taken the directory meanwhile. A worker that was believed dead may finish
                long after its run was given up and its folder used again.
        """
        if _read_record(self.files) != self._record:
            raise StorageError(f"{self.root}: is of another run now; what was made for this one is dropped")
        check = validators_of(self.run.settings, self.run.scene_hash)[Path(name).suffix]
        with atomic_write(self.root / name, check, once=True) as temporary:
            yield temporary


def validators_of(settings: RenderSettings, scene_hash: str) -> dict[str, Validator]:
    """How each kind of output is read back to see whether it is whole."""
    return {
        ".exr": lambda path: validate_exr(path, settings.width, settings.height),
        ".safetensors": lambda path: read_cache(path, scene_hash=scene_hash),
        ".points": lambda path: read_points(path, scene_hash=scene_hash),
    }


def _open(directory: str, threads: int | None) -> _Place:
    """The run directory; what was built for the task before is kept while it is the same run.

    Raises:
        StorageError: this machine does not see it.
    """
    if not RunDirectory(directory).run_file.exists():
        raise StorageError(
            f"{directory}: the machine {socket.gethostname()} sees no run there; all workers must see the run "
            "directory under the same path: choose an --output on a file system that they share"
        )
    record = _read_record(RunDirectory(directory))
    return _place(directory, threads, json.dumps(record, sort_keys=True))


def _read_record(files: RunDirectory) -> dict[str, Any]:
    """What `run.json` says now; on a worker, not to be able to read it is no fault of what the user asked for."""
    try:
        return files.read_record()
    except SettingsError as error:
        raise StorageError(str(error)) from error


@lru_cache(maxsize=1)
def _place(directory: str, threads: int | None, record: str) -> _Place:
    # A worker outlives a run, and another run may take its directory: its record is part of the key.
    return _Place(directory, json.loads(record), threads)


def _gather(place: _Place, task: Task) -> Result:
    """First pass: one selected frame."""
    renderer = place.renderer
    start = time.perf_counter()
    (frame,) = task.arguments["frames"]
    # Without the audit nobody would fill what frames leave to each other: each works alone then, as published.
    shared = place.run.selected if place.run.settings.coverage == "full" else ()
    done = renderer.first_pass(frame, shared)
    place.write_cache(task.outputs[0], done.records)
    return {
        "rays": done.rays,
        "hits": done.hits,
        "misses": done.misses,
        "left": done.left,
        "records": len(done.records),
        "seconds": time.perf_counter() - start,
    }


def _merge(place: _Place, task: Task) -> Result:
    """First-pass caches become one, or a part of it."""
    start = time.perf_counter()
    partition, part = place.run.partition, task.arguments["part"]
    caches = [place.records(name) for name in task.arguments["inputs"]]
    merged = merge_part(caches, partition, part)
    place.write_cache(task.outputs[0], merged)
    own = (np.count_nonzero(partition.part_of(cache.position) == part) for cache in caches)
    return {
        "records_in": int(sum(own)),
        "records_out": len(merged),
        "seconds": time.perf_counter() - start,
    }


def _audit(place: _Place, task: Task) -> Result:
    """Look along some frames for what the cache cannot answer."""
    cache = place.device_cache(task)
    start = time.perf_counter()
    found = place.renderer.audit(
        task.arguments["frames"], cache, last=task.arguments["round"] == AUDIT_ROUNDS
    )
    place.write_points(task.outputs[0], *found.points)
    return {"looked_up": found.looked_up, "missed": found.missed, "seconds": time.perf_counter() - start}


def _cover(place: _Place, task: Task) -> Result:
    """Make records in a part wherever the audits of a round missed."""
    renderer, partition, part = place.renderer, place.run.partition, task.arguments["part"]
    start = time.perf_counter()
    (name,) = task.arguments["cache"]
    before = place.records(name)
    found = []
    for window, name in zip(task.arguments["windows"], task.arguments["inputs"], strict=True):
        points = read_points(place.root / name, scene_hash=place.run.scene_hash)
        own = partition.owner_of(points[0], partition.windows[window]) == part
        found.append((points[0][own], points[1][own], points[2][own]))
    after = renderer.cover(found, before, task.arguments["round"], part)
    place.write_cache(task.outputs[0], after)
    return {"records": len(after) - len(before), "seconds": time.perf_counter() - start}


def _finish(place: _Place, task: Task) -> Result:
    """A part of the cache as the second pass reads it."""
    start = time.perf_counter()
    own, *around = map(place.records, task.arguments["cache"])
    place.write_cache(task.outputs[0], smooth_part(own, around))
    return {"seconds": time.perf_counter() - start}


def _join(place: _Place, task: Task) -> Result:
    """The parts of the merged cache in one file."""
    start = time.perf_counter()
    place.write_cache(
        task.outputs[0], concatenate_parts([place.records(name) for name in task.arguments["cache"]])
    )
    return {"seconds": time.perf_counter() - start}


def _shade(place: _Place, task: Task) -> Result:
    """Second pass (or the only pass): one frame."""
    renderer, settings = place.renderer, place.run.settings
    cache = place.device_cache(task) if settings.mode == "two-pass" else None
    start = time.perf_counter()
    (frame,) = task.arguments["frames"]
    done = renderer.path(frame) if settings.mode == "path" else renderer.shade(frame, cache)
    _refuse_nan(f"frame {frame}: pixels", *done.image)
    about = {"frame": frame, "scene": place.run.scene_name, "mode": settings.mode}
    with place.output(task.outputs[0]) as temporary:
        write_exr(temporary, done.image, about)
    return {
        "missed": done.missed,
        "new_records": done.new_records,
        "seconds": time.perf_counter() - start,
    }


def _refuse_nan(what: str, *arrays: NDArray[np.floating[Any]]) -> None:
    """Raise RunError if numbers are not finite: one such record or pixel would spoil all that use it."""
    bad = sum(int(np.count_nonzero(~np.isfinite(array))) for array in arrays)
    if bad:
        raise RunError(
            f"{what} came out with {bad} numbers that are not finite, which is a fault of the renderer: please "
            "report it together with the scene; another --seed may get past it"
        )


_STAGES = {
    "gather": _gather,
    "merge": _merge,
    "audit": _audit,
    "cover": _cover,
    "finish": _finish,
    "shade": _shade,
    "join": _join,
}
