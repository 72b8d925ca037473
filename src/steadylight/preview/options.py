"""Options of `steadylight preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt, SkipValidation

from steadylight.settings import ANIMATION, IMAGE, METHOD, CheckedSettings, Option


class PreviewOptions(CheckedSettings):
    """What to look at, and how long.

    Attributes:
        camera: a camera file; the scene's own camera if None.
        first_frame: number that the camera file gives to its first frame.
        orbit: instead of `camera`, a circle: see `camera.orbit.Orbit`.
        fps: frames per second.
        pictures: how many frames are shown.
        seconds: how long they are rendered, at least one pass each.
        renderer: name of the renderer.
        output: the page; the picture of the same name ends in .png.
    """

    camera: Annotated[
        str | None, Option("Camera file; see docs/cameras.md.", ANIMATION, "FILE", "the scene's own")
    ] = None
    first_frame: Annotated[
        int | None,
        Option("Number that the camera file gives to its first frame.", ANIMATION, "N", "the file's, or 1"),
    ] = None
    orbit: Annotated[
        str | None, Option("A circle; see `render --help`.", ANIMATION, "scene|KEY=VALUE,...", "none")
    ] = None
    fps: Annotated[
        PositiveFloat | None,
        Field(allow_inf_nan=False),
        Option("Frames per second.", ANIMATION, "F", "the camera's or the scene's"),
    ] = None
    pictures: Annotated[PositiveInt, Field(le=48), Option("Frames to show.", IMAGE, "N")] = 12
    seconds: Annotated[float, Field(gt=0, le=600), Option("Time to render them, seconds.", IMAGE, "S")] = 8.0
    renderer: Annotated[str, Option("mitsuba, radiance, or another installed renderer.", METHOD, "NAME")] = (
        "mitsuba"
    )
    output: Annotated[
        SkipValidation[str | Path | None],
        Option("Page (.html); the picture beside it ends in .png.", ANIMATION, "FILE", "SCENE-preview.html"),
    ] = None
