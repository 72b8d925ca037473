"""Answers where no record stands, from records further off: for the sliver of a film that is not worth records.

A single sample of a single pixel may meet a leaf, or the side of a moulding far away. What it shows of the picture is
little, and a record there would cost a thousand paths. Instead, records are placed that are not measured: they know
what those around them would answer with a longer radius. They stand in the cache as any other does, so that a frame
need not know of them, and so that they stick to the surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import pairs_within
from steadylight.cache.lookup import ANSWERED, STRETCHED, extrapolated, pair_weights
from steadylight.cache.placement import answered_weight, thin
from steadylight.cache.records import Floats, Records


def answerable(position: Floats, normal: Floats, records: Records) -> NDArray[np.bool_]:
    """Whether records further off can answer at each point.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        records: R records.
    """
    found = np.zeros(len(position), bool)
    if len(records) == 0 or len(position) == 0:
        return found
    for _, record, point in pairs_within(position, records.position, records.radius * np.float32(STRETCHED)):
        weight = pair_weights(position[point], normal[point], records, record, STRETCHED)
        found[point[weight > 0]] = True
    return found


def stretched(position: Floats, normal: Floats, radius: Floats, records: Records) -> Records:
    """Records that answer at every one of the points, made of what others around them know.

    Args:
        position: (P, 3) metres; `answerable`.
        normal: (P, 3) unit.
        radius: (P,) of the record that is made there, metres.
        records: R records.
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
    """A record at each place, with the irradiance that others give there with STRETCHED times their radius."""
    count, values = len(position), records.values
    total = np.zeros((count, values * 3))
    error = np.zeros((count, values))
    headroom = np.full(count, np.inf)
    share = np.zeros(count)
    for _, j, i in pairs_within(position, records.position, records.radius * np.float32(STRETCHED)):
        weight = pair_weights(position[i], normal[i], records, j, STRETCHED)
        near = np.flatnonzero(weight)
        i, j = i[near], j[near]  # noqa: PLW2901 - fewer of the same
        counts = weight[near].astype(np.float64) / np.square(records.radius[j], dtype=np.float64)
        E = np.maximum(extrapolated(position[i], normal[i], records, j), 0).reshape(len(i), -1)
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
