"""What a task costs besides its work: no-op tasks through each engine, milliseconds a task.

python benchmarks/task_overhead.py --tasks 2000 --workers 2
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Mapping
from typing import Any

from provenance import provenance

from steadylight.engines import Task, make_engine
from steadylight.settings import ExecutionSettings


def no_op(_: Task) -> Mapping[str, Any]:
    """Do nothing."""
    return {}


def measure(cluster: str, workers: int, count: int) -> float:
    """Milliseconds a task, after a warm-up that has started the workers."""
    tasks = [Task(key=f"none-{number:05d}", stage="none", outputs=()) for number in range(count)]
    with make_engine(ExecutionSettings(cluster=cluster, workers=workers)) as engine:
        list(engine.run(tasks[:200], no_op))
        start = time.perf_counter()
        done = sum(attempt.outcome == "done" for attempt in engine.run(tasks, no_op))
        seconds = time.perf_counter() - start
    if done != count:
        raise SystemExit(f"{done} of {count} tasks were done")
    return 1000 * seconds / count


def main() -> None:
    """Print a line for each engine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    print(json.dumps(provenance()))
    for cluster, workers in (("in-process", 1), ("local", 1), ("local", given.workers)):
        times = [measure(cluster, workers, given.tasks) for _ in range(given.repeat)]
        print(
            f"{cluster}, {workers} worker(s): {statistics.median(times):.2f} ms a task "
            f"(median of {given.repeat} runs of {given.tasks} tasks, {min(times):.2f} to {max(times):.2f})"
        )


if __name__ == "__main__":
    main()
