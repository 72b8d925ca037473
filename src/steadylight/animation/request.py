"""Request: the user's input, checked and completed before anything is written."""

from __future__ import annotations

import dataclasses
import itertools
import re
import time
from collections.abc import Iterator
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Final, Literal, cast

from steadylight.animation.camera import camera_of
from steadylight.animation.cost import Cost, estimate_cost
from steadylight.animation.options import Scene, with_options
from steadylight.animation.parsing import parse_frames, parse_parts, parse_size
from steadylight.animation.plan import (
    make_job,
    make_tasks,
    part_count,
    selected_count,
    windows_of,
)
from steadylight.animation.provenance import read_run
from steadylight.camera import select_frames
from steadylight.engines import Task, check_engine
from steadylight.errors import SceneError, SettingsError
from steadylight.redaction import redacted
from steadylight.renderers import find_renderer, renderers_for
from steadylight.renderers.base import Job, ProbingRenderer, Renderer, Survey
from steadylight.scenes import read_scene
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import SceneDescription
from steadylight.settings import (
    Coverage,
    DisplaySettings,
    ExecutionSettings,
    FirstPass,
    MachineSettings,
    MethodSettings,
    Options,
    RenderSettings,
    SceneOptions,
    option_name,
)
from steadylight.sites import SiteSettings, load_site
from steadylight.storage import RunDirectory
from steadylight.storage.store import copy_of, is_url

_DEFAULT_DISPLAY: Final = DisplaySettings()


