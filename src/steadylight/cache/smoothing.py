"""Neighbouring records average their noise before the second pass reads them.

A record is a Monte Carlo estimate; its noise would show as a splotch of its own size. Around it lie others that
measured nearly the same light. Each record is replaced by what its neighbours, moved along their gradients, say at
its place. The caches before keep the measured records; what the second pass reads is a file of its own.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steadylight.cache.lookup import pair_weights, said
from steadylight.cache.records import Records

STRETCH = 4.0
"""Neighbours speak up to this many times their radius."""

AGREE, ERRORS = 0.1, 3.0
"""Two records did not measure the same light if they differ by more than this part of it and, on top of that, this
many standard errors of their difference."""

NOISY = 2.0
"""A record with so many times the mean standard error of the others there counts half, with more still less: one path
that found a glint must not light a patch of wall. Lesser differences hardly count, or dark outcomes would outweigh
bright ones, which have the greater errors: 1.2 took 0.1 % more of the temple's light."""

CHUNK = 20_000
"""Records smoothed at once, to bound memory."""


def smooth(records: Records, rows: NDArray[np.intp] | None = None, *, noisy: float = NOISY) -> Records:
    """The same records with irradiance and gradients averaged over compatible neighbours.

    A neighbour's weight is that of a look-up with STRETCH times its radius, times (reach / its radius)² where its
    reach is longer: a record far from any edge must not blur one that lies beside it. It fades to zero where the two
    disagree by more than their noise: the dark of a joint stays in the joint. Gradients of shorter radius count for less
    by (its radius / reach)⁴: records crowd with the square of what they lack in reach, and how light changes over the
    last centimetre before an edge says nothing of the metre that this record answers for.

    Args:
        records: R records.
        rows: of the records to smooth; all if None. What each becomes depends only on records within STRETCH times its
            reach, and on their order.
        noisy: instead of NOISY; at least 1.

    Returns:
        The records at `rows`, in that order, at the same places, with the same reaches and deviations.
    """
    rows = np.arange(len(records)) if rows is None else rows
    here = records.take(rows)
    if len(here) == 0:
        return here
    wide = dataclasses.replace(records, radius=records.radius * np.float32(STRETCH))
    tree = cKDTree(records.position)
    parts = [_smoothed(records, wide, tree, rows[k : k + CHUNK], noisy) for k in range(0, len(rows), CHUNK)]
    E, translation, rotation = (
        np.concatenate([part[i] for part in parts]).astype(np.float32) for i in range(3)
    )
    return dataclasses.replace(
        here,
        irradiance=np.maximum(E, 0),
        translation=translation.reshape(-1, 3, 3),
        rotation=rotation.reshape(-1, 3, 3),
    )


def _smoothed(
    records: Records, wide: Records, tree: cKDTree, here: NDArray[np.intp], noisy: float
) -> tuple[np.ndarray, ...]:
    """Weighted means for C of the records: irradiance (C, 3) and both gradients (C, 9)."""
    # Who is near enough to speak: as far as the record's own wide radius, since longer radii count for little.
    near = tree.query_ball_point(records.position[here], wide.radius[here], return_sorted=True)
    sizes = np.fromiter(map(len, near), np.intp, len(near))
    i = np.repeat(np.arange(len(here)), sizes)
    j = np.concatenate([np.asarray(rows, np.intp) for rows in near])
    at = here[i]
    weight = pair_weights(records.position[at], records.normal[at], wide, j).astype(np.float64)
    weight *= np.minimum(1, records.radius[at] / records.radius[j]) ** 2
    E = said(records.position[at], records.normal[at], records, j)
    own = records.irradiance[at].mean(axis=1, dtype=np.float64)  # black records: no overflow
    tiny = np.finfo(np.float32).tiny
    error, here_error = (records.standard_error[rows].astype(np.float64) for rows in (j, at))
    unlike = np.abs(E.mean(axis=1) - own) / (
        AGREE * np.maximum(own, tiny) + ERRORS * np.hypot(error, here_error)
    )
    weight *= np.maximum(0, 1 - np.minimum(unlike, 1) ** 2) ** 2
    others = np.where(j == at, 0, weight)
    around = np.bincount(i, others, len(here))
    usual = np.bincount(i, others * error, len(here)) / np.maximum(around, tiny)
    usual = np.where(around > 0, usual, records.standard_error[here])
    # At least a thousandth of itself: no weight may round to zero.
    usual = np.maximum(np.maximum(usual, 1e-3 * records.standard_error[here]), tiny)
    weight /= 1 + (error / (noisy * usual[i])) ** 4

    def mean(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(i, weight * column, len(here)) for column in columns]
        return np.stack(sums, axis=1) / np.bincount(i, weight, len(here))[:, None]

    lasting = weight * np.minimum(1, records.radius[j] / records.radius[at]) ** 4
    return mean(E, weight), mean(records.translation[j], lasting), mean(records.rotation[j], lasting)
