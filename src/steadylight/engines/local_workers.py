"""The worker processes of a local cluster: started, monitored, replaced, and stopped with their parent.

Distributed's own nanny starts workers through multiprocessing, which re-runs the caller's main script in every worker
and loses the output of a dying worker. Plain child processes avoid both. Each has a pipe from its parent as standard
input and exits as soon as the pipe closes, which the operating system guarantees however the parent ends.

This module is also what such a process runs: `python -m steadylight.engines.local_workers`.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.engines.certificates import security_in
from steadylight.engines.performing import label
from steadylight.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from steadylight.engines.pools import Registered, Workload

# A worker that failed to start three times will not start the fourth time.
_MOST_FALSE_STARTS = 3
_SECONDS_TO_END = 10.0


@dataclass
class _Place:
    """A slot for a worker, and its current process."""

    number: int
    process: subprocess.Popen[bytes]
    folder: Path
    starts: int = 1
    false_starts: int = 0
    registered: bool = False

    @property
    def name(self) -> str:
        """Unique for each process: a scheduler rejects a name that it still knows."""
        return f"worker-{self.number}" + (f"-restart-{self.starts - 1}" if self.starts > 1 else "")


class LocalWorkers:
    """Keeps worker processes of this machine connected to a scheduler.

    Attributes:
        count: number of workers.
        may_grow: False; there is only one machine.
        grows: False.
        seconds_without_worker: how long a run waits while there is no worker.
    """

    may_grow = False
    grows = False
    seconds_without_worker = 120.0

    def __init__(self, count: int, address: str, scratch: Path) -> None:
        """Start the processes; they register with the scheduler by themselves.

        Args:
            count: number of processes.
            address: address of the scheduler.
            scratch: a folder that only this user can enter, with the certificates of the scheduler.
        """
        self.count = count
        self._address = address
        self._scratch = scratch
        self._places = []
        for number in range(1, count + 1):
            process, folder = self._start(f"worker-{number}")
            self._places.append(_Place(number, process, folder))

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """The registered workers, by address, whose process is alive."""
        alive = {place.name for place in self._places if place.process.poll() is None}
        return {address: worker for address, worker in known.items() if worker.name in alive}

    def eager(self, present: int) -> bool:
        """Whether a worker is missing: a process starts within seconds."""
        return present < self.count

    def label(self, name: str, address: str) -> str:  # noqa: ARG002 - the process id is more useful
        """Name of a worker in the journal."""
        return label(name, socket.gethostname(), self._place(name).process.pid)

    def has_time(self, name: str, seconds: float) -> bool:  # noqa: ARG002 - no process has a time limit
        """Always true."""
        return True

    def expired(self, name: str) -> bool:  # noqa: ARG002 - the same
        """Always false."""
        return False

    def tend(self, registered: Collection[str], workload: Workload) -> None:  # noqa: ARG002 - their number is fixed
        """Replace processes that have ended.

        Args:
            registered: names of the registered workers that are in use. One that ended just now is left to the next
                call, so that `end` can tell how it ended.
            workload: current demand of the run.

        Raises:
            RunError: a worker ended several times in a row before it registered.
        """
        for place in self._places:
            in_use = place.name in registered
            place.registered = place.registered or in_use
            if in_use or place.process.poll() is None:
                continue
            place.false_starts = 0 if place.registered else place.false_starts + 1
            if place.false_starts >= _MOST_FALSE_STARTS:
                raise RunError(f"a worker process cannot start: {_fate(place)}")
            self._replace(place)

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its name
        """Make sure that a worker's process is gone; returns how it ended, with its last output."""
        place = self._place(name)
        if hung:
            place.process.kill()
            place.process.wait(timeout=_SECONDS_TO_END)
            # Intended, so it does not count as a false start.
            place.registered = True
            return "the worker hung; its process was killed"
        try:
            # Its connection may close some time before the process is gone.
            place.process.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            place.process.kill()
            place.process.wait(timeout=_SECONDS_TO_END)
        return _fate(place)

    def stop(self, names: Collection[str]) -> None:
        """Kill processes whose task is no longer needed; `tend` replaces them."""
        stopped = [place for place in self._places if place.name in names]
        for place in stopped:
            place.process.kill()
            # Intended, so it does not count as a false start.
            place.registered = True
        for place in stopped:
            place.process.wait(timeout=_SECONDS_TO_END)

    def late(self, address: str) -> None:
        """Do nothing: a killed process cannot report."""

    def close(self) -> None:
        """Kill all processes and remove their folders."""
        for place in self._places:
            place.process.kill()
        for place in self._places:
            place.process.wait(timeout=_SECONDS_TO_END)
            _clear(place)
        self._places = []

    def _place(self, name: str) -> _Place:
        return next(place for place in self._places if place.name == name)

    def _replace(self, place: _Place) -> None:
        _clear(place)
        place.starts += 1
        place.registered = False
        place.process, place.folder = self._start(place.name)

    def _start(self, name: str) -> tuple[subprocess.Popen[bytes], Path]:
        folder = self._scratch / name
        folder.mkdir()
        # The worker must find the same modules as this process. -P keeps the current folder off its module path.
        path = os.pathsep.join(entry or str(Path.cwd()) for entry in sys.path)
        command = [sys.executable, "-P", "-m", __name__, self._address, name, str(folder)]
        with (folder / "output.txt").open("wb") as output:
            process = subprocess.Popen(  # noqa: S603 - the command is ours
                command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONPATH": path},
            )
        return process, folder


