"""Run: sends the remaining tasks to an engine, then makes the video; implements `steadylight render`."""

from __future__ import annotations

import functools
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

from steadylight.animation.film import compile_film, write_display
from steadylight.animation.notes import gather_notes
from steadylight.animation.plan import SCENE_FILE
from steadylight.animation.provenance import (
    check_same_run,
    check_same_settings,
    describe_run,
    describe_survey,
    load_run,
    read_run,
)
from steadylight.animation.remote import RemoteRun, perform_remote
from steadylight.animation.request import Request
from steadylight.animation.sessions import SessionLog
from steadylight.animation.statistics import collect_statistics, journal_entry
from steadylight.animation.tasks import perform, validators_of
from steadylight.atomic_file import atomic_write, storage_errors
from steadylight.engines import Attempt, Engine, Task, check_engine, make_engine
from steadylight.errors import RunError
from steadylight.renderers.base import ProbingRenderer
from steadylight.scenes.archive import is_archive_of, write_archive
from steadylight.sites import BATCH_SYSTEMS
from steadylight.storage import RunDirectory

Perform = Callable[[Task], Mapping[str, Any]]


_LARGEST_SHOWN = 8 * 2**20
"""Bytes; a notebook links to a larger video instead of embedding it."""


@dataclass(frozen=True, repr=False)
class Run:
    """A finished run.

    Attributes:
        directory: the run directory.
        statistics: the content of `stats.json`.
        frames: the frames, scene-linear EXR files, in order.
        video: the encoded animation.
        report: HTML report of the run.
    """

    directory: Path
    statistics: Mapping[str, Any]
    frames: tuple[Path, ...]
    video: Path
    report: Path

    def __repr__(self) -> str:
        return f"<Run {self.directory}: {self._numbers()}>"

    def _repr_html_(self) -> str:
        """The video and the main numbers, for notebooks."""
        source = escape(str(self.video), quote=True)
        if self.video.is_file() and self.video.stat().st_size < _LARGEST_SHOWN:
            source = f"data:video/mp4;base64,{b64encode(self.video.read_bytes()).decode('ascii')}"
        return (
            f'<video controls loop muted style="max-width: 100%" src="{source}"></video>'
            f"<p>{escape(str(self.directory))}: {escape(self._numbers())}</p>"
        )

    def _numbers(self) -> str:
        found = self.statistics
        size, missed = f"{found['width']}x{found['height']}", found["second_pass"]["missed"]
        return f"{len(self.frames)} frames at {size} in {found['makespan_s']:.1f} s, {missed} missed"


def check_start(request: Request) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """Check that a run can be started or resumed, without writing anything.

    Returns:
        Content of `run.json` if the run exists, and what it would be now (without the survey).

    Raises:
        InputError: the scene cannot be rendered, or the directory belongs to another run or to something else.
        BackendError: this machine lacks something that the renderer needs.
    """
    directory, then = RunDirectory(request.directory), None
    if directory.run_file.exists():
        read_run(directory)  # complete, and in a supported format
        then = load_run(directory)
        check_same_settings(directory.root, then, request.scene, request.settings)
    else:
        directory.check_free()
    # The scene of a resumed run was checked when it was started.
    backend = request.renderer.check(
        request.scene, request.settings, request.execution.variant, build=then is None
    )
    now = describe_run(request.job(backend.variant), request.source, backend, request.title)
    check_engine(request.execution)
    if then is not None:
        check_same_run(directory.root, then, now)
    return then, now


