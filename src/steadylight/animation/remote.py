"""A run directory at a URL (s3://, gs://, sftp://, ...), for machines that share no file system.

The store holds the run. This command and every worker have a copy of what they need of it: a worker fetches what
its task reads, works in its copy, and stores what the task wrote, the result last. So all that is true of a run
directory (whole files, hashes, the first valid file stays) is true of the copies, and a task is done when its
result is in the store.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import fsspec

from steadylight.animation.plan import SCENE_FILE
from steadylight.errors import SettingsError, SteadylightError, StorageError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from steadylight.engines import Task

_LEASE: Final = "log/lock"
_LEASE_LASTS: Final = 120.0
_SECONDS_BETWEEN_SIGNS: Final = 30.0
_OBJECT_STORES: Final = {"s3", "s3a", "gs", "gcs", "abfs", "az", "adl", "oss", "memory"}
_OURS: Final = ("run.json", SCENE_FILE)


def is_url(output: object) -> bool:
    """Whether an output is at a URL and no path."""
    return isinstance(output, str) and "://" in output


def copy_of(url: str) -> Path:
    """Where this user keeps the copy of a run at a URL, on this machine.

    Raises:
        SettingsError: somebody else may write there. The scene is a pickle, which can hold any code.
    """
    name = hashlib.sha256(url.rstrip("/").encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"steadylight-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o022:
        raise SettingsError(
            f"{folder}: must be a folder that is yours and that nobody else may write to, since copies of runs are "
            "kept there; remove it, or set TMPDIR to another place"
        )
    return folder / name


class Store:
    """The files of a run at a URL, and a copy of some of them in a folder."""

    def __init__(self, url: str, copy: Path) -> None:
        """Connect.

        Args:
            url: of the run directory.
            copy: a folder of this machine.

        Raises:
            SettingsError: there is no way to such a URL here.
        """
        self.url = url.rstrip("/")
        self.copy = copy
        # An object store shows a file when it is whole; others are written beside it and renamed.
        self._whole = url.split("://", maxsplit=1)[0] in _OBJECT_STORES
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError, OSError) as error:
            raise SettingsError(
                f"--output {url}: cannot be reached from here ({error}); install what fsspec needs for it, such "
                "as s3fs, or choose another output"
            ) from error

    def names(self) -> dict[str, int]:
        """Sizes of all files there, by name relative to the run directory."""
        with self._errors():
            self._files.invalidate_cache()
            found = self._files.find(self._root, detail=True)
        start = len(self._root.rstrip("/")) + 1
        return {name[start:]: int(about["size"] or 0) for name, about in found.items()}

    def fetch(self, names: Iterable[str]) -> None:
        """Copy files from there, whole or not at all."""
        for name in names:
            target = self.copy / name
            target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            temporary = target.with_name(f".partial-{os.getpid()}-{secrets.token_hex(6)}-{target.name}")
            with self._errors():
                try:
                    self._files.get_file(f"{self._root}/{name}", str(temporary))
                    temporary.replace(target)
                finally:
                    temporary.unlink(missing_ok=True)

    def store(self, names: Iterable[str]) -> None:
        """Copy files there, in this order."""
        for name in names:
            self.write(name, (self.copy / name).read_bytes())

    def remove(self, names: Iterable[str]) -> None:
        """Remove files there."""
        for name in names:
            with self._errors():
                self._files.rm_file(f"{self._root}/{name}")

    def read(self, name: str) -> bytes | None:
        """The content of a small file there; None without one."""
        with self._errors():
            self._files.invalidate_cache()
            try:
                return bytes(self._files.cat_file(f"{self._root}/{name}"))
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        """Write a file there, whole or not at all."""
        path = f"{self._root}/{name}"
        with self._errors():
            if self._whole:
                self._files.pipe_file(path, content)
                return
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
            temporary = f"{path}.partial-{secrets.token_hex(6)}"
            self._files.pipe_file(temporary, content)
            self._files.mv(temporary, path)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except SteadylightError:
            raise
        except Exception as error:
            raise StorageError(
                f"{self.url}: cannot be read or written ({type(error).__name__}: {error}); check the address and "
                "your rights there, then run the same command again"
            ) from error


class RemoteRun:
    """A run at a URL as the command that works on it sees it: a copy of all of it, and a lease."""

    def __init__(self, url: str, copy: Path) -> None:
        self.store = Store(url, copy)
        self._holder = f"host {socket.gethostname()}, process {os.getpid()}, {secrets.token_hex(4)}"
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Take the lease, and fetch what is there.

        An object store has no locks. Two commands that start within the same second may both get the lease; the
        frames would be right all the same, since whoever writes them writes the same bytes.

        Raises:
            SettingsError: another command is at work there.
            StorageError: the store cannot be reached.
        """
        held = self.store.read(_LEASE)
        if held is not None:
            with suppress(ValueError, KeyError, TypeError):
                lease = json.loads(held)
                if time.time() - float(lease["time"]) < _LEASE_LASTS:
                    raise SettingsError(
                        f"{self.store.url}: another steadylight command is at work here ({lease['holder']}); wait "
                        f"for it, stop it (and wait {_LEASE_LASTS:.0f} s), or choose another output"
                    )
        self._sign()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()
        there = self.store.names()
        here = self.store.copy
        for old in here.rglob("*") if here.exists() else ():
            name = old.relative_to(here).as_posix()
            if old.is_file() and name != _LEASE and there.get(name) != old.stat().st_size:
                old.unlink()
        self.store.fetch(name for name in there if name != _LEASE and not (here / name).exists())

    def begin(self, tasks: Iterable[Task]) -> None:
        """Store what workers need, and remove there what was found not to be valid here."""
        here = self.store.copy
        outputs = {name for task in tasks for name in task.outputs}
        self.store.remove(
            name for name in self.store.names() if name in outputs and not (here / name).exists()
        )
        self.store.store(_OURS)

    def done(self, task: Task) -> None:
        """Fetch what a task wrote."""
        self.store.fetch(task.outputs)

    def close(self) -> None:
        """Store what this command wrote, and give the lease back."""
        self._done.set()
        if self._thread is None:
            return
        self._thread.join()
        self._thread = None
        here = self.store.copy
        with suppress(StorageError):
            log = [*here.glob("log/*.jsonl"), *here.glob("log/sessions/*.json")]
            made = [here / name for name in ("stats.json", "animation.mp4", "report.html")]
            if (here / "run.json").exists():
                self.store.store(path.relative_to(here).as_posix() for path in [*log, *made] if path.exists())
            self.store.remove([_LEASE])

    def _sign(self) -> None:
        self.store.write(_LEASE, json.dumps({"holder": self._holder, "time": time.time()}).encode())

    def _keep(self) -> None:
        while not self._done.wait(_SECONDS_BETWEEN_SIGNS):
            with suppress(StorageError):
                self._sign()


