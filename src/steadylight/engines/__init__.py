"""WHERE work runs: an engine runs named tasks whose inputs and outputs are files.

An engine knows nothing of rendering; it is tested with arithmetic. The plan decides what may start
(readiness), an engine only runs it. `in_process` runs in this process (tests, debugging), `dask_cluster` on
processes of this machine, on jobs of a batch system, or on the workers of a Dask scheduler that is there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from steadylight.errors import SettingsError
from steadylight.sites import BATCH_SYSTEMS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

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
        cause: why it was not done: `task` (it raised), `input` (what the user gave is wrong), `storage` (the run
            directory cannot be written), `host` (the worker's machine lacks something), `lost` (the worker is
            gone), `hung` (it showed no progress and was ended) or `walltime` (its time was up); empty if done.
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


def make_engine(execution: ExecutionSettings, folder: Path | None = None) -> InProcess | DaskCluster:
    """The engine that the settings ask for, started; close it, or use it in a `with` statement.

    Args:
        execution: where the work runs; `check_engine` has nothing against it.
        folder: for logs of batch jobs and for certificates; all nodes must see it. Not touched on one machine.
            The working directory if None.

    Raises:
        SettingsError: no scheduler answers at the address, or none can be started.
    """
    cluster = execution.cluster
    # Imported where needed, because Dask takes half a second to load.
    if cluster == "in-process":
        from steadylight.engines.in_process import InProcess

        return InProcess(execution.attempts)
    from steadylight.engines.dask_cluster import DaskCluster

    return DaskCluster(execution.workers, cluster, execution.attempts, execution.site, folder)


def check_engine(execution: ExecutionSettings) -> None:
    """See whether the engine that the settings ask for can be had, without starting anything.

    Raises:
        SettingsError: there is no such kind of cluster, the site settings have no meaning there, or the batch
            system's commands are missing.
    """
    cluster, site = execution.cluster, execution.site
    if cluster in BATCH_SYSTEMS:
        from steadylight.engines.batch_jobs import check_batch_system

        check_batch_system(cluster, site)
        return
    address = cluster.startswith(("tcp://", "tls://"))
    if not address and cluster not in {"local", "in-process"}:
        raise SettingsError(
            f"--cluster {cluster}: not supported; give `local`, `in-process`, a batch system "
            f"({', '.join(BATCH_SYSTEMS)}), or the address of a Dask scheduler that runs already, "
            "`tcp://HOST:PORT` or `tls://HOST:PORT`"
        )
    useless = site.for_jobs + (["tls"] if site.tls is not None and not cluster.startswith("tls://") else [])
    if useless:
        raise SettingsError(
            f"--site: {', '.join(useless)}: has no meaning with --cluster {cluster}; leave it out, or choose a "
            f"batch system ({', '.join(BATCH_SYSTEMS)})"
        )
