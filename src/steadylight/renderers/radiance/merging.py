"""Merging records of many frames into one cache, independent of their order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from steadylight.renderers.radiance.ambient import Records, concatenated, directions, numbers, positions
from steadylight.renderers.radiance.quality import REDUNDANT

_SAME_SIDE = 0.966
"""Cosine of the angle between normals, 15 degrees, up to which one record may replace another."""


def united(parts: Sequence[Records]) -> Records:
    """All records without duplicates, in canonical order, which is that of their bytes."""
    together = concatenated(parts)
    raw = np.unique(together.view(f"V{together.dtype.itemsize}"))
    return raw.view(together.dtype)


def thinned(records: Records, accuracy: float) -> Records:
    """Remove records that a better one can replace.

    Better means a larger weight (it was made with more rays), then a smaller radius. A record is removed if a better
    one of the same level faces the same way and lies within a fraction of the reach of both.

    Args:
        records: in any order.
        accuracy: `-aa`; a record reaches this times its radius.

    Returns:
        The remaining records, in canonical order.
    """
    records = united([records])
    kept = np.ones(len(records), bool)
    for level in np.unique(records["level"]):
        own = np.flatnonzero(records["level"] == level)
        kept[own] = _kept(records[own], accuracy)
    return records[kept]


def _kept(records: Records, accuracy: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which records of one level are kept, (N,)."""
    from scipy.spatial import cKDTree  # importing it takes longer than `cache info`

    place, normal = positions(records), directions(records["normal"])
    near = REDUNDANT * accuracy * numbers(records["radius"])[:, 0]
    order = np.lexsort((np.arange(len(records)), near, -numbers(records["weight"])))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    neighbours = cKDTree(place).query_ball_point(place, near)
    kept = np.ones(len(records), bool)
    for i in order:
        better = [j for j in neighbours[i] if rank[j] < rank[i] and kept[j]]
        if better:
            distance = np.linalg.norm(place[better] - place[i], axis=1)
            alike = (distance < np.minimum(near[better], near[i])) & (normal[better] @ normal[i] > _SAME_SIDE)
            kept[i] = not alike.any()
    return kept
