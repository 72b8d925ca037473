"""Commands `render` and `plan`."""

from __future__ import annotations

import dataclasses
import shlex
import signal
import sys
from contextlib import nullcontext
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from steadylight.cli.application import app
from steadylight.cli.options import SceneArgument, with_options
from steadylight.cli.pages import live_page
from steadylight.display import (
    cost_words,
    err,
    out,
    show_notes,
    show_path,
    show_plan,
    show_run,
    show_simulation,
    usable_cores,
)
from steadylight.errors import SettingsError
from steadylight.redaction import redacted
from steadylight.settings import MACHINE, Options, SimulationOptions, option_name

if TYPE_CHECKING:
    # Importing these takes a second, too long for `--help`.
    from steadylight.animation.request import Request
    from steadylight.animation.run import Run, Session


@app.command()
@with_options(options=Options)
def render(
    scene: SceneArgument,
    *,
    watch: Annotated[
        bool,
        typer.Option(
            "--watch", help="Serve a live page meanwhile, on this machine only; see `steadylight watch`."
        ),
    ] = False,
    prepare_only: Annotated[
        bool,
        typer.Option(
            "--prepare-only",
            help="Make the run directory, for a render farm (see `export`) or a later command, and render nothing.",
            rich_help_panel=MACHINE,
        ),
    ] = False,
    options: Options,
) -> None:
    """Render frames, video and report into a run directory. Repeat the command to resume."""
    signal.signal(signal.SIGTERM, _stop)  # batch systems send it before the time limit
    session: Session | None = None
    try:
        from steadylight.animation.run import Session

        request = _request(scene, options)
        if prepare_only:
            if watch:
                raise SettingsError("--watch: has no effect with --prepare-only; give it to the render")
            _prepare(request)
            return
        if options.frames is None and options.size is None:
            _ask_before_a_long_run(request)
        session = Session(request)
        show_notes(request.scene.notes)
        with live_page(request.directory) if watch else nullcontext():
            run = work_on(session)
    except KeyboardInterrupt:
        _say_how_to_resume(session)
        raise typer.Exit(130) from None
    show_run(run)


@app.command()
@with_options(options=Options, simulation=SimulationOptions)
def plan(scene: SceneArgument, *, options: Options, simulation: SimulationOptions) -> None:
    """Show what `render` would do (selected frames, tasks, estimated cost) without rendering or writing anything.

    It refuses what `render` would refuse. With --simulate, it also estimates the time on many nodes.
    """
    from steadylight.animation.run import check_start

    _check_simulation(simulation)
    request = _request(scene, options)
    if request.url is None:  # what is at a URL is known only with its lease
        check_start(request)
    show_plan(request)
    _check_camera(request)
    if simulation.simulate:
        _simulate(request, simulation)


def _check_simulation(given: SimulationOptions) -> None:
    """Refuse options of the simulation without `--simulate`."""
    for name in sorted(given.model_dump(exclude_defaults=True)) if not given.simulate else ():
        raise SettingsError(f"{option_name(name)}: only with --simulate; add it, or leave this out")


def _request(scene: str, options: Options) -> Request:
    from steadylight.animation.request import request_of

    return request_of(scene, options)


def _check_camera(request: Request) -> None:
    """Print on which frames the camera is inside geometry, passes through it, or is close to it."""
    from steadylight.animation.clearance import check_camera

    show_path(check_camera(request))


def _simulate(request: Request, given: SimulationOptions) -> None:
    """Simulate the run with barriers between passes and without."""
    from steadylight.animation.simulation import Conditions, measured_for, simulate, with_barriers

    measured = measured_for(request, None if given.times is None else Path(given.times))
    conditions = Conditions(
        nodes=given.nodes,
        queue_wait=given.queue_wait,
        start=given.start,
        between_failures=3600 * given.between_failures,
        bandwidth=1e6 * given.bandwidth,
    )
    plans = {
        "with barriers between passes": with_barriers(request.tasks),
        "without barriers": request.tasks,
    }
    outcomes = {name: simulate(tasks, measured, conditions) for name, tasks in plans.items()}
    show_simulation(conditions.nodes, outcomes)


