"""How long would a run take on many nodes? Simulates the real tasks with measured times.

A discrete-event model. Nodes become available after a wait in the queue and start up. The command sends them tasks in
bundles, one submission at a time. Nodes fetch the inputs of their tasks (once per node), work, and fail now and then.
The shared store serves requests one at a time at a limited bandwidth. Two plans are compared: the real one, in which a
task waits only for the parts of the cache that it reads, and one with barriers, in which each stage waits for all of
the previous one.
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

from steadylight.animation.plan import SCENE_FILE, STAGES, files_read
from steadylight.animation.provenance import read_run
from steadylight.engines.readiness import Paces, Readiness, bundle_size
from steadylight.errors import SettingsError
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from steadylight.animation.request import Request
    from steadylight.engines import Task

_EVER: Final = float("inf")
_MOST_FAILURES: Final = 10_000
"""Plus a hundred for each task: with more failures than that, the simulation would not end."""

_COMMAND: Final = -1
"""Takes the place of a node number: the command has finished a submission."""


@dataclass(frozen=True)
class Conditions:
    """The machines on which a run is simulated.

    Attributes:
        nodes: number of nodes.
        queue_wait: mean wait in the queue for a node, seconds; exponentially distributed.
        start: start-up time of a node, seconds: interpreter, libraries, scene, kernels.
        between_failures: mean time between failures of a node, seconds; after one, its tasks are lost, and it queues
            again.
        bandwidth: bytes per second of the shared store, for all nodes together.
        overhead: seconds that a task costs its node besides its work.
        submissions: number per second that the command can make, to all nodes together.
        seed: random seed of waits and failures.
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
    """Result of a simulation.

    Attributes:
        makespan: seconds from the start until the last task is done.
        efficiency: seconds of finished work, divided by nodes times makespan.
        bytes_moved: bytes from the store to the nodes.
        attempts: number of attempts at tasks.
        failures: number of failures of busy nodes; idle nodes lose no work.
    """

    makespan: float
    efficiency: float
    bytes_moved: int
    attempts: int
    failures: int


@dataclass(frozen=True)
class Measured:
    """Times and sizes measured in a finished or unfinished run.

    Attributes:
        seconds: seconds of tasks, by key.
        by_stage: seconds of all measured tasks, by stage; stands in for tasks that were not measured.
        sizes: bytes of the files that tasks read, by name; the scene is `scene`.
    """

    seconds: Mapping[str, float]
    by_stage: Mapping[str, Sequence[float]]
    sizes: Mapping[str, int]

    def of(self, task: Task) -> float:
        """Seconds of a task: its own if measured, otherwise those of another task of its stage."""
        if task.key in self.seconds:
            return self.seconds[task.key]
        known = self.by_stage[task.stage]
        return known[zlib.crc32(task.key.encode()) % len(known)]


def read_measured(root: Path, stages: Iterable[str]) -> Measured:
    """Read the task times of a run from its journal, and the sizes of its files.

    A worker's first task of each stage compiles kernels, and its very first one builds the scene. That time is part of
    the start-up of a node (`Conditions.start`), so these tasks are left out if any other task of their stage was
    measured.

    Args:
        root: a run directory.
        stages: stages that must have task times.

    Raises:
        SettingsError: it is not a run directory, or has no task times for one of the stages.
    """
    run = RunDirectory(root)
    run.read_record()
    lines = [line for line in run.read_journal() if line.get("outcome") == "done"]
    begun = {(line["worker"], line["stage"]): line["task"] for line in reversed(lines)}
    first = set(begun.values())
    usual = {line["stage"] for line in lines if line["task"] not in first}
    lines = [line for line in lines if line["task"] not in first or line["stage"] not in usual]
    by_stage: dict[str, list[float]] = defaultdict(list)
    for line in lines:
        by_stage[str(line["stage"])].append(float(line["seconds"]))
    missing = sorted(set(stages) - by_stage.keys(), key=STAGES.index)
    if missing:
        raise SettingsError(
            f"--times: {root}: has no task times for {', '.join(missing)}; "
            "give a run of the same mode that completed these stages"
        )
    sizes = {path.relative_to(root).as_posix(): path.stat().st_size for path in root.glob("cache/*")}
    if (root / SCENE_FILE).exists():
        sizes["scene"] = (root / SCENE_FILE).stat().st_size
    return Measured({str(line["task"]): float(line["seconds"]) for line in lines}, by_stage, sizes)


