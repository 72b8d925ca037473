"""The two passes as data: settings in, tasks with their needs and files out; imports no renderer.

```
gather-00012 ─┐         ┌ audit-1-0001 ┐           ┌ audit-2-0001 ┐                    ┌ shade-00001
gather-00031 ─┼─ merge ─┼ audit-1-0002 ┼─ cover-1 ─┼ audit-2-0002 ┼─ cover-2 ─ finish ─┼ shade-00002
gather-00057 ─┘         └ ...          ┘           └ ...          ┘                    └ ...
```

With `--coverage off` the second pass follows the merge at once; modes without a shared cache have second-pass
tasks only.

A cache in parts (`cache.partition`) has a merge, a cover and a finish for each part and round, and each of them, and
each audit and frame, waits only for the parts that it reads: no barrier lies between the passes. A task reads what its
entry here names and nothing else, so its bytes do not depend on when it starts.

Nothing here depends on how many workers there are: the same settings always give the same tasks,
so that the bytes do not depend on the machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from steadylight.cache.partition import Partition
from steadylight.engines import Task
from steadylight.errors import SettingsError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from steadylight.settings import RenderSettings

STAGES: Final = ("gather", "merge", "audit", "cover", "finish", "shade", "join")
"""Every stage a task may belong to, in the order of the method."""

AUDIT_ROUNDS: Final = 2
"""How often all frames are looked at for points that the cache cannot answer; the last time along all their paths."""

FRAMES_PER_WINDOW: Final = 8
"""Frames of a window, which are audited together: fixed, so that records do not depend on the number of workers."""

FEWEST_FRAMES_IN_PARTS: Final = 400
FRAMES_PER_PART: Final = 20
MOST_PARTS: Final = 64
"""By default the cache of a film of so many frames is in parts: at least so many frames for each, and at most so many
parts. Filling and smoothing a part is one task, which others wait for."""

SCENE_FILE: Final = "scene.zip"
"""The scene as the workers read it, relative to the run directory."""


def gathered_cache(frame: int) -> str:
    """The first-pass cache of a selected frame, relative to the run directory."""
    return RunDirectory.cache_name(f"gather_{frame:05d}")


def merged_cache() -> str:
    """The merged cache of all selected frames, relative to the run directory."""
    return RunDirectory.cache_name("merged")


def audit_points(audit_round: int, window: int) -> str:
    """The points of one window of frames that the cache cannot answer, relative to the run directory."""
    return f"cache/audit_{audit_round}_{window:04d}.points"


def cache_part(state: str, part: int, parts: int) -> str:
    """A part of the shared cache, relative to the run directory.

    Args:
        state: `merged`, `covered_1` (after round 1 of the audit) or `finished` (smoothed, as the second pass reads it).
        part: its number.
        parts: how many there are; one part is the whole cache, and has no number.
    """
    return RunDirectory.cache_name(state if parts == 1 else f"{state}_{part:03d}")


def selected_count(frames: int, choice: int | Literal["auto", "workers"], workers: int) -> int:
    """How many frames the first pass visits.

    Args:
        frames: number of frames of the film.
        choice: a number; `workers` for the paper's rule (as many as there are workers); `auto` for the
            square root of the number of frames, rounded up, which does not depend on the machine.
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
            f"--selected-frames: {choice!r} is not valid: give auto, workers or a number of at least 1"
        )
    return min(choice, frames)


def part_count(frames: int, choice: int | Literal["auto"], mode: str, coverage: str) -> int:
    """In how many parts the shared cache is.

    Args:
        frames: number of frames of the film.
        choice: a number, or `auto`: 1 for short films, else the power of two next below one for FRAMES_PER_PART frames.
            It follows from the film alone, so that the bytes do not depend on the machine.
        mode: of the run.
        coverage: of the run.

    Raises:
        SettingsError: several parts where none are shared, or where frames add private records.
    """
    several = mode == "two-pass" and coverage == "full"
    if choice == "auto":
        few = frames < FEWEST_FRAMES_IN_PARTS or not several
        return 1 if few else min(MOST_PARTS, 1 << int(math.log2(frames / FRAMES_PER_PART)))
    if choice > 1 and not several:
        raise SettingsError(
            f"--cache-parts: {choice} is not valid here: only --mode two-pass with --coverage full has a cache in "
            "parts; give auto or 1"
        )
    return choice


