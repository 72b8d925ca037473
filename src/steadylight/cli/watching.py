"""Command `watch`."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from steadylight.cli.application import app
from steadylight.cli.options import RunArgument
from steadylight.cli.pages import live_page
from steadylight.errors import InputError


@app.command()
def watch(
    run: RunArgument,
    *,
    port: Annotated[
        int,
        typer.Option(metavar="N", min=0, max=65535, help="Port of this machine.", show_default="any free"),
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, if this is a terminal.")
    ] = True,
) -> None:
    """Serve a live page about a run: progress, frames as they arrive, workers, failures. Ends with Ctrl-C."""
    if not run.is_dir():
        raise InputError(f"{run}: no such folder; give the run directory of a render, also before it begins")
    with live_page(run, port, browser=browser):
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            raise typer.Exit(0) from None
