"""Progress of a run: bars on a terminal, plain lines everywhere else."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING, Final, Self

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from steadylight.animation.time_left import TimeLeft

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from typing import Any

    from rich.console import Console
    from rich.progress import TaskID

    from steadylight.engines import Attempt, Task
    from steadylight.settings import RenderSettings

PASSES: Final = {
    "prepare": "first pass",
    "look": "first pass",
    "gather": "first pass",
    "merge": "first pass",
    "audit": "coverage",
    "fill": "coverage",
    "smooth": "coverage",
    "shade": "second pass",
    "aovs": "AOVs",
    "concatenate": "first pass",
}
"""The pass that each stage belongs to, as shown to users."""


def pass_names(stages: Iterable[str]) -> Mapping[str, str]:
    """The pass of each stage of a run; without a shared cache, the frames are not a second pass but `frames`."""
    return PASSES if set(stages) - {"shade", "aovs"} else {**PASSES, "shade": "frames"}


_TASKS, _FRAMES = ("task", "tasks"), ("frame", "frames")
_UNITS = {
    "first pass": _TASKS,
    "coverage": _TASKS,
    "second pass": _FRAMES,
    "frames": _FRAMES,
    "AOVs": _FRAMES,
}
_SECONDS_BETWEEN_LINES = 10.0


class Tally:
    """Counts what attempts report, pass by pass.

    Attributes:
        total: tasks of each pass of the run, in order.
        done: how many of them are done.
        numbers: sums of what finished tasks returned, pass by pass.
    """

    def __init__(
        self, tasks: Iterable[Task], results: Mapping[str, Mapping[str, Any]], settings: RenderSettings
    ) -> None:
        """Start with the tasks that earlier sessions finished.

        Args:
            tasks: all tasks of the run.
            results: results of finished tasks, by key.
            settings: settings of the run.
        """
        self.total: Counter[str] = Counter()
        self.done: Counter[str] = Counter()
        self.numbers: dict[str, Counter[str]] = {}
        tasks = list(tasks)
        self._names = pass_names(task.stage for task in tasks)
        self._time_left = TimeLeft(tasks, settings)
        self._left = Counter(task.stage for task in tasks)
        self._workers: set[str] = set()
        self._said_black = False
        for task in tasks:
            self.total[self.pass_of(task)] += 1
            self.numbers.setdefault(self.pass_of(task), Counter())
            if task.key in results:
                result = results[task.key]
                if "seconds" in result:
                    self._time_left.add(task.stage, float(result["seconds"]))
                self._count(task, result)

    def add(self, attempt: Attempt) -> None:
        """Count an attempt that has ended."""
        if attempt.outcome == "done":
            self._workers.add(attempt.worker)
            self._time_left.add(attempt.task.stage, attempt.seconds, attempt.worker)
            self._count(attempt.task, attempt.result)

    def remark(self, attempt: Attempt) -> str | None:
        """What users should know at once: a failed or lost attempt, or the first black frame; otherwise None."""
        if attempt.outcome != "done":
            return trouble(attempt)
        if self._said_black or not attempt.result.get("black"):
            return None
        self._said_black = True
        return f"Warning: {black_frames(attempt.task.arguments['frames'])}"

    def time_left(self) -> str:
        """How long the rest of the run takes, in words; empty while that is unknown."""
        return left_in_words(self._time_left.seconds(self._left, len(self._workers)))

    def pass_of(self, task: Task) -> str:
        """Name of the pass that a task belongs to."""
        return self._names[task.stage]

    def words(self, name: str) -> str:
        """The key numbers of a pass: hit rate and records, or misses."""
        numbers = self.numbers[name]
        if name == "AOVs":
            return "depth, normal, position"
        if name == "first pass":
            looked_up = numbers["hits"] + numbers["misses"]
            rate = f"{numbers['hits'] / looked_up:.0%} hits, " if looked_up else ""
            merged = f", {numbers['records_out']:,} merged" if numbers["records_out"] else ""
            return f"{rate}{numbers['records']:,} records{merged}"
        if name == "coverage":
            paths, misses = numbers["looked_up"], counted(numbers["missed"], "miss", "misses")
            return f"{paths:,} paths audited, {misses}, {numbers['added']:,} records added"
        words = f"{counted(numbers['missed'], 'miss', 'misses')}, {numbers['new_records']:,} new records"
        return words if name == "second pass" or numbers["new_records"] else ""  # path tracing has no cache

    def _count(self, task: Task, result: Mapping[str, Any]) -> None:
        self._left[task.stage] -= 1
        self.done[self.pass_of(task)] += 1
        numbers = self.numbers[self.pass_of(task)]
        for key, value in result.items():
            if isinstance(value, int | float):
                # Audit tasks only find misses; the fill task that follows reports the records it added.
                numbers["added" if (task.stage, key) == ("fill", "records") else key] += value  # type: ignore[assignment]


_WHOLE: Final = "whole run"


class Bars:
    """A bar for each pass and one for the whole run, on a terminal."""

    def __init__(self, console: Console, tally: Tally) -> None:
        """Draw nothing until entered."""
        self._tally = tally
        self._progress = Progress(
            TextColumn("{task.description:<11}"),
            BarColumn(bar_width=None, table_column=Column(ratio=1)),
            MofNCompleteColumn(),
            # On a narrow terminal, only this column is cut short.
            TextColumn("{task.fields[words]}", style="dim", table_column=Column(ratio=4, no_wrap=True)),
            TimeElapsedColumn(),
            console=console,
            expand=True,
        )
        self._rows: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        """Start drawing."""
        self._progress.start()
        for name, total in self._tally.total.items():
            self._rows[name] = self._progress.add_task(
                name, total=total, completed=self._tally.done[name], start=False, words=""
            )
        self._rows[_WHOLE] = self._progress.add_task(
            _WHOLE, total=self._tally.total.total(), completed=self._tally.done.total(), words=""
        )
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bars as they are."""
        self._progress.stop()

    def add(self, attempt: Attempt) -> None:
        """Show the effect of an attempt."""
        self._tally.add(attempt)
        name = self._tally.pass_of(attempt.task)
        self._progress.start_task(self._rows[name])
        self._progress.update(
            self._rows[name], completed=self._tally.done[name], words=self._tally.words(name)
        )
        self._progress.update(
            self._rows[_WHOLE], completed=self._tally.done.total(), words=self._tally.time_left()
        )
        remark = self._tally.remark(attempt)
        if remark is not None:
            self._progress.console.print(remark, style="yellow", markup=False, highlight=False)


