"""How long would a run take on many nodes? The real tasks and measured times, played through on paper.

A discrete-event model: nodes come after waiting in a queue, start, are sent tasks in bundles by a command that makes
one submission after the other, fetch what a task reads (once for each node), work, and fail now and then; a store
hands out bytes at a limited rate, one after the other. Two plans are compared: the real one, in which a task waits only
for the parts of the cache that it reads, and the same with barriers, in which each pass waits for all of the pass
before.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import random
import zlib
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from steadylight.animation.plan import SCENE_FILE, STAGES
from steadylight.engines.readiness import Paces, Readiness, bundle_size
from steadylight.errors import SettingsError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from steadylight.engines import Task

_EVER: Final = float("inf")
_COMMAND: Final = -1
"""In the place of a node's number: the command has made a submission."""


@dataclass(frozen=True)
class Conditions:
    """The machines that a run is played through on.

    Attributes:
        nodes: how many.
        queue_wait: mean seconds until the batch system gives a node; exponentially distributed.
        start: seconds from a node's coming to its first task: interpreter, libraries, scene, kernels.
        between_failures: mean seconds of a node between failures; each costs the task at work and a new wait.
        bandwidth: bytes a second that the shared store hands out, to all nodes together.
        overhead: seconds that a task costs its node besides its work.
        submissions: a second, that the command can make to all nodes together.
        seed: of waits and failures.
    """

    nodes: int
    queue_wait: float = 0.0
    start: float = 0.0
    between_failures: float = _EVER
    bandwidth: float = _EVER
    overhead: float = 0.002
    submissions: float = 100.0
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes:
        makespan: seconds from the start to the last task done.
        efficiency: seconds of finished work, over nodes times makespan.
        bytes_moved: from the store to nodes.
        attempts: at tasks.
        failures: of nodes while at work; one that fails idle costs nothing but its absence.
    """

    makespan: float
    efficiency: float
    bytes_moved: int
    attempts: int
    failures: int


@dataclass(frozen=True)
class Measured:
    """What a finished or started run tells of times and sizes.

    Attributes:
        seconds: of tasks, by key.
        by_stage: the same for tasks that were not measured: all that were, by stage.
        sizes: bytes of what tasks read, by name; `scene` for the scene.
    """

    seconds: Mapping[str, float]
    by_stage: Mapping[str, Sequence[float]]
    sizes: Mapping[str, int]

    def of(self, task: Task) -> float:
        """Seconds of a task: its own if it was measured, else those of one of its stage."""
        if task.key in self.seconds:
            return self.seconds[task.key]
        known = self.by_stage[task.stage]
        return known[zlib.crc32(task.key.encode()) % len(known)]


def read_measured(root: Path, stages: Iterable[str]) -> Measured:
    """Times of the tasks of a run, from its journal, and sizes of its files.

    The first task of a worker built the scene and compiled kernels, which is a node's start (`Conditions.start`): it is
    left out where others of its stage were measured.

    Args:
        root: a run directory.
        stages: for which there must be times.

    Raises:
        SettingsError: it is no run directory, or has no times of one of the stages.
    """
    run = RunDirectory(root)
    run.read_record()
    lines = [line for line in run.read_journal() if line.get("outcome") == "done"]
    first = {line["task"] for line in {line["worker"]: line for line in reversed(lines)}.values()}
    usual = {line["stage"] for line in lines if line["task"] not in first}
    lines = [line for line in lines if line["task"] not in first or line["stage"] not in usual]
    by_stage: dict[str, list[float]] = defaultdict(list)
    for line in lines:
        by_stage[str(line["stage"])].append(float(line["seconds"]))
    missing = sorted(set(stages) - by_stage.keys(), key=STAGES.index)
    if missing:
        raise SettingsError(
            f"--times: {root}: holds no times of {', '.join(missing)}; give a run of the same mode that got that far"
        )
    sizes = {path.relative_to(root).as_posix(): path.stat().st_size for path in root.glob("cache/*")}
    if (root / SCENE_FILE).exists():
        sizes["scene"] = (root / SCENE_FILE).stat().st_size
    return Measured({str(line["task"]): float(line["seconds"]) for line in lines}, by_stage, sizes)


def simulate(tasks: Sequence[Task], measured: Measured, conditions: Conditions) -> Outcome:
    """Play a run through."""
    return _Simulation(tasks, measured, conditions).run()


def with_barriers(tasks: Sequence[Task]) -> tuple[Task, ...]:
    """The same plan, but each stage, and each round of the audit, waits for all of the one before."""
    before: tuple[str, ...] = ()
    changed: list[Task] = []
    for _, group in itertools.groupby(tasks, key=lambda task: (task.stage, task.arguments["round"])):
        stage = [dataclasses.replace(task, needs=before) for task in group]
        before = tuple(task.key for task in stage)
        changed += stage
    return tuple(changed)


@dataclass
class _Node:
    """A node: what it holds already, what it was sent and has not begun, and when it fails next."""

    fails: float
    holds: set[str] = field(default_factory=set)
    waiting: deque[Task] = field(default_factory=deque)


class _Simulation:
    """Events in the order of time."""

    def __init__(self, tasks: Sequence[Task], measured: Measured, conditions: Conditions) -> None:
        self._readiness = Readiness(tasks, attempts=1)
        self._measured = measured
        self._conditions = conditions
        self._random = random.Random(conditions.seed)  # noqa: S311 - nothing secret
        # Time, serial number, node or command, and the task that ends or fails; None as a node comes.
        self._events: list[tuple[float, int, int, Task | None]] = []
        self._serial = 0
        self._paces = Paces()
        self._store_free = self._command_free = 0.0
        self._idle: list[int] = []
        self._work = 0.0
        self._moved = self._attempts = self._failures = 0

    def run(self) -> Outcome:
        """Until every task is done."""
        now = 0.0
        self._nodes = [self._arrive(number, now, now) for number in range(self._conditions.nodes)]
        while not self._readiness.finished:
            now, _, number, task = heapq.heappop(self._events)
            if number != _COMMAND:
                self._go_on(number, task, now)
            self._assign(now)
        nodes = self._conditions.nodes
        efficiency = self._work / (nodes * now) if now else 1.0
        return Outcome(now, efficiency, self._moved, self._attempts, self._failures)

    def _go_on(self, number: int, task: Task | None, now: float) -> None:
        """A node has come, has done a task, or has failed during it."""
        node = self._nodes[number]
        if task is not None and now >= node.fails:
            # All that it was sent goes back, and the node comes again.
            self._failures += 1
            for lost in (task, *node.waiting):
                self._readiness.give_back(lost)
            self._nodes[number] = self._arrive(number, now, now)
            return
        if task is not None:
            self._readiness.done(task)
            self._work += self._measured.of(task)
            self._paces.note(task.stage, self._measured.of(task))
        if node.waiting:
            self._start(number, now)
        else:
            heapq.heappush(self._idle, number)

    def _arrive(self, number: int, asked: float, now: float) -> _Node:
        """Let a node come that was asked for some time ago: by now it may be there, and even have failed."""
        wait = self._conditions.queue_wait
        comes = asked + (self._random.expovariate(1 / wait) if wait else 0.0) + self._conditions.start
        self._push(max(comes, now), number, None)
        between = self._conditions.between_failures
        return _Node(_EVER if between == _EVER else comes + self._random.expovariate(1 / between))

    def _push(self, time: float, number: int, task: Task | None) -> None:
        self._serial += 1
        heapq.heappush(self._events, (time, self._serial, number, task))

    def _assign(self, now: float) -> None:
        """Send tasks while some are ready, a node is idle, and the command is not at a submission."""
        while self._readiness.next is not None and self._idle and self._command_free <= now:
            number = heapq.heappop(self._idle)
            node = self._nodes[number]
            if node.fails <= now:
                # It failed while idle, and was asked for again at once.
                self._nodes[number] = self._arrive(number, node.fails, now)
                continue
            taken = self._readiness.take_many(
                size=lambda stage, ready: bundle_size(ready, self._conditions.nodes, self._paces.of(stage))
            )
            node.waiting.extend(task for task, _ in taken)
            self._command_free = now + 1 / self._conditions.submissions
            self._push(self._command_free, _COMMAND, None)
            self._start(number, self._command_free)

    def _start(self, number: int, now: float) -> None:
        """Let a node begin the next task of its bundle."""
        node = self._nodes[number]
        task = node.waiting.popleft()
        self._attempts += 1
        end = self._fetch(task, node, now) + self._conditions.overhead + self._measured.of(task)
        # A node that fails is noticed at once.
        self._push(min(end, node.fails), number, task)

    def _fetch(self, task: Task, node: _Node, now: float) -> float:
        """When all that a task reads and the node lacks has come from the store."""
        wanted = {
            "scene",
            *task.arguments.get("inputs", ()),
            *task.arguments.get("cache", ()),
        } - node.holds
        size = sum(self._measured.sizes.get(name, 0) for name in wanted)
        node.holds |= wanted
        if not size:
            return now
        self._moved += size
        self._store_free = max(self._store_free, now) + size / self._conditions.bandwidth
        return self._store_free
