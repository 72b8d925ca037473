"""Rendering from Python: progress on a terminal and in notebooks."""

from __future__ import annotations

from rich.console import Console

from steadylight.animation.options import Scene, with_options
from steadylight.animation.request import request_of
from steadylight.animation.run import Run, Session
from steadylight.progress import Bars, Tally
from steadylight.settings import Options


@with_options(Options)
def render(scene: Scene, options: Options) -> Run:
    """Render a walkthrough (frames, video and report) into a run directory, or resume it.

    Takes the arguments of `steadylight.plan`, with the same defaults. Shows its progress on a terminal (on standard
    error) and in a notebook, and is silent elsewhere:

    ```python
    run = steadylight.render("gallery", frames=12, size=(512, 288), spp=16)
    ```

    Returns:
        The finished run.

    Raises:
        InputError: the input is wrong; nothing was written.
        RunError: permanent failure; the same call resumes the run.
    """
    console = Console(stderr=True)
    with Session(request_of(scene, options)) as session:
        if session.waiting and (console.is_terminal or console.is_jupyter):
            tally = Tally(session.request.tasks, session.results(), session.request.settings)
            with Bars(console, tally) as bars:
                for attempt in session:
                    bars.add(attempt)
        else:
            for _ in session:
                pass
        return session.finish()