def windows_of(frames: Sequence[int]) -> list[list[int]]:
    """The frames of the film by windows: those that are audited together."""
    return [
        list(frames[first : first + FRAMES_PER_WINDOW]) for first in range(0, len(frames), FRAMES_PER_WINDOW)
    ]


def make_tasks(
    settings: RenderSettings, selected: Sequence[int], partition: Partition | None = None
) -> tuple[Task, ...]:
    """All tasks of a run, each after what it needs.

    The arguments of every task are the same plain keys: `frames` (frame numbers), `cache` (the files of
    the cache that it reads, relative to the run directory), `inputs` (further files that it reads), `windows` (of the
    film, from 0: that of each input of a cover), `round` (of the audit, else 0) and `part` (of the cache, else 0). The
    last output of every task is its result file.

    Args:
        settings: of the run.
        selected: numbers of the frames that the first pass visits, ascending; of no meaning in modes
            without a shared cache.
        partition: of the cache; one part if None.
    """
    if settings.mode != "two-pass":
        return tuple(
            _task("shade", f"{n:05d}", RunDirectory.frame_name(n), frames=[n]) for n in settings.frames
        )
    windows = windows_of(settings.frames)
    shared = _Shared(partition or Partition.whole(len(windows)), windows)
    gathers = [_task("gather", f"{n:05d}", gathered_cache(n), frames=[n]) for n in selected]
    tasks = [*gathers, *shared.merges(selected)]
    state = _State("merged", "merge")
    if settings.coverage == "full":
        for audit_round in range(1, AUDIT_ROUNDS + 1):
            tasks += shared.audits(audit_round, state)
            tasks += shared.covers(audit_round, state)
            state = _State(f"covered_{audit_round}", f"cover-{audit_round}")
        tasks += shared.finishes(state)
        state = _State("finished", "finish")
    return (*tasks, *shared.shades(state), *shared.join())


class _State(NamedTuple):
    """What has become of the cache so far: how its files are called, and the tasks that wrote them."""

    file: str
    task: str


