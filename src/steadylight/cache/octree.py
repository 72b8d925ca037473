"""Spatial index of the cache: a multiple-reference octree as flat arrays, ready for a kernel.

A record is listed at the level whose cells are just larger than its radius, in every cell that it touches. These are
few cells, however much the radii of records differ (Křivánek & Gautron 2009, ch. 4). A query descends once, and reads
one list per level. Six trees share the arrays, one for each dominant direction of the query normal: a query in a corner
does not read the records of the other walls.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import NORMAL_TOLERANCE, dominant_faces
from steadylight.cache.lookup import FLATNESS, HEADROOM
from steadylight.cache.records import Records

MAX_LEVEL = 19
"""Three bits per level and three for the tree fit a 64-bit key."""

AT_ONCE = 1 << 14
"""Number of records whose entries are found at once: each takes some 4 kB temporarily, and 0.2 kB afterwards."""

_NEIGHBOURS, _HALVES = np.array([-1, 0, 1]), np.array([0, 1])


class Cube(NamedTuple):
    """An axis-aligned cube."""

    origin: tuple[float, float, float]  # lower corner, metres
    size: float  # edge, metres


@dataclass(frozen=True)
class Octree:
    """Six octrees over one cube.

    Attributes:
        origin: (3,) lower corner of the cube, metres.
        size: edge of the cube, metres.
        nodes: (n, 4) uint32: index of the first of eight children (bit 0 is x, bit 1 is y, bit 2 is z) or 0 if
            there are none; start and end of the node's list in `references`; 0. Nodes 0 to 5 are the roots, for
            query normals whose dominant axis is +x, -x, +y, -y, +z, -z.
        references: rows of the records, ascending within each list, uint32.
    """

    origin: NDArray[np.float32]
    size: float
    nodes: NDArray[np.uint32]
    references: NDArray[np.uint32]


def build_octree(
    records: Records, *, stretch: float = 1.0, cube: Cube | None = None, finer: int = 0
) -> Octree:
    """Index the records with whole-array operations.

    Args:
        records: R records.
        stretch: multiplies every radius and the tolerance of normals, for a look-up that accepts more distant records.
        cube: the root; if None, a cube around all points that records reach. With the same cube, a query meets the
            records that may contribute to it in the same order, whatever records exist further away. Queries outside
            the cube find nothing.
        finer: number of levels by which records are listed further down. Each level takes about three times as much
            memory. Where records are dense, it halves the number of records that a query reads in vain.

    Returns:
        The octree; six empty roots if there are no records.
    """
    radius = records.radius * np.float32(stretch)
    if cube is None and len(records) == 0:
        lower, size = np.zeros(3, np.float32), 1.0
    elif cube is None:
        lower = (records.position - radius[:, None]).min(axis=0)
        size = float(((records.position + radius[:, None]).max(axis=0) - lower).max()) * 1.001 + 1e-6
    else:
        lower, size = np.array(cube.origin, np.float32), cube.size
    height = np.minimum(radius / FLATNESS, HEADROOM * records.headroom)
    faces = dominant_faces(records.normal, NORMAL_TOLERANCE * stretch)
    bodies = _Bodies(records.position, records.normal, records.surface, radius, height, faces)
    entries = _entries(bodies, lower, size, finer)
    if len(entries.key) == 0:
        return Octree(lower.astype(np.float32), size, np.zeros((6, 4), np.uint32), np.zeros(0, np.uint32))
    lists = [_lists(entries, level) for level in range(int(entries.level.max()) + 1)]
    del entries

    # Find the cells of each level that exist: those with a list, and the parents of existing cells of the next level.
    cells = [np.zeros(0, np.uint64)]
    for listed in reversed(lists[1:]):
        both = np.sort(np.concatenate([listed.cell, _parents(cells[-1])]))
        cells.append(both[_is_first(both)])
    cells.append(np.arange(6, dtype=np.uint64))
    cells.reverse()

    # Lay out the levels one after the other, children in blocks of eight: nodes, and so their lists, are ordered by
    # level and key.
    first, count = [], []
    begin, width = 0, 6  # nodes of this level
    index = np.arange(6)  # of its existing cells, within the level
    for listed, (here, below) in zip(lists, itertools.pairwise(cells), strict=True):
        parents = _parents(below)
        children, counts = np.zeros(width, np.uint32), np.zeros(width, np.int64)
        children[index[np.searchsorted(here, parents)]] = begin + width + 8 * np.arange(len(parents))
        counts[index[np.searchsorted(here, listed.cell)]] = listed.length
        first.append(children)
        count.append(counts)
        begin, width = begin + width, 8 * len(parents)
        index = 8 * np.searchsorted(parents, below >> np.uint64(3)) + (below & np.uint64(7)).astype(np.int64)

    counts = np.concatenate(count)
    end = np.cumsum(counts)
    nodes = np.zeros((len(counts), 4), np.uint32)
    nodes[:, 0] = np.concatenate(first)
    nodes[:, 1] = end - counts
    nodes[:, 2] = end
    return Octree(lower.astype(np.float32), size, nodes, np.concatenate([listed.row for listed in lists]))


class _Entries(NamedTuple):
    """Pairs of a cell and a record that may contribute in it; rows ascend."""

    level: NDArray[np.uint8]
    key: NDArray[np.uint64]  # of the cell: its tree, and three bits per level
    row: NDArray[np.uint32]


class _Lists(NamedTuple):
    """The lists of one level."""

    cell: NDArray[np.uint64]  # keys of cells with a list, ascending
    length: NDArray[np.int64]  # of each list
    row: NDArray[np.uint32]  # all entries, one list after the other


def _lists(entries: _Entries, level: int) -> _Lists:
    here = np.flatnonzero(entries.level == level)
    key = entries.key[here]
    order = np.argsort(key, kind="stable")
    key = key[order]
    begin = np.flatnonzero(_is_first(key))
    return _Lists(key[begin], np.diff(begin, append=len(key)), entries.row[here[order]])


def _parents(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Keys of the parents of some cells, without duplicates; both ascending."""
    above = cells >> np.uint64(3)
    return above[_is_first(above)]


