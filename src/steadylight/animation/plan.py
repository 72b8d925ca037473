"""The two passes as data: turns settings into tasks with dependencies and files; imports no renderer.

With `--first-pass surface`:

```
look-0001 ┐                        ┌ audit-1-0001 ┐                 ┌ shade-00001
look-0002 ┼─ gather-000 ┐          ┼ audit-1-0002 ┼─ fill-1 ─ smooth ┼ shade-00002
...       │             ├─ merge ─ ┼ ...          ┘                 └ ...
prepare   ┴─ gather-001 ┘
```

With `--first-pass frames`, as published, and the audit which is ours:

```
gather-00012 ─┐         ┌ audit-1-0001 ┐          ┌ audit-2-0001 ┐                  ┌ shade-00001
gather-00031 ─┼─ merge ─┼ audit-1-0002 ┼─ fill-1 ─┼ audit-2-0002 ┼─ fill-2 ─ smooth ┼ shade-00002
gather-00057 ─┘         └ ...          ┘          └ ...          ┘                  └ ...
```

The stages of a run depend on the renderer's capabilities (`renderers.base.Capabilities`) and on the settings. With
`--coverage off`, the second pass directly follows the merge. Modes without a shared cache only have tasks of the second
pass.

A cache in parts (`renderers.base.Survey`) has a merge, a fill and a smooth task for each part and round. Each of them,
and each audit and frame, waits only for the parts that it reads: there is no barrier between the passes. A task reads
exactly the files listed here, so its output does not depend on when it starts.

Nothing here depends on the number of workers: the same settings always give the same tasks, so that the output does not
depend on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

from steadylight.engines import Task
from steadylight.errors import SettingsError
from steadylight.renderers.base import Capabilities, Job, Survey
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings
from steadylight.storage import RunDirectory

STAGES: Final = (
    "prepare",
    "look",
    "gather",
    "merge",
    "audit",
    "fill",
    "smooth",
    "shade",
    "aovs",
    "concatenate",
)
"""All stages of tasks, in the order of the method."""

FRAMES_PER_WINDOW: Final = 8
"""Frames per window, which one task audits: fixed, so that records do not depend on the number of workers."""

FEWEST_FRAMES_IN_PARTS: Final = 400
FRAMES_PER_PART: Final = 20
MOST_PARTS: Final = 64
"""Defaults for splitting the cache: minimum length of the animation, minimum frames per part, maximum number of parts.
Filling or smoothing a part is one task, for which others wait."""

PIXELS_PER_BOX: Final = 1 << 20
MOST_BOXES: Final = 64
"""Pixels of the whole animation to a box of space whose records one task makes, with a cache in one part, and maximum
number of boxes. Four boxes instead of one made 2 % more records (gallery); fewer boxes are fewer tasks at once."""

SCENE_FILE: Final = "scene.zip"
"""The scene for the workers, relative to the run directory."""


def selected_count(frames: int, choice: int | Literal["auto", "workers"], workers: int) -> int:
    """Number of first-pass frames.

    Args:
        frames: number of frames of the animation.
        choice: a number; `workers` for the paper's rule (one frame per worker); `auto` for the square root of the
            number of frames, rounded up, which does not depend on the machine.
        workers: number of workers at the start.

    Returns:
        At least 1, at most `frames`.

    Raises:
        SettingsError: `choice` is none of these.
    """
    if choice == "auto":
        return math.ceil(math.sqrt(frames))
    if choice == "workers":
        return min(max(workers, 1), frames)
    if isinstance(choice, bool) or not isinstance(choice, int) or choice < 1:
        raise SettingsError(
            f"--selected-frames: {choice!r} is not valid; give auto, workers or a positive whole number"
        )
    return min(choice, frames)


def part_count(frames: int, choice: int | Literal["auto"], *, shared: bool) -> int:
    """Number of parts of the shared cache.

    Args:
        frames: number of frames of the animation.
        choice: a number, or `auto`: 1 for short animations, otherwise the largest power of two with at least
            FRAMES_PER_PART frames per part. It depends only on the animation, so that the output does not depend on
            the machine.
        shared: whether a cache in parts is possible: it must be shared by all frames, and no frame may add records.

    Raises:
        SettingsError: several parts are requested but not possible.
    """
    if choice == "auto":
        few = frames < FEWEST_FRAMES_IN_PARTS or not shared
        return 1 if few else min(MOST_PARTS, 1 << int(math.log2(frames / FRAMES_PER_PART)))
    if choice > 1 and not shared:
        raise SettingsError(
            f"--cache-parts: {choice} needs --mode two-pass, --coverage full and a renderer that supports parts; "
            "give auto or 1"
        )
    return choice


def files_read(task: Task) -> tuple[str, ...]:
    """Files that a task reads, besides the scene, relative to the run directory."""
    return tuple(name for kind in ("cache", "inputs", "prepared") for name in task.arguments.get(kind, ()))


def windows_of(frames: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """The frames grouped into windows that are audited together."""
    return tuple(
        tuple(frames[first : first + FRAMES_PER_WINDOW]) for first in range(0, len(frames), FRAMES_PER_WINDOW)
    )


def make_job(
    scene: SceneDescription,
    settings: RenderSettings,
    variant: str,
    selected: Sequence[int],
    survey: Survey | None = None,
) -> Job:
    """What a renderer needs to know about a run.

    Args:
        scene: with the camera path that the frames follow.
        settings: of the run.
        variant: name of the renderer's backend.
        selected: numbers of the first-pass frames.
        survey: the parts of the cache; one part if None.
    """
    windows = windows_of(settings.frames)
    poses = scene.camera.frame_poses(settings.frames, settings.fps)
    return Job(
        scene=scene,
        settings=settings,
        variant=variant,
        poses=dict(zip(settings.frames, poses, strict=True)),
        windows=windows,
        selected=tuple(selected),
        survey=survey or Survey.undivided(len(windows)),
    )


def audit_rounds(settings: RenderSettings, can: Capabilities) -> int:
    """Number of audit rounds, each of which checks all frames for points that the cache does not cover."""
    if settings.first_pass == "surface":
        return 1
    return can.audit_rounds if settings.mode == "two-pass" and settings.coverage == "full" else 0


def make_tasks(
    settings: RenderSettings,
    selected: Sequence[int],
    can: Capabilities,
    survey: Survey | None = None,
    *,
    aovs: bool = False,
) -> tuple[Task, ...]:
    """All tasks of a run, each after the tasks that it needs.

    The arguments of every task have the same keys: `frames` (frame numbers), `cache` (the files of the cache that
    it reads, relative to the run directory), `inputs` (further files that it reads), `windows` (from 0: that of each
    input of a fill, a smooth or a gather of a box), `prepared` (what `prepare` wrote, in a list, if it reads that),
    `round` (of the audit, else 0), `part` (of the cache, else 0) and `box` (number and count of boxes in the part, for
    a gather of one). The last output of every task is its result file.

    Args:
        settings: of the run.
        selected: numbers of the first-pass frames, ascending; ignored in modes without a shared cache.
        can: what the renderer can do.
        survey: the parts of the cache; one part if None.
        aovs: whether depth, normal and position of each pixel are written, too.
    """
    seen = [
        _task("aovs", f"{n:05d}", _Files(frames=(n,)), RunDirectory.aovs_name(n))
        for n in (settings.frames if aovs else ())
    ]
    if settings.mode != "two-pass":
        shades = [_task("shade", f"{n:05d}", _Files(frames=(n,)), _frame(n)) for n in settings.frames]
        return (*shades, *seen)
    windows = windows_of(settings.frames)
    shared = _Shared(survey or Survey.undivided(len(windows)), windows, can)
    tasks = shared.prepares()
    if settings.first_pass == "surface":
        boxes = _boxes(settings)
        tasks += shared.looks() + shared.boxes(boxes) + shared.merges_of_boxes(boxes)
    else:
        tasks += shared.gathers(selected) + shared.merges(selected)
    state = _State("merged", "merge")
    rounds = audit_rounds(settings, can)
    for audit_round in range(1, rounds + 1):
        tasks += shared.audits(audit_round, state)
        tasks += shared.fills(audit_round, state)
        state = _State(f"filled_{audit_round}", f"fill-{audit_round}")
    # Without an audit, frames add their own records, and smoothing happens with those.
    if can.smoothing and (rounds or not can.audit_rounds):
        tasks += shared.smooths(state, rounds if settings.first_pass == "surface" else 0)
        state = _State("smoothed", "smooth")
    return (*tasks, *shared.shades(state), *seen, *shared.concatenate())


def _boxes(settings: RenderSettings) -> int:
    """Boxes of space in each part of the cache, whose records are made by a task each."""
    if settings.cache_parts > 1:
        return 1
    pixels = len(settings.frames) * settings.width * settings.height
    return min(MOST_BOXES, math.ceil(pixels / PIXELS_PER_BOX))


class _State(NamedTuple):
    """State of the cache: the stem of its files, and of the tasks that wrote them."""

    file: str
    task: str


@dataclass(frozen=True)
class _Files:
    """What a task reads; see `make_tasks`."""

    frames: Sequence[int] = ()
    cache: Sequence[str] = ()
    inputs: Sequence[str] = ()
    windows: Sequence[int] = ()
    needs: tuple[str, ...] = ()
    prepared: Sequence[str] = ()
    box: tuple[int, int] = (0, 0)


class _Shared:
    """Makes the tasks that read or write the shared cache."""

    def __init__(self, survey: Survey, windows: Sequence[Sequence[int]], can: Capabilities) -> None:
        self._survey = survey
        self._parts = range(survey.parts)
        self._windows = windows
        self._can = can

    def prepares(self) -> list[Task]:
        """What makes records is made ready, if it needs that."""
        return [_task("prepare", "", _Files(), file) for file in self._prepared]

    def looks(self) -> list[Task]:
        """A task for each window of frames, which finds what it looks up."""
        return [
            _task("look", f"{number + 1:04d}", _Files(frames=frames), self._misses(0, number))
            for number, frames in enumerate(self._windows)
        ]

    def boxes(self, count: int) -> list[Task]:
        """A task for each box of each part, which reads what was seen by the windows that see the part."""
        tasks = []
        for part in self._parts:
            windows = [n for n, seen in enumerate(self._survey.windows) if part in seen]
            reads = _Files(
                inputs=[self._misses(0, n) for n in windows],
                windows=windows,
                needs=tuple(f"look-{n + 1:04d}" for n in windows),
            )
            for box in range(count):
                given = self._making(replace(reads, box=(box, count)))
                name = part * count + box
                tasks.append(_task("gather", f"{name:03d}", given, self._gathered_box(name), part=part))
        return tasks

    def merges_of_boxes(self, count: int) -> list[Task]:
        """Merge each part from its boxes and those of its neighbours, whose records may replace its own."""
        tasks = []
        for part in self._parts:
            near = sorted({part, *self._survey.neighbours[part]})
            names = [other * count + box for other in near for box in range(count)]
            reads = _Files(
                inputs=[self._gathered_box(name) for name in names],
                needs=tuple(f"gather-{name:03d}" for name in names),
            )
            tasks.append(self._of_part(_State("merged", "merge"), part, reads))
        return tasks

    def gathers(self, selected: Sequence[int]) -> list[Task]:
        """A task for each selected frame."""
        return [
            _task("gather", f"{n:05d}", self._making(_Files(frames=(n,))), self._gathered(n))
            for n in selected
        ]

    def merges(self, selected: Sequence[int]) -> list[Task]:
        """Merge each part from the selected frames that see it or its neighbours, whose records may replace its own."""
        window_of = {frame: number for number, frames in enumerate(self._windows) for frame in frames}
        tasks = []
        for part in self._parts:
            near = {part, *self._survey.neighbours[part]}
            frames = [n for n in selected if near.intersection(self._survey.windows[window_of[n]])]
            reads = _Files(
                inputs=[self._gathered(n) for n in frames], needs=tuple(f"gather-{n:05d}" for n in frames)
            )
            tasks.append(self._of_part(_State("merged", "merge"), part, reads))
        return tasks

    def audits(self, audit_round: int, state: _State) -> list[Task]:
        """A task for each window of frames, which finds what the parts that it sees do not cover."""
        return [
            _task(
                "audit",
                f"{audit_round}-{number + 1:04d}",
                replace(self._reading(state, self._survey.windows[number]), frames=frames),
                self._misses(audit_round, number),
                audit_round=audit_round,
            )
            for number, frames in enumerate(self._windows)
        ]

    def fills(self, audit_round: int, state: _State) -> list[Task]:
        """Fill each part with the misses of the windows that see it."""
        tasks = []
        filled = _State(f"filled_{audit_round}", f"fill-{audit_round}")
        for part in self._parts:
            reads = self._with_misses(self._reading(state, [part]), audit_round, part)
            tasks.append(self._of_part(filled, part, self._making(reads), audit_round))
        return tasks

    def smooths(self, state: _State, audit_round: int) -> list[Task]:
        """Smooth each part with its neighbours; the part itself is the first file that its task reads.

        With a round of the audit, what it missed and no record answers since is answered by records further off.
        """
        smoothed = _State("smoothed", "smooth")
        tasks = []
        for part in self._parts:
            reads = self._reading(state, [part, *self._survey.neighbours[part]])
            if audit_round:
                reads = self._with_misses(reads, audit_round, part)
            tasks.append(self._of_part(smoothed, part, reads))
        return tasks

    def _with_misses(self, reads: _Files, audit_round: int, part: int) -> _Files:
        """With what a round of the audit missed in the windows that see a part."""
        windows = [n for n, seen in enumerate(self._survey.windows) if part in seen]
        return replace(
            reads,
            inputs=[self._misses(audit_round, n) for n in windows],
            windows=windows,
            needs=(*reads.needs, *(f"audit-{audit_round}-{n + 1:04d}" for n in windows)),
        )

    @property
    def _prepared(self) -> list[str]:
        """What `prepare` writes."""
        suffix = self._can.prepared_suffix
        return [RunDirectory.cache_name(f"prepared{suffix}")] if self._can.prepares else []

    def _making(self, reads: _Files) -> _Files:
        """Of a task that makes records."""
        needs = tuple("prepare" for _ in self._prepared)
        return replace(reads, prepared=self._prepared, needs=(*needs, *reads.needs))

    def shades(self, state: _State) -> list[Task]:
        """A task for each frame, which reads the parts that its window sees."""
        return [
            _task("shade", f"{n:05d}", replace(self._reading(state, seen), frames=(n,)), _frame(n))
            for frames, seen in zip(self._windows, self._survey.windows, strict=True)
            for n in frames
        ]

    def concatenate(self) -> list[Task]:
        """The merged cache as one file for inspection; no task waits for it."""
        if len(self._parts) == 1:
            return []
        reads = self._reading(_State("merged", "merge"), self._parts)
        return [_task("concatenate", "", reads, self._cache("merged"))]

    def _reading(self, state: _State, parts: Sequence[int]) -> _Files:
        """The inputs of a task that reads the given parts."""
        return _Files(
            cache=[self._part_file(state, part) for part in parts],
            needs=tuple(self._key(state, part) for part in parts),
        )

    def _of_part(self, state: _State, part: int, reads: _Files, audit_round: int = 0) -> Task:
        """The task that writes a part of the cache in a given state."""
        stage, _, number = self._key(state, part).partition("-")
        return _task(stage, number, reads, self._part_file(state, part), audit_round=audit_round, part=part)

    def _key(self, state: _State, part: int) -> str:
        return state.task if len(self._parts) == 1 else f"{state.task}-{part:03d}"

    def _part_file(self, state: _State, part: int) -> str:
        """An undivided cache has no part number in its file name."""
        return self._cache(state.file if len(self._parts) == 1 else f"{state.file}_{part:03d}")

    def _gathered(self, frame: int) -> str:
        return self._cache(f"gather_{frame:05d}")

    def _gathered_box(self, number: int) -> str:
        return self._cache(f"gather_{number:03d}")

    def _misses(self, audit_round: int, window: int) -> str:
        """What a round of the audit missed, or in round 0 what was looked at."""
        stem = f"audit_{audit_round}" if audit_round else "look"
        name = f"{stem}_{window + 1:04d}{self._can.misses_suffix}"
        return RunDirectory.cache_name(name)

    def _cache(self, stem: str) -> str:
        return RunDirectory.cache_name(stem + self._can.cache_suffix)


def _frame(number: int) -> str:
    return RunDirectory.frame_name(number)


def _task(
    stage: str, number: str, reads: _Files, output: str, *, audit_round: int = 0, part: int = 0
) -> Task:
    key = f"{stage}-{number}" if number else stage
    arguments: dict[str, Any] = {
        "frames": list(reads.frames),
        "cache": list(reads.cache),
        "inputs": list(reads.inputs),
        "windows": list(reads.windows),
        "prepared": list(reads.prepared),
        "round": audit_round,
        "part": part,
        "box": list(reads.box),
    }
    outputs = (output, RunDirectory.result_name(key))
    return Task(key=key, stage=stage, outputs=outputs, needs=reads.needs, arguments=arguments)


@dataclass(frozen=True)
class Cost:
    """Estimated work of a run, as far as it follows from the settings.

    Attributes:
        camera_samples: pixel samples of all frames of the second pass.
        first_pass_rays: minimum number of first-pass rays (base rays of each selected frame); 0 without a first pass.
        audited_frames: frames of the coverage audit, counted once per round; 0 without an audit.
        seconds_cpu: of all cores together, both passes included, on a processor. Scenes differ: within a factor of
            three of what was measured.
        memory: bytes of each worker.
        disk: bytes of the frames.
    """

    camera_samples: int
    first_pass_rays: int
    audited_frames: int
    seconds_cpu: float
    memory: int
    disk: int


def estimate_cost(settings: RenderSettings, selected: Sequence[int], can: Capabilities) -> Cost:
    """Rough cost of a run; the number of records is known only after the first pass."""
    frames, pixels = len(settings.frames), settings.width * settings.height
    a_sample = _SECONDS_PATH if settings.mode == "path" else can.seconds_per_sample
    return Cost(
        camera_samples=pixels * frames * settings.spp,
        first_pass_rays=settings.base_rays * len(selected) if settings.mode == "two-pass" else 0,
        audited_frames=frames * audit_rounds(settings, can),
        seconds_cpu=_SECONDS_START + frames * (_SECONDS_FRAME + a_sample * pixels * settings.spp),
        memory=int(_BYTES_START + _BYTES_SAMPLE * min(pixels * settings.spp, _SAMPLES_AT_ONCE)),
        disk=int(_BYTES_PIXEL * pixels * frames),
    )


# Measured on two cores: gallery and temple-walk at 64x48 to 640x480, and the times in docs/quality.md.
_SECONDS_START: Final = 12.0
_SECONDS_FRAME: Final = 1.0
_SECONDS_PATH: Final = 1.1e-6
_BYTES_START: Final = 0.5e9
_BYTES_SAMPLE: Final = 134.0
_SAMPLES_AT_ONCE: Final = 1 << 24
_BYTES_PIXEL: Final = 11.5
