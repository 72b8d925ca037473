"""The renderer interface: what the two passes ask of a renderer, on one screen.

A renderer makes caches of irradiance records and shades frames from them. Caches cross this interface as files: what is
in them is the renderer's own business, so that any engine can run any task and a run can be resumed. A renderer comes
in two parts. `Renderer` is what can be asked anywhere, without a scene; `SceneRenderer` is one scene made ready in a
worker process, and does the work of the tasks.
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
"""What a call counted: numbers by their names in `stats.json`. `seconds` is the time of the work without loading scene
and caches; if it is missing, the time of the whole call is used."""


@dataclass(frozen=True)
class Capabilities:
    """What a renderer can do; the plan follows.

    Attributes:
        scenes: formats of scene descriptions that it reads (`SceneDescription.format`).
        modes: of rendering; `single-pass` and `path` are the baselines.
        audit_rounds: rounds of the coverage audit; 0 if it has none. All of them are in the plan, so a round that finds
            nothing to do must be cheap.
        surfaces: whether its first pass may look along all frames and then make records box by box (`look` and
            `gather_box`), after which one round of the audit is enough.
        prepares: whether tasks that make records need the file that `prepare` makes, once for the run. After a first
            pass by surfaces, tasks that shade frames are given this file, too.
        parts: whether the shared cache may be in parts of space.
        smoothing: whether the cache is smoothed before the second pass reads it.
        denoising: whether `--denoise` has a meaning.
        inspection: whether its scenes are `SceneInspector`s.
        probing: whether it is a `ProbingRenderer`.
        cache_suffix: of its cache files; no other renderer's.
        misses_suffix: of the files that the audit writes, and `look`.
        prepared_suffix: of the file that `prepare` writes.
        seconds_per_sample: rough processor time per camera sample of a whole animation, all passes included.
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
    """How the shared cache is divided, and which window of frames reads what.

    Attributes:
        windows: of each window of frames, the parts that it reads, ascending.
        neighbours: of each part, the others that it is merged and smoothed with, ascending.
        details: the renderer's own plain data (JSON), for `run.json`.
    """

    windows: tuple[tuple[int, ...], ...]
    neighbours: tuple[tuple[int, ...], ...] = ((),)
    details: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def undivided(cls, windows: int) -> Survey:
        """One part, which every window reads."""
        return cls(((0,),) * windows)

    @property
    def parts(self) -> int:
        """Number of parts."""
        return len(self.neighbours)


@dataclass(frozen=True)
class Job:
    """All that decides the bytes of an animation, as plain data: it pickles.

    Attributes:
        scene: what is rendered.
        settings: how.
        variant: the backend, as `Renderer.check` named it.
        poses: camera of every frame, by frame number; each knows its time.
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
    """What the bytes of frames and caches depend on, on this machine: the backend and the versions of packages.

    Attributes:
        variant: for people and for `Job.variant`, such as `llvm_ad_rgb`.
        versions: of the packages and programs that count, by name.
        constants: what settings such as `--quality` stand for: plain data (JSON).
    """

    variant: str
    versions: Mapping[str, str]
    constants: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A finished frame.

    Attributes:
        image: (height, width, 3) float32 scene-linear RGB radiance, W/(m² sr); the first row is the top.
        missed: look-ups that no record answered.
        new_records: private records that were made for this frame alone.
        seconds: of the work, as in `Counts`; None for the time of the whole call.
        firefly_loss: part of its light that was removed from single paths far brighter than all around them.
    """

    image: NDArray[np.float32]
    missed: int = 0
    new_records: int = 0
    seconds: float | None = None
    firefly_loss: float = 0.0


