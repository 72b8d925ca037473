"""Commands `cache view` and `why`: which records a frame was shaded from."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from steadylight.cli.application import app, cache_app
from steadylight.cli.options import RunArgument
from steadylight.cli.pages import show_page
from steadylight.display import out
from steadylight.errors import SettingsError

if TYPE_CHECKING:
    from steadylight.animation.inspection import Records
    from steadylight.renderers.base import Question

FrameOption = Annotated[int, typer.Option("--frame", metavar="N", help="Number of the frame.")]


@cache_app.command()
def view(
    run: RunArgument,
    *,
    frame: FrameOption,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="The page.", show_default="records-RUN-N.html"),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, if this is a terminal.")
    ] = True,
) -> None:
    """Draw the records of a frame over it and from above, by radius, noise, origin and part, on a page."""
    from steadylight.animation.inspection import Inspection
    from steadylight.images import read_exr
    from steadylight.report.records import Scenery, write_records_page

    inspected = Inspection(run, frame)
    image = read_exr(inspected.directory.frame(frame))
    records = inspected.records()
    (pose,) = inspected.run.camera.frame_poses([frame], inspected.run.settings.fps)
    page = write_records_page(
        output or Path(f"records-{run.resolve().name}-{frame}.html"),
        run.resolve().name,
        Scenery(frame, image, pose, inspected.surfaces()),
        records.table,
        {**records.origins(), "part": records.part},
    )
    out.print(f"Page: {page}", soft_wrap=True)
    show_page(page.resolve().as_uri(), browser=browser)


@app.command()
def why(
    run: RunArgument,
    *,
    frame: FrameOption,
    pixel: Annotated[str, typer.Option(metavar="X,Y", help="Column and row, from 0,0 at the top left.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Show which records were used at a pixel: weights, distances, values, and where each record came from."""
    from steadylight.animation.inspection import Inspection

    inspected = Inspection(run, frame)
    column, row = _pixel(pixel)
    questions = inspected.questions(column, row)
    records = inspected.records()
    if as_json:
        sys.stdout.write(json.dumps([_plain(each, records) for each in questions], indent=2) + "\n")
        return
    if not questions:
        out.print("The cache is not used at the centre of this pixel: no diffuse surface is visible there.")
    for number, each in enumerate(questions, start=1):
        _show(number, each, records)


def _pixel(text: str) -> tuple[int, int]:
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(
            f"--pixel: {text!r} cannot be read; give a column and a row, such as 120,45"
        ) from None
    return column, row


def _plain(question: Question, records: Records) -> dict[str, object]:
    """A look-up and the records that answered it, as plain data."""
    return {
        "position": question.position,
        "normal": question.normal,
        "irradiance": question.irradiance,
        "records": [
            {
                "record": row,
                "file": records.files[records.table.source[row]],
                "from": records.words(row),
                "position": [float(x) for x in records.table.position[row]],
                "radius": float(records.table.radius[row]),
                "distance": distance,
                "weight": weight,
                "share": share,
                "value": value,
            }
            for row, distance, weight, share, value in zip(
                question.rows, question.distance, question.weight, question.share, question.value, strict=True
            )
        ],
    }


def _show(number: int, question: Question, records: Records) -> None:
    place, light = _vector(question.position), _vector(question.irradiance)
    out.print(f"surface {number} at {place} m: irradiance {light} W/m²", style="bold", soft_wrap=True)
    if not question.rows:
        out.print("  no record's radius reaches this point")
        return
    heads = f"  {'record':>8} {'share':>6} {'weight':>7} {'distance':>10} {'radius':>9}  {'expects, W/m²':<30} made for"
    out.print(heads, soft_wrap=True)
    for row, distance, weight, share, value in zip(
        question.rows, question.distance, question.weight, question.share, question.value, strict=True
    ):
        radius = float(records.table.radius[row])
        line = f"  {row:>8} {share:>6.1%} {weight:>7.4f} {distance:>8.4f} m {radius:>7.3g} m  {_vector(value):<30} "
        out.print(line + records.words(row), soft_wrap=True)
    used = sorted({records.files[records.table.source[row]] for row in question.rows})
    out.print(f"  of {', '.join(used)}", soft_wrap=True)


def _vector(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
