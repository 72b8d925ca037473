"""The run directory: file names, atomic writes, and which tasks are done.

Valid files on disk are the only state of a render. Hence three rules. A file under its final name is complete and was
read back (`atomic_write`). Only one command at a time works on a directory (a lock that ends with its process). A task
is done when all its outputs exist and are valid (`RunDirectory.pending`).
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from steadylight import checksum
from steadylight.atomic_file import TEMPORARY, Validator, atomic_write, storage_errors, write_json
from steadylight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["RunDirectory", "Validator", "Work", "atomic_write", "write_json"]

_log = logging.getLogger(__name__)

_FORMATS_WITHOUT_CHECKSUM = (1, 2)
"""Older formats of `run.json`."""


class Work(Protocol):
    """What storage needs to know about a task: its name, and its outputs relative to the run directory."""

    @property
    def key(self) -> str:
        """Name of the task."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Paths relative to the run directory."""


AnyWork = TypeVar("AnyWork", bound=Work)


class RunDirectory:
    """The files of one render: names, creation, lock, journal, results, and which tasks are done.

    Creating the object touches nothing on disk. A command that writes calls `open_or_create` first and
    `close` at the end (or uses `with`); workers and readers need neither.

    Attributes:
        root: the folder, as given.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self._lock: int | None = None
        self._shared = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Names ------------------------------------------------------------------------------------------------

    @property
    def run_file(self) -> Path:
        """`run.json`: everything that determines the bytes of the frames."""
        return self.root / "run.json"

    @property
    def stats_file(self) -> Path:
        """`stats.json`: statistics of the run."""
        return self.root / "stats.json"

    @property
    def display_file(self) -> Path:
        """`display.json`: how video and pictures are made of the frames."""
        return self.root / "display.json"

    @property
    def pictures(self) -> Path:
        """`pictures/`: 8-bit pictures of the frames, if they were asked for."""
        return self.root / "pictures"

    def picture(self, number: int) -> Path:
        """Path of the picture of frame `number`."""
        return self.pictures / f"frame_{number:05d}.png"

    @property
    def video_file(self) -> Path:
        """`animation.mp4`."""
        return self.root / "animation.mp4"

    @property
    def report_file(self) -> Path:
        """`report.html`."""
        return self.root / "report.html"

    @property
    def journal_file(self) -> Path:
        """`log/tasks.jsonl`: one line for each task attempt."""
        return self.root / "log" / "tasks.jsonl"

    @property
    def notes(self) -> Path:
        """`log/performed/`: a file for each attempt of `steadylight perform` that is not in the journal yet."""
        return self.root / "log" / "performed"

    @property
    def lock_file(self) -> Path:
        """`log/lock`: held by the command that uses the directory; names its host and process."""
        return self.root / "log" / "lock"

    @staticmethod
    def frame_name(number: int) -> str:
        """Name of a frame relative to the run directory, `frames/frame_00001.exr` for number 1."""
        return f"frames/frame_{number:05d}.exr"

    def frame(self, number: int) -> Path:
        """Path of frame `number`, counted from 1."""
        return self.root / self.frame_name(number)

    @staticmethod
    def aovs_name(number: int) -> str:
        """Name of what the pixels of a frame see, relative to the run directory, `aovs/frame_00001.exr`."""
        return f"aovs/frame_{number:05d}.exr"

    @staticmethod
    def cache_name(name: str) -> str:
        """Name of a renderer's file relative to the run directory, `cache/<name>`."""
        return f"cache/{name}"

    @staticmethod
    def result_name(key: str) -> str:
        """Name of a task's result relative to the run directory; always written last."""
        return f"log/results/{key}.json"

    # Opening ----------------------------------------------------------------------------------------------

    def open_or_create(self, record: Mapping[str, Any], about: Mapping[str, Any] | None = None) -> bool:
        """Take the directory for this command: create it, or resume a run with the same record.

        Args:
            record: everything that determines the bytes; plain data (JSON).
            about: stored in `run.json` under `about` and never compared (host, start time); plain data.

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
                for folder in ("", "frames", "cache", "log", "log/results"):
                    _make_folder(self.root / folder, made)
            self._take_lock()
            # Another command may have created the run between the first check and the lock.
            resumed = self._check(wanted)
            self.sweep()
            if not resumed:
                content = wanted | ({"about": dict(about)} if about else {})
                write_json(self.run_file, checksum.with_checksum(content))
        except BaseException:
            self._release_lock()
            if made:
                _remove_new(made, self.lock_file)
            raise
        return resumed

    def take(self, *, shared: bool = False) -> None:
        """Take an existing run for this command: alone, or together with others that share it.

        Raises:
            SettingsError: the folder is not a run directory, or is in use by another command.
            StorageError: the lock cannot be written.
        """
        self.read_record()
        self._take_lock(shared=shared)
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
        if self._lock is not None:
            if not self._shared:  # others may be writing
                with suppress(OSError):
                    self.sweep()
            self._release_lock()

    def sweep(self) -> list[Path]:
        """Remove temporary files of killed attempts; returns what was removed.

        A disconnected worker that is still writing loses its temporary file, so that its attempt fails
        instead of replacing a file later.
        """
        leftovers = [path for path in self.root.rglob(".partial-*") if TEMPORARY.fullmatch(path.name)]
        for path in leftovers:
            path.unlink(missing_ok=True)
        return leftovers

    def _check(self, wanted: Mapping[str, Any]) -> bool:
        """Whether there is a run to resume; raises if the folder is something else."""
        if not self.run_file.exists():
            self.check_free()
            return False
        found = self.read_record()
        found.pop("about", None)
        differences = _differences(found, wanted)
        if differences:
            raise SettingsError(
                f"{self.root}: was started with different settings:\n"
                + "\n".join(f"  {line}" for line in differences)
                + "\nUse the same settings to resume it, or choose another output."
            )
        return True

    def check_free(self) -> None:
        """Check that a new run may begin here: without run.json, only what an interrupted start leaves may be here.

        Raises:
            SettingsError: this is a file, or a folder of something else.
        """
        if not self.root.exists():
            return
        if not self.root.is_dir():
            raise SettingsError(
                f"{self.root}: is a file; the output must be a new folder or that of the same run"
            )
        ours = {"frames", "cache", "log", "log/results", "log/lock"}
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root).as_posix()
            if name not in ours and not TEMPORARY.fullmatch(path.name):
                raise SettingsError(
                    f"{self.root}: not a run directory: it contains {name} but no run.json; "
                    "nothing was written; choose a new or empty folder"
                )

    # The lock ---------------------------------------------------------------------------------------------

    def _take_lock(self, *, shared: bool = False) -> None:
        if self._lock is not None:
            return
        with storage_errors(self.lock_file):
            # Not through a link: a run directory from elsewhere may have one in place of any file.
            lock = os.open(self.lock_file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in {errno.EWOULDBLOCK, errno.EACCES}:
                holder = os.read(lock, 1000).decode(errors="replace").strip() or "an unnamed process"
                os.close(lock)
                raise SettingsError(
                    f"{self.root}: another steadylight command is using this run directory ({holder}); "
                    "wait for it, stop it, or choose another output"
                ) from None
            # Some cluster file systems do not support locks; refusing to run there would help nobody.
            _log.warning(
                "%s: the file system does not support locks (%s); run only one command at a time",
                self.root,
                error,
            )
        self._lock, self._shared = lock, shared
        # The content only names the holder in error messages; it may be missing on a full disk.
        with suppress(OSError):
            os.ftruncate(lock, 0)
            os.pwrite(lock, f"host {socket.gethostname()}, process {os.getpid()}\n".encode(), 0)

    def check_lock(self) -> None:
        """Check that this command still has the directory for itself; harmless if it is not open.

        Raises:
            StorageError: the lock file was removed or replaced, so that another command may be working here.
        """
        if self._lock is None:
            return
        held = os.fstat(self._lock)
        with suppress(OSError):
            there = self.lock_file.lstat()
            if (there.st_dev, there.st_ino) == (held.st_dev, held.st_ino):
                return
        raise StorageError(
            f"{self.lock_file}: was removed or replaced while this command was working, so that another one may "
            "work here at the same time; leave the file alone, and run the same command again when no other is working"
        )

    def _release_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    # Journal and results ----------------------------------------------------------------------------------

    def append_journal(self, entry: Mapping[str, Any]) -> None:
        """Add one line to the journal, with `time` (seconds since 1970) if the entry has none, and its checksum.

        One write per line, so that a killed command can only truncate the last one.

        Raises:
            StorageError: the journal cannot be written, or the directory's lock is gone.
        """
        self.check_lock()
        content = {"time": round(time.time(), 3), **entry}
        line = json.dumps(checksum.with_checksum(content)) + "\n"
        with storage_errors(self.journal_file):
            journal = os.open(
                self.journal_file, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666
            )
            try:
                size = os.fstat(journal).st_size
                if size and os.pread(journal, 1, size - 1) != b"\n":
                    line = "\n" + line
                encoded = line.encode()
                if os.write(journal, encoded) != len(encoded):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.journal_file))
            finally:
                os.close(journal)

    def read_journal(self) -> list[dict[str, Any]]:
        """The journal's entries in the order written; damaged and truncated lines are skipped.

        Raises:
            StorageError: the journal cannot be read.
        """
        return [entry for _, _, entry in self._journal_lines() if entry is not None]

    def set_journal_damage_aside(self) -> list[str]:
        """Move damaged and truncated lines of the journal to a file of their own; the lock must be held.

        Returns:
            A sentence for each such line.

        Raises:
            StorageError: the journal cannot be read or written.
        """
        lines = self._journal_lines()
        bad = [(number, line) for number, line, entry in lines if entry is None]
        if not bad:
            return []
        aside = self.journal_file.with_name("damaged-tasks.txt")
        before = aside.read_bytes() if aside.is_file() and not aside.is_symlink() else b""
        for path, content in (
            (aside, before + b"".join(line + b"\n" for _, line in bad)),
            (self.journal_file, b"".join(line + b"\n" for _, line, entry in lines if entry is not None)),
        ):
            with atomic_write(path) as temporary:
                temporary.write_bytes(content)
        return [
            f"{self.journal_file.name}: line {number} is damaged or cut short; it was moved to {aside.name}, "
            "and its attempt is missing from the statistics"
            for number, _ in bad
        ]

    def _journal_lines(self) -> list[tuple[int, bytes, dict[str, Any] | None]]:
        """Number, text and content of each line of the journal; without content if it is damaged."""
        try:
            lines = self.journal_file.read_bytes().split(b"\n")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StorageError(
                f"{self.journal_file}: cannot be read ({error.strerror}); move it away or make it a readable file, "
                "then run the same command again"
            ) from error
        return [(number, line, _parse_line(line)) for number, line in enumerate(lines, 1) if line]

    def write_result(self, key: str, result: Mapping[str, Any], outputs: Sequence[str] = ()) -> None:
        """Store what a task returned; call this after the task's other outputs are written.

        Args:
            key: of the task.
            result: plain data.
            outputs: of the task, all written. Their hashes are stored too, so that later corruption is detected
                even in formats without a checksum.
        """
        files = [name for name in outputs if name != self.result_name(key)]
        content = {**result, _TASK: key, _HASHES: {name: file_hash(self.root / name) for name in files}}
        write_json(self.root / self.result_name(key), checksum.with_checksum(content))

    def read_result(self, key: str) -> dict[str, Any]:
        """What a finished task returned.

        Raises:
            StorageError: there is no (readable) result of that task.
        """
        path = self.root / self.result_name(key)
        try:
            result = _parse_result(path, key)
        except (OSError, ValueError) as error:
            raise StorageError(
                f"{path}: the result of {key} cannot be read ({error}); run the same command again"
            ) from error
        return {name: value for name, value in result.items() if name not in {_TASK, _HASHES}}

    # Which tasks are done -----------------------------------------------------------------------------------------

    def is_done(self, task: Work, validators: Mapping[str, Validator]) -> tuple[bool, list[str]]:
        """Whether all outputs of a task exist and are valid, and what is wrong with invalid ones.

        Args:
            task: the task in question.
            validators: by suffix (`.exr`); `.json` is built in. Without one, any non-empty file is valid.

        Returns:
            Whether it is done, and a sentence for each output that exists but is not valid.
        """
        missing = False
        faults = []
        hashes = self._hashes(task.key)
        readers = {**validators, ".json": lambda path: _parse_result(path, task.key)}
        for name in task.outputs:
            path = self.root / name
            if not path.is_file():
                missing = True
                continue
            reason = _fault(path, readers)
            if not reason and hashes and name != self.result_name(task.key):
                reason = _difference(path, hashes.get(name))
            if reason:
                faults.append(f"{path.name} is not valid ({reason}); task {task.key} will run again")
        return not (missing or faults), faults

    def remove_outputs(self, task: Work) -> None:
        """Remove all outputs of a task, so that it is done anew.

        Raises:
            StorageError: one of them cannot be removed.
        """
        for name in task.outputs:
            with storage_errors(self.root / name):
                (self.root / name).unlink(missing_ok=True)

    def _hashes(self, key: str) -> dict[str, str]:
        """Recorded hashes of a task's outputs; empty if its result cannot be read."""
        try:
            hashes = _parse_result(self.root / self.result_name(key), key).get(_HASHES, {})
        except (OSError, ValueError):
            return {}
        return dict(hashes)

    def pending(
        self, tasks: Sequence[AnyWork], validators: Mapping[str, Validator], threads: int | None = None
    ) -> tuple[list[AnyWork], list[str]]:
        """The tasks that are not done, in order, and a sentence for each invalid output.

        Args:
            tasks: the plan.
            validators: as for `is_done`; called from several threads at once.
            threads: number of files checked at a time; by default chosen for the machine.

        If this command holds the lock, all outputs of these tasks are removed. Invalid ones would count as finished
        under their final names. Nothing vouches for those without a result: they may be another task's.
        """
        threads = threads or min(16, 2 * (os.cpu_count() or 1))
        with ThreadPoolExecutor(threads) as pool:
            verdicts = list(pool.map(lambda task: self.is_done(task, validators), tasks))
        waiting = [task for task, (done, _) in zip(tasks, verdicts, strict=True) if not done]
        if self._lock is not None:
            for task in waiting:
                self.remove_outputs(task)
        return waiting, [fault for _, faults in verdicts for fault in faults]


