"""Radii of records that reach to where others measured another light than they expect there.

What a hemisphere saw does not always tell that the light changes nearby: a window that is hidden behind an edge is seen
by few paths or none. The records on the other side of the edge know it (adaptive caching: Krivanek, Bouatouch,
Pattanaik & Zara 2006, "Making radiance and irradiance caching practical", EGSR).
"""

from __future__ import annotations

import numpy as np

from steadylight.cache.compatibility import pairs_within
from steadylight.cache.lookup import extrapolated, pair_weights
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing


def agreeing_radius(records: Records, smallest: Floats, smoothing: Smoothing) -> Floats:
    """Radius within which each record agrees with the others, metres; no longer than it is.

    Two records disagree where smoothing would not average their light. What gradients leave out grows with the square
    of the distance, so that a record which is wrong by twice of what is tolerated at some distance is right at that
    distance over the root of two.

    Args:
        records: R records.
        smallest: (R,) metres; no radius becomes shorter than this, or longer than it was.
        smoothing: how much two records may differ.
    """
    radius = records.radius.astype(np.float64)
    E = records.irradiance.sum(axis=(1, 2), dtype=np.float64)
    # The error of a mean of three channels is taken to be that of each.
    error = 3 * records.standard_error.sum(axis=1, dtype=np.float64)
    for _, j, k in pairs_within(records.position, records.position, records.radius):
        others = (j != k) & (pair_weights(records.position[k], records.normal[k], records, j) > 0)
        j, k = j[others], k[others]  # noqa: PLW2901 - fewer of the same
        expected = np.maximum(extrapolated(records.position[k], records.normal[k], records, j), 0)
        unlike = np.abs(expected.sum(axis=(1, 2), dtype=np.float64) - E[k])
        allowed = smoothing.tolerance * E[k] + smoothing.errors * np.hypot(error[j], error[k])
        wrong = unlike > allowed
        j, k = j[wrong], k[wrong]  # noqa: PLW2901 - as above
        distance = np.linalg.norm(records.position[k] - records.position[j], axis=1)
        right = distance * np.sqrt(allowed[wrong] / unlike[wrong])
        np.minimum.at(radius, j, right)
    return np.minimum(records.radius, np.maximum(radius, smallest)).astype(np.float32)


def left_to_the_strongest(position: Floats, normal: Floats, records: Records, radius: Floats) -> Floats:
    """Radius that is left to the record which counted most at each point, metres; infinite where none did.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        records: R records with the radius that they had.
        radius: (R,) what is left of it.
    """
    most, left = np.zeros(len(position), np.float32), np.full(len(position), np.inf, np.float32)
    if len(records) == 0 or len(position) == 0:
        return left
    for _, record, point in pairs_within(position, records.position, records.radius):
        # Those that count least first: of several values for one point, the last stays.
        share = pair_weights(position[point], normal[point], records, record) / records.radius[record] ** 2
        order = np.argsort(share, kind="stable")
        record, point, share = record[order], point[order], share[order]  # noqa: PLW2901 - in order
        more = share > most[point]
        most[point[more]], left[point[more]] = share[more], radius[record[more]]
    return left
