"""Workers that are jobs of a batch system: submitted as work asks for them, replaced, given back.

dask-jobqueue writes, submits and cancels the jobs. How many there should be is decided here and not by Dask's
adaptive scaling, which sees only tasks that were sent, while ours wait for a worker before they are; which takes
a gap between two passes for the end of the work; and which does not replace every job that ends.

The batch system's word on a job is never the last one. A worker that is registered works, whatever the queue
says; a job counts as gone when its worker left and does not come back, or when two listings in a row lack it.
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

# Jobs that end before their worker has registered, one after the other, will go on to do so.
_MOST_FALSE_STARTS = 3
_SECONDS_BETWEEN_LISTINGS = 5.0
_SECONDS_TO_COME_BACK = 20.0
_SECONDS_BETWEEN_REFUSED_SUBMISSIONS = 15.0
_MOST_REFUSED_SUBMISSIONS = 20
_MOST_SUBMISSIONS_AT_ONCE = 8
_SECONDS_OF_NO_USE = 30.0
# A worker that has used less than this part of its walltime is as good as it gets.
_FRESH = 0.2


@dataclass
class _Job:
    """A job that was submitted, and what is known of its worker."""

    name: str
    job: Any
    seen: bool = False
    started: float = 0.0
    missed_since: float | None = None
    unlisted: int = 0
    idle_since: float | None = None


@dataclass
class _Refusals:
    """Submissions that the batch system refused one after the other."""

    count: int = 0
    last: float = float("-inf")


class _Listing:
    """What the batch system says of its jobs, asked in a thread because the answer may take half a minute.

    Attributes:
        jobs: whose worker had not come when it was asked.
        listed: as of `listed_jobs`, once it is there.
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
        """Whether the answer has come."""
        return not self._thread.is_alive()