def perform_remote(task: Task, *, url: str, threads: int | None) -> Mapping[str, Any]:
    """Do one task of a run at a URL, in this machine's copy of what it needs.

    Args:
        task: from `plan.make_tasks`.
        url: of the run directory.
        threads: threads to use; all cores if None.
    """
    from steadylight.animation.tasks import perform

    # Its own copy for each process, beside the command's: attempts must not meet in one.
    _clear_left_copies(url)
    store = Store(url, copy_of(url).with_name(f"{copy_of(url).name}-worker-{os.getpid()}"))
    for folder in ("frames", "cache", "log/results"):
        (store.copy / folder).mkdir(parents=True, exist_ok=True, mode=0o700)
    record = store.copy / "run.json"
    before = record.read_bytes() if record.exists() else None
    store.fetch(["run.json"])
    stale = before is not None and record.read_bytes() != before
    wanted = [SCENE_FILE, *task.arguments["cache"], *task.arguments["inputs"]]
    store.fetch(name for name in wanted if (stale or not (store.copy / name).exists()))
    if stale:
        for name in task.outputs:
            (store.copy / name).unlink(missing_ok=True)
    result = perform(task, directory=str(store.copy), threads=threads)
    result_name = RunDirectory.result_name(task.key)
    store.store([name for name in task.outputs if name != result_name])
    store.store([result_name])
    for name in task.outputs:
        if name.startswith("frames/"):
            (store.copy / name).unlink(missing_ok=True)
    return result


@lru_cache(maxsize=1)
def _clear_left_copies(url: str) -> None:
    """Remove, once for each process, copies of processes that are not there any more."""
    name = copy_of(url).name
    for left in copy_of(url).parent.glob(f"{name}-worker-*"):
        number = left.name.rpartition("-")[2]
        if number.isdecimal() and not Path(f"/proc/{number}").exists():
            shutil.rmtree(left, ignore_errors=True)