class Lines:
    """A line at the start and end of a pass, at about every tenth of it, and every few seconds if it is slow."""

    def __init__(self, console: Console, tally: Tally) -> None:
        """Print nothing yet."""
        self._console = console
        self._tally = tally
        self._began: dict[str, float] = {}
        self._last_tenth: Counter[str] = Counter()
        self._last_line = self._start = time.perf_counter()

    def __enter__(self) -> Self:
        """Announce the first pass with tasks left."""
        self._announce()
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to clean up."""

    def add(self, attempt: Attempt) -> None:
        """Print the effect of an attempt, if a line is due."""
        name = self._tally.pass_of(attempt.task)
        self._announce(name)
        self._tally.add(attempt)
        remark = self._tally.remark(attempt)
        if remark is not None:
            self._print(remark)
        if attempt.outcome != "done":
            return
        done, total = self._tally.done[name], self._tally.total[name]
        tenth = 10 * done // total
        slow = time.perf_counter() - self._last_line > _SECONDS_BETWEEN_LINES
        if done == total or tenth > self._last_tenth[name] or slow:
            self._last_tenth[name] = tenth
            self._print(self._line(name))
        self._announce()

    def _line(self, name: str) -> str:
        done, total = self._tally.done[name], self._tally.total[name]
        seconds = time.perf_counter() - self._began.get(name, time.perf_counter())
        far = f"{done} of {counted(total, *_UNITS[name])}"
        words = self._tally.words(name)
        text = ", ".join([f"{name}: {far}", *([words] if words else []), duration(seconds)])
        if done == total:
            text = f"{text}, done"
        left = self._tally.time_left()
        return f"{text}; whole run: {duration(time.perf_counter() - self._start)}, {left}" if left else text

    def _announce(self, name: str | None = None) -> None:
        """Announce the pass that begins: `name`, or the first that is not done."""
        name = name or next((name for name in self._tally.total if self._left(name)), None)
        if name is not None and name not in self._began:
            self._began[name] = time.perf_counter()
            self._last_tenth[name] = 10 * self._tally.done[name] // self._tally.total[name]
            self._print(f"{name}: {counted(self._left(name), *_UNITS[name])} to do")

    def _left(self, name: str) -> int:
        return self._tally.total[name] - self._tally.done[name]

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        self._last_line = time.perf_counter()


def trouble(attempt: Attempt) -> str:
    """A failed or lost attempt in one line."""
    why = str(attempt.result.get("error", "")).splitlines()
    reason = f": {why[0]}" if why else ""
    return f"{attempt.task.key}: attempt {attempt.attempt} {attempt.outcome} on {attempt.worker}{reason}"


def black_frames(frames: Sequence[int]) -> str:
    """Which frames are black, and where to look for the cause."""
    from steadylight.walking.checks import stretches  # imports NumPy, which `--help` need not wait for

    which = f"frame {frames[0]} is" if len(frames) == 1 else f"frames {stretches(frames)} are"
    return f"{which} black: no light reaches what the camera sees. Check the position of the camera and the emitters."


def counted(number: int, one: str, many: str) -> str:
    """A number with its unit: `1 frame`, `1,441 frames`."""
    return f"{number:,} {one if number == 1 else many}"


def left_in_words(seconds: float | None) -> str:
    """The result of `TimeLeft.seconds` as shown to users; empty if it is unknown or nothing is left."""
    return f"about {duration(seconds)} left" if seconds else ""


def duration(seconds: float) -> str:
    """Human-readable duration: `4.2 s`, `3 min 05 s`, `2 h 07 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