class BatchWorkers:
    """Keeps jobs of a batch system connected to a scheduler.

    Attributes:
        seconds_without_worker: for ever, since queues may be long.
        most: jobs at most.
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
        """Submit nothing yet.

        Args:
            client: of the scheduler that the workers shall register with.
            system: the batch system.
            site: what the site asks of a job.
            most: jobs at most, unless the site settings say.
            folder: for logs and the sign that workers are wanted; visible on the nodes.
            security: with paths of files; None without TLS.
        """
        self.most = site.maximum_workers or most
        self._client = client
        self._system = system
        self._site = site
        self._folder = folder.resolve()
        self._security = security
        self._least = min(site.minimum_workers, self.most)
        # No more on bad hosts than on good ones.
        self._most_with_bad = 2 * self.most
        self._walltime = walltime_of(system, site)
        # What is known is when the worker came, not when the job began.
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
        # Jobs that a killed command left in the queue find their sign gone, and end as they start.
        for stale in self._folder.glob("wanted-*"):
            stale.unlink(missing_ok=True)
        self._marker = self._folder / f"wanted-{self._session}"
        self._marker.touch()

    @property
    def may_grow(self) -> bool:
        """Whether jobs are to come that may run on further hosts: some wait, or more will be submitted."""
        jobs = self._jobs.values()
        to_come = len(jobs) < self._most_with_bad or not all(job.seen for job in jobs)
        return to_come and sum(job.seen and job.name not in self._avoided for job in jobs) < self.most

    @property
    def grows(self) -> bool:
        """Whether a job waits, or one will be submitted for the tasks that there were at the last look."""
        return self.may_grow and (
            not all(job.seen for job in self._jobs.values()) or len(self._useful()) < self._wanted
        )

    @property
    def count(self) -> int:
        """Jobs that run or wait in the queue, and at first the number that there may be."""
        return len(self._jobs) or self.most

    def ours(self, known: Mapping[str, Registered]) -> dict[str, Registered]:
        """Workers whose job was not given up, and workers of other sites, which nobody here started."""
        prefix = f"{self._session}-"
        return {
            address: worker
            for address, worker in known.items()
            if worker.name in self._jobs or not worker.name.startswith(prefix)
        }

    def eager(self, present: int) -> bool:  # noqa: ARG002 - queues are slow
        """Never: queues have a pace of their own."""
        return False

    def label(self, name: str, address: str) -> str:
        """Name, job and address."""
        job = self._jobs.get(name)
        return f"{name} {address}" if job is None else f"{name} (job {job.job.job_id}) {address}"

    def has_time(self, name: str, seconds: float) -> bool:
        """Whether a task of so many seconds ends before the job does; a job that is fresh gets any task."""
        job = self._jobs.get(name)
        if job is None or not job.seen:
            return True
        used = time.monotonic() - job.started
        left = self._walltime - used - 0.5 * self._margin
        return used < _FRESH * self._walltime or left > 1.2 * seconds

    def expired(self, name: str) -> bool:
        """Whether a job's walltime was up; systems round it to minutes."""
        return name in self._expired or self._is_expired(self._jobs.get(name))

    def tend(self, registered: Collection[str], workload: Workload) -> None:
        """Notice what became of jobs, give back those that are idle, submit those that are needed.

        Raises:
            RunError: jobs end again and again before their worker has registered, or none can be submitted.
            SettingsError: the very first job was refused.
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
        """Jobs that are not on a bad host: those are kept, so that the system puts others in their place elsewhere."""
        return [job for job in self._jobs.values() if job.name not in self._avoided]

    def end(self, name: str, address: str, *, hung: bool) -> str:  # noqa: ARG002 - known by its job
        """Cancel the job of a worker that hangs; one that left may be started again by its nanny."""
        job = self._jobs.get(name)
        if job is None:
            return "the worker left or its machine cannot be reached any more"
        words = last_words(self._folder, job.job.job_id)
        if self._is_expired(job):
            self._expired.add(name)
        if hung:
            self._cancel(job)
            return f"the worker hangs; job {job.job.job_id} was cancelled"
        reason = f"the worker of job {job.job.job_id} left or its machine cannot be reached any more"
        return f"{reason}; it said: {words}" if words else reason

    def stop(self, names: Collection[str]) -> None:
        """Cancel jobs whose task is not wanted any more."""
        for name in set(names) & self._jobs.keys():
            self._cancel(self._jobs[name])

    def late(self, address: str) -> None:
        """Its job was cancelled; it has no more to say."""

    def close(self) -> None:
        """Cancel all jobs."""
        self._marker.unlink(missing_ok=True)
        for job in list(self._jobs.values()):
            self._cancel(job)

    # What became of jobs ----------------------------------------------------------------------------------

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
        """See whether jobs whose worker has not come are still in the queue."""
        if self._listing is not None and self._listing.there:
            listing, self._listing = self._listing, None
            self._read(listing)
        waiting = [job for job in self._jobs.values() if not job.seen]
        if waiting and self._listing is None and now - self._last_listing >= _SECONDS_BETWEEN_LISTINGS:
            self._last_listing = now
            self._listing = _Listing(self._system, waiting)

    def _read(self, listing: _Listing) -> None:
        """Each listing counts once, and only for jobs that were submitted before it."""
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
            words = last_words(self._folder, job.job.job_id)
            raise RunError(
                f"{self._false_starts} jobs ended before their worker reached this machine "
                f"({self._client.scheduler.address}), the last was {job.job.job_id}; "
                f"{f'it said: {words}' if words else f'see {self._folder}'}\n"
                "Check `prologue`, `python` and `host` or `interface` of the --site file, then run the same "
                "command again"
            )

    def _is_expired(self, job: _Job | None) -> bool:
        return job is not None and job.seen and time.monotonic() - job.started > self._walltime - self._margin

    # More and fewer ---------------------------------------------------------------------------------------

    def _give_back(self, useful: list[_Job], workload: Workload, wanted: int, now: float) -> None:
        """Cancel jobs that have been idle for long while there are more than wanted, or that are near their end.

        One that stays idle while there is work has no time left for any of it.
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
        """Submit a job; whether the batch system took it."""
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
        """A submission failed: for good if it was the first, for a while if there were others before."""
        words = words.strip()
        if not self._submitted:
            raise SettingsError(f"--cluster {self._system}: the batch system refused the job: {words}")
        self._refusals = _Refusals(self._refusals.count + 1, now)
        _log.warning("a job could not be submitted: %s", words)
        if self._refusals.count >= _MOST_REFUSED_SUBMISSIONS and not self._jobs:
            raise RunError(f"the batch system takes no more jobs: {words}; run the same command again later")

    def _cancel(self, job: _Job) -> None:
        self._jobs.pop(job.name, None)
        with suppress(Exception):
            self._client.sync(job.job.close)
