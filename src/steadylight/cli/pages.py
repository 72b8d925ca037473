"""Pages that commands open in a browser, if they are run from a terminal."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from steadylight.display import out


@contextmanager
def live_page(run: Path, port: int = 0, *, browser: bool = True) -> Iterator[None]:
    """Serve the live page of a run inside the `with` block; print its address, and open it from a terminal."""
    from steadylight.live import LiveServer

    with LiveServer(run, port) as server:
        out.print(f"Live page, on this machine only: {server.address}", soft_wrap=True)
        show_page(server.address, browser=browser)
        yield


def show_page(address: str, *, browser: bool = True) -> None:
    """Open a page in a browser, if there is one and the command is run from a terminal."""
    if browser and sys.stdin.isatty() and sys.stdout.isatty():
        webbrowser.open(address)
