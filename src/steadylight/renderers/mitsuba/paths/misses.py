"""Misses of the cache: recorded by a kernel as its paths meet them, read in the order of the paths."""

from __future__ import annotations

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

    def __init__(self, room: int = 0, *, over: list[Any] | None = None) -> None:
        """An empty list, or one that appends to the arrays of another.

        Args:
            room: maximum number of points that an empty list holds.
            over: the arrays of another list.
        """
        if over is None:
            limit, count = dr.opaque(mi.UInt32, room), dr.zeros(mi.UInt32, 1)
            kinds = ((mi.UInt32, 2), (mi.Float, 3), (mi.Float, 3), (mi.Float, 2))
            over = [limit, count, *(dr.zeros(kind, size * room) for kind, size in kinds)]
            dr.make_opaque(*over)
        self._arrays = over

    @property
    def arrays(self) -> list[Any]:
        """All that a kernel reads or writes through this object, for `frozen`."""
        return self._arrays

    def clear(self) -> None:
        """Forget all points."""
        count = self._arrays[1]
        dr.scatter(count, mi.UInt32(0), mi.UInt32(0))
        dr.eval(count)

    def note(self, path: mi.UInt32, step: mi.UInt32, point: Point, active: mi.Bool) -> None:
        """Append a point per lane; if there is no room, it is counted but not stored.

        Args:
            path: number of the path that met it.
            step: number of surfaces that the path met before; (path, step) identifies a point.
            point: the query point.
            active: lanes that have one.
        """
        limit, count, paths, position, normal, radii = self._arrays
        place = dr.scatter_inc(count, mi.UInt32(0), active)
        kept = active & (place < limit)
        dr.scatter(paths, mi.Vector2u(path, step), place, kept)
        dr.scatter(position, point.position, place, kept)
        dr.scatter(normal, point.normal, place, kept)
        dr.scatter(radii, mi.Vector2f(point.longest, point.smallest), place, kept)

    @property
    def count(self) -> int:
        """Number of points, stored or not."""
        return int(self._arrays[1][0])

    def read(self) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.uint32]]:
        """(P, 3) positions and normals, (P,) longest and smallest radii, (P,) paths of all points, by path and step.

        Raises:
            ValueError: there was no room for all; which ones are missing is then arbitrary.
        """
        count, room = self.count, dr.width(self._arrays[-1]) // 2
        if count > room:
            raise ValueError(f"{count} points, and room for {room}")
        # On a CPU, `asarray` does not copy: most of a long list may be empty.
        taken = (np.asarray(array).reshape(room, -1)[:count] for array in self._arrays[2:])
        (path, depth), *points = next(taken).T, *taken
        order = np.argsort(path.astype(np.uint64) << np.uint64(32) | depth)
        position, normal, radii = (array[order] for array in points)
        longest, smallest = np.ascontiguousarray(radii.T)
        return position, normal, longest, smallest, path[order]
