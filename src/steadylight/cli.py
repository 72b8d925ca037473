"""The command line: arguments and exit codes. Console output is in `display` and `progress`.

Exit codes: 0 success; 1 permanent failure (`cache diff`: the caches differ); 2 bad input or usage, or the
output cannot be written; 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import errno
import functools
import inspect
import io
import json
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Union, get_args, get_origin

import typer

from steadylight.display import (
    cost_words,
    err,
    out,
    show_comparison,
    show_plan,
    show_run,
    show_simulation,
    show_table,
)
from steadylight.errors import CacheFileError, SteadylightError, TaskFailed
from steadylight.quality import quality_word
from steadylight.redaction import redacted
from steadylight.settings import PANELS, CheckedSettings, Option, Options, SimulationOptions

if TYPE_CHECKING:
    # Importing these takes a second, too long for `--help`.
    from steadylight.animation.request import Request
    from steadylight.animation.run import Run, Session

app = typer.Typer(
    name="steadylight",
    help="Walkthrough animations with physically based global illumination, without flicker.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
cache_app = typer.Typer(help="Inspect, merge and compare cache files.", no_args_is_help=True)
app.add_typer(cache_app, name="cache")

_debug = False


# ---------------------------------------------------------------------- options, from `settings.Options`


def _with_options(**groups: type[CheckedSettings]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a command take each option of the groups by name, instead of each group as one argument."""
    fields = {name: field for group in groups.values() for name, field in group.model_fields.items()}
    order = sorted(fields, key=lambda name: PANELS.index(_option_of(fields[name].metadata).panel))
    options = [_parameter(name, fields[name]) for name in order]

    def adapt(function: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(function, eval_str=True).parameters.values()

        @functools.wraps(function)
        def command(**given: Any) -> None:
            for name, group in groups.items():
                values = {field: given.pop(field) for field in group.model_fields}
                given[name] = group.checked(**values)
            function(**given)

        rest = [parameter for parameter in own if parameter.name not in groups]
        command.__signature__ = inspect.Signature([*rest, *options])  # type: ignore[attr-defined]
        return command

    return adapt


def _parameter(name: str, field: Any) -> inspect.Parameter:
    """An option as a parameter that typer understands."""
    option = _option_of(field.metadata)
    shown = typer.Option(
        help=option.help,
        rich_help_panel=option.panel,
        metavar=option.metavar,
        show_default=True if option.shown is None else option.shown,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=quality_word(field.default) if option.worded else field.default,
        annotation=Annotated[str if option.worded else _typed_as(field.annotation), shown],
    )


def _option_of(metadata: list[Any]) -> Option:
    return next(each for each in metadata if isinstance(each, Option))


def _typed_as(annotation: Any) -> Any:
    """The command-line type for an annotation: a number, one of several words, or else text."""
    members = get_args(annotation) if get_origin(annotation) in {Union, UnionType} else (annotation,)
    optional = type(None) in members
    (kind, *others) = [member for member in members if member is not type(None)]
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    plain = not others and (kind in {bool, int, float, str} or get_origin(kind) is Literal)
    kind = kind if plain else str
    return kind | None if optional else kind


SceneArgument = Annotated[
    str,
    typer.Argument(
        help="A bundled scene (see `steadylight scenes`), a Mitsuba XML file, or a Radiance .rad or .oct file."
    ),
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Run directory.")]


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        out.print(f"steadylight {version('steadylight')}")
        raise typer.Exit


@app.callback()
def steadylight(
    *,
    version: Annotated[  # noqa: ARG001 - its callback does the work
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_show_version)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Walkthrough animations with physically based global illumination, without flicker."""
    global _debug  # noqa: PLW0603 - one process is one command
    _debug = debug


@app.command()
@_with_options(options=Options)
def render(scene: SceneArgument, *, options: Options) -> None:
    """Render frames, video and report into a run directory. Repeat the command to resume."""
    signal.signal(signal.SIGTERM, _stop)  # batch systems send it before the time limit
    session: Session | None = None
    try:
        from steadylight.animation.run import Session

        request = _request(scene, options)
        if options.frames is None and options.size is None:
            _ask_before_a_long_run(request)
        session = Session(request)
        run = _work(session)
    except KeyboardInterrupt:
        _say_how_to_resume(session)
        raise typer.Exit(130) from None
    show_run(run)


@app.command()
@_with_options(options=Options, simulation=SimulationOptions)
def plan(scene: SceneArgument, *, options: Options, simulation: SimulationOptions) -> None:
    """Show what `render` would do (selected frames, tasks, estimated cost) without rendering or writing anything.

    What `render` would refuse, this refuses too.

    With --simulate, also estimate the time on many nodes.
    """
    from steadylight.animation.run import check_start

    request = _request(scene, options)
    if request.url is None:  # what is at a URL is known only with its lease
        check_start(request)
    show_plan(request)
    if simulation.simulate:
        _simulate(request, simulation)


@app.command()
def compare(  # noqa: PLR0913 - one for each option
    run: RunArgument,
    other: Annotated[
        Path, typer.Argument(metavar="RUN", help="Second run directory; ratios are first / second.")
    ],
    *,
    reference: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="Reference run for errors, such as one with --mode path."),
    ] = None,
    reference_b: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Second reference run with another --seed. Errors then exclude the noise of both references.",
        ),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(
            metavar="x0,y0,x1,y1",
            help="Region in which flicker is measured, in pixels or in fractions from 0.0 to 1.0.",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for the plot.", show_default="compare-RUN-RUN.png"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare two runs: brightness, error, FLIP and flicker over a region. Also writes a plot."""
    from steadylight.metrics.compare import compare_runs
    from steadylight.metrics.plot import plot_comparison
    from steadylight.metrics.region import Region

    where = None if region is None else Region.parse(region)
    comparison = compare_runs(run, other, reference, where, reference_b)
    path = plot or Path(f"compare-{run.resolve().name}-{other.resolve().name}.png")
    plot_comparison(comparison, path)
    if as_json:
        sys.stdout.write(json.dumps(comparison.to_dict() | {"plot": str(path)}, indent=2) + "\n")
    else:
        show_comparison(comparison)
        out.print(f"Plot: {path}", soft_wrap=True, markup=False)


@app.command()
def report(run: RunArgument) -> None:
    """Rewrite report.html of a run."""
    from steadylight.report import write_report

    out.print(str(write_report(run)), soft_wrap=True, markup=False)


@app.command()
def scenes() -> None:
    """List the bundled scenes."""
    from steadylight.scenes.bundled import BUNDLED

    width = max(map(len, BUNDLED))
    for name, scene in BUNDLED.items():
        size = f"{scene.width}x{scene.height}"
        out.print(f"{name:<{width}}  {scene.frames:>5} frames  {size:>9}  {scene.about}", soft_wrap=True)


@cache_app.command()
def info(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files.")]) -> None:
    """Show the contents of cache files."""
    from steadylight.renderers import renderer_of

    for path in files:
        renderer, cache_files = renderer_of(path)
        show_table(str(path), {"renderer": renderer.name, **cache_files.describe(path)})


@cache_app.command()
def merge(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files of one scene.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The merged cache.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite the output if it exists.")] = False,
) -> None:
    """Merge caches of one scene into one, without duplicates."""
    from steadylight.atomic_file import atomic_write
    from steadylight.renderers import renderer_of

    if output.exists() and not force:
        raise CacheFileError(
            f"{output}: exists already; choose another --output, or overwrite it with --force"
        )
    _, cache_files = renderer_of(_of_one_renderer(*files))
    with atomic_write(output, cache_files.describe) as temporary:
        counts = cache_files.merge(files, temporary)
    words = f"{counts['records_out']:,} records, merged from {counts['records_in']:,}"
    out.print(f"{output}: {words}", soft_wrap=True, markup=False)


@cache_app.command()
def diff(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cache file.")],
    other: Annotated[Path, typer.Argument(metavar="FILE", help="A second cache file.")],
) -> None:
    """Compare two caches. Exit code 0 if they hold the same records of the same scene, otherwise 1."""
    from steadylight.renderers import renderer_of

    _, cache_files = renderer_of(_of_one_renderer(file, other))
    same, differences = cache_files.differences(file, other)
    show_table("same records" if same else "caches differ", differences)
    raise typer.Exit(0 if same else 1)


def _of_one_renderer(first: Path, *others: Path) -> Path:
    """The first of several cache files, after checking that all belong to one renderer."""
    for path in others:
        if path.suffix != first.suffix:
            raise CacheFileError(
                f"{path}: belongs to a different renderer than {first}; give files of one renderer"
            )
    return first


# ------------------------------------------------------------------------------------------- work and display


def _request(scene: str, options: Options) -> Request:
    from steadylight.animation.request import request_of

    return request_of(scene, options)


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
    if request.cost.seconds_cpu < _LONG_RUN * (os.cpu_count() or 1):
        return
    film = f"{len(settings.frames)} frames at {settings.width}x{settings.height}"
    out.print(f"{film}: {time}; {memory}; {disk}.", soft_wrap=True)
    out.print("For a quick look: --frames 12 --size 512x384", soft_wrap=True)
    if not typer.confirm("Render all of it?"):
        err.print("Stopped. Nothing was written.")
        raise typer.Exit(130)


def _at_a_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _work(session: Session) -> Run:
    """Do the remaining tasks of a run and show their progress."""
    from steadylight.progress import Bars, Lines, Tally

    with session:
        _say_what_remains(session)
        session.start_engine()
        if session.dashboard is not None:
            out.print(f"Dask dashboard: {session.dashboard}", soft_wrap=True, markup=False)
        tally = Tally(session.request.tasks, session.results())
        with Bars(out, tally) if out.is_terminal else Lines(out, tally) as display:
            for attempt in session:
                display.add(attempt)
        return session.finish()


def _say_what_remains(session: Session) -> None:
    tasks, left = len(session.request.tasks), len(session.waiting)
    where = session.directory.root
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
        out.print(fault, style="yellow", soft_wrap=True, markup=False)


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
        markup=False,
    )


def _stop(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def main() -> None:
    """Run a command; every error becomes a message and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files need not be valid text
    try:
        app()
    except SteadylightError as error:
        _fail(error, str(error), error.exit_code)
    except (MemoryError, RuntimeError, OSError, ImportError) as error:
        if not _is_about_memory(error):
            _fail(error, _unexpected(error), 1)
        _fail(
            error,
            f"not enough memory for the command itself ({error or type(error).__name__}); raise its limit, or use a "
            "machine with more memory, then run the same command again",
            1,
        )
    except Exception as error:  # noqa: BLE001 - users always get a sentence, not a traceback
        _fail(error, _unexpected(error), 1)


def _unexpected(error: Exception) -> str:
    return f"unexpected error, please report it: {type(error).__name__}: {error}"


def _is_about_memory(error: BaseException) -> bool:
    """Whether an error, or what caused it, says that the system gave no more memory or threads."""
    number = error.errno if isinstance(error, OSError) else None
    words = ("can't start new thread", "failed to map segment")
    if isinstance(error, MemoryError) or number == errno.ENOMEM or any(each in str(error) for each in words):
        return True
    cause = error.__cause__ or error.__context__
    return cause is not None and _is_about_memory(cause)


def _fail(error: Exception, message: str, code: int) -> NoReturn:
    err.print(f"Error: {redacted(message)}", soft_wrap=True, markup=False)
    if isinstance(error, TaskFailed) and error.details and not _debug:
        err.print(
            "Run the same command to resume. For details, add --debug or read log/tasks.jsonl.",
            soft_wrap=True,
        )
    if _debug:
        if isinstance(error, TaskFailed) and error.details:
            err.print(error.details, soft_wrap=True, markup=False)
        sys.stderr.write(redacted("".join(traceback.format_exception(error))))
    sys.exit(code)
