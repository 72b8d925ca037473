"""How many paths each secondary record takes: by what its light counts for, over all bounces.

The ceiling over a window may count for two hundred times as much as most records. With as many paths for each, a few
decide how bright a whole film is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Doubles = NDArray[np.float64]

NOISE = 0.002
"""Relative standard deviation that the noise of records may cause in the light of all bounces: once by their own light,
and once more by what they pass on. The brightness of the film inherits it, and may be wrong by half a percent."""

MOST_MORE_LIGHT, MOST_MORE_EXCHANGE = 0.5, 2.0
"""Bounds on the additional paths for that aim, as multiples of the paths without it: to measure the light of records,
and what they pass on. Paths of the second kind are fewer and end sooner, but are all kept in memory. At a bound, more
noise is left."""


class Effort(NamedTuple):
    """How many times as many paths each of R records takes as it would by itself: powers of four.

    Attributes:
        light: (R,) that measure its light of one bounce.
        exchange: (R,) that measure what it receives of the others' light.
    """

    light: NDArray[np.intp]
    exchange: NDArray[np.intp]

    @classmethod
    def even(cls, count: int) -> Effort:
        """The same for all."""
        return cls(np.ones(count, np.intp), np.ones(count, np.intp))


def importance(
    passed_on: csr_array, light: Doubles, bounces: int, negligible: float
) -> tuple[Doubles, Doubles]:
    """What the light of each record counts for, c = T' (1 + c), and the light of all bounces, E = A + T E.

    The first is importance as in Smits, Arvo & Salesin (1992, doi:10.1145/133994.134080), with what each record
    receives counting the same.

    Args:
        passed_on: T, (R, R): what each record receives of each other's irradiance.
        light: A, (R,) of one bounce.
        bounces: that follow; at most so many.
        negligible: part of the light below which further bounces are left out.

    Returns:
        c and E, (R,) each.
    """
    counts, all_light = np.zeros(len(light)), light
    counting, added = np.ones(len(light)), light
    for _ in range(bounces):
        counting, added = passed_on.T @ counting, passed_on @ added
        counts, all_light = counts + counting, all_light + added
        if added.sum() <= negligible * all_light.sum():
            break
    return counts, all_light


def shared_out(counts: Doubles, error: Doubles, most_more: float) -> NDArray[np.intp]:
    """How many times as many paths each record takes for noise of NOISE together: about in proportion to importance.

    Not by what each record measured: those that are dark by chance would be taken for quiet, and light would be lost.

    Args:
        counts: (R,) importance.
        error: (R,) standard errors, over the light of all records times its importance.
        most_more: more paths, as a multiple of what all records take without.
    """
    times = np.ones(len(counts), np.intp)
    each = counts.max(initial=0)  # importance that stands for as many paths as a record takes by itself
    while each > 0 and np.sqrt((np.square(counts * error) / times).sum()) > NOISE:
        each /= 2
        more = np.int64(4) ** np.ceil(np.log2(np.maximum(counts / each, 1)) / 2).astype(np.int64)
        if (more - 1).sum() > most_more * len(counts):
            break
        times = more
    return times
