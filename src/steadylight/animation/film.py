"""What is made from the finished frames: video, pictures, statistics and report.

None of it affects the bytes of the frames. `display.json` says how it is made, and may change from one command to the
next.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from steadylight.atomic_file import atomic_write, storage_errors, write_json
from steadylight.checksum import parse, with_checksum
from steadylight.errors import SettingsError
from steadylight.images import (
    animation_exposure,
    exposure_of_files,
    read_exr,
    tone_map,
    validate_png,
    write_png,
)
from steadylight.settings import DisplaySettings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from steadylight.settings import RenderSettings
    from steadylight.storage import RunDirectory
    from steadylight.video import Look


def write_display(directory: RunDirectory, display: DisplaySettings) -> None:
    """Record how video and pictures will be made, unless the same is recorded already.

    Raises:
        StorageError: the directory cannot be written.
    """
    content = with_checksum(display.model_dump(mode="json"))
    with suppress(SettingsError):
        if directory.display_file.is_file() and read_display(directory) == display:
            return
    write_json(directory.display_file, content)


def read_display(directory: RunDirectory) -> DisplaySettings:
    """How video and pictures are to be made; the defaults if nothing is recorded.

    Raises:
        SettingsError: the file is damaged.
    """
    try:
        return DisplaySettings.checked(**parse(directory.display_file.read_bytes()))
    except FileNotFoundError:
        return DisplaySettings()
    except (OSError, ValueError, TypeError, SettingsError) as error:
        raise SettingsError(
            f"{directory.display_file}: cannot be read ({error}); remove it to use the defaults, or run the render "
            "command again, which rewrites it"
        ) from error


def compile_film(
    directory: RunDirectory,
    settings: RenderSettings,
    display: DisplaySettings,
    statistics: Mapping[str, Any],
) -> dict[str, Any]:
    """Write statistics, video, pictures and report of a run whose frames are all done.

    Returns:
        The content of `stats.json`.

    Raises:
        StorageError: the directory cannot be written.
    """
    from steadylight.report import write_report
    from steadylight.video import Look, compile_video

    frames = [directory.frame(number) for number in settings.frames]
    look = Look(exposure_of(frames, display), display.tone, display.video_crf)
    shown = {"tone": look.tone, "exposure": display.exposure, "ev": round(math.log2(look.exposure), 4)}
    complete = {
        **statistics,
        "exposure": look.exposure,
        "display": {**shown, "video_crf": look.crf, "frames_as": display.frames_as},
    }
    write_json(directory.stats_file, with_checksum(complete))
    compile_video(frames, directory.video_file, settings.fps, look)
    if display.frames_as == "png" or directory.pictures.is_dir():
        write_pictures(directory, settings.frames, look)
    write_report(directory.root)
    return complete


def exposure_of(frames: Sequence[Path], display: DisplaySettings) -> float:
    """The factor on scene-linear values for a whole film."""
    if display.exposure == "auto":
        return exposure_of_files(frames)
    if display.exposure == "lock":
        return animation_exposure([read_exr(frames[0])])
    return float(2.0**display.exposure)


def write_pictures(directory: RunDirectory, numbers: Sequence[int], look: Look) -> None:
    """Write a PNG file of each frame that shows what the video shows.

    Raises:
        StorageError: the directory cannot be written.
    """
    with storage_errors(directory.pictures):
        directory.pictures.mkdir(exist_ok=True)
    for number in numbers:
        with atomic_write(directory.picture(number), validate_png) as temporary:
            write_png(temporary, tone_map(read_exr(directory.frame(number)), look.exposure, look.tone))
