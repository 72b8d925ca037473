"""Settings that determine the bytes of the frames."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field, PositiveFloat, PositiveInt

from steadylight.quality import WORDS, Quality, spacing_of_film
from steadylight.settings.camera import FrameRate
from steadylight.settings.option import IMAGE, METHOD, CheckedSettings, Option

MOST_PIXELS: Final = 16384
"""Maximum number of pixels on each side of the image: the video encoder supports no more."""

Mode = Literal["two-pass", "single-pass", "path"]
Coverage = Literal["full", "off"]
FirstPass = Literal["surface", "frames"]
Radii = Literal["split-sphere", "occlusion-hessian"]
SolidPanes = Literal["refract", "straight"]


def checked_bounces(value: object) -> int | Literal["auto"]:
    """A number of bounces, also as text, or `auto`; raises a ValueError for anything else."""
    if value == "auto":
        return "auto"
    try:
        number = int(value)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        number = -1
    if isinstance(value, bool | float) or number < 0:
        raise ValueError("give auto or a whole number of at least 0")
    return int(number)


Bounces = Annotated[int | Literal["auto"], BeforeValidator(checked_bounces)]
"""Type of a settings field: a number of indirect bounces, or `auto` for all that matter."""


class MethodSettings(CheckedSettings):
    """Options that affect the output bytes and are recorded as the user gives them.

    Attributes:
        renderer: name of the renderer; see `steadylight.renderers`.
        spp: samples per pixel.
        quality: 1 is normal; higher is slower and more accurate; see `steadylight.quality`.
        bounces: number of indirect bounces, counted from the diffuse surface that the camera sees, directly or in a
            reflection; or `auto` for all that matter (paper: 2 to 3).
        denoise: denoise direct light and glossy reflections, but not cached light, with Open Image Denoise; in mode
            path, denoise everything.
        seed: random seed.
        mode: two-pass (the method), single-pass (a private cache per frame) or path (no cache).
        threshold: stop a first-pass frame at this many cache hits per miss (paper: 10).
        base_rays: rays before the threshold is first tested (paper: 128).
        radii: how record radii are chosen.
        panes: how light from emitters passes solid clear glass.
        coverage: full (audit all frames after the merge and fill what is missing) or off (as in the paper).
    """

    renderer: Annotated[str, Option("mitsuba, radiance, or another installed renderer.", METHOD, "NAME")] = (
        "mitsuba"
    )
    spp: Annotated[PositiveInt, Option("Samples per pixel.", IMAGE, "N")] = 16
    quality: Annotated[
        Quality,
        Option(
            "Overall accuracy: draft, normal, high, or a number. 1 is normal; higher is slower and more accurate.",
            IMAGE,
            "WORD|X",
            worded=True,
        ),
    ] = WORDS["normal"]
    bounces: Annotated[
        Bounces,
        Option(
            "Number of indirect bounces from the diffuse surface in view. auto: as many as leave out less than 1 % of "
            "the light.",
            IMAGE,
            "auto|N",
        ),
    ] = "auto"
    denoise: Annotated[
        bool,
        Option(
            "Denoise direct light and glossy reflections with Open Image Denoise, never cached light; mode path: "
            "everything. Needs the extra `denoise`.",
            IMAGE,
        ),
    ] = False
    seed: Annotated[int, Field(ge=0, lt=2**32), Option("Random seed.", IMAGE, "N")] = 0
    mode: Annotated[
        Mode,
        Option(
            "two-pass: one cache shared by all frames. single-pass: a cache for each frame (baseline). "
            "path: path tracing, no cache (baseline).",
            METHOD,
        ),
    ] = "two-pass"
    threshold: Annotated[
        PositiveFloat,
        Field(allow_inf_nan=False),
        Option("Stop a first-pass frame at this many cache hits per miss.", METHOD, "X"),
    ] = 10.0
    base_rays: Annotated[PositiveInt, Option("Rays before the threshold is first tested.", METHOD, "N")] = 128
    radii: Annotated[
        Radii,
        Option(
            "How record radii are chosen: harmonic mean distance (Ward 1988) or occlusion Hessian "
            "(Schwarzhaupt 2012).",
            METHOD,
        ),
    ] = "occlusion-hessian"
    panes: Annotated[
        SolidPanes,
        Option(
            "How light from emitters passes solid clear glass. refract: bent, as it is, and noisy. straight: as "
            "through a flat pane, without noise.",
            METHOD,
        ),
    ] = "refract"
    coverage: Annotated[
        Coverage, Option("Coverage audit: find and fill what the cache misses on any frame.", METHOD)
    ] = "full"


class RenderSettings(MethodSettings):
    """Everything besides scene and camera path that determines the bytes of the frames.

    Attributes:
        frames: frame numbers to render, counted from 1; frame i is at time (i-1)/fps on the camera path.
        width: image width, pixels.
        height: image height, pixels.
        fps: frames per second of video and camera path.
        first_pass: how records are made; see `Options`.
        selected_frames: number of first-pass frames (`auto` and `workers` are already resolved to a number); 1 if the
            first pass selects none.
        depth: maximum number of non-diffuse interactions (mirrors, glass, gloss) between the eye and a cached surface.
        cache_parts: number of spatial parts in which the shared cache is merged, filled and read (`auto` is already
            resolved to a number).
    """

    frames: tuple[PositiveInt, ...] = Field(min_length=1)
    width: int = Field(ge=1, le=MOST_PIXELS)
    height: int = Field(ge=1, le=MOST_PIXELS)
    fps: FrameRate = 25.0
    first_pass: FirstPass = "frames"
    selected_frames: PositiveInt = 1
    depth: PositiveInt = 12
    cache_parts: int = Field(default=1, ge=1, le=999)

    @property
    def record_spacing(self) -> float:
        """Distance of records relative to that in a long film; 1 in the published first pass."""
        return spacing_of_film(len(self.frames)) if self.first_pass == "surface" else 1.0
