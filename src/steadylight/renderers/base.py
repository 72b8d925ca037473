"""The renderer interface: all that the two passes require of a renderer.

A renderer makes caches of irradiance records and shades frames from them. Caches cross this interface as files whose
contents are private to the renderer, so any engine can run any task, and a run can be resumed. A renderer has two
parts: `Renderer` provides what needs no loaded scene; `SceneRenderer` is one scene, loaded in a worker process, and
carries out the tasks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.scenes.description import SceneDescription
from steadylight.settings import Mode, RenderSettings

Counts = Mapping[str, float]
"""Statistics of a call, by their names in `stats.json`. `seconds` is the time of the work without loading scene and
caches; if it is missing, the time of the whole call is used."""


@dataclass(frozen=True)
class Capabilities:
    """What a renderer can do; the plan depends on it.

    Attributes:
        scenes: scene formats that it reads (`SceneDescription.format`).
        modes: rendering modes that it supports; `single-pass` and `path` are the baselines.
        audit_rounds: rounds of the coverage audit; 0 if it has none. The plan contains all of them, so a round with
            nothing to do must be cheap.
        surfaces: whether its first pass can look along all frames and then make records box by box (`look` and
            `gather_box`), after which one audit round is enough.
        prepares: whether tasks that make records need the file that `prepare` writes once per run. After a first pass
            by surfaces, tasks that shade frames receive this file too.
        parts: whether the shared cache can be divided into parts of space.
        smoothing: whether the cache is smoothed before the second pass reads it.
        denoising: whether it supports `--denoise`.
        inspection: whether its scenes are `SceneInspector`s.
        probing: whether it is a `ProbingRenderer`.
        cache_suffix: suffix of its cache files; unique to this renderer.
        misses_suffix: suffix of the files that `audit` and `look` write.
        prepared_suffix: suffix of the file that `prepare` writes.
        seconds_per_sample: approximate processor time per camera sample of an animation, all passes included.
    """

    scenes: tuple[str, ...]
    modes: tuple[Mode, ...]
    audit_rounds: int = 0
    surfaces: bool = False
    prepares: bool = False
    parts: bool = False
    smoothing: bool = False
    denoising: bool = False
    inspection: bool = False
    probing: bool = False
    cache_suffix: str = ".cache"
    misses_suffix: str = ".misses"
    prepared_suffix: str = ".prepared"
    seconds_per_sample: float = 2.5e-6


@dataclass(frozen=True)
class Survey:
    """How the shared cache is divided, and which parts each window of frames reads.

    Attributes:
        windows: for each window of frames, the parts that it reads, ascending.
        neighbours: for each part, the other parts that it is merged and smoothed with, ascending.
        details: the renderer's own plain data (JSON), for `run.json`.
    """

    windows: tuple[tuple[int, ...], ...]
    neighbours: tuple[tuple[int, ...], ...] = ((),)
    details: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def undivided(cls, windows: int) -> Survey:
        """One part, read by every window."""
        return cls(((0,),) * windows)

    @property
    def parts(self) -> int:
        """Number of parts."""
        return len(self.neighbours)


@dataclass(frozen=True)
class Job:
    """Everything that determines the bytes of an animation, as plain, picklable data.

    Attributes:
        scene: the scene.
        settings: the render settings.
        variant: the backend, as named by `Renderer.check`.
        poses: camera pose of every frame, by frame number; each includes its time.
        windows: frame numbers of each window.
        selected: numbers of the frames that the first pass visits.
        survey: how the shared cache is divided.
    """

    scene: SceneDescription
    settings: RenderSettings
    variant: str
    poses: Mapping[int, Pose]
    windows: tuple[tuple[int, ...], ...]
    selected: tuple[int, ...]
    survey: Survey


@dataclass(frozen=True)
class Backend:
    """What the bytes of frames and caches depend on, on this machine: the backend and package versions.

    Attributes:
        variant: the backend, for display and for `Job.variant`, such as `llvm_ad_rgb`.
        versions: versions of the packages and programs that matter, by name.
        constants: the values that settings such as `--quality` stand for: plain data (JSON).
    """

    variant: str
    versions: Mapping[str, str]
    constants: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A finished frame.

    Attributes:
        image: (height, width, 3) float32 scene-linear RGB radiance, W/(m² sr); the first row is the top.
        missed: look-ups that found no record.
        new_records: private records that were made for this frame alone.
        seconds: time of the work, as in `Counts`; None for the time of the whole call.
        firefly_loss: fraction of the frame's light that was clamped from paths far brighter than their surroundings.
    """

    image: NDArray[np.float32]
    missed: int = 0
    new_records: int = 0
    seconds: float | None = None
    firefly_loss: float = 0.0


