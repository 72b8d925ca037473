"""Placement of new records: a well-spread subset of the points that no record covers yet.

Records are made in rounds of shrinking spacing (`renderers/mitsuba/records/filling.py`). In each round, one candidate
per cell is kept, and Poisson-disk selection chooses greedily among these by priority. The outcome depends only on the
candidates and their order, never on the number of processes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import CompatibleSites, first_come
from steadylight.cache.lookup import ROUNDING, pair_weights
from steadylight.cache.records import Floats, Records

SAMPLED = 16
"""One in this many points is used to decide where space is divided."""


def thin(position: Floats, normal: Floats, spacing: Floats) -> NDArray[np.intp]:
    """Rows of the first point in each cell: cubes with edges of about `spacing`, times coarse normal directions.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        spacing: (P,) metres; rounded down to a power of two so that neighbours share a grid.

    Returns:
        Ascending rows, at most one per cell.
    """
    _, first = np.unique(_cells(position, normal, level_of(spacing)), return_index=True)
    return np.sort(first)


def thin_and_count(
    position: Floats, normal: Floats, spacing: Floats, number: Floats, rank: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Rows of the point of least rank in each cell, and the sum of `number` over all points in that cell.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        spacing: (P,) metres; cells as in `thin`.
        number: (P,) look-ups that each point stands for.
        rank: (P,) which point of a cell is kept; the first of several equal ones.

    Returns:
        Rows by ascending rank, and for each the sum.
    """
    if len(position) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.float32)
    cells = _cells(position, normal, level_of(spacing))
    order = np.argsort(cells, kind="stable")
    cells, ranked = cells[order], rank[order]
    begin = np.flatnonzero(np.concatenate([[True], cells[1:] != cells[:-1]]))
    least = np.repeat(np.minimum.reduceat(ranked, begin), np.diff(begin, append=len(order)))
    place = np.where(ranked == least, np.arange(len(order)), len(order))
    rows = order[np.minimum.reduceat(place, begin)]
    sums = np.add.reduceat(number[order], begin, dtype=np.float64).astype(np.float32)
    by_rank = np.lexsort((rows, rank[rows]))
    return rows[by_rank], sums[by_rank]


def totals(position: Floats, normal: Floats, spacing: Floats, number: Floats) -> Floats:
    """For each point, the sum of `number` over all points in its cell; cells as in `thin`.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        spacing: (P,) metres.
        number: (P,) look-ups that each point stands for.
    """
    _, cell = np.unique(_cells(position, normal, level_of(spacing)), return_inverse=True)
    cell = cell.ravel()
    return np.bincount(cell, number)[cell].astype(np.float32)


def level_of(spacing: Floats) -> NDArray[np.int64]:
    """Exponent of the largest power of two that is not greater than each spacing."""
    return np.floor(np.log2(spacing)).astype(np.int64)


def _cells(position: Floats, normal: Floats, level: NDArray[np.int64]) -> NDArray[np.uint64]:
    """A hash of the cell of each point: about one in 10^19 pairs of cells collides."""
    cell = np.floor(position / np.exp2(level)[:, None]).astype(np.int64)
    facing = np.round(normal * 3).astype(np.int64) + 3
    mixed = ((level + 64) * 343 + (facing[:, 0] * 7 + facing[:, 1]) * 7 + facing[:, 2]).astype(np.uint64)
    for column in cell.T:
        # The finaliser of SplitMix64 (Steele, Lea & Flood 2014) after each coordinate.
        mixed = (mixed + column.astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return mixed


def least_nearby(position: Floats, normal: Floats, spacing: Floats) -> Floats:
    """For each point, the smallest spacing among all points in its cell, whose size is about the point's own spacing.

    Where one frame looks at a surface from nearby and another from far away, the points of both frames are mixed, and
    all should have the same spacing.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        spacing: (P,) metres.
    """
    level = level_of(spacing)
    least = spacing.copy()
    for number in np.unique(level):
        finer = np.flatnonzero(level <= number)
        keys = _cells(position[finer], normal[finer], np.full(len(finer), number))
        _, cell = np.unique(keys, return_inverse=True)
        cell = cell.ravel()
        smallest = np.full(int(cell.max()) + 1, np.inf, np.float32)
        np.minimum.at(smallest, cell, spacing[finer])
        own = level[finer] == number
        least[finer[own]] = smallest[cell[own]]
    return least


def rows_in_box(position: Floats, number: int, count: int) -> NDArray[np.intp]:
    """Ascending rows of the positions in one of several axis-aligned boxes, which contain about equally many.

    Args:
        position: (P, 3) metres.
        number: of the box, from 0.
        count: of the boxes, which together contain all positions.
    """
    rows = np.arange(len(position))
    while count > 1:
        some = position[rows[::SAMPLED]]
        if len(some) == 0:
            return rows if number == 0 else rows[:0]
        below = count // 2
        axis = int(np.ptp(some, axis=0).argmax())
        place = len(some) * below // count
        above = position[rows, axis] >= np.partition(some[:, axis], place)[place]
        if number < below:
            rows, count = rows[~above], below
        else:
            rows, number, count = rows[above], number - below, count - below
    return rows


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
    # Points nearer than a point's own spacing: a superset of its conflicts.
    for pairs in CompatibleSites(p, n).near(p, n, s):
        i, j = pairs.place, pairs.site
        after = i < j
        i, j = i[after], j[after]
        rivals = np.linalg.norm(p[j] - p[i], axis=1) < np.minimum(s[j], s[i])
        earlier.append(i[rivals])
        later.append(j[rivals])
    return rows[first_come(np.concatenate(earlier), np.concatenate(later), len(rows))]


def answered_weight(position: Floats, normal: Floats, longest: Floats, records: Records) -> Floats:
    """Sum of the weights of `records` at each point, for few records and many points.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        longest: (P,) records of a longer radius do not count, metres.
        records: R records.

    Returns:
        (P,) sums of weights, as `look_up` would return.
    """
    total = np.zeros(len(position), np.float32)
    if len(records) == 0 or len(position) == 0:
        return total
    for pairs in CompatibleSites(position, normal).near(records.position, records.normal, records.radius):
        record, point = pairs.place, pairs.site
        trusted = records.radius[record] * (1 - ROUNDING) <= longest[point]
        record, point = record[trusted], point[trusted]
        np.add.at(total, point, pair_weights(position[point], normal[point], records, record))
    return total
