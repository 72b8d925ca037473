"""The bare building: rooms, openings and recesses carved out of a solid, as one closed surface.

Carving a solid instead of building walls prevents light leaks: the surface between air and solid
is closed by construction, its quads share their corners, and no two of them overlap.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.furnishings import Floats, Ints, Mesh

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

Hollow = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner of a block of air, metres."""

Point = tuple[float, float]


def hollow_out(hollows: Sequence[Hollow], material: Callable[[Floats, Floats], str]) -> dict[str, Mesh]:
    """The surface around the union of blocks of air, facing the air, by material.

    Args:
        hollows: blocks of air; they may touch and overlap.
        material: returns the material name of a quad from its centre (3,) and unit normal (3,).

    Returns:
        One mesh per material. Neighbouring quads meet corner to corner, without T-junctions.
    """
    blocks = np.array(hollows, dtype=np.float64)
    lines = [np.unique(np.round(blocks[:, :, axis], 6)) for axis in range(3)]
    air = np.zeros([len(line) + 1 for line in lines], dtype=bool)  # surrounded by a layer of solid
    for low, high in np.round(blocks, 6):
        i, j, k = (
            slice(int(np.searchsorted(line, a)) + 1, int(np.searchsorted(line, b)) + 1)
            for line, a, b in zip(lines, low, high, strict=True)
        )
        air[i, j, k] = True
    quads: dict[str, list[Floats]] = {}
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = np.eye(3)[axis] * sign
            for corners in _quads(air, lines, axis, facing_up=sign > 0):
                quads.setdefault(material(corners.mean(axis=0), normal), []).append(corners)
    return {name: _welded(np.array(group)) for name, group in quads.items()}


def _quads(air: np.ndarray, lines: list[Floats], axis: int, *, facing_up: bool) -> Floats:
    """Corners (Q, 4, 3) of the quads normal to one axis between solid and air, counter-clockwise seen from the air."""
    filled = np.moveaxis(air, axis, 0)
    edge = ~filled[:-1] & filled[1:] if facing_up else filled[:-1] & ~filled[1:]
    plane, first, second = np.nonzero(edge)  # between the cells `plane` and `plane + 1` lies line `plane`
    u, v = [a for a in range(3) if a != axis]
    if (axis == 1) == facing_up:  # keep (u, v, axis) right-handed, seen from the air
        order: list[tuple[int, int]] = [(0, 0), (0, 1), (1, 1), (1, 0)]
    else:
        order = [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = np.empty((len(plane), 4, 3))
    for k, (du, dv) in enumerate(order):
        corners[:, k, axis] = lines[axis][plane]
        corners[:, k, u] = lines[u][first - 1 + du]
        corners[:, k, v] = lines[v][second - 1 + dv]
    return corners


def _welded(quads: Floats) -> Mesh:
    """Quads (Q, 4, 3) as triangles that share their corners."""
    vertices, index = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    ring: Ints = index.reshape(-1, 4).astype(np.int64)
    return Mesh(vertices, np.concatenate([ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]]))


def broken_path(path: Sequence[Point], gaps: Sequence[Point], half: float) -> list[list[Point]]:
    """Cut the stretches within `half` of the gaps out of a polyline; returns the remaining polylines.

    Args:
        path: corners (x, y), metres.
        gaps: points on the path; points off the path have no effect.
        half: half of the length that is cut out around a gap, less than the distance to the next corner.

    Returns:
        The remaining polylines, in order.
    """
    parts: list[list[Point]] = [[path[0]]]
    for start, end in itertools.pairwise(path):
        along = np.subtract(end, start)
        length = float(np.hypot(*along))
        along = along / length
        reaches = [np.subtract(gap, start) for gap in gaps]
        on_line = [reach for reach in reaches if abs(along[0] * reach[1] - along[1] * reach[0]) < 1e-6]
        for at in sorted(float(reach @ along) for reach in on_line):
            if 0.0 < at < length:
                before, after = start + (at - half) * along, start + (at + half) * along
                parts[-1].append((float(before[0]), float(before[1])))
                parts.append([(float(after[0]), float(after[1]))])
        parts[-1].append(end)
    return parts
