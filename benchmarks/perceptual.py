"""How films look to a person, in JOD: two-pass, single-pass and denoised path tracing in the same time.

    python benchmarks/perceptual.py [--scenes gallery temple-walk] [--camera FILE] [--frame N] [--size 192x108]
        [--frames 24] [--spp 16] [--quality normal] [--reference-spp 8192] [--output FOLDER] [--json jod.json]

A clip of a standing camera, because a reference film without noise is out of reach in hard light: its reference is one
picture with very many samples, in passes with seeds of their own, and repeated. What differs from it is error that
stays, and flicker. All compute the same number of bounces. Times are those of the processor, all threads together,
which others on the machine hardly change.

- two-pass, single-pass: steadylight with `--denoise`; the whole film over its frames, after a small film that compiles
  the kernels.
- path + OIDN: as many samples as fit into the time of a frame of the two-pass film.
- path + OIDN + temporal: the same frames through the temporal filter of temporal_filter.py.

JOD by ColorVideoVDP (`steadylight.metrics.perceptual`), rel_rmse as the mean over the frames, static deviation as in
steadylight.metrics.temporal. With `--output`, the frames of each film are kept for `steadylight compare --html`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from provenance import provenance
from rivals import Job, PathTracer, standing
from temporal_filter import TemporalFilter

import steadylight as sl
from steadylight.animation.parsing import parse_size
from steadylight.camera import Pose
from steadylight.images import animation_exposure, read_exr, write_exr
from steadylight.metrics.perceptual import jod
from steadylight.metrics.still import rel_rmse
from steadylight.metrics.temporal import static_deviation
from steadylight.renderers.mitsuba.backend import resolve_variant

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Film:
    """The frames of one method, and its seconds a frame."""

    method: str
    seconds: float
    frames: Sequence[Image]


def main() -> None:
    """Measure scene by scene and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["gallery", "temple-walk"])
    parser.add_argument("--camera", type=Path, help="keyframes, instead of the scene's own path")
    parser.add_argument(
        "--frame", type=int, help="where the camera stands; the middle of the path if not given"
    )
    parser.add_argument("--size", default="192x108")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel of steadylight")
    parser.add_argument("--quality", default="normal", help="of steadylight")
    parser.add_argument("--bounces", type=int, default=2, help="indirect diffuse bounces, of all")
    parser.add_argument("--reference-spp", type=int, default=8192)
    parser.add_argument("--output", type=Path, help="keep the frames here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sl.use_variant(resolve_variant("auto"))
    result = provenance() | {"scenes": {}}
    for name in options.scenes:
        job = job_of(name, options)
        with tempfile.TemporaryDirectory(prefix="perceptual-") as folder:
            films = films_of(job, Path(folder))
        tracer = PathTracer(job)
        (reference,) = tracer.reference(1)
        (other,) = PathTracer(job_of(name, options, part=8)).reference(2)
        result["scenes"][job.scene.name] = concluded(job, films, reference, other)
        if options.output:
            keep(options.output / job.scene.name, films, reference)
    print(json.dumps(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


def job_of(name: str, options: argparse.Namespace, part: int = 1) -> Job:
    """A standing camera in a scene; the reference with one `part`-th of the samples."""
    request = sl.plan(name, camera=options.camera)
    scene, fps = request.scene, request.settings.fps
    frame = options.frame or (request.settings.frames[-1] + 1) // 2
    (pose,) = scene.camera.frame_poses([frame], fps)
    scene = sl.plan(request.scene, camera=standing(pose, options.frames / fps), fps=fps).scene
    frames = tuple(range(1, options.frames + 1))
    return Job(
        scene=scene,
        frames=frames,
        compared=frames[:1],
        size=parse_size(options.size),
        spp=options.spp,
        quality=options.quality,
        bounces=options.bounces,
        stills=len(frames),
        reference_spp=options.reference_spp // part,
        most_spp=0,
        denoise=True,
    )


def films_of(job: Job, folder: Path) -> list[Film]:
    """A film of each method."""
    films = [by_steadylight(job, mode, folder) for mode in ("two-pass", "single-pass")]
    tracer = boxed(job)
    path = fitting(tracer, films[0].seconds)
    smooth = TemporalFilter()
    filtered = Film(f"{path.method} + temporal", path.seconds, [smooth(image) for image in path.frames])
    return [*films, path, filtered]


def by_steadylight(job: Job, mode: str, folder: Path) -> Film:
    """A film by steadylight in one of its modes."""
    given = {
        "spp": job.spp,
        "quality": job.quality,
        "bounces": job.bounces,
        "denoise": True,
        "mode": mode,
        "fps": job.scene.fps,
        "cluster": "in-process",
    }
    small = tuple(max(16, side // 4) for side in job.size)
    sl.render(job.scene, frames=2, size=small, output=folder / f"{mode}-warm", **given)
    start = time.process_time()
    run = sl.render(job.scene, frames=len(job.frames), size=job.size, output=folder / mode, **given)
    seconds = (time.process_time() - start) / len(job.frames)
    print(f"{job.scene.name}, {mode}: {seconds:.2f} s a frame", file=sys.stderr, flush=True)
    return Film(mode, seconds, [read_exr(path) for path in run.frames])


def boxed(job: Job) -> PathTracer:
    """Pictures with a box filter, as the denoiser is made for."""
    return PathTracer(job, replace(job.scene, film={"type": "box"}))


def fitting(tracer: PathTracer, seconds: float) -> Film:
    """Denoised frames that take as long, with 1 sample per pixel at least."""
    (pose,) = tracer.job.poses
    tracer.denoised_frame(pose, 4, 0)  # compiles the kernels
    spp = 4
    while (spent := timed(tracer, pose, spp)) < 0.5 * seconds and spp < 4096:
        spp *= 4
    # Multijitter wants a square number.
    spp = max(1, round((spp * seconds / spent) ** 0.5)) ** 2
    start = time.process_time()
    frames = [tracer.denoised_frame(pose, spp, number) for number in tracer.job.frames]
    spent = (time.process_time() - start) / len(frames)
    print(f"path {spp} spp + OIDN: {spent:.2f} s a frame", file=sys.stderr, flush=True)
    return Film(f"path {spp} spp + OIDN", spent, frames)


def timed(tracer: PathTracer, pose: Pose, spp: int) -> float:
    """Seconds of the processor for a frame."""
    start = time.process_time()
    tracer.denoised_frame(pose, spp, 0)
    return time.process_time() - start


def concluded(job: Job, films: Sequence[Film], reference: Image, other: Image) -> dict[str, object]:
    """The table of a scene, printed and as plain data."""
    exposure = animation_exposure([reference])
    noise = rel_rmse(other, reference)
    width, height = job.size
    print(
        f"\n{job.scene.name}, {width}x{height}, {len(job.frames)} frames of a standing camera, {job.bounces} indirect "
        f"bounces\nreference: {job.reference_spp} spp; another of an eighth of them differs by {100 * noise:.2f} %\n\n"
        f"{'':52} {'s a frame':>10} {'JOD':>6} {'rel_rmse':>9} {'static dev.':>11}"
    )
    rows = []
    for film in films:
        row = {
            "method": film.method,
            "seconds": film.seconds,
            "jod": jod(film.frames, [reference] * len(film.frames), job.scene.fps, exposure),
            "rel_rmse": statistics.mean(rel_rmse(image, reference) for image in film.frames),
            "static_deviation": static_deviation(film.frames, reference),
        }
        rows.append(row)
        print(
            f"{film.method:52} {film.seconds:10.2f} {row['jod']:6.2f} {row['rel_rmse']:9.4f} "
            f"{row['static_deviation']:11.5f}",
            flush=True,
        )
    return {"size": f"{width}x{height}", "reference_spp": job.reference_spp, "noise": noise, "rows": rows}


def keep(folder: Path, films: Sequence[Film], reference: Image) -> None:
    """Write the frames as folders that `compare` reads."""
    for film in (*films, Film("reference", 0.0, [reference] * len(films[0].frames))):
        place = folder / film.method.replace(",", "").replace(" ", "-")
        place.mkdir(parents=True, exist_ok=True)
        for number, image in enumerate(film.frames, start=1):
            write_exr(place / f"frame_{number:05d}.exr", image)


if __name__ == "__main__":
    main()
