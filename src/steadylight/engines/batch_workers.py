"""Workers as jobs of a batch system: submitted on demand, replaced, released.

dask-jobqueue writes, submits and cancels the jobs. Their number is decided here, because Dask's adaptive scaling does
not fit. It sees only tasks that were already sent, but here tasks are sent only when there is a worker for them. It
takes a gap between two passes for the end of the work. And it does not replace every job that ends.

The batch system's job list alone is never trusted. A registered worker is alive, whatever the queue says. A job counts
as gone when its worker left and does not return, or when it is missing from two listings in a row.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from steadylight.engines.batch_jobs import (
    Scheduler,
    is_listed,
    last_words,
    listed_jobs,
    make_job,
    walltime_of,
)
from steadylight.errors import RunError, SettingsError

if TYPE_CHECKING:
    from distributed import Client
    from distributed.security import Security

    from steadylight.engines.pools import Registered, Workload
    from steadylight.sites import BatchSystem, SiteSettings

_log = logging.getLogger(__name__)

# If several jobs in a row end before their worker registers, further ones will too.
_MOST_FALSE_STARTS = 3
_SECONDS_BETWEEN_LISTINGS = 5.0
_SECONDS_TO_COME_BACK = 20.0
_SECONDS_BETWEEN_REFUSED_SUBMISSIONS = 15.0
_MOST_REFUSED_SUBMISSIONS = 20
_MOST_SUBMISSIONS_AT_ONCE = 8
_SECONDS_OF_NO_USE = 30.0
# A worker that has used less than this fraction of its walltime counts as fresh.
_FRESH = 0.2


@dataclass
class _Job:
    """A submitted job, and the state of its worker."""

    name: str
    job: Any
    seen: bool = False
    started: float = 0.0
    missed_since: float | None = None
    unlisted: int = 0
    idle_since: float | None = None


@dataclass
class _Refusals:
    """Consecutive submissions that the batch system rejected."""

    count: int = 0
    last: float = float("-inf")


class _Listing:
    """The batch system's job list, queried in a thread because the answer may take half a minute.

    Attributes:
        jobs: jobs whose worker had not registered at the time of the query.
        listed: result of `listed_jobs`, when available.
    """

    def __init__(self, system: BatchSystem, jobs: list[_Job]) -> None:
        self.jobs = jobs
        self.listed: set[str] | None = None
        self._thread = threading.Thread(target=self._ask, args=(system,), daemon=True)
        self._thread.start()

    def _ask(self, system: BatchSystem) -> None:
        self.listed = listed_jobs(system)

    @property
    def there(self) -> bool:
        """Whether the answer has arrived."""
        return not self._thread.is_alive()


class BatchWorkers:
    """Keeps jobs of a batch system connected to a scheduler.

    Attributes:
        seconds_without_worker: infinite, because queues may be long.
        most: maximum number of jobs.
    """

    seconds_without_worker = float("inf")

    def __init__(
        self,
        client: Client,
        system: BatchSystem,
        site: SiteSettings,
        most: int,
        folder: Path,
        *,
        security: Security | None,
    ) -> None:
        """Prepare to submit jobs; none is submitted yet.

        Args:
            client: client of the scheduler with which the workers register.
            system: the batch system.
            site: settings of the site's jobs.
            most: maximum number of jobs, unless the site settings give one.
            folder: for logs and for the marker file that says that workers are wanted; visible on the nodes.
            security: certificates as file paths; None without TLS.
        """
        self.most = site.maximum_workers or most
        self._client = client
        self._system = system
        self._site = site
        self._folder = folder.resolve()
        self._security = security
        self._least = min(site.minimum_workers, self.most)
        # At most as many jobs on bad hosts as on good ones.
        self._most_with_bad = 2 * self.most
        self._walltime = walltime_of(system, site)
        # Only the worker's registration time is known, not the start of the job.
        self._margin = min(120.0, 0.35 * self._walltime)
        self._jobs: dict[str, _Job] = {}
        self._expired: set[str] = set()
        self._avoided: Collection[str] = ()
        self._wanted = self.most
        self._submitted = 0
        self._false_starts = 0
        self._refusals = _Refusals()
        self._last_listing = float("-inf")
        self._listing: _Listing | None = None
        self._session = secrets.token_hex(4)
        self._folder.mkdir(parents=True, exist_ok=True)
        # Jobs that a killed command left in the queue find their marker gone and exit when they start.
        for stale in self._folder.glob("wanted-*"):
            stale.unlink(missing_ok=True)
        self._marker = self._folder / f"wanted-{self._session}"
        self._marker.touch()

    @property
    def may_grow(self) -> bool:
        """Whether more jobs may run on further hosts: some are waiting, or more will be submitted."""
        jobs = self._jobs.values()
        to_come = len(jobs) < self._most_with_bad or not all(job.seen for job in jobs)
        return to_come and sum(job.seen and job.name not in self._avoided for job in jobs) < self.most

    @property
    def grows(self) -> bool:
        """Whether a job is waiting, or will be submitted for the tasks known at the last check."""
        return self.may_grow and (
            not all(job.seen for job in self._jobs.values()) or len(self._useful()) < self._wanted
        )

    @property
    def count(self) -> int:
        """Number of running and waiting jobs; before the first submission, the maximum."""
        return len(self._jobs) or self.most

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """Workers whose job was not given up, and workers that were not started by this command."""
        prefix = f"{self._session}-"
        return {
            address: worker
            for address, worker in known.items()
            if worker.name in self._jobs or not worker.name.startswith(prefix)
        }

    def eager(self, present: int) -> bool:  # noqa: ARG002 - queues are slow
        """Always false: jobs may wait in the queue for long."""
        return False

    def label(self, name: str, address: str) -> str:
        """Name, job and address."""
        job = self._jobs.get(name)
        return f"{name} {address}" if job is None else f"{name} (job {job.job.job_id}) {address}"

    def has_time(self, name: str, seconds: float) -> bool:
        """Whether a task of this duration ends before the job does; a fresh job gets any task."""
        job = self._jobs.get(name)
        if job is None or not job.seen:
            return True
        used = time.monotonic() - job.started
        left = self._walltime - used - 0.5 * self._margin
        return used < _FRESH * self._walltime or left > 1.2 * seconds

    def expired(self, name: str) -> bool:
        """Whether a job reached its walltime; systems round it to minutes."""
        return name in self._expired or self._is_expired(self._jobs.get(name))

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Update the state of jobs, release idle ones, submit new ones as needed.

        Raises:
            RunError: jobs keep ending before their worker registers, or none can be submitted.
            SettingsError: the very first job was rejected.
        """
        now = time.monotonic()
        self._notice(registered, now)
        self._list(now)
        self._wanted = min(self.most, max(self._least, workload.tasks))
        self._avoided = workload.avoided
        self._give_back(self._useful(), workload, self._wanted, now)
        missing = min(self._wanted - len(self._useful()), self._most_with_bad - len(self._jobs))
        for _ in range(min(missing, _MOST_SUBMISSIONS_AT_ONCE)):
            if not self._submit(now):
                break

    def _useful(self) -> list[_Job]:
        """Jobs that are not on a bad host. Jobs on bad hosts are kept, so that the system starts others elsewhere."""
        return [job for job in self._jobs.values() if job.name not in self._avoided]

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its job
        """Cancel the job of a hung worker; one that left may be restarted by its nanny."""
        job = self._jobs.get(name)
        if job is None:
            return "the worker left or its machine can no longer be reached"
        words = last_words(self._folder, job.job.job_id, job.name)
        if self._is_expired(job):
            self._expired.add(name)
        if hung:
            self._cancel(job)
            return f"the worker hung; job {job.job.job_id} was cancelled"
        reason = f"the worker of job {job.job.job_id} left or its machine can no longer be reached"
        return f"{reason}; last output: {words}" if words else reason

    def stop(self, names: Collection[str]) -> None:
        """Cancel jobs whose task is no longer needed."""
        for name in set(names) & self._jobs.keys():
            self._cancel(self._jobs[name])

    def late(self, address: str) -> None:
        """Ignored: the job was cancelled."""

    def close(self) -> None:
        """Cancel all jobs."""
        self._marker.unlink(missing_ok=True)
        for job in list(self._jobs.values()):
            self._cancel(job)

    # State of jobs ---------------------------------------------------------------------------------------

    def _notice(self, registered: Collection[str], now: float) -> None:
        for job in list(self._jobs.values()):
            if job.name in registered:
                if not job.seen:
                    job.seen, job.started, self._false_starts = True, now, 0
                job.missed_since = None
            elif job.seen:
                job.missed_since = now if job.missed_since is None else job.missed_since
                if now - job.missed_since > _SECONDS_TO_COME_BACK:
                    self._cancel(job)

    def _list(self, now: float) -> None:
        """Check whether jobs whose worker has not registered are still in the queue."""
        if self._listing is not None and self._listing.there:
            listing, self._listing = self._listing, None
            self._read(listing)
        waiting = [job for job in self._jobs.values() if not job.seen]
        if waiting and self._listing is None and now - self._last_listing >= _SECONDS_BETWEEN_LISTINGS:
            self._last_listing = now
            self._listing = _Listing(self._system, waiting)

    def _read(self, listing: _Listing) -> None:
        """Count jobs as ended that two listings in a row lack; a listing says nothing about jobs submitted after it."""
        if listing.listed is None:
            return
        for job in listing.jobs:
            if job.seen or job.name not in self._jobs:
                continue
            job.unlisted = 0 if is_listed(job.job.job_id, listing.listed) else job.unlisted + 1
            if job.unlisted >= 2:
                self._false_start(job)

    def _false_start(self, job: _Job) -> None:
        self._jobs.pop(job.name)
        self._false_starts += 1
        _log.warning("job %s ended before its worker had registered", job.job.job_id)
        if self._false_starts >= _MOST_FALSE_STARTS:
            words = last_words(self._folder, job.job.job_id, job.name)
            raise RunError(
                f"{self._false_starts} jobs ended before their worker could connect to this machine "
                f"({self._client.scheduler.address}). Last job {job.job.job_id}: "
                f"{words or f'see {self._folder}'}\n"
                "Check `prologue`, `python` and `host` or `interface` of the --site file, then run the same "
                "command again"
            )

    def _is_expired(self, job: _Job | None) -> bool:
        return job is not None and job.seen and time.monotonic() - job.started > self._walltime - self._margin

    # Number of jobs ---------------------------------------------------------------------------------------

    def _give_back(self, useful: list[_Job], workload: Workload, wanted: int, now: float) -> None:
        """Cancel surplus jobs that have been idle for long, and jobs near their time limit.

        A job that stays idle while there is work has too little time left for any task.
        """
        surplus = len(useful) - wanted
        work_waits = workload.tasks > len(workload.busy)
        # Jobs that still wait in the queue go first.
        for job in sorted(useful, key=lambda job: job.seen):
            if job.name in workload.busy:
                job.idle_since = None
                continue
            job.idle_since = now if job.idle_since is None else job.idle_since
            idle_for_long = surplus > 0 and now - job.idle_since > self._site.idle_after
            old = job.seen and now - job.started > _FRESH * self._walltime
            of_no_use = work_waits and old and now - job.idle_since > _SECONDS_OF_NO_USE
            if idle_for_long or of_no_use or self._is_expired(job):
                self._cancel(job)
                surplus -= 1

    def _submit(self, now: float) -> bool:
        """Submit a job; returns whether the batch system accepted it."""
        if now - self._refusals.last < _SECONDS_BETWEEN_REFUSED_SUBMISSIONS:
            return False
        name = f"{self._session}-{self._submitted + 1}"
        job = make_job(
            self._system,
            self._site,
            Scheduler(self._client.scheduler.address, self._security),
            name=name,
            folder=self._folder,
            marker=self._marker,
        )
        try:
            self._client.sync(job.start)
        except (OSError, RuntimeError, ValueError) as error:
            self._refuse(str(error), now)
            return False
        self._submitted += 1
        self._refusals = _Refusals()
        self._jobs[name] = _Job(name, job)
        return True

    def _refuse(self, words: str, now: float) -> None:
        """Handle a failed submission: fatal if it was the first, otherwise retried later."""
        words = words.strip()
        if not self._submitted:
            raise SettingsError(f"--cluster {self._system}: the batch system rejected the job: {words}")
        self._refusals = _Refusals(self._refusals.count + 1, now)
        _log.warning("a job could not be submitted: %s", words)
        if self._refusals.count >= _MOST_REFUSED_SUBMISSIONS and not self._jobs:
            raise RunError(
                f"the batch system accepts no more jobs: {words}; run the same command again later"
            )

    def _cancel(self, job: _Job) -> None:
        self._jobs.pop(job.name, None)
        with suppress(Exception):
            self._client.sync(job.job.close)
