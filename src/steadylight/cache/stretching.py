"""Stretched records, extrapolated from more distant ones: for points that matter too little to be measured.

A single sample of a single pixel may hit a leaf, or the side of a moulding far away. Such a point hardly affects the
picture, and a measured record there would cost a thousand paths. Instead, a stretched record is made: it holds the
irradiance that the records around it would interpolate there if their radii were longer. Stretched records are stored
in the cache like any others, so frames need not treat them differently, and they stay fixed to the surface.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import CompatibleSites
from steadylight.cache.lookup import ANSWERED, STRETCHED, extrapolated, pair_weights
from steadylight.cache.placement import answered_weight, thin
from steadylight.cache.records import Floats, Records


def answerable(position: Floats, normal: Floats, records: Records) -> NDArray[np.bool_]:
    """Whether any record reaches each point with STRETCHED times its radius.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        records: R records.
    """
    found = np.zeros(len(position), bool)
    if len(records) == 0 or len(position) == 0:
        return found
    for record, point in _reached(position, normal, records):
        weight = pair_weights(position[point], normal[point], records, record, STRETCHED)
        found[point[weight > 0]] = True
    return found


def _reached(
    position: Floats, normal: Floats, records: Records
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """All pairs of a record and a point that it may reach with STRETCHED times its radius, in batches."""
    radius = records.radius * np.float32(STRETCHED)
    # The tolerance of normals is stretched too.
    sites = CompatibleSites(position, normal, STRETCHED)
    for pairs in sites.near(records.position, records.normal, radius):
        yield pairs.place, pairs.site


def stretched(position: Floats, normal: Floats, radius: Floats, records: Records) -> Records:
    """Stretched records that together cover all of the points.

    Args:
        position: (P, 3) metres, of points for which `answerable` is true.
        normal: (P, 3) unit.
        radius: (P,) radius of a record at the point, metres.
        records: R records from which they are extrapolated.
    """
    made = [Records.empty(records.values)]
    while len(position):
        rows = thin(position, normal, radius)
        made.append(_made(position[rows], normal[rows], radius[rows], records))
        any_radius = np.full(len(position), np.inf, np.float32)
        waiting = answered_weight(position, normal, any_radius, made[-1]) < ANSWERED
        waiting[rows] = False
        position, normal, radius = position[waiting], normal[waiting], radius[waiting]
    return Records.concatenate(*made)


def _made(position: Floats, normal: Floats, radius: Floats, records: Records) -> Records:
    """A record at each place, with the irradiance that others interpolate there with STRETCHED times their radius."""
    count, values = len(position), records.values
    total = np.zeros((count, values * 3))
    error = np.zeros((count, values))
    headroom = np.full(count, np.inf)
    share = np.zeros(count)
    for j, i in _reached(position, normal, records):
        weight = pair_weights(position[i], normal[i], records, j, STRETCHED)
        near = np.flatnonzero(weight)
        i, j = i[near], j[near]  # noqa: PLW2901 - fewer of the same
        counts = weight[near].astype(np.float64) / np.square(records.radius[j], dtype=np.float64)
        E = np.maximum(extrapolated(position[i], normal[i], records, j), 0).reshape(len(i), 3 * values)
        np.add.at(total, i, counts[:, None] * E)
        np.add.at(error, i, counts[:, None] * records.standard_error[j])
        np.add.at(share, i, counts)
        np.minimum.at(headroom, i, records.headroom[j])
    share = np.maximum(share, np.finfo(np.float64).tiny)[:, None]
    none = np.zeros((count, values, 3, 3), np.float32)
    return Records.undivided(
        position=position,
        normal=normal,
        irradiance=(total / share).reshape(count, values, 3).astype(np.float32),
        translation=none,
        rotation=none,
        curvature=np.zeros((count, values), np.float32),
        radius=radius,
        standard_error=(error / share).astype(np.float32),
        headroom=np.maximum(headroom, radius).astype(np.float32),
    )
