"""Options for the camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ConfigDict, Field, SkipValidation

from steadylight.settings.option import ANIMATION, CheckedSettings, Option

if TYPE_CHECKING:
    from steadylight.camera import CameraPath

    CameraSource = str | Path | CameraPath
else:
    CameraSource = Any  # the camera module imports NumPy and SciPy, too slow for `--help`


FrameRate = Annotated[float, Field(ge=1e-3, le=1e3, allow_inf_nan=False)]
"""Frames per second, from slow time lapse to fast slow motion; the video format allows little more."""


class CameraOptions(CheckedSettings):
    """Options for the camera.

    Attributes:
        camera: a camera file or a camera path; the scene's own if None.
        first_frame: number that the camera file gives to its first frame; if None, what the file says, or else 1.
        orbit: a circle in place of `camera`; see `camera.orbit.Orbit`.
        fps: frames per second; those of the camera file or the scene if None.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    camera: Annotated[
        SkipValidation[CameraSource | None],
        Option(
            "Camera file: keyframes (.toml, .json), a table (.csv), TUM poses (.txt) or Radiance views (.vf).",
            ANIMATION,
            "FILE",
            "the scene's own",
        ),
    ] = None
    first_frame: Annotated[
        int | None,
        Option("Number that the camera file gives to its first frame.", ANIMATION, "N", "the file's, or 1"),
    ] = None
    orbit: Annotated[
        str | None,
        Option(
            "Circle around the scene, or some of radius=4,height=1.6,around=0:0:1,turns=1,frames=250,fov=60.",
            ANIMATION,
            "scene|KEY=VALUE,...",
            "none",
        ),
    ] = None
    fps: Annotated[
        FrameRate | None, Option("Frames per second.", ANIMATION, "F", "the camera's or the scene's")
    ] = None
