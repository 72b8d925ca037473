"""Misses of the cache: recorded by a kernel as its paths meet them, read in the order of the paths."""

from __future__ import annotations

from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.collected import Collected


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
    """Misses that kernels append in any order."""

    def __init__(self, room: int = 0, *, over: list[Any] | None = None) -> None:
        """As `Collected`."""
        self._points = Collected(room, (3, 3, 2), over=over)

    @property
    def arrays(self) -> list[Any]:
        """All that a kernel reads or writes through this object, for `frozen`."""
        return self._points.arrays

    @property
    def count(self) -> int:
        """Number of points, stored or not."""
        return self._points.count

    def clear(self) -> None:
        """Forget all points."""
        self._points.clear()

    def note(self, path: mi.UInt32, step: mi.UInt32, point: Point, active: mi.Bool) -> None:
        """Append a query point per lane; arguments as of `Collected.append`."""
        radii = mi.Vector2f(point.longest, point.smallest)
        self._points.append(path, step, (point.position, point.normal, radii), active)

    def read(self) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.uint32]]:
        """(P, 3) positions and normals, (P,) longest and smallest radii, (P,) paths of all points, by path and step.

        Raises:
            ValueError: there was no room for all.
        """
        path, (position, normal, radii) = self._points.read()
        longest, smallest = np.ascontiguousarray(radii.T)
        return position, normal, longest, smallest, path
