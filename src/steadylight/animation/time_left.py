"""How long the rest of a run takes, from the tasks that are done."""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from steadylight.engines.performing import machine_of

if TYPE_CHECKING:
    from steadylight.engines import Task
    from steadylight.settings import RenderSettings

RECENT: Final = 40
"""Tasks of a stage whose mean duration stands for those to come."""

KERNELS: Final[Mapping[str, float]] = {"prepare": 2.0}
"""Seconds that a worker's first task of a stage takes longer, since kernels are compiled; 1 if it is not named. Two
cores take 1 to 3 s, and 4 to 10 s for `prepare`, if the kernels are in no cache."""

LEAST: Final = 0.1
"""Seconds that a task takes however small its pictures are, to read, to start its kernels and to write."""

PATHS: Final = ("prepare", "gather", "shade")
"""Stages that tell how long others take: their time is that of light paths, which differs most between scenes."""

PIXELS: Final = 12 * 256 * 144
"""Pixels of all frames for which `usual` has no other factors."""


def usual(settings: RenderSettings) -> Mapping[str, float]:
    """Seconds of all tasks of a stage, beside those of `prepare`: geometric means of five films.

    `prepare` does not grow with the film, but its paths take as long as those of the other stages do in that scene:
    within a factor of 1.3 for `gather` and 1.8 for `shade`, while `prepare` itself took 4.5 to 46 s.

    Args:
        settings: of the run.
    """
    film = settings.width * settings.height * len(settings.frames) / PIXELS
    # Neither four times as many frames nor pixels half as wide make four times as many records.
    records = math.sqrt(film)
    samples = film * settings.spp / 16
    return {
        "prepare": 1.0,
        "look": 0.13 * film,
        "gather": 1.4 * records,
        "merge": 0.01 * records,
        "audit": 0.19 * samples,
        "fill": 0.2 * records,
        "smooth": 0.13 * records,
        "shade": 0.6 * samples,
        "aovs": 0.04 * film,
        "concatenate": 0.01 * records,
    }


class TimeLeft:
    """Learns from the tasks of a run, as they end, what those to come will take."""

    def __init__(self, tasks: Iterable[Task], settings: RenderSettings) -> None:
        """Know nothing yet of how long they take.

        Args:
            tasks: all tasks of the run.
            settings: of the run.
        """
        self._total = Counter(task.stage for task in tasks)
        self._usual = usual(settings)
        self._first: dict[str, float] = {}
        self._later: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RECENT))
        self._begun: set[tuple[str, str]] = set()

    def add(self, stage: str, seconds: float, worker: str = "") -> None:
        """Learn from a task that is done.

        The first task of a worker in a stage compiles its kernels: it counts without `KERNELS`, and only while there is
        no other, unless the stage has but one.

        Args:
            stage: of the task.
            seconds: that it took.
            worker: that did it; empty if that is not known.
        """
        first = bool(worker) and (stage, worker) not in self._begun
        if first:
            self._begun.add((stage, worker))
            seconds = max(seconds - KERNELS.get(stage, 1.0), seconds / 2)
        if first and self._total[stage] > 1:
            self._first.setdefault(stage, seconds)
        else:
            self._later[stage].append(seconds)

    def seconds(self, left: Mapping[str, int], workers: int) -> float | None:
        """Wall-clock seconds until the run is done; None while nothing is known of light paths.

        Stages of which no task is done yet are foretold by what is usual beside those that are known. Workers of one
        machine share its cores, all of which the task had that prepares.

        Args:
            left: number of tasks that are not done, by stage.
            workers: that share them.
        """
        left = {stage: count for stage, count in left.items() if count > 0}
        known = {stage: sum(later) / len(later) for stage, later in self._later.items()}
        scale = self._scale(known) or self._scale(self._first)
        if scale is None:
            return None if left else 0.0
        workers = max(workers, 1)
        machines = len({machine_of(worker) for _, worker in self._begun}) or workers
        total = 0.0
        for stage, count in left.items():
            if stage in known:
                total += known[stage] * count / min(workers, count)
            else:
                each = max(scale * self._usual[stage] / self._total[stage], LEAST)
                foretold = each * count / min(machines, count)
                # No task takes longer than a first one, which compiled the kernels.
                most = self._first.get(stage, math.inf) * count / min(workers, count)
                total += min(foretold, most)
        return total

    def _scale(self, known: Mapping[str, float]) -> float | None:
        """Factor between the seconds that `usual` gives for stages and those that they take in this run.

        It is the geometric mean over those of PATHS that are known, weighted by their usual seconds; None if none is.

        Args:
            known: mean seconds of a task, by stage.
        """
        weight = {stage: self._usual[stage] for stage in PATHS if stage in known}
        if not weight:
            return None
        logs = (
            part * math.log(max(known[stage] * self._total[stage], 1e-3) / self._usual[stage])
            for stage, part in weight.items()
        )
        return math.exp(sum(logs) / sum(weight.values()))
