"""Which task may start next, and how often each may be retried; the same on every engine.

Readiness is decided here, not by a scheduler. A task may start when the tasks it needs are done, and tasks start in the
order of the plan. So every engine runs a plan in the same order, and a run resumes by leaving out finished tasks.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from typing import TYPE_CHECKING

from steadylight import errors
from steadylight.errors import InputError, RunError, StorageError, TaskFailed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from typing import Any

    from steadylight.engines.base import Task

# A task that loses its worker more often than this counts as the cause. Up to this number, the machines are blamed.
MOST_LOSSES = 3

# Time the command needs to send a bundle, whatever its size. A bundle should last long enough that this cost is
# negligible, and that the command, which serves all workers, spends at most half of its time on sending. Bundles of
# more than a few dozen tasks save no more time, and all their unfinished tasks go back if the worker is lost.
_SECONDS_TO_SEND = 0.01
_LEAST_SECONDS = 2.0
_MOST_AT_ONCE = 64


def bundle_size(ready: int, workers: int, pace: float) -> int:
    """Number of tasks of a stage to send to a worker together: guided self-scheduling.

    A bundle is a fraction of the remaining tasks. So bundles shrink to single tasks towards the end, and the workers
    finish together (Polychronopoulos and Kuck, "Guided self-scheduling", IEEE Transactions on Computers, 1987). The
    fraction is half of a worker's fair share, because tasks of a stage are not equally long. It is up to a full share
    if that would end before the command has sent a bundle to every other worker. A bundle never has more tasks than it
    needs to be long enough (see `_SECONDS_TO_SEND`).

    Args:
        ready: tasks of the stage that may start, at least 1.
        workers: number of workers that share the tasks, at least 1.
        pace: seconds of one such task; infinity while unknown.
    """
    one_round = _SECONDS_TO_SEND * workers
    part = max(ready // (2 * workers), min(_lasting(one_round, pace), math.ceil(ready / workers)))
    return max(1, min(part, _lasting(max(_LEAST_SECONDS, 2 * one_round), pace)))


def _lasting(seconds: float, pace: float) -> int:
    """Number of tasks that take this long, limited to the maximum bundle size."""
    return math.ceil(seconds / pace) if _MOST_AT_ONCE * pace > seconds else _MOST_AT_ONCE


class Paces:
    """Recent mean duration of tasks of each stage."""

    def __init__(self) -> None:
        """Start without measurements."""
        self._seconds: dict[str, float] = {}

    def note(self, stage: str, seconds: float) -> None:
        """Record the duration of a task."""
        self._seconds[stage] = 0.7 * self._seconds.get(stage, seconds) + 0.3 * seconds

    def of(self, stage: str, unknown: float = float("inf")) -> float:
        """Seconds of a task of a stage; `unknown` while none has been done."""
        return self._seconds.get(stage, unknown)


class Readiness:
    """Order and retry budget of a set of tasks.

    Every task is in one of three states: waiting (for needs, or for its turn), taken, or done. `take` returns the next
    task and `take_many` several; `done`, `failed`, `lost` or `give_back` ends the taken state.
    """

    def __init__(self, tasks: Sequence[Task], attempts: int) -> None:
        """Prepare the order.

        Args:
            tasks: in order of priority; needs that are not in it count as done.
            attempts: number of times a task may fail, at least 1.

        Raises:
            ValueError: two tasks have the same key, or tasks depend on each other in a cycle.
        """
        self._tasks = list(tasks)
        self._budget = attempts
        self._position = {task.key: position for position, task in enumerate(tasks)}
        if len(self._position) != len(self._tasks):
            raise ValueError("two tasks have the same key")
        self._missing: dict[str, set[str]] = {}
        self._dependents: dict[str, list[str]] = {task.key: [] for task in tasks}
        for task in tasks:
            self._missing[task.key] = {need for need in task.needs if need in self._position}
            for need in self._missing[task.key]:
                self._dependents[need].append(task.key)
        self._ready: list[int] = []
        self._ready_of: Counter[str] = Counter()
        for key, missing in self._missing.items():
            if not missing:
                self._wait(key)
        self._taken: set[str] = set()
        self._tries = dict.fromkeys(self._position, 0)
        self._failures: dict[str, Counter[str]] = {key: Counter() for key in self._position}
        self._failed_on: dict[str, set[str]] = {}
        self._losses = dict.fromkeys(self._position, 0)
        self._unfinished = set(self._position)
        self._refuse_cycles()

    @property
    def finished(self) -> bool:
        """Whether every task is done."""
        return not self._unfinished

    @property
    def next(self) -> Task | None:
        """The task that would be taken now; None while all remaining tasks wait for needs or are taken."""
        return self._tasks[self._ready[0]] if self._ready else None

    @property
    def open(self) -> int:
        """Number of tasks that are taken or could be taken now."""
        return len(self._ready) + len(self._taken)

    def take(self, suits: Callable[[Task], bool] | None = None) -> tuple[Task, int] | None:
        """Take the next task.

        Args:
            suits: whether a task may be taken now; any may if None.

        Returns:
            The task and the number of this attempt, from 1; None if no ready task suits.
        """
        return next(iter(self.take_many(suits)), None)

    def take_many(
        self,
        suits: Callable[[Task], bool] | None = None,
        size: Callable[[str, int], int] = lambda _stage, _ready: 1,
    ) -> list[tuple[Task, int]]:
        """Take the next task, and the next ones of the same stage with it.

        Args:
            suits: as for `take`; applies to each task.
            size: maximum number, from the stage of the first task and the number of ready tasks of that stage.

        Returns:
            As for `take`, in the order of the plan; empty if no ready task suits.
        """
        passed_over: list[int] = []
        found: list[Task] = []
        most = 1
        while self._ready and len(found) < most:
            position = heapq.heappop(self._ready)
            task = self._tasks[position]
            if (found and task.stage != found[0].stage) or not (suits is None or suits(task)):
                passed_over.append(position)
                continue
            if not found:
                most = size(task.stage, self._ready_of[task.stage])
            found.append(task)
        for position in passed_over:
            heapq.heappush(self._ready, position)
        for task in found:
            self._ready_of[task.stage] -= 1
            self._tries[task.key] += 1
            self._taken.add(task.key)
        return [(task, self._tries[task.key]) for task in found]

    def give_back(self, task: Task) -> None:
        """Put back a taken task that never started."""
        self._tries[task.key] -= 1
        self._put_back(task)

    def withdraw(self, task: Task) -> bool:
        """Take a waiting task that was believed lost but is done after all; returns whether it was waiting."""
        position = self._position[task.key]
        if position not in self._ready:
            return False
        self._ready.remove(position)
        heapq.heapify(self._ready)
        self._ready_of[task.stage] -= 1
        self._taken.add(task.key)
        return True

    def failed_on(self, task: Task) -> Collection[str]:
        """Hosts where a task has failed, or was lost."""
        return self._failed_on.get(task.key, ())

    def excuse(self, host: str) -> None:
        """Put the failures on a host down to the host, so that no task is charged for them."""
        for failures in self._failures.values():
            failures.pop(host, None)

    def done(self, task: Task) -> None:
        """Record that a taken task is done; tasks that only waited for it may start."""
        self._taken.discard(task.key)
        self._unfinished.remove(task.key)
        for key in self._dependents[task.key]:
            self._missing[key].discard(task.key)
            if not self._missing[key]:
                self._wait(key)

    def failed(
        self, task: Task, result: Mapping[str, Any], host: str = "", *, charged: bool = True
    ) -> Exception | None:
        """Record that a taken task raised; it is retried unless its budget is used up.

        Args:
            task: the task.
            result: `error`, `details` and `kind` as `performing.perform_here` describes a failure.
            host: where it failed.
            charged: whether this uses up the task's budget; not if the host is to blame.

        Returns:
            The error to raise if the task may not be retried.
        """
        self._failures[task.key][host] += charged
        self._failed_on.setdefault(task.key, set()).add(host)
        message, details = str(result.get("error", "")), str(result.get("details", ""))
        kind = getattr(errors, str(result.get("kind")), None)
        if isinstance(kind, type) and issubclass(kind, InputError):
            # The same input would fail again.
            return kind(message)
        failures = self._failures[task.key].total()
        if charged and failures >= self._budget:
            if kind is StorageError:
                return StorageError(message)
            tries = f" ({failures} times)" if failures > 1 else ""
            return TaskFailed(task.key, message + tries, details)
        self._put_back(task)
        return None

    def lost(self, task: Task, reason: str, host: str = "", *, charged: bool = True) -> RunError | None:
        """Record that a taken task's worker died or hung; like `failed`, with its own budget.

        Args:
            task: the task that was running there.
            reason: how the worker ended, as far as known.
            host: where it ran.
            charged: whether the task may be to blame; not if the worker reached its time limit, or others were lost
                with it.
        """
        self._losses[task.key] += charged
        self._failed_on.setdefault(task.key, set()).add(host)
        if self._losses[task.key] > MOST_LOSSES:
            return TaskFailed(
                task.key,
                f"its worker died {self._losses[task.key]} times while running it, the last time: {reason}; "
                "the usual cause is too little memory: render smaller frames, use fewer workers on the machine, "
                "or a machine with more memory, then run the same command again",
                reason,
            )
        self._put_back(task)
        return None

    def _put_back(self, task: Task) -> None:
        self._taken.discard(task.key)
        self._wait(task.key)

    def _wait(self, key: str) -> None:
        """Queue a task."""
        position = self._position[key]
        heapq.heappush(self._ready, position)
        self._ready_of[self._tasks[position].stage] += 1

    def _refuse_cycles(self) -> None:
        missing = {key: len(needs) for key, needs in self._missing.items()}
        free = [key for key, count in missing.items() if not count]
        for key in free:
            for dependent in self._dependents[key]:
                missing[dependent] -= 1
                if not missing[dependent]:
                    free.append(dependent)
        if len(free) < len(missing):
            stuck = sorted(key for key, count in missing.items() if count)
            raise ValueError(f"tasks depend on each other in a cycle: {', '.join(stuck)}")
