"""Time and memory of a large cache, and of a frame that reads it, against the number of records and of pixels.

    python benchmarks/limits.py [SCENE] [--records 1000,10000,...] [--sizes 512,1024,2048] [--full] [--smooth]

Records lie where camera rays of the scene's animation end, as densely as their number asks, all with the same light
and of such radii that some ten of them answer at each point, as in a real cache. Each case has a process of its own,
so that its memory is its own; one that the system ends, for want of memory as a rule, is told and left out. Columns:
seconds to smooth the cache, with `--smooth`, in parts of about a million records, one after the other; to write its
file and read it; to index and upload it; to learn which emitters each record sees; of a frame with kernels warm, and
of that nanoseconds a sample; peak resident memory of all that.

Gathering is not measured: records are made in boxes of some thousand, and one takes as long however many there are.

Other limits: a frame beside Mitsuba's `direct`, and the gather beside its `path`, by frame_cost.py; error against the
number of records, by radii.py.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
from provenance import provenance

from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.scenes import load_scene
from steadylight.settings import RenderSettings

ANSWERS = 10
"""Records that answer at a point, on average."""

MOST_IN_A_PART = 1_000_000
"""Records in a part of a cache that is smoothed, on average at most."""

VIEWS = 16
"""Frames along the animation from whose views the records come."""


def measure(scene_name: str, count: int, size: int, options: argparse.Namespace) -> dict[str, Any]:
    """One case, in this process."""
    spp, repeat = options.spp, options.repeat
    use_variant(resolve_variant("auto"))
    from steadylight.cache.file import CacheFile, encode_cache, read_cache
    from steadylight.renderers.mitsuba.image.picture import Sampled, render_layers
    from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
    from steadylight.renderers.mitsuba.renderer import Renderer

    scene = load_scene(scene_name)
    numbers = np.linspace(1, scene.frames, VIEWS).round().astype(int).tolist()
    poses = dict(zip(numbers, scene.camera.frame_poses(numbers, scene.fps), strict=True))
    settings = RenderSettings(frames=tuple(numbers), width=size, height=size, spp=spp, quality="draft")
    renderer = Renderer(scene, poses, settings)
    view = renderer.view

    records = make_records(renderer, poses, count)
    begun = time.perf_counter()
    records = smoothed_by_parts(records) if options.smooth else records
    smoothed = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "smoothed.safetensors"
        path.write_bytes(encode_cache(CacheFile(records, "0" * 64, {})))
        records = read_cache(path).records

    start = time.perf_counter()
    cache = renderer.load(records)
    loaded = time.perf_counter()
    view.lighting(cache)
    prepared = time.perf_counter()
    # As `Renderer.shade`, which would render a frame with gaps, as these records leave, once more.
    view.camera.look(poses[numbers[0]])
    rfilter = view.camera.sensor.film().rfilter()

    def seen_by(samples: Any, ray: Any) -> Sampled:
        shade = view.shade(samples, ray, cache)
        return Sampled((shade.radiance + shade.direct,), shade.missed)

    look = Look(view.camera, seen_by, lambda: view.arrays(cache))
    frames = []
    for _ in range(repeat + 1):
        begin = time.perf_counter()
        missed = render_layers(look, [rfilter], Sampling(spp, 0)).count
        frames.append(time.perf_counter() - begin)
    seconds = statistics.median(frames[1:])  # the first has compiled the kernels
    return {
        "records": count,
        "size": size,
        "smooth_s": smoothed - begun,
        "file_s": start - smoothed,
        "load_s": loaded - start,
        "emitters_s": prepared - loaded,
        "frame_s": seconds,
        "ns_per_sample": 1e9 * seconds / (size * size * spp),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "missed": missed,
    }


def make_records(renderer: Any, poses: Mapping[int, Any], count: int) -> Any:
    """So many records where camera rays from all poses end, in the order of a merged cache."""
    from steadylight.cache.merge import canonical_order
    from steadylight.cache.records import Records
    from steadylight.renderers.mitsuba.records.filling import Points

    view = renderer.view
    random = np.random.default_rng(0)
    nothing = renderer.load(Records.empty())
    seen: list[Points] = []
    while sum(len(points.position) for points in seen) < count:
        for pose in poses.values():
            view.camera.look(pose)
            film = random.random((max(1024, 2 * count // VIEWS), 2), np.float32)
            points, _ = view.missed_through(film, nothing, len(seen))
            seen.append(points)
    points = Points.concatenate(seen)
    points = points.take(random.permutation(len(points.position))[:count])
    # Camera rays fall densely where the camera is near, and so do records: as far as the tenth neighbour.
    radius = _distance_to_neighbour(points.position, ANSWERS)
    values = {name: np.zeros((count, *shape), np.float32) for name, shape in Records.SHAPES.items()}
    values |= {"position": points.position, "normal": points.normal, "radius": radius}
    values["irradiance"] += 1
    values["headroom"] += np.inf
    records = Records(**values)
    return records.take(canonical_order(records))


def smoothed_by_parts(records: Any) -> Any:
    """The records, smoothed as a run does whose cache has parts of about MOST_IN_A_PART."""
    from steadylight.cache.partition import concatenate_parts, divide_space, smooth_part

    position, longest = records.position, float(records.radius.max())
    corners = np.stack([position.min(axis=0), position.max(axis=0)]).astype(np.float64)
    partition = divide_space([position], -(-len(records) // MOST_IN_A_PART), longest, corners)
    part_of = partition.part_of(position)
    parts = [records.take(part_of == part) for part in range(partition.count)]
    smoothed = []
    for number, own in enumerate(parts):
        around = [parts[near] for near in partition.around([number]) if near != number]
        smoothed.append(smooth_part(own, around, partition.radius))
    return concatenate_parts(smoothed)


def _distance_to_neighbour(position: np.ndarray, k: int) -> np.ndarray:
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(position).query(position, [min(k + 1, len(position))], workers=-1)
    return np.maximum(distance[:, 0], 1e-4).astype(np.float32)


def main() -> None:
    """Print a row for each case, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="gallery")
    parser.add_argument("--records", default="1000,10000,100000")
    parser.add_argument("--sizes", default="256,512")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument(
        "--full", action="store_true", help="up to ten million records, and 2048x2048 with a million"
    )
    parser.add_argument("--smooth", action="store_true", help="about two minutes for a million records")
    options = parser.parse_args()
    counts = [int(number) for number in options.records.split(",")]
    sizes = [int(number) for number in options.sizes.split(",")]
    cases = [(count, min(512, max(sizes))) for count in counts] + [(counts[-1], size) for size in sizes]
    if options.full:
        cases = [(10**power, 512) for power in range(3, 8)] + [(10**6, size) for size in (512, 1024, 2048)]
    origin = provenance()  # before hours have passed, and commits with them
    rows = []
    names = (
        "records",
        "size",
        "smooth_s",
        "file_s",
        "load_s",
        "emitters_s",
        "frame_s",
        "ns_per_sample",
        "peak_gb",
        "missed",
    )
    print("".join(f"{name:>13}" for name in names))
    for count, size in dict.fromkeys(cases):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            case = pool.submit(measure, options.scene, count, size, options)
        if isinstance(case.exception(), BrokenProcessPool):
            print(f"{count:>13}{size:>13} was ended by the system: out of memory?", flush=True)
            continue
        row = case.result()
        rows.append(row)
        print(
            "".join(
                f"{row[name]:>13.3f}" if isinstance(row[name], float) else f"{row[name]:>13}"
                for name in names
            ),
            flush=True,
        )
    print(json.dumps({"scene": options.scene, **origin, "rows": rows}))


if __name__ == "__main__":
    main()
