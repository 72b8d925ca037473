"""Where new records go: a well-spread subset of the points that nothing answers yet.

Candidates are taken in rounds of shrinking spacing; within a round, one candidate per cell and then greedy
Poisson-disk selection by priority. The outcome depends on the candidates and their order only, never on how
many processes look at them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import compatible, first_come, pairs_within
from steadylight.cache.lookup import ROUNDING, pair_weights
from steadylight.cache.records import Floats, Records


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
    earlier, later = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    # What is nearer than a point's own spacing: a superset of its conflicts.
    for _, i, j in pairs_within(p, p, s):
        after = i < j
        i, j = i[after], j[after]  # noqa: PLW2901 - fewer of the same
        distance = np.linalg.norm(p[j] - p[i], axis=1)
        rivals = compatible(n[i], n[j]) & (distance < np.minimum(s[j], s[i]))
        earlier.append(i[rivals])
        later.append(j[rivals])
    return rows[first_come(np.concatenate(earlier), np.concatenate(later), len(rows))]


def answered_weight(position: Floats, normal: Floats, longest: Floats, records: Records) -> Floats:
    """Sum of weights that `records` give at each point, for few records and many points.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        longest: (P,) records of a longer radius do not count, metres.
        records: R records.

    Returns:
        (P,) sums of weights, as `look_up` would give.
    """
    total = np.zeros(len(position), np.float32)
    if len(records) == 0 or len(position) == 0:
        return total
    for _, record, point in pairs_within(position, records.position, records.radius):
        trusted = records.radius[record] * (1 - ROUNDING) <= longest[point]
        record, point = record[trusted], point[trusted]  # noqa: PLW2901 - fewer of the same
        np.add.at(total, point, pair_weights(position[point], normal[point], records, record))
    return total
