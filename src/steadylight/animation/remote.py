"""A run directory at a URL (s3://, gs://, sftp://, ...), for machines that share no file system.

The store holds the run. This command and every worker have a copy of what they need of it: a worker fetches what
its task reads, works in its copy, and stores what the task wrote, the result last. So all that is true of a run
directory (whole files, hashes, the first valid file stays) is true of the copies, and a task is done when its
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

from steadylight.animation.plan import SCENE_FILE
from steadylight.animation.store import LEASE, RECORD, Lease, Store, copy_of, make_folder
from steadylight.errors import StorageError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from steadylight.engines import Task

_MADE_AT_THE_END: Final = ("stats.json", "animation.mp4", "report.html")


class RemoteRun:
    """A run at a URL as the command that works on it sees it: a copy, and a lease.

    The copy has all that was there at the start. Of what is made meanwhile it gets frames and results, but no
    caches: only workers read those.
    """

    def __init__(self, url: str, copy: Path) -> None:
        self.store = Store(url, copy)
        self._lease = Lease(self.store)
        self._there: set[str] = set()
        self._new_folders: list[str] = []
        self._begun = False

    def open(self) -> None:
        """Take the lease, and fetch what is there.

        Raises:
            SettingsError: another command is at work there.
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
        """Store what workers need, and remove there what was found not to be valid here."""
        self._lease.check()
        self._begun = True
        self.store.sweep()
        # Everything that was there was fetched, so what is not here any more was not valid.
        outputs = self._there.intersection(name for task in tasks for name in task.outputs)
        self.store.remove(name for name in sorted(outputs) if not (self.store.copy / name).exists())
        self.store.store([SCENE_FILE] if RECORD in self._there else [RECORD, SCENE_FILE])

    def done(self, task: Task) -> None:
        """Fetch what video and report need of what a task wrote.

        Raises:
            StorageError: the store cannot be reached, or another command has taken the run over.
        """
        self._lease.check()
        self.store.fetch(name for name in task.outputs if not name.startswith("cache/"))

    def finish(self) -> None:
        """Store statistics, video and page.

        Raises:
            StorageError: the store cannot be written, or another command has taken the run over.
        """
        self._lease.check()
        self.store.store(_MADE_AT_THE_END)

    def close(self) -> None:
        """Store this command's logs if it began, and give the lease back; the store may be out of reach."""
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
    """Do one task of a run at a URL, in this machine's copy of what it needs.

    Args:
        task: from `plan.make_tasks`.
        url: of the run directory.
        threads: threads to use; all cores if None.

    Raises:
        StorageError: there is no run there, or at the end another one.
    """
    from steadylight.animation.tasks import perform

    # Its own copy for each process, beside the command's: attempts must not meet in one.
    _clear_left_copies(url)
    store = Store(url, copy_of(url).with_name(f"{_copies_here(url)}{os.getpid()}"))
    if not store.follow_run():
        raise StorageError(
            f"{url}: the machine {socket.gethostname()} sees no run there; all workers must reach the same store "
            "under the same URL"
        )
    for folder in ("frames", "cache", "log/results"):
        make_folder(store.copy / folder)
    wanted = [SCENE_FILE, *task.arguments["cache"], *task.arguments["inputs"]]
    store.fetch(name for name in wanted if not (store.copy / name).exists())
    result = perform(task, directory=str(store.copy), threads=threads)
    result_name = RunDirectory.result_name(task.key)
    for name in (*(name for name in task.outputs if name != result_name), result_name):
        store.check_same_run()
        store.store([name])
    for name in task.outputs:
        if name.startswith("frames/"):
            (store.copy / name).unlink(missing_ok=True)
    return result


def _copies_here(url: str) -> str:
    """What names of the copies of this machine's workers begin with; machines may share the folder."""
    return f"{copy_of(url).name}-worker-{socket.gethostname()}-"


@lru_cache(maxsize=1)
def _clear_left_copies(url: str) -> None:
    """Remove, once for each process, copies of processes that are not there any more."""
    for left in copy_of(url).parent.glob(f"{_copies_here(url)}*"):
        number = left.name.rpartition("-")[2]
        if number.isdecimal() and not Path(f"/proc/{number}").exists():
            shutil.rmtree(left, ignore_errors=True)
