"""The tasks that make, read or write the cache that all frames share; `plan.make_tasks` puts them in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from steadylight.engines import Task
from steadylight.renderers.base import Capabilities, Survey
from steadylight.storage import RunDirectory


class State(NamedTuple):
    """State of the cache: stems of its files and of the keys of the tasks that write them."""

    file: str
    task: str


@dataclass(frozen=True)
class Files:
    """What a task reads; see `plan.make_tasks`."""

    frames: Sequence[int] = ()
    cache: Sequence[str] = ()
    inputs: Sequence[str] = ()
    windows: Sequence[int] = ()
    needs: tuple[str, ...] = ()
    prepared: Sequence[str] = ()
    box: tuple[int, int] = (0, 0)


class SharedCache:
    """Makes the tasks that read or write the shared cache.

    After a first pass by surfaces, frames also read the output of `prepare`, which lights what faint gloss reflects.
    """

    def __init__(
        self, survey: Survey, windows: Sequence[Sequence[int]], can: Capabilities, *, by_surfaces: bool
    ) -> None:
        self._survey, self._by_surfaces = survey, by_surfaces
        self._parts = range(survey.parts)
        self._windows = windows
        self._can = can

    def prepares(self) -> list[Task]:
        """The task `prepare`, whose output is needed to make records, if the renderer has one."""
        return [make_task("prepare", "", Files(), file) for file in self._prepared]

    def looks(self) -> list[Task]:
        """A task for each window of frames, which finds the points that these frames look up."""
        return [
            make_task("look", f"{number + 1:04d}", Files(frames=frames), self._misses(0, number))
            for number, frames in enumerate(self._windows)
        ]

    def boxes(self, count: int) -> list[Task]:
        """A task for each box of each part, which reads the points looked up by the windows that see the part."""
        tasks = []
        for part in self._parts:
            windows = [n for n, seen in enumerate(self._survey.windows) if part in seen]
            reads = Files(
                inputs=[self._misses(0, n) for n in windows],
                windows=windows,
                needs=tuple(f"look-{n + 1:04d}" for n in windows),
            )
            for box in range(count):
                given = self._making(replace(reads, box=(box, count)))
                name = part * count + box
                tasks.append(make_task("gather", f"{name:03d}", given, self._gathered_box(name), part=part))
        return tasks

    def merges_of_boxes(self, count: int) -> list[Task]:
        """Merge each part from its boxes and those of its neighbours, whose records may replace its own."""
        tasks = []
        for part in self._parts:
            near = sorted({part, *self._survey.neighbours[part]})
            names = [other * count + box for other in near for box in range(count)]
            reads = Files(
                inputs=[self._gathered_box(name) for name in names],
                needs=tuple(f"gather-{name:03d}" for name in names),
            )
            tasks.append(self._of_part(State("merged", "merge"), part, reads))
        return tasks

    def gathers(self, selected: Sequence[int]) -> list[Task]:
        """A task for each selected frame."""
        return [
            make_task("gather", f"{n:05d}", self._making(Files(frames=(n,))), self._gathered(n))
            for n in selected
        ]

    def merges(self, selected: Sequence[int]) -> list[Task]:
        """Merge each part from the selected frames that see it or its neighbours, whose records may replace its own."""
        window_of = {frame: number for number, frames in enumerate(self._windows) for frame in frames}
        tasks = []
        for part in self._parts:
            near = {part, *self._survey.neighbours[part]}
            frames = [n for n in selected if near.intersection(self._survey.windows[window_of[n]])]
            reads = Files(
                inputs=[self._gathered(n) for n in frames], needs=tuple(f"gather-{n:05d}" for n in frames)
            )
            tasks.append(self._of_part(State("merged", "merge"), part, reads))
        return tasks

    def audits(self, audit_round: int, state: State) -> list[Task]:
        """A task for each window of frames, which finds the points that the parts it sees do not cover."""
        return [
            make_task(
                "audit",
                f"{audit_round}-{number + 1:04d}",
                replace(self._reading(state, self._survey.windows[number]), frames=frames),
                self._misses(audit_round, number),
                audit_round=audit_round,
            )
            for number, frames in enumerate(self._windows)
        ]

    def fills(self, audit_round: int, state: State) -> list[Task]:
        """Fill each part with the misses of the windows that see it."""
        tasks = []
        filled = State(f"filled_{audit_round}", f"fill-{audit_round}")
        for part in self._parts:
            reads = self._with_misses(self._reading(state, [part]), audit_round, part)
            tasks.append(self._of_part(filled, part, self._making(reads), audit_round))
        return tasks

    def smooths(self, state: State, audit_round: int) -> list[Task]:
        """Smooth each part with its neighbours; the part itself is the first file that its task reads.

        If `audit_round` is not 0, points that this round missed and that still have no record are covered by records
        farther away.
        """
        smoothed = State("smoothed", "smooth")
        tasks = []
        for part in self._parts:
            reads = self._reading(state, [part, *self._survey.neighbours[part]])
            if audit_round:
                reads = self._with_misses(reads, audit_round, part)
            tasks.append(self._of_part(smoothed, part, reads))
        return tasks

    def _with_misses(self, reads: Files, audit_round: int, part: int) -> Files:
        """Add the misses of an audit round in the windows that see a part."""
        windows = [n for n, seen in enumerate(self._survey.windows) if part in seen]
        return replace(
            reads,
            inputs=[self._misses(audit_round, n) for n in windows],
            windows=windows,
            needs=(*reads.needs, *(f"audit-{audit_round}-{n + 1:04d}" for n in windows)),
        )

    @property
    def _prepared(self) -> list[str]:
        """The file that `prepare` writes, in a list; empty if the renderer has no such task."""
        suffix = self._can.prepared_suffix
        return [RunDirectory.cache_name(f"prepared{suffix}")] if self._can.prepares else []

    def _making(self, reads: Files) -> Files:
        """Add the output of `prepare`."""
        needs = tuple("prepare" for _ in self._prepared)
        return replace(reads, prepared=self._prepared, needs=(*needs, *reads.needs))

    def shades(self, state: State) -> list[Task]:
        """A task for each frame, which reads the parts that its window sees."""
        tasks = []
        for frames, seen in zip(self._windows, self._survey.windows, strict=True):
            reads = self._reading(state, seen)
            reads = self._making(reads) if self._by_surfaces else reads
            tasks += [
                make_task("shade", f"{n:05d}", replace(reads, frames=(n,)), RunDirectory.frame_name(n))
                for n in frames
            ]
        return tasks

    def concatenate(self) -> list[Task]:
        """The merged cache as one file for inspection; no task waits for it."""
        if len(self._parts) == 1:
            return []
        reads = self._reading(State("merged", "merge"), self._parts)
        return [make_task("concatenate", "", reads, self._cache("merged"))]

    def _reading(self, state: State, parts: Sequence[int]) -> Files:
        """The inputs of a task that reads the given parts."""
        return Files(
            cache=[self._part_file(state, part) for part in parts],
            needs=tuple(self._key(state, part) for part in parts),
        )

    def _of_part(self, state: State, part: int, reads: Files, audit_round: int = 0) -> Task:
        """The task that writes a part of the cache in a given state."""
        stage, _, number = self._key(state, part).partition("-")
        return make_task(
            stage, number, reads, self._part_file(state, part), audit_round=audit_round, part=part
        )

    def _key(self, state: State, part: int) -> str:
        return state.task if len(self._parts) == 1 else f"{state.task}-{part:03d}"

    def _part_file(self, state: State, part: int) -> str:
        """Name of the file of a part; an undivided cache has no part number in it."""
        return self._cache(state.file if len(self._parts) == 1 else f"{state.file}_{part:03d}")

    def _gathered(self, frame: int) -> str:
        return self._cache(f"gather_{frame:05d}")

    def _gathered_box(self, number: int) -> str:
        return self._cache(f"gather_{number:03d}")

    def _misses(self, audit_round: int, window: int) -> str:
        """Name of the file of misses of an audit round; for round 0, of the points that `look` found."""
        stem = f"audit_{audit_round}" if audit_round else "look"
        name = f"{stem}_{window + 1:04d}{self._can.misses_suffix}"
        return RunDirectory.cache_name(name)

    def _cache(self, stem: str) -> str:
        return RunDirectory.cache_name(stem + self._can.cache_suffix)


def make_task(
    stage: str, number: str, reads: Files, output: str, *, audit_round: int = 0, part: int = 0
) -> Task:
    """A task; its arguments are described in `plan.make_tasks`."""
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