def measured_for(request: Request, times: Path | None) -> Measured:
    """Task times for simulating a request.

    Args:
        request: the request to simulate.
        times: a run of the same mode and renderer; the run of the request itself if None.

    Raises:
        SettingsError: there is no such run, or its mode or renderer differs.
    """
    if times is None and not RunDirectory(request.directory).run_file.exists():
        raise SettingsError(
            f"--simulate: {request.directory} has no task times, since it was not rendered yet; give --times RUN, a "
            "rendered run of the same mode"
        )
    root = times or request.directory
    settings = read_run(RunDirectory(root)).settings
    for name in ("mode", "renderer"):
        found, wanted = getattr(settings, name), getattr(request.settings, name)
        if found != wanted:
            raise SettingsError(
                f"--times: {root}: was rendered with --{name} {found}; give a run with --{name} {wanted}"
            )
    return read_measured(root, {task.stage for task in request.tasks})


def simulate(tasks: Sequence[Task], measured: Measured, conditions: Conditions) -> Outcome:
    """Simulate a run.

    Raises:
        SettingsError: nodes fail so often that it would not end.
    """
    return _Simulation(tasks, measured, conditions).run()


def with_barriers(tasks: Sequence[Task]) -> tuple[Task, ...]:
    """The same plan, but each stage, and each round of the audit, waits for all of the previous one."""
    before: tuple[str, ...] = ()
    changed: list[Task] = []
    for _, group in itertools.groupby(tasks, key=lambda task: (task.stage, task.arguments["round"])):
        stage = [dataclasses.replace(task, needs=before) for task in group]
        before = tuple(task.key for task in stage)
        changed += stage
    return tuple(changed)


@dataclass
class _Node:
    """A node: the files it has, the tasks it was sent but has not started, and the time of its next failure."""

    fails: float
    holds: set[str] = field(default_factory=set)
    waiting: deque[Task] = field(default_factory=deque)


class _Simulation:
    """Processes events in time order."""

    def __init__(self, tasks: Sequence[Task], measured: Measured, conditions: Conditions) -> None:
        self._readiness = Readiness(tasks, attempts=1)
        self._tasks = len(tasks)
        self._measured = measured
        self._conditions = conditions
        self._random = random.Random(conditions.seed)  # noqa: S311 - not security-relevant
        # Time, serial number, node or command, and the task that ends or fails; None when a node becomes available.
        self._events: list[tuple[float, int, int, Task | None]] = []
        self._serial = 0
        self._paces = Paces()
        self._store_free = self._command_free = 0.0
        self._idle: list[int] = []
        self._work = 0.0
        self._moved = self._attempts = self._failures = 0

    def run(self) -> Outcome:
        """Simulate until every task is done."""
        now = 0.0
        self._nodes = [self._arrive(number, now, now) for number in range(self._conditions.nodes)]
        while not self._readiness.finished:
            if self._failures > _MOST_FAILURES + 100 * self._tasks:
                raise SettingsError(
                    "--between-failures: nodes fail so often that tasks never finish; give a longer time"
                )
            now, _, number, task = heapq.heappop(self._events)
            if number != _COMMAND:
                self._advance(number, task, now)
            self._assign(now)
        nodes = self._conditions.nodes
        efficiency = self._work / (nodes * now) if now else 1.0
        return Outcome(now, efficiency, self._moved, self._attempts, self._failures)

    def _advance(self, number: int, task: Task | None, now: float) -> None:
        """Handle a node that has become available, has done a task, or has failed during it."""
        node = self._nodes[number]
        if task is not None and now >= node.fails:
            # All tasks that it was sent go back, and the node queues again.
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
        """Schedule a node that was requested at `asked`: by now it may be available, or even have failed."""
        wait = self._conditions.queue_wait
        comes = asked + (self._random.expovariate(1 / wait) if wait else 0.0) + self._conditions.start
        self._push(max(comes, now), number, None)
        between = self._conditions.between_failures
        return _Node(_EVER if between == _EVER else comes + self._random.expovariate(1 / between))

    def _push(self, time: float, number: int, task: Task | None) -> None:
        self._serial += 1
        heapq.heappush(self._events, (time, self._serial, number, task))

    def _assign(self, now: float) -> None:
        """Send tasks while some are ready, a node is idle, and the command is not busy submitting."""
        while self._readiness.next is not None and self._idle and self._command_free <= now:
            number = heapq.heappop(self._idle)
            node = self._nodes[number]
            if node.fails <= now:
                # The node failed while idle, and was requested again at once.
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
        """Start the next task of a node's bundle."""
        node = self._nodes[number]
        task = node.waiting.popleft()
        self._attempts += 1
        end = self._fetch(task, node, now) + self._conditions.overhead + self._measured.of(task)
        # A failure is detected at once.
        self._push(min(end, node.fails), number, task)

    def _fetch(self, task: Task, node: _Node, now: float) -> float:
        """Time at which the node has fetched all missing inputs of a task from the store."""
        wanted = {"scene", *files_read(task)} - node.holds
        size = sum(self._measured.sizes.get(name, 0) for name in wanted)
        node.holds |= wanted
        if not size:
            return now
        self._moved += size
        self._store_free = max(self._store_free, now) + size / self._conditions.bandwidth
        return self._store_free
