"""Where workers come from: what a run of tasks needs to know of those who keep them.

Three keep workers: `LocalWorkers` (processes of this machine), `BatchWorkers` (jobs of a batch system), and
`ForeignWorkers` (here: whoever registers with a scheduler that is not ours).
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
_SCHEDULER_GONE = (
    "the Dask scheduler does not answer any more: when it is there again, run the same command again"
)


class Registered(NamedTuple):
    """What the scheduler knows of a worker.

    Attributes:
        name: of the worker.
        threads: of its pool for tasks.
        host: where it runs.
        heartbeat: when it last gave a sign, by the scheduler's clock.
        percent: how much of a core its process has used lately.
    """

    name: str
    threads: int
    host: str
    heartbeat: float
    percent: float


@dataclass(frozen=True)
class Workload:
    """What the run could use now.

    Attributes:
        tasks: how many are at work or could start.
        busy: names of workers that have a task.
        avoided: names of workers on hosts that get no tasks for now.
    """

    tasks: int
    busy: Collection[str]
    avoided: Collection[str]


def registered(client: Client) -> dict[str, Registered]:
    """The workers that the scheduler has now, by address.

    Raises:
        RunError: the scheduler is gone.
    """
    refuse_to_go_on_alone(client)
    try:
        # Not `client.scheduler_info`: the client's own periodic look, which asks for no workers, can change
        # what that returns under our hands.
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


def refuse_to_go_on_alone(client: Client) -> None:
    """Raise RunError if the scheduler is gone; with it went all that was sent, even if it comes back."""
    if client.status != "running":
        raise RunError(_SCHEDULER_GONE)


class WorkerPool(Protocol):
    """Keeps workers connected to a scheduler.

    Attributes:
        seconds_without_worker: how long a run waits while there is none.
    """

    seconds_without_worker: float

    @property
    def may_grow(self) -> bool:
        """Whether workers on further hosts may come by themselves, now or when there is more to do."""

    @property
    def grows(self) -> bool:
        """Whether workers on further hosts are to come for what there is to do now."""

    @property
    def count(self) -> int:
        """How many workers there are to be, or are there if others decide."""

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """Those of the registered workers, by address, that may be used."""

    def eager(self, present: int) -> bool:
        """Whether a worker is missing that will come within seconds."""

    def label(self, name: str, address: str) -> str:
        """How a worker is called in the journal before it has said so itself."""

    def has_time(self, name: str, seconds: float) -> bool:
        """Whether a task of so many seconds should still be sent to a worker."""

    def expired(self, name: str) -> bool:
        """Whether a worker's time was up, so that its end is nobody's fault."""

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Put new workers in the place of those that are gone; more or fewer of them as the work asks for."""

    def end(self, name: str, address: str, *, hung: bool) -> str:
        """Make sure that a worker which is gone or hangs does no more; returns how it ended."""

    def stop(self, names: Collection[str]) -> None:
        """End workers whose task is not wanted any more."""

    def late(self, address: str) -> None:
        """A worker that was given up has reported after all."""

    def close(self) -> None:
        """End all workers."""


class ForeignWorkers:
    """The workers of a scheduler at an address: they come and go, and are not ours to end.

    Attributes:
        may_grow: no; who runs them decides.
        grows: no.
        seconds_without_worker: how long a run waits while there is none.
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
        """How many there are now."""
        return len(self.ours(registered(self._client)))

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """All but those that hang."""
        self._given_up &= known.keys()
        return {address: worker for address, worker in known.items() if address not in self._given_up}

    def eager(self, present: int) -> bool:
        """While there is none at all."""
        return present == 0

    def label(self, name: str, address: str) -> str:
        """Name and address."""
        return f"{name} {address}"

    def has_time(self, name: str, seconds: float) -> bool:  # noqa: ARG002 - nothing is known of its end
        """Always."""
        return True

    def expired(self, name: str) -> bool:  # noqa: ARG002 - the same
        """Never."""
        return False

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Whoever runs them tends them."""

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its address
        """Have the nanny of a worker that hangs start it again; without one it is left alone until it reports."""
        if not hung:
            return "the worker left or its machine cannot be reached any more"
        self._given_up.add(address)
        with suppress(Exception):
            self._client.restart_workers([address], timeout=_SECONDS_TO_RESTART, raise_for_error=False)
        return "the worker hangs"

    def stop(self, names: Collection[str]) -> None:
        """What runs there ends on its own."""

    def late(self, address: str) -> None:
        """It may have tasks again."""
        self._given_up.discard(address)

    def close(self) -> None:
        """They stay."""