class _Shared:
    """Makes the tasks that read or write the shared cache."""

    def __init__(self, partition: Partition, windows: Sequence[Sequence[int]]) -> None:
        self._partition = partition
        self._parts = range(partition.count)
        self._windows = windows

    def merges(self, selected: Sequence[int]) -> list[Task]:
        """Each part from the selected frames that see it, or its neighbours, whose records may stand in for its."""
        window_of = {frame: number for number, frames in enumerate(self._windows) for frame in frames}
        tasks = []
        for part in self._parts:
            near = set(self._partition.around([part]))
            frames = [n for n in selected if near.intersection(self._partition.windows[window_of[n]])]
            tasks.append(
                self._of_part(
                    "merge",
                    "merged",
                    part,
                    needs=tuple(f"gather-{n:05d}" for n in frames),
                    inputs=[gathered_cache(n) for n in frames],
                )
            )
        return tasks

    def audits(self, audit_round: int, state: _State) -> list[Task]:
        """A task for each window of frames, which looks for what the parts that it sees cannot answer."""
        return [
            _task(
                "audit",
                f"{audit_round}-{number + 1:04d}",
                audit_points(audit_round, number + 1),
                frames=list(frames),
                audit_round=audit_round,
                **self._reading(state, self._partition.windows[number]),
            )
            for number, frames in enumerate(self._windows)
        ]

    def covers(self, audit_round: int, state: _State) -> list[Task]:
        """Each part with what the windows that see it have missed."""
        tasks = []
        for part in self._parts:
            windows = [n for n, seen in enumerate(self._partition.windows) if part in seen]
            reading = self._reading(state, [part])
            audits = tuple(f"audit-{audit_round}-{n + 1:04d}" for n in windows)
            reading["needs"] = (*reading["needs"], *audits)
            tasks.append(
                self._of_part(
                    f"cover-{audit_round}",
                    f"covered_{audit_round}",
                    part,
                    inputs=[audit_points(audit_round, n + 1) for n in windows],
                    windows=windows,
                    audit_round=audit_round,
                    **reading,
                )
            )
        return tasks

    def finishes(self, state: _State) -> list[Task]:
        """Each part, which is the first that its task reads, smoothed with its neighbours around it."""
        tasks = []
        for part in self._parts:
            others = [other for other in self._partition.around([part]) if other != part]
            tasks.append(self._of_part("finish", "finished", part, **self._reading(state, [part, *others])))
        return tasks

    def shades(self, state: _State) -> list[Task]:
        """Every frame, from the parts that its window sees."""
        return [
            _task("shade", f"{n:05d}", RunDirectory.frame_name(n), frames=[n], **self._reading(state, seen))
            for frames, seen in zip(self._windows, self._partition.windows, strict=True)
            for n in frames
        ]

    def join(self) -> list[Task]:
        """The merged cache in one file, for people: nothing waits for it."""
        if len(self._parts) == 1:
            return []
        return [_task("join", "", merged_cache(), **self._reading(_State("merged", "merge"), self._parts))]

    def _reading(self, state: _State, parts: Sequence[int]) -> dict[str, Any]:
        """Arguments of a task that reads some parts."""
        return {
            "needs": tuple(self._key(state.task, part) for part in parts),
            "cache": [cache_part(state.file, part, len(self._parts)) for part in parts],
        }

    def _of_part(self, stem: str, state: str, part: int, **more: Any) -> Task:
        """A task that writes a part of the cache."""
        stage, _, number = self._key(stem, part).partition("-")
        return _task(stage, number, cache_part(state, part, len(self._parts)), part=part, **more)

    def _key(self, stem: str, part: int) -> str:
        return stem if len(self._parts) == 1 else f"{stem}-{part:03d}"


def _task(
    stage: str,
    number: str,
    output: str,
    *,
    needs: tuple[str, ...] = (),
    frames: list[int] | None = None,
    cache: list[str] | None = None,
    inputs: list[str] | None = None,
    windows: list[int] | None = None,
    audit_round: int = 0,
    part: int = 0,
) -> Task:
    key = f"{stage}-{number}" if number else stage
    arguments: dict[str, Any] = {
        "frames": frames or [],
        "cache": cache or [],
        "inputs": inputs or [],
        "windows": windows or [],
        "round": audit_round,
        "part": part,
    }
    outputs = (output, RunDirectory.result_name(key))
    return Task(key=key, stage=stage, outputs=outputs, needs=needs, arguments=arguments)


@dataclass(frozen=True)
class Cost:
    """Roughly what a run asks of the machine; a record's number is known only after the first pass.

    Attributes:
        camera_samples: samples through pixels of all frames of the second pass.
        first_pass_rays: least number of first-pass rays (base rays of each selected frame), 0 without one.
        audit_rays: rays of the coverage audit, at one per pixel and in the last round all samples; 0 without one.
        paths_per_record: paths that a quiet record costs, and a noisy one; None without a cache.
        path_segments: most indirect segments of one of these paths (of one camera path in mode path).
    """

    camera_samples: int
    first_pass_rays: int
    audit_rays: int
    paths_per_record: tuple[int, int] | None
    path_segments: int


def estimate_cost(settings: RenderSettings, selected: Sequence[int]) -> Cost:
    """Rough cost of a run from its settings alone."""
    from steadylight.renderers.mitsuba.quality import quality_of

    pixels = settings.width * settings.height * len(settings.frames)
    shared = settings.mode == "two-pass"
    audited = shared and settings.coverage == "full"
    cached = settings.mode != "path"
    return Cost(
        camera_samples=pixels * settings.spp,
        first_pass_rays=settings.base_rays * len(selected) if shared else 0,
        audit_rays=pixels * (AUDIT_ROUNDS - 1 + settings.spp) if audited else 0,
        paths_per_record=quality_of(settings).records.paths_per_record if cached else None,
        path_segments=settings.bounces,
    )
