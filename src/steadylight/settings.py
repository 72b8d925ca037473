"""Settings of a render: what the user may choose, with defaults, units and checks.

Every option is declared here once, as a field with an `Option`: the command line, the functions `steadylight.plan` and
`steadylight.render`, and the checks follow. `Options` is what the user writes. `RenderSettings`, made from it, decides
the bytes of the frames and is recorded in `run.json`; `ExecutionSettings` says where the work runs and decides nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
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
    CameraSource = Any  # a camera brings NumPy and SciPy, for which `--help` should not wait

Mode = Literal["two-pass", "single-pass", "path"]
Coverage = Literal["full", "off"]
Radii = Literal["split-sphere", "occlusion-hessian"]
Variant = Literal["auto", "llvm", "cuda"]

Frames = int | str | Sequence[int]
"""`N`, or text such as `"30-53"`, `"1-91:45"`, `"1,5,9"`, or frame numbers."""

ANIMATION, IMAGE, METHOD, MACHINE, SIMULATION = "Animation", "Image", "Method", "Machine", "Simulation"
PANELS: Final = (ANIMATION, IMAGE, METHOD, MACHINE, SIMULATION)
"""How `--help` groups the options."""


@dataclass(frozen=True)
class Option:
    """How an option is shown on the command line, where a field `some_name` is `--some-name`.

    Attributes:
        help: a sentence.
        panel: one of PANELS.
        metavar: what stands for its value; that of the type if None.
        shown: instead of the default, where that is None or would not tell.
        worded: whether a word may stand for the number that it is.
    """

    help: str
    panel: str
    metavar: str | None = None
    shown: str | None = None
    worded: bool = False


class CheckedSettings(BaseModel):
    """Settings whose faults are told in the words of the command line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def checked(cls, **values: Any) -> Self:
        """Make settings; a wrong one raises SettingsError that names the option, the value and what is right."""
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingsError(_explain(error)) from None


class MethodSettings(CheckedSettings):
    """Options that decide bytes and are recorded as the user gives them.

    Attributes:
        renderer: by its name; see `steadylight.renderers`.
        spp: samples per pixel.
        quality: 1 is normal, more is slower and closer to the truth; see `steadylight.quality`.
        bounces: indirect diffuse bounces (paper: 2 to 3).
        denoise: direct light and gloss go through Open Image Denoise; never the cached light.
        seed: of everything random.
        mode: two-pass (the method), single-pass (a private cache per frame) or path (no cache).
        threshold: stop a first-pass frame at this many cache hits per miss (paper: 10).
        base_rays: rays before the threshold is looked at (paper: 128).
        radii: what the radius of records goes by.
        coverage: full (audit all frames after the merge and fill holes) or off (as in the paper).
    """

    renderer: Annotated[
        str, Option("What makes light: mitsuba, radiance, or another that is installed.", METHOD, "NAME")
    ] = "mitsuba"
    spp: Annotated[PositiveInt, Option("Samples per pixel.", IMAGE, "N")] = 16
    quality: Annotated[
        Quality,
        Option(
            "draft, normal, high, or a number: 1 is normal, more is slower and better.",
            IMAGE,
            "WORD|X",
            "normal",
            worded=True,
        ),
    ] = WORDS["normal"]
    bounces: Annotated[NonNegativeInt, Option("Indirect diffuse bounces.", IMAGE, "N")] = 2
    denoise: Annotated[
        bool,
        Option(
            "Open Image Denoise on direct light and gloss, never on the cached light; needs the extra `denoise`.",
            IMAGE,
        ),
    ] = False
    seed: Annotated[int, Field(ge=0, lt=2**32), Option("Of everything random.", IMAGE, "N")] = 0
    mode: Annotated[
        Mode,
        Option(
            "two-pass shares one cache; single-pass has one for each frame (the baseline); path has none.",
            METHOD,
        ),
    ] = "two-pass"
    threshold: Annotated[
        PositiveFloat,
        Field(allow_inf_nan=False),
        Option("A first-pass frame stops at this many cache hits per miss.", METHOD, "X"),
    ] = 10.0
    base_rays: Annotated[PositiveInt, Option("Rays before the threshold is looked at.", METHOD, "N")] = 128
    radii: Annotated[
        Radii,
        Option(
            "What a record's radius goes by: distances (Ward 1988) or the curvature of irradiance (2012).",
            METHOD,
        ),
    ] = "occlusion-hessian"
    coverage: Annotated[
        Coverage, Option("Look along all frames for what the cache misses, and fill it.", METHOD)
    ] = "full"


