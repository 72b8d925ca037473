"""Modelling primitives of the bundled scenes: small meshes made by lofting, lathing and extrusion.

World frame right-handed, z up, metres. Faces are counter-clockwise seen from outside. A mesh with normals is
shaded smoothly; a mesh without normals is faceted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_SMALLEST_AREA = 1e-9  # m²: triangles below this are dropped by `tidy`


@dataclass(frozen=True)
class Mesh:
    """Triangles in memory.

    Attributes:
        vertices: (V, 3) world position, metres.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside.
        normals: (V, 3) unit shading normals, or None for a faceted mesh.
    """

    vertices: Floats
    faces: Integers
    normals: Floats | None = None

    def transformed(self, matrix: ArrayLike, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """The mesh under x -> matrix @ x + offset; the matrix is a rotation or a reflection times a scale."""
        m = np.asarray(matrix, dtype=np.float64)
        faces = self.faces if np.linalg.det(m) > 0 else self.faces[:, ::-1]
        normals = None if self.normals is None else _unit(self.normals @ m.T)
        return Mesh(self.vertices @ m.T + np.asarray(offset, dtype=np.float64), faces, normals)

    def moved(self, offset: ArrayLike) -> Mesh:
        """The mesh translated by `offset`, metres."""
        return Mesh(self.vertices + np.asarray(offset, dtype=np.float64), self.faces, self.normals)

    def turned(self, angle: float) -> Mesh:
        """The mesh rotated about the z axis by `angle`, radians, counter-clockwise seen from above."""
        c, s = np.cos(angle), np.sin(angle)
        return self.transformed([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one; smooth only if all of them are."""
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    normals = [m.normals for m in meshes if m.normals is not None]
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate(normals) if len(normals) == len(meshes) else None,
    )


def areas(vertices: Floats, faces: Integers) -> Floats:
    """(F,) area of each triangle, m²."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))


def tidy(mesh: Mesh) -> Mesh:
    """The mesh without triangles of (almost) no area, which a loft makes where a profile pinches."""
    return Mesh(mesh.vertices, mesh.faces[areas(mesh.vertices, mesh.faces) > _SMALLEST_AREA], mesh.normals)


def box(lower: ArrayLike, upper: ArrayLike) -> Mesh:
    """A closed axis-aligned box between two corners."""
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    plan = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return loft([at_height(plan, low[2]), at_height(plan, high[2])])


def at_height(plan: ArrayLike, z: float) -> Floats:
    """(K, 3) ring of a plan outline (K, 2) at height z."""
    outline = np.asarray(plan, dtype=np.float64)
    return np.column_stack([outline, np.full(len(outline), z)])


def loft(rings: ArrayLike, *, caps: bool = True) -> Mesh:
    """A skin over stacked rings, each counter-clockwise seen from the last ring's side.

    Args:
        rings: (R, K, 3) positions; point k of a ring is joined to point k of the next.
        caps: close both ends with a fan; the end rings must then be star-shaped about their mean.
    """
    points = np.asarray(rings, dtype=np.float64)
    count, size = points.shape[:2]
    index = np.arange(count * size).reshape(count, size)
    after = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1].ravel(), after[:-1].ravel(), after[1:].ravel(), index[1:].ravel()
    faces = [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    vertices = [points.reshape(-1, 3)]
    if caps:
        for ring, order in ((0, -1), (-1, 1)):
            hub = count * size + len(vertices) - 1
            vertices.append(points[ring].mean(axis=0, keepdims=True))
            rim = np.column_stack([index[ring], after[ring]])[:, ::order]
            faces.append(np.column_stack([np.full(size, hub), rim]))
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def lathe(radii: ArrayLike, heights: ArrayLike) -> Mesh:
    """A smooth surface of revolution about the z axis, open at both ends, with ribs if the radii vary.

    Args:
        radii: (R, S) radius of ring r at azimuth 2 pi s / S, metres; all positive.
        heights: (R,) height of each ring, increasing, metres.
    """
    r, z = np.asarray(radii, dtype=np.float64), np.asarray(heights, dtype=np.float64)
    azimuth = np.linspace(0.0, 2 * np.pi, r.shape[1], endpoint=False)
    rings = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.broadcast_to(z[:, None], r.shape)], axis=2)
    along = np.gradient(rings, axis=0)
    around = np.roll(rings, -1, axis=1) - np.roll(rings, 1, axis=1)
    normals = _unit(np.cross(around, along).reshape(-1, 3))
    skin = loft(rings, caps=False)
    return Mesh(skin.vertices, skin.faces, normals)


def frustums(corners: Floats, tops: Floats) -> Mesh:
    """Many low blocks without bottoms: four sides from a lower to an upper quadrilateral, and the top.

    Args:
        corners: (N, 4, 3) lower quadrilaterals, counter-clockwise seen from outside.
        tops: (N, 4, 3) upper quadrilaterals, in the same order.
    """
    count = len(corners)
    vertices = np.concatenate([corners, tops], axis=1).reshape(-1, 3)
    quads = [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]]
    pattern = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    faces = (pattern[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return Mesh(vertices, faces)


def height_field(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Mesh:
    """An open smooth surface over a grid, seen from above.

    Args:
        x: (A, B) positions, metres, increasing along the first axis.
        y: (A, B) positions, increasing along the second axis (so that x, y, z are right-handed).
        z: (A, B) heights.
    """
    points = np.stack([np.asarray(v, dtype=np.float64) for v in (x, y, z)], axis=2)
    index = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    normals = _unit(np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1)).reshape(-1, 3))
    return Mesh(points.reshape(-1, 3), faces, normals)


def projected_uv(mesh: Mesh, scale: float) -> tuple[Mesh, Floats]:
    """Texture coordinates by projection along the dominant axis of each face's normal.

    Faces of a faceted mesh get separate vertices, because neighbours may be projected along different axes.

    Args:
        mesh: smooth or faceted.
        scale: size of the texture, metres.

    Returns:
        The mesh and its (V, 2) texture coordinates.
    """
    if mesh.normals is not None:
        axis = np.argmax(np.abs(mesh.normals), axis=1)
        return mesh, _drop_axis(mesh.vertices, axis) / scale
    corners = mesh.vertices[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.repeat(np.argmax(np.abs(facing), axis=1), 3)
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return Mesh(vertices, faces), _drop_axis(vertices, axis) / scale


def triangles(mesh: Mesh, bsdf: Mapping[str, Any], uv: Floats | None = None) -> dict[str, Any]:
    """The mesh as an entry of a scene description."""
    entry: dict[str, Any] = {
        "type": "triangles",
        "vertices": np.ascontiguousarray(mesh.vertices, dtype=np.float32),
        "faces": np.ascontiguousarray(mesh.faces, dtype=np.uint32),
    }
    if mesh.normals is not None:
        entry["normals"] = np.ascontiguousarray(mesh.normals, dtype=np.float32)
    if uv is not None:
        entry["uv"] = np.ascontiguousarray(uv, dtype=np.float32)
    entry["bsdf"] = dict(bsdf)
    return entry


def _drop_axis(vertices: Floats, axis: Integers) -> Floats:
    """(V, 2): the two coordinates other than `axis`, the vertical one last."""
    first = np.where(axis == 0, vertices[:, 1], vertices[:, 0])
    second = np.where(axis == 2, vertices[:, 1], vertices[:, 2])
    return np.column_stack([first, second])


def _unit(vectors: Floats) -> Floats:
    """Vectors scaled to length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
