"""WHERE work runs: an engine runs named tasks whose inputs and outputs are files.

An engine knows nothing of rendering; it is tested with arithmetic. The plan decides what may start
(readiness), an engine only runs it. `in_process` runs in this process (tests, debugging), `dask_cluster` on
processes of this machine, on jobs of a batch system, or on the workers of a Dask scheduler that is there.
"""

from __future__ import annotations

from pathlib import Path

from steadylight.engines.base import Attempt, Engine, Task
from steadylight.errors import SettingsError
from steadylight.settings import ExecutionSettings
from steadylight.sites import BATCH_SYSTEMS

__all__ = ["Attempt", "Engine", "Task", "check_engine", "make_engine"]


def make_engine(execution: ExecutionSettings, folder: Path | None = None) -> Engine:
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