class MachineSettings(CheckedSettings):
    """Options that say where the work runs and change no byte.

    Attributes:
        workers: worker processes; on one machine each uses its share of the cores, a batch job all of its own.
        cluster: `in-process`, `local`, a batch system, or the address of a Dask scheduler.
        variant: backend of the renderer; auto takes cuda where a device is found, llvm otherwise.
    """

    workers: Annotated[
        PositiveInt, Option("Worker processes; of a batch system, jobs at most.", MACHINE, "N")
    ] = 1
    cluster: Annotated[
        str,
        Option(
            "Where they run: local, in-process, a batch system (slurm, sge, pbs, lsf, htcondor, oar), or the address "
            "of a Dask scheduler (tcp://..., tls://...).",
            MACHINE,
            "NAME",
        ),
    ] = "local"
    variant: Annotated[Variant, Option("Mitsuba's backend.", MACHINE)] = "auto"


class Options(MethodSettings, MachineSettings):
    """All options, as the user writes them.

    Attributes:
        camera: a file of keyframes or a path; the scene's own if None.
        sky: a .rad file with sky and sun, which is added to a .rad scene.
        frames: N for the first N frames of the path, or their numbers: `A-B`, `A-B:STEP`, comma lists of these and of
            single numbers, or a sequence. Frame i is at time (i-1)/fps, whichever others there are. If None, the
            scene's own number, or all of the path of `camera`.
        size: image size, pixels, as `WxH` or a pair; the scene's own if None.
        fps: frames per second; that of the camera file or the scene if None.
        output: the run directory, or a URL that fsspec knows; `runs/SCENE-MODE` if None.
        selected_frames: how many frames the first pass visits: auto (square root of the number of frames), workers (as
            many as there are, as published) or a number.
        cache_parts: in how many parts of space the cache is merged, filled and read: auto (by the number of frames) or
            a number.
        site: what the batch system wants to know: a TOML file (see `sites.SiteSettings`), or the settings.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    camera: Annotated[
        SkipValidation[CameraSource | None],
        Option("File of keyframes, TOML or JSON.", ANIMATION, "FILE", "the scene's own"),
    ] = None
    sky: Annotated[
        SkipValidation[str | Path | None],
        Option("Radiance file with sky and sun, added to a scene in a .rad file.", ANIMATION, "FILE", "none"),
    ] = None
    frames: Annotated[
        SkipValidation[Frames | None],
        Option(
            "The first N frames of the path; or numbers: 30-53, 1-91:45 (every 45th), 1,5,9.",
            ANIMATION,
            "N",
            "the whole path",
        ),
    ] = None
    size: Annotated[
        SkipValidation[str | tuple[int, int] | None],
        Option("Pixels of a frame.", ANIMATION, "WxH", "the scene's own"),
    ] = None
    fps: Annotated[
        PositiveFloat | None,
        Field(allow_inf_nan=False),
        Option("Frames per second.", ANIMATION, "F", "the camera's or the scene's"),
    ] = None
    output: Annotated[
        SkipValidation[str | Path | None], Option("The run directory.", ANIMATION, "DIR", "runs/SCENE-MODE")
    ] = None
    selected_frames: Annotated[
        SkipValidation[int | str],
        Option(
            "Frames of the first pass: a number, workers (as many as there are, as published) or auto.",
            METHOD,
            "auto|workers|N",
        ),
    ] = "auto"
    cache_parts: Annotated[
        SkipValidation[int | str],
        Option(
            "Parts of space in which the cache is merged, filled and read, so that frames start before all of it is "
            "done; auto goes by the number of frames.",
            METHOD,
            "auto|N",
        ),
    ] = "auto"
    site: Annotated[
        SkipValidation[str | Path | SiteSettings | None],
        Option(
            "What the batch system wants to know: queue, account, cores, memory, walltime, ... as TOML.",
            MACHINE,
            "FILE",
            "Dask's own configuration",
        ),
    ] = None

    def values_of(self, settings: type[BaseModel]) -> dict[str, Any]:
        """Those options that some settings take as they are."""
        return {name: getattr(self, name) for name in settings.model_fields}


class SimulationOptions(CheckedSettings):
    """Options of `steadylight plan` alone: the machines that a run is played through on.

    Attributes:
        simulate: whether to.
        times: a run directory whose task times and file sizes are taken; that of the plan if None.
        nodes: how many.
        queue_wait: mean seconds until a node comes.
        start: seconds until a node has its first task.
        between_failures: mean hours of a node between failures.
        bandwidth: megabytes a second of the shared store.
    """

    simulate: Annotated[
        bool, Option("Play the run through on many nodes, with measured times.", SIMULATION)
    ] = False
    times: Annotated[
        SkipValidation[str | Path | None],
        Option("A run whose task times and file sizes are taken.", SIMULATION, "RUN", "--output"),
    ] = None
    nodes: Annotated[PositiveInt, Option("How many.", SIMULATION, "N")] = 200
    queue_wait: Annotated[NonNegativeFloat, Option("Mean seconds until a node comes.", SIMULATION, "S")] = (
        60.0
    )
    start: Annotated[
        NonNegativeFloat, Option("Seconds until a node has its first task.", SIMULATION, "S")
    ] = 20.0
    between_failures: Annotated[
        PositiveFloat, Option("Mean hours of a node between failures.", SIMULATION, "H")
    ] = 1000.0
    bandwidth: Annotated[
        PositiveFloat, Option("Megabytes a second of the shared store.", SIMULATION, "MB")
    ] = 1000.0


class RenderSettings(MethodSettings):
    """Everything besides scene and camera path that decides the bytes of the frames.

    Attributes:
        frames: frame numbers to render, counted from 1; frame i is at time (i-1)/fps on the camera path.
        width: image width, pixels.
        height: image height, pixels.
        fps: frames per second of video and camera path.
        selected_frames: how many frames the first pass visits (already a number: `auto` and `workers` are
            resolved before).
        depth: most non-diffuse interactions (mirrors, glass, gloss) between the eye and a cached surface.
        cache_parts: parts of space in which the shared cache is merged, filled and read (already a number: `auto` is
            resolved before).
    """

    frames: tuple[PositiveInt, ...] = Field(min_length=1)
    width: int = Field(ge=1, le=65536)
    height: int = Field(ge=1, le=65536)
    fps: PositiveFloat = Field(default=25.0, allow_inf_nan=False)
    selected_frames: PositiveInt = 1
    depth: PositiveInt = 12
    cache_parts: int = Field(default=1, ge=1, le=999)


class ExecutionSettings(MachineSettings):
    """Where the work runs; no effect on any byte of the result.

    Attributes:
        site: what the batch system wants to know, and how long to bear with faults.
        attempts: how often a task may fail before the run gives up.
    """

    site: SiteSettings = SiteSettings()
    attempts: PositiveInt = 3


def _explain(error: ValidationError) -> str:
    """Pydantic's findings as one line each, in the words of the command line."""
    lines = []
    for finding in error.errors():
        option = option_name(str(finding["loc"][0])) if finding["loc"] else "settings"
        lines.append(f"{option}: {finding['input']!r} is not valid: {finding['msg'].lower()}")
    return "\n".join(lines)


def option_name(setting: str) -> str:
    """The option, as it is typed, that decides a setting."""
    return "--size" if setting in {"width", "height"} else "--" + setting.replace("_", "-")
