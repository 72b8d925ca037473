"""What short commands take, as multiples of `python -c "import numpy"` on the same machine.

python benchmarks/start_up.py [--repeat 5] [--json start_up.json]

Each command runs in a fresh process, in turn with the import of NumPy, so that other load on the machine affects both.
Medians of wall-clock time and of processor time, and the median of the ratios of processor time.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from provenance import provenance

RENDER = ("render", "gallery", "--frames", "1", "--size", "16x12", "--quality", "draft", "--output", "run")
COMMANDS = {
    "--help": ("--help",),
    "render --help": ("render", "--help"),
    "--version": ("--version",),
    "scenes": ("scenes",),
    "cache info": ("cache", "info", "run/cache/merged.safetensors"),
    "render with other settings": (*RENDER, "--spp", "2"),
}


def spent(words: list[str], folder: Path) -> tuple[float, float]:
    """Wall-clock and processor seconds of a command."""
    before, start = os.times(), time.perf_counter()
    subprocess.run(words, cwd=folder, capture_output=True, check=False)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, cpu


def main() -> None:
    """Print a line for each command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    ours, yardstick = [sys.executable, "-m", "steadylight"], [sys.executable, "-c", "import numpy"]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        subprocess.run([*ours, *RENDER], cwd=home, capture_output=True, check=True)
        for name, words in COMMANDS.items():
            spent([*ours, *words], home)  # the first call reads the files of the modules from the disk
            pairs = [(spent(yardstick, home), spent([*ours, *words], home)) for _ in range(given.repeat)]
            rows.append(
                {
                    "command": name,
                    "seconds": statistics.median(own[0] for _, own in pairs),
                    "seconds_cpu": statistics.median(own[1] for _, own in pairs),
                    "ratio_cpu": statistics.median(own[1] / other[1] for other, own in pairs),
                }
            )
    origin = provenance()
    print(json.dumps(origin))
    print(f"{'command':28} {'s':>6} {'CPU s':>6} {'CPU / import numpy':>19}")
    for row in rows:
        print(f"{row['command']:28} {row['seconds']:6.2f} {row['seconds_cpu']:6.2f} {row['ratio_cpu']:19.1f}")
    if given.json is not None:
        given.json.write_text(json.dumps({**origin, "rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
