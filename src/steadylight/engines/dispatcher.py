"""One run of a set of tasks on a Dask cluster: which tasks were sent to which worker, and their outcomes.

Tasks are sent in bundles (`readiness.bundle_size`), which a worker processes one task after the other. It reports each
task as it ends, through a scheduler event rather than a result to fetch: the report is delivered before the next task
starts, and cannot be lost with the worker's memory.
"""

from __future__ import annotations

import json
import queue
import time
import uuid
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from distributed import Client, Future

from steadylight.engines.base import Attempt, Task
from steadylight.engines.bundles import perform_bundle
from steadylight.engines.hosts import Hosts
from steadylight.engines.performing import Trial, describe
from steadylight.engines.pools import Registered, Workload, registered, require_scheduler
from steadylight.engines.readiness import MOST_LOSSES, Paces, bundle_size
from steadylight.engines.stalls import Stalls
from steadylight.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from steadylight.engines.pools import WorkerPool
    from steadylight.engines.readiness import MOST_LOSSES, Readiness
    from steadylight.sites import FaultSettings

_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_BETWEEN_EAGER_LOOKS = 0.05
# Querying all workers costs the scheduler time, so large numbers of workers are queried less often.
_WORKERS_PER_SECOND = 200

# Sending takes about 0.01 s. To hide this, the next bundle is queued at a worker during the last task of its current
# one if that task is short. Nothing is queued behind a long task: a worker that becomes idle earlier should get it.
_SHORT_SECONDS = 2.0
# The notice that a worker is gone may arrive before its last reports.
_SECONDS_FOR_LAST_REPORTS = 5.0

_Ended = tuple[Attempt, Exception | None]
"""An attempt, and the error that ends the run if the task may not be retried."""


@dataclass
class _Flight:
    """A task that was sent to a worker.

    Attributes:
        task: the task.
        attempt: number of the attempt, from 1.
        address: address of the worker.
        host: host of the worker.
        future: future of the bundle, shared by its tasks; the scheduler may forget it when the last one is released.
        excused: whether the host has since turned out to be a bad one.
    """

    task: Task
    attempt: int
    address: str
    host: str
    future: Future
    excused: bool = False


