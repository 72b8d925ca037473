"""Splits polygons into triangles, and replaces normals without a direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SHORTEST_NORMAL = 1e-19
"""The square of a shorter length is zero in single precision."""


def has_direction(normals: ArrayLike) -> NDArray[np.bool_]:
    """Whether normals, (..., 3), are finite and not zero up to rounding.

    Exporters write zeros at corners of triangles without area, or NaN if they divide by zero.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(np.asarray(normals, np.float64), axis=-1)
        return np.asarray(np.isfinite(length) & (length > SHORTEST_NORMAL))


def with_directions(normals: Floats, faces: Integers, points: Floats) -> Floats:
    """Replace normals without a direction by the area-weighted mean of the adjacent faces.

    Args:
        normals: (V, 3) normals.
        faces: (F, 3) indices of vertices.
        points: (V, 3) vertices.

    Returns:
        (V, 3); along z where no adjacent face has an area.
    """
    corners = np.asarray(points, np.float64)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.stack([np.bincount(faces.ravel(), np.repeat(c, 3), len(points)) for c in across.T], axis=1)
    around = np.where(has_direction(sums)[:, None], sums, [0.0, 0.0, 1.0])
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    return np.where(has_direction(normals)[:, None], normals, around)


def triangulate(counts: Integers, indices: Integers, points: Floats) -> tuple[Integers, Integers]:
    """Split polygons into triangles.

    Args:
        counts: (P,) number of corners of each polygon.
        indices: (C,) index of the point at each corner.
        points: (V, 3) positions.

    Returns:
        (F, 3) indices of corners, and (F,) indices of polygons, in the order of the polygons.
    """
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    triangles: list[Integers] = []
    owners: list[Integers] = []
    for size in np.unique(counts):
        if size < 3:
            continue
        polygons = np.flatnonzero(counts == size)
        corner = starts[polygons, None] + np.arange(size)
        if size == 3:
            split = corner[:, None, :]
        elif size == 4:
            split = _split_quads(corner, points[indices[corner]])
        else:
            fan = np.array([[0, i, i + 1] for i in range(1, size - 1)])
            split = corner[:, fan]
            for row in np.flatnonzero(_concave(points[indices[corner]])):
                split[row] = corner[row][_split_polygon(points[indices[corner[row]]])]
        triangles.append(split.reshape(-1, 3))
        owners.append(np.repeat(polygons, split.shape[1]))
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _split_quads(corner: Integers, points: Floats) -> Integers:
    """Split quadrilaterals, (Q, 2, 3), along the first diagonal, or the second if the first one lies outside."""
    a, b, c, d = (points[:, i] for i in range(4))
    first = (np.cross(b - a, c - a) * np.cross(c - a, d - a)).sum(axis=1)
    second = (np.cross(c - b, d - b) * np.cross(d - b, a - b)).sum(axis=1)
    ways = np.array([[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]])
    way = ways[((first <= 0) & (second > first)).astype(np.int64)]
    return np.take_along_axis(corner[:, :, None], way.reshape(len(corner), 6, 1), axis=1).reshape(-1, 2, 3)


def _normals(points: Floats) -> Floats:
    """Normals of polygons, (P, 3), with length twice their area, from their corners, (P, N, 3)."""
    around = points - points[:, :1]
    return np.asarray(np.cross(around, np.roll(around, -1, axis=1)).sum(axis=1))


def _concave(points: Floats) -> NDArray[np.bool_]:
    """Which polygons are concave, (P,), from their corners, (P, N, 3)."""
    edges = np.roll(points, -1, axis=1) - points
    turns = np.einsum("pnx,px->pn", np.cross(np.roll(edges, 1, axis=1), edges), _normals(points))
    return np.asarray((turns < 0).any(axis=1) & np.isfinite(points).all(axis=(1, 2)))


def _split_polygon(points: Floats) -> Integers:
    """Triangles of one concave polygon, (N-2, 3); a fan if it crosses itself."""
    size = len(points)
    fan = np.array([[0, i, i + 1] for i in range(1, size - 1)])
    normal = _normals(points[None])[0]
    import mapbox_earcut

    drop = int(np.abs(normal).argmax())
    flat = np.ascontiguousarray(points[:, [(drop + 1) % 3, (drop + 2) % 3]])
    found = (
        mapbox_earcut.triangulate_float64(flat, np.array([size], np.uint32)).reshape(-1, 3).astype(np.int64)
    )
    if len(found) != size - 2:
        return fan
    a, b, c = (points[found[:, corner]] for corner in range(3))
    turned = np.cross(b - a, c - a) @ normal < 0
    found[turned] = found[turned][:, ::-1]
    return found
