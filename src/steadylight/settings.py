"""Settings of a render: what the user may choose, with defaults, units and checks.

Every option is declared here once, as a field with an `Option`: the command line, the functions `steadylight.plan` and
`steadylight.render`, and the checks follow. `Options` is what the user writes. `RenderSettings`, derived from it,
determines the bytes of the frames and is recorded in `run.json`. `ExecutionSettings` says where the work runs and does
not affect the result.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    SkipValidation,
    ValidationError,
)

from steadylight.errors import SettingsError
from steadylight.quality import WORDS, Quality
from steadylight.sites import SiteSettings

if TYPE_CHECKING:
    from steadylight.camera import CameraPath

    CameraSource = str | Path | CameraPath
else:
    CameraSource = Any  # the camera module imports NumPy and SciPy, too slow for `--help`

Mode = Literal["two-pass", "single-pass", "path"]
Coverage = Literal["full", "off"]
FirstPass = Literal["surface", "frames"]
Radii = Literal["split-sphere", "occlusion-hessian"]
SolidPanes = Literal["refract", "straight"]
Variant = Literal["auto", "llvm", "cuda"]
Tone = Literal["agx", "filmic", "srgb", "none"]
FramesAs = Literal["exr", "png"]


def checked_bounces(value: object) -> int | Literal["auto"]:
    """A number of bounces, also as text, or `auto`; raises a ValueError that says so."""
    if value == "auto":
        return "auto"
    try:
        number = int(value)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        number = -1
    if isinstance(value, bool | float) or number < 0:
        raise ValueError("give auto or a whole number of at least 0")
    return int(number)


def checked_parameters(value: object) -> object:
    """A mapping of names to text, also from `name=value` lines; raises a ValueError that says so."""
    if isinstance(value, Mapping):
        return {str(name): str(item) for name, item in value.items()}
    pairs = [str(item).partition("=") for item in (value if isinstance(value, list | tuple) else [value])]
    if not all(re.fullmatch(r"\w+", name) and sign for name, sign, _ in pairs):
        raise ValueError("give name=value")
    return {name: item for name, _, item in pairs}


Bounces = Annotated[int | Literal["auto"], BeforeValidator(checked_bounces)]
"""A field of settings for a number of indirect diffuse bounces, or `auto` for all that matter."""


def checked_exposure(value: object) -> float | Literal["auto", "lock"]:
    """Exposure values (EV), also as text, or a word; raises a ValueError that says so."""
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
"""A field of settings for `--exposure`."""

Frames = int | str | Sequence[int]
"""`N`, text such as `"30-53"`, `"1-91:45"` or `"1,5,9"`, or a sequence of frame numbers."""

SCENE, ANIMATION, IMAGE, DISPLAY = "Scene", "Animation", "Image", "Video and pictures"
METHOD, MACHINE, SIMULATION, WALK = "Method", "Machine", "Simulation", "Walk"
PANELS: Final = (WALK, SCENE, ANIMATION, IMAGE, DISPLAY, METHOD, MACHINE, SIMULATION)
"""How `--help` groups the options."""


@dataclass(frozen=True)
class Option:
    """How an option is shown on the command line, where a field `some_name` is `--some-name`.

    Attributes:
        help: a sentence.
        panel: one of PANELS.
        metavar: placeholder for the value; that of the type if None.
        shown: text to show instead of the default, where the default is None or uninformative.
        worded: whether a word may be given instead of a number.
        names: as typed, instead of the field's.
    """

    help: str
    panel: str
    metavar: str | None = None
    shown: str | None = None
    worded: bool = False
    names: tuple[str, ...] = ()


class CheckedSettings(BaseModel):
    """Settings whose validation errors use the option names of the command line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def checked(cls, **values: Any) -> Self:
        """Make settings; an invalid one raises a SettingsError with the option, the value and what is expected."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingsError(_explain(error)) from None

    def values_of(self, settings: type[BaseModel]) -> dict[str, Any]:
        """The options that `settings` takes unchanged."""
        return {name: getattr(self, name) for name in settings.model_fields}


class MethodSettings(CheckedSettings):
    """Options that affect the output bytes and are recorded as the user gives them.

    Attributes:
        renderer: name of the renderer; see `steadylight.renderers`.
        spp: samples per pixel.
        quality: 1 is normal; higher is slower and more accurate; see `steadylight.quality`.
        bounces: number of indirect diffuse bounces, or `auto` for all that matter (paper: 2 to 3).
        denoise: denoise direct light and glossy reflections with Open Image Denoise, never cached light (path: all).
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
            "Number of indirect diffuse bounces. auto: as many as leave out less than 1 % of the light.",
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


