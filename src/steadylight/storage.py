"""The run directory: names of files, writing that leaves whole files or none, and what is done already.

What is on disk and valid is the only truth about a render. Hence three rules: a file under its final name is
complete and was read back (`atomic_write`); one command at a time works on a directory (a lock that ends
with its process); and a task is done when all its outputs are there and valid (`RunDirectory.pending`).
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

from steadylight.atomic_file import TEMPORARY, Validator, atomic_write, storage_errors, write_json
from steadylight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["RunDirectory", "Validator", "Work", "atomic_write", "write_json"]

_log = logging.getLogger(__name__)


class Work(Protocol):
    """What storage needs to know of a task: its name, and its outputs relative to the run directory."""

    @property
    def key(self) -> str:
        """Name of the task."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Paths relative to the run directory."""


AnyWork = TypeVar("AnyWork", bound=Work)


class RunDirectory:
    """Everything that one render wrote: names, creation, lock, journal, results, and what is done.

    Making the object touches nothing on disk. A command that writes calls `open_or_create` first and
    `close` at the end (or uses `with`); workers and readers need neither.

    Attributes:
        root: the folder, as given.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self._lock: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Names ------------------------------------------------------------------------------------------------

    @property
    def run_file(self) -> Path:
        """`run.json`: all that decides the bytes of the frames."""
        return self.root / "run.json"

    @property
    def stats_file(self) -> Path:
        """`stats.json`: what happened."""
        return self.root / "stats.json"

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
    def lock_file(self) -> Path:
        """`log/lock`: held by the command that works here; names its host and process."""
        return self.root / "log" / "lock"

    @staticmethod
    def frame_name(number: int) -> str:
        """Name of a frame relative to the run directory, `frames/frame_00001.exr` for number 1."""
        return f"frames/frame_{number:05d}.exr"

    def frame(self, number: int) -> Path:
        """Path of frame `number`, counted from 1."""
        return self.root / self.frame_name(number)

    @staticmethod
    def cache_name(name: str) -> str:
        """Name of a renderer's file relative to the run directory, `cache/<name>`."""
        return f"cache/{name}"

    @staticmethod
    def result_name(key: str) -> str:
        """Name of a task's result relative to the run directory; the last of the outputs to be written."""
        return f"log/results/{key}.json"

    # Opening ----------------------------------------------------------------------------------------------

    def open_or_create(self, record: Mapping[str, Any], about: Mapping[str, Any] | None = None) -> bool:
        """Take the directory for this command: a new one is written, one of the same record is resumed.

        Args:
            record: all that decides the bytes; plain data (JSON).
            about: kept in `run.json` under `about` and never compared (host, time of start); plain data.

        Returns:
            Whether there was a run to resume.

        Raises:
            SettingsError: the folder is no run directory, was started with another record, or is in use by
                another command; nothing was written.
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
            # Another command may have created the run between the first look and the lock.
            resumed = self._check(wanted)
            self.sweep()
            if not resumed:
                write_json(self.run_file, wanted | ({"about": dict(about)} if about else {}))
        except BaseException:
            self._release_lock()
            if made:
                _remove_new(made, self.lock_file)
            raise
        return resumed

    def read_record(self) -> dict[str, Any]:
        """What `run.json` says.

        Raises:
            SettingsError: the folder is no run directory, or its `run.json` cannot be read.
        """
        try:
            record = json.loads(self.run_file.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            raise SettingsError(
                f"{self.root}: not a run directory: there is no run.json in it; "
                "give a folder that `steadylight render --output` wrote"
            ) from None
        except (OSError, ValueError) as error:
            raise SettingsError(
                f"{self.run_file}: cannot be read ({error}); restore it, or choose another output"
            ) from error
        if not isinstance(record, dict):
            raise SettingsError(
                f"{self.run_file}: must hold a JSON object; restore it, or choose another output"
            )
        return record

    def close(self) -> None:
        """Remove what interrupted attempts left, and give the directory free; harmless when not open."""
        if self._lock is not None:
            with suppress(OSError):
                self.sweep()
            self._release_lock()

    def sweep(self) -> list[Path]:
        """Remove temporary files of attempts that were killed; returns what was removed.

        A worker that is cut off but still writes loses its temporary file, so that its attempt fails
        instead of replacing something later.
        """
        leftovers = [path for path in self.root.rglob(".partial-*") if TEMPORARY.fullmatch(path.name)]
        for path in leftovers:
            path.unlink(missing_ok=True)
        return leftovers

    def _check(self, wanted: Mapping[str, Any]) -> bool:
        """Whether there is a run to resume; raises if the folder is something else."""
        if not self.root.exists():
            return False
        if not self.root.is_dir():
            raise SettingsError(
                f"{self.root}: is a file; the output must be a folder, new or of the same run"
            )
        if not self.run_file.exists():
            self._check_fresh()
            return False
        found = self.read_record()
        found.pop("about", None)
        differences = _differences(found, wanted)
        if differences:
            raise SettingsError(
                f"{self.root}: was started with other settings:\n"
                + "\n".join(f"  {line}" for line in differences)
                + "\nGive the same settings to go on with it, or choose another output."
            )
        return True

    def _check_fresh(self) -> None:
        """Without run.json a folder may hold only what a start that was cut off leaves."""
        ours = {"frames", "cache", "log", "log/results", "log/lock"}
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root).as_posix()
            if name not in ours and not TEMPORARY.fullmatch(path.name):
                raise SettingsError(
                    f"{self.root}: not a run directory: it holds {name} but no run.json; "
                    "nothing was written; choose a new or empty folder"
                )

    # The lock ---------------------------------------------------------------------------------------------

    def _take_lock(self) -> None:
        if self._lock is not None:
            return
        with storage_errors(self.lock_file):
            lock = os.open(self.lock_file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in {errno.EWOULDBLOCK, errno.EACCES}:
                holder = os.read(lock, 1000).decode(errors="replace").strip() or "an unnamed process"
                os.close(lock)
                raise SettingsError(
                    f"{self.root}: another steadylight command is at work here ({holder}); "
                    "wait for it, stop it, or choose another output"
                ) from None
            # Some cluster file systems have no locks at all; refusing to work there would help nobody.
            _log.warning("%s: the file system has no locks (%s); start one command only", self.root, error)
        self._lock = lock
        # The content only tells people who holds the lock: it may be missing on a full disk.
        with suppress(OSError):
            os.ftruncate(lock, 0)
            os.pwrite(lock, f"host {socket.gethostname()}, process {os.getpid()}\n".encode(), 0)

    def _release_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    # Journal and results ----------------------------------------------------------------------------------

    def append_journal(self, entry: Mapping[str, Any]) -> None:
        """Add one line to the journal, with `time` (seconds since 1970) if the entry has none.

        One write per line, so that lines of a killed command are whole but for the last one.
        """
        line = json.dumps({"time": round(time.time(), 3), **entry}) + "\n"
        with storage_errors(self.journal_file):
            journal = os.open(self.journal_file, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
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
        """The journal's entries in the order written; lines cut short by a kill are left out."""
        try:
            text = self.journal_file.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return []
        entries = []
        for line in text.splitlines():
            with suppress(ValueError):
                entry = json.loads(line)
                if isinstance(entry, dict):
                    entries.append(entry)
        return entries

    def write_result(self, key: str, result: Mapping[str, Any], outputs: Sequence[str] = ()) -> None:
        """Store what a task returned; call it after the task's other outputs are written.

        Args:
            key: of the task.
            result: plain data.
            outputs: of the task, all written; their hashes are stored too, so that a bit that flips later is found
                even where a format has no checksum.
        """
        files = [name for name in outputs if name != self.result_name(key)]
        content = {**result, _HASHES: {name: file_hash(self.root / name) for name in files}}
        write_json(self.root / self.result_name(key), {**content, _OWN_HASH: _hash_of(content)})

    def read_result(self, key: str) -> dict[str, Any]:
        """What a finished task returned.

        Raises:
            StorageError: there is no (readable) result of that task.
        """
        path = self.root / self.result_name(key)
        try:
            result = _parse_result(path)
        except (OSError, ValueError) as error:
            raise StorageError(
                f"{path}: the result of {key} cannot be read ({error}); run the same command again"
            ) from error
        return {name: value for name, value in result.items() if name not in {_HASHES, _OWN_HASH}}

    # What is done -----------------------------------------------------------------------------------------

    def is_done(self, task: Work, validators: Mapping[str, Validator]) -> tuple[bool, list[str]]:
        """Whether all outputs of a task are there and valid, and what is wrong with those that are not.

        Args:
            task: the task in question.
            validators: by suffix (`.exr`); `.json` is known here. A suffix without one: any bytes will do.

        Returns:
            Done or not, and a sentence for each output that exists but is not valid.
        """
        missing = False
        faults = []
        hashes = self._hashes(task.key)
        for name in task.outputs:
            path = self.root / name
            if not path.is_file():
                missing = True
                continue
            reason = _fault(path, {".json": _parse_result, **validators})
            if not reason and name in hashes and file_hash(path) != hashes[name]:
                reason = "it is not what was written: its hash differs"
            if reason:
                faults.append(f"{path.name} is not valid ({reason}): {task.key} is run again")
        return not (missing or faults), faults

    def _hashes(self, key: str) -> dict[str, str]:
        """Hashes of a task's outputs as it noted them; none if its result cannot be read."""
        try:
            hashes = _parse_result(self.root / self.result_name(key)).get(_HASHES, {})
        except (OSError, ValueError):
            return {}
        return dict(hashes)

    def pending(
        self, tasks: Sequence[AnyWork], validators: Mapping[str, Validator], threads: int | None = None
    ) -> tuple[list[AnyWork], list[str]]:
        """The tasks that are not done, in their order, and a sentence for each output that is not valid.

        Args:
            tasks: the plan.
            validators: as for `is_done`; called from several threads at once.
            threads: how many files are looked at at a time; by default as suits the machine.

        What is not valid is removed if this command holds the directory, since whatever has a final name counts
        as somebody's finished work.
        """
        threads = threads or min(16, 2 * (os.cpu_count() or 1))
        with ThreadPoolExecutor(threads) as pool:
            verdicts = list(pool.map(lambda task: self.is_done(task, validators), tasks))
        waiting = [task for task, (done, _) in zip(tasks, verdicts, strict=True) if not done]
        if self._lock is not None:
            for task, (_, faults) in zip(tasks, verdicts, strict=True):
                for name in task.outputs if faults else ():
                    with storage_errors(self.root / name):
                        (self.root / name).unlink(missing_ok=True)
        return waiting, [fault for _, faults in verdicts for fault in faults]


