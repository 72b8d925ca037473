"""Bad hosts, and how long they are avoided.

A host where tasks fail that succeed elsewhere is worse than no host: it takes one task after another and fails them
quickly. Failures are therefore counted per host as well as per task, and a host where different tasks failed in a row
gets no tasks for a while.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

_FAILED_TASKS_OF_A_BAD_HOST = 3


@dataclass
class _Record:
    """A host's failed tasks since its last success, and how long and how often it is avoided."""

    failed: set[str] = field(default_factory=set)
    until: float = float("-inf")
    terms: int = 0


class Hosts:
    """Failures and successes by host."""

    def __init__(self, forgive_after: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without records.

        Args:
            forgive_after: seconds for which a bad host is avoided the first time; doubled for each further time
                without a success in between.
            clock: monotonic clock, seconds.
        """
        self._forgive_after = forgive_after
        self._clock = clock
        self._records: dict[str, _Record] = {}

    def failed(self, host: str, key: str, *, severe: bool = False) -> float | None:
        """Record that a task failed or was lost on a host.

        Args:
            host: where.
            key: key of the task; only different tasks count.
            severe: whether the host certainly caused the failure.

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
        """Record a success on a host, which clears its failures."""
        self._records.pop(host, None)

    def doubted(self, host: str) -> bool:
        """Whether anything failed on a host since its last success."""
        return host in self._records

    def avoided(self, host: str) -> bool:
        """Whether a host should get no task now."""
        record = self._records.get(host)
        return record is not None and self._clock() < record.until
