"""What a second-pass frame and a gathered path cost beside Mitsuba's own integrators, in one run.

    python benchmarks/frame_cost.py [SCENE] [--size 512x288] [--spp 16] [--repeat 5]

Prints the median seconds of a steady second-pass frame and of Mitsuba's `direct` integrator (same sampler, spp,
size and sensor), and the paths per second of the gather and of Mitsuba's `path` integrator (same bounces), kernels
warm, the two of each pair in turn; then their ratios. After that, where a frame's time goes: what it takes to make
and filter the samples alone, with camera rays and nothing else, with direct light and whatever is followed further,
and with the cache; and how much of the last is spent in kernels.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from provenance import provenance

from steadylight.animation.parsing import parse_size
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.scenes import load_scene
from steadylight.settings import RenderSettings


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="gallery")
    parser.add_argument("--size", default="512x288")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--frame", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    use_variant(resolve_variant("auto"))
    import drjit as dr
    import mitsuba as mi

    from steadylight.cache.records import Records
    from steadylight.renderers.mitsuba.records.gather import Places, gather_records
    from steadylight.renderers.mitsuba.records.radius import Bounds
    from steadylight.renderers.mitsuba.renderer import Renderer

    width, height = parse_size(options.size)
    scene = load_scene(options.scene)
    settings = RenderSettings(
        frames=(options.frame,), width=width, height=height, spp=options.spp, quality="draft", bounces=2
    )
    pose = scene.camera.frame_poses([options.frame], scene.fps)[0]
    renderer = Renderer(scene, {options.frame: pose}, settings)
    cache = filled(renderer, options.frame)
    film = np.random.default_rng(0).random((1000, 2), np.float32)
    points, _ = renderer.view.missed_through(film, renderer.load(Records.empty()), 1)
    filler = renderer.filler
    quality = filler.gather.quality
    # As many for each record.
    quality = dataclasses.replace(quality, refinement_paths=quality.refinement_paths[-1:])
    gathering = dataclasses.replace(filler.gather, quality=quality)

    def frame() -> int:
        renderer.shade(options.frame, cache)
        return width * height * options.spp

    def gather() -> int:
        largest = filler.bounds.at(points.position).largest
        bounds = Bounds(np.full_like(largest, 1e-9), largest)
        gather_records(gathering, Places(points.position, points.normal, bounds), seed=1)
        return len(points.position) * quality.paths_per_record[0]

    def mitsuba(kind: dict[str, Any]) -> Callable[[], int]:
        integrator = mi.load_dict(kind)
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": pose.fov,
                "to_world": mi.ScalarTransform4f(pose.to_world),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "rgb",
                    "rfilter": dict(scene.film),
                },
                "sampler": {"type": "multijitter", "sample_count": options.spp},
            }
        )

        def render() -> int:
            image = mi.render(renderer.view.scene, sensor=sensor, integrator=integrator, spp=options.spp)
            dr.eval(image)
            dr.sync_thread()
            return width * height * options.spp

        return render

    pairs = {
        "frame / direct": (frame, mitsuba({"type": "direct"})),
        "gather / path": (
            gather,
            mitsuba({"type": "path", "max_depth": settings.bounces + 2, "rr_depth": 1000}),
        ),
    }
    results: dict[str, Any] = {
        "scene": options.scene,
        "size": options.size,
        "spp": options.spp,
        "records": len(cache.records),
        **provenance(),
    }
    for name, pair in pairs.items():
        results[name] = compared(name, pair, options.repeat)
    renderer.view.camera.look(pose)
    results["parts"] = frame_parts(renderer.view, cache, options.spp, options.repeat)
    results["kernels"] = frame_kernels(lambda: renderer.shade(options.frame, cache))
    print(json.dumps(results))


def filled(renderer: Any, frame: int) -> Any:
    """The cache of one frame, as the second pass reads it."""
    from steadylight.cache.smoothing import smooth

    records = renderer.first_pass(frame).records
    for number, last in ((1, False), (2, True)):
        found = renderer.audit([frame], renderer.load(records), last=last)
        records = renderer.fill([found.points], records, number)
    return renderer.load(smooth(records))


def compared(name: str, pair: tuple[Callable[[], int], Callable[[], int]], repeat: int) -> dict[str, float]:
    """Print and return the rates of two pieces of work done in turn; each returns how many samples or paths it took."""
    rates: list[list[float]] = [[], []]
    for _ in range(repeat + 1):
        for k, work in enumerate(pair):
            start = time.perf_counter()
            done = work()
            rates[k].append(done / (time.perf_counter() - start))
    a, b = (statistics.median(rate[1:]) for rate in rates)  # the first has compiled the kernels
    print(f"{name:16} {a / 1e6:8.3f} M/s, Mitsuba {b / 1e6:8.3f} M/s: {b / a:.2f} times the time per sample")
    return {"ours_per_second": a, "mitsuba_per_second": b, "rate_ratio": a / b, "time_ratio": b / a}


def frame_parts(view: Any, cache: Any, spp: int, repeat: int) -> dict[str, float]:
    """Print and return median seconds of a frame of which more and more is done, the variants in turn."""
    import drjit as dr
    import mitsuba as mi

    from steadylight.renderers.mitsuba.image.picture import Sampled, render_layers
    from steadylight.renderers.mitsuba.image.pixels import Look, Sampling

    rfilter = view.camera.sensor.film().rfilter()

    def nothing(_samples: Any, ray: Any) -> Sampled:
        return Sampled((mi.Color3f(ray.d),), mi.UInt32(0))

    def camera_rays(_samples: Any, ray: Any) -> Sampled:
        hit = view.scene.ray_intersect_preliminary(ray, coherent=True)
        return Sampled((mi.Color3f(dr.select(hit.is_valid(), hit.t, 0)),), mi.UInt32(0))

    def lit(known: Any) -> Callable[[Any, Any], Sampled]:
        def seen(samples: Any, ray: Any) -> Sampled:
            shade = view.shade(samples, ray, known)
            return Sampled((shade.radiance + shade.direct,), shade.missed)

        return seen

    stages = {
        name: (Look(view.camera, seen, lambda known=known: view.arrays(known)), known)
        for name, seen, known in (
            ("samples", nothing, None),
            ("camera rays", camera_rays, None),
            ("direct light, gloss", lit(None), None),
            ("the cache", lit(cache), cache),
        )
    }
    seconds: dict[str, list[float]] = {name: [] for name in stages}
    for _ in range(repeat + 1):
        for name, (look, known) in stages.items():
            view.lighting(known)  # not part of a frame, but of loading the cache
            start = time.perf_counter()
            render_layers(look, [rfilter], Sampling(spp, 0))
            seconds[name].append(time.perf_counter() - start)
    medians = {name: statistics.median(values[1:]) for name, values in seconds.items()}
    before = 0.0
    for name, median in medians.items():
        print(f"{name:24} {1e3 * median:8.0f} ms, {1e3 * (median - before):+8.0f}")
        before = median
    return medians


def frame_kernels(frame: Callable[[], Any]) -> dict[str, float]:
    """Print and return what Dr.Jit ran for a steady frame."""
    import drjit as dr

    frame()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        frame()
        history = dr.kernel_history([dr.KernelType.JIT])
    times = [kernel["execution_time"] for kernel in history]
    found = {
        "count": len(history),
        "compiled": sum(not kernel["cache_hit"] for kernel in history),
        "milliseconds": sum(times),
        "largest": max(times),
    }
    print(
        f"one frame: {found['count']} kernels, {found['compiled']} of them compiled; "
        f"{found['milliseconds']:.0f} ms in kernels, {found['largest']:.0f} in the largest"
    )
    return found


if __name__ == "__main__":
    main()