class MachineSettings(CheckedSettings):
    """Options that say where the work runs and do not affect the result.

    Attributes:
        workers: worker processes; on one machine each uses its share of the cores, in a batch job all of them.
        cluster: `in-process`, `local`, a batch system, or the address of a Dask scheduler.
        variant: backend of the Mitsuba renderer; auto is cuda if a device is found, otherwise llvm.
        aovs: write depth, normal and position of each pixel, too; frames stay the same.
    """

    workers: Annotated[
        PositiveInt,
        Option("Number of worker processes; with a batch system, the maximum number of jobs.", MACHINE, "N"),
    ] = 1
    cluster: Annotated[
        str,
        Option(
            "Where workers run: local, in-process, a batch system (slurm, sge, pbs, lsf, htcondor, oar), or the "
            "address of a Dask scheduler (tcp://..., tls://...).",
            MACHINE,
            "NAME",
        ),
    ] = "local"
    variant: Annotated[Variant, Option("Backend of the Mitsuba renderer.", MACHINE)] = "auto"
    aovs: Annotated[
        bool,
        Option(
            "Also write depth, normal and position of what each pixel sees (aovs/). A finished run can get them later.",
            IMAGE,
        ),
    ] = False


SKIES: Final = ("clear", "overcast")
"""What `--sky` takes instead of a file."""


UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length that `--unit` takes, metres."""


class SceneOptions(CheckedSettings):
    """Options that belong to a scene file. `scenes.READERS` tells which format takes which of them.

    Attributes:
        sky: a Radiance file with sky and sun, or `clear` or `overcast` for a sky with the given sun.
        sun: azimuth (from north over east) and altitude, degrees; `daylight` says where north is.
        place: latitude and longitude, degrees, north and east positive.
        time: date and time (ISO 8601) with offset from UTC, from which with `place` the sun follows.
        envmap: picture of the environment, latitude and longitude, as EXR, HDR or PFM.
        envmap_rotation: azimuth of its middle, degrees; north if None.
        unit: of length of a mesh file, which does not say; guessed from its size if None.
        up: axis that is up in a mesh file, which does not say; the usual one if None.
        sensor: id or name of a sensor or camera of the scene, or its number, counted from 1; the first if None.
        parameters: values of an .xml scene's parameters, by name, instead of its defaults; `name=value` lines are taken
            as well.
        allow_outside: whether a scene may refer to files outside its folder.
        skip_missing: leave out shapes of an .xml scene whose files are missing.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    sky: Annotated[
        SkipValidation[str | Path | None],
        Option(
            "Radiance file with sky and sun. With the sun given: clear or overcast.",
            SCENE,
            "FILE|clear|overcast",
            "none",
        ),
    ] = None
    sun: Annotated[
        str | None,
        Option(
            "Sun and clear sky: azimuth (0 north, 90 east) and altitude of the sun, degrees.",
            SCENE,
            "AZIMUTH,ALTITUDE",
            "none",
        ),
    ] = None
    place: Annotated[
        str | None,
        Option(
            "Sun and clear sky at a place: degrees north and east. Needs --time.", SCENE, "LAT,LON", "none"
        ),
    ] = None
    time: Annotated[
        str | None,
        Option("Time for --place, such as 2026-06-21T12:00+02:00.", SCENE, "ISO", "none"),
    ] = None
    envmap: Annotated[
        SkipValidation[str | Path | None],
        Option("Picture of the environment (latitude-longitude; .exr, .hdr).", SCENE, "FILE", "none"),
    ] = None
    envmap_rotation: Annotated[
        float | None,
        Field(allow_inf_nan=False),
        Option("Azimuth of the middle of --envmap, degrees from north over east.", SCENE, "DEGREES", "0"),
    ] = None
    unit: Annotated[
        Literal["m", "cm", "mm", "in", "ft"] | None,
        Option("Unit of length of an .obj, .ply or .stl scene.", SCENE, "m|cm|mm|in|ft", "by its size"),
    ] = None
    up: Annotated[
        Literal["y", "z"] | None,
        Option("Axis that is up in an .obj, .ply or .stl scene.", SCENE, "y|z", "y in .obj, z otherwise"),
    ] = None
    sensor: Annotated[
        SkipValidation[str | int | None],
        Option(
            "Sensor or camera of the scene, by id or name, or by number from 1.", SCENE, "ID|N", "the first"
        ),
    ] = None

    parameters: Annotated[
        Mapping[str, str],
        BeforeValidator(checked_parameters),
        Option(
            "Value of a parameter of an .xml scene, instead of its default; may be repeated.",
            SCENE,
            "NAME=VALUE",
            "the scene's own",
            names=("-D",),
        ),
    ] = {}
    allow_outside: Annotated[
        bool, Option("Let a scene refer to files outside its folder.", SCENE, shown="no")
    ] = False
    skip_missing: Annotated[
        bool, Option("Leave out shapes of an .xml scene whose files are missing.", SCENE, shown="no")
    ] = False

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {name: value for name, value in self if value}


class DisplaySettings(CheckedSettings):
    """Options for video and pictures; frames and caches do not depend on them.

    Attributes:
        exposure: stops (scene-linear values are multiplied by 2 to this power); `auto`: what brings the middle
            brightness of the film to middle grey; `lock`: the same for its first frame. Always one for the whole film.
        tone: curve from scene-linear values to the display; see `images.to_display`.
        frames_as: `png` to write a picture of each frame besides its EXR file.
        video_crf: x264's constant rate factor of the video; each 6 more roughly halve its size.
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


class CameraOptions(CheckedSettings):
    """From where a scene is seen.

    Attributes:
        camera: a camera file or a camera path; the scene's own if None.
        first_frame: number that the camera file gives to its first frame; what the file says, or else 1, if None.
        orbit: instead of `camera`, a circle: see `camera.orbit.Orbit`.
        fps: frames per second; that of the camera file or the scene if None.
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
        PositiveFloat | None,
        Field(allow_inf_nan=False),
        Option("Frames per second.", ANIMATION, "F", "the camera's or the scene's"),
    ] = None