@dataclass(frozen=True)
class Surfaces:
    """The first surface at the centre of each pixel; where there is none, position and normal are 0.

    Attributes:
        position: (height, width, 3) float32 world, metres.
        normal: (height, width, 3) float32 unit shading normal, world, towards the camera.
        depth: (height, width) float32 distance along the view direction, metres.
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class RecordTable:
    """R records of a cache, for display.

    Attributes:
        position: (R, 3) world, metres.
        normal: (R, 3) unit.
        radius: (R,) metres.
        irradiance: (R, 3) W/m².
        noise: (R,) standard error relative to the irradiance; NaN where it is unknown.
        source: (R,) index of the file that each record comes from.
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    radius: NDArray[np.float32]
    irradiance: NDArray[np.float32]
    noise: NDArray[np.float32]
    source: NDArray[np.intp]


@dataclass(frozen=True)
class Question:
    """A cache look-up at a surface point, and the records that it interpolated.

    Attributes:
        position: world, metres.
        normal: unit.
        irradiance: the interpolated value, W/m².
        rows: rows of the interpolated records in the `RecordTable` of the same files, by descending share.
        distance: distance to each, metres.
        weight: weight of each, from 0 to 1.
        share: share of each in the result; the shares sum to 1.
        value: (records, 3) irradiance that each record extrapolates to this point, W/m².
    """

    position: tuple[float, float, float]
    normal: tuple[float, float, float]
    irradiance: tuple[float, float, float]
    rows: tuple[int, ...]
    distance: tuple[float, ...]
    weight: tuple[float, ...]
    share: tuple[float, ...]
    value: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Box:
    """One of the boxes that a part of the cache is divided into; one task makes the records of a box.

    Attributes:
        part: number of the part.
        number: of the box in that part, from 0.
        count: number of boxes in that part.
    """

    part: int
    number: int
    count: int


class SceneRenderer(Protocol):
    """One scene in this process. Methods with an `output` write that file; the caller validates and renames it."""

    def gather(self, frame: int, output: Path) -> Counts:
        """First pass: make records for a selected frame. Counts rays, hits, misses, left, records."""

    def merge(self, caches: Sequence[Path], part: int, output: Path) -> Counts:
        """Merge caches of frames or boxes into one part of the shared cache. Counts records_in, records_out."""

    def audit(self, frames: Sequence[int], caches: Sequence[Path], audit_round: int, output: Path) -> Counts:
        """Note the points along some frames that the cache does not cover. Counts looked_up, missed."""

    def fill(
        self, cache: Path, misses: Mapping[int, Path], part: int, audit_round: int, output: Path
    ) -> Counts:
        """Add records to a part at the misses of an audit, given by window. Counts records (the new ones)."""

    def smooth(self, cache: Path, around: Sequence[Path], output: Path) -> Counts:
        """Smooth a part for the second pass, averaging its records with those of its neighbours."""

    def concatenate(self, caches: Sequence[Path], output: Path) -> Counts:
        """Write all parts to one file, for inspection."""

    def shade(self, frame: int, caches: Sequence[Path] | None) -> Frame:
        """Second pass: render a frame from the shared cache, or from a private one if None (single-pass)."""

    def trace(self, frame: int) -> Frame:
        """Mode `path`: path-trace a frame; the baseline without a cache."""


class SceneInspector(SceneRenderer, Protocol):
    """A scene whose frames can be inspected; with the capability `inspection`."""

    def surfaces(self, frame: int) -> Surfaces:
        """The surface that each pixel of a frame sees."""

    def records(self, caches: Sequence[Path]) -> RecordTable:
        """The records of some files, in that order."""

    def questions(self, frame: int, pixel: tuple[int, int], caches: Sequence[Path]) -> Sequence[Question]:
        """Cache look-ups along the path through the centre of a pixel (column, row), in path order."""


@dataclass(frozen=True)
class Hits:
    """First intersections of rays.

    Attributes:
        distance: (N,) metres; inf for rays that hit nothing.
        normal: (N, 3) unit normals as modelled; a ray may hit a surface from either side.
        shape: (N,) indices into `Geometry.shapes`; -1 for rays that hit nothing.
    """

    distance: NDArray[np.float64]
    normal: NDArray[np.float64]
    shape: NDArray[np.int64]


