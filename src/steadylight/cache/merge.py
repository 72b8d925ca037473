"""Caches of many frames become one: put in a fixed order, without duplicates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steadylight.cache.lookup import NORMAL_TOLERANCE
from steadylight.cache.octree import spread_bits
from steadylight.cache.records import Records

REDUNDANT = 0.35
"""Of two compatible records nearer than this fraction of both radii, one is dropped."""


def merge_caches(caches: Sequence[Records]) -> Records:
    """One cache from many, the same bytes in whatever order the caches come.

    The paper only unites the caches. Frames that see the same wall leave records side by side there, which make
    every look-up slower and answer no new point, so we drop those that a kept one stands in for.

    Args:
        caches: records of the selected frames.

    Returns:
        Kept records, in Morton order.
    """
    records = Records.joined(*caches)
    records = records.take(canonical_order(records))
    return records.take(np.flatnonzero(~redundant(records)))


def canonical_order(records: Records) -> NDArray[np.intp]:
    """Rows by Morton code, ties by every component: neighbours in space are neighbours in memory."""
    if len(records) == 0:
        return np.zeros(0, np.intp)
    # A fixed grid, not the bounding box: adding a record must not reorder the others.
    cell = np.floor(records.position.astype(np.float64) * 1024).astype(np.int64) + (1 << 20)
    code = sum(spread_bits(cell[:, axis]) << np.uint64(axis) for axis in range(3))
    columns = [
        records.standard_error[:, None],
        records.curvature[:, None],
        records.rotation.reshape(-1, 9),
        records.translation.reshape(-1, 9),
        records.irradiance,
        records.normal,
        records.position,
    ]
    ties = [component for column in columns for component in column.T]
    return np.lexsort([records.radius, *ties, code])


def redundant(records: Records) -> NDArray[np.bool_]:
    """Which records another, kept one stands in for.

    Records are visited from small to large reach, so the more detailed survive; a record is dropped when a kept,
    compatible record of comparable radius lies within `REDUNDANT` of the smaller radius.

    Args:
        records: R records in canonical order.

    Returns:
        (R,) True for those to drop.
    """
    drop = np.zeros(len(records), bool)
    if len(records) == 0:
        return drop
    p, n, radius = records.position, records.normal, records.radius
    tree = cKDTree(p)
    rank = np.empty(len(records), np.intp)
    order = np.argsort(radius, kind="stable")
    rank[order] = np.arange(len(records))
    for i in order:
        if drop[i]:
            continue
        near = np.array(tree.query_ball_point(p[i], REDUNDANT * radius[i]), np.intp)
        near = near[(rank[near] > rank[i]) & (radius[near] < 2 * radius[i])]
        # Term by term, not as a matrix product: the same bits however many there are.
        cosine = n[near, 0] * n[i, 0] + n[near, 1] * n[i, 1] + n[near, 2] * n[i, 2]
        drop[near[cosine > 1 - NORMAL_TOLERANCE / 8]] = True
    return drop
