"""What the user asks for, checked and made whole before anything is written: the way into a run."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from steadylight.animation.plan import (
    Cost,
    estimate_cost,
    make_tasks,
    part_count,
    selected_count,
    windows_of,
)
from steadylight.animation.provenance import read_run
from steadylight.animation.store import copy_of, is_url
from steadylight.cache.partition import Partition
from steadylight.camera import CameraPath, load_camera, select_frames
from steadylight.engines import check_engine
from steadylight.errors import SettingsError
from steadylight.scenes import load_scene
from steadylight.scenes.description import SceneDescription
from steadylight.settings import Coverage, ExecutionSettings, Mode, Radii, RenderSettings, Variant
from steadylight.sites import SiteSettings, load_site
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from steadylight.engines import Task

Frames = int | str | Sequence[int]
"""`N`, or text such as `"30-53"`, `"1-91:45"`, `"1,5,9"`, or frame numbers."""

Selection = int | Literal["auto", "workers"]

Parts = int | Literal["auto"]

_MOST_FRAMES: Final = 99_999  # five digits in the names of files
_ITEM = re.compile(r"(\d+)(?:-(\d+)(?::(\d+))?)?")


@dataclasses.dataclass(frozen=True)
class Request:
    """A run that could start: every input is read and agrees with the others.

    Attributes:
        scene: with the camera path that the frames follow.
        source: name or file that the scene came from, as the user gave it.
        settings: that decide the bytes.
        execution: where the work runs.
        selected: numbers of the frames that the first pass visits; empty without a shared cache.
        directory: the run directory; may not exist yet.
        url: of the run directory, if it is at one; `directory` is then this machine's copy.
        started: `time.perf_counter()` when the request was made: the makespan counts from here.
        survey: finds the parts of the cache, if there are several; the renderer's own if None.
    """

    scene: SceneDescription
    source: str
    settings: RenderSettings
    execution: ExecutionSettings
    selected: tuple[int, ...]
    directory: Path
    started: float
    url: str | None = None
    survey: Callable[[Request], Partition] | None = None

    @cached_property
    def partition(self) -> Partition:
        """The parts of the cache: of the run if it was started, else surveyed, which builds the scene.

        Raises:
            BackendError: no usable Mitsuba backend.
            SceneError: Mitsuba refused something in the scene.
        """
        if self.settings.cache_parts == 1:
            return Partition.whole(len(windows_of(self.settings.frames)))
        return self._partition_of_run() or (self.survey or survey_film)(self)

    def _partition_of_run(self) -> Partition | None:
        """What is in `run.json`, if that is of the same film."""
        try:
            run = read_run(RunDirectory(self.directory))
        except SettingsError:
            return None
        same = run.settings == self.settings and run.scene_hash == self.scene.hash
        return run.partition if same and run.camera == self.scene.camera else None

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks of the run, done or not; with a cache in parts, `partition` is needed for that."""
        return make_tasks(self.settings, self.selected, self.partition)

    @cached_property
    def cost(self) -> Cost:
        """Roughly what the run asks of the machine."""
        return estimate_cost(self.settings, self.selected)


def survey_film(request: Request) -> Partition:
    """Look along the film for what it sees; see `rendering.visibility`."""
    from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

    use_variant(resolve_variant(request.execution.variant))
    from steadylight.renderers.mitsuba.survey import survey

    settings = request.settings
    poses = request.scene.camera.frame_poses(settings.frames, settings.fps)
    along = dict(zip(settings.frames, poses, strict=True))
    windows = [[along[frame] for frame in window] for window in windows_of(settings.frames)]
    return survey(request.scene, windows, settings)


