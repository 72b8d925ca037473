"""Misses of the cache: recorded by a kernel as its paths meet them, read in the order of the paths."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats


class Point(NamedTuple):
    """A query point of the cache.

    Attributes:
        position: world, metres.
        normal: unit, on the lit side.
        longest: upper bound of the radius of records that are trusted there, metres.
        smallest: lower bound of the radius that a record there needs, metres.
    """

    position: mi.Point3f
    normal: mi.Normal3f
    longest: mi.Float
    smallest: mi.Float


class MissList:
    """A list to which lanes append in any order; the order of what is read does not depend on it."""

    def __init__(self, room: int) -> None:
        """An empty list.

        Args:
            room: maximum number of points that it holds.
        """
        self._room = room
        self._limit = dr.opaque(mi.UInt32, room)
        self._count = dr.zeros(mi.UInt32, 1)
        self._path = dr.zeros(mi.UInt32, 2 * room)
        self._position = dr.zeros(mi.Float, 3 * room)
        self._normal = dr.zeros(mi.Float, 3 * room)
        self._radii = dr.zeros(mi.Float, 2 * room)
        dr.make_opaque(self._count, self._path, self._position, self._normal, self._radii)

    def note(self, path: mi.UInt32, step: mi.UInt32, point: Point, active: mi.Bool) -> None:
        """Append a point per lane; if there is no room, it is counted but not stored.

        Args:
            path: number of the path that met it.
            step: number of surfaces that the path met before; (path, step) identifies a point.
            point: the query point.
            active: lanes that have one.
        """
        place = dr.scatter_inc(self._count, mi.UInt32(0), active)
        kept = active & (place < self._limit)
        dr.scatter(self._path, mi.Vector2u(path, step), place, kept)
        dr.scatter(self._position, point.position, place, kept)
        dr.scatter(self._normal, point.normal, place, kept)
        dr.scatter(self._radii, mi.Vector2f(point.longest, point.smallest), place, kept)

    @property
    def count(self) -> int:
        """Number of points, stored or not."""
        return int(self._count[0])

    def read(self) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.uint32]]:
        """(P, 3) positions and normals, (P,) longest and smallest radii, (P,) paths of all points, by path and step.

        Raises:
            ValueError: there was no room for all; which ones are missing is then arbitrary.
        """
        count = self.count
        if count > self._room:
            raise ValueError(f"{count} points, and room for {self._room}")
        path, depth = np.array(self._path).reshape(-1, 2)[:count].T
        order = np.lexsort((depth, path))
        arrays = (self._position, self._normal, self._radii)
        rows = (np.array(array).reshape(self._room, -1)[:count][order] for array in arrays)
        position, normal, radii = rows
        longest, smallest = np.ascontiguousarray(radii.T)
        return position, normal, longest, smallest, path[order]
