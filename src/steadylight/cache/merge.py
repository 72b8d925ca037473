"""Merging the caches of many frames into one: in a fixed order, without redundant records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import CompatibleSites, first_come
from steadylight.cache.octree import spread_bits
from steadylight.cache.records import Floats, Records

REDUNDANT = 0.35
"""Of two compatible records nearer than this fraction of both radii, one is redundant."""

STANDS_IN = 1 / 8
"""Fraction of the look-up's tolerance of normals within which one record may replace another. The kept record must
contribute wherever the dropped one would, so the difference of their normals may use up only little of its tolerance:
about the square of REDUNDANT, since weights depend on the square of the distance."""


def merge_caches(caches: Sequence[Records]) -> Records:
    """Merge caches into one, with the same bytes for any order of the caches.

    The paper only unites the caches. Frames that see the same wall leave records side by side there. These slow down
    every look-up and cover no new point, so we drop each record that a kept record can replace.

    Args:
        caches: records of the selected frames.

    Returns:
        Kept records, in Morton order.
    """
    records = Records.concatenate(*caches)
    records = records.take(canonical_order(records))
    return records.take(np.flatnonzero(~redundant(records)))


def canonical_order(records: Records) -> NDArray[np.intp]:
    """Rows by Morton code, ties by every component, so that neighbours in space are neighbours in memory."""
    if len(records) == 0:
        return np.zeros(0, np.intp)
    # A fixed grid, not the bounding box: adding a record must not reorder the others.
    cell = np.floor(records.position.astype(np.float64) * 1024).astype(np.int64) + (1 << 20)
    x, y, z = (spread_bits(cell[:, axis]) for axis in range(3))
    code = x | y << np.uint64(1) | z << np.uint64(2)
    order = np.argsort(code, kind="stable")
    same = np.diff(code[order]) == 0
    alike = np.flatnonzero(np.append(same, False) | np.append(False, same))
    if len(alike):
        tied = order[alike]
        order[alike] = tied[np.lexsort([*_ties(records.take(tied)), code[tied]])]
    return order


def _ties(records: Records) -> list[Floats]:
    """Components, the most significant last."""
    columns = [
        records.radius,
        records.difference,
        records.standard_error,
        records.curvature,
        records.rotation,
        records.translation,
        records.irradiance,
        records.normal,
        records.position,
    ]
    return [component for column in columns for component in column.reshape(len(records), -1).T]


def redundant(records: Records) -> NDArray[np.bool_]:
    """Which records can be replaced by another, kept one.

    Records are visited from small to large radius, so the more detailed ones survive; a record is dropped when a kept,
    compatible record of comparable radius lies within `REDUNDANT` of the smaller radius.

    Args:
        records: R records in canonical order.

    Returns:
        (R,) True for those to drop.
    """
    if len(records) == 0:
        return np.zeros(0, bool)
    p, n, radius = records.position, records.normal, records.radius
    rank = np.empty(len(records), np.intp)
    rank[np.argsort(radius, kind="stable")] = np.arange(len(records))
    smaller, larger = [], []
    for pairs in CompatibleSites(p, n, STANDS_IN).near(p, n, REDUNDANT * radius):
        i, j = pairs.place, pairs.site
        rivals = (rank[j] > rank[i]) & (radius[j] < 2 * radius[i])
        smaller.append(i[rivals])
        larger.append(j[rivals])
    return ~first_come(np.concatenate(smaller), np.concatenate(larger), len(records))
