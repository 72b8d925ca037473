"""Detects hung workers by their progress, not by a timeout alone.

A worker makes progress if its process used the CPU between heartbeats. One that is stopped, swapped out or waiting for
a lost file system does not. One in an endless loop uses the CPU; it is detected by the duration of its task compared
with others of the same stage.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from steadylight.sites import FaultSettings

# Heartbeats alone cost a process about 1 %.
_PERCENT_AT_WORK = 5.0


@dataclass
class _Watched:
    """A running task: its start, its last progress, and the last heartbeat seen."""

    key: str
    since: float
    progress: float
    heartbeat: float


class Stalls:
    """Watches what each worker is doing now."""

    def __init__(self, settings: FaultSettings, clock: Callable[[], float] = time.monotonic) -> None:
        """Start with no worker to watch.

        Args:
            settings: how long faulty workers are tolerated.
            clock: monotonic clock, seconds.
        """
        self._settings = settings
        self._clock = clock
        self._watched: dict[str, _Watched] = {}
        self._longest: dict[str, float] = {}

    def note_done(self, stage: str, seconds: float) -> None:
        """Record the duration of a task."""
        self._longest[stage] = max(self._longest.get(stage, 0.0), seconds)

    def forget(self, address: str) -> None:
        """Stop watching a worker that is gone or idle."""
        self._watched.pop(address, None)

    def complaint(self, address: str, key: str, stage: str, heartbeat: float, percent: float) -> str:
        """Why a worker counts as hung, as a clause; empty while it does not.

        Args:
            address: address of the worker.
            key: key of its current attempt.
            stage: stage of the task.
            heartbeat: time of its last heartbeat, by any clock.
            percent: its CPU use since then, per cent of a core.
        """
        now = self._clock()
        watched = self._watched.get(address)
        if watched is None or watched.key != key:
            self._watched[address] = _Watched(key, now, now, heartbeat)
            return ""
        if heartbeat != watched.heartbeat:
            watched.heartbeat = heartbeat
            if percent >= _PERCENT_AT_WORK:
                watched.progress = now
        silent = now - watched.progress
        if silent > self._settings.stalled_after:
            return f"it has made no progress for {silent:.0f} s"
        limit = self._limit(stage)
        if now - watched.since > limit:
            return f"the task has run for more than {limit:.0f} s, far longer than others of its kind"
        return ""

    def _limit(self, stage: str) -> float:
        if stage not in self._longest:
            return float("inf")
        return max(self._settings.slow_after, self._settings.slow_factor * self._longest[stage])
