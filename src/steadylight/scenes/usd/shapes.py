"""The basic shapes of USD (sphere, cube, cylinder, cone, capsule, plane) as triangles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.usd.meshes import Geometry

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

KINDS: Final = ("Sphere", "Cube", "Cylinder", "Cone", "Capsule", "Plane")
_AROUND: Final = 96
"""Number of segments of a round shape: polygon and circle differ by 0.05 % of the radius."""


def shape(prim: Any, time: Any) -> Geometry | None:
    """Geometry of a basic shape; None if it has no size, or is none of `KINDS`."""

    def get(name: str, default: Any) -> Any:
        value = prim.GetAttribute(name).Get(time)
        return default if value is None else value

    kind, axis = str(prim.GetTypeName()), str(get("axis", "Z"))
    radius, height = float(get("radius", 1.0)), float(get("height", 2.0))
    if kind == "Cube":
        return _box(float(get("size", 2.0)) / 2)
    if kind == "Plane":
        return _plane(float(get("width", 2.0)) / 2, float(get("length", 2.0)) / 2, axis)
    made = {"Sphere": _sphere, "Capsule": _capsule, "Cylinder": _cylinder, "Cone": _cone}.get(kind)
    if made is None:
        return None
    return _turned(made(radius, height), "Z" if kind == "Sphere" else axis)


Profile = tuple[Floats, Floats]
"""Half of an outline from bottom to top, (radius, height), and its normals, (outward, upward)."""


def _sphere(radius: float, _: float) -> list[Profile]:
    angle = np.linspace(-np.pi / 2, np.pi / 2, _AROUND // 2 + 1)
    profile = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return [(profile, profile)]


def _capsule(radius: float, height: float) -> list[Profile]:
    angle = np.linspace(0, np.pi / 2, _AROUND // 4 + 1)
    high = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    low = high[::-1] * [1, -1]
    up = np.array([0.0, height / 2])
    return [(np.concatenate([low - up, high + up]), np.concatenate([low, high]))]


def _cylinder(radius: float, height: float) -> list[Profile]:
    side = np.array([[radius, -height / 2], [radius, height / 2]])
    out = np.array([[1.0, 0.0], [1.0, 0.0]])
    return [_disk(radius, -height / 2), (side, out), _disk(radius, height / 2)]


def _cone(radius: float, height: float) -> list[Profile]:
    side = np.array([[radius, -height / 2], [0.0, height / 2]])
    return [_disk(radius, -height / 2), (side, np.array([[height, radius], [height, radius]]))]


def _disk(radius: float, z: float) -> Profile:
    """Profile of an end of a solid of revolution, facing away from the middle."""
    profile = np.array([[0.0, z], [radius, z]])
    return (profile if z < 0 else profile[::-1]), np.array([[0.0, np.sign(z)]] * 2)


def _turned(profiles: Sequence[Profile], axis: str) -> Geometry | None:
    """A solid of revolution, from profiles in order from bottom to top."""
    turn = np.linspace(0, 2 * np.pi, _AROUND + 1)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points: list[Floats] = []
    normals: list[Floats] = []
    uv: list[Floats] = []
    triangles: list[Integers] = []
    offset = 0
    for profile, normal in profiles:
        rows = len(profile)
        for values, out in ((profile, points), (normal, normals)):
            ring = np.concatenate(
                [values[:, None, :1] * around, np.repeat(values[:, None, 1:], _AROUND + 1, axis=1)], axis=2
            )
            out.append(ring.reshape(-1, 3))
        grid = np.meshgrid(turn / (2 * np.pi), np.linspace(1, 0, rows))
        uv.append(np.stack(grid, axis=2).reshape(-1, 2))
        at = offset + np.arange(rows * (_AROUND + 1)).reshape(rows, _AROUND + 1)
        a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
        triangles.append(np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3))
        offset += rows * (_AROUND + 1)
    turned = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}[axis]
    corner = np.concatenate(points)[:, turned]
    direction = np.concatenate(normals)[:, turned]
    if not np.ptp(corner, axis=0).any():
        return None
    faces = np.concatenate(triangles)
    number = np.arange(len(corner))
    return Geometry(corner, faces, number, np.arange(len(faces)), direction, {"st": np.concatenate(uv)}, None)


def _box(half: float) -> Geometry:
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.array([[-1.0, -1, sign], [1, -1, sign], [1, 1, sign], [-1, 1, sign]]) * half
            sides.append(np.roll(side if sign > 0 else side[::-1], axis + 1, axis=1))
    return _quads(np.array(sides))


def _plane(half_width: float, half_length: float, axis: str) -> Geometry:
    """A plane with its width along x (z if its axis is x) and its length along y (z if it is y), as in UsdGeomPlane."""
    across = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) * [half_width, half_length]
    zero = np.zeros((4, 1))
    u, v = across[:, :1], across[:, 1:]
    columns = {"X": (zero, v, u), "Y": (u, zero, v), "Z": (u, v, zero)}[axis]
    corners = np.concatenate(columns, axis=1)
    return _quads((corners if axis == "Z" else corners[::-1])[None])


def _quads(corners: Floats) -> Geometry:
    """Flat quadrilaterals, (Q, 4, 3), each with a whole image."""
    count = len(corners)
    number = np.arange(4 * count).reshape(count, 4)
    triangles = number[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    uv = np.tile([[0.0, 1.0], [1, 1], [1, 0], [0, 0]], (count, 1))
    return Geometry(
        corners.reshape(-1, 3),
        triangles,
        number.ravel(),
        np.repeat(np.arange(count), 2),
        None,
        {"st": uv},
        None,
    )