class Session:
    """One command's work on a run: opens or creates the directory, does the remaining tasks, makes the video.

    ```python
    with Session(prepare("gallery", frames=12)) as session:
        for attempt in session:
            print(attempt.task.key, attempt.outcome)
        run = session.finish()
    ```

    The caller's loop follows the progress. Leaving the block, also by Ctrl-C, stops the workers and releases the
    directory. Finished tasks are kept, and another session on the same directory resumes from there.

    Attributes:
        request: the request.
        directory: the run directory.
        resumed: whether the run had been started before.
        waiting: tasks that are not done yet; shrinks while the session is iterated over.
        faults: a sentence for each damaged file, which will be made again, and for each damaged line of the logs.
        variant: backend of the renderer.
        dashboard: address of the engine's dashboard, if it has one.
    """

    def __init__(self, request: Request, *, perform: Perform | None = None) -> None:
        """Make a session; nothing happens until it is entered.

        Args:
            request: what to render.
            perform: does the work of a task in place of the renderer.
        """
        self.request = request
        self.directory = RunDirectory(request.directory)
        self.resumed = False
        self.waiting: list[Task] = []
        self.faults: list[str] = []
        self.variant = ""
        self.dashboard: str | None = None
        self._perform = perform
        self._remote = None if request.url is None else RemoteRun(request.url, request.directory)
        self._engine: Engine | None = None
        self._log: SessionLog | None = None

    def __repr__(self) -> str:
        if not self.variant:
            return f"<Session {self.directory.root}: not entered>"
        tasks = len(self.request.tasks)
        return f"<Session {self.directory.root}: {tasks - len(self.waiting)} of {tasks} tasks done>"

    def _repr_html_(self) -> str:
        """The text of `repr` for notebooks."""
        return f"<p>{escape(repr(self)[1:-1])}</p>"

    def __enter__(self) -> Self:
        """Run the remaining checks, and take the directory.

        Raises:
            InputError: the scene cannot be built, or the directory belongs to another run; nothing was written.
            BackendError: this machine lacks something that the renderer needs; nothing was written.
            StorageError: the directory cannot be written.
        """
        try:
            self._open()
        except BaseException as error:
            self._leave(error)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leave(error)

    def __iter__(self) -> Iterator[Attempt]:
        """Do the remaining tasks; yield each attempt at a task as it ends.

        Raises:
            TaskFailed: a task failed the maximum number of times.
            StorageError: the directory can no longer be written.
        """
        if not self.waiting:
            return
        self.start_engine()
        assert self._engine is not None, "it was started"
        renderer = self.request.renderer
        if renderer.capabilities.probing and self.request.execution.cluster != "in-process":
            cast(ProbingRenderer, renderer).release()  # the workers build the scene themselves
        self._log = SessionLog(self.directory.root, self.request.started, self._engine.workers)
        for attempt in self._engine.run(tuple(self.waiting), self._worker_call(self._engine)):
            self.directory.append_journal(journal_entry(attempt))
            if attempt.outcome == "done":
                if self._remote is not None:
                    self._remote.done(attempt.task)
                self.waiting = [task for task in self.waiting if task.key != attempt.task.key]
            self._log.note(tasks_done=attempt.outcome == "done")
            yield attempt

    def start_engine(self) -> None:
        """Start the workers if any task is left; iterating does this too.

        Raises:
            SettingsError: the requested workers are not available.
        """
        if self._engine is None and self.waiting:
            self._engine = make_engine(self.request.execution, self._batch_folder)
        if self._engine is not None:
            self.dashboard = self._engine.dashboard_link

    def finish(self) -> Run:
        """Make statistics, video and report of a run whose tasks are all done.

        Raises:
            RunError: tasks are left.
            StorageError: the directory cannot be written.
        """
        if self.waiting:
            raise RunError(f"{self.directory.root}: {len(self.waiting)} tasks are not done yet")
        if self._log is not None:
            self._log.close("done")
        self.directory.check_lock()
        frames = tuple(self.directory.frame(number) for number in self.request.settings.frames)
        request = self.request
        statistics = compile_film(self.directory, request.settings, request.display, self.statistics())
        if self._remote is not None:
            self._remote.finish()
        return Run(
            self.directory.root, statistics, frames, self.directory.video_file, self.directory.report_file
        )

    def results(self) -> dict[str, dict[str, Any]]:
        """What each finished task returned, by key."""
        left = {task.key for task in self.waiting}
        done = [task.key for task in self.request.tasks if task.key not in left]
        return {key: self.directory.read_result(key) for key in done}

    def statistics(self) -> dict[str, Any]:
        """Statistics so far; see `animation.statistics`."""
        return collect_statistics(
            self.request,
            self.variant,
            results=self.results(),
            journal=self.directory.read_journal(),
            sessions=SessionLog.read_all(self.directory.root),
            workers=self.request.execution.workers,
        )

    def _open(self) -> None:
        """Do all checks before anything is written, and open the directory.

        The only exception is the lease of a URL. It is taken first, because the content of the store is not known
        before, and released if a check fails.
        """
        if self._remote is not None:
            self._remote.open()
        request = self.request
        then, now = check_start(request)
        self.variant = now["variant"]
        if then is None and request.execution.cluster not in BATCH_SYSTEMS:  # jobs need the directory
            # Started early, because it may fail and takes time, during which the other checks run.
            self._engine = make_engine(request.execution, self._batch_folder)
        if then is None and request.settings.cache_parts > 1:
            now["survey"] = describe_survey(request.survey)
        was_there = self.directory.root.exists()
        self.resumed = self.directory.open_or_create(then or now)
        try:
            self._write_scene()
            write_display(self.directory, request.display)
            if request.execution.aovs:  # tells render farms, which see only the directory
                with storage_errors(self.directory.aovs):
                    self.directory.aovs.mkdir(exist_ok=True)
        except BaseException:
            if not self.resumed:
                self._undo(keep_root=was_there)
            raise
        aside = [
            *self.directory.set_journal_damage_aside(),
            *SessionLog.set_damage_aside(self.directory.root),
            *gather_notes(self.directory),
        ]
        self.waiting, damaged = self.directory.pending(
            request.tasks, validators_of(request.renderer, request.settings, request.scene.hash)
        )
        self.faults = [*aside, *damaged]
        if self._remote is not None:
            self._remote.begin(request.tasks)

    @property
    def _batch_folder(self) -> Path:
        return self.directory.root / "log" / "batch"

    def _write_scene(self) -> None:
        """Write the scene for the workers, unless it is there: there may be no room for a second copy of a large one.

        Workers unpickle the file, which can execute any code, so a file from elsewhere is never kept.
        """
        path, scene, with_files = (
            self.directory.root / SCENE_FILE,
            self.request.scene,
            self._remote is not None,
        )
        if is_archive_of(path, scene, with_files=with_files):
            return
        with atomic_write(path) as temporary:
            write_archive(temporary, scene, with_files=with_files)

    def _undo(self, *, keep_root: bool) -> None:
        """Undo a failed start, so that nothing incomplete is left behind."""
        root = self.directory.root
        for name in (SCENE_FILE, self.directory.display_file.name, self.directory.run_file.name, "log/lock"):
            with suppress(OSError):
                (root / name).unlink(missing_ok=True)
        for folder in ("log/results", "log", "cache", "frames", "aovs", *([] if keep_root else ["."])):
            with suppress(OSError):
                (root / folder).rmdir()

    def _worker_call(self, engine: Engine) -> Perform:
        if self._perform is not None:
            return self._perform
        if self._remote is not None:
            return functools.partial(
                perform_remote, url=self._remote.store.url, threads=engine.threads_per_worker
            )
        directory = str(self.directory.root.resolve())  # workers may have another working directory
        return functools.partial(perform, directory=directory, threads=engine.threads_per_worker)

    def _leave(self, error: BaseException | None) -> None:
        """Stop the workers, record how the session ended, and release the directory."""
        engine, self._engine = self._engine, None
        try:
            if engine is not None:
                engine.close()
        finally:
            if self._log is not None and not self._log.closed:
                stopped = error is None or isinstance(error, KeyboardInterrupt | GeneratorExit)
                with suppress(RunError):  # a full disk may be what ended the session
                    self._log.close("stopped" if stopped else "failed")
            self.directory.close()
            if self._remote is not None:
                self._remote.close()
