"""The journal of a run: one line for each attempt at a task, each with its checksum."""

from __future__ import annotations

import errno
import json
import os
import time
from typing import TYPE_CHECKING, Any

from steadylight import checksum
from steadylight.atomic_file import atomic_write, storage_errors
from steadylight.errors import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_OF_AN_ATTEMPT = {"time", "task", "stage", "outcome", "seconds"}


class Journal:
    """A file of JSON lines to which the command that holds the lock appends.

    Args:
        path: path of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def append(self, entry: Mapping[str, Any]) -> None:
        """Add one line, with `time` (seconds since 1970) if the entry has none, and its checksum.

        One write per line, so that a killed command can only truncate the last one.

        Raises:
            StorageError: the journal cannot be written.
        """
        content = {"time": round(time.time(), 3), **entry}
        line = json.dumps(checksum.with_checksum(content)) + "\n"
        with storage_errors(self._path):
            journal = os.open(
                self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666
            )
            try:
                size = os.fstat(journal).st_size
                if size and os.pread(journal, 1, size - 1) != b"\n":
                    line = "\n" + line
                encoded = line.encode()
                if os.write(journal, encoded) != len(encoded):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
            finally:
                os.close(journal)

    def read(self) -> list[dict[str, Any]]:
        """The entries in the order written; damaged and truncated lines are skipped.

        Raises:
            StorageError: the journal cannot be read.
        """
        return [entry for _, _, entry in self._lines() if entry is not None]

    def set_damage_aside(self) -> list[str]:
        """Move damaged and truncated lines to a file of their own; the lock must be held.

        Returns:
            A sentence for each such line.

        Raises:
            StorageError: the journal cannot be read or written.
        """
        lines = self._lines()
        bad = [(number, line) for number, line, entry in lines if entry is None]
        if not bad:
            return []
        aside = self._path.with_name("damaged-tasks.txt")
        before = aside.read_bytes() if aside.is_file() and not aside.is_symlink() else b""
        for path, content in (
            (aside, before + b"".join(line + b"\n" for _, line in bad)),
            (self._path, b"".join(line + b"\n" for _, line, entry in lines if entry is not None)),
        ):
            with atomic_write(path) as temporary:
                temporary.write_bytes(content)
        return [
            f"{self._path.name}: line {number} is damaged or cut short; it was moved to {aside.name}, "
            "and its attempt is missing from the statistics"
            for number, _ in bad
        ]

    def _lines(self) -> list[tuple[int, bytes, dict[str, Any] | None]]:
        """Number, text and content of each line; without content if it is damaged."""
        try:
            lines = self._path.read_bytes().split(b"\n")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StorageError(
                f"{self._path}: cannot be read ({error.strerror}); move it away or make it a readable file, "
                "then run the same command again"
            ) from error
        return [(number, line, _parse_line(line)) for number, line in enumerate(lines, 1) if line]


def _parse_line(line: bytes) -> dict[str, Any] | None:
    """An entry of the journal; None if it is damaged. Lines of older versions have no checksum."""
    try:
        entry = checksum.parse(line, required=False)
    except ValueError:
        return None
    return entry if checksum.KEY.encode() in line or entry.keys() >= _OF_AN_ATTEMPT else None
