"""Misses of the cache: recorded by a kernel as its paths meet them, read in the order of the paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

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

    def __init__(self, room: int, arrays: Sequence[Any] | None = None) -> None:
        """An empty list.

        Args:
            room: maximum number of points that it holds.
            arrays: those of another list, which this one then appends to, for `frozen`.
        """
        self._room = room
        if arrays is None:
            limit, count = dr.opaque(mi.UInt32, room), dr.zeros(mi.UInt32, 1)
            kinds = ((mi.UInt32, 2), (mi.Float, 3), (mi.Float, 3), (mi.Float, 2))
            arrays = limit, count, *(dr.zeros(kind, size * room) for kind, size in kinds)
            dr.make_opaque(*arrays)
        self._limit, self._count, self._path, self._position, self._normal, self._radii = arrays

    def clear(self) -> None:
        """Forget all points."""
        dr.scatter(self._count, mi.UInt32(0), mi.UInt32(0))
        dr.eval(self._count)

    def arrays(self) -> list[Any]:
        """All that a kernel reads or writes through this object, for `frozen`."""
        return [self._limit, self._count, self._path, self._position, self._normal, self._radii]

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
        # On a CPU, `asarray` does not copy: most of a long list may be empty.
        path, depth = np.asarray(self._path).reshape(-1, 2)[:count].T
        order = np.lexsort((depth, path))
        arrays = (self._position, self._normal, self._radii)
        rows = (np.asarray(array).reshape(self._room, -1)[:count][order] for array in arrays)
        position, normal, radii = rows
        longest, smallest = np.ascontiguousarray(radii.T)
        return position, normal, longest, smallest, path[order]
