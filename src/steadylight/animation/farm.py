"""A run whose tasks are done by independent commands: `steadylight perform`.

A render farm decides which task runs when and where. Each command checks the inputs of its tasks, does them as any
worker would, and leaves a note of each attempt. The last one gathers the notes and makes video, statistics and report.
All of them share the lock of the run directory, so that no `render` works on it at the same time.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Self

from steadylight.animation.film import compile_film, read_display
from steadylight.animation.notes import gather_notes, leave_note
from steadylight.animation.plan import make_tasks
from steadylight.animation.provenance import RunRecord, check_versions, read_run
from steadylight.animation.sessions import SessionLog
from steadylight.animation.statistics import collect_statistics
from steadylight.animation.tasks import perform, validators_of
from steadylight.errors import InputError, RunError, SettingsError
from steadylight.renderers import find_renderer
from steadylight.storage import RunDirectory
from steadylight.storage.store import is_url

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from steadylight.atomic_file import Validator
    from steadylight.engines import Attempt, Task
    from steadylight.renderers.base import Renderer
    from steadylight.settings import RenderSettings

FINISH: Final = "finish"
"""Given in place of a key: make video, statistics and report of a run whose tasks are all done."""

_NUMBERS: Final = re.compile(r"(\d{1,6})(?:-(\d{1,6})(?::(\d{1,6}))?)?")
_SHOWN: Final = 5
"""Maximum number of keys that a message lists."""


def step_of(task: Task) -> str:
    """Name of a task's step (all tasks that differ only in frame, window or part): the stage, with any audit round."""
    audit_round = task.arguments["round"]
    return f"{task.stage}-{audit_round}" if audit_round else task.stage


def number_of(task: Task) -> int | None:
    """Number of a task within its step: frame, window or part; None if it is the only one."""
    rest = task.key.removeprefix(step_of(task)).lstrip("-")
    return int(rest) if rest else None


