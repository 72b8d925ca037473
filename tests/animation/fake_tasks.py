"""A renderer that makes no light, and tasks that write real files with it: what the run needs to be tested with."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path

import numpy as np

from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CacheFileError
from steadylight.images import write_exr
from steadylight.renderers.base import Backend, Capabilities, Frame, Survey
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

CAN = Capabilities(
    scenes=("mitsuba",),
    modes=("two-pass", "single-pass", "path"),
    audit_rounds=2,
    surfaces=True,
    prepares=True,
    parts=True,
    smoothing=True,
    denoising=True,
)

RESULTS = {
    "prepare": {"seconds": 0.1},
    "look": {"rays": 256, "seconds": 0.1},
    "gather": {"rays": 256, "hits": 200, "misses": 20, "records": 20, "seconds": 0.1, "seconds_cpu": 0.2},
    "merge": {"records_in": 60, "records_out": 50, "seconds": 0.1},
    "audit": {"looked_up": 1000, "missed": 3, "seconds": 0.1},
    "fill": {"records": 4, "seconds": 0.1},
    "smooth": {"seconds": 0.1},
    "concatenate": {"seconds": 0.1},
    "shade": {"seconds": 0.25, "missed": 1, "new_records": 2, "firefly_loss": 0.25},
}


@dataclasses.dataclass
class FakeRenderer:
    """Stands in for the renderer of a request; its cache files name their scene and nothing else."""

    variant: str = "llvm_ad_rgb"
    versions: dict[str, str] = dataclasses.field(default_factory=lambda: {"lamp": "1.0"})
    constants: dict[str, float] = dataclasses.field(default_factory=lambda: {"accuracy": 0.1})
    fault: Exception | None = None
    name = "mitsuba"
    capabilities = CAN
    cache_files = None

    def __post_init__(self):
        self.surveys = []
        self.built = []

    def check(self, scene, settings, variant, *, build):
        self.built.append(build)
        if self.fault is not None:
            raise self.fault
        return Backend(self.variant, self.versions, self.constants)

    def survey(self, job):
        """Parts in a row, of which every window sees the first two."""
        self.surveys.append(job)
        parts = job.settings.cache_parts
        neighbours = tuple(tuple(n for n in (part - 1, part + 1) if 0 <= n < parts) for part in range(parts))
        return Survey(((0, 1),) * len(job.windows), neighbours, {"planes": parts - 1})

    def validate(self, path, scene_hash):
        try:
            found = json.loads(path.read_text())["scene"]
        except (ValueError, KeyError) as error:
            raise CacheFileError("cut short") from error
        if found != scene_hash:
            raise CacheFileError("made for another scene")

    def open(self, job, threads):
        return FakeScene(job)


class FakeScene:
    """Counts like `RESULTS`; a subclass may do worse."""

    def __init__(self, job):
        self.job = job

    def _write(self, stage, output):
        output.write_text(json.dumps({"scene": self.job.scene.hash, "stage": stage}))
        return RESULTS[stage]

    def prepare(self, output):
        return self._write("prepare", output)

    def use(self, prepared):
        self.prepared = prepared

    def look(self, frames, output):
        return self._write("look", output)

    def gather_box(self, seen, box, output):
        return self._write("gather", output)

    def gather(self, frame, output):
        return self._write("gather", output)

    def merge(self, caches, part, output):
        return self._write("merge", output)

    def audit(self, frames, caches, audit_round, output):
        return self._write("audit", output)

    def fill(self, cache, misses, part, audit_round, output):
        return self._write("fill", output)

    def smooth(self, cache, around, output):
        return self._write("smooth", output)

    def smooth_and_stretch(self, cache, around, misses, part, output):
        return self._write("smooth", output)

    def concatenate(self, caches, output):
        return self._write("concatenate", output)

    def shade(self, frame, caches):
        return Frame(np.full((8, 16, 3), 0.1 * frame, np.float32), 1, 2, 0.25)

    def trace(self, frame):
        return self.shade(frame, None)


def perform(task, *, directory, scene_hash=SCENE.hash, failing=()):
    """What the tasks of a renderer do, with made-up light."""
    if task.key in failing:
        raise RuntimeError("no light today")
    run = RunDirectory(directory)
    for name in (*task.arguments["cache"], *task.arguments["inputs"]):
        assert (run.root / name).is_file(), f"{task.key} reads {name} too early"
    path = run.root / task.outputs[0]
    if path.suffix == ".exr":
        frame = task.arguments["frames"][0]
        write_exr(path, np.full((8, 16, 3), 0.1 * frame, np.float32))
    else:
        path.write_text(json.dumps({"scene": scene_hash, "task": task.key}))
    run.write_result(task.key, RESULTS[task.stage])
    return RESULTS[task.stage]


def prepared(scene=SCENE, *, renderer=None, **options):
    """A request of the fake renderer."""
    return dataclasses.replace(prepare(scene, **options), renderer=renderer or FakeRenderer())


def session(directory, *, scene=SCENE, failing=(), renderer=None, **options):
    """A session of the fake renderer."""
    request = prepared(scene, renderer=renderer, output=directory, cluster="in-process", **options)
    work = partial(perform, directory=directory, scene_hash=scene.hash, failing=failing)
    return Session(request, perform=work)


def rendered(directory, **options):
    """The finished run."""
    with session(directory, **options) as opened:
        for _ in opened:
            pass
        return opened.finish()


def names(directory):
    """Every file below a folder."""
    return {path.relative_to(directory).as_posix() for path in Path(directory).rglob("*") if path.is_file()}
