"""The state of a run, polled from its directory at little cost: only what has changed is read again."""

from __future__ import annotations

import json
import os
import platform
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from steadylight.animation.plan import make_tasks
from steadylight.animation.provenance import RunRecord, read_run
from steadylight.animation.sessions import SessionLog
from steadylight.animation.time_left import TimeLeft
from steadylight.checksum import parse
from steadylight.errors import SteadylightError
from steadylight.progress import duration, left_in_words, pass_names
from steadylight.renderers import find_renderer
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Iterable

    from steadylight.engines import Task

ACTIVE: Final = 120.0
"""A worker counts as working if it ended an attempt within this many seconds before the run's latest attempt."""


class RunState:
    """Follows a run directory.

    Attributes:
        directory: the run directory.
        frames: paths of the existing frames, by number, in the order in which they appeared.
    """

    def __init__(self, root: Path) -> None:
        """Prepare; nothing is read yet."""
        self.directory = RunDirectory(root)
        self.frames: dict[int, Path] = {}
        self._tasks: tuple[Task, ...] = ()
        self._record: RunRecord | None = None
        self._record_fault = ""
        self._record_time = -1.0
        self._title = ""
        self._attempts: list[dict[str, Any]] = []
        self._offset = 0
        self._folder_times: dict[str, float] = {}
        self._done: set[str] = set()

    def look(self) -> None:
        """Read what has changed since the last look."""
        self._read_record()
        self._read_journal()
        if self._changed("frames"):
            self._read_frames()
        if self._changed("log/results"):
            names = _names(self.directory.root / "log/results")
            self._done = {name.removesuffix(".json") for name in names if name.endswith(".json")}

    def plain(self, since: int = 0) -> dict[str, Any]:
        """The state as plain data, with the attempts from number `since` on."""
        left = [task for task in self._tasks if task.key not in self._done]
        sessions = SessionLog.read_all(self.directory.root)
        status = self._status(left, sessions)
        record = self._record
        return {
            "name": self.directory.root.resolve().name,
            "title": self._title,
            "status": status,
            "notices": self._notices(),
            "passes": self._passes(),
            "tasks": [len(self._tasks) - len(left), len(self._tasks)],
            "left": self._time_left(left) if status == "running" else "",
            "spent": duration(sum(float(session["seconds"]) for session in sessions)) if sessions else "",
            "workers": len(self._active()),
            "fps": record.settings.fps if record else 25.0,
            "wanted": len(record.settings.frames) if record else 0,
            "frames": sorted(self.frames),
            "newest": list(self.frames)[-24:],
            "attempts": [_attempt(entry) for entry in self._attempts[since:]],
            "count": len(self._attempts),
        }

    # ---- reading ---------------------------------------------------------------------------------

    def _read_record(self) -> None:
        try:
            changed = self.directory.run_file.stat().st_mtime
        except OSError:
            self._record, self._tasks, self._record_time = None, (), -1.0
            self._record_fault = f"{self.directory.root}: no run.json: no render has begun here yet."
            return
        if changed == self._record_time:
            return
        self._record_time = changed
        try:
            self._record = record = read_run(self.directory)
            scene = self.directory.read_record()["scene"]
            self._title = str(scene.get("title") or scene.get("name") or "")
            can = find_renderer(record.settings.renderer).capabilities
            aovs = self.directory.aovs.is_dir()
            self._tasks = make_tasks(record.settings, record.selected, can, record.survey, aovs=aovs)
            self._record_fault = ""
        except SteadylightError as error:
            self._record, self._tasks, self._record_fault = None, (), str(error)

    def _read_journal(self) -> None:
        """Read new complete lines of the journal; damaged ones are skipped."""
        path = self.directory.journal_file
        try:
            size = path.stat().st_size
            if size < self._offset:  # another run began here
                self._offset, self._attempts = 0, []
            if size == self._offset:
                return
            with path.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
        except OSError:
            return
        whole = new[: new.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.splitlines():
            with suppress(ValueError, KeyError, TypeError):
                entry = parse(line, required=False)
                float(entry["time"]), float(entry["seconds"]), str(entry["task"])
                self._attempts.append(entry)

    def _read_frames(self) -> None:
        folder = self.directory.root / "frames"
        found = {}
        for name in _names(folder):
            stem, _, suffix = name.partition(".")
            digits = stem.removeprefix("frame_")
            if suffix == "exr" and digits.isdecimal():
                found[int(digits)] = folder / name
        self.frames = {number: path for number, path in self.frames.items() if number in found}
        new = [number for number in found if number not in self.frames]
        for each in sorted(new, key=lambda each: _time_of(found[each])):
            self.frames[each] = found[each]

    def _changed(self, folder: str) -> bool:
        changed = _time_of(self.directory.root / folder)
        before, self._folder_times[folder] = self._folder_times.get(folder), changed
        # Folders that changed in the last seconds are listed again: a file may appear within the same clock tick.
        return before != changed or time.time() - changed < 5

    # ---- reporting -------------------------------------------------------------------------------

    def _notices(self) -> list[str]:
        notices = [self._record_fault] if self._record_fault else []
        missing = self._record is not None and not (self.directory.root / "log").is_dir()
        if missing:
            notices.append(f"{self.directory.root}: no log folder: times and workers are not known.")
        return notices

    def _status(self, left: Iterable[Task], sessions: list[dict[str, Any]]) -> str:
        if self._record is None:
            return "unknown" if self.directory.run_file.exists() else "waiting"
        if self.directory.stats_file.exists() and not left:
            return "done"
        if not sessions:  # prepared, or performed by a farm
            return "running" if self._done else "waiting"
        last = sessions[-1]
        if last.get("outcome") == "running" and _is_alive(last):
            return "running"
        return str(last.get("outcome")) if last.get("outcome") != "running" else "killed"

    def _passes(self) -> list[dict[str, Any]]:
        """Number of finished and of all tasks of each pass, in order."""
        totals: Counter[str] = Counter()
        done: Counter[str] = Counter()
        names = pass_names(task.stage for task in self._tasks)
        for task in self._tasks:
            totals[names[task.stage]] += 1
            done[names[task.stage]] += task.key in self._done
        return [{"name": name, "done": done[name], "total": total} for name, total in totals.items()]

    def _active(self) -> set[str]:
        """Workers that have ended an attempt recently."""
        latest = max((float(entry["time"]) for entry in self._attempts), default=0.0)
        return {str(e.get("worker")) for e in self._attempts if float(e["time"]) > latest - ACTIVE}

    def _time_left(self, left: Iterable[Task]) -> str:
        """How long the rest of the run takes, in words; empty while that is unknown."""
        if self._record is None:
            return ""
        estimate = TimeLeft(self._tasks, self._record.settings)
        for entry in self._attempts:
            if entry.get("outcome") == "done":
                estimate.add(str(entry.get("stage")), float(entry["seconds"]), str(entry.get("worker")))
        return left_in_words(estimate.seconds(Counter(task.stage for task in left), len(self._active())))


def _attempt(entry: dict[str, Any]) -> dict[str, Any]:
    """An attempt as the page needs it."""
    end, seconds = float(entry["time"]), float(entry["seconds"])
    found: dict[str, Any] = {
        "task": entry["task"],
        "stage": entry.get("stage", ""),
        "worker": str(entry.get("worker", "")),
        "start": round(end - seconds, 3),
        "end": round(end, 3),
        "outcome": entry.get("outcome", ""),
        "attempt": entry.get("attempt", 1),
    }
    if entry.get("outcome") != "done":
        result = entry.get("result")
        why = str(result.get("error", "")).splitlines() if isinstance(result, dict) else []
        found |= {"cause": entry.get("cause", ""), "why": why[0] if why else ""}
    return found


def _names(folder: Path) -> list[str]:
    try:
        return [entry.name for entry in os.scandir(folder) if not entry.name.startswith(".")]
    except OSError:
        return []


def _time_of(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return -1.0


def _is_alive(session: dict[str, Any]) -> bool:
    """Whether the process of a session is running, as far as this machine can tell."""
    if session.get("host") != platform.node():
        return True
    return Path(f"/proc/{session.get('process')}").exists() or not Path("/proc").is_dir()


def as_text(state: dict[str, Any]) -> str:
    """The state as JSON."""
    return json.dumps(state, separators=(",", ":"))
