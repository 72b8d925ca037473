"""Worker pools: the interface between a run of tasks and the source of its workers.

There are three pools: `LocalWorkers` (processes of this machine), `BatchWorkers` (jobs of a batch system), and
`ForeignWorkers` (here: any workers of an existing scheduler).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from steadylight.errors import RunError

if TYPE_CHECKING:
    from distributed import Client

_SECONDS_TO_RESTART = 10.0
_SCHEDULER_GONE = "lost the Dask scheduler; when it is back, run the same command again"


class Registered(NamedTuple):
    """What the scheduler knows about a worker.

    Attributes:
        name: name of the worker.
        threads: size of its thread pool for tasks.
        host: where it runs.
        heartbeat: time of its last heartbeat, by the scheduler's clock.
        percent: recent CPU use of its process, per cent of a core.
    """

    name: str
    threads: int
    host: str
    heartbeat: float
    percent: float


@dataclass(frozen=True)
class Workload:
    """Current demand of the run.

    Attributes:
        tasks: number of tasks that are running or could start.
        busy: names of workers that have a task.
        avoided: names of workers on hosts that currently get no tasks.
    """

    tasks: int
    busy: Collection[str]
    avoided: Collection[str]


def registered(client: Client) -> dict[str, Registered]:
    """The scheduler's current workers, by address.

    Raises:
        RunError: the scheduler is gone.
    """
    require_scheduler(client)
    try:
        # Not `client.scheduler_info`: the client's own periodic update, which requests no workers, may
        # overwrite it.
        workers = client.sync(client.scheduler.identity, n_workers=-1)["workers"]
    except (OSError, RuntimeError, TimeoutError) as error:
        raise RunError(_SCHEDULER_GONE) from error
    return {
        address: Registered(
            name=str(worker["name"]),
            threads=int(worker["nthreads"]),
            host=str(worker["host"]),
            heartbeat=float(worker["last_seen"]),
            percent=float(worker["metrics"].get("cpu", 0.0)),
        )
        for address, worker in workers.items()
    }


def require_scheduler(client: Client) -> None:
    """Raise RunError if the scheduler is gone; all tasks sent are lost with it, even if it comes back."""
    if client.status != "running":
        raise RunError(_SCHEDULER_GONE)


class WorkerPool(Protocol):
    """Keeps workers connected to a scheduler.

    Attributes:
        seconds_without_worker: how long a run waits while there is no worker.
    """

    seconds_without_worker: float

    @property
    def may_grow(self) -> bool:
        """Whether workers on further hosts may become available, now or with more work."""

    @property
    def grows(self) -> bool:
        """Whether workers on further hosts are expected for the current work."""

    @property
    def count(self) -> int:
        """Intended number of workers, or the current one if others decide."""

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """The registered workers that may be used, by address."""

    def eager(self, present: int) -> bool:
        """Whether a missing worker is expected within seconds."""

    def label(self, name: str, address: str) -> str:
        """Name of a worker in the journal before its first report."""

    def has_time(self, name: str, seconds: float) -> bool:
        """Whether a task of this duration should still be sent to a worker."""

    def expired(self, name: str) -> bool:
        """Whether a worker reached its time limit, so that nothing is to blame."""

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Replace lost workers, and adapt their number to the work.

        Args:
            registered: names of the registered workers that are in use. One that ended just now is not replaced yet:
                `end` must be able to tell how it ended.
            workload: current demand of the run.
        """

    def end(self, name: str, address: str, *, hung: bool) -> str:
        """Make sure that a lost or hung worker has stopped; returns how it ended."""

    def stop(self, names: Collection[str]) -> None:
        """Stop workers whose task is no longer needed."""

    def late(self, address: str) -> None:
        """Note that a worker that was given up has reported after all."""

    def close(self) -> None:
        """Stop all workers."""


class ForeignWorkers:
    """The workers of an existing scheduler: they come and go, and are not stopped from here.

    Attributes:
        may_grow: False; the owner of the scheduler decides.
        grows: False.
        seconds_without_worker: how long a run waits while there is no worker.
    """

    may_grow = False
    grows = False
    seconds_without_worker = 120.0

    def __init__(self, client: Client) -> None:
        """Watch the workers of the client's scheduler."""
        self._client = client
        self._given_up: set[str] = set()

    @property
    def count(self) -> int:
        """Current number."""
        return len(self.ours(registered(self._client)))

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """All registered workers except hung ones, by address."""
        self._given_up &= known.keys()
        return {address: worker for address, worker in known.items() if address not in self._given_up}

    def eager(self, present: int) -> bool:
        """Whether there are no workers."""
        return present == 0

    def label(self, name: str, address: str) -> str:
        """Name and address."""
        return f"{name} {address}"

    def has_time(self, name: str, seconds: float) -> bool:  # noqa: ARG002 - its time limit is unknown
        """Always true."""
        return True

    def expired(self, name: str) -> bool:  # noqa: ARG002 - the same
        """Always false."""
        return False

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Do nothing: the owner of the scheduler manages them."""

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its address
        """Have the nanny of a hung worker restart it; without one, it is ignored until it reports."""
        if not hung:
            return "the worker left or its machine can no longer be reached"
        self._given_up.add(address)
        with suppress(Exception):
            self._client.restart_workers([address], timeout=_SECONDS_TO_RESTART, raise_for_error=False)
        return "the worker hung"

    def stop(self, names: Collection[str]) -> None:
        """Do nothing: running tasks end on their own."""

    def late(self, address: str) -> None:
        """Allow the worker to get tasks again."""
        self._given_up.discard(address)

    def close(self) -> None:
        """Do nothing: the workers stay."""
