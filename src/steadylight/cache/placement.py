"""Where new records go: a well-spread subset of the points that nothing answers yet.

Candidates are taken in rounds of shrinking spacing; within a round, one candidate per cell and then greedy
Poisson-disk selection by priority. The outcome depends on the candidates and their order only, never on how
many processes look at them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steadylight.cache.lookup import NORMAL_TOLERANCE, ROUNDING, pair_weights
from steadylight.cache.records import Floats, Records

PAIRS = 1 << 22
"""Pairs of a record and a point in its radius that are looked at together, to bound memory."""


def thin(position: Floats, normal: Floats, spacing: Floats) -> NDArray[np.intp]:
    """Rows of the first point in each cell: cubes of about `spacing`, times coarse normal directions.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        spacing: (P,) metres; rounded down to a power of two so that neighbours share a grid.

    Returns:
        Ascending rows, at most one per cell.
    """
    level = np.floor(np.log2(spacing)).astype(np.int64)
    cell = np.floor(position / np.exp2(level)[:, None]).astype(np.int64)
    key = np.column_stack([level, cell, np.round(normal * 3).astype(np.int64)])
    order = np.lexsort(key.T)  # stable: the first of each cell stays first
    first = np.ones(len(order), bool)
    first[1:] = (key[order[1:]] != key[order[:-1]]).any(axis=1)
    return np.sort(order[first])


def select(position: Floats, normal: Floats, spacing: Floats) -> NDArray[np.intp]:
    """Rows of a subset in which no two compatible points are closer than the smaller of their spacings.

    Args:
        position: (P, 3) metres, in order of priority: an earlier point wins.
        normal: (P, 3) unit; points whose normals differ by more than the look-up tolerates do not compete.
        spacing: (P,) metres.

    Returns:
        Ascending rows.
    """
    rows = thin(position, normal, spacing)
    p, n, s = position[rows], normal[rows], spacing[rows]
    # Each list holds what is nearer than the point's own spacing: a superset of its conflicts.
    near = cKDTree(p).query_ball_point(p, s)
    i = np.repeat(np.arange(len(rows)), np.fromiter(map(len, near), np.intp, len(near)))
    j = np.concatenate([np.zeros(0, np.intp), *(np.asarray(rows, np.intp) for rows in near)])
    i, j = i[i < j], j[i < j]
    distance = np.linalg.norm(p[j] - p[i], axis=1)
    alike = np.einsum("ij,ij->i", n[i], n[j]) > 1 - NORMAL_TOLERANCE
    rival = alike & (distance < np.minimum(s[j], s[i]))
    i, j = i[rival], j[rival]
    # As if one after the other: whoever has no earlier rival left is chosen, and drops its later ones.
    chosen, waiting = np.zeros(len(rows), bool), np.ones(len(rows), bool)
    while waiting.any():
        free = waiting.copy()
        free[j] = False
        chosen |= free
        waiting &= ~free
        waiting[j[free[i]]] = False
        left = waiting[i] & waiting[j]
        i, j = i[left], j[left]
    return rows[chosen]


def answered_weight(position: Floats, normal: Floats, longest: Floats, records: Records) -> Floats:
    """Sum of weights that `records` give at each point, for few records and many points.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        longest: (P,) records that reach further than this do not count, metres.
        records: R records.

    Returns:
        (P,) sums of weights, as `look_up` would give.
    """
    total = np.zeros(len(position), np.float32)
    if len(records) == 0 or len(position) == 0:
        return total
    tree = cKDTree(position)
    pairs = np.cumsum(tree.query_ball_point(records.position, records.radius, return_length=True))
    begin = 0
    while begin < len(records):
        # As many records as have PAIRS points in reach together, one at least.
        before = pairs[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(pairs, before + PAIRS, side="right")))
        near = tree.query_ball_point(records.position[begin:end], records.radius[begin:end])
        point = np.concatenate([np.asarray(rows, np.intp) for rows in near])
        record = np.repeat(np.arange(begin, end), [len(rows) for rows in near])
        heard = records.radius[record] * (1 - ROUNDING) <= longest[point]
        point, record = point[heard], record[heard]
        np.add.at(total, point, pair_weights(position[point], normal[point], records, record))
        begin = end
    return total
