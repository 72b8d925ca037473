"""The command line: arguments and exit codes; what people see is in `display` and `progress`.

Exit codes: 0 done; 1 something failed for good (`cache diff`: the caches differ); 2 bad input or usage, or
the output cannot be written; 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import json
import shlex
import signal
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from steadylight.display import (
    err,
    out,
    show_comparison,
    show_plan,
    show_run,
    show_simulation,
    show_table,
    vector,
)
from steadylight.errors import CacheFileError, SteadylightError, TaskFailed
from steadylight.settings import Coverage, Mode, Radii, Variant

if TYPE_CHECKING:
    from types import FrameType

    from steadylight.animation.request import Request
    from steadylight.animation.run import Run, Session

app = typer.Typer(
    name="steadylight",
    help="Walkthrough animations with physically based global illumination, without flicker.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
cache_app = typer.Typer(help="Look into, merge and compare cache files.", no_args_is_help=True)
app.add_typer(cache_app, name="cache")

_FILM, _IMAGE, _METHOD, _MACHINE = "Film", "Image", "Method", "Machine"
_SIMULATION = "Simulation"
_SIMULATED = ("simulate", "times", "nodes", "queue_wait", "start", "between_failures", "bandwidth")
_debug = False


def _option(text: str, panel: str, **more: Any) -> Any:
    return typer.Option(help=text, rich_help_panel=panel, show_default=more.pop("default", True), **more)


# What `render` and `plan` take; the names are those of `animation.request.prepare`.
Scene = Annotated[
    str, typer.Argument(help="A bundled scene (see `steadylight scenes`) or a Mitsuba XML file.")
]
Camera = Annotated[
    str | None,
    _option("File of keyframes, TOML or JSON.", _FILM, metavar="FILE", default="the scene's own"),
]
Frames = Annotated[
    str | None,
    _option(
        "The first N frames of the path; or numbers: 30-53, 1-91:45 (every 45th), 1,5,9.",
        _FILM,
        metavar="N",
        default="the whole path",
    ),
]
Size = Annotated[str | None, _option("Pixels of a frame.", _FILM, metavar="WxH", default="the scene's own")]
Fps = Annotated[
    float | None, _option("Frames per second.", _FILM, metavar="F", default="the camera's or the scene's")
]
Output = Annotated[str | None, _option("The run directory.", _FILM, metavar="DIR", default="runs/SCENE-MODE")]
Spp = Annotated[int, _option("Samples per pixel.", _IMAGE, metavar="N")]
QualityChoice = Annotated[
    str, _option("draft, normal or high, or a number: 1 is normal, more is slower and better.", _IMAGE)
]
Bounces = Annotated[int, _option("Indirect diffuse bounces.", _IMAGE, metavar="N")]
Seed = Annotated[int, _option("Of everything random.", _IMAGE, metavar="N")]
ModeChoice = Annotated[
    Mode,
    _option(
        "two-pass shares one cache; single-pass has one for each frame (the baseline); path has none.",
        _METHOD,
    ),
]
SelectedFrames = Annotated[
    str,
    _option(
        "Frames of the first pass: a number, workers (as many as there are, as published) or auto.",
        _METHOD,
        metavar="auto|workers|N",
    ),
]
Threshold = Annotated[
    float, _option("A first-pass frame stops at this many cache hits per miss.", _METHOD, metavar="X")
]
BaseRays = Annotated[int, _option("Rays before the threshold is looked at.", _METHOD, metavar="N")]
RadiiChoice = Annotated[
    Radii,
    _option("What a record's reach goes by: distances (Ward 1988), or how light bends (2012).", _METHOD),
]
CoverageChoice = Annotated[
    Coverage, _option("Look along all frames for what the cache misses, and fill it.", _METHOD)
]
CacheParts = Annotated[
    str,
    _option(
        "Parts of space in which the cache is merged, filled and read, so that frames start before all of it is "
        "done; auto goes by the number of frames.",
        _METHOD,
        metavar="auto|N",
    ),
]
Denoise = Annotated[
    bool,
    _option(
        "Open Image Denoise on direct light and gloss, never on the cached light; needs the extra `denoise`.",
        _IMAGE,
    ),
]
Workers = Annotated[int, _option("Worker processes; of a batch system, jobs at most.", _MACHINE, metavar="N")]
Cluster = Annotated[
    str,
    _option(
        "Where they run: local, in-process, a batch system (slurm, sge, pbs, lsf, htcondor, oar), or the address "
        "of a Dask scheduler (tcp://..., tls://...).",
        _MACHINE,
        metavar="NAME",
    ),
]
Site = Annotated[
    Path | None,
    _option(
        "What the batch system wants to know: queue, account, cores, memory, walltime, ... as TOML.",
        _MACHINE,
        metavar="FILE",
        default="Dask's own configuration",
    ),
]
VariantChoice = Annotated[Variant, _option("Mitsuba backend.", _MACHINE)]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="A run directory.")]


def _show_version(asked: bool) -> None:
    if asked:
        from steadylight import __version__

        out.print(f"steadylight {__version__}")
        raise typer.Exit


@app.callback()
def steadylight(
    *,
    version: Annotated[  # noqa: ARG001 - its callback does the work
        bool, typer.Option("--version", help="Print the version.", is_eager=True, callback=_show_version)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where in the program an error arose.")] = False,
) -> None:
    """Walkthrough animations with physically based global illumination, without flicker."""
    global _debug  # noqa: PLW0603 - one process is one command
    _debug = debug


@app.command()
def render(
    scene: Scene,
    *,
    camera: Camera = None,
    frames: Frames = None,
    size: Size = None,
    fps: Fps = None,
    output: Output = None,
    spp: Spp = 16,
    quality: QualityChoice = "normal",
    bounces: Bounces = 2,
    denoise: Denoise = False,
    seed: Seed = 0,
    mode: ModeChoice = "two-pass",
    selected_frames: SelectedFrames = "auto",
    threshold: Threshold = 10.0,
    base_rays: BaseRays = 128,
    radii: RadiiChoice = "occlusion-hessian",
    coverage: CoverageChoice = "full",
    cache_parts: CacheParts = "auto",
    workers: Workers = 1,
    cluster: Cluster = "local",
    site: Site = None,
    variant: VariantChoice = "auto",
) -> None:
    """Render frames, film and report into a run directory; the same command again goes on from there."""
    options = dict(locals())
    signal.signal(signal.SIGTERM, _stop)  # what a batch system sends before its time limit
    session: Session | None = None
    try:
        from steadylight.animation.run import Session

        session = Session(_prepare(options))
        run = _work(session)
    except KeyboardInterrupt:
        _say_how_to_go_on(session)
        raise typer.Exit(130) from None
    show_run(run)


@app.command()
def plan(
    scene: Scene,
    *,
    camera: Camera = None,
    frames: Frames = None,
    size: Size = None,
    fps: Fps = None,
    output: Output = None,
    spp: Spp = 16,
    quality: QualityChoice = "normal",
    bounces: Bounces = 2,
    denoise: Denoise = False,
    seed: Seed = 0,
    mode: ModeChoice = "two-pass",
    selected_frames: SelectedFrames = "auto",
    threshold: Threshold = 10.0,
    base_rays: BaseRays = 128,
    radii: RadiiChoice = "occlusion-hessian",
    coverage: CoverageChoice = "full",
    cache_parts: CacheParts = "auto",
    workers: Workers = 1,
    cluster: Cluster = "local",
    site: Site = None,
    variant: VariantChoice = "auto",
    simulate: Annotated[
        bool, _option("Play the run through on many nodes, with measured times.", _SIMULATION)
    ] = False,
    times: Annotated[
        Path | None,
        _option(
            "A run whose task times and file sizes are taken.", _SIMULATION, metavar="RUN", default="--output"
        ),
    ] = None,
    nodes: Annotated[int, _option("How many.", _SIMULATION, metavar="N", min=1)] = 200,
    queue_wait: Annotated[
        float, _option("Mean seconds until a node comes.", _SIMULATION, metavar="S", min=0.0)
    ] = 60.0,
    start: Annotated[
        float, _option("Seconds until a node has its first task.", _SIMULATION, metavar="S", min=0.0)
    ] = 20.0,
    between_failures: Annotated[
        float, _option("Mean hours of a node between failures.", _SIMULATION, metavar="H", min=0.001)
    ] = 1000.0,
    bandwidth: Annotated[
        float, _option("Megabytes a second of the shared store.", _SIMULATION, metavar="MB", min=0.001)
    ] = 1000.0,
) -> None:
    """Show what `render` would do: selected frames, tasks, estimated cost. Renders and writes nothing.

    With --simulate also how long it would take on many nodes.
    """
    options = dict(locals())
    given = {name: options.pop(name) for name in _SIMULATED}
    request = _prepare(options)
    show_plan(request)
    if given.pop("simulate"):
        _simulate(request, **given)


@app.command()
def compare(
    run: RunArgument,
    other: Annotated[
        Path, typer.Argument(metavar="RUN", help="Another one; ratios say how much better it is.")
    ],
    *,
    reference: Annotated[
        Path | None, typer.Option(metavar="RUN", help="A run to hold both against, such as --mode path.")
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(
            metavar="x0,y0,x1,y1", help="Where flicker is measured: pixels, or fractions from 0.0 to 1.0."
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Where the picture goes.", show_default="compare-RUN-RUN.png"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all numbers as JSON instead.")] = False,
) -> None:
    """Measure two runs side by side: error, FLIP, and flicker over a region; draws a picture too."""
    from steadylight.metrics.compare import compare_runs
    from steadylight.metrics.plot import plot_comparison
    from steadylight.metrics.region import Region

    where = None if region is None else Region.parse(region)
    comparison = compare_runs(run, other, reference, where)
    path = plot or Path(f"compare-{run.resolve().name}-{other.resolve().name}.png")
    plot_comparison(comparison, path)
    if as_json:
        sys.stdout.write(json.dumps(comparison.to_dict() | {"plot": str(path)}, indent=2) + "\n")
    else:
        show_comparison(comparison)
        out.print(f"Picture: {path}", soft_wrap=True, markup=False)


@app.command()
def report(run: RunArgument) -> None:
    """Write report.html of a run again."""
    from steadylight.report import write_report

    out.print(str(write_report(run)), soft_wrap=True, markup=False)


@app.command()
def scenes() -> None:
    """List the bundled scenes."""
    from steadylight.scenes import BUNDLED, load_scene

    width = max(map(len, BUNDLED))
    for name in BUNDLED:  # a line as soon as it is known: some take a second to build
        scene = load_scene(name)
        size = f"{scene.width}x{scene.height}"
        out.print(f"{name:<{width}}  {scene.frames:>5} frames  {size:>9}  {scene.about}", soft_wrap=True)


@cache_app.command()
def info(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files.")]) -> None:
    """Show what cache files hold."""
    from steadylight.cache.file import read_cache

    for path in files:
        cache = read_cache(path)
        records = cache.records
        rows = {"records": f"{len(records):,}", "scene": cache.scene_hash}
        if len(records):
            low, high = records.position.min(axis=0), records.position.max(axis=0)
            rows["bounds"] = f"{vector(low)} to {vector(high)} m"
            radius = sorted(records.radius.tolist())
            rows["radius"] = f"{radius[0]:.4g} to {radius[-1]:.4g} m, median {radius[len(radius) // 2]:.4g} m"
            rows["mean irradiance"] = f"{vector(records.irradiance.sum(axis=1).mean(axis=0))} W/m²"
        rows |= {str(key): json.dumps(value) for key, value in cache.about.items()}
        show_table(str(path), rows)


@cache_app.command()
def merge(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Cache files of one scene.")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The merged cache.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the output if it exists.")] = False,
) -> None:
    """Merge caches of one scene into one, without duplicates."""
    from steadylight.atomic_file import atomic_write
    from steadylight.cache.file import CacheFile, encode_cache, read_cache
    from steadylight.cache.merge import merge_caches

    if output.exists() and not force:
        raise CacheFileError(f"{output}: exists already; choose another --output, or replace it with --force")
    caches = [read_cache(path) for path in files]
    scene_hash = caches[0].scene_hash
    for path, cache in zip(files, caches, strict=True):
        if cache.scene_hash != scene_hash:
            raise CacheFileError(
                f"{path}: made for another scene (hash {cache.scene_hash[:12]}) than {files[0]} (hash "
                f"{scene_hash[:12]}); merge caches of one scene only"
            )
    records = merge_caches([cache.records for cache in caches])
    merged = CacheFile(records, scene_hash, {"merged": [path.name for path in files]})
    with atomic_write(output, read_cache) as temporary:
        temporary.write_bytes(encode_cache(merged))
    before = sum(len(cache.records) for cache in caches)
    out.print(f"{output}: {len(records):,} records, from {before:,}", soft_wrap=True, markup=False)


@cache_app.command()
def diff(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cache file.")],
    other: Annotated[Path, typer.Argument(metavar="FILE", help="Another one.")],
) -> None:
    """Say how two caches differ; exit code 0 if they hold the same records of the same scene, 1 if not."""
    import numpy as np

    from steadylight.cache.file import read_cache
    from steadylight.cache.merge import canonical_order

    a, b = read_cache(file), read_cache(other)
    rows = {"records": f"{len(a.records):,} and {len(b.records):,}"}
    rows["scene"] = "the same" if a.scene_hash == b.scene_hash else "another"
    first, second = (cache.records.take(canonical_order(cache.records)) for cache in (a, b))
    same = a.scene_hash == b.scene_hash and len(first) == len(second)
    if len(first) == len(second):
        for name in first.SHAPES:
            gap = np.abs(getattr(first, name).astype(np.float64) - getattr(second, name))
            largest = float(gap.max(initial=0.0))
            rows[f"largest difference of {name}"] = f"{largest:.6g}"
            same = same and largest == 0.0
    show_table("the same records" if same else "the caches differ", rows)
    raise typer.Exit(0 if same else 1)


# ------------------------------------------------------------------------------------------- work and display


def _prepare(options: dict[str, Any]) -> Request:
    from steadylight.animation.request import prepare

    return prepare(**options)


def _simulate(
    request: Request, *, times: Path | None, between_failures: float, bandwidth: float, **more: Any
) -> None:
    """Play the run through, with the barriers between passes and without."""
    from steadylight.animation.simulation import Conditions, read_measured, simulate, with_barriers

    measured = read_measured(times or request.directory, {task.stage for task in request.tasks})
    conditions = Conditions(between_failures=3600 * between_failures, bandwidth=1e6 * bandwidth, **more)
    plans = {
        "passes one after the other": with_barriers(request.tasks),
        "tasks start when they can": request.tasks,
    }
    outcomes = {name: simulate(tasks, measured, conditions) for name, tasks in plans.items()}
    show_simulation(conditions.nodes, outcomes)


def _work(session: Session) -> Run:
    """Do what is left of a run, and draw how far it is."""
    from steadylight.progress import Bars, Lines, Tally

    with session:
        _say_what_is_left(session)
        session.start_engine()
        if session.dashboard is not None:
            out.print(f"Live view of the workers: {session.dashboard}", soft_wrap=True, markup=False)
        tally = Tally(session.request.tasks, session.results())
        with Bars(out, tally) if out.is_terminal else Lines(out, tally) as display:
            for attempt in session:
                display.add(attempt)
        return session.finish()


def _say_what_is_left(session: Session) -> None:
    tasks, left = len(session.request.tasks), len(session.waiting)
    where = session.directory.root
    if session.resumed:
        rest = f"{left} left" if left else "nothing left but film and report"
        out.print(f"Going on with {where}: {tasks - left} of {tasks} tasks are done, {rest}.", soft_wrap=True)
    else:
        out.print(f"Rendering into {where}: {tasks} tasks, {session.variant}.", soft_wrap=True)
    for fault in session.faults:
        out.print(fault, style="yellow", soft_wrap=True, markup=False)


def _say_how_to_go_on(session: Session | None) -> None:
    if session is None or not session.directory.run_file.exists():
        err.print("Stopped; nothing was written.")
        return
    tasks, left = len(session.request.tasks), len(session.waiting)
    again = shlex.join(["steadylight", *sys.argv[1:]])
    err.print(
        f"Stopped. {tasks - left} of {tasks} tasks are done and stay so. "
        "To go on, give the same command again:\n"
        f"  {again}",
        soft_wrap=True,
        markup=False,
    )


def _stop(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def main() -> None:
    """Run a command; every error becomes a message and an exit code."""
    try:
        app()
    except SteadylightError as error:
        _fail(error, str(error), error.exit_code)
    except Exception as error:  # noqa: BLE001 - a person gets a sentence, whatever happened
        _fail(error, f"unexpected error, please report it: {type(error).__name__}: {error}", 1)


def _fail(error: Exception, message: str, code: int) -> NoReturn:
    err.print(f"Error: {message}", soft_wrap=True, markup=False)
    if isinstance(error, TaskFailed) and error.details and not _debug:
        err.print(
            "The same command goes on from what is done; --debug and log/tasks.jsonl tell more.",
            soft_wrap=True,
        )
    if _debug:
        if isinstance(error, TaskFailed) and error.details:
            err.print(error.details, soft_wrap=True, markup=False)
        traceback.print_exception(error)
    sys.exit(code)