def prepare(
    scene: str | Path | SceneDescription,
    *,
    camera: str | Path | CameraPath | None = None,
    frames: Frames | None = None,
    size: str | tuple[int, int] | None = None,
    fps: float | None = None,
    spp: int = 16,
    quality: float | str = "normal",
    mode: Mode = "two-pass",
    selected_frames: Selection | str = "auto",
    threshold: float = 10.0,
    base_rays: int = 128,
    bounces: int = 2,
    radii: Radii = "occlusion-hessian",
    coverage: Coverage = "full",
    cache_parts: Parts | str = "auto",
    denoise: bool = False,
    seed: int = 0,
    output: str | Path | None = None,
    workers: int = 1,
    cluster: str = "local",
    site: str | Path | SiteSettings | None = None,
    variant: Variant = "auto",
) -> Request:
    """Read scene and camera, fill in what was left out, check everything; writes and renders nothing.

    Args:
        scene: a bundled name, a file, or a description.
        camera: a file of keyframes or a path; the scene's own if None.
        frames: N for the first N frames of the path, or their numbers: `A-B`, `A-B:STEP`, comma lists of
            these and of single numbers, or a sequence. Frame i is at time (i-1)/fps, whichever others there
            are. Default: the scene's own number, or all of the path of `camera`.
        size: image size, pixels, as `WxH` or a pair; the scene's own if None.
        fps: frames per second; that of the camera file or the scene if None.
        spp: samples per pixel.
        quality: draft, normal or high.
        mode: two-pass, single-pass or path.
        selected_frames: how many frames the first pass visits: auto (square root of the number of frames),
            workers (as many as there are, as published) or a number.
        threshold: a first-pass frame stops at this many cache hits per miss.
        base_rays: rays of a first-pass frame before the threshold counts.
        bounces: indirect diffuse bounces.
        radii: what the reach of records goes by: split-sphere or occlusion-hessian.
        coverage: full or off.
        cache_parts: in how many parts of space the cache is merged, filled and read: auto (by the number of frames) or
            a number.
        denoise: direct light and gloss, with Open Image Denoise (extra `denoise`); never the cached light.
        seed: of everything random.
        output: the run directory, or a URL that fsspec knows; `runs/SCENE-MODE` if None.
        workers: worker processes, or batch jobs at most.
        cluster: where they run.
        site: what the batch system wants to know: a TOML file (see `sites.SiteSettings`), or the settings.
        variant: auto, llvm or cuda.

    Raises:
        SceneError: no such scene, or it cannot be read.
        CameraError: the camera file is wrong, or frames are beyond the end of its path.
        SettingsError: another input is wrong.
    """
    started = time.perf_counter()
    settings = (
        site if isinstance(site, SiteSettings) else SiteSettings() if site is None else load_site(Path(site))
    )
    execution = ExecutionSettings.checked(workers=workers, cluster=cluster, site=settings, variant=variant)
    check_engine(execution)
    description = scene if isinstance(scene, SceneDescription) else load_scene(scene)
    path, native_fps, native_frames = _camera(description, camera, fps)
    numbers = parse_frames(native_frames if frames is None else frames)
    width, height = (description.width, description.height) if size is None else parse_size(size)
    url = str(output) if is_url(output) else None
    directory = Path(output) if output is not None else default_directory(description.name, mode)
    if url is not None:
        directory = copy_of(url)
    draft = RenderSettings.checked(
        frames=numbers,
        width=width,
        height=height,
        fps=native_fps,
        spp=spp,
        quality=quality,
        mode=mode,
        threshold=threshold,
        base_rays=base_rays,
        bounces=bounces,
        radii=radii,
        coverage=coverage,
        cache_parts=part_count(len(numbers), _parts(cache_parts), mode, coverage),
        denoise=_denoise(denoise, mode),
        seed=seed,
    )
    poses = path.frame_poses(numbers, native_fps)
    count = selected_count(len(numbers), _selection(selected_frames, directory), workers)
    selected = tuple(numbers[i] for i in select_frames(poses, count)) if mode == "two-pass" else ()
    return Request(
        scene=dataclasses.replace(description, camera=path),
        source=scene_source(scene),
        settings=draft.model_copy(update={"selected_frames": max(len(selected), 1)}),
        execution=execution,
        selected=selected,
        directory=directory,
        started=started,
        url=url,
    )


def _camera(
    scene: SceneDescription, camera: str | Path | CameraPath | None, fps: float | None
) -> tuple[CameraPath, float, int]:
    """The path, its frames per second, and the number of frames if the user names none."""
    if fps is not None:
        RenderSettings.checked(frames=(1,), width=1, height=1, fps=fps)  # before it divides anything
    if camera is None:
        rate = scene.fps if fps is None else fps
        # At another rate the same stretch of the path is shown, not the same number of frames.
        same_stretch = round((scene.frames - 1) / scene.fps * rate) + 1
        return scene.camera, rate, scene.frames if rate == scene.fps else same_stretch
    path, file_fps = (camera, None) if isinstance(camera, CameraPath) else load_camera(Path(camera))
    rate = next(value for value in (fps, file_fps, scene.fps) if value is not None)
    return path, rate, path.frame_count(rate)