def _is_first(ascending: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Whether each element is the first of its value."""
    return np.concatenate([np.ones(min(len(ascending), 1), bool), ascending[1:] != ascending[:-1]])


class _Bodies(NamedTuple):
    """The flat ellipsoids within which records contribute."""

    position: NDArray[np.float32]  # (R, 3) metres
    normal: NDArray[np.float32]  # (R, 3) unit
    surface: NDArray[np.float32]  # (R, 3) unit
    radius: NDArray[np.float32]  # (R,) metres
    height: NDArray[np.float32]  # (R,) half the thickness, metres
    faces: NDArray[np.bool_]  # (R, 6) in which trees they are listed

    def take(self, rows: slice) -> _Bodies:
        """The bodies at `rows`."""
        position, normal, surface, radius, height, faces = self
        places = position[rows], normal[rows], surface[rows]
        return _Bodies(*places, radius[rows], height[rows], faces[rows])


def _entries(bodies: _Bodies, lower: NDArray[np.float32], size: float, finer: int) -> _Entries:
    parts = []
    for begin in range(0, max(len(bodies.radius), 1), AT_ONCE):
        part = _entries_of_some(bodies.take(slice(begin, begin + AT_ONCE)), lower, size, finer)
        parts.append(part._replace(row=part.row + np.uint32(begin)))
    return _Entries(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _entries_of_some(bodies: _Bodies, lower: NDArray[np.float32], size: float, finer: int) -> _Entries:
    level = np.clip(np.floor(np.log2(size / bodies.radius)), 0, MAX_LEVEL - finer).astype(np.int64)
    cells = np.exp2(level)  # along each axis
    home = np.floor((bodies.position - lower) / (size / cells)[:, None]).astype(np.int64)
    row, cell = _touching(bodies, np.arange(len(home)), home, _NEIGHBOURS, lower, size / cells)
    inside = ((cell >= 0) & (cell < cells[row, None])).all(axis=1)
    row, cell = row[inside], cell[inside]
    for _ in range(finer):
        level += 1
        row, cell = _touching(bodies, row, 2 * cell, _HALVES, lower, size / np.exp2(level))
    pair, tree = np.nonzero(bodies.faces[row])
    row, cell = row[pair], cell[pair]
    code = (
        spread_bits(cell[:, 0])
        | spread_bits(cell[:, 1]) << np.uint64(1)
        | spread_bits(cell[:, 2]) << np.uint64(2)
    )
    key = tree.astype(np.uint64) << (3 * level[row]).astype(np.uint64) | code
    return _Entries(level[row].astype(np.uint8), key, row.astype(np.uint32))


def _touching(
    bodies: _Bodies,
    row: NDArray[np.int64],
    cell: NDArray[np.int64],
    steps: NDArray[np.int64],
    lower: NDArray[np.float32],
    edges: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a record and a cell that its flat ellipsoid may touch, among the cells around given ones.

    The ellipsoid lies within a sphere and within a slab, along the record's normal or its surface
    (`lookup.height_over`). A cell must touch the sphere and either slab. All tests are sums over the three axes, so the
    terms of each axis are computed only once for its k cell numbers.

    Args:
        bodies: of R records.
        row: (n,) row of the record in each given pair.
        cell: (n, 3) number of the cell along each axis in each given pair.
        steps: (k,) offsets to the cell numbers that are tried along each axis: k³ cells for each given pair.
        lower: (3,) lower corner of the first cell, metres.
        edges: (R,) edge of the cells of each record, metres.

    Returns:
        (m,) row of the record and (m, 3) number of the cell.
    """
    tried = cell[:, None] + steps[:, None]  # (n, k, 3)
    exact = edges[row]
    edge = exact.astype(np.float32)
    corner = (lower + tried * exact[:, None, None]).astype(np.float32)
    position, normal, surface, r, most = (each[row] for each in bodies[:5])
    slack = np.float32(1e-3) * edge  # the kernel rounds differently in finding a cell
    along = edge[:, None, None]
    nearest = np.clip(position[:, None], corner, corner + along)
    distance = _sums((position[:, None] - nearest) ** 2)
    in_sphere = distance <= ((r + slack) ** 2)[:, None, None, None]
    offset = corner + along / 2 - position[:, None]
    in_slab = np.zeros(in_sphere.shape, bool)
    for axis in (normal, surface):
        height = np.abs(_sums(offset * axis[:, None]))
        widest = most + (edge / 2 + slack) * np.abs(axis).sum(axis=1)
        in_slab |= height <= widest[:, None, None, None]
    which, z, y, x = np.nonzero(in_sphere & in_slab)
    return row[which], np.stack([tried[which, x, 0], tried[which, y, 1], tried[which, z, 2]], axis=1)


def _sums(parts: NDArray[Any]) -> NDArray[Any]:
    """(n, k, k, k) sums of one part of each axis, z, y, x, from (n, k, 3) parts."""
    sums: NDArray[Any] = parts[:, None, None, :, 0] + parts[:, None, :, None, 1] + parts[:, :, None, None, 2]
    return sums


def spread_bits(value: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Insert two zero bits after each of the lowest 21 bits: a third of a Morton code."""
    x = np.clip(value, 0, (1 << 21) - 1).astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x
