"""The paper's longest film on a grid, simulated: 1441 frames of the temple on 200 and 1000 nodes.

    python benchmarks/grid.py RUN [--nodes 200,1000] [--json grid.json]

RUN is a run of `temple-rotation` that was really rendered, of every N-th frame and with the cache in parts, such as

    steadylight render temple-rotation --frames 1-1441:48 --size 1024x768 --quality draft --cache-parts 64 --output RUN

Its task times and file sizes are played through for all 1441 frames (`steadylight plan --simulate` does the same for
one case), with and without barriers between the passes, three times over. The first task of each stage on a worker
compiles kernels, which belongs to the start-up of a node; it is left out. A run has one `prepare` alone, which is done
twice here; the second time counts.

- measured: as they are.
- the paper's image: times and sizes by the ratio of 2048x1536 pixels to those of RUN. That is what samples cost, and
  the most that records can: their number grows with the pixels only where they stand as close as these allow.
- the paper's machines: times so much longer that a frame takes nine minutes of one of them on average, everything
  included (its Table 1).

Nodes come after a minute in the queue on average and need 20 s to start; the store gives 1000 MB a second.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

from provenance import provenance

from steadylight.animation.parsing import parse_size
from steadylight.animation.request import Request, prepare
from steadylight.animation.simulation import Conditions, Measured, read_measured, simulate, with_barriers
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

FRAMES = 1441
PIXELS = 2048 * 1536
MINUTES_A_FRAME = 9.0
CONDITIONS = Conditions(
    nodes=1, queue_wait=60.0, start=20.0, between_failures=1000 * 3600.0, bandwidth=1000e6
)


def scaled(measured: Measured, times: float, sizes: float) -> Measured:
    """The same run, if all had taken so many times as long and been so many times as large."""
    return Measured(
        {key: times * seconds for key, seconds in measured.seconds.items()},
        {stage: [times * each for each in seconds] for stage, seconds in measured.by_stage.items()},
        {name: round(size * (1 if name == "scene" else sizes)) for name, size in measured.sizes.items()},
    )


def warm_prepare(request: Request) -> float:
    """Seconds of `prepare`, scene and kernels loaded."""
    use_variant(resolve_variant("auto"))
    from steadylight.renderers.mitsuba.renderer import Renderer

    settings, scene = request.settings, request.scene
    poses = scene.camera.frame_poses(settings.frames, settings.fps)
    for _ in range(2):
        renderer = Renderer(scene, dict(zip(settings.frames, poses, strict=True)), settings)
        start = time.perf_counter()
        renderer.prepare()
    return time.perf_counter() - start


def main() -> None:
    """Print a row for each case, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--nodes", default="200,1000")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    settings = json.loads((options.run / "run.json").read_text())["settings"]
    width, height = settings["width"], settings["height"]
    request = prepare(
        "temple-rotation",
        frames=FRAMES,
        size=parse_size(f"{width}x{height}"),
        spp=settings["spp"],
        quality=settings["quality"],
        cache_parts=settings["cache_parts"],
    )
    plans = {"barriers": with_barriers(request.tasks), "overlapped": request.tasks}
    measured = read_measured(options.run, {task.stage for task in request.tasks})
    measured = dataclasses.replace(measured, seconds={**measured.seconds, "prepare": warm_prepare(request)})
    print(f"prepare, kernels warm: {measured.seconds['prepare']:.1f} s")
    work = sum(measured.of(task) for task in request.tasks)
    pixels = PIXELS / (width * height)
    cases = {
        "measured": scaled(measured, 1, 1),
        "the paper's image": scaled(measured, pixels, pixels),
        "the paper's machines": scaled(measured, 60 * MINUTES_A_FRAME * FRAMES / work, pixels),
    }
    rows: list[dict[str, Any]] = []
    print(
        f"{'case':22}{'one node':>10}{'nodes':>7}  {'plan':12}{'makespan':>10}{'efficiency':>12}{'GB moved':>10}"
    )
    for case, times in cases.items():
        alone = sum(times.of(task) for task in request.tasks)
        for nodes in map(int, options.nodes.split(",")):
            for plan, tasks in plans.items():
                outcome = simulate(tasks, times, dataclasses.replace(CONDITIONS, nodes=nodes))
                rows.append({"case": case, "nodes": nodes, "plan": plan} | dataclasses.asdict(outcome))
                print(
                    f"{case:22}{alone / 3600:>8.1f} h{nodes:>7}  {plan:12}{outcome.makespan:>8.0f} s"
                    f"{outcome.efficiency:>12.0%}{outcome.bytes_moved / 1e9:>10.1f}",
                    flush=True,
                )
    result = {
        **provenance(),
        "size": f"{width}x{height}",
        "cache_parts": settings["cache_parts"],
        "rows": rows,
    }
    print(json.dumps(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
