"""Estimates how long the rest of a run takes, from the tasks that are done."""

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
"""Number of recent tasks of a stage whose mean duration predicts the remaining ones."""

KERNELS: Final[Mapping[str, float]] = {"prepare": 2.0}
"""Extra seconds of a worker's first task of a stage, which compiles kernels; 1 for stages not listed. Two cores take
1 to 3 s, and 4 to 10 s for `prepare`, if the kernels are not cached."""

LEAST: Final = 0.1
"""Minimum seconds of a task, however small the image: to read, start kernels and write."""

PATHS: Final = ("prepare", "gather", "shade")
"""Stages from which the time of others is estimated: they trace light paths, whose cost differs most between scenes."""

PIXELS: Final = 12 * 256 * 144
"""Pixels of all frames together at which the numbers in `usual` apply as written."""


def usual(settings: RenderSettings) -> Mapping[str, float]:
    """Seconds of all tasks of each stage, relative to `prepare`: about the geometric means of seven films.

    The time of `prepare` does not grow with the film, but it shows how long light paths take in the scene: the ratios
    hold within a factor of 3.3, while `prepare` itself took 5 to 24 s. `gather` has the ratio of rooms full of things
    instead of the mean, 1.4: their films take longest, and there it counts most.

    Args:
        settings: settings of the run.
    """
    film = settings.width * settings.height * len(settings.frames) / PIXELS
    # Records grow more slowly than pixels: neither four times the frames nor half the pixel size quadruples them.
    records = math.sqrt(film)
    samples = film * settings.spp / 16
    return {
        "prepare": 1.0,
        "look": 0.06 * film,
        "gather": 1.9 * records,
        "merge": 0.01 * records,
        "audit": 0.1 * samples,
        "fill": 0.2 * records,
        "smooth": 0.08 * records,
        "shade": 0.6 * samples,
        "aovs": 0.04 * film,
        "concatenate": 0.01 * records,
    }


class TimeLeft:
    """Learns from the finished tasks of a run how long the remaining ones will take."""

    def __init__(self, tasks: Iterable[Task], settings: RenderSettings) -> None:
        """Start without any measurement.

        Args:
            tasks: all tasks of the run.
            settings: settings of the run.
        """
        self._total = Counter(task.stage for task in tasks)
        self._usual = usual(settings)
        self._first: dict[str, float] = {}
        self._later: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RECENT))
        self._begun: set[tuple[str, str]] = set()

    def add(self, stage: str, seconds: float, worker: str = "") -> None:
        """Learn from a finished task.

        A worker's first task of a stage compiles kernels. It counts without the time in `KERNELS`, and only until
        another task of the stage is done, unless the stage has only one task.

        Args:
            stage: stage of the task.
            seconds: duration of the task.
            worker: worker that did it; empty if unknown.
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
        """Wall-clock seconds until the run is done; None until a stage in `PATHS` has been measured.

        Stages without a finished task are estimated from `usual`, scaled by the stages that were measured. Workers on
        one machine share its cores, all of which the `prepare` task had for itself.

        Args:
            left: number of tasks that are not done, by stage.
            workers: number of workers that share them.
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
                # No task takes longer than the first one of its stage, which compiled the kernels.
                most = self._first.get(stage, math.inf) * count / min(workers, count)
                total += min(foretold, most)
        return total

    def _scale(self, known: Mapping[str, float]) -> float | None:
        """Seconds that stages take in this run, relative to `usual`; None if no stage in PATHS was measured.

        It is the geometric mean over the measured stages in PATHS, weighted by their usual seconds.

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