class Dispatcher:
    """One run of a set of tasks: sends tasks to workers and collects the outcomes."""

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
        # Unique names for everything, because a scheduler may serve other runs at the same time.
        self._topic = f"steadylight-{uuid.uuid4().hex}"
        self._events: queue.SimpleQueue[tuple[str, str, Any]] = queue.SimpleQueue()
        self._flights: dict[str, _Flight] = {}
        self._given_up: dict[str, _Flight] = {}
        self._workers: dict[str, Registered] = {}
        self._labels: dict[str, str] = {}
        self._queues: dict[str, deque[str]] = {}
        self._paces = Paces()
        self._waiting_since: dict[str, float] = {}
        self._sent = 0
        self._last_look = 0.0
        self._last_worker = time.monotonic()
        self._wipeouts = 0
        client.subscribe_topic(self._topic, self._on_report)

    def attempts(self) -> Iterator[Attempt]:
        """Send tasks that may start and yield their attempts, until all are done or an error is final."""
        while not self._readiness.finished:
            ended = list(self._look_at_workers())
            self._send()
            ended += self._collect(wait=not ended)
            verdict = next((error for _, error in ended if error is not None), None)
            # Workers get their next tasks before the caller processes these attempts.
            if verdict is None:
                self._send()
            for attempt, _ in ended:
                yield attempt
            if verdict is not None:
                raise verdict

    def stop(self) -> None:
        """Cancel tasks that were sent and stop running ones where possible."""
        busy = self._busy
        futures = {flight.future for flight in self._flights.values()}
        self._flights.clear()
        with suppress(Exception):
            self._client.unsubscribe_topic(self._topic)
        if futures:
            self._pool.stop(busy)
            with suppress(Exception):
                self._client.cancel(list(futures), force=True)

    # Sending ----------------------------------------------------------------------------------------------

    def _send(self) -> None:
        """Send tasks while one may start and a worker has room for it."""
        # Testing thousands of tasks against a worker takes long, so workers on bad hosts are skipped.
        good = [address for address in self._queues if not self._hosts.avoided(self._workers[address].host)]
        candidates = good or list(self._queues)
        useless: set[str] = set()
        while self._readiness.next is not None:
            free = [address for address in candidates if address not in useless and self.has_room(address)]
            if not free:
                return
            # The emptiest first, then by name, so that runs are reproducible.
            address = min(free, key=lambda address: (len(self._queues[address]), self._workers[address].name))
            if not self._send_to(address, len(candidates)):
                useless.add(address)

    def _send_to(self, address: str, workers: int) -> bool:
        """Send a worker the next tasks that suit it; returns whether there were any."""
        taken = self._readiness.take_many(
            lambda task: self._suits(task, address),
            lambda stage, ready: self._size(address, stage, ready, workers),
        )
        if not taken:
            return False
        keys = [f"{task.key}-a{attempt}-{uuid.uuid4().hex[:8]}" for task, attempt in taken]
        future = self._client.submit(
            perform_bundle,
            self._perform,
            [(key, task) for key, (task, _) in zip(keys, taken, strict=True)],
            self._topic,
            key=keys[0],
            workers=[address],
            allow_other_workers=False,
            # A worker processes its queue in the order sent: the oldest task is the one that is running.
            priority=-self._sent,
            pure=False,
            retries=0,
        )
        self._sent += 1
        for key, (task, attempt) in zip(keys, taken, strict=True):
            self._waiting_since.pop(task.key, None)
            self._flights[key] = _Flight(task, attempt, address, self._workers[address].host, future)
            self._queues[address].append(key)
        future.add_done_callback(lambda _: self._events.put(("settled", "", keys)))
        return True

    def _size(self, address: str, stage: str, ready: int, workers: int) -> int:
        """Number of tasks of a stage to send to a worker together."""
        worker = self._workers[address]
        # A host that may be bad gets one task at a time.
        if self._hosts.doubted(worker.host):
            return 1
        pace = self._paces.of(stage)
        size = bundle_size(ready, workers, pace)
        while size > 1 and not self._pool.has_time(worker.name, size * pace):
            size -= 1
        return size

    def _suits(self, task: Task, address: str) -> bool:
        """Whether a worker suits a task, or no better one is available."""
        if not self._pool.has_time(self._workers[address].name, self._paces.of(task.stage, unknown=0.0)):
            return False
        if self._is_good(self._workers[address].host, task):
            return True
        if any(self._is_good(worker.host, task) for worker in self._workers.values()):
            return False
        # A better host may become available, but the run does not wait for it forever.
        waited = time.monotonic() - self._waiting_since.setdefault(task.key, time.monotonic())
        return not self._pool.grows or waited > self._faults.forgive_after

    def _is_good(self, host: str, task: Task) -> bool:
        return not self._hosts.avoided(host) and host not in self._readiness.failed_on(task)

    def has_room(self, address: str) -> bool:
        """Whether a worker should be sent more tasks now: see `_SHORT_SECONDS`."""
        waiting = self._queues[address]
        if not waiting:
            return True
        worker = self._workers[address]
        # A worker with several threads would run the tasks in parallel.
        if worker.threads > 1 or len(waiting) > 1 or self._hosts.doubted(worker.host):
            return False
        return self._paces.of(self._flights[waiting[0]].task.stage) < _SHORT_SECONDS

    # Outcomes ---------------------------------------------------------------------------------------------

    def _on_report(self, event: tuple[float, str]) -> None:
        """Receive a worker's report (in the client's own thread)."""
        report = json.loads(event[1])
        self._events.put(("report", report.pop("key"), report))

    def _collect(self, *, wait: bool) -> Iterator[_Ended]:
        """Handle all pending events; with `wait`, first wait for one until the workers are due for a check."""
        with suppress(queue.Empty):
            event = self._events.get(timeout=self._patience if wait else 0)
            while True:
                yield from self._handle(*event)
                event = self._events.get_nowait()

    def _hear_last_reports(self) -> Iterator[_Ended]:
        """Handle the last reports of workers that left; events about their bundles stay queued.

        Reports arrive in the order in which the scheduler received them, so an event sent now arrives after them.
        """
        last = uuid.uuid4().hex
        with suppress(OSError, RuntimeError):  # the scheduler is gone: the next check says so
            self._client.log_event(self._topic, json.dumps({"key": last}))
        others = []
        with suppress(queue.Empty):
            while True:
                event = self._events.get(timeout=_SECONDS_FOR_LAST_REPORTS)
                if event[1] == last:
                    break
                if event[0] == "report":
                    yield from self._handle(*event)
                else:
                    others.append(event)
        for event in others:
            self._events.put(event)

    def _handle(self, kind: str, key: str, content: Any) -> Iterator[_Ended]:
        if kind == "settled":
            yield from self._settle([key for key in content if key in self._flights])
        elif key in self._flights:
            yield self._note(self._forget(key), Trial(**content))
        elif key in self._given_up:
            yield from self._note_late(self._given_up.pop(key), Trial(**content))

    def _settle(self, unreported: Sequence[str]) -> Iterator[_Ended]:
        """Handle the end of a bundle, perhaps without reports: its worker died, or could not unpickle the tasks."""
        if not unreported:
            return
        require_scheduler(self._client)
        future, address = self._flights[unreported[0]].future, self._flights[unreported[0]].address
        error = future.exception(timeout=1.0) if future.status == "error" else None
        if error is None or type(error).__name__ == "KilledWorker":
            yield from self._lose(address)
            return
        # Charge one task, or the run would retry forever; the others have not started.
        first, *others = [self._forget(key) for key in unreported]
        for flight in others:
            self._readiness.give_back(flight.task)
        yield self._note(first, Trial("failed", 0.0, 0.0, self._labels[address], describe(error)))

    def _note(self, flight: _Flight, trial: Trial) -> _Ended:
        task, error = flight.task, None
        host = flight.host
        self._labels[flight.address] = trial.worker
        if trial.outcome == "done":
            self._paces.note(task.stage, trial.seconds)
            self._stalls.note_done(task.stage, trial.seconds)
            self._hosts.succeeded(host)
            self._readiness.done(task)
            self._wipeouts = 0
            return Attempt(task=task, attempt=flight.attempt, **vars(trial)), None
        cause = str(trial.result.get("cause", "task"))
        # If there is no other host, charge the task, or the run would retry forever.
        charged = not (cause == "host" or flight.excused) or not self._elsewhere(host)
        error = self._readiness.failed(task, trial.result, host, charged=charged)
        trial = replace(trial, result={**trial.result, **self._blame(host, task, severe=cause == "host")})
        return Attempt(task=task, attempt=flight.attempt, **vars(trial), cause=cause), error

    def _note_late(self, flight: _Flight, trial: Trial) -> Iterator[_Ended]:
        """Handle a worker that was given up but finished after all; accept its result if the task is not running."""
        self._pool.late(flight.address)
        if trial.outcome == "done" and self._readiness.withdraw(flight.task):
            self._readiness.done(flight.task)
            yield Attempt(task=flight.task, attempt=flight.attempt, **vars(trial)), None

    def _blame(self, host: str, task: Task, *, severe: bool = False) -> dict[str, Any]:
        """Count a failure against a host; returns journal entries if it is avoided from now on."""
        if not self._elsewhere(host):
            return {}
        seconds = self._hosts.failed(host, task.key, severe=severe)
        if seconds is None:
            return {}
        self._readiness.excuse(host)
        for flight in self._flights.values():
            flight.excused = flight.excused or flight.host == host
        return {"host_avoided": host, "host_avoided_s": seconds}

    def _elsewhere(self, host: str) -> bool:
        """Whether another good host is or may become available."""
        return self._pool.may_grow or any(
            worker.host != host and not self._hosts.avoided(worker.host) for worker in self._workers.values()
        )

    def _forget(self, key: str) -> _Flight:
        """Remove a flight that has ended."""
        flight = self._flights.pop(key)
        with suppress(KeyError, ValueError):
            self._queues[flight.address].remove(key)
        return flight

    # Workers ----------------------------------------------------------------------------------------------

    def _lose(self, address: str, complaint: str = "", *, alone: bool = True) -> Iterator[_Ended]:
        """Handle a lost or hung worker: its oldest task was running; the others go back as if never sent.

        Args:
            address: address of the worker.
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
            self._client.cancel(list({flight.future for flight in lost}), force=True)
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

    def _lose_all_but(self, in_use: Mapping[str, Registered]) -> Iterator[_Ended]:
        """Handle workers that are not in use any more: those that had work were lost at the same time."""
        gone = [address for address in self._queues if address not in in_use]
        if any(self._queues[address] for address in gone):
            yield from self._hear_last_reports()
        alone = len(gone) == 1
        busy = {address for address, waiting in self._queues.items() if waiting}
        for address in gone:
            for attempt, error in self._lose(address, alone=alone):
                busy.discard(address)
                yield attempt, error or (None if alone or busy else self._wiped_out(attempt))

    def _wiped_out(self, last: Attempt) -> RunError | None:
        """Count that all busy workers were lost together; the error to raise if that keeps happening.

        No task is charged for losses that others share, so without this limit the run would go on forever.
        """
        self._wipeouts += last.cause == "lost"
        if self._wipeouts <= MOST_LOSSES:
            return None
        return RunError(
            f"all workers that had work died at the same time, {self._wipeouts} times without finishing a task in "
            f"between, the last time: {last.result['error']}; the usual cause is too little memory: render smaller "
            "frames, use fewer workers on the machine, or a machine with more memory, then run the same command again"
        )

    @property
    def _busy(self) -> set[str]:
        return {self._workers[address].name for address, waiting in self._queues.items() if waiting}

    @property
    def _patience(self) -> float:
        """Seconds between checks of the workers; shorter while one is expected soon."""
        if self._pool.eager(len(self._queues)):
            return _SECONDS_BETWEEN_EAGER_LOOKS
        return max(_SECONDS_BETWEEN_LOOKS, len(self._queues) / _WORKERS_PER_SECOND)

    def _look_at_workers(self) -> Iterator[_Ended]:
        """Update the list of workers, end hung ones, and replace missing ones."""
        now = time.monotonic()
        if now - self._last_look < self._patience:
            return
        self._last_look = now
        listed = registered(self._client)
        known = self._pool.ours(listed)
        # Before `tend` replaces lost workers, which deletes the record of how they ended.
        yield from self._lose_all_but(known)
        for address, complaint in self._complaints(known):
            yield from self._lose(address, complaint)
            known.pop(address)
        for address, worker in known.items():
            if address not in self._queues:
                self._queues[address] = deque()
                self._labels[address] = self._pool.label(worker.name, address)
            self._workers[address] = worker
        avoided = {worker.name for worker in known.values() if self._hosts.avoided(worker.host)}
        workload = Workload(self._readiness.open, self._busy, avoided)
        self._pool.tend({worker.name for worker in known.values()}, workload)
        # Released workers get no more tasks, though they may still be registered. Others may have ended meanwhile.
        yield from self._lose_all_but(self._pool.ours(listed))
        if known:
            self._last_worker = now
        elif now - self._last_worker > self._pool.seconds_without_worker:
            raise RunError(
                f"no worker has been available for {self._pool.seconds_without_worker:.0f} s; start one with `dask "
                f"worker {self._client.scheduler.address} --nthreads 1`, then run the same command again"
            )

    def _complaints(self, known: Mapping[str, Registered]) -> list[tuple[str, str]]:
        """Hung workers, and why they count as hung."""
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
