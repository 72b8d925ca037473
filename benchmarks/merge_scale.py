"""The merge of many caches: plain in one process, and in parts by worker processes; time and memory, same bytes.

python benchmarks/merge_scale.py --caches 64 --records 100000 --parts 8 --workers 2
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from provenance import provenance

from steadylight.cache.file import CacheFile, encode_cache, read_cache
from steadylight.cache.merge import merge_caches
from steadylight.cache.partition import Partition, concatenate_parts, divide_space, merge_part
from steadylight.cache.records import Records
from steadylight.engines import Task
from steadylight.engines.dask_cluster import DaskCluster

HASH = "0" * 64


def make_cache(path: Path, number: int, records: int, density: float) -> None:
    """Records on the walls of a hall, as a selected frame would leave them: every cache sees the same walls."""
    random = np.random.default_rng(number)
    side = np.sqrt(records / density)
    position = random.uniform((0, 0, 0), (side, side, 4), (records, 3)).astype(np.float32)
    position[:, 2] = 4 * np.round(position[:, 2] / 4)
    normal = np.zeros((records, 3), np.float32)
    normal[:, 2] = 1 - position[:, 2] / 2
    values = {name: random.random((records, *shape), np.float32) for name, shape in Records.SHAPES.items()}
    radius = random.uniform(0.1, 0.4, records).astype(np.float32)
    cache = Records(**{**values, "position": position, "normal": normal, "radius": radius})
    path.write_bytes(encode_cache(CacheFile(cache, HASH, {})))


def caches_in(folder: Path) -> list[Records]:
    """All caches of the benchmark."""
    return [read_cache(path, scene_hash=HASH).records for path in sorted(folder.glob("gather_*.safetensors"))]


def peak() -> float:
    """Largest resident memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def work(task: Task, folder: str) -> Mapping[str, Any]:
    """A part, or all parts in one."""
    root = Path(folder)
    if task.stage == "merge":
        partition = Partition.from_plain(task.arguments["partition"])
        kept = merge_part(caches_in(root), partition, task.arguments["part"])
        (root / task.outputs[0]).write_bytes(encode_cache(CacheFile(kept, HASH, {})))
        return {"kept": len(kept), "peak_gb": peak()}
    parts = [read_cache(root / f"{need}.part", scene_hash=HASH).records for need in task.needs]
    merged = encode_cache(CacheFile(concatenate_parts(parts), HASH, {}))
    return {"sha256": hashlib.sha256(merged).hexdigest(), "peak_gb": peak()}


def plain(folder: str) -> tuple[float, float, str, int]:
    """Seconds, GB, hash and number of records of the plain merge."""
    start = time.perf_counter()
    merged = merge_caches(caches_in(Path(folder)))
    content = encode_cache(CacheFile(merged, HASH, {}))
    seconds = time.perf_counter() - start
    return seconds, peak(), hashlib.sha256(content).hexdigest(), len(merged)


def distributed(folder: Path, count: int, workers: int) -> tuple[float, float, str]:
    """Seconds, GB of the largest worker, and hash."""
    with DaskCluster(workers=workers) as engine:
        list(engine.run([Task("warm-1", "warm", ())], dict_of_nothing))
        start = time.perf_counter()
        caches = caches_in(folder)
        longest = max(float(cache.radius.max()) for cache in caches)
        positions = [cache.position for cache in caches]
        del caches
        everything = np.concatenate(positions)
        bounds = np.stack([everything.min(axis=0), everything.max(axis=0)])
        partition = divide_space(positions, count, longest, bounds).plain()
        del positions, everything
        tasks = [
            Task(
                f"merge-{i:03d}",
                "merge",
                (f"merge-{i:03d}.part",),
                arguments={"partition": partition, "part": i},
            )
            for i in range(count)
        ]
        whole = Task("concatenate-1", "concatenate", (), needs=tuple(task.key for task in tasks))
        attempts = list(engine.run([*tasks, whole], functools.partial(work, folder=str(folder))))
        seconds = time.perf_counter() - start
    results = [attempt.result for attempt in attempts]
    digest = next(result["sha256"] for result in results if "sha256" in result)
    return seconds, max(result["peak_gb"] for result in results), digest


def dict_of_nothing(_: Task) -> Mapping[str, Any]:
    """Let the worker load its modules."""
    return {}


def main() -> None:
    """Print both, and whether they agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--caches", type=int, default=64)
    parser.add_argument("--records", type=int, default=100_000)
    parser.add_argument("--parts", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--density", type=float, default=60.0, help="records of a cache per square metre")
    given = parser.parse_args()
    print(json.dumps(provenance()))
    print(f"{given.caches} caches of {given.records} records")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(given.caches):
            make_cache(folder / f"gather_{number:05d}.safetensors", number, given.records, given.density)
        # In a process of its own, so that its memory is its own.
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            seconds, memory, digest, kept = pool.apply(plain, (name,))
        print(f"plain: {seconds:.1f} s, {memory:.2f} GB, {kept} records kept")
        seconds, memory, other = distributed(folder, given.parts, given.workers)
        print(
            f"{given.parts} parts, {given.workers} workers: {seconds:.1f} s, {memory:.2f} GB in the largest worker"
        )
        print("the same bytes" if digest == other else "THE BYTES DIFFER")
        raise SystemExit(digest != other)


if __name__ == "__main__":
    main()
