"""Points that the paths of a kernel append in any order; read in an order that does not depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats


class Collected:
    """A list of points, each a row of numbers. Not a dataclass: it is not one of a kernel's loop variables."""

    def __init__(self, room: int, widths: Sequence[int], *, over: list[Any] | None = None) -> None:
        """An empty list, or one that appends to the arrays of another.

        Args:
            room: maximum number of points that an empty list holds.
            widths: number of floats in each column.
            over: the arrays of another list.
        """
        if over is None:
            over = [dr.opaque(mi.UInt32, room), dr.zeros(mi.UInt32, 1), dr.zeros(mi.UInt32, 2 * room)]
            over += [dr.zeros(mi.Float, width * room) for width in widths]
            dr.make_opaque(*over)
        self.arrays = over  # all that a kernel reads or writes through this object, for `frozen`

    @property
    def count(self) -> int:
        """Number of points, stored or not."""
        return int(self.arrays[1][0])

    def clear(self) -> None:
        """Forget all points."""
        count = self.arrays[1]
        dr.scatter(count, mi.UInt32(0), mi.UInt32(0))
        dr.eval(count)

    def append(self, path: mi.UInt32, step: mi.UInt32, row: Sequence[Any], active: mi.Bool) -> None:
        """Append a point per lane; if there is no room, it is counted but not stored.

        Args:
            path: number of the path that found it.
            step: number of surfaces that the path met before; (path, step) identifies a point.
            row: a vector for each column.
            active: lanes that have one.
        """
        limit, count, order, *columns = self.arrays
        place = dr.scatter_inc(count, mi.UInt32(0), active)
        kept = active & (place < limit)
        dr.scatter(order, mi.Vector2u(path, step), place, kept)
        for column, values in zip(columns, row, strict=True):
            dr.scatter(column, values, place, kept)

    def read(self) -> tuple[NDArray[np.uint32], list[Floats]]:
        """(P,) paths of all points, and their columns, (P, width) each, by path and step.

        Raises:
            ValueError: there was no room for all; which ones are missing is then arbitrary.
        """
        count, room = self.count, dr.width(self.arrays[2]) // 2
        if count > room:
            raise ValueError(f"{count} points, and room for {room}")
        # On a CPU, `asarray` does not copy: most of a long list may be empty.
        taken, *columns = (np.asarray(array).reshape(room, -1)[:count] for array in self.arrays[2:])
        path, step = taken.T
        order = np.argsort(path.astype(np.uint64) << np.uint64(32) | step)
        return path[order], [column[order] for column in columns]
