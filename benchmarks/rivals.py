"""Steadylight beside Radiance, Mitsuba's path tracer and a denoised path tracer: time, error and flicker, in one run.

    python benchmarks/rivals.py [--scenes gallery] [--camera FILE] [--frames 93-100] [--size 128x72] [--denoise]
        [--full] [--json rivals.json]

The same scenes, views, bounces and cores for all; each works alone on the machine while it is timed. Without options
a short version of the gallery; `--full`: three scenes, all frames, their own sizes: many hours (`--size` makes it
fewer). A scene may be a file, with a camera path of its own; Radiance is then left out if it cannot say what is in the
scene. With `--denoise`, so renders steadylight. Rivals that are not installed are left out:
`pip install pyradiance pyoidn`, or the extra `rivals`.

Seconds a frame
- steadylight, steady: the median second-pass task, file written, kernels and cache loaded.
- steadylight, film: makespan of the whole film over its frames: loading the scene, first pass, merge, audit, second
  pass, files; not the start of Python, and kernels are compiled before by a film of two small frames.
- path: Mitsuba's `path`, multijitter sampler, scene loaded and kernels compiled; median of the compared frames.
- path + OIDN: the same, then albedo and normals by Mitsuba's `aov` integrator alone, then the denoiser, loaded before:
  HDR, layers not prefiltered. What it gets is rendered with a box filter, as it is made for: with the film's Gaussian
  it takes noise for texture, and hardly denoises.
- path + OIDN + temporal: the same frames, each averaged with those before it where they saw the same surface
  (temporal_filter.py): a stand-in for denoisers that see several frames. It begins with the first compared frame.
- rpict, shared: the compared frames as a film with one ambient file, as many processes as cores, frame by frame in
  turn, from an empty file: whole processes, a small overture and loading the scene included. `file full` renders the
  same film again with that file: what a frame of a long film tends to, with all records there.
- rpict, own: a process for each frame, which keeps its ambient values to itself.
Without `--full`, rpict has two settings instead of three, and one only for `own` and the standing camera. Settings of
rpict are in radiance_film.py, what it cannot say of a scene in steadylight.renderers.radiance.export. It is held
against a path reference of what it computes: -ab bounces for lamps and sun; light of the sky comes by an ambient
bounce, so under a sky -ab is one more, and the light of the sun has one bounce more there and in that reference.

Errors (rel_rmse, rel_bias) are the means over some neighbouring frames amid the film, by `measure` of accuracy.py
against two path references of other seeds, whose noise (second line of a scene) thus does not count. BFM excess is over
the same frames, whole image, against the mean of both; overshoot is of their brightness alone. Static deviation: a
film of a standing camera in the middle of them, with other random numbers in each frame; for rpict with a fresh ambient
file.

Then, for each rival, the seconds at which it has the rel_rmse of steadylight, on the straight line between
neighbouring settings in log(seconds) and log(error), over the seconds of steadylight. `>`: it does not come that far
with its slowest setting; `<`: it is already better with its fastest.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from accuracy import measure
from numpy.typing import NDArray
from provenance import provenance
from temporal_filter import TemporalFilter

import steadylight as sl
from steadylight.animation.parsing import parse_frames, parse_size
from steadylight.camera import Pose
from steadylight.errors import SceneError
from steadylight.images import read_exr, tone_map, write_png
from steadylight.metrics.reprojection import View
from steadylight.metrics.temporal import bfm_excess, brightness_series, overshoot, static_deviation
from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.scenes.description import SceneDescription

SCENES = ("gallery", "temple-walk", "corridor")
RIVALS = {"Radiance": "pyradiance", "OIDN": "pyoidn"}
SHORT_FRAMES = 8
"""Of the film, without `--full` and `--frames`."""

LANES = 1 << 22
"""Samples that are rendered at once for a reference."""

LAYER_SPP = 16
"""Samples per pixel of albedo and normals: with more the denoised picture hardly gets better, with fewer worse."""

STATIC_SPP = 64
"""With more samples than these the standing camera of `path` is left out: it is about seconds then."""

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Job:
    """What all rivals render.

    Attributes:
        scene: with its camera path.
        frames: numbers of the frames of the film.
        compared: numbers of those that errors are measured on, neighbours.
        size: width and height, pixels.
        spp: samples per pixel of steadylight.
        quality: of steadylight.
        bounces: indirect diffuse bounces.
        stills: frames of the standing camera.
        reference_spp: samples per pixel of each of the two references.
        most_spp: of `path` at most.
        denoise: by steadylight, of what is not cached.
    """

    scene: SceneDescription
    frames: tuple[int, ...]
    compared: tuple[int, ...]
    size: tuple[int, int]
    spp: int
    quality: str
    bounces: int
    stills: int
    reference_spp: int
    most_spp: int
    denoise: bool

    @property
    def poses(self) -> list[Pose]:
        """Of the compared frames."""
        return self.scene.camera.frame_poses(self.compared, self.scene.fps)

    @property
    def middle(self) -> int:
        """Which of the compared frames the standing camera looks at."""
        return len(self.compared) // 2


class Reference(NamedTuple):
    """Two path-traced films that differ in their seed."""

    a: list[Image]
    b: list[Image]

    @property
    def mean(self) -> list[Image]:
        """Of both."""
        return [(a + b) / 2 for a, b in zip(self.a, self.b, strict=True)]


@dataclass(frozen=True)
class Rendered:
    """What a rival made.

    Attributes:
        method: for the table.
        setting: the same.
        seconds: of a frame.
        images: of the compared frames.
        stills: of the standing camera; none if they were left out.
    """

    method: str
    setting: str
    seconds: float
    images: list[Image]
    stills: list[Image] = field(default_factory=list)


@dataclass(frozen=True)
class Row:
    """A line of the table; None where nothing was measured."""

    method: str
    setting: str
    seconds: float
    rel_rmse: float
    rel_bias: float
    bfm_excess: float
    overshoot: float | None
    static_deviation: float | None
    plain_rmse: float


class Crossing(NamedTuple):
    """The seconds at which a rival has some error; `sign` says if that is measured (=) or a bound (<, >)."""

    sign: str
    seconds: float


def main() -> None:
    """Measure scene by scene and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", help=f"gallery if not given, {' '.join(SCENES)} with --full")
    parser.add_argument("--camera", type=Path, help="keyframes, instead of the scene's own path")
    parser.add_argument("--frames", help=f"of the film; {SHORT_FRAMES} in its middle if not given")
    parser.add_argument("--size", help="128x72 if not given, the scene's own with --full")
    parser.add_argument(
        "--compared", type=int, help="frames that are compared; 3 if not given, 6 with --full"
    )
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel of steadylight")
    parser.add_argument("--quality", default="normal", help="of steadylight")
    parser.add_argument("--bounces", type=int, default=2, help="indirect diffuse bounces, of all")
    parser.add_argument("--denoise", action="store_true", help="what steadylight does not cache")
    parser.add_argument("--most-spp", type=int, help="of `path`; 1024 if not given, 16384 with --full")
    parser.add_argument("--reference-spp", type=int, help="512 if not given, 2048 with --full")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="a PNG of each method's middle frame")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    variant = resolve_variant("auto")
    sl.use_variant(variant)
    here = {name: find_spec(package) is not None for name, package in RIVALS.items()}
    for name, package in RIVALS.items():
        if not here[name]:
            print(f"{name} is left out: pip install {package} (or the extra `rivals` of steadylight)")
    result: dict[str, Any] = provenance() | {"variant": variant, "scenes": []}
    result["versions"] |= {name: version(name) for name in RIVALS.values() if find_spec(name)}
    print(json.dumps(result))
    for name in options.scenes or (SCENES if options.full else SCENES[:1]):
        job = job_of(name, options)
        with tempfile.TemporaryDirectory(prefix="rivals-") as folder:
            rendered, references = render_all(job, Path(folder), here, options.full)
        result["scenes"].append(concluded(job, rendered, references))
        if options.pictures:
            draw(options.pictures, job, rendered, references)
    print(json.dumps(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


def job_of(name: str, options: argparse.Namespace) -> Job:
    """What was asked for, of one scene."""
    request = sl.plan(name, camera=options.camera)
    settings = request.settings
    scene = replace(request.scene, fps=settings.fps, frames=settings.frames[-1])
    if options.frames:
        frames = parse_frames(options.frames)
    elif options.full:
        frames = parse_frames(scene.frames)
    else:
        first = max(1, (scene.frames - SHORT_FRAMES) // 2)
        frames = tuple(range(first, min(first + SHORT_FRAMES, scene.frames + 1)))
    count = min(options.compared or (6 if options.full else 3), len(frames))
    start = (len(frames) - count) // 2
    size = options.size or (f"{scene.width}x{scene.height}" if options.full else "128x72")
    return Job(
        scene=scene,
        frames=frames,
        compared=frames[start : start + count],
        size=parse_size(size),
        spp=options.spp,
        quality=options.quality,
        bounces=options.bounces,
        stills=8 if options.full else 4,
        reference_spp=options.reference_spp or (2048 if options.full else 512),
        most_spp=options.most_spp or (16384 if options.full else 1024),
        denoise=options.denoise,
    )


def render_all(
    job: Job, folder: Path, here: dict[str, bool], full: bool
) -> tuple[list[Rendered], dict[str, Reference]]:
    """Everything, one after the other, and the references by what is held against them."""
    tracer = PathTracer(job)
    references = {"": Reference(*(tracer.reference(seed) for seed in (1, 2)))}
    rendered = by_steadylight(job, folder)
    film, steady = rendered
    error = judged(steady, references[""], job).rel_rmse
    rendered += by_spp(tracer.plain, job, lambda row: row.rel_rmse < error, references[""])
    if here["OIDN"]:
        boxed = PathTracer(job, replace(job.scene, film={"type": "box"}))
        denoised = by_spp(boxed.denoised, job, lambda row: row.seconds >= film.seconds, references[""])
        rendered += [*denoised, *(noted(boxed.filtered(each)) for each in denoised)]
    if here["Radiance"]:
        try:
            made, reference = by_radiance(job, folder / "radiance", full)
        except SceneError as error:
            print(f"Radiance is left out: {error}")
        else:
            rendered += made
            references["rpict"] = reference or references[""]
    return rendered, references


def by_steadylight(job: Job, folder: Path) -> list[Rendered]:
    """The film: its frames with and without their share of what comes before the second pass."""
    warm = {
        "spp": job.spp,
        "quality": job.quality,
        "bounces": job.bounces,
        "denoise": job.denoise,
        "cluster": "in-process",
    }
    small = tuple(max(16, side // 4) for side in job.size)
    sl.render(job.scene, frames=job.compared[:2], size=small, output=folder / "warm", **warm)
    run = sl.render(job.scene, frames=job.frames, size=job.size, output=folder / "film", **warm)
    still = sl.render(
        job.scene,
        camera=standing(job.poses[job.middle], job.stills / job.scene.fps),
        frames=job.stills,
        fps=job.scene.fps,
        size=job.size,
        output=folder / "still",
        **warm,
    )
    by_number = dict(zip(job.frames, run.frames, strict=True))
    images = [read_exr(by_number[number]) for number in job.compared]
    stills = [read_exr(path) for path in still.frames]
    film = run.statistics["makespan_s"] / len(job.frames)
    steady = statistics.median(run.statistics["second_pass"]["frame_seconds"])
    setting = f"{job.quality}, {job.spp} spp" + (", denoise" if job.denoise else "")
    return [
        noted(Rendered("steadylight, film", f"{len(job.frames)} frames, {setting}", film, images, stills)),
        noted(Rendered("steadylight, steady", setting, steady, images, stills)),
    ]


def standing(pose: Pose, seconds: float) -> sl.CameraPath:
    """A camera that keeps a pose for some seconds."""
    x, y, z = pose.origin + pose.direction
    ox, oy, oz = pose.origin
    ux, uy, uz = pose.to_world[:3, 1]
    key = sl.Keyframe(0.0, (ox, oy, oz), (x, y, z), (ux, uy, uz), pose.fov)
    return sl.CameraPath((key, replace(key, time=seconds)))


def by_spp(
    render: Callable[[int], Rendered], job: Job, enough: Callable[[Row], bool], reference: Reference
) -> list[Rendered]:
    """With four times as many samples per pixel each time, from 4 until it is enough or `most_spp` is reached."""
    made: list[Rendered] = []
    spp = 4
    while spp <= job.most_spp and not (made and enough(judged(made[-1], reference, job))):
        made.append(noted(render(spp)))
        spp *= 4
    return made


class PathTracer:
    """Mitsuba's path tracer on the views of a job, with the bounces of the job or some more."""

    def __init__(self, job: Job, scene: SceneDescription | None = None, more_bounces: int = 0) -> None:
        """Load the scene.

        Args:
            job: what to render.
            scene: other than the job's.
            more_bounces: than the job's.
        """
        import mitsuba as mi

        from steadylight.renderers.mitsuba.scene import build_scene, build_sensor

        description = scene or job.scene
        # Its number of samples is that of each render.
        sensor = {**description.sensor, "sampler": {"type": "multijitter", "sample_count": 4}}
        description = replace(description, sensor=sensor)
        self.job = job
        self.scene = build_scene(description)
        self.sensor = build_sensor(description, job.poses[0], *job.size)
        # Russian roulette starts beyond the last bounce: it would only add noise to so few.
        path = {"type": "path", "max_depth": job.bounces + more_bounces + 2, "rr_depth": 1 << 20}
        layers = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
        self.path, self.layers = mi.load_dict(path), mi.load_dict(layers)
        self.places = mi.load_dict({"type": "aov", "aovs": "position:position,normal:sh_normal"})

    def reference(self, seed: int) -> list[Image]:
        """The compared frames with many samples, for this seed."""
        width, height = self.job.size
        # Multijitter wants a square number; passes keep the memory small.
        spp = max(1, min(self.job.reference_spp, 4 ** int(math.log(max(4, LANES // (width * height)), 4))))
        passes = math.ceil(self.job.reference_spp / spp)
        return [
            sum(self._pass(pose, spp, _seed(seed, number, k)) for k in range(passes)) / passes
            for number, pose in enumerate(self.job.poses)
        ]

    def plain(self, spp: int) -> Rendered:
        """`path` as it is."""
        stills = spp <= STATIC_SPP
        return self._rendered("path", spp, lambda pose, seed: self._pass(pose, spp, seed), stills=stills)

    def denoised(self, spp: int) -> Rendered:
        """`path` with OIDN after it."""
        return self._rendered(
            "path + OIDN", spp, lambda pose, seed: self.denoised_frame(pose, spp, seed), stills=True
        )

    def denoised_frame(self, pose: Pose, spp: int, seed: int) -> Image:
        """One frame of that."""
        import pyoidn

        color = self._pass(pose, spp, seed)
        albedo, normal = np.split(self._pass(pose, LAYER_SPP, seed, self.layers), 2, axis=2)
        return pyoidn.denoise(color, albedo=albedo.clip(0, 1), normal=normal, hdr=True)

    def filtered(self, denoised: Rendered) -> Rendered:
        """Denoised frames with a temporal filter after it."""
        start = time.perf_counter()
        moving, standing = TemporalFilter(), TemporalFilter()
        images = [
            moving(image, self._view(pose))
            for image, pose in zip(denoised.images, self.job.poses, strict=True)
        ]
        seconds = denoised.seconds + (time.perf_counter() - start) / max(len(images), 1)
        stills = [standing(image) for image in denoised.stills]
        return Rendered(f"{denoised.method} + temporal", denoised.setting, seconds, images, stills)

    def _view(self, pose: Pose) -> View:
        """What each pixel sees on average, which is the middle of it on a plane."""
        position, normal = np.split(self._pass(pose, LAYER_SPP, 0, self.places), 2, axis=2)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        # Half a surface, or two of them, is none.
        whole = np.where(length > 0.9, normal / np.maximum(length, 1e-6), 0)
        return View(pose, self.job.size, position, whole)

    def _rendered(
        self, method: str, spp: int, frame: Callable[[Pose, int], Image], *, stills: bool
    ) -> Rendered:
        """The compared frames, timed, and the standing camera."""
        poses = self.job.poses
        frame(poses[0], 0)  # compiles the kernels
        images, seconds = [], []
        for number, pose in enumerate(poses):
            start = time.perf_counter()
            images.append(frame(pose, _seed(3, spp, number)))
            seconds.append(time.perf_counter() - start)
        standing = poses[self.job.middle]
        still = [frame(standing, _seed(4, spp, k)) for k in range(self.job.stills if stills else 0)]
        return Rendered(method, f"{spp} spp", statistics.median(seconds), images, still)

    def _pass(self, pose: Pose, spp: int, seed: int, integrator: Any = None) -> Image:
        """(H, W, channels) of one frame."""
        import drjit as dr
        import mitsuba as mi

        from steadylight.renderers.mitsuba.scene import set_pose

        set_pose(self.sensor, pose)
        image = mi.render(
            self.scene,
            sensor=self.sensor,
            integrator=integrator or self.path,
            spp=spp,
            seed=dr.opaque(mi.UInt32, seed),
        )
        return np.array(image, np.float32)


def by_radiance(job: Job, folder: Path, full: bool) -> tuple[list[Rendered], Reference | None]:
    """Films by rpict, and what they are held against if that is other light than the job's."""
    from radiance_film import QUALITIES, Rpict

    from steadylight.renderers.radiance.export import export, split_sky

    scene = export(job.scene, folder)
    reference = None
    if scene.sky:
        parts = [PathTracer(job, part, 0 if sky else 1) for part, sky in split_sky(job.scene)]
        films = [[part.reference(seed) for part in parts] for seed in (1, 2)]
        reference = Reference(*([sum(images) for images in zip(*film, strict=True)] for film in films))
    rpict = Rpict(scene, job.size, job.bounces + scene.sky, os.cpu_count() or 1)
    still = [job.poses[job.middle]] * job.stills
    made = []
    for quality in QUALITIES if full else QUALITIES[:2]:
        where = folder / quality.name
        film, again = (rpict.shared(job.poses, quality, where / "film") for _ in range(2))
        runs = [("rpict, shared", film, []), ("rpict, file full", again, [])]
        # The short version leaves out what takes longest.
        if full or quality is QUALITIES[0]:
            stills, stills_apart = (
                render(still, quality, where / name).images
                for render, name in ((rpict.shared, "still"), (rpict.apart, "still-apart"))
            )
            apart = rpict.apart(job.poses, quality, where / "apart")
            runs = [("rpict, shared", film, stills), runs[1], ("rpict, own", apart, stills_apart)]
        for method, done, standing_camera in runs:
            seconds = done.seconds / len(job.poses)
            made.append(noted(Rendered(method, quality.name, seconds, done.images, standing_camera)))
    return made, reference


def noted(rendered: Rendered) -> Rendered:
    """The same, after a line for who waits."""
    line = f"{rendered.method}, {rendered.setting}: {rendered.seconds:.3f} s a frame"
    print(line, file=sys.stderr, flush=True)
    return rendered


def judged(rendered: Rendered, reference: Reference, job: Job) -> Row:
    """What was made against the reference."""
    errors = [
        measure(image, a, b) for image, a, b in zip(rendered.images, reference.a, reference.b, strict=True)
    ]
    mean = {name: float(np.mean([error[name] for error in errors])) for name in errors[0]}
    series = [brightness_series(images) for images in (rendered.images, reference.mean)]
    still = rendered.stills and static_deviation(rendered.stills, reference.mean[job.middle])
    return Row(
        method=rendered.method,
        setting=rendered.setting,
        seconds=rendered.seconds,
        rel_rmse=mean["rel_rmse"],
        rel_bias=mean["rel_bias"],
        bfm_excess=_bfm_excess(*series),
        overshoot=overshoot(series[0]) if len(job.compared) > 2 else None,
        static_deviation=still or None,
        plain_rmse=mean["plain_rmse"],
    )


def _bfm_excess(brightness: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Of neighbouring frames, or NaN for one alone."""
    return bfm_excess(brightness, truth) if len(brightness) > 1 else math.nan


def time_at(error: float, curve: Sequence[tuple[float, float]]) -> Crossing:
    """When a rival has that error.

    Args:
        error: rel_rmse, more than 0.
        curve: (seconds, rel_rmse) of its settings, in any order.

    Returns:
        On the straight line between the first neighbours, by seconds, of which one has a larger error and the next has
        not, in the logarithms of both; a bound if there are none.
    """
    points = sorted(curve)
    if points[0][1] <= error:
        return Crossing("<", points[0][0])
    for (t0, e0), (t1, e1) in itertools.pairwise(points):
        if e1 <= error:
            part = math.log(e0 / error) / math.log(e0 / e1)
            return Crossing("=", t0 * (t1 / t0) ** part)
    return Crossing(">", points[-1][0])


def concluded(job: Job, rendered: Sequence[Rendered], references: dict[str, Reference]) -> dict[str, Any]:
    """The table and the ratios of a scene, printed and as plain data."""
    rows = [judged(item, reference_of(item.method, references), job) for item in rendered]
    width, height = job.size
    noise = references[""]
    errors = [measure(a, a, b)["reference_noise"] for a, b in zip(noise.a, noise.b, strict=True)]
    reference = {
        "spp": job.reference_spp,
        "noise": float(np.mean(errors)),
        "bfm_excess": _bfm_excess(brightness_series(noise.a), brightness_series(noise.b)) / 2,
    }
    print(
        f"\n{job.scene.name}, {width}x{height}, {len(job.frames)} frames from {job.frames[0]}, compared: "
        f"{', '.join(map(str, job.compared))}; {job.bounces} indirect bounces\n"
        f"reference: twice {job.reference_spp} spp; noise of their mean {100 * reference['noise']:.2f} %, in BFM "
        f"{reference['bfm_excess']:.6f}\n\n"
        f"{'':20} {'':36} {'s a frame':>10} {'rel_rmse':>9} {'rel_bias':>9} {'BFM excess':>11} {'overshoot':>11} "
        f"{'static dev.':>11}"
    )
    for row in rows:
        static = "-" if row.static_deviation is None else f"{row.static_deviation:.5f}"
        beyond = "-" if row.overshoot is None else f"{row.overshoot:.6f}"
        print(
            f"{row.method:20} {row.setting:36} {row.seconds:10.3f} {row.rel_rmse:9.4f} {row.rel_bias:+9.4f} "
            f"{row.bfm_excess:11.6f} {beyond:>11} {static:>11}"
        )
    film, steady = rows[:2]
    return {
        "scene": job.scene.name,
        "size": f"{width}x{height}",
        "frames": list(job.frames),
        "compared": list(job.compared),
        "bounces": job.bounces,
        "reference": reference,
        "rows": [vars(row) for row in rows],
        "time_ratios": time_ratios(film, steady, rows),
        "denoised": against_denoised(film, rows),
    }


def time_ratios(film: Row, steady: Row, rows: Sequence[Row]) -> dict[str, Any]:
    """Times of the rivals at the error of steadylight over those of steadylight."""
    print(
        f"\n{'at rel_rmse ' + format(steady.rel_rmse, '.4f'):22} {'s a frame':>12} {'/ steady':>9} {'/ film':>9}"
    )
    ratios = {}
    for method in dict.fromkeys(row.method for row in rows[2:]):
        sign, seconds = time_at(
            steady.rel_rmse, [(row.seconds, row.rel_rmse) for row in rows if row.method == method]
        )
        ratios[method] = {
            "sign": sign,
            "seconds": seconds,
            "to_steady": seconds / steady.seconds,
            "to_film": seconds / film.seconds,
        }
        mark = " " if sign == "=" else sign
        print(
            f"{method:22} {mark} {seconds:10.3f} {seconds / steady.seconds:9.1f} {seconds / film.seconds:9.1f}"
        )
    return ratios


def against_denoised(film: Row, rows: Sequence[Row]) -> dict[str, Any] | None:
    """The denoised path tracer in no more time than a frame of the film, or with the fewest samples there are."""
    denoised = sorted((row for row in rows if row.method == "path + OIDN"), key=lambda row: row.seconds)
    if not denoised:
        return None
    row = max(
        (row for row in denoised if row.seconds <= film.seconds),
        key=lambda row: row.seconds,
        default=denoised[0],
    )
    names = ("seconds", "rel_rmse", "static_deviation", "bfm_excess", "overshoot")
    ratios = {name: _ratio(getattr(row, name), getattr(film, name)) for name in names}
    words = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    print(f"\n{row.method}, {row.setting}, over {film.method}: {words}")
    return {"setting": row.setting} | ratios


def _ratio(rival: float | None, ours: float | None) -> float:
    if rival is None or ours is None:
        return math.nan
    return rival / ours if ours else math.inf


def reference_of(method: str, references: dict[str, Reference]) -> Reference:
    """What that method is held against."""
    return references["rpict"] if method.startswith("rpict") else references[""]


def draw(folder: Path, job: Job, rendered: Sequence[Rendered], references: dict[str, Reference]) -> None:
    """Each method's middle frame, its reference, and the signed error (grey: none; 25 % either way at the ends)."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in rendered:
        image, truth = item.images[job.middle], reference_of(item.method, references).mean[job.middle]
        exposure = float(0.35 / np.median(truth))
        error = (image - truth) / (truth + 0.1 * truth.mean())
        grey = np.clip(128 + 512 * error, 0, 255).astype(np.uint8)
        name = f"{job.scene.name} {item.method} {item.setting}".replace(",", "").replace(" ", "-")
        pictures = [tone_map(image, exposure), tone_map(truth, exposure), grey]
        write_png(folder / f"{name}.png", np.concatenate(pictures, axis=1))


def _seed(*numbers: int) -> int:
    from steadylight.renderers.mitsuba.sampling import seed_of

    return seed_of(*numbers)


if __name__ == "__main__":
    main()
