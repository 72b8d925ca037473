"""Radiance's surfaces as triangles.

Orientation is kept: a polygon faces the side from which its corners run counter-clockwise. Spheres, cylinders and cones
face outward; bubbles, tubes and cups face inward.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.radiance.grammar import Primitive

Floats = NDArray[np.float64]

SURFACES: Final = (
    "polygon",
    "sphere",
    "bubble",
    "cylinder",
    "tube",
    "cone",
    "cup",
    "ring",
)
"""Kinds of local surfaces."""

SIDES: Final = 64
"""Number of flat pieces around a cylinder, a cone or a ring: areas are within 0.1 %."""

ROWS: Final = 32
"""Number of rows of flat pieces from pole to pole of a sphere."""

MOST_CORNERS: Final = 100_000
"""Maximum number of corners of a polygon."""

_COUNTS = {"sphere": 4, "bubble": 4, "cylinder": 7, "tube": 7, "cone": 8, "cup": 8, "ring": 8}


@dataclass(frozen=True)
class Triangles:
    """Triangles of one surface or of several.

    Attributes:
        vertices: (V, 3) world positions.
        faces: (F, 3) indices of vertices, counter-clockwise seen from the front.
        normals: (V, 3) unit normals of a curved surface, otherwise None.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats | None = None

    @property
    def area(self) -> float:
        """Sum of all areas, m²."""
        return float(self.areas.sum())

    @property
    def areas(self) -> Floats:
        """Area of each triangle, (F,), m²."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        areas: Floats = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        return areas

    @property
    def entry(self) -> dict[str, Any]:
        """The triangles as a mesh of a scene description."""
        held: dict[str, Any] = {
            "type": "triangles",
            "vertices": self.vertices.astype(np.float32),
            "faces": self.faces.astype(np.uint32),
        }
        return held if self.normals is None else held | {"normals": self.normals.astype(np.float32)}


def joined(parts: Sequence[Triangles]) -> Triangles:
    """Several as one; with normals only if all have them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    smooth = [part.normals for part in parts if part.normals is not None]
    return Triangles(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate(smooth) if len(smooth) == len(parts) else None,
    )


def triangles_of(surface: Primitive) -> Triangles:
    """Triangles of a local surface; without faces if it has no area.

    Raises:
        SceneError: its numbers do not describe such a surface.
    """
    numbers = np.array(surface.numbers, np.float64)
    if surface.kind == "polygon":
        return _polygon(surface, numbers)
    wanted = _COUNTS[surface.kind]
    if len(numbers) != wanted:
        raise fault(surface, f"has {len(numbers)} numbers where {wanted} are expected")
    if surface.kind in ("sphere", "bubble"):
        return _sphere(surface, numbers)
    if surface.kind == "ring":
        return _ring(surface, numbers)
    return _cone(surface, numbers)


def fault(primitive: Primitive, what: str) -> SceneError:
    """An error about a primitive."""
    return SceneError(f"{primitive.place}: {primitive.kind} `{primitive.name}` {what}")


