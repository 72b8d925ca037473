"""How well a run foretold how long it would take: replays finished runs, task by task.

    python benchmarks/time_left.py RUN [RUN ...] [--json FILE]

For each run that one session rendered: what `render` said of the whole run, over what it took, by the part of the run
that was over. The video and the report, which come after the last task, are left out.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from provenance import provenance

from steadylight.animation.cache_tasks import Files, make_task
from steadylight.animation.provenance import read_run
from steadylight.animation.time_left import TimeLeft
from steadylight.storage import RunDirectory


class Said(NamedTuple):
    """What was foretold when a task was done."""

    over: float  # part of the run that was over, by the clock
    ratio: float  # whole run as foretold, over what it took


def replay(root: Path) -> tuple[float, list[Said]]:
    """Seconds of a run, and what it foretold after each of its tasks, once it did."""
    lines = (root / "log/tasks.jsonl").read_text().splitlines()
    attempts = [entry for entry in map(json.loads, lines) if entry["outcome"] == "done"]
    tasks = [make_task(entry["stage"], str(n), Files(), "") for n, entry in enumerate(attempts)]
    estimate = TimeLeft(tasks, read_run(RunDirectory(root)).settings)
    left, workers = Counter(task.stage for task in tasks), set[str]()
    start = attempts[0]["time"] - attempts[0]["seconds"]
    whole = attempts[-1]["time"] - start
    said = []
    for entry in attempts:
        estimate.add(entry["stage"], entry["seconds"], entry["worker"])
        left[entry["stage"]] -= 1
        workers.add(entry["worker"])
        seconds, over = estimate.seconds(left, len(workers)), entry["time"] - start
        if seconds is not None:
            said.append(Said(over / whole, (over + seconds) / whole))
    return whole, said


def main() -> None:
    """Print a line for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = {}
    for root in given.runs:
        whole, said = replay(root)
        ratios = [one.ratio for one in said]
        print(
            f"{root.name}: {whole:.0f} s; after {said[0].over:.0%} of it {ratios[0]:.2f} times that,"
            f" from then on {min(ratios):.2f} to {max(ratios):.2f} times"
        )
        found[str(root)] = {"seconds": whole, "said": [one._asdict() for one in said]}
    if given.json:
        given.json.write_text(json.dumps({"provenance": provenance(), "runs": found}, indent=1))


if __name__ == "__main__":
    main()
