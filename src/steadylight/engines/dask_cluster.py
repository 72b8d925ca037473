"""The engine for one machine or many: workers of a Dask cluster (local, batch system, or existing scheduler).

Dask only transports task names and small results. `readiness` decides which tasks may start, in which order and how
often, and `dispatcher` chooses the worker of each task, so that

- a worker does one task at a time, whatever its number of threads: the renderer uses the cores itself;
- when a worker dies, it is known which task it was running, and no other task is blamed;
- tasks queue behind others at a worker only if these are short (see `readiness.bundle_size` and
  `Dispatcher.has_room`).
"""

from __future__ import annotations

import asyncio
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import dask
from dask.system import cpu_count
from distributed import Client
from distributed.comm import connect

from steadylight.engines.certificates import forget, forget_others, security_of, temporary_security
from steadylight.engines.dispatcher import Dispatcher
from steadylight.engines.local_workers import LocalWorkers
from steadylight.engines.pools import ForeignWorkers
from steadylight.engines.private_folder import PrivateFolder
from steadylight.engines.readiness import Readiness
from steadylight.engines.scheduler import OwnScheduler
from steadylight.errors import SettingsError
from steadylight.sites import BATCH_SYSTEMS, SiteSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from distributed.security import Security

    from steadylight.engines.base import Attempt, Task
    from steadylight.engines.pools import WorkerPool
    from steadylight.sites import BatchSystem

_SECONDS_TO_CONNECT = 20.0
_SECONDS_TO_CLOSE = 5.0

_THREADS_PER_CORE = 4
"""Threads that all local workers together may use for each core of the machine. At times all workers but one wait for
what that one prepares. If each worker could use only its share of the cores, two workers on two cores would take a
third longer for a furnished room than one worker. Four workers on two cores, with two threads each, lose nothing; more
were not tried (docs/experiments.md)."""


