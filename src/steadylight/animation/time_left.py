"""How long the rest of a run takes, from the tasks that are done."""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from steadylight.engines import Task

RECENT: Final = 40
"""Tasks of a stage whose mean duration stands for those to come."""

USUAL: Final[Mapping[str, float]] = {
    "look": 1.0,
    "gather": 13.0,
    "merge": 0.1,
    "audit": 1.6,
    "fill": 2.0,
    "smooth": 0.7,
    "shade": 5.5,
    "aovs": 0.4,
    "concatenate": 0.1,
}
"""Seconds of all tasks of a stage, beside those of the look: geometric means of four films (gallery, vr-gallery,
living-room, classroom), at 16 samples per pixel for `shade`. They differ by up to three times between scenes, and stand
in only for stages of which no task is done. `prepare` is not among them: it does not grow with the film."""

KERNELS: Final = 1.0
"""Seconds that a worker's first task of a stage takes longer, since kernels are compiled: one to three on two cores."""

USUAL_SAMPLES: Final = 16
"""Samples per pixel for which `USUAL` holds."""


class TimeLeft:
    """Learns from the tasks of a run, as they end, what those to come will take."""

    def __init__(self, tasks: Iterable[Task], spp: int) -> None:
        """Know nothing yet of how long they take.

        Args:
            tasks: all tasks of the run.
            spp: samples per pixel of its frames.
        """
        self._total = Counter(task.stage for task in tasks)
        self._usual = {**USUAL, "shade": USUAL["shade"] * spp / USUAL_SAMPLES}
        self._first: dict[str, float] = {}
        self._later: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RECENT))
        self._begun: set[tuple[str, str]] = set()

    def add(self, stage: str, seconds: float, worker: str = "") -> None:
        """Learn from a task that is done.

        The first task of a worker in a stage compiles its kernels: it is used only while there is no other, and then
        without `KERNELS`.

        Args:
            stage: of the task.
            seconds: that it took.
            worker: that did it; empty if that is not known.
        """
        if worker and (stage, worker) not in self._begun:
            self._begun.add((stage, worker))
            self._first.setdefault(stage, max(seconds - KERNELS, seconds / 2))
        else:
            self._later[stage].append(seconds)

    def seconds(self, left: Mapping[str, int], workers: int) -> float | None:
        """Wall-clock seconds until the run is done; None while nothing is known.

        Stages of which no task is done yet are foretold by what is usual beside those that are known.

        Args:
            left: number of tasks that are not done, by stage.
            workers: that share them.
        """
        known = {stage: mean for stage in self._total if (mean := self._mean(stage)) is not None}
        scales = [
            math.log(max(mean * self._total[stage], 1e-3) / self._usual[stage])
            for stage, mean in known.items()
            if stage in self._usual
        ]
        left = {stage: count for stage, count in left.items() if count > 0}
        if not scales and not left.keys() <= known.keys():
            return None
        scale = math.exp(sum(scales) / len(scales)) if scales else 0.0
        total = 0.0
        for stage, count in left.items():
            each = (
                known[stage] if stage in known else scale * self._usual.get(stage, 0.0) / self._total[stage]
            )
            total += each * count / min(max(workers, 1), count)
        return total

    def _mean(self, stage: str) -> float | None:
        """Mean seconds of a task of a stage, once one is done."""
        later = self._later[stage]
        return sum(later) / len(later) if later else self._first.get(stage)
