"""Engines: run named tasks whose inputs and outputs are files.

An engine knows nothing about rendering; its tests use arithmetic. `readiness` decides which tasks of the plan may
start; an engine only runs them. `in_process` runs in this process (tests, debugging); `dask_cluster` on processes of
this machine, on jobs of a batch system, or on the workers of an existing Dask scheduler.
"""

from __future__ import annotations

from pathlib import Path

from steadylight.engines.base import Attempt, Engine, Task
from steadylight.errors import SettingsError
from steadylight.settings import ExecutionSettings
from steadylight.sites import BATCH_SYSTEMS

__all__ = ["Attempt", "Engine", "Task", "check_engine", "make_engine"]


def make_engine(execution: ExecutionSettings, folder: Path | None = None) -> Engine:
    """Start the engine for the settings; close it, or use it in a `with` statement.

    Args:
        execution: where the work runs; must pass `check_engine`.
        folder: for logs of batch jobs and for certificates; all nodes must see it. Not touched on one machine.
            The working directory if None.

    Raises:
        SettingsError: no scheduler responds at the address, or none can be started.
    """
    cluster = execution.cluster
    # Imported where needed, because Dask takes half a second to load.
    if cluster == "in-process":
        from steadylight.engines.in_process import InProcess

        return InProcess(execution.attempts)
    from steadylight.engines.dask_cluster import DaskCluster

    return DaskCluster(execution.workers, cluster, execution.attempts, execution.site, folder)


def check_engine(execution: ExecutionSettings) -> None:
    """Check that the engine for the settings is available, without starting anything.

    Raises:
        SettingsError: the kind of cluster is unknown, the site settings have no effect with it, or the batch
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
            f"({', '.join(BATCH_SYSTEMS)}), or the address of a running Dask scheduler, "
            "`tcp://HOST:PORT` or `tls://HOST:PORT`"
        )
    useless = site.for_jobs + (["tls"] if site.tls is not None and not cluster.startswith("tls://") else [])
    if useless:
        raise SettingsError(
            f"--site: {', '.join(useless)}: has no effect with --cluster {cluster}; leave it out, or choose a "
            f"batch system ({', '.join(BATCH_SYSTEMS)})"
        )