@dataclasses.dataclass(frozen=True, repr=False)
class Request:
    """A run that can start: all inputs are read and consistent.

    Attributes:
        scene: the scene, with the camera path of the frames.
        title: name of the scene in output and in the name of the run directory; see `scene_title`.
        source: name or file that the scene came from, as the user gave it.
        renderer: the renderer.
        settings: settings that determine the bytes.
        execution: where the work runs.
        selected: numbers of the first-pass frames; empty without a shared cache.
        directory: the run directory; may not exist yet.
        url: URL of the run directory, if it is remote; `directory` is then this machine's copy.
        display: how video and pictures are made from the frames.
        started: `time.perf_counter()` when the request was made, where the makespan starts.
    """

    scene: SceneDescription
    title: str
    source: str
    renderer: Renderer
    settings: RenderSettings
    execution: ExecutionSettings
    selected: tuple[int, ...]
    directory: Path
    started: float
    url: str | None = None
    display: DisplaySettings = _DEFAULT_DISPLAY

    def __repr__(self) -> str:
        return f"<Request {', '.join(f'{name} {value}' for name, value in self._facts().items())}>"

    def _repr_html_(self) -> str:
        """The main settings as a table, for notebooks."""
        rows = (
            f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>"
            for name, value in self._facts().items()
        )
        return f"<table>{''.join(rows)}</table>"

    def _facts(self) -> dict[str, str]:
        settings = self.settings
        return {
            "scene": self.title,
            "frames": str(len(settings.frames)),
            "size": f"{settings.width}x{settings.height}",
            "samples": str(settings.spp),
            "mode": settings.mode,
            "directory": self.place,
        }

    @property
    def place(self) -> str:
        """Where the run is, for people: its URL without a password, or its directory."""
        return str(self.directory) if self.url is None else redacted(self.url)

    def job(self, variant: str) -> Job:
        """Everything that determines the bytes except the survey, for a backend of the renderer."""
        return make_job(self.scene, self.settings, variant, self.selected)

    @cached_property
    def survey(self) -> Survey:
        """The parts of the cache: from the run if it was started, otherwise from a survey, which builds the scene.

        Raises:
            BackendError: this machine lacks something that the renderer needs.
            SceneError: something in the scene cannot be rendered.
        """
        if self.settings.cache_parts == 1:
            return Survey.undivided(len(windows_of(self.settings.frames)))
        known = self._survey_of_run()
        if known is not None:
            return known
        backend = self.renderer.check(self.scene, self.settings, self.execution.variant, build=False)
        return self.renderer.survey(self.job(backend.variant))

    def _survey_of_run(self) -> Survey | None:
        """The survey in `run.json`, if it belongs to the same animation."""
        try:
            run = read_run(RunDirectory(self.directory))
        except SettingsError:
            return None
        same = run.settings == self.settings and run.scene_hash == self.scene.hash
        return run.survey if same and run.camera == self.scene.camera else None

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks of the run, done or not. With a cache in parts, this needs the survey."""
        return make_tasks(
            self.settings,
            self.selected,
            self.renderer.capabilities,
            self.survey,
            aovs=self.execution.aovs,
        )

    @cached_property
    def cost(self) -> Cost:
        """Rough cost of the run."""
        return estimate_cost(self.settings, self.selected, self.renderer.capabilities)

    @cached_property
    def probed_cost(self) -> Cost:
        """Like `cost`, with the time estimated by a probe of the scene on this machine, if the renderer has one.

        Raises:
            BackendError: this machine lacks something that the renderer needs.
            SceneError: something in the scene cannot be rendered.
        """
        can = self.renderer.capabilities
        if not can.probing:
            return self.cost
        backend = self.renderer.check(self.scene, self.settings, self.execution.variant, build=False)
        probed = cast("ProbingRenderer", self.renderer).probe(self.job(backend.variant))
        return estimate_cost(self.settings, self.selected, can, probed)


@with_options(Options)
def prepare(scene: Scene, options: Options) -> Request:
    """Read scene and camera, fill in defaults and check everything, without rendering or writing anything.

    Args:
        scene: a bundled name, a file, or a description.
        options: options as keyword arguments, with the defaults of the command line; see `steadylight render --help`
            and `steadylight.settings.Options`.

    Raises:
        SceneError: there is no such scene, or it cannot be read (by this renderer).
        CameraError: the camera file is wrong, or frames are beyond the end of its path.
        SettingsError: another input is wrong.
    """
    return request_of(scene, options)


def request_of(scene: Scene, options: Options) -> Request:
    """Implementation of `prepare`."""
    started = time.perf_counter()
    execution = ExecutionSettings.checked(**options.values_of(MachineSettings), site=_site(options))
    check_engine(execution)
    renderer = find_renderer(options.renderer)
    description = _description(scene, options.scene, renderer)
    _check_renderer(renderer, description, options)
    path, fps, native_frames = camera_of(description, options)
    numbers = parse_frames(native_frames if options.frames is None else options.frames)
    size = (description.width, description.height) if options.size is None else parse_size(options.size)
    coverage = options.coverage if renderer.capabilities.audit_rounds else "off"
    shared = options.mode == "two-pass" and coverage == "full" and renderer.capabilities.parts
    first_pass = _first_pass(options, coverage, renderer)
    poses = path.frame_poses(numbers, fps)
    parts = part_count(len(numbers), parse_parts(options.cache_parts), shared=shared)
    description = dataclasses.replace(description, camera=path)
    title, source = scene_title(scene), _source(scene, options.scene)
    for directory in _directories(title, options):
        selected: tuple[int, ...] = ()
        if options.mode == "two-pass" and first_pass == "frames":
            count = selected_count(len(numbers), _selection(options, directory), execution.workers)
            selected = tuple(numbers[i] for i in select_frames(poses, count))
        settings = RenderSettings.checked(
            **options.values_of(MethodSettings) | {"coverage": coverage},
            frames=numbers,
            width=size[0],
            height=size[1],
            fps=fps,
            first_pass=first_pass,
            selected_frames=max(len(selected), 1),
            cache_parts=parts,
        )
        if options.output is not None or _is_for(directory, description, source, settings):
            break
    return Request(
        scene=description,
        title=title,
        source=source,
        renderer=renderer,
        settings=settings,
        execution=execution,
        selected=selected,
        directory=directory,
        started=started,
        url=str(options.output) if is_url(options.output) else None,
        display=DisplaySettings.checked(**options.values_of(DisplaySettings)),
    )


def _site(options: Options) -> SiteSettings:
    if isinstance(options.site, SiteSettings):
        return options.site
    return SiteSettings() if options.site is None else load_site(Path(options.site))


def _description(scene: Scene, options: SceneOptions, renderer: Renderer) -> SceneDescription:
    """The scene as plain data."""
    if not isinstance(scene, SceneDescription):
        return read_scene(scene, options, renderer.capabilities.scenes)
    for name in options.given:
        raise SettingsError(
            f"{option_name(name)}: only for scene files, not for a scene description; leave it out"
        )
    return scene


def _check_renderer(renderer: Renderer, scene: SceneDescription, options: Options) -> None:
    """Reject what the renderer does not support.

    Raises:
        SceneError: the renderer does not read such scenes; the message names those that do.
        SettingsError: it does not support the mode, denoising or AOVs.
    """
    can = renderer.capabilities
    if scene.format not in can.scenes:
        others = " or ".join(f"--renderer {name}" for name in renderers_for(scene.format))
        raise SceneError(
            f"scene {scene.name}: renderer {renderer.name} does not read format `{scene.format}`; "
            + (f"use {others}" if others else "no installed renderer reads it")
        )
    if options.mode not in can.modes:
        raise SettingsError(
            f"--mode: {options.mode} is not available with --renderer {renderer.name}; give {' or '.join(can.modes)}"
        )
    if options.denoise and not can.denoising:
        raise SettingsError(
            f"--denoise: not available with --renderer {renderer.name}, which has no denoiser; leave it out"
        )
    if options.aovs and not can.inspection:
        raise SettingsError(
            f"--aovs: not available with --renderer {renderer.name}, whose frames have no depth and normals; "
            "leave it out"
        )


def scene_title(scene: Scene) -> str:
    """A scene's name; for a file, with its folder, since many files are called `scene.xml`."""
    if isinstance(scene, SceneDescription):
        return scene.name
    if str(scene) in BUNDLED:
        return str(scene)
    path = Path(scene)
    folder = path.absolute().parent.name
    return path.stem if folder in {"", path.stem} else f"{folder}/{path.stem}"


