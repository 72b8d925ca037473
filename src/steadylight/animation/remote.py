"""A run directory at a URL (s3://, gs://, sftp://, ...), for machines that share no file system.

The store holds the run. This command and every worker keep a local copy of the files that they need. A worker fetches
the inputs of its task, works in its copy, and stores the outputs, the result last. The guarantees of a run directory
(complete files, hashes, the first valid file wins) therefore also hold for the copies, and a task is done when its
result is in the store.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from steadylight.animation.plan import SCENE_FILE, files_read
from steadylight.errors import StorageError
from steadylight.storage import RunDirectory
from steadylight.storage.lease import LEASE, Lease
from steadylight.storage.store import RECORD, Store, copy_of, make_folder

if TYPE_CHECKING:
    from steadylight.engines import Task

DISPLAY: Final = "display.json"
_MADE_AT_THE_END: Final = ("stats.json", "animation.mp4", "report.html")


class RemoteRun:
    """A run at a URL as seen by the command that works on it: a local copy and a lease.

    The copy has all files that were there at the start. Of the new files it only gets frames and results: caches are
    read only by workers.
    """

    def __init__(self, url: str, copy: Path) -> None:
        self.store = Store(url, copy)
        self._lease = Lease(self.store)
        self._there: set[str] = set()
        self._new_folders: list[str] = []
        self._begun = False

    def open(self) -> None:
        """Take the lease, and fetch the existing files.

        Raises:
            SettingsError: another command is using the run.
            StorageError: the store cannot be reached, or the copy cannot be written.
        """
        self._new_folders = self.store.missing_folders(LEASE)
        self._lease.take()
        self.store.follow_run()
        there = self.store.names()
        here = self.store.copy
        for old in here.rglob("*") if here.exists() else ():
            name = old.relative_to(here).as_posix()
            if old.is_file() and name != LEASE and there.get(name) != old.stat().st_size:
                old.unlink()
        self.store.fetch(name for name in there if name != LEASE and not (here / name).exists())
        self._there = set(there)

    def begin(self, tasks: Iterable[Task]) -> None:
        """Store the files that workers need, and remove files from the store that turned out to be invalid."""
        self._lease.check()
        self._begun = True
        self.store.sweep()
        # Everything was fetched, so files that are missing here were invalid.
        outputs = self._there.intersection(name for task in tasks for name in task.outputs)
        self.store.remove(name for name in sorted(outputs) if not (self.store.copy / name).exists())
        first = [SCENE_FILE, DISPLAY]
        self.store.store(first if RECORD in self._there else [RECORD, *first])

    def done(self, task: Task) -> None:
        """Fetch the outputs of a task that video and report need.

        Raises:
            StorageError: the store cannot be reached, or another command has taken over the run.
        """
        self._lease.check()
        self.store.fetch(name for name in task.outputs if not name.startswith("cache/"))

    def finish(self) -> None:
        """Store statistics, video and report.

        Raises:
            StorageError: the store cannot be written, or another command has taken over the run.
        """
        self._lease.check()
        pictures = sorted(path.name for path in (self.store.copy / "pictures").glob("[!.]*.png"))
        self.store.store([*_MADE_AT_THE_END, *(f"pictures/{name}" for name in pictures)])

    def close(self) -> None:
        """Store this command's logs if it began, and release the lease; the store may be unreachable."""
        here = self.store.copy
        if self._begun:
            with suppress(StorageError):
                self._lease.check()
                log = [*here.glob("log/*.jsonl"), *here.glob("log/sessions/*.json")]
                self.store.store(path.relative_to(here).as_posix() for path in log)
        with suppress(StorageError):
            if self._lease.give_back() and not self._begun:
                self.store.remove_folders(self._new_folders)


def perform_remote(task: Task, *, url: str, threads: int | None) -> Mapping[str, Any]:
    """Do one task of a run at a URL, in a local copy of its inputs.

    Args:
        task: from `plan.make_tasks`.
        url: URL of the run directory.
        threads: threads to use; all cores if None.

    Raises:
        StorageError: there is no run at the URL, or it belongs to another run at the end.
    """
    from steadylight.animation.tasks import perform

    # Each process has its own copy, next to the command's, so that attempts do not collide.
    _clear_left_copies(url)
    store = Store(url, copy_of(url).with_name(f"{_copies_here(url)}{os.getpid()}"))
    if not store.follow_run():
        raise StorageError(
            f"{store}: the machine {socket.gethostname()} finds no run there; all workers must reach the same store "
            "under the same URL"
        )
    for folder in ("frames", "cache", "log/results"):
        make_folder(store.copy / folder)
    wanted = [SCENE_FILE, *files_read(task)]
    store.fetch(name for name in wanted if not (store.copy / name).exists())
    result = perform(task, directory=str(store.copy), threads=threads)
    result_name = RunDirectory.result_name(task.key)
    for name in (*(name for name in task.outputs if name != result_name), result_name):
        store.check_same_run()
        store.store([name])
    for name in task.outputs:
        if name.startswith(("frames/", "aovs/")):
            (store.copy / name).unlink(missing_ok=True)
    return result


def _copies_here(url: str) -> str:
    """Name prefix of the copies of this machine's workers; machines may share the folder."""
    return f"{copy_of(url).name}-worker-{socket.gethostname()}-"


@lru_cache(maxsize=1)
def _clear_left_copies(url: str) -> None:
    """Remove, once per process, copies of processes that no longer exist."""
    for left in copy_of(url).parent.glob(f"{_copies_here(url)}*"):
        number = left.name.rpartition("-")[2]
        if number.isdecimal() and not Path(f"/proc/{number}").exists():
            shutil.rmtree(left, ignore_errors=True)
