"""Neighbouring records average their noise before the second pass reads them.

A record is a Monte Carlo estimate; its noise would show as a splotch of its own size. Around it lie others that
measured nearly the same light. Each record is replaced by what its neighbours expect at its place by their gradients.
The caches before keep the measured records; what the second pass reads is a file of its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steadylight.cache.compatibility import Pairs, pairs_within
from steadylight.cache.lookup import extrapolated, pair_weights
from steadylight.cache.records import Floats, Records

STRETCH = 4.0
"""Neighbours count up to this many times their radius."""


@dataclass(frozen=True)
class Smoothing:
    """How much neighbouring records share their noise.

    Attributes:
        tolerance: two records did not measure the same light if they differ by more than this part of it and, on top,
            `errors` standard errors of their difference.
        errors: see above.
        outlier: a record with so many times the mean standard error of the others around it counts half, with more
            still less: one path that found a glint must not light a patch of wall. Lesser differences hardly count, or
            dark outcomes would outweigh bright ones, which have the greater errors: 1.2 took 0.1 % more of the temple's
            light.
    """

    tolerance: float = 0.1
    errors: float = 3.0
    outlier: float = 2.0


def smooth(
    records: Records, rows: NDArray[np.intp] | None = None, smoothing: Smoothing | None = None
) -> Records:
    """The same records with irradiance and gradients averaged over compatible neighbours.

    A neighbour's weight is that of a look-up with STRETCH times its radius, times (radius / its radius)² where its
    radius is longer: a record far from any edge must not blur one that lies beside it. It fades to zero where the two
    disagree by more than their noise: the dark of a joint stays in the joint. Gradients of shorter radius count for
    less by (its radius / radius)⁴: records crowd with the square of what they lack in radius, and how light changes
    over the last centimetre before an edge says nothing of the metre that this record answers for. All values of a
    record are averaged with the same weights, which go by their sum.

    Args:
        records: R records.
        rows: of the records to smooth; all if None. What each becomes depends only on records within STRETCH times its
            radius, and on their order.
        smoothing: how much; as it is at normal quality if None.

    Returns:
        The records at `rows`, in that order, at the same places, with the same radii and standard errors.
    """
    rows = np.arange(len(records)) if rows is None else rows
    here = records.take(rows)
    if len(here) == 0:
        return here
    wide = dataclasses.replace(records, radius=records.radius * np.float32(STRETCH))
    # Who is near enough to count: as far as the record's own wide radius, since longer radii count for little.
    portions = pairs_within(cKDTree(records.position), here.position, here.radius * np.float32(STRETCH))
    parts = [_smoothed(records, wide, rows, pairs, smoothing or Smoothing()) for pairs in portions]
    E, translation, rotation = (
        np.concatenate([part[i] for part in parts]).astype(np.float32) for i in range(3)
    )
    return dataclasses.replace(
        here,
        irradiance=np.maximum(E, 0).reshape(here.irradiance.shape),
        translation=translation.reshape(here.translation.shape),
        rotation=rotation.reshape(here.rotation.shape),
    )


def _smoothed(
    records: Records, wide: Records, rows: NDArray[np.intp], pairs: Pairs, smoothing: Smoothing
) -> tuple[NDArray[np.float64], ...]:
    """Weighted means for C of the records: irradiance (C, 3 K) and both gradients (C, 9 K)."""
    count = pairs.places.stop - pairs.places.start
    i, j, at = pairs.place - pairs.places.start, pairs.site, rows[pairs.place]
    position, normal = records.position[at], records.normal[at]
    weight = pair_weights(position, normal, wide, j).astype(np.float64)
    # Most pairs lie at the rim of a ball that is flat in truth, and need no further look.
    near = np.flatnonzero(weight)
    i, j, at = i[near], j[near], at[near]
    position, normal, weight = position[near], normal[near], weight[near]
    weight *= np.minimum(1, records.radius[at] / records.radius[j]) ** 2
    E = extrapolated(position, normal, records, j)
    weight *= _agreement(records, E, j, at, smoothing)

    # Outliers count for less: by what is usual among the others around.
    error = _whole_error(records)
    tiny = np.finfo(np.float32).tiny
    others = np.where(j == at, 0, weight)
    around = np.bincount(i, others, count)
    usual = np.bincount(i, others * error[j], count) / np.maximum(around, tiny)
    own = error[rows[pairs.places]]
    # At least a thousandth of the record's own: no weight may round to zero.
    usual = np.maximum(np.maximum(np.where(around > 0, usual, own), 1e-3 * own), tiny)
    weight /= 1 + (error[j] / (smoothing.outlier * usual[i])) ** 4

    def mean(values: Floats, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(i, weight * column, count) for column in columns]
        return np.stack(sums, axis=1) / np.bincount(i, weight, count)[:, None]

    lasting = weight * np.minimum(1, records.radius[j] / records.radius[at]) ** 4
    return mean(E, weight), mean(records.translation[j], lasting), mean(records.rotation[j], lasting)


def _agreement(
    records: Records, E: Floats, j: NDArray[np.intp], at: NDArray[np.intp], smoothing: Smoothing
) -> NDArray[np.float64]:
    """How far what records `j` expect at the places of others, E (P, K, 3), agrees with these: from 0 to 1."""
    whole = records.irradiance.sum(axis=1)
    own = whole[at].mean(axis=1, dtype=np.float64)  # black records: no overflow
    error = _whole_error(records)
    noise = np.hypot(error[j], error[at])
    tiny = np.finfo(np.float32).tiny
    allowed = smoothing.tolerance * np.maximum(own, tiny) + smoothing.errors * noise
    unlike = np.abs(E.sum(axis=1).mean(axis=1) - own) / allowed
    return np.asarray(np.maximum(0, 1 - np.minimum(unlike, 1) ** 2) ** 2)


def _whole_error(records: Records) -> NDArray[np.float64]:
    """(R,) standard error of the sum of all values."""
    return np.asarray(np.sqrt(np.square(records.standard_error, dtype=np.float64).sum(axis=1)))