@dataclass(frozen=True)
class FarmRun:
    """A run directory that `render` has prepared, as described by its own files.

    Attributes:
        directory: the run directory.
        record: content of `run.json`.
        title: title of the film.
        renderer: the renderer of the run.
        tasks: all tasks, in the order of the plan.
    """

    directory: RunDirectory
    record: RunRecord
    title: str
    renderer: Renderer
    tasks: tuple[Task, ...]

    @classmethod
    def open(cls, root: Path | str) -> Self:
        """Read a run directory without writing anything.

        Raises:
            SettingsError: it is not a run directory, is damaged, or is at a URL.
        """
        if is_url(str(root)):
            raise SettingsError(
                f"{root}: a farm needs a run directory in a folder that all its machines see, not at a URL"
            )
        directory = RunDirectory(root)
        record = read_run(directory)
        renderer = find_renderer(record.settings.renderer)
        can, aovs = renderer.capabilities, directory.aovs.is_dir()
        tasks = make_tasks(record.settings, record.selected, can, record.survey, aovs=aovs)
        title = directory.read_record()["scene"].get("title", directory.root.resolve().name)
        return cls(directory, record, str(title), renderer, tasks)

    @property
    def settings(self) -> RenderSettings:
        """The settings that determine the bytes."""
        return self.record.settings

    @property
    def selected(self) -> tuple[int, ...]:
        """Numbers of the first-pass frames."""
        return self.record.selected

    @cached_property
    def validators(self) -> Mapping[str, Validator]:
        """How each kind of output is read back and validated, by suffix."""
        return validators_of(self.renderer, self.settings, self.record.scene_hash)

    def choose(self, words: Sequence[str]) -> list[Task]:
        """Tasks by key, or by step and numbers, such as `shade:1-8,12`; in the order of the plan.

        Raises:
            SettingsError: there is no such task; the message lists those that exist.
        """
        known = {task.key for task in self.tasks}
        keys: set[str] = set()
        for word in words:
            step, colon, numbers = word.partition(":")
            if word in known:
                keys.add(word)
            elif colon:
                keys |= self._of_step(word, step, _numbers_in(word, numbers))
            else:
                raise SettingsError(
                    f"KEY {word!r}: no such task in {self.directory.root}; its steps are {self._steps()}"
                )
        return [task for task in self.tasks if task.key in keys]

    def _of_step(self, word: str, step: str, numbers: set[int]) -> set[str]:
        tasks = {number_of(task): task.key for task in self.tasks if step_of(task) == step}
        if not tasks:
            raise SettingsError(f"KEY {word!r}: no step {step!r} in this run; its steps are {self._steps()}")
        missing = sorted(numbers - tasks.keys())
        if missing:
            there = ", ".join(str(number) for number in list(tasks)[:_SHOWN] if number is not None)
            raise SettingsError(
                f"KEY {word!r}: step {step} has no task {missing[0]}; it has {there or 'one, without a number'}"
                + (f", ... {list(tasks)[-1]}" if len(tasks) > _SHOWN else "")
            )
        return {tasks[number] for number in numbers}

    def _steps(self) -> str:
        return ", ".join([*dict.fromkeys(map(step_of, self.tasks)), FINISH])

    def perform(self, tasks: Sequence[Task], threads: int | None = None) -> Iterator[Attempt | Task]:
        """Do tasks in this process, one after the other; yield each attempt, and each task that was already done.

        Args:
            tasks: of this run, in order.
            threads: threads that a task may use; all cores if None.

        Raises:
            InputError: an input of a task is missing or damaged.
            BackendError: this machine has other versions of the packages that determine the bytes.
            TaskFailed: a task failed; those before it are done.
            SettingsError: a render command is working on the run.
        """
        from steadylight.engines.in_process import InProcess

        check_versions(self.directory.root, self.record.versions)
        work = functools.partial(perform, directory=str(self.directory.root.resolve()), threads=threads)
        with self.directory:
            self.directory.take(shared=True)
            checked: set[str] = set()
            for task in tasks:
                if self.directory.is_done(task, self.validators)[0]:
                    yield task
                    continue
                self._check_inputs(task, checked)
                self.directory.remove_outputs(task)
                for attempt in InProcess(attempts=1).run((task,), work):
                    leave_note(self.directory, attempt)
                    yield attempt

    def _check_inputs(self, task: Task, checked: set[str]) -> None:
        """Check that the tasks that a task needs are done and valid; those in `checked` are not read again."""
        before = {other.key: other for other in self.tasks}
        for key in task.needs:
            if key in checked:
                continue
            done, faults = self.directory.is_done(before[key], self.validators)
            if not done:
                why = faults[0] if faults else f"task {key} is not done yet"
                raise InputError(
                    f"{self.directory.root}: {task.key} cannot start: {why}; perform {key} first, then {task.key}"
                )
            checked.add(key)

    def finish(self) -> tuple[dict[str, Any], list[str]]:
        """Make video, statistics and report of a run whose tasks are all done.

        Returns:
            Content of `stats.json`, and a sentence for each damaged line or file of the logs.

        Raises:
            RunError: tasks are not done, or their files are damaged; the message names them.
            SettingsError: another command is working on the run.
        """
        directory = self.directory
        with directory:
            directory.take()
            display = read_display(directory)
            aside = [
                *directory.set_journal_damage_aside(),
                *SessionLog.set_damage_aside(directory.root),
                *gather_notes(directory),
            ]
            waiting, faults = directory.pending(self.tasks, self.validators)
            if waiting:
                keys = ", ".join(task.key for task in waiting[:_SHOWN])
                more = f" and {len(waiting) - _SHOWN} more" if len(waiting) > _SHOWN else ""
                what = f"{len(waiting)} of {len(self.tasks)} tasks are not done: {keys}{more}"
                words = [*faults, f"{directory.root}: {what}; perform them, then {FINISH} again"]
                raise RunError("\n".join(words))
            results = {task.key: directory.read_result(task.key) for task in self.tasks}
            statistics = collect_statistics(
                self,
                self.record.variant,
                results=results,
                journal=directory.read_journal(),
                sessions=SessionLog.read_all(directory.root),
            )
            return compile_film(directory, self.settings, display, statistics), aside


def _numbers_in(word: str, text: str) -> set[int]:
    """Numbers of a comma list of `A`, `A-B` and `A-B:STEP`, as farms write them."""
    numbers: set[int] = set()
    for item in text.split(","):
        match = _NUMBERS.fullmatch(item.strip())
        first, last, step = (int(part) if part else None for part in match.groups()) if match else (None,) * 3
        if first is None or (last is not None and last < first) or step == 0:
            raise SettingsError(f"KEY {word!r}: {item.strip()!r} is neither a number nor a range such as 1-8")
        numbers |= set(range(first, (first if last is None else last) + 1, step or 1))
    return numbers
