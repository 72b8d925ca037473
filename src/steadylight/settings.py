"""Settings of a render: what the user may choose, with defaults, units and checks.

`RenderSettings` decides the bytes of the frames and is recorded in `run.json`; `ExecutionSettings` says where
the work runs and decides nothing.
"""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
)

from steadylight.errors import SettingsError
from steadylight.quality import WORDS, Quality
from steadylight.sites import SiteSettings

Mode = Literal["two-pass", "single-pass", "path"]
Coverage = Literal["full", "off"]
Radii = Literal["split-sphere", "occlusion-hessian"]
Variant = Literal["auto", "llvm", "cuda"]


class RenderSettings(BaseModel):
    """Everything besides scene and camera path that decides the bytes of the frames.

    Attributes:
        frames: frame numbers to render, counted from 1; frame i is at time (i-1)/fps on the camera path.
        width: image width, pixels.
        height: image height, pixels.
        fps: frames per second of film and camera path.
        spp: samples per pixel.
        quality: 1 is normal, more is slower and closer to the truth; see `steadylight.quality`.
        mode: two-pass (the method), single-pass (a private cache per frame) or path (no cache).
        selected_frames: how many frames the first pass visits (already a number: `auto` and `workers` are
            resolved before).
        threshold: stop a first-pass frame at this many cache hits per miss (paper: 10).
        base_rays: rays before the threshold is looked at (paper: 128).
        bounces: indirect diffuse bounces (paper: 2 to 3).
        depth: most non-diffuse interactions (mirrors, glass, gloss) between the eye and a cached surface.
        radii: what the radius of records goes by; see `renderers.mitsuba.quality`.
        coverage: full (audit all frames after the merge and fill holes) or off (as in the paper).
        cache_parts: parts of space in which the shared cache is merged, filled and read (already a number: `auto` is
            resolved before).
        denoise: direct light and gloss go through Open Image Denoise.
        seed: of everything random.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: tuple[PositiveInt, ...] = Field(min_length=1)
    width: int = Field(ge=1, le=65536)
    height: int = Field(ge=1, le=65536)
    fps: PositiveFloat = Field(default=25.0, allow_inf_nan=False)
    spp: PositiveInt = 16
    quality: Quality = WORDS["normal"]
    mode: Mode = "two-pass"
    selected_frames: PositiveInt = 1
    threshold: PositiveFloat = Field(default=10.0, allow_inf_nan=False)
    base_rays: PositiveInt = 128
    bounces: NonNegativeInt = 2
    depth: PositiveInt = 12
    radii: Radii = "occlusion-hessian"
    coverage: Coverage = "full"
    cache_parts: int = Field(default=1, ge=1, le=999)
    denoise: bool = False
    seed: int = Field(default=0, ge=0, lt=2**32)

    @classmethod
    def checked(cls, **values: Any) -> Self:
        """Make settings; a wrong one raises SettingsError that names the option, the value and what is right."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingsError(_explain(error)) from None


class ExecutionSettings(BaseModel):
    """Where the work runs; no effect on any byte of the result.

    Attributes:
        workers: worker processes; on one machine each uses its share of the cores, a batch job all of its own.
        cluster: `in-process`, `local`, a batch system, or the address of a Dask scheduler.
        site: what the batch system wants to know, and how long to bear with faults.
        variant: Mitsuba backend; auto takes cuda where a device is found, llvm otherwise.
        attempts: how often a task may fail before the run gives up.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    workers: PositiveInt = 1
    cluster: str = "local"
    site: SiteSettings = SiteSettings()
    variant: Variant = "auto"
    attempts: PositiveInt = 3

    @classmethod
    def checked(cls, **values: Any) -> Self:
        """Make settings; a wrong one raises SettingsError that names the option, the value and what is right."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingsError(_explain(error)) from None


def _explain(error: ValidationError) -> str:
    """Pydantic's findings as one line each, in the words of the command line."""
    lines = []
    for finding in error.errors():
        option = "--" + str(finding["loc"][0]).replace("_", "-") if finding["loc"] else "settings"
        lines.append(f"{option}: {finding['input']!r} is not valid: {finding['msg'].lower()}")
    return "\n".join(lines)
