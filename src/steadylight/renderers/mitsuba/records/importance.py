"""Number of paths of each secondary record, by the importance of its light over all bounces.

The ceiling above a window may be two hundred times as important as most records. With the same number of paths for all,
a few records determine how bright a whole film is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Doubles = NDArray[np.float64]

NOISE = 0.002
"""Target for the relative standard deviation of the light of all bounces due to noise of records: once by their own
light, and once more by the exchange. The brightness of the film inherits it, and may be wrong by half a percent."""

MOST_MORE_LIGHT, MOST_MORE_EXCHANGE = 2.0, 6.0
"""Bounds of the additional paths for that target, as multiples of the paths without it: for the light of records, and
for the exchange, whose paths are fewer and shorter, but all kept in memory. At a bound, more noise remains."""


class Effort(NamedTuple):
    """Factors on the number of paths of each of R records: powers of four.

    Attributes:
        light: (R,) for paths that measure its light of one bounce.
        exchange: (R,) for paths that measure what it receives of the others' light.
    """

    light: NDArray[np.intp]
    exchange: NDArray[np.intp]

    @classmethod
    def even(cls, count: int) -> Effort:
        """A factor of one for all."""
        return cls(np.ones(count, np.intp), np.ones(count, np.intp))


def importance(
    passed_on: csr_array, light: Doubles, bounces: int, negligible: float
) -> tuple[Doubles, Doubles]:
    """Importance of the light of each record, c = T' (1 + c), and the light of all bounces, E = A + T E.

    Importance as in Smits, Arvo & Salesin (1992, doi:10.1145/133994.134080), where the irradiance of every record is
    equally important.

    Args:
        passed_on: T, (R, R): fraction of each other's irradiance that a record receives.
        light: A, (R,) of one bounce.
        bounces: maximum number of bounces that follow.
        negligible: fraction of the light below which further bounces are left out.

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
    """Factors on the number of paths of each record that give a total noise of NOISE: about proportional to importance.

    They do not depend on what a record measured: records that are dark by chance would seem free of noise, and light
    would be lost.

    Args:
        counts: (R,) importance.
        error: (R,) standard errors, relative to the light of all records times its importance.
        most_more: bound on additional paths, as a multiple of the paths without them.
    """
    times = np.ones(len(counts), np.intp)
    each = counts.max(initial=0)  # importance that corresponds to a factor of one
    while each > 0 and np.sqrt((np.square(counts * error) / times).sum()) > NOISE:
        each /= 2
        more = np.int64(4) ** np.ceil(np.log2(np.maximum(counts / each, 1)) / 2).astype(np.int64)
        if (more - 1).sum() > most_more * len(counts):
            break
        times = more
    return times
