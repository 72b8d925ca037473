"""Commands about finished runs: `compare` and `report`."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from steadylight.cli.application import app
from steadylight.cli.options import RunArgument
from steadylight.display import out, show_comparison
from steadylight.errors import SettingsError
from steadylight.progress import counted


@app.command()
def compare(  # noqa: PLR0913 - one for each option
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN RUN...", help="Run directories; ratios are first / second."),
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
    html: Annotated[
        bool,
        typer.Option(
            "--html",
            help="Write a page instead, of any number of runs: players, wipe, difference, flicker, graphs of regions.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The page of --html.", show_default="compare-RUN-RUN.html"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare runs: brightness, error, FLIP and flicker over a region. Writes a plot, or a page with --html."""
    others = {"--region": region, "--plot": plot, "--reference-b": reference_b, "--json": as_json or None}
    _refuse_useless(others if html else {"--output": output}, html=html)
    if html:
        _write_page(runs, reference, output)
        return
    if len(runs) != 2:
        raise SettingsError(
            f"compare: got {counted(len(runs), 'run', 'runs')}; give two, or add --html for a page with any number"
        )
    run, other = runs
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
        out.print(f"Plot: {path}", soft_wrap=True)


def _refuse_useless(given: Mapping[str, object], *, html: bool) -> None:
    """Refuse options that would have no effect."""
    for name in [name for name, value in given.items() if value is not None]:
        where = "with --html" if html else "without --html; --plot names the picture"
        raise SettingsError(f"compare: {name} has no effect {where}; leave it out")


def _write_page(runs: list[Path], reference: Path | None, output: Path | None) -> None:
    from steadylight.report import write_comparison

    path = output or Path(f"compare-{'-'.join(run.resolve().name for run in runs)}.html")
    out.print(f"Page: {write_comparison(runs, path, reference)}", soft_wrap=True)


@app.command()
def figures(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN [RUN...]", help="Runs of one animation, such as single-pass and two-pass."
        ),
    ],
    *,
    region: Annotated[
        list[str] | None,
        typer.Option(
            metavar="x0,y0,x1,y1",
            help="Region of a BFM graph; may be repeated.",
            show_default="the whole image",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the figures.")
    ] = Path("figures"),
    kind: Annotated[
        Literal["pdf", "svg", "png"], typer.Option("--format", help="Format of the files.")
    ] = "pdf",
) -> None:
    """Draw figures for a paper: change measure with selected frames, BFM of regions, timeline of the tasks."""
    from steadylight.metrics.region import Region
    from steadylight.report.figures import write_figures

    regions = [Region.parse(text) for text in region or ["0.0,0.0,1.0,1.0"]]
    for name, made in write_figures(runs, output, regions, kind).items():
        words = str(made) if isinstance(made, Path) else f"no figure: {made}"
        out.print(f"{name}: {words}", soft_wrap=True)


@app.command()
def report(run: RunArgument) -> None:
    """Rewrite report.html of a run."""
    from steadylight.report import write_report

    out.print(str(write_report(run)), soft_wrap=True)
