"""Which hosts have shown themselves bad, and for how long they are avoided.

A host where tasks keep failing that succeed elsewhere is a worse place to work than none: it takes task after
task and fails them fast. So failures are counted for each host besides for each task, and a host where
different tasks failed one after the other gets no more of them for a while.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

_FAILED_TASKS_OF_A_BAD_HOST = 3


@dataclass
class _Record:
    """What is known of a host: tasks that failed there since the last success, and its term, if any."""

    failed: set[str] = field(default_factory=set)
    until: float = float("-inf")
    terms: int = 0


class Hosts:
    """Failures and successes by host."""

    def __init__(self, forgive_after: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Know no host.

        Args:
            forgive_after: seconds for which a bad host is avoided the first time; each further time without a
                success in between is twice as long.
            clock: seconds that only grow.
        """
        self._forgive_after = forgive_after
        self._clock = clock
        self._records: dict[str, _Record] = {}

    def failed(self, host: str, key: str, *, severe: bool = False) -> float | None:
        """A task failed or was lost at a host.

        Args:
            host: where.
            key: of the task; only different tasks count.
            severe: whether the failure was of the host's making beyond doubt.

        Returns:
            Seconds for which the host is avoided from now on, if it was not avoided before.
        """
        record = self._records.setdefault(host, _Record())
        record.failed.add(key)
        on_probation = record.terms > 0
        enough = severe or on_probation or len(record.failed) >= _FAILED_TASKS_OF_A_BAD_HOST
        if not enough or self.avoided(host):
            return None
        seconds = self._forgive_after * 2.0**record.terms
        record.until = self._clock() + seconds
        record.terms += 1
        record.failed.clear()
        return seconds

    def succeeded(self, host: str) -> None:
        """A task was done at a host: what was before does not count any more."""
        self._records.pop(host, None)

    def doubted(self, host: str) -> bool:
        """Whether something failed at a host since the last success there."""
        return host in self._records

    def avoided(self, host: str) -> bool:
        """Whether a host should get no task now."""
        record = self._records.get(host)
        return record is not None and self._clock() < record.until
