"""Shortens the radii of records whose extrapolated irradiance disagrees with what their neighbours measured.

What a hemisphere saw does not always show that the light changes nearby: a window hidden behind an edge is seen by few
of its paths, or by none. The records on the other side of the edge see the window (adaptive caching: Krivanek,
Bouatouch, Pattanaik & Zara 2006, "Making radiance and irradiance caching practical", EGSR).
"""

from __future__ import annotations

import numpy as np

from steadylight.cache.compatibility import CompatibleSites
from steadylight.cache.lookup import extrapolated, pair_weights
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing


def agreeing_radius(records: Records, smallest: Floats, smoothing: Smoothing) -> Floats:
    """Radius within which each record agrees with the others, metres; at most its present radius.

    Two records disagree roughly where smoothing would not average their light. The error of extrapolation by gradients
    grows with the square of the distance: a record whose error is twice the tolerated one at some distance is good
    enough at that distance divided by the square root of two.

    Args:
        records: R records.
        smallest: (R,) metres; no radius becomes shorter than this, and none becomes longer than it was.
        smoothing: how much two records may differ.
    """
    radius = records.radius.astype(np.float64)
    E = records.irradiance.sum(axis=(1, 2), dtype=np.float64)
    # The standard error of the channels' mean is used for each channel.
    error = 3 * records.standard_error.sum(axis=1, dtype=np.float64)
    places = records.position, records.normal
    for pairs in CompatibleSites(*places).near(*places, records.radius):
        j, k = pairs.place, pairs.site
        others = (j != k) & (pair_weights(records.position[k], records.normal[k], records, j) > 0)
        j, k = j[others], k[others]
        expected = np.maximum(extrapolated(records.position[k], records.normal[k], records, j), 0)
        unlike = np.abs(expected.sum(axis=(1, 2), dtype=np.float64) - E[k])
        allowed = smoothing.tolerance * E[k] + smoothing.errors * np.hypot(error[j], error[k])
        wrong = unlike > allowed
        j, k = j[wrong], k[wrong]
        distance = np.linalg.norm(records.position[k] - records.position[j], axis=1)
        right = distance * np.sqrt(allowed[wrong] / unlike[wrong])
        np.minimum.at(radius, j, right)
    return np.minimum(records.radius, np.maximum(radius, smallest)).astype(np.float32)


def left_to_the_strongest(position: Floats, normal: Floats, records: Records, radius: Floats) -> Floats:
    """Shortened radius of the record with the largest share at each point, metres; infinite if none contributed.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        records: R records with their radii before shortening.
        radius: (R,) their shortened radii, metres.
    """
    most, left = np.zeros(len(position), np.float32), np.full(len(position), np.inf, np.float32)
    if len(records) == 0 or len(position) == 0:
        return left
    for pairs in CompatibleSites(position, normal).near(records.position, records.normal, records.radius):
        record, point = pairs.place, pairs.site
        # In ascending order of share: of several values for one point, the last assignment stays.
        share = pair_weights(position[point], normal[point], records, record) / records.radius[record] ** 2
        order = np.argsort(share, kind="stable")
        record, point, share = record[order], point[order], share[order]
        more = share > most[point]
        most[point[more]], left[point[more]] = share[more], radius[record[more]]
    return left
