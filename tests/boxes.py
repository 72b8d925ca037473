"""Rooms of boxes, whose ray intersections are a few lines of NumPy: known answers for walks and checks."""

from __future__ import annotations

import numpy as np

from steadylight.renderers.base import Hits


class Boxes:
    """Solid boxes, (B, 2, 3) lowest and highest corners. Implements `renderers.base.Geometry`."""

    lamps = ()

    def __init__(self, boxes, *, reverse=False, ray_offset=0.0):
        self.ray_offset = ray_offset
        self.boxes = np.asarray(boxes, np.float64)
        self.sign = -1.0 if reverse else 1.0
        self.shapes = tuple(f"box_{number}" for number in range(len(boxes)))
        self.rays = 0

    @property
    def bounds(self):
        return np.array([self.boxes[:, 0].min(axis=0), self.boxes[:, 1].max(axis=0)])

    def cast(self, origins, directions, longest=np.inf):
        self.rays += len(origins)
        best, shape = np.full(len(origins), np.inf), np.full(len(origins), -1)
        origin, direction = np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / direction
            for number in range(len(self.boxes)):
                enter, leave = self._slabs(origin, inverse, number)
                first, last = enter.max(axis=0), leave.min(axis=0)
                t = np.where(first > 1e-9, first, last)
                hit = (first <= last) & (t > 1e-9) & (t < best) & (t <= longest)
                best[hit], shape[hit] = t[hit], number
            enter, leave = self._slabs(origin, inverse, shape)
        outside = enter.max(axis=0) > 1e-9
        axis = np.where(outside, enter.argmax(axis=0), leave.argmin(axis=0))
        way = np.sign(direction[axis, np.arange(len(axis))]) * np.where(outside, -1, 1)
        normal = np.eye(3)[axis] * (self.sign * way * (shape >= 0))[:, None]
        return Hits(best, normal, shape)

    def _slabs(self, origin, inverse, number):
        """Where rays enter and leave the slabs of a box, or of a box each, (3, N)."""
        low, high = self.boxes[number, 0].T, self.boxes[number, 1].T
        low, high = (each[:, None] if each.ndim == 1 else each for each in (low, high))
        a, b = (low - origin) * inverse, (high - origin) * inverse
        return np.fmin(a, b), np.fmax(a, b)

    def colours(self, origins, directions):
        return np.full((len(origins), 3), np.nan)


def box(x0, x1, y0, y1, z0, z1):
    return [[x0, y0, z0], [x1, y1, z1]]


WALLS = [
    box(-0.2, 8.2, -0.2, 4.2, -0.2, 0.0),  # floor
    box(-0.2, 8.2, -0.2, 4.2, 2.6, 2.8),  # ceiling
    box(-0.2, 0.0, -0.2, 4.2, 0.0, 2.6),
    box(8.0, 8.2, -0.2, 4.2, 0.0, 2.6),
    box(-0.2, 8.2, -0.2, 0.0, 0.0, 2.6),
    box(-0.2, 8.2, 4.0, 4.2, 0.0, 2.6),
]
"""A room of 8 x 4 x 2.6 m."""

DIVIDED = [
    *WALLS,
    box(3.9, 4.1, 0.0, 1.5, 0.0, 2.6),
    box(3.9, 4.1, 2.4, 4.0, 0.0, 2.6),
    box(3.9, 4.1, 1.5, 2.4, 2.1, 2.6),
]
"""Two rooms of 3.9 x 4 m, joined by a door of 0.9 x 2.1 m."""

FURNISHED = [*DIVIDED, box(1.2, 2.8, 1.4, 2.6, 0.7, 0.75), box(6.0, 6.5, 1.6, 2.2, 0.0, 0.45)]
"""With a table in the first room, and a stool in the second."""
