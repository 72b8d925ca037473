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
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from distributed import Client, Future, get_worker

from steadylight.engines import Attempt, Task
from steadylight.engines.hosts import Hosts
from steadylight.engines.performing import Trial, describe, perform_here
from steadylight.engines.pools import Demand, Registered, refuse_to_go_on_alone, registered
from steadylight.engines.stalls import Stalls
from steadylight.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from steadylight.engines.pools import WorkerPool
    from steadylight.engines.readiness import Readiness
    from steadylight.sites import FaultSettings

_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_BETWEEN_EAGER_LOOKS = 0.05
# Asking after every worker costs the scheduler time, so many are asked after less often.
_WORKERS_PER_SECOND = 200

# Sending one task after the other costs about 0.01 s each. A second task waits at a worker if the first is
# short, so that this is hidden, and so many that they last 0.05 s; behind a long one none waits, because a
# worker that falls idle first should have it.
_SHORT_SECONDS = 2.0
_QUEUE_SECONDS = 0.05
_QUEUE_LENGTH = 16

_Ended = tuple[Attempt, Exception | None]
"""An attempt, and the error that ends the run if the task may not be tried again."""


@dataclass
class _Flight:
    """A task that was sent: to whom, and what holds it there."""

    task: Task
    attempt: int
    address: str
    host: str
    future: Future


