"""This version beside another one: error and time of the same animations, rendered in turn.

    git worktree add ../before COMMIT
    python benchmarks/versions.py ../before [--scenes gallery corridor] [--frames 1-12] [--size 256x144]
                                  [--spp 16] [--bounces 2] [--reference-spp 1024] [--output runs/versions]
                                  [--for-this="--spp 8"] [--json versions.json]

A scene is a bundled name, or `FILE,CAMERA` for a scene file and its camera. Both versions render every animation from
nothing with this Python, each by the command that a user would give. Errors are those of accuracy.py against two path
references of other seeds, at the frames that the references have (the middle one and the last). Times are seconds of
CPU, summed over all threads, from the journals: `cache` is all that comes before the second pass; `frame` is the median
of the second pass, without the first frame of each worker, which compiles kernels. `overshoot` is flicker without the
trend that the camera makes (docs/conventions.md), the mean over 8 x 8 regions of the film; it needs consecutive frames.
Runs that are there already are gone on with, so that a second call prints the table again. With other settings
for this version alone (`--for-this`), times can be compared at equal error.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import measure
from provenance import provenance

from steadylight.animation.parsing import parse_frames
from steadylight.images import read_exr
from steadylight.metrics.blocks import Grid
from steadylight.metrics.temporal import normalised, overshoot

HERE = Path(__file__).resolve().parent.parent
SEEDS = (11, 12)


def main() -> None:
    """Render what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", type=Path, help="a checkout of the other version")
    parser.add_argument("--scenes", nargs="+", default=["gallery"])
    parser.add_argument("--frames", default="1-12")
    parser.add_argument("--size", default="256x144")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--bounces", type=int, default=2, help="older versions know no other default")
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--output", type=Path, default=Path("runs/versions"))
    parser.add_argument("--for-this", default="", help="further options of this version's command")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    origin = provenance()
    checkouts = {"before": options.other.resolve(), "after": HERE}
    rows = []
    print(
        f"{'scene':14} {'version':8} {'rel_rmse':>9} {'rel_bias':>9} {'overshoot':>9} {'CPU s':>8} {'cache':>8} "
        f"{'frame':>7} {'records':>9} {'missed':>7}"
    )
    for scene in options.scenes:
        row = {"scene": scene} | compare(scene, options, checkouts)
        rows.append(row)
        show(row)
    result = {"rows": rows, **origin}
    print(json.dumps(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


def compare(scene: str, options: argparse.Namespace, checkouts: dict[str, Path]) -> dict[str, Any]:
    """Both versions of one animation, in turn."""
    numbers = parse_frames(options.frames)
    compared = sorted({numbers[len(numbers) // 2], numbers[-1]})
    source = Path(scene.partition(",")[0])
    folder = options.output / source.parent.name / source.stem
    both = ["--size", options.size, "--bounces", str(options.bounces)]
    animation = [*both, "--frames", options.frames, "--spp", str(options.spp)]
    runs = {name: folder / name for name in checkouts}
    further = {"before": [], "after": shlex.split(options.for_this)}
    for name, checkout in checkouts.items():
        render(checkout, scene, [*animation, *further[name], "--output", str(runs[name])])
    truth = [*both, "--mode", "path", "--frames", ",".join(map(str, compared))]
    truth += ["--spp", str(options.reference_spp)]
    references = [folder / f"reference-{seed}" for seed in SEEDS]
    for seed, reference in zip(SEEDS, references, strict=True):
        render(HERE, scene, [*truth, "--seed", str(seed), "--output", str(reference)])
    return {name: figures(run, references, compared) for name, run in runs.items()}


def render(checkout: Path, scene: str, options: list[str]) -> None:
    """One run by the command of a checkout; goes on with what is there."""
    source, _, camera = scene.partition(",")
    command = [sys.executable, "-m", "steadylight", "render", source, *options]
    command += ["--camera", camera] if camera else []
    environment = os.environ | {"PYTHONPATH": str(checkout / "src")}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)


def tasks_done(run: Path) -> list[dict[str, Any]]:
    """Lines of the journal about tasks that were done."""
    lines = [json.loads(line) for line in (run / "log/tasks.jsonl").read_text().splitlines()]
    return [line for line in lines if line["outcome"] == "done"]


def frame_cpu(shades: list[dict[str, Any]]) -> float:
    """CPU seconds of a frame: the median, without the first frame of each worker, which compiles kernels."""
    first = {line["worker"]: line["task"] for line in reversed(shades)}.values()
    return float(np.median([line["seconds_cpu"] for line in shades if line["task"] not in first]))


def figures(run: Path, references: list[Path], frames: list[int]) -> dict[str, float]:
    """Errors and times of a run."""
    errors = [
        measure(*(read_exr(each / "frames" / f"frame_{n:05d}.exr") for each in (run, *references)))
        for n in frames
    ]
    done = tasks_done(run)
    shades = [line for line in done if line["stage"] == "shade"]
    statistics = json.loads((run / "stats.json").read_text())
    made = statistics["first_pass"]["records"] + statistics.get("coverage", {}).get("records", 0)
    return {
        "rel_rmse": float(np.mean([error["rel_rmse"] for error in errors])),
        "rel_bias": float(np.mean([error["rel_bias"] for error in errors])),
        "overshoot": flicker(
            [run / "frames" / f"{line['task'].replace('shade-', 'frame_')}.exr" for line in shades]
        ),
        "seconds_cpu": sum(line["seconds_cpu"] for line in done),
        "cache_cpu": sum(line["seconds_cpu"] for line in done if line["stage"] != "shade"),
        "frame_cpu": frame_cpu(shades),
        "records": made,
        "missed": statistics["second_pass"]["missed"] + statistics["second_pass"]["new_records"],
    }


def flicker(frames: list[Path]) -> float:
    """Overshoot of a film, mean over 8 x 8 regions."""
    images = [read_exr(path) for path in sorted(frames)]
    height, width = images[0].shape[:2]
    regions = Grid.of(width, height, 64)
    series = np.reshape([regions.sums(image) for image in images], (len(images), -1))
    return float(np.mean([overshoot(normalised(each)) for each in series.T]))


def show(row: dict[str, Any]) -> None:
    """Two lines of the table, and the ratios of times."""
    name = Path(row["scene"].partition(",")[0])
    label = name.parent.name if name.suffix else str(name)
    for version in ("before", "after"):
        f = row[version]
        print(
            f"{label:14} {version:8} {100 * f['rel_rmse']:8.2f}% {100 * f['rel_bias']:+8.2f}% "
            f"{f['overshoot']:9.5f} {f['seconds_cpu']:8.1f} {f['cache_cpu']:8.1f} "
            f"{f['frame_cpu']:7.2f} {f['records']:9,} {f['missed']:7}"
        )
    before, after = row["before"], row["after"]
    names = ("overshoot", "seconds_cpu", "cache_cpu", "frame_cpu", "records")
    flickers, *times, records = (after[name] / before[name] for name in names)
    print(
        f"{'':14} {'ratio':8} {'':19} {flickers:9.2f} {times[0]:8.2f} {times[1]:8.2f} {times[2]:7.2f} {records:9.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
