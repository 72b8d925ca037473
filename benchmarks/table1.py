"""The paper's Table 1 with the bundled animations: makespan of two-pass and single-pass, and the speed-up.

    python benchmarks/table1.py [--scenes temple-walk] [--frames 1-91] [--size 512x384] [--quality draft]
                                [--every 1] [--renderer radiance] [--output runs/table1] [--json table1.json]

Renders each animation twice, by the command that a user would give. Runs that are there already, finished or not, are
gone on with. Without options, a short version: 24 frames, 128x96. `--full`: the four animations, all their frames,
512x384; it takes hours. With `--renderer radiance`, the paper's kind of renderer, the short version has 6
frames, 64x48.

Frames of a single-pass film have nothing to do with each other, so `--every N` renders each N-th only and multiplies:
the makespan is then an estimate, and is marked so.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

from provenance import provenance

from steadylight.animation.parsing import parse_frames
from steadylight.scenes import load_scene

SCENES = ("temple-walk", "temple-rotation", "gallery", "corridor")


class Options(NamedTuple):
    """What the runs have in common."""

    size: str
    quality: str
    renderer: str
    output: Path


def main() -> None:
    """Render what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["temple-walk"])
    parser.add_argument(
        "--frames", help="of each animation; the first 24 (6 of radiance) if not given, all with --full"
    )
    parser.add_argument("--size", help="128x96 (64x48 of radiance) if not given, 512x384 with --full")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--renderer", default="mitsuba", choices=["mitsuba", "radiance"])
    parser.add_argument("--every", type=int, default=1, metavar="N", help="single-pass: each N-th frame only")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--output", type=Path, default=Path("runs/table1"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    slow = options.renderer == "radiance"
    size = options.size or ("512x384" if options.full else "64x48" if slow else "128x96")
    short = "1-6" if slow else "1-24"
    # Asked for first: what cannot be told must not show after hours.
    origin = provenance()
    rows = []
    print(
        f"{'scene':16} {'mode':12} {'frames':>6} {'first_pass':>10} {'merge':>7} {'coverage':>8} {'second_pass':>11} "
        f"{'frame':>7} {'makespan':>9} {'speed-up':>8}"
    )
    for scene in SCENES if options.full else options.scenes:
        frames = options.frames or (f"1-{load_scene(scene).frames}" if options.full else short)
        row = measure(
            scene, frames, options.every, Options(size, options.quality, options.renderer, options.output)
        )
        rows.append(row)
        show(scene, row)
    result = {
        "size": size,
        "quality": options.quality,
        "renderer": options.renderer,
        **origin,
        "rows": rows,
    }
    print(json.dumps(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


def measure(scene: str, frames: str, every: int, options: Options) -> dict[str, Any]:
    """Both modes of one animation."""
    numbers = parse_frames(frames)
    sampled = numbers[::every]
    two = render(scene, numbers, "two-pass", options)
    single = render(scene, sampled, "single-pass", options)
    scale = len(numbers) / len(sampled)
    return {
        "scene": scene,
        "frames": len(numbers),
        "two-pass": times(two),
        "single-pass": times(single),
        "single-pass frames": len(sampled),
        "speed-up": scale * single["makespan_s"] / two["makespan_s"],
    }


def render(scene: str, frames: tuple[int, ...], mode: str, options: Options) -> dict[str, Any]:
    """The statistics of a run of that mode."""
    listed = ",".join(map(str, frames))
    size, quality, renderer, output = options
    folder = output / f"{renderer}-{scene}-{size}-{quality}-{mode}-{frames[0]}-{frames[-1]}-{len(frames)}"
    command = [sys.executable, "-m", "steadylight", "render", scene, "--frames", listed, "--size", size]
    command += ["--renderer", renderer, "--quality", quality, "--mode", mode, "--output", str(folder)]
    if mode == "two-pass":
        command += ["--first-pass", "frames"]  # as in the paper
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    statistics: dict[str, Any] = json.loads((folder / "stats.json").read_text())
    return statistics


def times(statistics: dict[str, Any]) -> dict[str, float]:
    """Seconds of each part of a run; a frame's without what comes before it."""
    parts = {
        name: statistics.get(name, {}).get("seconds", 0.0) for name in ("first_pass", "merge", "coverage")
    }
    second = statistics["second_pass"]
    frame = sum(second["frame_seconds"]) / len(second["frame_seconds"])
    return parts | {
        "second_pass": second["seconds"],
        "frame": frame,
        "makespan": statistics["makespan_s"],
    }


def show(scene: str, row: dict[str, Any]) -> None:
    """Two lines of the table."""
    for mode in ("two-pass", "single-pass"):
        t = row[mode]
        frames = row["frames"] if mode == "two-pass" else row["single-pass frames"]
        print(
            f"{scene:16} {mode:12} {frames:6} {t['first_pass']:10.1f} {t['merge']:7.1f} {t['coverage']:8.1f} "
            f"{t['second_pass']:11.1f} {t['frame']:7.2f} {t['makespan']:9.1f} "
            + (f"{row['speed-up']:8.2f}" if mode == "two-pass" else "")
        )
    if row["single-pass frames"] < row["frames"]:
        print(
            f"{'':16} Estimated: {row['single-pass frames']} of {row['frames']} single-pass frames were rendered "
            "and their makespan was multiplied."
        )


if __name__ == "__main__":
    main()