class Session:
    """One run of a set of tasks: what was sent where, and what comes back."""

    def __init__(
        self,
        client: Client,
        pool: WorkerPool,
        readiness: Readiness,
        perform: Callable[[Task], Mapping[str, Any]],
        faults: FaultSettings,
    ) -> None:
        self._client = client
        self._pool = pool
        self._readiness = readiness
        self._perform = perform
        self._faults = faults
        self._hosts = Hosts(faults.forgive_after)
        self._stalls = Stalls(faults)
        # Names of their own for everything, because a scheduler may serve other runs at the same time.
        self._topic = f"steadylight-{uuid.uuid4().hex}"
        self._events: queue.SimpleQueue[tuple[str, str, Any]] = queue.SimpleQueue()
        self._flights: dict[str, _Flight] = {}
        self._given_up: dict[str, _Flight] = {}
        self._workers: dict[str, Registered] = {}
        self._labels: dict[str, str] = {}
        self._queues: dict[str, deque[str]] = {}
        self._paces: dict[str, float] = {}
        self._waiting_since: dict[str, float] = {}
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
        busy = self._busy
        futures = [flight.future for flight in self._flights.values()]
        self._flights.clear()
        with suppress(Exception):
            self._client.unsubscribe_topic(self._topic)
        if futures:
            self._pool.stop(busy)
            with suppress(Exception):
                self._client.cancel(futures, force=True)

    # Sending ----------------------------------------------------------------------------------------------

    def _send(self) -> None:
        """Send tasks while there is one that may start and a worker that has room for it."""
        # To find that none of thousands of tasks suits a worker takes long, so those on bad hosts are not asked.
        good = [address for address in self._queues if not self._hosts.avoided(self._workers[address].host)]
        candidates = good or list(self._queues)
        useless: set[str] = set()
        while self._readiness.next is not None:
            free = [address for address in candidates if address not in useless and self.has_room(address)]
            if not free:
                return
            # The emptiest first; among those by name, so that runs are alike.
            address = min(free, key=lambda address: (len(self._queues[address]), self._workers[address].name))
            if not self._send_to(address):
                useless.add(address)

    def _send_to(self, address: str) -> bool:
        """Send a worker the next task that suits it; whether there was one."""
        taken = self._readiness.take(lambda task: self._suits(task, address))
        if taken is None:
            return False
        task, attempt = taken
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
        self._waiting_since.pop(task.key, None)
        self._flights[key] = _Flight(task, attempt, address, self._workers[address].host, future)
        self._queues[address].append(key)
        future.add_done_callback(lambda _: self._events.put(("settled", key, None)))
        return True

    def _suits(self, task: Task, address: str) -> bool:
        """Whether a worker is a good place for a task, or as good as any that can be had."""
        if not self._pool.has_time(self._workers[address].name, self._paces.get(task.stage, 0.0)):
            return False
        if self._is_good(self._workers[address].host, task):
            return True
        if any(self._is_good(worker.host, task) for worker in self._workers.values()):
            return False
        # A better host may still come, but the run does not wait for it for ever.
        waited = time.monotonic() - self._waiting_since.setdefault(task.key, time.monotonic())
        return not self._pool.may_grow or waited > self._faults.forgive_after

    def _is_good(self, host: str, task: Task) -> bool:
        return not self._hosts.avoided(host) and host not in self._readiness.failed_on(task)

    def has_room(self, address: str) -> bool:
        """Whether a worker should be sent another task now: see `_SHORT_SECONDS`."""
        waiting = self._queues[address]
        if not waiting:
            return True
        # Several threads would not wait but run side by side.
        if self._workers[address].threads > 1 or len(waiting) >= _QUEUE_LENGTH:
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
        if flight is not None:
            if kind == "report":
                self._forget(key)
                yield self._note(flight, Trial(**report))
            else:
                yield from self._settle(key, flight)
        elif kind == "report" and key in self._given_up:
            yield from self._note_late(self._given_up.pop(key), Trial(**report))

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
        host = flight.host
        self._labels[flight.address] = trial.worker
        if trial.outcome == "done":
            pace = self._paces.get(task.stage, trial.seconds)
            self._paces[task.stage] = 0.7 * pace + 0.3 * trial.seconds
            self._stalls.note_done(task.stage, trial.seconds)
            self._hosts.succeeded(host)
            self._readiness.done(task)
            return Attempt(task=task, attempt=flight.attempt, **vars(trial)), None
        cause = str(trial.result.get("cause", "task"))
        # With nowhere else to go, a fault is the task's own, or the run would try for ever.
        elsewhere = self._elsewhere(host)
        error = self._readiness.failed(task, trial.result, host, charged=cause != "host" or not elsewhere)
        trial = replace(trial, result={**trial.result, **self._blame(host, task, severe=cause == "host")})
        return Attempt(task=task, attempt=flight.attempt, **vars(trial), cause=cause), error

    def _note_late(self, flight: _Flight, trial: Trial) -> Iterator[_Ended]:
        """A worker that was given up has finished after all; if nobody else is at the task, that is as good."""
        self._pool.late(flight.address)
        if trial.outcome == "done" and self._readiness.withdraw(flight.task):
            self._readiness.done(flight.task)
            yield Attempt(task=flight.task, attempt=flight.attempt, **vars(trial)), None

    def _blame(self, host: str, task: Task, *, severe: bool = False) -> dict[str, Any]:
        """Count a failure against a host; what to say of it if it is avoided from now on."""
        if not self._elsewhere(host):
            return {}
        seconds = self._hosts.failed(host, task.key, severe=severe)
        if seconds is None:
            return {}
        self._readiness.excuse(host)
        return {"host_avoided": host, "host_avoided_s": seconds}

    def _elsewhere(self, host: str) -> bool:
        """Whether there is, or may come, another host that is not a bad one."""
        return self._pool.may_grow or any(
            worker.host != host and not self._hosts.avoided(worker.host) for worker in self._workers.values()
        )

    def _forget(self, key: str) -> None:
        """A flight has ended; releasing its future lets the scheduler forget it too."""
        flight = self._flights.pop(key)
        with suppress(KeyError, ValueError):
            self._queues[flight.address].remove(key)

    # Workers ----------------------------------------------------------------------------------------------

    def _lose(self, address: str, complaint: str = "", *, alone: bool = True) -> Iterator[_Ended]:
        """A worker is gone, or hangs: the oldest of its tasks was running; the others go back as if never sent.

        Args:
            address: of the worker.
            complaint: why it counts as hung; empty if it is gone.
            alone: whether no other worker was lost at the same time.
        """
        waiting = self._queues.pop(address, None)
        if waiting is None:
            return
        worker, label = self._workers.pop(address), self._labels[address]
        self._stalls.forget(address)
        lost = [self._flights.pop(key) for key in waiting]
        if complaint and lost:
            self._given_up[waiting[0]] = lost[0]
        reason = self._pool.end(worker.name, address, hung=bool(complaint))
        reason = f"{complaint}: {reason}" if complaint else reason
        with suppress(Exception):
            self._client.cancel([flight.future for flight in lost], force=True)
        for flight in lost[1:]:
            self._readiness.give_back(flight.task)
        if lost:
            task = lost[0].task
            cause = "hung" if complaint else "walltime" if self._pool.expired(worker.name) else "lost"
            charged = cause == "hung" or (cause == "lost" and alone)
            error = self._readiness.lost(task, reason, worker.host, charged=charged)
            result = {"error": reason}
            if cause != "walltime" and alone:
                result |= self._blame(worker.host, task)
            yield Attempt(task, "lost", lost[0].attempt, 0.0, 0.0, label, result, cause), error

    @property
    def _busy(self) -> set[str]:
        return {self._workers[address].name for address, waiting in self._queues.items() if waiting}

    @property
    def _patience(self) -> float:
        """How long not to look at the workers: shorter while one is missed that will come soon."""
        if self._pool.eager(len(self._queues)):
            return _SECONDS_BETWEEN_EAGER_LOOKS
        return max(_SECONDS_BETWEEN_LOOKS, len(self._queues) / _WORKERS_PER_SECOND)

    def _look_at_workers(self) -> Iterator[_Ended]:
        """Learn which workers there are, end those that hang, and see to it that there are enough."""
        now = time.monotonic()
        if now - self._last_look < self._patience:
            return
        self._last_look = now
        known = self._pool.ours(registered(self._client))
        # Before their processes are replaced, and with them the record of how they ended.
        gone = [address for address in self._queues if address not in known]
        for address in gone:
            yield from self._lose(address, alone=len(gone) == 1)
        for address, complaint in self._complaints(known):
            yield from self._lose(address, complaint)
            known.pop(address)
        for address, worker in known.items():
            if address not in self._queues:
                self._queues[address] = deque()
                self._labels[address] = self._pool.label(worker.name, address)
            self._workers[address] = worker
        avoided = {worker.name for worker in known.values() if self._hosts.avoided(worker.host)}
        demand = Demand(self._readiness.open, self._busy, avoided)
        self._pool.tend({worker.name for worker in known.values()}, demand)
        # Those that were given back get no task any more, though they may still be registered.
        kept = self._pool.ours(known)
        for address in [address for address in self._queues if address not in kept]:
            yield from self._lose(address)
        if known:
            self._last_worker = now
        elif now - self._last_worker > self._pool.seconds_without_worker:
            raise RunError(
                f"there has been no worker for {self._pool.seconds_without_worker:.0f} s: start one with `dask "
                f"worker {self._client.scheduler.address} --nthreads 1`, then run the same command again"
            )

    def _complaints(self, known: Mapping[str, Registered]) -> list[tuple[str, str]]:
        """Workers that hang, and why they count as hung."""
        found = []
        for address, waiting in self._queues.items():
            worker = known.get(address)
            if worker is None or not waiting:
                self._stalls.forget(address)
                continue
            stage = self._flights[waiting[0]].task.stage
            complaint = self._stalls.complaint(address, waiting[0], stage, worker.heartbeat, worker.percent)
            if complaint:
                found.append((address, complaint))
        return found


def _perform_on_worker(
    perform: Callable[[Task], Mapping[str, Any]], task: Task, topic: str, key: str
) -> None:
    """What a worker does: perform the task and report. Runs in the worker process."""
    worker = get_worker()
    trial = perform_here(perform, task, str(worker.name))
    worker.log_event(topic, json.dumps(asdict(trial) | {"key": key}))
