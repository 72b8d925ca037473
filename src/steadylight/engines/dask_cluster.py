"""The engine for one machine or many: worker processes of a Dask cluster, local or at an address.

Dask carries task names and small results and nothing else; what may start, in which order and how often, is
decided here (`readiness`), and each task is sent to a worker of our choice (`dask_session`), so that

- a worker does one task at a time, whatever its number of threads: the renderer uses the cores itself;
- when a worker dies it is known which task it was doing, and no other is blamed;
- a task waits behind another only if that one is short (see `Session.has_room`).
"""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

import dask
from dask.system import cpu_count
from distributed import Client, LocalCluster

from steadylight.engines.dask_session import Session, registered
from steadylight.engines.local_workers import LocalWorkers
from steadylight.engines.readiness import Readiness
from steadylight.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from steadylight.engines import Attempt, Task

_SCHEDULER_OPTIONS = {
    # We count losses ourselves; the scheduler shall tell of the first at once.
    "distributed.scheduler.allowed-failures": 0,
    # A worker whose task holds Python's lock for minutes is slow, not dead; its process is watched.
    "distributed.scheduler.worker-ttl": None,
}
_SECONDS_TO_CONNECT = 20.0
_SECONDS_TO_CLOSE = 5.0


class DaskCluster:
    """Runs tasks on worker processes, each one task at a time; a killed worker is replaced.

    Attributes:
        threads_per_worker: cores for each local worker, at least 1; None for the workers of an address.
    """

    def __init__(self, workers: int = 1, cluster: str = "local", attempts: int = 3) -> None:
        """Start a local cluster (loopback only), or connect to one.

        Args:
            workers: processes of the local cluster; an address has the workers that it has.
            cluster: `local`, or the address of a Dask scheduler: `tcp://...` or `tls://...` (certificates
                from Dask's own configuration).
            attempts: how often a task may fail before the run gives up, at least 1.

        Raises:
            SettingsError: no scheduler answers at the address.
        """
        self._attempts = attempts
        self._cluster: Any = None
        self._local: LocalWorkers | None = None
        self._hushed = _hush()
        self.threads_per_worker: int | None = None
        try:
            if cluster == "local":
                self._cluster = _start_scheduler()
                self._client = Client(self._cluster, set_as_default=False)
                self._local = LocalWorkers(workers, self._cluster.scheduler_address)
                self.threads_per_worker = max(1, int(cpu_count()) // workers)
            else:
                self._client = _connect(cluster)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def workers(self) -> int:
        """Worker processes: those asked for, or those that the scheduler at the address has now."""
        return self._local.count if self._local is not None else len(registered(self._client))

    @property
    def dashboard_link(self) -> str | None:
        """Address of Dask's live view of the work, where there is one."""
        with suppress(OSError, KeyError, ValueError, AttributeError):
            return str(self._client.dashboard_link) or None
        return None

    def run(self, tasks: Sequence[Task], perform: Callable[[Task], Mapping[str, Any]]) -> Iterator[Attempt]:
        """Perform every task after its needs; yield each attempt as it ends.

        When the caller stops listening, or an error ends the run, tasks that have not started are taken
        back, and local workers that are still busy are killed; a task that runs at an address cannot be
        stopped and ends on its own.

        Args:
            tasks: in order of priority; needs that are not among them count as done.
            perform: does the work of a task; must pickle, and is sent with every task: keep it small.

        Raises:
            TaskFailed: a task failed as often as allowed, or took down its worker again and again.
            InputError: a task found that what the user gave is wrong.
            RunError: no worker can be had.
            ValueError: the tasks' keys or needs contradict each other.
        """
        session = Session(self._client, self._local, Readiness(tasks, self._attempts), perform)
        try:
            yield from session.attempts()
        finally:
            session.stop()

    def close(self) -> None:
        """Stop the workers and the scheduler; what a local worker was doing ends now."""
        client, local, cluster = getattr(self, "_client", None), self._local, self._cluster
        self._client, self._local, self._cluster = None, None, None
        if client is not None:
            with suppress(Exception):
                client.close(timeout=_SECONDS_TO_CLOSE)
        if local is not None:
            local.close()
        if cluster is not None:
            with suppress(Exception):
                cluster.close(timeout=_SECONDS_TO_CLOSE)
        for handler, level in self._hushed:
            handler.setLevel(level)
        self._hushed = []


def _start_scheduler() -> Any:
    """A scheduler in this process, on loopback, with its live view if that can be had."""
    for dashboard in ("127.0.0.1:0", None):
        try:
            with dask.config.set(_SCHEDULER_OPTIONS):
                return LocalCluster(
                    n_workers=0,
                    processes=True,
                    host="127.0.0.1",
                    protocol="tcp",
                    dashboard_address=dashboard,
                    silence_logs=False,
                )
        except Exception:
            if dashboard is None:
                raise
    raise AssertionError


def _connect(address: str) -> Client:
    """A client of the scheduler at an address."""
    try:
        return Client(address, set_as_default=False, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise SettingsError(
            f"--cluster {address}: no Dask scheduler answers there ({error}); "
            "check the address, or start one with `dask scheduler`"
        ) from error


def _hush() -> list[tuple[logging.Handler, int]]:
    """Keep Dask's logs off the terminal; returns what to restore. What matters becomes our errors."""
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
