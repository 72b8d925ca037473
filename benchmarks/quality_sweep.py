"""Error and time over five qualities: more must cost more and err less, at every step.

    python benchmarks/quality_sweep.py [SCENE ...] [--qualities 0.25,0.5,1,2,4] [--output runs/quality] [--full]

Renders each scene at each quality, and two references of mode `path` that differ in their seed, by the command that a
user would give. Runs that are there already, finished or not, are gone on with. Columns: records of the merged and
filled cache; rel_rmse without the noise of the references, and rel_bias (see accuracy.py); CPU seconds of all tasks, of
the first pass and what comes between the passes, and of the second pass, each from the run's journal. The last line of
a scene says whether error falls and CPU time grows at every step.

Without options, a short version: two scenes, 2 frames, 128x72. `--full`: 6 frames, 512x288.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from accuracy import measure
from provenance import provenance

from steadylight.images import read_exr

SCENES = ("gallery", "temple-walk")
FIRST = ("gather", "merge", "audit", "fill", "smooth", "concatenate")
"""Stages before the second pass."""


class Size(NamedTuple):
    """How much is rendered."""

    frames: int
    size: str
    spp: int
    reference_spp: int


SHORT = Size(2, "128x72", 16, 1024)
FULL = Size(6, "512x288", 16, 4096)


def main() -> None:
    """Print a table for each scene, and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", help=f"{' and '.join(SCENES)} if none is named")
    parser.add_argument("--qualities", default="0.25,0.5,1,2,4")
    parser.add_argument("--output", type=Path, default=Path("runs/quality"))
    parser.add_argument("--full", action="store_true")
    options = parser.parse_args()
    chosen = FULL if options.full else SHORT
    qualities = [float(value) for value in options.qualities.split(",")]
    origin = provenance()  # before hours have passed, and commits with them
    found = {}
    names = ("records", "rel_rmse", "rel_bias", "cpu_s", "first_cpu_s", "second_cpu_s")
    for scene in options.scenes or SCENES:
        print(f"{scene}\n{'quality':>10}" + "".join(f"{name:>14}" for name in names), flush=True)
        references = [
            render(options.output, scene, chosen, mode="path", seed=seed, spp=chosen.reference_spp)
            for seed in (1001, 1002)
        ]
        rows = []
        for quality in qualities:
            run = render(options.output, scene, chosen, quality=quality)
            rows.append({"quality": quality, **errors(run, references), **costs(run)})
            print(f"{quality:10g}" + "".join(f"{rows[-1][name]:14.5g}" for name in names), flush=True)
        falls = all(a["rel_rmse"] > b["rel_rmse"] for a, b in pairwise(rows))
        grows = all(a["cpu_s"] < b["cpu_s"] for a, b in pairwise(rows))
        print(
            f"error {'falls' if falls else 'DOES NOT FALL'} and CPU time {'grows' if grows else 'DOES NOT GROW'}"
        )
        found[scene] = {"rows": rows, "monotone": falls and grows}
    print(json.dumps({**origin, **chosen._asdict(), "scenes": found}))


def render(output: Path, scene: str, size: Size, **settings: Any) -> Path:
    """The run directory of a run with these settings; with their own if they do not say."""
    settings = {"spp": size.spp, **settings}
    name = "-".join(f"{key}{value}" for key, value in settings.items())
    folder = output / f"{scene}-{size.frames}x{size.size}-{name}"
    command = [sys.executable, "-m", "steadylight", "render", scene]
    settings = {"frames": size.frames, "size": size.size, "output": folder, **settings}
    command += [f"--{key}={value}" for key, value in settings.items()]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def errors(run: Path, references: list[Path]) -> dict[str, float]:
    """Mean errors over the frames."""
    rows = []
    for path in sorted((run / "frames").glob("frame_*.exr")):
        a, b = (read_exr(reference / "frames" / path.name) for reference in references)
        rows.append(measure(read_exr(path), a, b))
    return {name: float(np.mean([row[name] for row in rows])) for name in ("rel_rmse", "rel_bias")}


def costs(run: Path) -> dict[str, float]:
    """Records of the cache, and CPU seconds of attempts by pass."""
    statistics = json.loads((run / "stats.json").read_text())
    attempts = [json.loads(line) for line in (run / "log" / "tasks.jsonl").read_text().splitlines()]
    first = sum(each["seconds_cpu"] for each in attempts if each["stage"] in FIRST)
    second = sum(each["seconds_cpu"] for each in attempts if each["stage"] == "shade")
    records = statistics["merge"]["records_out"] + statistics["coverage"]["records"]
    return {
        "records": records,
        "cpu_s": first + second,
        "first_cpu_s": first,
        "second_cpu_s": second,
    }


if __name__ == "__main__":
    main()
