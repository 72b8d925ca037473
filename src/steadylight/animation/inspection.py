"""Inspects a frame of a run: which records it was shaded from, where they came from, and which were used at a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from steadylight.animation.plan import make_tasks
from steadylight.animation.provenance import RunRecord, read_run
from steadylight.animation.tasks import open_scene
from steadylight.engines import Task
from steadylight.errors import InputError, SettingsError
from steadylight.renderers import find_renderer
from steadylight.renderers.base import Question, RecordTable, SceneInspector, Surfaces
from steadylight.storage import RunDirectory

BOX = 100_000
"""Added to the number of a box of the first pass to tell it from a frame: frame numbers are smaller."""


@dataclass(frozen=True)
class Records:
    """The records that a frame reads.

    Attributes:
        table: the records.
        files: the files that they are in, relative to the run directory.
        origin: (R,) what made each record: the number of a selected frame; BOX plus the number of a box; minus the
            round of the coverage audit; or 0 if unknown.
        part: (R,) part of the cache that each is in.
    """

    table: RecordTable
    files: tuple[str, ...]
    origin: NDArray[np.int64]
    part: NDArray[np.int64]

    def origins(self) -> dict[str, NDArray[np.int64]]:
        """Numbers of the frames or boxes that made the records, by the name `frame` or `box`."""
        boxes = self.origin >= BOX
        name = "box" if boxes.any() else "frame"
        return {name: np.where(boxes, self.origin - BOX, self.origin)}

    def words(self, row: int) -> str:
        """Where a record came from."""
        number = int(self.origin[row])
        if number >= BOX:
            return f"box {number - BOX}"
        if number > 0:
            return f"frame {number}"
        return f"audit round {-number}" if number else "unknown"


class Inspection:
    """A frame of a run, its surfaces and its records."""

    def __init__(self, root: Path, frame: int) -> None:
        """Check that the frame can be inspected; the scene is not opened yet.

        Args:
            root: run directory.
            frame: number of the frame.

        Raises:
            SettingsError: there is no run, it has no such frame, or its renderer or mode has no records to inspect.
            InputError: files that the frame reads are missing.
        """
        self.directory, self.frame = RunDirectory(root), frame
        self.run: RunRecord = read_run(self.directory)
        settings = self.run.settings
        can = find_renderer(settings.renderer).capabilities
        if not can.inspection:
            raise SettingsError(
                f"{root}: was rendered with {settings.renderer}, whose records cannot be inspected"
            )
        if settings.mode != "two-pass":
            raise SettingsError(
                f"{root}: was rendered with --mode {settings.mode}, which keeps no cache; give a two-pass run"
            )
        if frame not in settings.frames:
            first, last = settings.frames[0], settings.frames[-1]
            raise SettingsError(f"--frame: {frame} is not a frame of {root}, which has {first} to {last}")
        self._tasks = make_tasks(settings, self.run.selected, can, self.run.survey)
        shade = next(t for t in self._tasks if t.stage == "shade" and t.arguments["frames"] == [frame])
        self.files: tuple[str, ...] = tuple(shade.arguments["cache"])
        for name in self.files:
            if not (self.directory.root / name).is_file():
                raise InputError(
                    f"{self.directory.root / name}: does not exist yet, and this frame needs it; finish the render "
                    "first"
                )
        self._opened: SceneInspector | None = None

    @property
    def scene(self) -> SceneInspector:
        """The scene, opened when it is first needed."""
        if self._opened is None:
            self._opened = cast("SceneInspector", open_scene(self.directory.root)[1])
        return self._opened

    def surfaces(self) -> Surfaces:
        """What each pixel of the frame sees."""
        return self.scene.surfaces(self.frame)

    def records(self) -> Records:
        """The records that the frame reads."""
        table = self.scene.records(self._paths(self.files))
        writers = {task.outputs[0]: task for task in self._tasks}
        parts = np.array([writers[name].arguments["part"] for name in self.files], np.int64)
        return Records(table, self.files, self._origins(table), parts[table.source])

    def questions(self, column: int, row: int) -> Sequence[Question]:
        """The surface points at which a pixel looked up the cache.

        Raises:
            SettingsError: the pixel is outside the frame.
        """
        width, height = self.run.settings.width, self.run.settings.height
        if not (0 <= column < width and 0 <= row < height):
            raise SettingsError(
                f"--pixel: {column},{row} is outside the frame of {width}x{height} pixels; the top left one is 0,0"
            )
        return self.scene.questions(self.frame, (column, row), self._paths(self.files))

    def _origins(self, table: RecordTable) -> NDArray[np.int64]:
        """Origin of each record, found by its position, which never changes after the task that made it."""
        origin = np.zeros(len(table.position), np.int64)
        places = _keys(table.position)
        fills = sorted((t for t in self._tasks if t.stage == "fill"), key=lambda t: -t.arguments["round"])
        gathers = [task for task in self._tasks if task.stage == "gather"]
        for task in (*fills, *gathers):  # the task that made a record comes last: later files repeat it
            if (self.directory.root / task.outputs[0]).is_file():
                made = self.scene.records(self._paths(task.outputs[:1])).position
                origin[np.isin(places, _keys(made))] = number_of(task)
        return origin

    def _paths(self, names: Sequence[str]) -> list[Path]:
        return [self.directory.root / name for name in names]


def number_of(task: Task) -> int:
    """Number by which `Records.origin` refers to the task that made a record."""
    if task.stage != "gather":
        return -int(task.arguments["round"])
    frames = task.arguments["frames"]
    return int(frames[0]) if frames else BOX + int(task.key.rpartition("-")[2])


def _keys(position: NDArray[np.float32]) -> NDArray[np.void]:
    """Each position as one value that can be compared bit by bit."""
    return np.ascontiguousarray(position, np.float32).view(np.dtype((np.void, 12))).ravel()
