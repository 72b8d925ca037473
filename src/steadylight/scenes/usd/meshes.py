"""Geometry of USD prims as triangles: polygons, shading normals, texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.polygons import triangulate

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Geometry:
    """Polygons, with values at their corners.

    Attributes:
        points: (V, 3) positions, in the prim's own frame.
        triangles: (F, 3) indices of corners.
        corners: (C,) index of the point at each corner.
        face: (F,) index of the polygon that each triangle belongs to.
        normals: (C, 3), or None for flat polygons.
        uv: (C, 2) texture coordinates by name, v downward from the top of the image.
        colors: (C, 3), linear RGB; or None.
    """

    points: Floats
    triangles: Integers
    corners: Integers
    face: Integers
    normals: Floats | None
    uv: dict[str, Floats]
    colors: Floats | None

    def entry(
        self, to_world: Floats, faces: NDArray[np.bool_] | None, uv: str | None
    ) -> dict[str, Any] | None:
        """A mesh of a scene description; None if it has no area.

        Args:
            to_world: (4, 4) transform of the points.
            faces: (F,) mask of the triangles to include; all if None.
            uv: name of the texture coordinates; the first ones if None or unknown.
        """
        triangles = self.triangles if faces is None else self.triangles[faces]
        if not (np.isfinite(self.points).all() and np.isfinite(to_world).all()):
            raise SceneError("has points, or a transform, that are not finite")
        vertices = self.points @ to_world[:3, :3].T + to_world[:3, 3]
        coordinates = self.uv.get(uv or "", next(iter(self.uv.values()), None))
        parts: dict[str, Floats] = {}
        if self.normals is not None:
            turned = self.normals @ _normal_matrix(to_world).T
            parts["normals"] = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
        if coordinates is not None:
            parts["uv"] = coordinates
        if self.colors is not None:
            parts["colors"] = self.colors
        if np.linalg.det(to_world[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        return _welded(vertices, self.corners, triangles, parts)


def _normal_matrix(to_world: Floats) -> Floats:
    """Inverse transpose, (3, 3), up to a positive factor; finite even for flattened objects."""
    a, b, c = to_world[:3, :3].T
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    return np.asarray(cofactors * (1.0 if np.linalg.det(to_world[:3, :3]) >= 0 else -1.0))


def _welded(
    vertices: Floats, corners: Integers, triangles: Integers, parts: dict[str, Floats]
) -> dict[str, Any] | None:
    """Merge equal corners into one vertex, and drop triangles without area."""
    used = np.unique(triangles)
    rows = [corners[used, None].astype(np.float64), *(value[used] for value in parts.values())]
    key = np.ascontiguousarray(np.concatenate(rows, axis=1).astype(np.float32) + np.float32(0))
    key = np.concatenate([corners[used, None].astype(np.int32), key[:, 1:].view(np.int32)], axis=1)
    packed = np.ascontiguousarray(key).view(np.dtype((np.void, key.shape[1] * 4))).ravel()
    _, first, number = np.unique(packed, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # vertices keep the order of the file
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    chosen = used[first[order]]
    new = np.zeros(len(corners), dtype=np.int64)
    new[used] = rank[number.ravel()]
    faces = new[triangles]
    positions = vertices[corners[chosen]].astype(np.float32)
    a, b, c = (positions[faces[:, i]] for i in range(3))
    faces = faces[(np.cross(b - a, c - a) != 0).any(axis=1)]
    if not len(faces):
        return None
    entry: dict[str, Any] = {"type": "triangles", "vertices": positions, "faces": faces.astype(np.uint32)}
    return entry | {name: value[chosen].astype(np.float32) for name, value in parts.items()}


def mesh(prim: Any, time: Any) -> Geometry | None:
    """Geometry of a UsdGeomMesh; None if it has no polygons.

    Raises:
        SceneError: its arrays are not consistent.
    """
    from pxr import UsdGeom

    given = UsdGeom.Mesh(prim)
    points = _array(given.GetPointsAttr().Get(time), 3)
    counts = _array(given.GetFaceVertexCountsAttr().Get(time), 0).astype(np.int64)
    indices = _array(given.GetFaceVertexIndicesAttr().Get(time), 0).astype(np.int64)
    if not len(counts) or not len(points):
        return None
    if (counts < 0).any() or counts.sum() != len(indices):
        raise SceneError(f"has {len(indices)} corners, but its polygons need {counts.sum()}")
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        wrong = indices.max() if indices.min() >= 0 else indices.min()
        raise SceneError(f"refers to point {wrong}, but there are {len(points)} points")
    triangles, face = triangulate(counts, indices, points)
    holes = _array(given.GetHoleIndicesAttr().Get(time), 0).astype(np.int64)
    if len(holes):
        kept = ~np.isin(face, holes)
        triangles, face = triangles[kept], face[kept]
    if not len(triangles):
        return None
    if given.GetOrientationAttr().Get(time) == "leftHanded":
        triangles = triangles[:, ::-1]
    sizes = _Sizes(len(points), len(counts), counts, indices)
    primvars = UsdGeom.PrimvarsAPI(prim)
    normals = sizes.corner_values(primvars.FindPrimvarWithInheritance("normals"), time, 3)
    if normals is None and given.GetNormalsAttr().HasAuthoredValue():
        values = _array(given.GetNormalsAttr().Get(time), 3)
        normals = sizes.spread("normals", values, given.GetNormalsInterpolation())
    colors = sizes.corner_values(primvars.FindPrimvarWithInheritance("displayColor"), time, 3)
    return Geometry(points, triangles, indices, face, normals, sizes.uv(primvars, time), colors)


@dataclass(frozen=True)
class _Sizes:
    """Number of points, polygons and corners of a mesh."""

    points: int
    polygons: int
    counts: Integers
    indices: Integers

    def uv(self, primvars: Any, time: Any) -> dict[str, Floats]:
        """All sets of texture coordinates, `st` first, v downward."""
        found = {}
        for primvar in primvars.FindPrimvarsWithInheritance():
            kind = str(primvar.GetTypeName())
            if kind.startswith("texCoord2") or (
                kind.startswith("float2") and primvar.GetPrimvarName() in ("st", "uv")
            ):
                values = self.corner_values(primvar, time, 2)
                if values is not None:
                    found[str(primvar.GetPrimvarName())] = values * [1.0, -1.0] + [0.0, 1.0]
        return dict(sorted(found.items(), key=lambda item: (item[0] not in ("st", "UVMap"), item[0])))

    def corner_values(self, primvar: Any, time: Any, width: int) -> Floats | None:
        """Values of a primvar at the corners, (C, width); None if it has none."""
        if not primvar or not primvar.HasValue():
            return None
        name = str(primvar.GetPrimvarName())
        values = primvar.ComputeFlattened(time)
        if values is None:
            raise SceneError(f"primvars:{name} has indices beyond its values")
        kept = _array(values, width)
        return self.spread(name, kept, str(primvar.GetInterpolation())) if len(kept) else None

    def spread(self, name: str, values: Floats, interpolation: str) -> Floats:
        """Spread values with an interpolation over the corners."""
        corners = len(self.indices)
        match interpolation:
            case "constant":
                wanted, at = 1, np.zeros(corners, np.int64)
            case "uniform":
                wanted, at = self.polygons, np.repeat(np.arange(self.polygons), self.counts)
            case "vertex" | "varying":
                wanted, at = self.points, self.indices
            case _:
                wanted, at = corners, np.arange(corners)
        if len(values) < wanted or not np.isfinite(values).all():
            raise SceneError(
                f"has {len(values)} values of {name} ({interpolation}); {wanted} finite ones are needed"
            )
        return np.asarray(values[at])


def _array(value: Any, width: int) -> Floats:
    """USD's array as float64, (N,) or (N, width)."""
    if value is None:
        return np.zeros((0, width) if width else 0)
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(
            f"has an attribute that does not have the type that USD prescribes ({type(value).__name__})"
        ) from None
    if width and found.size % width:
        raise SceneError(
            f"has an attribute that does not have the type that USD prescribes: {width} numbers are needed for each "
            "element"
        )
    return found.reshape(-1, width) if width else found.ravel()
