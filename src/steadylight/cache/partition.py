"""The merge in parts that know nothing of each other: slabs of space, and what is open at their borders.

Whether a record is kept depends only on kept records of smaller reach near it (`merge.judge`), so a slab that sees a
little beyond its faces can decide most of its records for good. The few that hang on records further off are left
open, and decided at the end among themselves. The result has the bytes of `merge_caches`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.merge import REDUNDANT, canonical_order, judge
from steadylight.cache.records import Records


@dataclass(frozen=True)
class Slab:
    """The records from `low` to below `high` along an axis, which looks `margin` further.

    Attributes:
        axis: 0, 1 or 2.
        low: metres; may be minus infinity.
        high: metres; may be infinity.
        margin: metres; no record has a stand-in further away.
    """

    axis: int
    low: float
    high: float
    margin: float


@dataclass(frozen=True)
class Part:
    """What is known of the records of a slab.

    Attributes:
        kept: records that stay, whatever is elsewhere.
        border: (len(kept),) those that may stand in for a record of another slab.
        undecided: records that may stay.
    """

    kept: Records
    border: NDArray[np.bool_]
    undecided: Records


def slabs_of(positions: Sequence[NDArray[np.float32]], longest_reach: float, count: int) -> list[Slab]:
    """Slabs with about as many records each, across the longest side of the whole.

    Args:
        positions: of the records of each cache, (R, 3) each.
        longest_reach: of any record, metres.
        count: of slabs, at least 1.
    """
    everything = np.concatenate(positions) if positions else np.zeros((0, 3), np.float32)
    if len(everything) == 0:
        return [Slab(0, -np.inf, np.inf, 0.0)]
    axis = int(np.argmax(np.ptp(everything, axis=0)))
    edges = np.unique(np.quantile(everything[:, axis], np.arange(1, count) / count))
    margin = 1.001 * REDUNDANT * longest_reach
    bounds = [-np.inf, *map(float, edges), np.inf]
    return [Slab(axis, low, high, margin) for low, high in itertools.pairwise(bounds)]


def merge_part(caches: Sequence[Records], slab: Slab) -> Part:
    """Decide what can be decided in a slab.

    Args:
        caches: to be merged; only what the slab sees is looked at.
        slab: one of `slabs_of` these caches.
    """
    low, high = slab.low - slab.margin, slab.high + slab.margin
    seen = [
        cache.take((cache.position[:, slab.axis] >= low) & (cache.position[:, slab.axis] <= high))
        for cache in caches
    ]
    records = Records.joined(*seen)
    records = records.take(canonical_order(records))
    where = records.position[:, slab.axis].astype(np.float64)
    reach = REDUNDANT * records.reach.astype(np.float64)
    own = (where >= slab.low) & (where < slab.high)
    drop, undecided = judge(records, own | ((where - reach >= low) & (where + reach <= high)))
    kept = own & ~drop & ~undecided
    at_border = (where < slab.low + slab.margin) | (where >= slab.high - slab.margin)
    return Part(records.take(kept), at_border[kept], records.take(own & undecided))


def join_parts(parts: Sequence[Part]) -> Records:
    """Decide what the slabs left open, and put everything in order: the bytes of `merge_caches`."""
    undecided = Records.joined(*(part.undecided for part in parts))
    border = Records.joined(*(part.kept.take(part.border) for part in parts))
    both = Records.joined(undecided, border)
    order = canonical_order(both)
    drop, _ = judge(both.take(order), np.ones(len(both), bool))
    stays = order[~drop]
    result = Records.joined(*(part.kept for part in parts), both.take(stays[stays < len(undecided)]))
    return result.take(canonical_order(result))