_LONG_RUN = 3600.0
"""Estimated seconds from which a run of the scene's own size and length is confirmed first."""


def _ask_before_a_long_run(request: Request) -> None:
    """At a terminal, ask before a new run that takes hours: the defaults of a scene are those of a finished film."""
    execution = request.execution
    here = execution.cluster in {"local", "in-process"} and execution.variant != "cuda"
    begun = request.url is not None or (request.directory / "run.json").exists()
    if not here or begun or not _at_a_terminal():
        return
    settings, (time, memory, disk) = request.settings, cost_words(request.cost)
    if request.cost.seconds_cpu < _LONG_RUN * usable_cores():
        return
    film = f"{len(settings.frames)} frames at {settings.width}x{settings.height}"
    out.print(f"{film}: {time}; {memory}; {disk}.", soft_wrap=True)
    out.print("For a quick look: --frames 12 --size 512x384", soft_wrap=True)
    if not typer.confirm("Render all of it?"):
        err.print("Stopped. Nothing was written.")
        raise typer.Exit(130)


def _at_a_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _prepare(request: Request) -> None:
    """Make the run directory and check it as a render does, without workers."""
    from steadylight.animation.run import Session

    here = request.execution.model_copy(update={"cluster": "in-process"})
    show_notes(request.scene.notes)
    with Session(dataclasses.replace(request, execution=here)) as session:
        tasks, left = len(request.tasks), len(session.waiting)
        for fault in session.faults:
            out.print(fault, style="yellow", soft_wrap=True)
    out.print(f"{request.place}: ready, {left} of {tasks} tasks left.", soft_wrap=True)


def work_on(session: Session) -> Run:
    """Do the remaining tasks of a run, show their progress, and finish it."""
    from steadylight.progress import Bars, Lines, Tally

    with session:
        _say_what_remains(session)
        if not session.resumed:
            _check_camera(session.request)
        session.start_engine()
        if session.dashboard is not None:
            out.print(f"Dask dashboard: {session.dashboard}", soft_wrap=True)
        tally = Tally(session.request.tasks, session.results(), session.request.settings)
        with Bars(out, tally) if out.is_terminal else Lines(out, tally) as display:
            for attempt in session:
                display.add(attempt)
        return session.finish()


def _say_what_remains(session: Session) -> None:
    tasks, left = len(session.request.tasks), len(session.waiting)
    where = session.request.place
    if session.resumed:
        rest = f"{left} left" if left else "only video and report left"
        out.print(f"Resuming {where}: {tasks - left} of {tasks} tasks done, {rest}.", soft_wrap=True)
    else:
        out.print(f"Rendering into {where}: {tasks} tasks, {session.variant}.", soft_wrap=True)
    on_processor = not session.variant.startswith("cuda") and session.request.execution.cluster in {
        "local",
        "in-process",
    }
    time, *rest_of_cost = cost_words(session.request.cost, left / tasks)
    if left:
        words = [*([time] if on_processor else []), *rest_of_cost]
        out.print(f"Rough cost: {'; '.join(words)}.", soft_wrap=True)
    for fault in session.faults:
        out.print(fault, style="yellow", soft_wrap=True)


def _say_how_to_resume(session: Session | None) -> None:
    if session is None or not session.directory.run_file.exists():
        err.print("Stopped. Nothing was written.")
        return
    tasks, left = len(session.request.tasks), len(session.waiting)
    again = redacted(shlex.join(["steadylight", *sys.argv[1:]]))
    err.print(
        f"Stopped. {tasks - left} of {tasks} tasks are done and saved. "
        "To resume, run the same command:\n"
        f"  {again}",
        soft_wrap=True,
    )


def _stop(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