class Options(CameraOptions, MethodSettings, MachineSettings, SceneOptions, DisplaySettings):
    """All options, as the user writes them.

    Attributes:
        frames: N for the first N frames of the path, or their numbers: `A-B`, `A-B:STEP`, comma lists of these and of
            single numbers, or a sequence. Frame i is at time (i-1)/fps, whichever other frames are rendered. If None,
            the scene's own number, or the whole path of `camera`.
        size: image size, pixels, as `WxH` or a pair; the scene's own if None.
        output: the run directory, or a URL that fsspec supports; if None, `runs/SCENE-MODE`, or if that holds a run
            with other input, `runs/SCENE-MODE-2` and so on.
        first_pass: how records are made: surface (look along all frames, then box by box) or frames (from selected
            frames, as published); if None, surface, unless coverage, selected frames, threshold or base rays are of the
            published method, or the renderer has only that.
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
        Option("Run directory.", ANIMATION, "DIR", "runs/SCENE-MODE, numbered if taken"),
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


class SimulationOptions(CheckedSettings):
    """Options of `steadylight plan` only: the machines on which a run is simulated.

    Attributes:
        simulate: whether to simulate.
        times: run directory to take task times and file sizes from; that of the plan if None.
        nodes: number of nodes.
        queue_wait: mean wait in the queue for a node, seconds.
        start: start-up time of a node, seconds.
        between_failures: mean time between failures of a node, hours.
        bandwidth: bandwidth of the shared store, MB/s.
    """

    simulate: Annotated[
        bool, Option("Simulate the run on many nodes, with measured task times.", SIMULATION)
    ] = False
    times: Annotated[
        SkipValidation[str | Path | None],
        Option("Run to take task times and file sizes from.", SIMULATION, "RUN", "--output"),
    ] = None
    nodes: Annotated[PositiveInt, Option("Number of nodes.", SIMULATION, "N")] = 200
    queue_wait: Annotated[
        NonNegativeFloat, Option("Mean wait in the queue for a node, seconds.", SIMULATION, "S")
    ] = 60.0
    start: Annotated[NonNegativeFloat, Option("Start-up time of a node, seconds.", SIMULATION, "S")] = 20.0
    between_failures: Annotated[
        PositiveFloat, Option("Mean time between failures of a node, hours.", SIMULATION, "H")
    ] = 1000.0
    bandwidth: Annotated[PositiveFloat, Option("Bandwidth of the shared store, MB/s.", SIMULATION, "MB")] = (
        1000.0
    )


class RenderSettings(MethodSettings):
    """Everything besides scene and camera path that determines the bytes of the frames.

    Attributes:
        frames: frame numbers to render, counted from 1; frame i is at time (i-1)/fps on the camera path.
        width: image width, pixels.
        height: image height, pixels.
        fps: frames per second of video and camera path.
        first_pass: how records are made: see `Options`.
        selected_frames: number of first-pass frames (`auto` and `workers` are already resolved to a number); 1 if the
            first pass selects none.
        depth: maximum number of non-diffuse interactions (mirrors, glass, gloss) between the eye and a cached surface.
        cache_parts: number of spatial parts in which the shared cache is merged, filled and read (`auto` is already
            resolved to a number).
    """

    frames: tuple[PositiveInt, ...] = Field(min_length=1)
    width: int = Field(ge=1, le=65536)
    height: int = Field(ge=1, le=65536)
    fps: PositiveFloat = Field(default=25.0, allow_inf_nan=False)
    first_pass: FirstPass = "frames"
    selected_frames: PositiveInt = 1
    depth: PositiveInt = 12
    cache_parts: int = Field(default=1, ge=1, le=999)


class ExecutionSettings(MachineSettings):
    """Where the work runs; no effect on any byte of the result.

    Attributes:
        site: settings of the batch system, and how long faulty workers and hosts are tolerated.
        attempts: number of times a task may fail before the run gives up.
    """

    site: SiteSettings = SiteSettings()
    attempts: PositiveInt = 3


def _explain(error: ValidationError) -> str:
    """Pydantic's errors, one line each, with the option names of the command line."""
    lines = []
    for finding in error.errors():
        option = option_name(str(finding["loc"][0])) if finding["loc"] else "settings"
        lines.append(f"{option}: {finding['input']!r} is not valid; {_reason(finding['msg'])}")
    return "\n".join(lines)


def _reason(message: str) -> str:
    reason = message.removeprefix("Value error, ")
    return reason[:1].lower() + reason[1:]


def option_name(setting: str) -> str:
    """The option, as typed, that sets a setting."""
    if setting == "parameters":
        return "-D"
    return "--size" if setting in {"width", "height"} else "--" + setting.replace("_", "-")