def _directories(title: str, options: Options) -> Iterator[Path]:
    """The run directory, or this machine's copy of a remote one; without `--output`, endless numbered candidates."""
    if options.output is not None:
        yield copy_of(str(options.output)) if is_url(options.output) else _named(Path(options.output))
        return
    first = _named(default_directory(title, options.mode))
    yield first
    for number in itertools.count(2):
        yield first.with_name(f"{first.name}-{number}")


def _named(directory: Path) -> Path:
    """The directory, after checking its name.

    Raises:
        SettingsError: its name is too long, or not UTF-8, which the libraries that write frames and video need.
    """
    try:
        str(directory.absolute()).encode()
        directory.exists()
    except (UnicodeEncodeError, ValueError):
        raise SettingsError(
            f"--output: {str(directory.absolute())!r} is not valid UTF-8; choose another name"
        ) from None
    except OSError as error:
        raise SettingsError(
            f"--output: {directory}: {(error.strerror or str(error)).lower()}; choose another output"
        ) from None
    return directory


def _is_for(directory: Path, scene: SceneDescription, source: str, settings: RenderSettings) -> bool:
    """Whether a default directory is free, or was started with this input.

    The content of the scene is not compared: a changed scene file keeps its directory, and the session reports the
    change.
    """
    if not RunDirectory(directory).run_file.exists():
        return True
    try:
        run = read_run(RunDirectory(directory))
    except SettingsError:
        return True  # the session reports what is wrong with it
    same_source = Path(run.source).absolute() == Path(source).absolute()
    return same_source and run.settings == settings and run.camera == scene.camera


def _first_pass(options: Options, coverage: Coverage, renderer: Renderer) -> FirstPass:
    """How records are made: by surfaces, unless something asks for selected frames.

    Raises:
        SettingsError: `--first-pass surface` is given together with options that exclude it.
    """
    defaults = Options()
    published = [
        option_name(name)
        for name in ("selected_frames", "threshold", "base_rays")
        if getattr(options, name) != getattr(defaults, name)
    ]
    possible = options.mode == "two-pass" and coverage == "full" and renderer.capabilities.surfaces
    if options.first_pass == "surface" and not possible:
        raise SettingsError(
            "--first-pass: surface needs --mode two-pass, --coverage full and a renderer that supports it; give frames"
        )
    if options.first_pass == "surface" and published:
        raise SettingsError(
            f"--first-pass: surface cannot be combined with {', '.join(published)}; give frames"
        )
    if options.first_pass is not None:
        return options.first_pass
    return "surface" if possible and not published else "frames"


def _selection(options: Options, directory: Path) -> int | Literal["auto", "workers"]:
    """`--selected-frames` as a number or a rule; for `workers`, a resumed run keeps the number in its `run.json`."""
    choice = options.selected_frames
    if choice == "workers":
        try:
            return read_run(RunDirectory(directory)).settings.selected_frames
        except SettingsError:
            return "workers"
    if choice == "auto":
        return "auto"
    if isinstance(choice, str):
        if not choice.strip().isdecimal():
            raise SettingsError(
                f"--selected-frames: {choice!r} is not valid; give auto, workers or a positive whole number"
            )
        return int(choice)
    return choice


def default_directory(title: str, mode: str) -> Path:
    """`runs/SCENE-MODE` in the working directory, with a file name that is valid on any system."""
    return Path("runs") / re.sub(r"[^A-Za-z0-9._-]+", "-", f"{title}-{mode}").strip(".-")


def _source(scene: Scene, options: SceneOptions) -> str:
    """The scene as the user gave it, for `run.json`."""
    if isinstance(scene, SceneDescription):
        return f"{scene.name} (described in Python)"
    given = (f"{name} {value}" for name, value in options.given.items())
    return ", ".join((str(scene), *given))
