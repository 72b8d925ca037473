"""The engine for tests and debugging: one task at a time, in this process and thread."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from dask.system import cpu_count

from steadylight.engines.base import Attempt
from steadylight.engines.performing import perform_here
from steadylight.engines.readiness import Readiness

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from steadylight.engines.base import Task


class InProcess:
    """Runs every task in this process, so that a debugger and Ctrl-C reach it and nothing outlives the process.

    Attributes:
        workers: 1, this process.
        threads_per_worker: cores that the process may use.
        dashboard_link: None; there is no dashboard.
    """

    workers = 1
    dashboard_link: str | None = None

    def __init__(self, attempts: int = 3) -> None:
        """Make the engine.

        Args:
            attempts: number of times a task may fail before the run gives up, at least 1.
        """
        self._attempts = attempts
        self.threads_per_worker: int | None = int(cpu_count())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, tasks: Sequence[Task], perform: Callable[[Task], Mapping[str, Any]]) -> Iterator[Attempt]:
        """Perform every task after its needs; yield each attempt as it ends.

        Args:
            tasks: in order of priority; needs that are not in it count as done.
            perform: does the work of a task.

        Raises:
            TaskFailed: a task failed the maximum number of times.
            InputError: a task found that the user's input is wrong.
            ValueError: the tasks' keys or needs contradict each other.
        """
        readiness = Readiness(tasks, self._attempts)
        while not readiness.finished:
            taken = readiness.take()
            assert taken is not None, "a task without open needs is left while any is"
            task, attempt = taken
            trial = perform_here(perform, task, "in-process")
            verdict = None
            if trial.outcome == "done":
                readiness.done(task)
            else:
                verdict = readiness.failed(task, trial.result)
            yield Attempt(task=task, attempt=attempt, **vars(trial), cause=str(trial.result.get("cause", "")))
            if verdict is not None:
                raise verdict

    def close(self) -> None:
        """Do nothing: no task runs in the background."""
