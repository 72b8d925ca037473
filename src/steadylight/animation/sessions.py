"""A file for each command that worked on a run: when, for how long, and with how many workers.

The makespan is the sum over these (see `animation.statistics`). The file is updated during the session, so that little
is lost if the session is killed.
"""

from __future__ import annotations

import datetime as dt
import os
import platform
import time
from typing import TYPE_CHECKING, Any, Final

from steadylight.atomic_file import storage_errors, write_json
from steadylight.checksum import parse, with_checksum
from steadylight.engines.performing import machine_of
from steadylight.errors import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

FOLDER: Final = "log/sessions"
"""Relative to the run directory."""

_SECONDS_BETWEEN_NOTES = 2.0
_HOSTS_NAMED: Final = 4


class SessionLog:
    """Writes the file of one session.

    Attributes:
        path: path of the file.
        closed: whether the end of the session was recorded.
    """

    def __init__(self, root: Path, started: float, workers: int) -> None:
        """Create the file.

        Args:
            root: the run directory.
            started: `time.perf_counter()` when the command began.
            workers: worker processes at the start.

        Raises:
            StorageError: the file cannot be written.
        """
        self.path = _new_file(root)
        self.closed = False
        self._started = started
        self._written = float("-inf")
        begin = dt.datetime.now(dt.UTC) - dt.timedelta(seconds=self._seconds())
        self._content: dict[str, Any] = {
            "started": begin.isoformat(timespec="seconds"),
            "seconds": 0.0,
            "workers": workers,
            "host": platform.node(),
            "process": os.getpid(),
            "outcome": "running",
            "tasks_done": 0,
        }
        self._write()

    def note(self, *, tasks_done: int) -> None:
        """Record that an attempt has ended and `tasks_done` more tasks are done."""
        self._content["tasks_done"] += tasks_done
        self._content["seconds"] = self._seconds()
        if time.perf_counter() - self._written > _SECONDS_BETWEEN_NOTES:
            self._write()

    def close(self, outcome: str) -> None:
        """Record the end of the session: `done`, `stopped` or `failed`.

        A completed session ends with its last task; an interrupted one ends now.
        """
        if outcome != "done":
            self._content["seconds"] = self._seconds()
        self._content["outcome"] = outcome
        self.closed = True
        self._write()

    @staticmethod
    def add(root: Path, attempts: Sequence[Mapping[str, Any]]) -> None:
        """Record attempts of a render farm as one session, from the first start to the last end.

        Args:
            root: the run directory.
            attempts: lines of the journal.

        Raises:
            StorageError: the file cannot be written.
        """
        spans = [(float(line["time"]) - float(line["seconds"]), float(line["time"])) for line in attempts]
        begin, end = min(start for start, _ in spans), max(end for _, end in spans)
        hosts = sorted({machine_of(str(line.get("worker", ""))) for line in attempts})
        content = {
            "started": dt.datetime.fromtimestamp(begin, dt.UTC).isoformat(timespec="seconds"),
            "seconds": round(end - begin, 3),
            "workers": max(sum(start <= at < stop for start, stop in spans) for at, _ in spans),
            "host": ", ".join(hosts[:_HOSTS_NAMED]) + (" ..." if len(hosts) > _HOSTS_NAMED else ""),
            "process": os.getpid(),
            "outcome": "done",
            "tasks_done": sum(line.get("outcome") == "done" for line in attempts),
        }
        write_json(_new_file(root), with_checksum(content))

    @staticmethod
    def read_all(root: Path) -> list[dict[str, Any]]:
        """All sessions of a run, in order; damaged files are skipped."""
        contents = [_read(path) for path in _files(root)]
        return [content for content in contents if content is not None]

    @staticmethod
    def set_damage_aside(root: Path) -> list[str]:
        """Rename damaged files of sessions; returns a sentence for each.

        Raises:
            StorageError: a file cannot be renamed.
        """
        # Not through a link: a run directory from elsewhere may have one anywhere.
        if (root / FOLDER).is_symlink():
            raise StorageError(
                f"{root / FOLDER}: is a symbolic link; remove it, then run the same command again"
            )
        damaged = [path for path in _files(root) if _read(path) is None]
        return [set_aside(path, f"{FOLDER}/{path.name}", "session") for path in damaged]

    def _seconds(self) -> float:
        return round(time.perf_counter() - self._started, 3)

    def _write(self) -> None:
        write_json(self.path, with_checksum(self._content))
        self._written = time.perf_counter()


def set_aside(path: Path, name: str, what: str) -> str:
    """Rename a damaged file, which is then no longer read.

    Args:
        path: path of the file.
        name: name of the file in the message.
        what: what is lost with it.

    Returns:
        What happened, as a sentence.

    Raises:
        StorageError: the file cannot be renamed.
    """
    aside = path.with_suffix(".damaged")
    with storage_errors(path):
        path.rename(aside)
    return f"{name} is damaged; it was renamed to {aside.name}, and its {what} is missing from the statistics"


def _new_file(root: Path) -> Path:
    """Path of the next session's file."""
    folder = root / FOLDER
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    numbers = [int(path.stem) for path in folder.glob("*") if path.stem.isdecimal()]
    return folder / f"{max(numbers, default=0) + 1:04d}.json"


def _files(root: Path) -> list[Path]:
    """Files of all sessions of a run, in order."""
    return sorted(path for path in (root / FOLDER).glob("*.json") if path.stem.isdecimal())


def _read(path: Path) -> dict[str, Any] | None:
    """Content of a file; None if it is damaged. Files of older versions have no checksum."""
    try:
        content = parse(path.read_bytes(), required=False)
        float(content["seconds"]), int(content["workers"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return content
