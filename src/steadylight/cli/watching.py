"""Command `watch`, and the live page of `render --watch`."""

from __future__ import annotations

import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from steadylight.cli.application import app
from steadylight.cli.options import RunArgument
from steadylight.display import out
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


@contextmanager
def live_page(run: Path, port: int = 0, *, browser: bool = True) -> Iterator[None]:
    """Serve the live page of a run meanwhile, say where it is, and open it if somebody sits here."""
    from steadylight.live import LiveServer

    with LiveServer(run, port) as server:
        out.print(f"Live page, on this machine only: {server.address}", soft_wrap=True, markup=False)
        show_page(server.address, browser=browser)
        yield


def show_page(address: str, *, browser: bool = True) -> None:
    """Open a page if somebody sits at a terminal, and there is a browser."""
    if browser and sys.stdin.isatty() and sys.stdout.isatty():
        webbrowser.open(address)
