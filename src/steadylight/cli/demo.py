"""Command `demo`: renders a short film with the method and with its rivals, and compares them on a page."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from steadylight.cli.application import app
from steadylight.cli.pages import show_page
from steadylight.cli.rendering import work_on
from steadylight.display import err, out
from steadylight.progress import duration
from steadylight.settings import Options

if TYPE_CHECKING:
    from steadylight.animation.run import Run

SCENE, FRAMES, SIZE = "temple-walk", "30-37", "128x96"
"""A walk among columns lit almost only by indirect light, short and small enough to render in minutes."""

_FIRST = 30
_TRIAL_SPP = 16


@app.command()
def demo(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the films and the page.")
    ] = Path("steadylight-demo"),
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, if this is a terminal.")
    ] = True,
) -> None:
    """Render a short walk in three ways (a few minutes) and compare them on a page. Repeat it to resume."""
    from steadylight.report import write_comparison

    start = time.perf_counter()
    try:
        films = _films(output)
    except KeyboardInterrupt:
        err.print("Stopped. Finished work is kept. To resume, run the same command.")
        raise typer.Exit(130) from None
    page = write_comparison(films, output / "compare.html", title=f"{SCENE}, frames {FRAMES}")
    out.print(f"Done in {duration(time.perf_counter() - start)}. Page: {page}", soft_wrap=True)
    out.print("Press Play: the film in the middle flickers. Then choose `flicker of each`.", soft_wrap=True)
    show_page(page.resolve().as_uri(), browser=browser)


def _films(output: Path) -> list[Path]:
    """Render the three films, or resume them; returns their run directories."""
    from steadylight.animation.provenance import read_run
    from steadylight.storage import RunDirectory

    begun = RunDirectory(output / "two-pass")
    # A resumed demo keeps its settings, even if the denoiser has been installed since.
    denoise = read_run(begun).settings.denoise if begun.run_file.exists() else _can_denoise()

    def render(number: int, name: str, about: str, **given: object) -> Run:
        out.print(f"{number} of 3: {name}, {about}", style="bold", soft_wrap=True)
        return _rendered(output / name, denoise=denoise, **given)

    two_pass = render(1, "two-pass", "one cache for all frames", mode="two-pass", aovs=True)
    single = render(2, "single-pass", "a cache for each frame", mode="single-pass")
    name = "path-denoised"
    if RunDirectory(output / name).run_file.exists():
        spp = read_run(RunDirectory(output / name)).settings.spp
    else:
        seconds = two_pass.statistics["makespan_s"] / len(two_pass.frames)
        spp = _samples_in(seconds, output / "trial", denoise=denoise)
    path = render(
        3, name, f"{spp} samples per pixel, as many as fit in the time of two-pass", mode="path", spp=spp
    )
    return [run.directory for run in (two_pass, single, path)]


def _samples_in(seconds: float, place: Path, *, denoise: bool) -> int:
    """Samples per pixel with which path tracing takes at most `seconds` for a frame, denoising included."""
    out.print("Measuring the speed of path tracing: two test frames.", style="dim", soft_wrap=True)
    trial = _rendered(place, mode="path", denoise=denoise, spp=_TRIAL_SPP, frames=f"{_FIRST}-{_FIRST + 1}")
    # The second frame is measured: the first compiles the kernels.
    a_sample = trial.statistics["second_pass"]["frame_seconds"][-1] / _TRIAL_SPP
    # The path tracer's sampler fills a square grid in each pixel.
    return max(1, math.isqrt(max(1, int(seconds / a_sample)))) ** 2


def _rendered(directory: Path, **given: object) -> Run:
    """Render a film of the demo, or resume it."""
    from steadylight.animation.request import request_of
    from steadylight.animation.run import Session

    options: dict[str, object] = {
        "frames": FRAMES,
        "size": SIZE,
        "quality": "draft",
        "spp": 8,
        **given,
    }
    return work_on(
        Session(request_of(SCENE, Options.checked(**options, output=directory, cluster="in-process")))
    )


def _can_denoise() -> bool:
    """Whether a denoiser is installed; if not, print what to install."""
    from importlib.util import find_spec

    if find_spec("pyoidn") is not None:
        return True
    out.print(
        "Open Image Denoise is not installed; with it, the comparison would be fairer to path tracing: "
        f"{sys.executable} -m pip install pyoidn",
        style="yellow",
        soft_wrap=True,
    )
    return False
