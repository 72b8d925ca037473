"""Modelling primitives of the interiors: meshes from profiles and sheets, merged into one mesh per material.

Metres, z up, right-handed; triangles run counter-clockwise seen from outside. A mesh with normals is shaded
smoothly; a mesh without normals is faceted.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LAMP_WEIGHT = 5.0
"""How much more often an area light is sampled than a spotlight, because it illuminates more surfaces."""


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (V, 3) positions, metres.
        faces: (F, 3) indices into `vertices`.
        normals: (V, 3) unit shading normals, or None for a faceted surface.
        uv: (V, 2) texture coordinates, or None.
    """

    vertices: Floats
    faces: Ints
    normals: Floats | None = None
    uv: Floats | None = None

    def transformed(self, matrix: Floats) -> Mesh:
        """The mesh under a 4x4 rigid or uniformly scaled transform."""
        linear = matrix[:3, :3]
        normals = None
        if self.normals is not None:
            normals = self.normals @ linear.T
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return replace(self, vertices=self.vertices @ linear.T + matrix[:3, 3], normals=normals)

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """The mesh translated, metres."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, degrees: float) -> Mesh:
        """The mesh rotated counter-clockwise about the z axis through the origin."""
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        matrix = np.eye(4)
        matrix[:2, :2] = [[c, -s], [s, c]]
        return self.transformed(matrix)

    def mapped(self, first: int, second: int, scale: float) -> Mesh:
        """The mesh with a planar texture projection along two world axes, repeating every `scale` metres."""
        return replace(self, uv=self.vertices[:, [first, second]] / scale)


def join(meshes: Iterable[Mesh]) -> Mesh:
    """Several meshes as one; all or none must have normals, and all or none uv."""
    parts = list(meshes)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    normals = [part.normals for part in parts if part.normals is not None]
    uv = [part.uv for part in parts if part.uv is not None]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate(normals) if normals else None,
        np.concatenate(uv) if uv else None,
    )


def box(low: ArrayLike, high: ArrayLike) -> Mesh:
    """An axis-aligned block between two corners."""
    ends = np.array([low, high], dtype=np.float64)
    corner = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(np.take_along_axis(ends, corner, axis=0), faces)


def chamfered_box(low: ArrayLike, high: ArrayLike, chamfer: float) -> Mesh:
    """A block with edges chamfered by `chamfer` metres."""
    start, end = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
    inner = box(start + chamfer, end - chamfer).vertices
    middle = (start + end) / 2
    shifts = np.sign(inner - middle)[:, None, :] * np.eye(3) * chamfer
    return convex_hull((inner[:, None, :] + shifts).reshape(-1, 3))


def convex_hull(points: Floats) -> Mesh:
    """The convex hull of (N, 3) points, with faces outward."""
    from scipy.spatial import ConvexHull  # SciPy takes longer to load than `plan` needs

    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    corners = points[faces]
    flipped = (
        np.einsum(
            "ij,ij->i",
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
            hull.equations[:, :3],
        )
        < 0
    )
    faces[flipped] = faces[flipped][:, ::-1]
    return Mesh(points.copy(), faces)


def quad(corner: ArrayLike, right: ArrayLike, up: ArrayLike) -> Mesh:
    """A rectangle facing right x up; an image on it appears upright (v runs down, like rows)."""
    start, u, v = (np.array(a, dtype=np.float64) for a in (corner, right, up))
    return Mesh(
        np.stack([start, start + u, start + u + v, start + v]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        uv=np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]),
    )


def sheet(points: Floats, *, wrap_rows: bool = False, wrap_columns: bool = False) -> Mesh:
    """A smooth surface through a grid of points (R, C, 3); it faces columns x rows.

    A row whose points all coincide becomes one vertex (a pole). `wrap_*` joins the last row or column to
    the first.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    poles = np.ptp(points, axis=1).max(axis=1) < 1e-9
    index[poles] = index[poles, :1]
    if wrap_rows:
        index = np.concatenate([index, index[:1]])
    if wrap_columns:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    sides = faces[:, [1, 2, 0]]
    faces = faces[np.all(faces != sides, axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return smoothed(Mesh(points.reshape(-1, 3)[used], faces.reshape(-1, 3)))


def smoothed(mesh: Mesh) -> Mesh:
    """The mesh with normals averaged over the faces that share a vertex, by area."""
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(normals, mesh.faces[:, k], area)
    return replace(mesh, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))


def lathe(*profiles: Sequence[tuple[float, float]] | Floats, segments: int = 32) -> Mesh:
    """A surface of revolution about the z axis; each profile of (radius, z) is smooth, with creases in between.

    A profile that rises faces away from the axis; one that falls faces it.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(segments)], -1)
    parts = []
    for profile in profiles:
        r, z = np.array(profile, dtype=np.float64).T
        parts.append(
            sheet(circle * r[:, None, None] + np.array([0.0, 0.0, 1.0]) * z[:, None, None], wrap_columns=True)
        )
    return join(parts)


def tube(path: ArrayLike, radius: ArrayLike, *, sides: int = 12, closed: bool = False) -> Mesh:
    """A pipe along (N, 3) points; `radius` is one number or one per point. Open ends are capped.

    The cross-section does not twist about the path (parallel transport), or, if the path is closed, by
    the smallest angle that joins the ends.
    """
    points = np.array(path, dtype=np.float64)
    n = len(points)
    step = np.roll(points, -1, 0) - np.roll(points, 1, 0) if closed else np.gradient(points, axis=0)
    ahead = step / np.linalg.norm(step, axis=1, keepdims=True)
    across = np.zeros((n, 3))
    start = np.eye(3)[np.argmin(np.abs(ahead[0]))]
    across[0] = start - ahead[0] * (start @ ahead[0])
    for k in range(1, n):
        across[k] = across[k - 1] - ahead[k] * (across[k - 1] @ ahead[k])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(ahead, across)
    twist = np.zeros(n)
    if closed:
        end = across[-1] - ahead[0] * (across[-1] @ ahead[0])
        twist = -np.linspace(0.0, 1.0, n) * np.arctan2(end @ up[0], end @ across[0])
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False) + twist[:, None]
    around = np.cos(angle)[..., None] * across[:, None] + np.sin(angle)[..., None] * up[:, None]
    rings = points[:, None] + around * np.broadcast_to(np.array(radius, dtype=np.float64), n)[:, None, None]
    parts = [sheet(rings, wrap_rows=closed, wrap_columns=True)]
    if not closed:
        for ring, centre in ((rings[0], points[0]), (rings[-1], points[-1])):
            rows = [np.broadcast_to(centre, ring.shape), ring]
            parts.append(sheet(np.stack(rows if ring is rings[0] else rows[::-1]), wrap_columns=True))
    return join(parts)


def moulding(path: ArrayLike, profile: ArrayLike, *, closed: bool = False) -> Mesh:
    """A strip of constant profile along a polyline in the x-y plane, with mitred corners and open ends.

    Args:
        path: (N, 2) corners.
        profile: (P, 2) of (offset to the left of the path, height along z); it faces outward when it rises on
            the right and falls on the left. Ends should extend into adjoining parts.
        closed: whether the last corner connects to the first.
    """
    corners, section = np.array(path, dtype=np.float64), np.array(profile, dtype=np.float64)
    n, p = len(corners), len(section)
    along = np.roll(corners, -1, 0) - corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.stack([-along[:, 1], along[:, 0]], 1)
    before = np.roll(left, 1, 0)
    if not closed:
        left[-1], before[0] = left[-2], left[0]
        before[-1] = left[-2]
    mitre = (left + before) / (1.0 + np.sum(left * before, axis=1, keepdims=True))
    flat = corners[:, None, :] + mitre[:, None, :] * section[None, :, :1]
    points = np.concatenate([flat, np.broadcast_to(section[None, :, 1:], (n, p, 1))], axis=2).reshape(-1, 3)
    runs = n if closed else n - 1
    k, i = np.meshgrid(np.arange(runs), np.arange(p - 1), indexing="ij")
    a, b = (k * p + i).ravel(), ((k + 1) % n * p + i).ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)]))


def standing(origin: ArrayLike, facing_degrees: float) -> Floats:
    """The 4x4 transform that puts the x-y plane upright on a wall: y becomes up, z becomes the facing.

    Args:
        origin: world position of (0, 0, 0).
        facing_degrees: direction the wall faces, counter-clockwise from +x; seen from there, x runs right.
    """
    c, s = np.cos(np.radians(facing_degrees)), np.sin(np.radians(facing_degrees))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]]).T
    matrix[:3, 3] = origin
    return matrix


@dataclass
class Model:
    """Collects meshes by material and returns them as a small number of scene entries.

    Attributes:
        materials: Mitsuba BSDF of each material, by name.
    """

    materials: Mapping[str, Mapping[str, Any]]
    _parts: dict[tuple[str, bool, bool], list[Mesh]] = field(default_factory=dict)
    _extra: dict[str, Any] = field(default_factory=dict)

    def add(self, material: str, *meshes: Mesh) -> None:
        """Add meshes of one material; raises KeyError for an unknown material."""
        if material not in self.materials:
            raise KeyError(material)
        for mesh in meshes:
            key = (material, mesh.normals is not None, mesh.uv is not None)
            self._parts.setdefault(key, []).append(mesh)

    def add_lamp(self, name: str, radiance: Sequence[float], *panels: Mesh) -> None:
        """Add faceted panels that emit `radiance` (W/(m² sr), RGB) on the side they face.

        Each is a separate emitter, so that a renderer that selects emitters can select nearby ones.
        """
        emitter = {
            "type": "area",
            "radiance": {"type": "rgb", "value": list(radiance)},
            "sampling_weight": LAMP_WEIGHT,
        }
        for number, panel in enumerate(panels, start=1):
            self._extra[f"{name}_{number}"] = {**_entry(panel, diffuse(0.6)["bsdf"]), "emitter": emitter}

    def add_spot(self, name: str, origin: ArrayLike, target: ArrayLike, intensity: Sequence[float]) -> None:
        """Add a spotlight (intensity in W/sr, RGB) with a soft edge from 20 to 32 degrees off its axis."""
        self._extra[name] = {
            "type": "spot",
            "to_world": looking(origin, target),
            "intensity": {"type": "rgb", "value": list(intensity)},
            "cutoff_angle": 32.0,
            "beam_width": 20.0,
        }

    def content(self) -> dict[str, Any]:
        """Everything that was added, as content of a scene description."""
        entries: dict[str, Any] = {"type": "scene"}
        for (material, smooth, textured), parts in self._parts.items():
            name = material + ("-smooth" if smooth else "") + ("-uv" if textured else "")
            entries[name] = _entry(join(parts), self.materials[material])
        return {**entries, **self._extra}


def _entry(mesh: Mesh, bsdf: Mapping[str, Any]) -> dict[str, Any]:
    """A mesh in the syntax of the scene description."""
    entry: dict[str, Any] = {
        "type": "triangles",
        "vertices": np.ascontiguousarray(mesh.vertices, dtype=np.float32),
        "faces": np.ascontiguousarray(mesh.faces, dtype=np.uint32),
        "bsdf": dict(bsdf),
    }
    if mesh.normals is not None:
        entry["normals"] = np.ascontiguousarray(mesh.normals, dtype=np.float32)
    if mesh.uv is not None:
        entry["uv"] = np.ascontiguousarray(mesh.uv, dtype=np.float32)
    return entry


def looking(origin: ArrayLike, target: ArrayLike) -> Floats:
    """The 4x4 transform that points +z from `origin` to `target` (which must not be vertical; tilt it slightly)."""
    start, end = np.array(origin, dtype=np.float64), np.array(target, dtype=np.float64)
    ahead = (end - start) / np.linalg.norm(end - start)
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :4] = np.column_stack([left, np.cross(ahead, left), ahead, start])
    return matrix


def diffuse(reflectance: float | Sequence[float] | NDArray[np.float32]) -> dict[str, Any]:
    """A two-sided matte material of a grey, a linear RGB colour, or an image (H, W, 3)."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour(reflectance)}}


def plastic(reflectance: float | Sequence[float] | NDArray[np.float32], alpha: float) -> dict[str, Any]:
    """A two-sided matte material under a clear coat of GGX roughness `alpha`."""
    return {
        "type": "twosided",
        "bsdf": {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": alpha,
            "diffuse_reflectance": colour(reflectance),
        },
    }


def metal(name: str, alpha: float) -> dict[str, Any]:
    """A two-sided rough conductor; `name` is a material of Mitsuba's measured data."""
    return {
        "type": "twosided",
        "bsdf": {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": name},
    }


def colour(value: float | Sequence[float] | NDArray[np.float32]) -> dict[str, Any]:
    """A grey, a linear RGB colour, or an image, as a Mitsuba texture."""
    if isinstance(value, np.ndarray):
        return {"type": "bitmap", "data": value, "raw": True, "filter_type": "bilinear"}
    rgb = [value] * 3 if isinstance(value, int | float) else list(value)
    return {"type": "rgb", "value": rgb}