# Making and undoing ---------------------------------------------------------------------------------------


def _make_folder(folder: Path, made: list[Path]) -> None:
    """Make a folder and its parents; new ones are added to `made`, outermost first."""
    for path in [*reversed(folder.parents), folder]:
        if not path.exists():
            path.mkdir(exist_ok=True)
            made.append(path)


def _remove_new(made: Sequence[Path], lock_file: Path) -> None:
    """Undo a failed start: remove only folders that it made itself and that are still empty."""
    if lock_file.parent in made:
        with suppress(OSError):
            lock_file.unlink(missing_ok=True)
    for folder in reversed(made):
        with suppress(OSError):
            folder.rmdir()


# Comparing and checking -----------------------------------------------------------------------------------

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


def _fault(path: Path, validators: Mapping[str, Validator]) -> str:
    """Why a file is not valid; empty if it is."""
    try:
        validator = validators.get(path.suffix)
        if validator is not None:
            validator(path)
        elif path.stat().st_size == 0:
            return "it is empty"
    except Exception as error:  # noqa: BLE001 - any reader error means invalid
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return ""


_OF_AN_ATTEMPT = {"time", "task", "stage", "outcome", "seconds"}


def _parse_line(line: bytes) -> dict[str, Any] | None:
    """An entry of the journal; None if it is damaged. Lines of older versions have no checksum."""
    try:
        entry = checksum.parse(line, required=False)
    except ValueError:
        return None
    return entry if checksum.KEY.encode() in line or entry.keys() >= _OF_AN_ATTEMPT else None


_TASK, _HASHES = "task", "outputs"
"""Keys of a result file that storage adds to those of the task."""


def _difference(path: Path, recorded: str | None) -> str:
    """In which way a file is not the recorded one; empty if it is."""
    if recorded is None:
        return "it belongs to another task than its result"
    return "" if file_hash(path) == recorded else "its hash does not match the recorded one"


def _parse_result(path: Path, key: str) -> dict[str, Any]:
    """A result file.

    Raises:
        ValueError: it is damaged, or belongs to another task.
    """
    result = checksum.parse(path.read_bytes())
    if result.get(_TASK, key) != key:
        raise ValueError(f"it is the result of task {result[_TASK]}")
    return result


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
