"""Commands for render farms: `export` and `perform`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from steadylight.cli.application import app
from steadylight.display import out
from steadylight.progress import black_frames

FarmRunArgument = Annotated[str, typer.Argument(metavar="RUN", help="Run directory; not a URL.")]
JobFormat = Literal["openjd", "flamenco", "opencue"]


@app.command()
def export(
    run: FarmRunArgument,
    *,
    job_format: Annotated[
        JobFormat, typer.Option("--format", help="Open Job Description, Flamenco or OpenCue (PyOutline).")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="File for the job.", show_default="RUN.FORMAT"),
    ] = None,
    program: Annotated[
        str, typer.Option(metavar="PATH", help="The steadylight command on the machines of the farm.")
    ] = "steadylight",
    chunk: Annotated[int, typer.Option(min=1, metavar="N", help="Frames per command.")] = 8,
) -> None:
    """Write a run as a job of a render farm. `render --prepare-only` makes the run directory."""
    from steadylight.animation.farm import FarmRun
    from steadylight.animation.farm_jobs import FORMATS, FarmOptions, write_job
    from steadylight.atomic_file import atomic_write

    prepared = FarmRun.open(run)
    path = output or Path(Path(run).resolve().name + FORMATS[job_format].suffix)
    text = write_job(prepared, job_format, FarmOptions(program, chunk))
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    out.print(f"{path}: {len(prepared.tasks)} tasks", soft_wrap=True)


@app.command()
def perform(
    run: FarmRunArgument,
    keys: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY...",
            help="Tasks by key (shade-00012) or by step and numbers (shade:1-8,12); `finish` makes video, "
            "statistics and report.",
        ),
    ],
    *,
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Threads per task.", show_default="all cores")
    ] = None,
) -> None:
    """Perform tasks of a run directory on this machine, as a worker would. Render farms run this command."""
    from steadylight.animation.farm import FINISH, FarmRun
    from steadylight.engines import Task

    prepared = FarmRun.open(run)
    tasks = prepared.choose([key for key in keys if key != FINISH])
    for each in prepared.perform(tasks, threads) if tasks else ():
        if isinstance(each, Task):
            out.print(f"{each.key}: is already done", soft_wrap=True)
        elif each.outcome == "done":
            out.print(f"{each.task.key}: done in {each.seconds:.1f} s", soft_wrap=True)
    if FINISH in keys:
        statistics, faults = prepared.finish()
        for fault in faults:
            out.print(fault, style="yellow", soft_wrap=True)
        out.print(
            f"{FINISH}: {statistics['frames']} frames, {prepared.directory.video_file}",
            soft_wrap=True,
        )
        if black := statistics["second_pass"]["black_frames"]:
            out.print(f"Warning: {black_frames(black)}", style="yellow", soft_wrap=True)