@dataclass(frozen=True)
class Lamp:
    """An emitter, as shown on a plan.

    Attributes:
        kind: type in the scene's own format, such as `area` or `point`.
        name: of the emitter or its shape.
        position: (x, y, z), metres; None if it is infinitely far away.
    """

    kind: str
    name: str
    position: tuple[float, float, float] | None = None


class Geometry(Protocol):
    """Ray queries against the surfaces of a scene: for walks, checks of camera paths, and plans."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the bounding box, (2, 3)."""

    @property
    def shapes(self) -> Sequence[str]:
        """Names of the shapes."""

    @property
    def lamps(self) -> Sequence[Lamp]:
        """The emitters, as far as they are known."""

    @property
    def ray_offset(self) -> float:
        """Distance by which rays start off a surface, as a fraction of its largest coordinate; 0 if negligible."""

    def cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], longest: float = np.inf
    ) -> Hits:
        """Trace rays for at most `longest` metres; origins are (N, 3), directions are unit vectors, (N, 3)."""

    def colours(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reflectance at the first hit of each ray, (N, 3): the diffuse one if there is one; NaN where unknown."""


class PreparedRenderer(Protocol):
    """Further methods of a scene renderer with the capability `prepares`."""

    def prepare(self, output: Path) -> Counts:
        """Prepare what all tasks that make records need; after a first pass by surfaces, also those that shade."""

    def use(self, prepared: Path) -> None:
        """Load the file that `prepare` wrote; called before a task that needs it."""


class SurfaceRenderer(Protocol):
    """Further methods of a scene renderer with the capability `surfaces`."""

    def look(self, frames: Sequence[int], output: Path) -> Counts:
        """First pass: note the look-up points of some frames. Counts rays."""

    def gather_box(self, seen: Mapping[int, Path], box: Box, output: Path) -> Counts:
        """First pass: make the records of a box for the points of `look`, by window. Counts hits, misses, records."""

    def smooth_and_stretch(
        self, cache: Path, around: Sequence[Path], misses: Mapping[int, Path], part: int, output: Path
    ) -> Counts:
        """As `smooth`, then stretch records to reach look-ups that the audit missed and that still find no record.

        `misses` are the audit's files by window. Counts stretched: the look-ups served in this way.
        """


class CacheFiles(Protocol):
    """What `steadylight cache` does with a renderer's cache files."""

    def describe(self, path: Path) -> Mapping[str, str]:
        """The contents of a file, as lines of text."""

    def merge(self, paths: Sequence[Path], output: Path) -> Counts:
        """Merge caches of one scene. Counts records_in, records_out."""

    def differences(self, path: Path, other: Path) -> tuple[bool, Mapping[str, str]]:
        """Whether two files hold the same records of the same scene, and how they differ, as lines of text."""


class Renderer(Protocol):
    """A renderer; see `steadylight.renderers.find_renderer`."""

    @property
    def name(self) -> str:
        """Its name, as given to `--renderer`."""

    @property
    def capabilities(self) -> Capabilities:
        """What it can do."""

    @property
    def cache_files(self) -> CacheFiles | None:
        """For `steadylight cache`; None if its cache files are private."""

    def check(
        self, scene: SceneDescription, settings: RenderSettings, variant: str, *, build: bool
    ) -> Backend:
        """Check that this scene can be rendered on this machine, before anything is written.

        Args:
            scene: the scene.
            settings: the render settings.
            variant: `--variant`: auto, llvm or cuda.
            build: whether to build the scene too; not needed on resuming a run, whose scene was checked before.

        Raises:
            SceneError: something in the scene cannot be rendered; names it.
            SettingsError: a setting is not supported.
            BackendError: something that it needs is missing on this machine; says what to install.
        """

    def survey(self, job: Job) -> Survey:
        """Find the surfaces that the frames see, and divide the cache into `settings.cache_parts`."""

    def geometry(self, scene: SceneDescription, variant: str) -> Geometry | None:
        """The surfaces of a scene; None if this renderer cannot provide them. Arguments and errors as for `check`."""

    def validate(self, path: Path, scene_hash: str) -> None:
        """Read a cache or misses file back; raises CacheFileError if it is damaged or made for another scene."""

    def open(self, job: Job, threads: int | None) -> SceneRenderer:
        """Load the scene in this process, now or on first use, with `threads` threads (all if None)."""


class ProbingRenderer(Renderer, Protocol):
    """A renderer that can predict how long a run takes; with the capability `probing`."""

    def probe(self, job: Job) -> float | None:
        """Predicted processor time of all rays of a run, seconds, from a few seconds' work; None if unknown."""

    def release(self) -> None:
        """Free the memory of what probes and checks have built and keep for each other."""
