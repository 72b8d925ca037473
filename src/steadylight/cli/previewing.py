"""Command `preview`."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer

from steadylight.cli.application import app
from steadylight.cli.options import SceneArgument, with_options
from steadylight.display import out, show_notes
from steadylight.preview.options import PreviewOptions
from steadylight.settings import SceneOptions


@app.command()
@with_options(scene_options=SceneOptions, options=PreviewOptions)
def preview(
    scene: SceneArgument,
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of lines.")] = False,
    scene_options: SceneOptions,
    options: PreviewOptions,
) -> None:
    """Show in seconds how a scene and its camera path were understood.

    Writes a page and a picture: quick frames, a plan, sizes, lights, and what was converted or left out.
    """
    from steadylight.preview.making import make_preview, plain

    made = make_preview(scene, scene_options, options)
    if as_json:
        sys.stdout.write(json.dumps(plain(made), indent=2) + "\n")
        return
    for fact in made.facts:
        out.print(f"{fact[:1].upper()}{fact[1:]}.", soft_wrap=True)
    for warning in made.warnings:
        out.print(f"Warning: {warning}", style="yellow", soft_wrap=True)
    show_notes(made.notes)
    for name, path in (("page", made.page), ("picture", made.sheet)):
        out.print(f"  {name:<7} {path}", soft_wrap=True)
