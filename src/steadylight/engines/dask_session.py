"""One run of a set of tasks on a Dask cluster: what was sent to which worker, and what comes back.

A worker reports through an event of the scheduler rather than through a result that is fetched: the report
is out before the task counts as finished, and cannot be lost with the worker's memory afterwards.
"""

from __future__ import annotations

import json
import queue
import time
import uuid
from collections import deque
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from distributed import Client, Future, get_worker

from steadylight.engines import Attempt, Task
from steadylight.engines.performing import Trial, describe, perform_here
from steadylight.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from steadylight.engines.local_workers import LocalWorkers
    from steadylight.engines.readiness import Readiness

_SECONDS_WITHOUT_WORKER = 120.0
_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_BETWEEN_EAGER_LOOKS = 0.05

# Sending one task after the other costs about 0.01 s each. A second task waits at a worker if the first is
# short, so that this is hidden, and so many that they last 0.05 s; behind a long one none waits, because a
# worker that falls idle first should have it.
_SHORT_SECONDS = 2.0
_QUEUE_SECONDS = 0.05
_QUEUE_LENGTH = 16
_SCHEDULER_GONE = (
    "the Dask scheduler does not answer any more: when it is there again, run the same command again"
)

_Ended = tuple[Attempt, Exception | None]
"""An attempt, and the error that ends the run if the task may not be tried again."""


class Registered(NamedTuple):
    """What the scheduler knows of a worker."""

    name: str
    threads: int


@dataclass
class _Flight:
    """A task that was sent: to whom, and what holds it there."""

    task: Task
    attempt: int
    address: str
    future: Future


