"""What the pages of long runs take: time to make them, their size, and what following a run costs.

    steadylight render temple-rotation --size 96x54 --quality draft --spp 4 --frames 1-1441 --output RUN
    python benchmarks/pages.py RUN OTHER [--repeat 3] [--json pages.json]

The report is that of RUN; the comparison page is of RUN and OTHER, without their videos, which it shows from where they
are. Following is what the live page does every two seconds: one look at the run directory, and the answer to a browser
that knows all attempts so far. Wall-clock and processor seconds, medians.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

from provenance import provenance

from steadylight.live.state import RunState, as_text

INTERVAL = 2.0
"""Seconds between two looks of the live page."""


def spent(work: Callable[[], Any], repeat: int) -> tuple[float, float]:
    """Median wall-clock and processor seconds of some work, child processes included."""
    both = []
    for _ in range(repeat):
        before, start = _seconds_cpu(), time.perf_counter()
        work()
        both.append((time.perf_counter() - start, _seconds_cpu() - before))
    return statistics.median(wall for wall, _ in both), statistics.median(cpu for _, cpu in both)


def _seconds_cpu() -> float:
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


def main() -> None:
    """Print a line for each page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    command = [sys.executable, "-m", "steadylight"]
    rows: list[dict[str, Any]] = []

    def row(name: str, times: tuple[float, float], size: int | None = None) -> None:
        rows.append({"page": name, "seconds": times[0], "seconds_cpu": times[1], "bytes": size})
        told = "" if size is None else f"{size / 1e6:8.1f} MB"
        print(f"{name:12} {times[0]:9.3f} s {times[1]:9.3f} CPU s {told}", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "compare.html"
        report = [*command, "report", str(given.run)]
        compare = [*command, "compare", str(given.run), str(given.other), "--html", "--output", str(page)]
        for name, words, file in (
            ("report", report, given.run / "report.html"),
            ("comparison", compare, page),
        ):
            times = spent(
                lambda words=words: subprocess.run(words, check=True, capture_output=True), given.repeat
            )
            row(name, times, file.stat().st_size)
        state = RunState(given.run)
        row("live, opened", spent(state.look, 1), len(as_text(state.plain())))
        known = int(state.plain()["count"])

        def follow() -> None:
            state.look()
            as_text(state.plain(known))

        times = spent(follow, 20)
        row("live, after", times)
    print(f"The live page takes {100 * times[1] / INTERVAL:.2f} % of a core.")
    result = {"rows": rows, "share_of_core": times[1] / INTERVAL, **provenance()}
    print(json.dumps(result))
    if given.json:
        given.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