def threads_of_local_worker(cores: int, workers: int) -> int:
    """Threads that each local worker may use: at least 1, at most the number of cores."""
    return max(1, min(cores, _THREADS_PER_CORE * cores // workers))


class DaskCluster:
    """Runs tasks on worker processes, each one task at a time; a killed worker is replaced.

    Attributes:
        threads_per_worker: threads that a task may use, at least 1: the cores of a job, or the result of
            `threads_of_local_worker`; None for workers of an existing scheduler.
    """

    def __init__(
        self,
        workers: int = 1,
        cluster: str = "local",
        attempts: int = 3,
        site: SiteSettings | None = None,
        folder: Path | None = None,
    ) -> None:
        """Start a local cluster (loopback only), prepare to submit jobs, or connect to a scheduler.

        Args:
            workers: processes of the local cluster, or maximum number of jobs; ignored for an existing scheduler.
            cluster: `local`, a batch system, or the address of a Dask scheduler: `tcp://...` or `tls://...`
                (certificates from the site settings or Dask's own configuration).
            attempts: number of times a task may fail before the run gives up, at least 1.
            site: batch system settings, certificates, and how long faulty workers and hosts are tolerated.
            folder: for a batch system's logs and certificates; visible on all nodes. The working directory if
                None.

        Raises:
            SettingsError: no scheduler responds at the address, or certificates cannot be read.
        """
        self._attempts = attempts
        self._site = site or SiteSettings()
        self._own: OwnScheduler | None = None
        self._scratch: PrivateFolder | None = None
        self._client: Any = None
        self._pool: WorkerPool | None = None
        self._certificates = (folder or Path.cwd()).resolve() / f"tls-{os.getpid()}"
        if folder is not None:
            forget_others(self._certificates)
        self._hushed = _hush()
        self.threads_per_worker: int | None = None
        try:
            if cluster == "local":
                self._start_local(workers)
            elif cluster in BATCH_SYSTEMS:
                self._start_batch(cluster, workers, self._certificates.parent)
            else:
                self._client = _connect(cluster, self._site)
                self._pool = ForeignWorkers(self._client)
        except BaseException:
            self.close()
            raise

    def _start_local(self, workers: int) -> None:
        self._scratch = PrivateFolder()
        security = temporary_security(self._scratch.path)
        address = self._start_scheduler("127.0.0.1", 0, security, self._scratch)
        self._pool = LocalWorkers(workers, address, self._scratch.path)
        self.threads_per_worker = threads_of_local_worker(int(cpu_count()), workers)

    def _start_scheduler(
        self, host: str, port: int, security: Security | None, scratch: PrivateFolder
    ) -> str:
        """Start a scheduler in this process and connect to it; returns its address."""
        self._own = OwnScheduler(host, port, security, scratch.path)
        self._client = Client(self._own.cluster, set_as_default=False)
        return str(self._own.cluster.scheduler_address)

    def _start_batch(self, system: BatchSystem, workers: int, folder: Path) -> None:
        from steadylight.engines.batch_jobs import cores_of
        from steadylight.engines.batch_workers import BatchWorkers

        site, security = self._site, None
        if site.tls is not None:
            security = security_of(site.tls)
        elif site.encrypted:
            security = temporary_security(self._certificates)
        self._scratch = PrivateFolder()
        self._start_scheduler(_host_for_nodes(system, site), site.port, security, self._scratch)
        self._pool = BatchWorkers(self._client, system, site, workers, folder, security=security)
        self.threads_per_worker = cores_of(system, site)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def workers(self) -> int:
        """Number of worker processes: as requested, or as the existing scheduler has now."""
        return self._pool.count if self._pool is not None else 0

    @property
    def address(self) -> str:
        """Address of the scheduler, where further workers may register."""
        return str(self._client.scheduler.address)

    @property
    def dashboard_link(self) -> str | None:
        """Address of Dask's dashboard, if there is one."""
        if self._own is not None:
            return self._own.dashboard_link
        with suppress(OSError, KeyError, ValueError, AttributeError):
            return str(self._client.dashboard_link) or None
        return None

    def run(self, tasks: Sequence[Task], perform: Callable[[Task], Mapping[str, Any]]) -> Iterator[Attempt]:
        """Perform every task after its needs; yield each attempt as it ends.

        When the caller stops iterating, or an error ends the run, tasks that have not started are cancelled, and
        local workers that are still busy are killed. A running task of an existing scheduler cannot be stopped and
        ends on its own.

        Args:
            tasks: in order of priority; needs that are not in it count as done.
            perform: does the work of a task; must pickle; sent with every bundle of tasks, so keep it small.

        Raises:
            TaskFailed: a task failed the maximum number of times, or repeatedly killed its worker.
            InputError: a task found that the user's input is wrong.
            RunError: no worker is available.
            ValueError: the tasks' keys or needs contradict each other.
        """
        assert self._pool is not None, "the engine is closed"
        readiness = Readiness(tasks, self._attempts)
        dispatcher = Dispatcher(self._client, self._pool, readiness, perform, self._site.faults)
        try:
            yield from dispatcher.attempts()
        finally:
            dispatcher.stop()

    def close(self) -> None:
        """Stop the workers and the scheduler; running tasks of local workers are killed."""
        client, pool, own, scratch = self._client, self._pool, self._own, self._scratch
        self._client, self._pool, self._own, self._scratch = None, None, None, None
        if pool is not None and not isinstance(pool, LocalWorkers):
            # Jobs are cancelled through the client.
            with suppress(Exception):
                pool.close()
        if client is not None:
            with suppress(Exception):
                client.close(timeout=_SECONDS_TO_CLOSE)
        if isinstance(pool, LocalWorkers):
            pool.close()
        if own is not None:
            with suppress(Exception):
                own.cluster.close(timeout=_SECONDS_TO_CLOSE)
        if scratch is not None:
            scratch.remove()
        with suppress(OSError):
            forget(self._certificates)
        for handler, level in self._hushed:
            handler.setLevel(level)
        self._hushed = []


def _host_for_nodes(system: BatchSystem, site: SiteSettings) -> str:
    """The address at which the nodes reach this machine."""
    from distributed.utils import get_ip, get_ip_interface

    if site.host is not None:
        return site.host
    interface = site.interface or dask.config.get(f"jobqueue.{system}.interface", None)
    if interface is None:
        return str(get_ip())
    try:
        return str(get_ip_interface(interface))
    except ValueError as error:
        raise SettingsError(
            f"--site: interface: {error}; or give the `host` at which nodes reach this machine"
        ) from error


def _connect(address: str, site: SiteSettings) -> Client:
    """Connect a client to the scheduler at an address."""
    security = None if site.tls is None else security_of(site.tls)
    try:
        # A failed client leaves a thread behind that may block later clients, so the connection is tested first.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(asyncio.run, _knock(address, security)).result()
        return Client(address, set_as_default=False, timeout=_SECONDS_TO_CONNECT, security=security)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise SettingsError(
            f"--cluster {address}: no Dask scheduler responds there ({error}); "
            "check the address, or start one with `dask scheduler`"
            + ("; a TLS scheduler needs certificates: set [tls] in a --site file" if "tls" in address else "")
        ) from error


async def _knock(address: str, security: Security | None) -> None:
    """Test the connection to a scheduler."""
    from distributed.security import Security

    known = security or Security()
    comm = await connect(address, timeout=_SECONDS_TO_CONNECT, **known.get_connection_args("client"))
    await comm.close()


def _hush() -> list[tuple[logging.Handler, int]]:
    """Keep Dask's logs off the terminal; returns the levels to restore. Relevant problems are raised as errors."""
    handlers = {
        handler
        for name in list(logging.root.manager.loggerDict)
        if name.split(".")[0] in {"distributed", "tornado", "bokeh"}
        for handler in logging.getLogger(name).handlers
    }
    levels = [(handler, handler.level) for handler in handlers]
    for handler in handlers:
        handler.setLevel(logging.CRITICAL + 1)
    return levels
