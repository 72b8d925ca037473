"""All options of a render, as the user writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, SkipValidation

from steadylight.settings.camera import CameraOptions
from steadylight.settings.display import DisplaySettings
from steadylight.settings.machine import MachineSettings
from steadylight.settings.method import FirstPass, MethodSettings
from steadylight.settings.option import ANIMATION, MACHINE, METHOD, Option
from steadylight.settings.scene import SceneOptions
from steadylight.sites import SiteSettings

Frames = int | str | Sequence[int]
"""`N`, text such as `"30-53"`, `"1-91:45"` or `"1,5,9"`, or a sequence of frame numbers."""


class Options(CameraOptions, MethodSettings, MachineSettings, SceneOptions, DisplaySettings):
    """All options, as the user writes them.

    Attributes:
        frames: N for the first N frames of the path, or frame numbers: `A-B`, `A-B:STEP`, comma lists of these and of
            single numbers, or a sequence. Frame i is at time (i-1)/fps, whichever other frames are rendered. If None,
            the scene's own number of frames, or the whole path of `camera`.
        size: image size, pixels, as `WxH` or a pair; the scene's own if None.
        output: the run directory, or a URL that fsspec supports; if None, `runs/SCENE-MODE`, or if that holds a run
            with other input, `runs/SCENE-MODE-2` and so on.
        first_pass: how records are made: surface (look along all frames, then box by box) or frames (from selected
            frames, as published). If None, surface, unless the renderer or the mode does not support it, coverage is
            off, or selected frames, threshold or base rays are given.
        selected_frames: number of first-pass frames: auto (square root of the number of frames), workers (one per
            worker, as published) or a number.
        cache_parts: number of spatial parts in which the cache is merged, filled and read: auto (from the number of
            frames) or a number.
        site: settings of the batch system: a TOML file (see `sites.SiteSettings`), or the settings themselves.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    frames: Annotated[
        SkipValidation[Frames | None],
        Option(
            "Frames to render: the first N, a range (30-53), every n-th (1-91:45) or a list (1,5,9).",
            ANIMATION,
            "N",
            "the whole path",
        ),
    ] = None
    size: Annotated[
        SkipValidation[str | tuple[int, int] | None],
        Option("Image size in pixels.", ANIMATION, "WxH", "the scene's own"),
    ] = None
    output: Annotated[
        SkipValidation[str | Path | None],
        Option(
            "Run directory.",
            ANIMATION,
            "DIR",
            "runs/SCENE-MODE, numbered if taken",
            names=("--output", "-o"),
        ),
    ] = None
    first_pass: Annotated[
        FirstPass | None,
        Option(
            "surface: look along all frames and make records box by box. frames: make them from selected frames, as "
            "published.",
            METHOD,
            shown="surface, if nothing asks for frames",
        ),
    ] = None
    selected_frames: Annotated[
        SkipValidation[int | str],
        Option(
            "Number of first-pass frames: a number, `workers` (one per worker, as published), or `auto` (from the "
            "length of the animation).",
            METHOD,
            "auto|workers|N",
        ),
    ] = "auto"
    cache_parts: Annotated[
        SkipValidation[int | str],
        Option(
            "Number of spatial parts of the cache. With several, frames start before the whole cache is ready. "
            "auto: from the number of frames.",
            METHOD,
            "auto|N",
        ),
    ] = "auto"
    site: Annotated[
        SkipValidation[str | Path | SiteSettings | None],
        Option(
            "TOML file with the batch system's settings: queue, account, cores, memory, walltime, ...",
            MACHINE,
            "FILE",
            "Dask's own configuration",
        ),
    ] = None

    @property
    def scene(self) -> SceneOptions:
        """The options that belong to the scene file."""
        return SceneOptions(**self.values_of(SceneOptions))