def _selection(choice: Selection | str, directory: Path) -> Selection:
    """`--selected-frames` as a number or a rule; what `workers` meant at the start is in `run.json`."""
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
                f"--selected-frames: {choice!r} is not valid: give auto, workers or a number of at least 1"
            )
        return int(choice)
    return choice


def _parts(choice: Parts | str) -> Parts:
    """`--cache-parts` as a number or `auto`."""
    if choice == "auto":
        return "auto"
    if isinstance(choice, str) and choice.strip().isdecimal():
        return int(choice)
    if isinstance(choice, bool) or not isinstance(choice, int):
        raise SettingsError(f"--cache-parts: {choice!r} is not valid: give auto or a number of at least 1")
    return choice


def _denoise(choice: bool, mode: Mode) -> bool:
    """`--denoise`, which is for what the cache leaves."""
    if choice and mode == "path":
        raise SettingsError(
            "--denoise: is not valid with --mode path: it keeps the light of the cache as it is and denoises the rest, "
            "and there is no cache; leave it out, or choose two-pass or single-pass"
        )
    return choice


def parse_frames(frames: Frames) -> tuple[int, ...]:
    """Frame numbers from what the user wrote, ascending, without duplicates.

    Raises:
        SettingsError: not a number, range or list of these; a frame before the first; too many.
    """
    if isinstance(frames, str) and not frames.strip().lstrip("+-").isdecimal():
        numbers = _parse_items(frames)
    elif isinstance(frames, str | int):
        count = int(frames)
        if isinstance(frames, bool) or count < 1:
            raise _wrong_frames(frames, "a film has at least one frame")
        numbers = list(range(1, min(count, _MOST_FRAMES + 1) + 1))
    else:
        numbers = list(frames)
        if not numbers or any(isinstance(n, bool) or not isinstance(n, int) for n in numbers):
            raise _wrong_frames(frames, "frame numbers are whole, and there is at least one")
    result = tuple(sorted(set(numbers)))
    if result[0] < 1:
        raise _wrong_frames(frames, "frames are counted from 1")
    if result[-1] > _MOST_FRAMES:
        raise _wrong_frames(frames, f"a film has at most {_MOST_FRAMES} frames")
    return result


def _parse_items(text: str) -> list[int]:
    """Frame numbers of a comma list of `A`, `A-B` and `A-B:STEP`."""
    numbers: list[int] = []
    for item in text.split(","):
        match = _ITEM.fullmatch(item.strip())
        if match is None:
            raise _wrong_frames(text, f"{item.strip()!r} is neither a frame nor a range")
        first, last, step = int(match[1]), int(match[2] or match[1]), int(match[3] or 1)
        if last < first or step < 1:
            raise _wrong_frames(text, f"{item.strip()!r} has no frames in it")
        numbers += range(first, min(last, _MOST_FRAMES + 1) + 1, step)
    return numbers


def _wrong_frames(frames: Frames, why: str) -> SettingsError:
    return SettingsError(
        f"--frames: {frames!r} is not valid: {why}; give a number such as 24, a range such as 30-53 or "
        "1-91:45 (every 45th), or a list such as 1,5,9"
    )


def parse_size(size: str | Iterable[int]) -> tuple[int, int]:
    """Width and height in pixels from `WxH` or a pair.

    Raises:
        SettingsError: neither, or a side is not from 1 to 65536.
    """
    given = size
    sides: Iterable[int]
    if isinstance(size, str):
        match = re.fullmatch(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*", size)
        sides = () if match is None else (int(match[1]), int(match[2]))
    else:
        sides = size
    pair = tuple(sides)
    if len(pair) != 2 or not all(isinstance(side, int) and 1 <= side <= 65536 for side in pair):
        raise SettingsError(
            f"--size: {given!r} is not valid: give width x height in pixels, each from 1 to 65536, such as "
            "1024x768"
        )
    return pair[0], pair[1]


def default_directory(scene_name: str, mode: str) -> Path:
    """`runs/SCENE-MODE` in the working directory, safe as a file name on any system."""
    return Path("runs") / re.sub(r"[^A-Za-z0-9._-]+", "-", f"{scene_name}-{mode}").strip(".-")


def scene_source(scene: str | Path | SceneDescription) -> str:
    """What the user gave as the scene, for `run.json`."""
    return f"{scene.name} (described in Python)" if isinstance(scene, SceneDescription) else str(scene)
