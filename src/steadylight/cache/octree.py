"""Spatial index of the cache: a multi-reference octree as flat arrays, ready for a kernel.

Every leaf lists all records that may answer inside it, so a query descends once and reads one contiguous list
(Křivánek & Gautron 2009, ch. 4). Six trees share the arrays, one for each dominant axis of the query normal:
in a corner, the records of the other walls are not even looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.lookup import FLATNESS, NORMAL_TOLERANCE
from steadylight.cache.records import Records

LEAF_SIZE = 8
"""A list of this length need not be split."""

WORTHWHILE = 0.7
"""Split a node only if its non-empty children's lists are shorter than its own by this factor on average."""

MAX_LEVEL = 20

_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)


@dataclass(frozen=True)
class Octree:
    """Six octrees over one cube.

    Attributes:
        origin: (3,) lower corner of the cube, metres.
        size: edge of the cube, metres.
        first: (nodes,) int32. Inner node: index of the first of its eight children (bit 0 is x, bit 1 is y,
            bit 2 is z). Leaf: ~start of its list in `references`. Nodes 0 to 5 are the roots, for query
            normals whose dominant axis is +x, -x, +y, -y, +z, -z.
        count: (nodes,) uint32 length of a leaf's list, 0 for inner nodes.
        references: rows of the records, ascending within each list, uint32.
    """

    origin: NDArray[np.float32]
    size: float
    first: NDArray[np.int32]
    count: NDArray[np.uint32]
    references: NDArray[np.uint32]


def dominant_faces(normal: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(R, 6) which of the six trees hold a record: those that a compatible query normal may select.

    Two unit vectors with n·n' >= 1 - t differ by at most sqrt(2 t) in each component, and the component that
    dominates a query normal is at least 1/sqrt(3).
    """
    slack = np.float32(np.sqrt(2 * NORMAL_TOLERANCE))
    signed = np.stack([normal[:, 0], -normal[:, 0], normal[:, 1], -normal[:, 1], normal[:, 2], -normal[:, 2]], 1)
    largest = np.abs(normal).max(axis=1, keepdims=True)
    return (signed >= largest - 2 * slack) & (signed >= 1 / np.sqrt(3) - slack)


def build_octree(records: Records, *, stretch: float = 1.0, leaf_size: int = LEAF_SIZE) -> Octree:
    """Index the records, level by level, in whole-array steps.

    Args:
        records: R records.
        stretch: multiplies every reach, for a look-up that accepts more distant records.
        leaf_size: lists up to this length are not split.

    Returns:
        The octree; a cube without leaves' entries if there are no records.
    """
    reach = records.reach * np.float32(stretch)
    if len(records) == 0:
        lower, size = np.zeros(3, np.float32), 1.0
    else:
        lower = (records.position - reach[:, None]).min(axis=0)
        size = float(((records.position + reach[:, None]).max(axis=0) - lower).max()) * 1.001 + 1e-6

    row, face = np.nonzero(dominant_faces(records.normal)) if len(records) else (np.zeros(0, int),) * 2
    order = np.lexsort((row, face))
    row, node = row[order].astype(np.uint32), face[order].astype(np.int64)
    corner = np.tile(lower.astype(np.float32), (6, 1))  # lower corner of each node of this level

    firsts: list[NDArray[np.int32]] = []
    counts: list[NDArray[np.uint32]] = []
    lists: list[NDArray[np.uint32]] = []
    nodes_before, listed, edge = 0, 0, np.float32(size)
    for level in range(MAX_LEVEL + 1):
        # Pairs (node, row) are sorted by node, so each node's list is one run.
        nodes = len(corner)
        count = np.bincount(node, minlength=nodes)
        split = (count > leaf_size) & (level < MAX_LEVEL)

        # Hand every record of a long list down to the children that it reaches.
        edge = np.float32(edge / 2)
        rank = np.cumsum(split) - 1
        down = split[node]
        child_node = (8 * rank[node[down]][:, None] + np.arange(8)).ravel()
        child_row = np.repeat(row[down], 8)
        child_corner = (corner[split][:, None] + edge * _CORNERS).reshape(-1, 3)
        touched = _touches(records, reach, child_row, child_corner[child_node], edge)
        child_node, child_row = child_node[touched], child_row[touched]

        # Take back the splits that hardly shorten the lists: there the records simply overlap.
        child_count = np.bincount(child_node, minlength=8 * int(split.sum())).reshape(-1, 8)
        full = np.maximum((child_count > 0).sum(axis=1), 1)
        pays = child_count.sum(axis=1) < WORTHWHILE * full * count[split]
        kept = pays[child_node // 8]
        new_rank = np.cumsum(pays) - 1
        child_node = 8 * new_rank[child_node[kept] // 8] + child_node[kept] % 8
        child_row = child_row[kept]
        child_corner = child_corner.reshape(-1, 8, 3)[pays].reshape(-1, 3)
        split[split] = pays

        # Leaves: append their lists; inner nodes: point at children that start after this level.
        leaf_count = np.where(split, 0, count)
        start = listed + np.cumsum(leaf_count) - leaf_count
        child = nodes_before + nodes + 8 * (np.cumsum(split) - 1)
        firsts.append(np.where(split, child, ~start).astype(np.int32))
        counts.append(leaf_count.astype(np.uint32))
        in_leaf = row[~split[node]]
        lists.append(in_leaf)
        listed += len(in_leaf)
        nodes_before += nodes
        if not split.any():
            break
        order = np.argsort(child_node, kind="stable")
        node, row, corner = child_node[order], child_row[order], child_corner

    return Octree(
        lower.astype(np.float32), size, np.concatenate(firsts), np.concatenate(counts), np.concatenate(lists)
    )


def _touches(
    records: Records,
    reach: NDArray[np.float32],
    row: NDArray[np.uint32],
    corner: NDArray[np.float32],
    edge: np.float32,
) -> NDArray[np.bool_]:
    """Whether the flat ellipsoid of each record may touch its cube: by its sphere and by its slab."""
    position, normal, r = records.position[row], records.normal[row], reach[row]
    nearest = np.clip(position, corner, corner + edge)
    in_sphere = ((position - nearest) ** 2).sum(axis=1) <= r**2
    height = np.abs(((corner + edge / 2 - position) * normal).sum(axis=1))
    in_slab = height <= r / FLATNESS + edge / 2 * np.abs(normal).sum(axis=1)
    return in_sphere & in_slab
