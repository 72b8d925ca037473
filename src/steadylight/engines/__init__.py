"""WHERE work runs: an engine runs named tasks whose inputs and outputs are files.

An engine knows nothing of rendering; it is tested with arithmetic. The plan decides what may start
(readiness), an engine only runs it. `in_process` runs in this process (tests, debugging), `dask_cluster` on
a local Dask cluster or any Dask scheduler.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from steadylight.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from steadylight.engines.dask_cluster import DaskCluster
    from steadylight.engines.in_process import InProcess
    from steadylight.settings import ExecutionSettings


@dataclass(frozen=True)
class Task:
    """One unit of work: done when all of `outputs` exist and are valid.

    Attributes:
        key: stage and frame, for example `second_pass-0012`; also the stem of its log lines.
        stage: the part before the dash; a key of its progress bar.
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
    """What came of one try at a task: one line of the journal.

    Attributes:
        task: the task that was tried.
        outcome: `done`, `failed` (the task raised) or `lost` (its worker died or was lost).
        attempt: 1 for the first try.
        seconds: wall-clock seconds on the worker (0 if lost).
        seconds_cpu: CPU seconds of the worker process during the task (all threads).
        worker: name of the worker, with host and process id.
        result: what the task returned (a small plain dict), or the error text.
    """

    task: Task
    outcome: str
    attempt: int
    seconds: float
    seconds_cpu: float
    worker: str
    result: Mapping[str, Any]


class Engine(Protocol):
    """Runs tasks; implemented by `InProcess` and `DaskCluster`."""

    def run(self, tasks: Sequence[Task], perform: Callable[[Task], Mapping[str, Any]]) -> Iterator[Attempt]:
        """Perform every task after its needs; yield each attempt as it ends.

        Needs that are not among `tasks` count as done. A failed or lost task is sent again up to the
        engine's limit.

        Raises:
            TaskFailed: a task failed as often as allowed; everything else that was running is stopped.
        """
        ...

    def close(self) -> None:
        """Stop the workers."""
        ...


def make_engine(execution: ExecutionSettings) -> InProcess | DaskCluster:
    """The engine that the settings ask for, started; close it, or use it in a `with` statement.

    Raises:
        SettingsError: there is no such kind of cluster, or no scheduler answers at the address.
    """
    cluster = execution.cluster
    # Imported where needed, because Dask takes half a second to load.
    if cluster == "in-process":
        from steadylight.engines.in_process import InProcess

        return InProcess(execution.attempts)
    if cluster == "local" or cluster.startswith(("tcp://", "tls://")):
        from steadylight.engines.dask_cluster import DaskCluster

        return DaskCluster(execution.workers, cluster, execution.attempts)
    raise SettingsError(
        f"--cluster {cluster}: not supported; give `local`, `in-process`, or the address of a Dask scheduler "
        "that runs already, `tcp://HOST:PORT` or `tls://HOST:PORT`"
    )
