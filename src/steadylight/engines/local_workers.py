"""The worker processes of a local cluster: started, watched, replaced and ended together with their parent.

Distributed's own nanny starts workers through multiprocessing, which runs the caller's main script again in
every worker and gives no word of what a dying worker said. Plain child processes do neither. Each has a pipe
from its parent as standard input; it ends at once when the pipe closes, which the operating system sees to
however the parent ends.

This file is also what such a process runs: `python -m steadylight.engines.local_workers`.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.engines.performing import label
from steadylight.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from steadylight.engines.pools import Registered, Workload

# A worker that cannot even start will not do so the fourth time.
_MOST_FALSE_STARTS = 3
_SECONDS_TO_END = 10.0


@dataclass
class _Place:
    """One of the places for a worker, and the process that fills it now."""

    number: int
    process: subprocess.Popen[bytes]
    folder: Path
    starts: int = 1
    false_starts: int = 0
    registered: bool = False

    @property
    def name(self) -> str:
        """Unique for each process: a scheduler refuses a name that it still knows."""
        return f"worker-{self.number}" + (f"-restart-{self.starts - 1}" if self.starts > 1 else "")


class LocalWorkers:
    """Keeps worker processes of this machine connected to a scheduler.

    Attributes:
        count: how many.
        may_grow: no; there is one machine.
        grows: no.
        seconds_without_worker: how long a run waits while there is none.
    """

    may_grow = False
    grows = False
    seconds_without_worker = 120.0

    def __init__(self, count: int, address: str) -> None:
        """Start the processes; they register with the scheduler at `address` on their own."""
        self.count = count
        self._address = address
        self._places = []
        for number in range(1, count + 1):
            process, folder = self._start(f"worker-{number}")
            self._places.append(_Place(number, process, folder))

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """Those of the registered workers, by address, whose process is alive."""
        alive = {place.name for place in self._places if place.process.poll() is None}
        return {address: worker for address, worker in known.items() if worker.name in alive}

    def eager(self, present: int) -> bool:
        """Whether one is missing: a process starts within seconds."""
        return present < self.count

    def label(self, name: str, address: str) -> str:  # noqa: ARG002 - the process says more
        """How a worker is called in the journal."""
        return label(name, socket.gethostname(), self._place(name).process.pid)

    def has_time(self, name: str, seconds: float) -> bool:  # noqa: ARG002 - no process has a time limit
        """Always."""
        return True

    def expired(self, name: str) -> bool:  # noqa: ARG002 - the same
        """Never."""
        return False

    def tend(self, registered: Collection[str], workload: Workload) -> None:  # noqa: ARG002 - their number is fixed
        """Put new processes in the place of those that ended.

        Args:
            registered: names that the scheduler knows now.
            workload: what the run could use.

        Raises:
            RunError: a worker ended several times in a row before it had registered.
        """
        for place in self._places:
            place.registered = place.registered or place.name in registered
            if place.process.poll() is None:
                continue
            place.false_starts = 0 if place.registered else place.false_starts + 1
            if place.false_starts >= _MOST_FALSE_STARTS:
                raise RunError(f"a worker process cannot start: {_fate(place)}")
            self._replace(place)

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its name
        """Make sure that a worker's process is gone; returns how it ended, with its last words."""
        place = self._place(name)
        if hung:
            place.process.kill()
            place.process.wait(timeout=_SECONDS_TO_END)
            # Wanted by us, so it is no false start.
            place.registered = True
            return "the worker hangs; its process was killed"
        try:
            # Its connection may close some time before the process is gone.
            place.process.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            place.process.kill()
            place.process.wait(timeout=_SECONDS_TO_END)
        return _fate(place)

    def stop(self, names: Collection[str]) -> None:
        """Kill processes whose task is not wanted any more; `tend` replaces them."""
        stopped = [place for place in self._places if place.name in names]
        for place in stopped:
            place.process.kill()
            # Wanted by us, so it is no false start.
            place.registered = True
        for place in stopped:
            place.process.wait(timeout=_SECONDS_TO_END)

    def late(self, address: str) -> None:
        """A process that was killed reports no more."""

    def close(self) -> None:
        """Kill all processes and remove what they left."""
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
        folder = Path(tempfile.mkdtemp(prefix="steadylight-"))
        # The worker must find the same modules as this process; -P, because a folder that the user
        # happens to stand in is no place to import from.
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
    """How a process ended, in a sentence, with the end of what it printed."""
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
    return f"{fate}; it said: {words}" if words else fate


# What the child process does ------------------------------------------------------------------------------


def main(address: str, name: str, folder: str) -> None:
    """Be a worker of the scheduler at `address` until that or the parent process is gone."""
    # Ctrl-C in a terminal reaches every process of the group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()

    import asyncio

    import dask

    dask.config.set({"distributed.worker.profile.enabled": False, "logging": {"distributed": "error"}})
    asyncio.run(_serve(address, name, folder))
    # Not a normal exit: that would wait for a task that runs for nobody.
    os._exit(0)


def _end_with_parent(folder: str) -> None:
    """Wait until the parent closes the pipe, by intent or by its end, and go with it at once."""
    while os.read(0, 1024):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


async def _serve(address: str, name: str, folder: str) -> None:
    from distributed import Worker

    worker = Worker(
        address,
        name=name,
        nthreads=1,
        host="127.0.0.1",
        local_directory=folder,
        # Dask would pause or kill a worker by its resident memory, which counts mapped cache files too.
        memory_limit=0,
        death_timeout="60s",
        dashboard=False,
    )
    async with worker:
        await worker.finished()


if __name__ == "__main__":
    main(*sys.argv[1:])
