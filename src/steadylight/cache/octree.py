"""Spatial index of the cache: a multi-reference octree as flat arrays, ready for a kernel.

A record is listed at the level whose cells are just larger than its radius, in every cell that it touches: a
handful, however unlike the radii are (Křivánek & Gautron 2009, ch. 4). A query descends once and reads one list
on each level. Six trees share the arrays, one for each dominant axis of the query normal: in a corner, the records
of the other walls are not even looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import FLATNESS, HEADROOM
from steadylight.cache.records import Records

MAX_LEVEL = 19
"""Three bits a level and three for the tree fit a 64-bit key."""

_NEIGHBOURS = np.array([[x, y, z] for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)], np.int64)
_OCTANTS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.int64)


class Cube(NamedTuple):
    """A cube along the axes."""

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


def dominant_faces(normal: NDArray[np.float32], tolerance: float = NORMAL_TOLERANCE) -> NDArray[np.bool_]:
    """(R, 6) which of the six trees hold a record: those that a compatible query normal may select.

    Two unit vectors with n·n' >= 1 - t differ by at most sqrt(2 t) in each component, and the component that
    dominates a query normal is at least 1/sqrt(3).
    """
    slack = np.float32(np.sqrt(2 * tolerance))
    signed = np.stack(
        [normal[:, 0], -normal[:, 0], normal[:, 1], -normal[:, 1], normal[:, 2], -normal[:, 2]], 1
    )
    largest = np.abs(normal).max(axis=1, keepdims=True)
    compatible: NDArray[np.bool_] = (signed >= largest - 2 * slack) & (signed >= 1 / np.sqrt(3) - slack)
    return compatible


def build_octree(
    records: Records, *, stretch: float = 1.0, cube: Cube | None = None, finer: int = 0
) -> Octree:
    """Index the records in whole-array steps.

    Args:
        records: R records.
        stretch: multiplies every radius and the tolerance of normals, for a look-up that accepts more distant records.
        cube: the root; around all that records can answer if None. With the same cube, a query meets the same records
            that may answer it in the same order, whatever others there are further off. What lies outside is not
            found.
        finer: levels by which records are listed further down. Each level takes some three times as much memory, and a
            query among crowded records meets half as many that do not answer it.

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
    level, key, row = _entries(records, radius, lower, size, NORMAL_TOLERANCE * stretch, finer)
    if len(key) == 0:
        return Octree(lower.astype(np.float32), size, np.zeros((6, 4), np.uint32), np.zeros(0, np.uint32))

    # Find the cells of each level that exist: those with a list, and the ancestors of those below.
    cells: list[NDArray[np.uint64]] = [np.zeros(0, np.uint64)] * (MAX_LEVEL + 2)
    for l in range(int(level.max()), 0, -1):
        cells[l] = np.unique(np.concatenate([key[level == l], cells[l + 1] >> np.uint64(3)]))
    cells[0] = np.arange(6, dtype=np.uint64)

    # Lay the levels out one after the other, children in blocks of eight.
    node = np.zeros(len(key), np.int64)  # of each entry
    node[level == 0] = key[level == 0].astype(np.int64)
    first: list[NDArray[np.int64]] = []
    index, begin, width = (
        cells[0].astype(np.int64),
        0,
        6,
    )  # of this level's existing cells, and its node count
    for l in range(int(level.max()) + 1):
        parents = np.unique(cells[l + 1] >> np.uint64(3))
        child_begin = begin + width
        children = np.zeros(width, np.int64)
        children[index[np.searchsorted(cells[l], parents)] - begin] = child_begin + 8 * np.arange(
            len(parents)
        )
        first.append(children)

        def place(
            keys: NDArray[np.uint64], start: int = child_begin, above: NDArray[np.uint64] = parents
        ) -> NDArray[np.int64]:
            """Node numbers of cells of the next level."""
            block = np.searchsorted(above, keys >> np.uint64(3))
            return start + 8 * block + (keys & np.uint64(7)).astype(np.int64)

        below = level == l + 1
        node[below] = place(key[below])
        index = place(cells[l + 1])
        begin, width = child_begin, 8 * len(parents)

    order = np.lexsort((row, node))
    count = np.bincount(node, minlength=begin)
    end = np.cumsum(count)
    nodes = np.zeros((len(count), 4), np.uint32)
    nodes[:, 0] = np.concatenate(first)
    nodes[:, 1] = end - count
    nodes[:, 2] = end
    return Octree(lower.astype(np.float32), size, nodes, row[order].astype(np.uint32))


def _entries(
    records: Records,
    radius: NDArray[np.float32],
    lower: NDArray[np.float32],
    size: float,
    tolerance: float,
    finer: int,
) -> tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.int64]]:
    """Level, cell key and row of every (cell, record) pair in which the record may answer."""
    level = np.clip(np.floor(np.log2(size / radius)), 0, MAX_LEVEL - finer).astype(np.int64)
    home = np.floor((records.position - lower) / (size / np.exp2(level))[:, None]).astype(np.int64)
    cell = home[:, None] + _NEIGHBOURS  # (R, 27, 3)
    row, neighbour = np.nonzero(((cell >= 0) & (cell < (1 << level)[:, None, None])).all(axis=2))
    cell = cell[row, neighbour]
    row, cell = _touching(records, radius, row, cell, lower, size / np.exp2(level))
    for _ in range(finer):
        level += 1
        row, cell = np.repeat(row, 8), (2 * cell[:, None] + _OCTANTS).reshape(-1, 3)
        row, cell = _touching(records, radius, row, cell, lower, size / np.exp2(level))
    face = dominant_faces(records.normal, tolerance)
    pair, tree = np.nonzero(face[row])
    row, cell = row[pair], cell[pair]
    code = (
        spread_bits(cell[:, 0])
        | spread_bits(cell[:, 1]) << np.uint64(1)
        | spread_bits(cell[:, 2]) << np.uint64(2)
    )
    key = tree.astype(np.uint64) << (3 * level[row]).astype(np.uint64) | code
    return level[row], key, row


def _touching(
    records: Records,
    radius: NDArray[np.float32],
    row: NDArray[np.int64],
    cell: NDArray[np.int64],
    lower: NDArray[np.float32],
    edges: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Those pairs of record and cell where the flat ellipsoid of one may touch the other: by its sphere and slab.

    Args:
        records: R records.
        radius: (R,) metres.
        row: (n,) of the record.
        cell: (n, 3) its number along each axis.
        lower: (3,) corner of the first, metres.
        edges: (R,) of the cells of each record, metres.
    """
    edge = edges[row].astype(np.float32)
    corner = (lower + cell * edges[row, None]).astype(np.float32)
    position, normal, r = records.position[row], records.normal[row], radius[row]
    slack = np.float32(1e-3) * edge  # a kernel finds the cell by other roundings than we do
    nearest = np.clip(position, corner, corner + edge[:, None])
    in_sphere = ((position - nearest) ** 2).sum(axis=1) <= (r + slack) ** 2
    height = np.abs(((corner + edge[:, None] / 2 - position) * normal).sum(axis=1))
    most = np.minimum(r / FLATNESS, HEADROOM * records.headroom[row])
    in_slab = height <= most + (edge / 2 + slack) * np.abs(normal).sum(axis=1)
    touches = in_sphere & in_slab
    return row[touches], cell[touches]


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
