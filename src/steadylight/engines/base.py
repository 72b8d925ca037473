"""The engine interface: tasks, attempts at them, and the engine that runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, Self


@dataclass(frozen=True)
class Task:
    """One unit of work: done when all of `outputs` exist and are valid.

    Attributes:
        key: stage and frame, for example `shade-00012`; also the stem of its log lines.
        stage: the part before the dash, used in statistics and progress.
        needs: keys of the tasks that must be done first.
        outputs: paths relative to the run directory.
        arguments: plain data only; must pickle.
    """

    key: str
    stage: str
    outputs: tuple[str, ...]
    needs: tuple[str, ...] = ()
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt at a task: one line of the journal.

    Attributes:
        task: the task.
        outcome: `done`, `failed` (the task raised) or `lost` (its worker died or was lost).
        attempt: number of the attempt, from 1.
        seconds: wall-clock seconds on the worker (0 if lost).
        seconds_cpu: CPU seconds of the worker process during the task (all threads).
        worker: name of the worker, with host and process id.
        result: what the task returned (a small plain dict), or the error text.
        cause: why it was not done: `task` (it raised), `input` (the user's input is wrong), `storage` (the run
            directory cannot be written), `host` (the worker's machine lacks something), `lost` (the worker is
            gone), `hung` (it made no progress and was killed) or `walltime` (the job reached its time limit); empty
            if done.
    """

    task: Task
    outcome: str
    attempt: int
    seconds: float
    seconds_cpu: float
    worker: str
    result: Mapping[str, Any]
    cause: str = ""


class Engine(Protocol):
    """Runs tasks; implemented by `InProcess` and `DaskCluster`, which `make_engine` chooses from."""

    @property
    def workers(self) -> int:
        """Current number of worker processes."""

    @property
    def threads_per_worker(self) -> int | None:
        """Threads that a task may use; None for all cores of its machine."""

    @property
    def dashboard_link(self) -> str | None:
        """Address of the dashboard, if there is one."""

    def run(self, tasks: Sequence[Task], perform: Callable[[Task], Mapping[str, Any]]) -> Iterator[Attempt]:
        """Perform every task after its needs; yield each attempt as it ends.

        Needs that are not in `tasks` count as done. A failed or lost task is retried up to the engine's limit.

        Raises:
            TaskFailed: a task failed the maximum number of times; all other running tasks are stopped.
        """

    def close(self) -> None:
        """Stop the workers."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...
