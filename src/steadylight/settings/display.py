"""How frames are shown: video and pictures."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from steadylight.settings.option import DISPLAY, CheckedSettings, Option

Tone = Literal["agx", "filmic", "srgb", "none"]
FramesAs = Literal["exr", "png"]


def checked_exposure(value: object) -> float | Literal["auto", "lock"]:
    """A number of stops (EV), also as text, or a word; raises a ValueError for anything else."""
    if value == "auto" or value == "lock":  # noqa: PLR1714 - so that the type checker sees the words
        return value
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not -100 <= number <= 100:
        raise ValueError("give auto, lock, or a number of stops such as -1.5")
    return number


Exposure = Annotated[float | Literal["auto", "lock"], BeforeValidator(checked_exposure)]
"""Type of a settings field for `--exposure`."""


class DisplaySettings(CheckedSettings):
    """Options for video and pictures; frames and caches do not depend on them.

    Attributes:
        exposure: stops (scene-linear values are multiplied by 2 to this power); `auto`: as needed to show the middle
            brightness of the film as middle grey; `lock`: the same for its first frame. One value for the whole film.
        tone: curve from scene-linear values to the display; see `images.to_display`.
        frames_as: `png` to write a picture of each frame in addition to its EXR file.
        video_crf: x264's constant rate factor for the video; each increase by 6 roughly halves its size.
    """

    exposure: Annotated[
        Exposure,
        Option(
            "One exposure for the whole film: stops, auto (middle brightness of the film becomes middle grey), or "
            "lock (that of the first frame).",
            DISPLAY,
            "EV|auto|lock",
        ),
    ] = "auto"
    tone: Annotated[
        Tone,
        Option(
            "Tone curve: Blender's agx or filmic, srgb with compressed highlights, or none, which clips them.",
            DISPLAY,
        ),
    ] = "srgb"
    frames_as: Annotated[
        FramesAs, Option("png: also write 8-bit pictures of the frames, which are always EXR.", DISPLAY)
    ] = "exr"
    video_crf: Annotated[
        int,
        Field(ge=1, le=51),
        Option(
            "Quality of the video (x264's constant rate factor): 17 is almost lossless, 30 is small.",
            DISPLAY,
            "N",
        ),
    ] = 17