def _clear(place: _Place) -> None:
    """Close the pipe to a process that has ended, and remove its folder."""
    if place.process.stdin is not None:
        place.process.stdin.close()
    shutil.rmtree(place.folder, ignore_errors=True)


def _fate(place: _Place) -> str:
    """How a process ended, in a sentence, with the end of its output."""
    code = place.process.returncode
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else "unknown"
        fate = f"the process was killed by signal {-code} ({name})"
    else:
        fate = f"the process ended with exit code {code}"
    try:
        words = (place.folder / "output.txt").read_bytes()[-2000:].decode(errors="replace").strip()
    except OSError:
        words = ""
    return f"{fate}; last output: {words}" if words else fate


# What the child process does ------------------------------------------------------------------------------


def main(address: str, name: str, folder: str) -> None:
    """Serve as a worker of the scheduler at `address` until it or the parent process is gone."""
    # Ctrl-C in a terminal reaches every process of the group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()
    with suppress(OSError):
        # If memory runs out, the system should end a worker, which is replaced, and not the command.
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")

    import asyncio

    import dask

    dask.config.set(
        {
            "distributed.worker.profile.enabled": False,
            "distributed.worker.http.routes": [],
            "logging": {"distributed": "error"},
        }
    )
    asyncio.run(_serve(address, name, folder))
    # Not a normal exit, which would wait for a task that nobody needs.
    os._exit(0)


def _end_with_parent(folder: str) -> None:
    """Wait until the parent closes the pipe or ends, then exit at once."""
    while os.read(0, 1024):
        pass
    # The parent was killed, so nobody else removes what it shared with its workers.
    shutil.rmtree(Path(folder).parent, ignore_errors=True)
    os._exit(1)


async def _serve(address: str, name: str, folder: str) -> None:
    from distributed import Worker

    worker = Worker(
        address,
        name=name,
        security=security_in(Path(folder).parent),
        nthreads=1,
        host="127.0.0.1",
        local_directory=folder,
        # Dask would pause or kill a worker for its resident memory, which includes mapped cache files.
        memory_limit=0,
        death_timeout="60s",
        dashboard=False,
    )
    async with worker:
        await worker.finished()


if __name__ == "__main__":
    main(*sys.argv[1:])
