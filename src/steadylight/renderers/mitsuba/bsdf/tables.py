"""Tables of BSDFs: which of them have a property that kernels ask for."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import drjit as dr
import mitsuba as mi


def table_of(bsdfs: Iterable[mi.BSDF], some: Collection[mi.BSDF]) -> mi.Bool | None:
    """Table over all BSDF instances of whether each is in `some`; None if `some` is empty."""
    if not some:
        return None
    numbers = numbers_of(bsdfs)
    table = [False] * (max(numbers.values()) + 1)
    for bsdf in some:
        table[numbers[bsdf]] = True
    return mi.Bool(table)


def numbers_of(bsdfs: Iterable[mi.BSDF]) -> dict[mi.BSDF, int]:
    """Mitsuba's registry number of each BSDF; at least 1."""
    return {bsdf: int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs}


def is_in(table: mi.Bool | None, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
    """Entry of a table for each BSDF; False in inactive lanes."""
    if table is None:
        return mi.Bool(False)
    return dr.gather(mi.Bool, table, dr.reinterpret_array(mi.UInt32, bsdf), active)
