"""Options of `steadylight preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveInt, SkipValidation

from steadylight.settings import ANIMATION, IMAGE, METHOD, CameraOptions, Option


class PreviewOptions(CameraOptions):
    """What to show, and how long to render it.

    Attributes:
        pictures: number of frames to show.
        seconds: time to render them, with at least one pass each.
        renderer: name of the renderer.
        output: the page; the picture of the same name ends in .png.
    """

    pictures: Annotated[PositiveInt, Field(le=48), Option("Frames to show.", IMAGE, "N")] = 12
    seconds: Annotated[float, Field(gt=0, le=600), Option("Time to render them, seconds.", IMAGE, "S")] = 8.0
    renderer: Annotated[str, Option("mitsuba, radiance, or another installed renderer.", METHOD, "NAME")] = (
        "mitsuba"
    )
    output: Annotated[
        SkipValidation[str | Path | None],
        Option("Page (.html); the picture beside it ends in .png.", ANIMATION, "FILE", "SCENE-preview.html"),
    ] = None
