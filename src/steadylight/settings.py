"""Settings of a render: what the user may choose, with defaults, units and checks.

`RenderSettings` decides the bytes of the frames and is recorded in `run.json`; `ExecutionSettings` says where
the work runs and decides nothing.
"""

from __future__ import annotations

from math import isqrt
from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from steadylight.errors import SettingsError
from steadylight.sites import SiteSettings

Mode = Literal["two-pass", "single-pass", "path"]
Quality = Literal["draft", "normal", "high"]
Coverage = Literal["full", "off"]
Radii = Literal["split-sphere", "occlusion-hessian"]
Variant = Literal["auto", "llvm", "cuda"]


class CacheSettings(BaseModel):
    """How irradiance records are made and reused; `--quality` chooses a set of these.

    Attributes:
        polar_strata: M, strata in elevation of the cosine-stratified hemisphere (Ward & Heckbert 1992).
        azimuth_strata: N, strata in azimuth. A record's first look takes M*N paths, one to a stratum.
        paths: further paths, sent where the first look saw light: each record takes one of these numbers, by its noise.
            Ascending, at least M*N each, and square, since their shared multijitter point set is a grid.
        noise: relative standard error that a record's number of paths aims at, as far as the first look can tell; less
            is asked of records at their smallest reach, whose neighbours share their noise.
        radii: what a record's reach goes by: split-sphere, the harmonic mean distance of what its hemisphere sees
            (Ward, Rubinstein & Clear 1988); or occlusion-hessian, how irradiance bends beside it (Schwarzhaupt,
            Jensen & Jarosz 2012).
        accuracy: a; a record reaches `a` times that.
        clamped: no record reaches beyond the nearest surface that stands over it; off as published.
        minimum_spacing: smallest reach, in pixels of the camera that comes nearest on the whole path.
        maximum_spacing: largest reach, as a fraction of the scene's diagonal.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    polar_strata: PositiveInt = 10
    azimuth_strata: PositiveInt = 40
    paths: tuple[PositiveInt, ...] = Field(default=(400, 784, 1600, 3136), min_length=1)
    noise: PositiveFloat = 0.033
    radii: Radii = "occlusion-hessian"
    accuracy: PositiveFloat = 0.15
    clamped: bool = True
    minimum_spacing: PositiveFloat = 1.6
    maximum_spacing: PositiveFloat = 0.05

    @model_validator(mode="after")
    def _paths_fit(self) -> Self:
        if any(count < self.strata or isqrt(count) ** 2 != count for count in self.paths):
            raise ValueError("paths must be square numbers, and at least one path for each stratum")
        if list(self.paths) != sorted(set(self.paths)):
            raise ValueError("paths must ascend")
        return self

    @property
    def strata(self) -> int:
        """M*N."""
        return self.polar_strata * self.azimuth_strata

    @property
    def paths_per_record(self) -> tuple[int, int]:
        """Paths of both looks, for a quiet record and for a noisy one."""
        return self.strata + self.paths[0], self.strata + self.paths[-1]


QUALITY: dict[Quality, CacheSettings] = {
    "draft": CacheSettings(
        polar_strata=8,
        azimuth_strata=32,
        paths=(400, 784, 1600),
        noise=0.06,
        accuracy=0.25,
        minimum_spacing=6.0,
    ),
    "normal": CacheSettings(),
    "high": CacheSettings(paths=(400, 784, 1600, 3136, 6400), noise=0.022, accuracy=0.1, minimum_spacing=1.0),
}


class RenderSettings(BaseModel):
    """Everything besides scene and camera path that decides the bytes of the frames.

    Attributes:
        frames: frame numbers to render, counted from 1; frame i is at time (i-1)/fps on the camera path.
        width: image width, pixels.
        height: image height, pixels.
        fps: frames per second of film and camera path.
        spp: samples per pixel.
        quality: chooses the cache settings; high also the larger network of the denoiser.
        mode: two-pass (the method), single-pass (a private cache per frame) or path (no cache).
        selected_frames: how many frames the first pass visits (already a number: `auto` and `workers` are
            resolved before).
        threshold: stop a first-pass frame at this many cache hits per miss (paper: 10).
        base_rays: rays before the threshold is looked at (paper: 128).
        bounces: indirect diffuse bounces (paper: 2 to 3).
        depth: most non-diffuse interactions (mirrors, glass, gloss) between the eye and a cached surface.
        radii: what the reach of records goes by; see `CacheSettings`.
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
    quality: Quality = "normal"
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

    @property
    def cache(self) -> CacheSettings:
        """The cache settings that `quality` stands for, with the radii that were asked for."""
        return QUALITY[self.quality].model_copy(update={"radii": self.radii})

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
