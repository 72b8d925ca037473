"""Compatibility of records and surface points, and the compatible neighbours of a site.

Two places are compatible if their normals differ by less than a look-up tolerates. A record at one of them may then
contribute at the other if it is near enough (`lookup.pair_weights` defines how near). Placement, merging, and every
comparison of a record with its neighbours use this criterion.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

NORMAL_TOLERANCE = 0.1
"""t: 1 - cos of the angle between normals (26 degrees) at which a record no longer contributes."""

PAIRS_AT_ONCE = 1 << 20
"""Pairs of neighbours that are processed together. Bounds memory; no result depends on it."""


def compatible(normal: Floats, other: Floats, part: float = 1.0) -> NDArray[np.bool_]:
    """Whether unit normals differ by less than a look-up tolerates.

    Args:
        normal: (..., 3).
        other: (..., 3), broadcasts against the first.
        part: fraction of the tolerance that is allowed; less than 1 for a stricter test.

    Returns:
        (...) mask.
    """
    # Term by term rather than as a matrix product: the same bits for any number of normals.
    cosine = normal[..., 0] * other[..., 0] + normal[..., 1] * other[..., 1] + normal[..., 2] * other[..., 2]
    return np.asarray(cosine > 1 - part * NORMAL_TOLERANCE)


def dominant_faces(normal: Floats, tolerance: float = NORMAL_TOLERANCE) -> NDArray[np.bool_]:
    """(S, 6) which of the axes +x, -x, +y, -y, +z, -z may be dominant in a normal that is compatible with these.

    Two unit vectors with n·n' >= 1 - t differ by at most sqrt(2 t) in each component, and the dominant component of a
    unit vector is at least 1/sqrt(3).
    """
    slack = np.float32(np.sqrt(2 * tolerance))
    signed = np.stack(
        [normal[:, 0], -normal[:, 0], normal[:, 1], -normal[:, 1], normal[:, 2], -normal[:, 2]], 1
    )
    largest = np.abs(normal).max(axis=1, keepdims=True)
    return np.asarray((signed >= largest - 2 * slack) & (signed >= 1 / np.sqrt(3) - slack))


def dominant_face(normal: Floats) -> NDArray[np.intp]:
    """(S,) number of the dominant axis of each normal, in the order of `dominant_faces`."""
    axis = np.abs(normal).argmax(axis=1)
    return np.asarray(2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0))


class Neighbours(NamedTuple):
    """The nearest sites of each of S sites, the nearest first."""

    rows: NDArray[np.int32]  # (S, n) which; the first is the site itself, or another at the same place
    compatible: NDArray[np.bool_]  # (S, n) whether each counts; the first always does


def compatible_neighbours(
    position: Floats, normal: Floats, count: int, within: Floats | float = np.inf
) -> Neighbours:
    """The nearest sites of each site, and which of them are compatible with it and near enough.

    Args:
        position: (S, 3) metres.
        normal: (S, 3) unit.
        count: number of nearest sites to find for each, itself included; all if there are fewer.
        within: (S,) largest distance of a neighbour that counts, metres.
    """
    count = min(count, len(position))
    if count == 0:
        return Neighbours(np.zeros((0, 0), np.int32), np.zeros((0, 0), bool))
    tree, reach = tree_of(position), np.broadcast_to(within, len(position))
    rows, mask = np.zeros((len(position), count), np.int32), np.zeros((len(position), count), bool)
    for begin in range(0, len(position), PAIRS_AT_ONCE // count):
        some = slice(begin, begin + PAIRS_AT_ONCE // count)
        distance, rows[some] = tree.query(position[some], range(1, count + 1))
        mask[some] = compatible(normal[some, None], normal[rows[some]]) & (distance <= reach[some, None])
    mask[:, 0] = True
    return Neighbours(rows, mask)


class Pairs(NamedTuple):
    """Some places, and the compatible sites near each of them."""

    places: NDArray[np.intp]  # (C,) rows of the places, ascending; their number bounds memory
    at: NDArray[np.intp]  # (P,) index of the place of each pair in `places`, ascending
    site: NDArray[np.intp]  # (P,) ascending for each place

    @property
    def place(self) -> NDArray[np.intp]:
        """(P,) row of the place of each pair."""
        return self.places[self.at]


class CompatibleSites:
    """Sites to search for those that are near a place and compatible with it.

    A search tree for each dominant axis of a normal contains the sites that a place of such a normal may be compatible
    with. Around a place in a furnished room, most of what is near faces elsewhere.
    """

    def __init__(self, position: Floats, normal: Floats, part: float = 1.0) -> None:
        """Index S sites.

        Args:
            position: (S, 3) metres.
            normal: (S, 3) unit.
            part: as in `compatible`.
        """
        self._normal, self._part = normal, part
        self._rows = [np.flatnonzero(listed) for listed in dominant_faces(normal, part * NORMAL_TOLERANCE).T]
        self._trees = [tree_of(position[rows]) for rows in self._rows]

    def near(self, position: Floats, normal: Floats, radius: Floats) -> Iterator[Pairs]:
        """All pairs of a place and a compatible site within the place's radius, in batches.

        Args:
            position: (Q, 3) places, metres.
            normal: (Q, 3) unit.
            radius: (Q,) metres.
        """
        faces = dominant_face(normal)
        for face, (rows, tree) in enumerate(zip(self._rows, self._trees, strict=True)):
            places = np.flatnonzero(faces == face)
            for some, at, found in _within(tree, position[places], radius[places]):
                here, site = places[some], rows[found]
                alike = compatible(normal[here][at], self._normal[site], self._part)
                yield Pairs(here, at[alike], site[alike])


def _within(
    tree: cKDTree, position: Floats, radius: Floats
) -> Iterator[tuple[slice, NDArray[np.intp], NDArray[np.intp]]]:
    """Consecutive places; for each site within the radius of one, its index among these places, and the site."""
    ends = np.cumsum(tree.query_ball_point(position, radius, return_length=True))
    begin = 0
    while begin < len(position):
        # As many places as have PAIRS_AT_ONCE sites in total, but at least one.
        before = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, before + PAIRS_AT_ONCE, side="right")))
        near = tree.query_ball_point(position[begin:end], radius[begin:end], return_sorted=True)
        sizes = np.fromiter(map(len, near), np.intp, len(near))
        at = np.repeat(np.arange(len(near)), sizes)
        yield slice(begin, end), at, _flat(near, len(at))
        begin = end


def tree_of(sites: Floats) -> cKDTree:
    """Tree for finding the sites near a place."""
    from scipy.spatial import cKDTree  # importing it takes longer than `cache info`

    return cKDTree(sites)


def _flat(lists: NDArray[np.object_], count: int) -> NDArray[np.intp]:
    return np.fromiter(itertools.chain.from_iterable(lists), np.intp, count)


def first_come(winner: NDArray[np.intp], loser: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    """Greedy selection in order of priority: a candidate is chosen unless an earlier rival of it was chosen.

    Many are decided at once: all candidates without an undecided earlier rival are chosen, and rule out their later
    rivals.

    Args:
        winner: of each pair of rivals, the one that comes first.
        loser: of each pair, the other one.
        count: number of candidates. Their numbers may have any order, since the pairs define which comes first.

    Returns:
        (count,) mask.
    """
    chosen, waiting = np.zeros(count, bool), np.ones(count, bool)
    while waiting.any():
        free = waiting.copy()
        free[loser] = False
        chosen |= free
        waiting &= ~free
        waiting[loser[free[winner]]] = False
        left = waiting[winner] & waiting[loser]
        winner, loser = winner[left], loser[left]
    return chosen
