"""Binary search in sorted arrays, within a range of rows per lane."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

Numbers = TypeVar("Numbers", "mi.Float", "mi.UInt32")


@dr.syntax
def first_above(
    values: Numbers, number: Numbers, begin: mi.UInt32, end: mi.UInt32, active: mi.Bool
) -> mi.UInt32:
    """The first row whose value is greater than a number; `end` if there is none.

    `drjit.binary_search` needs the number of rows as a constant, so each number of rows would have a kernel of its own.

    Args:
        values: ascending within the range of each lane.
        number: of each lane.
        begin: first row of the range.
        end: row after the last.
        active: lanes.
    """
    low, high = mi.UInt32(begin), mi.UInt32(end)
    while active & (low < high):
        middle = (low + high) // 2
        not_above = dr.gather(type(values), values, middle) <= number
        low = dr.select(not_above, middle + 1, low)
        high = dr.select(not_above, high, middle)
    return low
