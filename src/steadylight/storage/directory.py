"""A run directory on this machine: opening it, which tasks are done, and what belongs to one command at a time."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self, TypeVar

from steadylight import checksum
from steadylight.atomic_file import TEMPORARY, storage_errors, write_json
from steadylight.errors import SettingsError
from steadylight.storage import results
from steadylight.storage.journal import Journal
from steadylight.storage.lock import Lock
from steadylight.storage.names import RunFiles
from steadylight.storage.results import Work

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from steadylight.atomic_file import Validator

_FORMATS_WITHOUT_CHECKSUM = (1, 2)
"""Older formats of `run.json`."""

_FOLDERS = ("", "frames", "cache", "log", "log/results")
"""Folders that every run has."""

AnyWork = TypeVar("AnyWork", bound=Work)


class RunDirectory(RunFiles):
    """The files of one render: creation, lock, journal, results, and which tasks are done.

    Creating the object touches nothing on disk. A command that writes calls `open_or_create` first and
    `close` at the end (or uses `with`); workers and readers need neither.

    Attributes:
        root: the folder, as given.
    """

    def __init__(self, root: Path | str) -> None:
        super().__init__(root)
        self._lock = Lock(self.lock_file, self.root)
        self._journal = Journal(self.journal_file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Opening ----------------------------------------------------------------------------------------------

    def open_or_create(self, record: Mapping[str, Any]) -> bool:
        """Take the directory for this command: create it, or resume a run with the same record.

        Args:
            record: everything that determines the bytes; plain data (JSON).

        Returns:
            Whether there was a run to resume.

        Raises:
            SettingsError: the folder is not a run directory, was started with a different record, or is in use
                by another command; nothing was written.
            StorageError: the folder cannot be written; nothing new is left behind.
        """
        wanted = json.loads(json.dumps(record))
        self._check(wanted)
        made: list[Path] = []
        try:
            with storage_errors(self.root):
                for folder in _FOLDERS:
                    _make_folder(self.root / folder, made)
            self._lock.take()
            # Another command may have created the run between the first check and the lock.
            resumed = self._check(wanted)
            self.sweep()
            if not resumed:
                write_json(self.run_file, checksum.with_checksum(wanted))
        except BaseException:
            self._undo(made)
            raise
        return resumed

    def take(self, *, shared: bool = False) -> None:
        """Take an existing run for this command: alone, or together with others that share it.

        Raises:
            SettingsError: the folder is not a run directory, or is in use by another command.
            StorageError: the lock cannot be written.
        """
        self.read_record()
        self._lock.take(shared=shared)
        if not shared:
            self.sweep()

    def read_record(self) -> dict[str, Any]:
        """The content of `run.json`.

        Raises:
            SettingsError: the folder is not a run directory, or its `run.json` cannot be read or is damaged.
        """
        try:
            text = self.run_file.read_bytes()
            record = checksum.parse(text, required=False)
            if record.get("format") not in _FORMATS_WITHOUT_CHECKSUM:
                checksum.parse(text)
        except (FileNotFoundError, NotADirectoryError):
            raise SettingsError(
                f"{self.root}: not a run directory: it has no run.json; "
                "give a folder written by `steadylight render --output`"
            ) from None
        except (OSError, ValueError) as error:
            raise SettingsError(
                f"{self.run_file}: cannot be read ({error}); restore it from a copy, or choose another output"
            ) from error

        return record

    def close(self) -> None:
        """Remove leftovers of interrupted attempts and release the directory; harmless if not open."""
        if self._lock.held and not self._lock.shared:  # others may be writing
            with suppress(OSError):
                self.sweep()
        self._lock.release()

    def sweep(self) -> list[Path]:
        """Remove temporary files of killed attempts; returns what was removed.

        A disconnected worker that is still writing loses its temporary file, so that its attempt fails
        instead of replacing a file later.
        """
        leftovers = [path for path in self.root.rglob(".partial-*") if TEMPORARY.fullmatch(path.name)]
        for path in leftovers:
            path.unlink(missing_ok=True)
        return leftovers

    def check_free(self) -> None:
        """Check that a new run may start here: the folder may hold only leftovers of an interrupted start.

        Raises:
            SettingsError: this is a file, or a folder with other content.
        """
        if not self.root.exists():
            return
        if not self.root.is_dir():
            raise SettingsError(
                f"{self.root}: is a file; the output must be a new folder or that of the same run"
            )
        ours = {*_FOLDERS, "aovs", "log/lock"}
        waiting = [self.root]
        while waiting:  # one folder at a time: walking through a whole home directory would take long
            for path in _entries(waiting.pop()):
                name = path.relative_to(self.root).as_posix()
                if name not in ours and not TEMPORARY.fullmatch(path.name):
                    raise SettingsError(
                        f"{self.root}: not a run directory: it contains {name} but no run.json; "
                        "nothing was written; choose a new or empty folder"
                    )
                if path.is_dir() and not path.is_symlink():
                    waiting.append(path)

    def check_lock(self) -> None:
        """Check that this command still has the directory for itself; harmless if it is not open.

        Raises:
            StorageError: the lock file was removed or replaced, so that another command may be working here.
        """
        self._lock.check()

    def _check(self, wanted: Mapping[str, Any]) -> bool:
        """Whether there is a run to resume; raises if the folder is something else."""
        if not self.run_file.exists():
            self.check_free()
            return False
        differences = _differences(self.read_record(), wanted)
        if differences:
            raise SettingsError(
                f"{self.root}: was started with different settings:\n"
                + "\n".join(f"  {line}" for line in differences)
                + "\nUse the same settings to resume it, or choose another output."
            )
        return True

    def _undo(self, made: Sequence[Path]) -> None:
        """Undo a failed start: remove only folders that it made itself and that are still empty.

        Where another command took the lock first, nothing is removed: it may be using these folders.
        """
        if self._lock.held and self.lock_file.parent in made:
            self._lock.remove()
        if self._lock.held or not self.lock_file.exists():
            for folder in reversed(made):
                with suppress(OSError):
                    folder.rmdir()
        self._lock.release()

    # Journal and results ----------------------------------------------------------------------------------

    def append_journal(self, entry: Mapping[str, Any]) -> None:
        """Add one line to the journal, with `time` (seconds since 1970) if the entry has none, and its checksum.

        Raises:
            StorageError: the journal cannot be written, or the directory's lock is gone.
        """
        self._lock.check()
        self._journal.append(entry)

    def read_journal(self) -> list[dict[str, Any]]:
        """The journal's entries in the order written; damaged and truncated lines are skipped.

        Raises:
            StorageError: the journal cannot be read.
        """
        return self._journal.read()

    def set_journal_damage_aside(self) -> list[str]:
        """Move damaged and truncated lines of the journal to a file of their own; the lock must be held.

        Returns:
            A sentence for each such line.

        Raises:
            StorageError: the journal cannot be read or written.
        """
        return self._journal.set_damage_aside()

    def write_result(self, key: str, result: Mapping[str, Any], outputs: Sequence[str] = ()) -> None:
        """Store what a task returned; call this after the task's other outputs are written.

        Args:
            key: key of the task.
            result: plain data.
            outputs: outputs of the task, all written. Their hashes are stored too, so that later corruption is detected
                even in formats without a checksum.
        """
        results.write_result(self, key, result, outputs)

    def read_result(self, key: str) -> dict[str, Any]:
        """What a finished task returned.

        Raises:
            StorageError: there is no (readable) result of that task.
        """
        return results.read_result(self, key)

    # Which tasks are done -----------------------------------------------------------------------------------------

    def is_done(self, task: Work, validators: Mapping[str, Validator]) -> tuple[bool, list[str]]:
        """Whether all outputs of a task exist and are valid, and what is wrong with invalid ones.

        Args:
            task: the task in question.
            validators: by suffix (`.exr`); `.json` is built in. Without one, any non-empty file is valid.

        Returns:
            Whether it is done, and a sentence for each output that exists but is not valid.
        """
        missing, faults = results.faults_of(self, task, validators)
        return not (missing or faults), faults

    def remove_outputs(self, task: Work) -> None:
        """Remove all outputs of a task, so that it is done again.

        Raises:
            StorageError: one of them cannot be removed.
        """
        for name in task.outputs:
            with storage_errors(self.root / name):
                (self.root / name).unlink(missing_ok=True)

    def pending(
        self, tasks: Sequence[AnyWork], validators: Mapping[str, Validator], threads: int | None = None
    ) -> tuple[list[AnyWork], list[str]]:
        """The tasks that are not done, in order, and a sentence for each invalid output.

        Args:
            tasks: the plan.
            validators: as for `is_done`; called from several threads at once.
            threads: number of files checked at a time; by default chosen for the machine.

        If this command holds the lock, all outputs of the returned tasks are removed: an invalid file under its final
        name would count as finished, and a file without its task's result may belong to another task.
        """
        threads = threads or min(16, 2 * (os.cpu_count() or 1))
        with ThreadPoolExecutor(threads) as pool:
            verdicts = list(pool.map(lambda task: self.is_done(task, validators), tasks))
        waiting = [task for task, (done, _) in zip(tasks, verdicts, strict=True) if not done]
        if self._lock.held:
            for task in waiting:
                self.remove_outputs(task)
        return waiting, [fault for _, faults in verdicts for fault in faults]


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, by name."""
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise SettingsError(
            f"{folder}: cannot be read: {(error.strerror or str(error)).lower()}; choose another output"
        ) from error


def _make_folder(folder: Path, made: list[Path]) -> None:
    """Make a folder and its parents; new ones are added to `made`, outermost first."""
    for path in [*reversed(folder.parents), folder]:
        if not path.exists():
            path.mkdir(exist_ok=True)
            made.append(path)


_ABSENT = object()


def _differences(found: Any, wanted: Any, place: str = "") -> list[str]:
    """A line for each entry that differs, with its dotted path in the record."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        keys = [*found, *(key for key in wanted if key not in found)]
        return [
            line
            for key in keys
            for line in _differences(
                found.get(key, _ABSENT), wanted.get(key, _ABSENT), f"{place}.{key}" if place else str(key)
            )
        ]
    # Records contain no NaN, so they are equal exactly if their parsed JSON is.
    return [] if found == wanted else [f"{place}: was {_shown(found)}, is now {_shown(wanted)}"]


def _shown(value: object) -> str:
    if value is _ABSENT:
        return "not set"
    text = json.dumps(value)
    if len(text) <= 70:
        return text
    size = f" ({len(value)} entries)" if isinstance(value, list) else ""
    return f"{text[:40]} ... {text[-20:]}{size}"
