"""Notes of attempts by a render farm, before they are moved to the journal."""

from __future__ import annotations

import json
import secrets
import time
from typing import TYPE_CHECKING, Any

from steadylight.animation.sessions import SessionLog, set_aside
from steadylight.animation.statistics import journal_entry
from steadylight.atomic_file import storage_errors, write_json
from steadylight.checksum import parse, with_checksum
from steadylight.errors import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from steadylight.engines import Attempt
    from steadylight.storage import RunDirectory


def leave_note(directory: RunDirectory, attempt: Attempt) -> None:
    """Record an attempt in a file of its own: many machines cannot safely append to one journal.

    Raises:
        StorageError: the directory cannot be written.
    """
    _refuse_link(directory)
    with storage_errors(directory.notes):
        directory.notes.mkdir(parents=True, exist_ok=True)
    entry = {"time": round(time.time(), 3), **journal_entry(attempt)}
    write_json(
        directory.notes / f"{attempt.task.key}.{secrets.token_hex(6)}.json", with_checksum(_plain(entry))
    )


def gather_notes(directory: RunDirectory) -> list[str]:
    """Move the notes of all attempts to the journal, as one session; the lock must be held.

    Returns:
        A sentence for each damaged note, which is set aside.

    Raises:
        StorageError: the directory cannot be written.
    """
    _refuse_link(directory)
    entries: dict[str, dict[str, Any]] = {}
    faults = []
    paths = sorted(directory.notes.glob("[!.]*.json"))
    for path in paths:
        try:
            entry = parse(path.read_bytes())
            float(entry["time"]), float(entry["seconds"])
            entries[path.stem] = entry
        except (OSError, ValueError, KeyError, TypeError):
            faults.append(set_aside(path, path.name, "attempt"))
    # An earlier command may have been killed after it wrote the journal and before it removed the notes.
    known = {line.get("note") for line in directory.read_journal()}
    new = sorted((entry | {"note": stem} for stem, entry in entries.items() if stem not in known), key=_end)
    for entry in new:
        directory.append_journal(entry)
    if new:
        SessionLog.add(directory.root, new)
    for stem in entries:
        with storage_errors(directory.notes):
            (directory.notes / f"{stem}.json").unlink(missing_ok=True)
    return faults


def _refuse_link(directory: RunDirectory) -> None:
    """Refuse to rename or remove files through a link: a run directory from elsewhere may have one anywhere."""
    if directory.notes.is_symlink():
        raise StorageError(
            f"{directory.notes}: is a symbolic link; remove it, then run the same command again"
        )


def _end(entry: Mapping[str, Any]) -> float:
    return float(entry["time"])


def _plain(entry: Mapping[str, Any]) -> dict[str, Any]:
    return dict(json.loads(json.dumps(entry)))