# Making and undoing ---------------------------------------------------------------------------------------


def _make_folder(folder: Path, made: list[Path]) -> None:
    """Make a folder and its parents; those that are new are added to `made`, outermost first."""
    for path in [*reversed(folder.parents), folder]:
        if not path.exists():
            path.mkdir(exist_ok=True)
            made.append(path)


def _remove_new(made: Sequence[Path], lock_file: Path) -> None:
    """Undo a start that failed: only folders that it made itself and that are still empty."""
    if lock_file.parent in made:
        with suppress(OSError):
            lock_file.unlink(missing_ok=True)
    for folder in reversed(made):
        with suppress(OSError):
            folder.rmdir()


# Comparing and checking -----------------------------------------------------------------------------------

_ABSENT = object()


def _differences(found: Any, wanted: Any, place: str = "") -> list[str]:
    """A line for each entry that differs, by its dotted place in the record."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        keys = [*found, *(key for key in wanted if key not in found)]
        return [
            line
            for key in keys
            for line in _differences(
                found.get(key, _ABSENT), wanted.get(key, _ABSENT), f"{place}.{key}" if place else str(key)
            )
        ]
    # NaN is no setting, so equality of the parsed JSON is equality of the records.
    return [] if found == wanted else [f"{place}: {_shown(found)} then, {_shown(wanted)} now"]


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
    except Exception as error:  # noqa: BLE001 - whatever a reader says of a file, the file is not valid
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return ""


_HASHES, _OWN_HASH = "outputs", "sha256"
"""Keys of a result file that are ours, not the task's."""


def _parse_result(path: Path) -> dict[str, Any]:
    """A result file.

    Raises:
        ValueError: it is no JSON object, or is not what was written.
    """
    result = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(result, dict):
        raise ValueError("it holds no JSON object")  # noqa: TRY004 - the value is wrong, not the program
    if _OWN_HASH in result and result[_OWN_HASH] != _hash_of(
        {k: v for k, v in result.items() if k != _OWN_HASH}
    ):
        raise ValueError("its hash differs from what was written")
    return result


def _hash_of(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
