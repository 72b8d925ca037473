"""Random records and query points that meet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.records import Records


def unit(vectors: Any) -> np.ndarray:
    vectors = np.asarray(vectors, np.float64)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def make_records(
    seed: int, count: int, *, radius: tuple[float, float] = (0.05, 0.8), values: int = 1
) -> Records:
    """Records all through the unit cube, with normals near the axes as in rooms; the radius is log-uniform."""
    rng = np.random.default_rng(seed)
    axes = np.concatenate([np.eye(3), -np.eye(3)])[rng.integers(6, size=count)]
    lowest, highest = np.log(radius)
    return Records.undivided(
        position=rng.random((count, 3), np.float32),
        normal=unit(axes + 0.15 * rng.standard_normal((count, 3))),
        irradiance=rng.random((count, values, 3), np.float32) + 0.5,
        translation=rng.standard_normal((count, values, 3, 3)).astype(np.float32) * 0.2,
        rotation=rng.standard_normal((count, values, 3, 3)).astype(np.float32) * 0.2,
        curvature=rng.uniform(-1, 1, (count, values)).astype(np.float32),
        radius=np.exp(rng.uniform(lowest, highest, count)).astype(np.float32),
        standard_error=0.1 * rng.random((count, values), np.float32),
    )


def make_queries(seed: int, records: Records, each: int) -> tuple[np.ndarray, np.ndarray]:
    """`each` points about every record, to twice its radius, and normals to beyond its tolerance."""
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.arange(len(records)), each)
    n = records.normal[rows]
    away = unit(rng.standard_normal((len(rows), 3))) * rng.random((len(rows), 1), np.float32) * 2
    normal = unit(n + 0.3 * rng.random((len(rows), 1)) * rng.standard_normal((len(rows), 3)))
    # Most ellipsoids are missed by points all round, and most lie a step away; half of the offsets are those to points
    # of the same evenly curved surface.
    mean = unit(n + normal)
    even = away - np.einsum("qi,qi->q", away, mean)[:, None] * mean
    away = np.where(rng.random((len(rows), 1)) < 0.5, even, away).astype(np.float32)
    return records.position[rows] + away * records.radius[rows, None], normal


@pytest.fixture(scope="session")
def records_of() -> Any:
    return make_records


@pytest.fixture(scope="session")
def queries_about() -> Any:
    return make_queries