def _polygon(surface: Primitive, numbers: Floats) -> Triangles:
    """A flat polygon; holes are joined to the outline by a seam that is traversed in both directions."""
    if len(numbers) % 3 or not 9 <= len(numbers) <= 3 * MOST_CORNERS:
        raise fault(
            surface, f"has {len(numbers)} numbers; a polygon has three for each of its three or more corners"
        )
    corners = numbers.reshape(-1, 3)
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners - corners[0], following - corners[0]).sum(axis=0) / 2
    area = np.linalg.norm(normal)
    if not area > 0:
        return Triangles(corners, np.zeros((0, 3), np.int64))
    if len(corners) == 3:
        return Triangles(corners, np.array([[0, 1, 2]]))
    turns = np.cross(following - corners, np.roll(following, -1, axis=0) - following) @ normal
    if len(corners) == 4 and (turns > 0).all():
        return Triangles(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    import mapbox_earcut

    axis = int(np.argmax(np.abs(normal)))
    across = [(axis + 1) % 3, (axis + 2) % 3]
    flat = np.ascontiguousarray(corners[:, across])
    found = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    faces = found.reshape(-1, 3).astype(np.int64)
    a, b, c = (corners[faces[:, corner]] for corner in range(3))
    turned = np.cross(b - a, c - a) @ normal < 0
    faces[turned] = faces[turned][:, ::-1]
    return Triangles(corners, faces)


def _sphere(surface: Primitive, numbers: Floats) -> Triangles:
    """A sphere in rows of flat pieces; where possible, the converter uses Mitsuba's `sphere` instead."""
    *centre, radius = numbers.tolist()
    inward = (surface.kind == "bubble") != (radius < 0)
    if radius == 0:
        raise fault(surface, "has radius 0")
    polar, azimuth = np.linspace(0, np.pi, ROWS + 1), np.arange(SIDES) / SIDES * 2 * np.pi
    unit = np.stack(
        [
            np.outer(np.sin(polar), np.cos(azimuth)),
            np.outer(np.sin(polar), np.sin(azimuth)),
            np.outer(np.cos(polar), np.ones(SIDES)),
        ],
        axis=2,
    ).reshape(-1, 3)
    faces = _grid_faces(ROWS + 1)
    return Triangles(
        np.array(centre) + abs(radius) * unit,
        faces[:, ::-1] if inward else faces,
        -unit if inward else unit,
    )


def _grid_faces(rows: int) -> NDArray[np.int64]:
    """Triangles between rows of SIDES points; outward if rows go down and points counter-clockwise."""
    row, side = np.meshgrid(np.arange(rows - 1), np.arange(SIDES), indexing="ij")
    a, b = row * SIDES + side, row * SIDES + (side + 1) % SIDES
    below = np.stack([a, a + SIDES, b + SIDES], axis=2), np.stack([a, b + SIDES, b], axis=2)
    return np.concatenate([part.reshape(-1, 3) for part in below])


def _cone(surface: Primitive, numbers: Floats) -> Triangles:
    """A cone, cup, cylinder or tube, without its ends."""
    start, end = numbers[:3], numbers[3:6]
    radii = numbers[6:] if len(numbers) == 8 else np.repeat(numbers[6:], 2)
    axis = end - start
    length = float(np.linalg.norm(axis))
    inward = surface.kind in ("cup", "tube")
    if surface.kind in ("cylinder", "tube") and radii[0] < 0:
        inward, radii = not inward, -radii
    if not length > 0 or (radii < 0).any() or not radii.any():
        raise fault(surface, "has no length, or radii that are negative or all 0")
    axis /= length
    ring = _circle(axis)
    vertices = np.concatenate([end + radii[1] * ring, start + radii[0] * ring])
    slope = (radii[0] - radii[1]) / length
    normal = ring + slope * axis
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    at_start, at_end = np.split(_grid_faces(2), 2)  # triangles with an edge on that circle
    faces = np.concatenate(
        [half for half, radius in ((at_start, radii[0]), (at_end, radii[1])) if radius > 0]
    )
    normals = np.concatenate([normal, normal])
    return Triangles(vertices, faces[:, ::-1] if inward else faces, -normals if inward else normals)


def _ring(surface: Primitive, numbers: Floats) -> Triangles:
    """A flat ring, or a disc if one radius is 0."""
    centre, normal = numbers[:3], numbers[3:6]
    inner, outer = sorted(numbers[6:].tolist())
    length = float(np.linalg.norm(normal))
    if not length > 0 or inner < 0 or outer <= inner:
        raise fault(surface, "has no normal, or no two radii of at least 0 that differ")
    ring = _circle(normal / length)
    return Triangles(np.concatenate([centre + inner * ring, centre + outer * ring]), _grid_faces(2))


def _circle(axis: Floats) -> Floats:
    """Points of a unit circle around an axis, counter-clockwise seen from its end, (SIDES, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = np.arange(SIDES) / SIDES * 2 * np.pi
    circle: Floats = np.outer(np.cos(angle), u) + np.outer(np.sin(angle), v)
    return circle


def bounds(parts: Iterable[Triangles]) -> tuple[Floats, Floats]:
    """Lower and upper corner of all parts; infinite if there are none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for part in parts:
        if len(part.vertices):
            low = np.minimum(low, part.vertices.min(axis=0))
            high = np.maximum(high, part.vertices.max(axis=0))
    return low, high