class Session:
    """One run of a set of tasks: what was sent where, and what comes back."""

    def __init__(
        self,
        client: Client,
        local: LocalWorkers | None,
        readiness: Readiness,
        perform: Callable[[Task], Mapping[str, Any]],
    ) -> None:
        self._client = client
        self._local = local
        self._readiness = readiness
        self._perform = perform
        # Names of their own for everything, because a scheduler may serve other runs at the same time.
        self._topic = f"steadylight-{uuid.uuid4().hex}"
        self._events: queue.SimpleQueue[tuple[str, str, Any]] = queue.SimpleQueue()
        self._flights: dict[str, _Flight] = {}
        self._names: dict[str, str] = {}
        self._labels: dict[str, str] = {}
        self._queues: dict[str, deque[str]] = {}
        self._single_threaded: set[str] = set()
        self._paces: dict[str, float] = {}
        self._sent = 0
        self._last_look = 0.0
        self._last_worker = time.monotonic()
        client.subscribe_topic(self._topic, self._on_report)

    def attempts(self) -> Iterator[Attempt]:
        """Send what may start and yield what comes of it, until all is done or an error is final."""
        while not self._readiness.finished:
            ended = list(self._look_at_workers())
            self._send()
            ended += self._collect(wait=not ended)
            verdict = next((error for _, error in ended if error is not None), None)
            # The workers get their next tasks before the caller takes its time with these.
            if verdict is None:
                self._send()
            for attempt, _ in ended:
                yield attempt
            if verdict is not None:
                raise verdict

    def stop(self) -> None:
        """Take back what was sent and end what runs, where that is possible."""
        busy = {self._names[flight.address] for flight in self._flights.values()}
        futures = [flight.future for flight in self._flights.values()]
        self._flights.clear()
        with suppress(Exception):
            self._client.unsubscribe_topic(self._topic)
        if futures:
            if self._local is not None:
                self._local.stop(busy)
            with suppress(Exception):
                self._client.cancel(futures, force=True)

    # Sending ----------------------------------------------------------------------------------------------

    def _send(self) -> None:
        """Send tasks while there is one that may start and a worker that has room."""
        while self._readiness.next is not None:
            free = [address for address in self._queues if self.has_room(address)]
            if not free:
                return
            # The emptiest first; among those by name, so that runs are alike.
            address = min(free, key=lambda address: (len(self._queues[address]), self._names[address]))
            self._send_to(address)

    def _send_to(self, address: str) -> None:
        task, attempt = self._readiness.take()
        key = f"{task.key}-a{attempt}-{uuid.uuid4().hex[:8]}"
        future = self._client.submit(
            _perform_on_worker,
            self._perform,
            task,
            self._topic,
            key,
            key=key,
            workers=[address],
            allow_other_workers=False,
            # A worker takes what waits for it in the order sent: the oldest is the one that runs.
            priority=-self._sent,
            pure=False,
            retries=0,
        )
        self._sent += 1
        self._flights[key] = _Flight(task, attempt, address, future)
        self._queues[address].append(key)
        future.add_done_callback(lambda _: self._events.put(("settled", key, None)))

    def has_room(self, address: str) -> bool:
        """Whether a worker should be sent another task now: see `_SHORT_SECONDS`."""
        waiting = self._queues[address]
        if not waiting:
            return True
        # Several threads would not wait but run side by side.
        if address not in self._single_threaded or len(waiting) >= _QUEUE_LENGTH:
            return False
        paces = [self._paces.get(self._flights[key].task.stage, float("inf")) for key in waiting]
        return sum(paces) < _QUEUE_SECONDS or (len(waiting) == 1 and paces[0] < _SHORT_SECONDS)

    # What comes back --------------------------------------------------------------------------------------

    def _on_report(self, event: tuple[float, str]) -> None:
        """Take a worker's report (in the client's own thread)."""
        report = json.loads(event[1])
        self._events.put(("report", report.pop("key"), report))

    def _collect(self, *, wait: bool) -> Iterator[_Ended]:
        """All that has happened; with `wait`, what happens until it is time to look around."""
        with suppress(queue.Empty):
            event = self._events.get(timeout=self._patience if wait else 0)
            while True:
                yield from self._handle(*event)
                event = self._events.get_nowait()

    def _handle(self, kind: str, key: str, report: Any) -> Iterator[_Ended]:
        flight = self._flights.get(key)
        if flight is None:
            # The report came before, or the task was taken back.
            return
        if kind == "report":
            self._forget(key)
            yield self._note(flight, Trial(**report))
        else:
            yield from self._settle(key, flight)

    def _settle(self, key: str, flight: _Flight) -> Iterator[_Ended]:
        """A task ended without a report: its worker died, or could not even read the task."""
        refuse_to_go_on_alone(self._client)
        error = flight.future.exception(timeout=1.0) if flight.future.status == "error" else None
        if error is None or type(error).__name__ == "KilledWorker":
            yield from self._lose(flight.address)
        else:
            self._forget(key)
            yield self._note(flight, Trial("failed", 0.0, 0.0, self._labels[flight.address], describe(error)))

    def _note(self, flight: _Flight, trial: Trial) -> _Ended:
        task, error = flight.task, None
        self._labels[flight.address] = trial.worker
        if trial.outcome == "done":
            pace = self._paces.get(task.stage, trial.seconds)
            self._paces[task.stage] = 0.7 * pace + 0.3 * trial.seconds
            self._readiness.done(task)
        else:
            error = self._readiness.failed(task, trial.result)
        return Attempt(task=task, attempt=flight.attempt, **vars(trial)), error

    def _forget(self, key: str) -> None:
        """A flight has ended; releasing its future lets the scheduler forget it too."""
        flight = self._flights.pop(key)
        with suppress(KeyError, ValueError):
            self._queues[flight.address].remove(key)

    # Workers ----------------------------------------------------------------------------------------------

    def _lose(self, address: str) -> Iterator[_Ended]:
        """A worker is gone: the oldest of its tasks was running; the others go back as if never sent."""
        waiting = self._queues.pop(address, None)
        if waiting is None:
            return
        name, worker = self._names[address], self._labels[address]
        reason = "the worker left or its machine cannot be reached any more"
        if self._local is not None:
            reason = self._local.end(name)
        lost = [self._flights.pop(key) for key in waiting]
        with suppress(Exception):
            self._client.cancel([flight.future for flight in lost], force=True)
        for flight in lost[1:]:
            self._readiness.give_back(flight.task)
        if lost:
            task = lost[0].task
            error = self._readiness.lost(task, reason)
            yield Attempt(task, "lost", lost[0].attempt, 0.0, 0.0, worker, {"error": reason}), error

    @property
    def _patience(self) -> float:
        """How long not to look at the workers: shorter while one is missed."""
        complete = len(self._queues) >= (self._local.count if self._local is not None else 1)
        return _SECONDS_BETWEEN_LOOKS if complete else _SECONDS_BETWEEN_EAGER_LOOKS

    def _look_at_workers(self) -> Iterator[_Ended]:
        """Learn which workers there are, and replace local ones that ended."""
        now = time.monotonic()
        if now - self._last_look < self._patience:
            return
        self._last_look = now
        known = registered(self._client)
        if self._local is not None:
            alive = self._local.names
            known = {address: worker for address, worker in known.items() if worker.name in alive}
        # Before their processes are replaced, and with them the record of how they ended.
        for address in [address for address in self._queues if address not in known]:
            yield from self._lose(address)
        for address, worker in known.items():
            if address not in self._queues:
                self._welcome(address, worker)
        if self._local is not None:
            self._local.tend({worker.name for worker in known.values()})
        if known:
            self._last_worker = now
        elif now - self._last_worker > _SECONDS_WITHOUT_WORKER:
            raise RunError(
                f"there has been no worker for {_SECONDS_WITHOUT_WORKER:.0f} s: start one with `dask worker "
                f"{self._client.scheduler.address} --nthreads 1`, then run the same command again"
            )

    def _welcome(self, address: str, worker: Registered) -> None:
        """Take a new worker into use."""
        self._queues[address] = deque()
        self._names[address] = worker.name
        self._labels[address] = (
            self._local.label(worker.name) if self._local is not None else f"{worker.name} {address}"
        )
        if worker.threads == 1:
            self._single_threaded.add(address)
        else:
            self._single_threaded.discard(address)


def _perform_on_worker(
    perform: Callable[[Task], Mapping[str, Any]], task: Task, topic: str, key: str
) -> None:
    """What a worker does: perform the task and report. Runs in the worker process."""
    worker = get_worker()
    trial = perform_here(perform, task, str(worker.name))
    worker.log_event(topic, json.dumps(asdict(trial) | {"key": key}))


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
        address: Registered(str(worker["name"]), int(worker["nthreads"]))
        for address, worker in workers.items()
    }


def refuse_to_go_on_alone(client: Client) -> None:
    """Raise RunError if the scheduler is gone; with it went all that was sent, even if it comes back."""
    if client.status != "running":
        raise RunError(_SCHEDULER_GONE)