@dataclass(frozen=True)
class Surfaces:
    """The first surface behind the centre of each pixel; all 0 where there is none, with infinite depth.

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
    """R records of a cache, for people.

    Attributes:
        position: (R, 3) world, metres.
        normal: (R, 3) unit.
        radius: (R,) how far each answers, metres.
        irradiance: (R, 3) W/m².
        noise: (R,) standard error over the irradiance; NaN where that is not known.
        source: (R,) which of the files each is from, counted from 0.
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    radius: NDArray[np.float32]
    irradiance: NDArray[np.float32]
    noise: NDArray[np.float32]
    source: NDArray[np.intp]


@dataclass(frozen=True)
class Question:
    """A surface point that asked the cache, and what answered.

    Attributes:
        position: world, metres.
        normal: unit.
        irradiance: what came of it, W/m².
        rows: of the records that answered, in the `RecordTable` of the same files; the largest share first.
        distance: metres, of each.
        weight: of each, from 0 to 1.
        share: of each in the answer; they sum to 1.
        value: (records, 3) irradiance that each expects here, W/m².
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
    """One of several boxes of space, whose records one task makes.

    Attributes:
        part: of the cache.
        number: of the box in that part, from 0.
        count: of boxes in that part.
    """

    part: int
    number: int
    count: int


class SceneRenderer(Protocol):
    """One scene in this process. Methods with an `output` write that file, which its caller validates and renames."""

    def gather(self, frame: int, output: Path) -> Counts:
        """First pass: records of a selected frame. Counts rays, hits, misses, left, records."""

    def merge(self, caches: Sequence[Path], part: int, output: Path) -> Counts:
        """Caches of frames or boxes become one part of the shared cache. Counts records_in, records_out."""

    def audit(self, frames: Sequence[int], caches: Sequence[Path], audit_round: int, output: Path) -> Counts:
        """Note what the cache cannot answer along some frames. Counts looked_up, missed."""

    def fill(
        self, cache: Path, misses: Mapping[int, Path], part: int, audit_round: int, output: Path
    ) -> Counts:
        """A part with records for what the audit noted, by window. Counts records (the new ones)."""

    def smooth(self, cache: Path, around: Sequence[Path], output: Path) -> Counts:
        """A part as the second pass reads it, averaged with its neighbours."""

    def concatenate(self, caches: Sequence[Path], output: Path) -> Counts:
        """All parts in one file, for people."""

    def shade(self, frame: int, caches: Sequence[Path] | None) -> Frame:
        """Second pass: a frame from the shared cache; None makes a private one (single-pass)."""

    def trace(self, frame: int) -> Frame:
        """Mode path: a frame by path tracing, the baseline without a cache."""


class SceneInspector(SceneRenderer, Protocol):
    """A scene that also says what lies behind its frames; with the capability `inspection`."""

    def surfaces(self, frame: int) -> Surfaces:
        """What each pixel of a frame sees."""

    def records(self, caches: Sequence[Path]) -> RecordTable:
        """The records of some files, one after the other."""

    def questions(self, frame: int, pixel: tuple[int, int], caches: Sequence[Path]) -> Sequence[Question]:
        """What asked the cache along the path through the middle of a pixel, (column, row), in that order."""


@dataclass(frozen=True)
class Hits:
    """What rays meet first.

    Attributes:
        distance: (N,) metres; inf where nothing is met.
        normal: (N, 3) unit normals of the surfaces as they are modelled; a ray may meet a surface from either side.
        shape: (N,) indices into `Geometry.shapes`; -1 where nothing is met.
    """

    distance: NDArray[np.float64]
    normal: NDArray[np.float64]
    shape: NDArray[np.int64]


@dataclass(frozen=True)
class Lamp:
    """An emitter, as a plan shows it.

    Attributes:
        kind: in the words of the scene's format, such as `area` or `point`.
        name: of the emitter or its shape.
        position: (x, y, z), metres; None if it is infinitely far away.
    """

    kind: str
    name: str
    position: tuple[float, float, float] | None = None


class Geometry(Protocol):
    """Where the surfaces of a scene are: for walks, checks of paths, and plans."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of all surfaces, (2, 3)."""

    @property
    def shapes(self) -> Sequence[str]:
        """Names of the shapes."""

    @property
    def lamps(self) -> Sequence[Lamp]:
        """The emitters, as far as they are known."""

    def cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], longest: float = np.inf
    ) -> Hits:
        """Follow rays for at most `longest` metres; origins are (N, 3), directions are unit vectors, (N, 3)."""

    def colours(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reflectance, (N, 3), of what rays meet: the diffuse one if there is one; NaN where it is not known."""


class PreparedRenderer(Protocol):
    """What a scene renderer with the capability `prepares` does besides."""

    def prepare(self, output: Path) -> Counts:
        """Make what all tasks that make records need, and after a first pass by surfaces the frames."""

    def use(self, prepared: Path) -> None:
        """Take what `prepare` wrote from this file; called before a task that needs it."""


class SurfaceRenderer(Protocol):
    """What a scene renderer with the capability `surfaces` does besides."""

    def look(self, frames: Sequence[int], output: Path) -> Counts:
        """First pass: note what some frames look up. Counts rays."""

    def gather_box(self, seen: Mapping[int, Path], box: Box, output: Path) -> Counts:
        """First pass: records of a box for what `look` noted, by window. Counts hits, misses, records."""

    def smooth_and_stretch(
        self, cache: Path, around: Sequence[Path], misses: Mapping[int, Path], part: int, output: Path
    ) -> Counts:
        """As `smooth`, and let records farther away answer look-ups that the audit missed and no record answers.

        `misses` are the audit's files by window. Counts stretched: the look-ups that are answered in this way.
        """


class CacheFiles(Protocol):
    """What `steadylight cache` does with a renderer's cache files."""

    def describe(self, path: Path) -> Mapping[str, str]:
        """What a file holds, as lines for people."""

    def merge(self, paths: Sequence[Path], output: Path) -> Counts:
        """Merge caches of one scene. Counts records_in, records_out."""

    def differences(self, path: Path, other: Path) -> tuple[bool, Mapping[str, str]]:
        """Whether two files hold the same records of the same scene, and how they differ, as lines."""


class Renderer(Protocol):
    """A renderer by name: see `steadylight.renderers.find_renderer`."""

    @property
    def name(self) -> str:
        """As in `--renderer`."""

    @property
    def capabilities(self) -> Capabilities:
        """What it can do."""

    @property
    def cache_files(self) -> CacheFiles | None:
        """For `steadylight cache`; None if its caches are not for people."""

    def check(
        self, scene: SceneDescription, settings: RenderSettings, variant: str, *, build: bool
    ) -> Backend:
        """See whether this can be rendered here, before anything is written.

        Args:
            scene: what is rendered.
            settings: how.
            variant: `--variant`: auto, llvm or cuda.
            build: whether to build the scene too; not when a run is resumed, which had it checked.

        Raises:
            SceneError: something in the scene cannot be rendered; names it.
            SettingsError: a setting has no meaning here.
            BackendError: what it needs is missing on this machine; says what to install.
        """

    def survey(self, job: Job) -> Survey:
        """Look along the frames for what they see, and divide the cache into `settings.cache_parts`."""

    def geometry(self, scene: SceneDescription, variant: str) -> Geometry | None:
        """Where the surfaces of a scene are; None if this renderer cannot say. Arguments and errors as for `check`."""

    def validate(self, path: Path, scene_hash: str) -> None:
        """Read a cache or misses file back; raises CacheFileError if it is not whole or of another scene."""

    def open(self, job: Job, threads: int | None) -> SceneRenderer:
        """Make the scene ready in this process, now or when it is first needed, on so many threads (all if None)."""


class ProbingRenderer(Renderer, Protocol):
    """A renderer that foretells how long a run takes; with the capability `probing`."""

    def probe(self, job: Job) -> float | None:
        """Processor time of all rays of a run, seconds, from a few seconds' work; None where it cannot say."""
