"""Neighbouring records average their noise before the second pass reads them.

A record is a Monte Carlo estimate; its noise would show as a splotch of its own size. Around it lie others that
measured nearly the same light. Each record is replaced by what its neighbours expect at its place by their gradients.
The caches before keep the measured records; what the second pass reads is a file of its own.

Weights that knew the noise which they average would lose light: what is bright by chance would be called unlike, and
left out. So each record keeps what two halves of its paths measured. What a half measured is weighed by what the other
half says of the same records, and the two results are averaged (as in Rousselle, Knaus & Zwicker 2012,
doi:10.1145/2366145.2366214).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import Pairs, compatible, pairs_within
from steadylight.cache.lookup import STEP, mean_height, pair_weights
from steadylight.cache.records import Floats, Records

STRETCH = 3.0
"""Neighbours count up to this many times their radius. Noise falls as the inverse of this number; where light bends,
what neighbours expect by their gradients is wrong by its square."""

ALIKE = 0.2
"""Part of the tolerance of normals within which two records tell each other how light changes along one plane."""

TILTED = 3.0
"""A record is tilted if its light changes so many times as steeply as by the flatter of its guides."""

OUTLYING = 2.0
"""This times the tolerance is what the brightest path of half of a record's paths may add to what all others measured:
of some hundred paths that share the light evenly, each brings less than a hundredth."""

RESIDUE = 1e-5
"""Part of a half's light below which what is left without its brightest path is taken for rounding."""

GROWTH = 1.5
"""How many times as much of what is like an outlier must lie within twice its reach for more to be looked for: on a
wall four times as much does, along a shelf twice. On a small thing, whole rooms would be searched in vain."""

LIKE = 4
"""How fast the share of records that are brighter or dimmer falls: of one with half of the light, to a sixteenth."""

ASIDE = 0.2
"""Height over a record's plane, over the distance, up to which another lies on its surface, which may be curved."""


@dataclass(frozen=True)
class Smoothing:
    """How much neighbouring records share their noise.

    Attributes:
        tolerance: two records did not measure the same light if they differ by more than this part of it and, on top,
            `errors` standard errors of their difference.
        errors: see above.
    """

    tolerance: float = 0.1
    errors: float = 3.0


def smooth(
    records: Records,
    rows: NDArray[np.intp] | None = None,
    smoothing: Smoothing | None = None,
    longest: float = np.inf,
) -> Records:
    """The same records with irradiance and gradients averaged over compatible neighbours.

    A neighbour's weight is that of a look-up with STRETCH times its radius, times (radius / its radius)² where its
    radius is longer: a record far from any edge must not blur one that lies beside it. A tilted record hears them in
    full: a single bright path makes its radius short, and by itself it would be a light dot. The weight fades to zero
    where the two disagree by more than their noise: the dark of a joint stays in the joint. A half is weighed by
    whether the guides of the other half agree. Gradients of shorter radius count for less by (its radius / radius)⁴:
    records crowd with the square of what they lack in radius, and how light changes over the last centimetre before an
    edge says nothing of the metre that this record answers for. All values of a record are averaged with the same
    weights, which go by their sum. Of gradients by position, that part counts which neighbours confirm.

    Args:
        records: R records.
        rows: of the records to smooth; all if None. What each becomes depends only on records within STRETCH times the
            longest radius, on those within as much of these, and on their order.
        smoothing: how much; as it is at normal quality if None.
        longest: radius of any record of the whole cache, metres; of these if infinite.

    Returns:
        The records at `rows`, in that order, at the same places, with the same radii, standard errors and halves.
    """
    rows = np.arange(len(records)) if rows is None else rows
    if len(rows) == 0:
        return records.take(rows)
    smoothing = smoothing or Smoothing()
    longest = float(records.radius.max()) if np.isinf(longest) else longest
    here = records.take(rows)
    tilted = _tilted(records)
    reach = here.radius * np.float32(STRETCH)
    records, received = _outliers_spread(records, rows, smoothing, longest)
    heard = rows if len(rows) == len(records) else _heard(records, here.position, reach)
    records = _with_confirmed_gradients(records, heard, smoothing)
    wide = dataclasses.replace(records, radius=records.radius * np.float32(STRETCH))
    # Who is near enough to count: as far as the record's own wide radius, since longer radii count for little, and a
    # tilted record needs no more.
    portions = pairs_within(records.position, here.position, reach)
    parts = [_smoothed(records, wide, tilted, rows, pairs, smoothing) for pairs in portions]
    E, translation, rotation = (
        np.concatenate([part[i] for part in parts]).astype(np.float32) for i in range(3)
    )
    return dataclasses.replace(
        here,
        irradiance=(np.maximum(E, 0).reshape(here.irradiance.shape) + received[rows]).astype(np.float32),
        translation=translation.reshape(here.translation.shape),
        rotation=rotation.reshape(here.rotation.shape),
    )


def _outliers_spread(
    records: Records, rows: NDArray[np.intp], smoothing: Smoothing, longest: float
) -> tuple[Records, NDArray[np.float64]]:
    """The records without the light that single paths brought to outliers, and what each gets of it.

    A caustic may reach one record of a hundred by a single path. Where the other half is quiet, no neighbour is taken
    to be like the record, which would stay a disc of light. So what such a path brought goes to the records around on
    the same surface that have light like it (`_alike`), by the area for which they answer: none is lost. It goes so far
    that it adds no more to them than a path may add to its half, but no further than the longest records hear. A half
    is judged by itself, so that the weights, which the other half gives, know nothing of it. What is taken from a
    record depends on it alone. Gradients and guides stay as they are.

    Args:
        records: R records.
        rows: of those whose share is wanted; at least one.
        smoothing: as in `smooth`.
        longest: as in `smooth`.

    Returns:
        The records, and (R, K, 3) irradiance to be added after smoothing: all of it at `rows`.
    """
    E, difference = (array.astype(np.float64) for array in (records.irradiance, records.difference))
    halves = np.stack([E + difference, E - difference], axis=2)  # (R, K, 2, 3)
    mean = halves.mean(axis=3)
    others = mean - records.brightest
    others[others < RESIDUE * mean] = 0
    allowed = OUTLYING * smoothing.tolerance
    excess = np.clip(records.brightest - allowed * np.maximum(others, 0), 0, np.maximum(mean, 0))
    part = np.divide(excess, mean, out=np.zeros_like(mean), where=excess > 0)
    light = np.maximum(others.mean(axis=2).sum(axis=1), 0)
    area = np.square(records.radius, dtype=np.float64)
    taken = (halves * part[..., None]).mean(axis=2)
    brought = taken.mean(axis=2).sum(axis=1) * area
    received = np.zeros_like(E)
    most = np.float32(STRETCH * longest)
    # What lies further off reaches none of the rows.
    low, high = records.position[rows].min(axis=0) - most, records.position[rows].max(axis=0) + most
    near = ((records.position >= low) & (records.position <= high)).all(axis=1)
    waiting = np.flatnonzero(near & (brought != 0))
    reach = np.minimum(records.radius[waiting] * np.float32(STRETCH), most)
    found = np.zeros(len(waiting))  # light times area of what is like each
    while len(waiting):
        before, found = found, np.zeros(len(waiting))
        further = np.zeros(len(waiting), bool)
        for places, place, j in pairs_within(records.position, records.position[waiting], reach):
            some, i, at = waiting[places], waiting[place], place - places.start
            weight = _along_surface(records, i, j, reach[place]) * _alike(light[i], light[j])
            total = np.bincount(at, weight * area[j], len(some))
            found[places] = total
            last = (reach[places] >= most) | (total <= GROWTH * before[places])
            far = ~last & (brought[some] > allowed * total)
            further[places] = far
            alone = some[last & (total == 0)]  # nobody has light like it
            received[alone] += taken[alone]
            given = ~far & (total > 0)
            share = np.divide(weight * area[i], total[at], out=np.zeros_like(weight), where=given[at])
            np.add.at(received, j, share[:, None, None] * taken[i])
        waiting, found = waiting[further], found[further]
        reach = np.minimum(2 * reach[further], most)
    first, second = np.moveaxis(halves * (1 - part[..., None]), 2, 0)
    left = dataclasses.replace(
        records,
        irradiance=((first + second) / 2).astype(np.float32),
        difference=((first - second) / 2).astype(np.float32),
    )
    return left, received


def _alike(light: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) the light of others, as far as it is like that of outliers without their paths.

    Where a few records found a small lamp and measured it well, and most missed it, the paths by which some of these
    met it after all are the light that these lack, and not those. Nor does what is dim beside a bright spot lack any.
    """
    ratio = np.divide(light, other, out=np.zeros_like(other), where=other > 0)
    inverse = np.divide(other, light, out=np.zeros_like(other), where=light > 0)
    return np.asarray(other * np.minimum(ratio, inverse) ** LIKE)


def _along_surface(
    records: Records, i: NDArray[np.intp], j: NDArray[np.intp], reach: Floats
) -> NDArray[np.float64]:
    """(P,) how near records `j` lie along the surface of records `i`: 1 at these, 0 at their reach or aside.

    What a path brought to the lit front of a thing must not go to its shaded side, a hand's breadth behind.
    """
    offset = records.position[j].astype(np.float64) - records.position[i]
    distance = np.linalg.norm(offset, axis=1)
    height = np.maximum(*(np.abs(np.einsum("px,px->p", offset, records.normal[rows])) for rows in (i, j)))
    aside = height > ASIDE * distance
    near = np.where(aside, 0, np.maximum(1 - distance / reach, 0))
    return np.asarray(near * compatible(records.normal[i], records.normal[j], ALIKE))


def _smoothed(
    records: Records,
    wide: Records,
    tilted: NDArray[np.bool_],
    rows: NDArray[np.intp],
    pairs: Pairs,
    smoothing: Smoothing,
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
    # A step that counts for the shorter radius counts, however wide the other is.
    step = np.abs(mean_height(position - records.position[j], records.normal[j], normal))
    weight[step > STEP * np.minimum(records.radius[at], records.radius[j])] = 0
    beside = np.minimum(1, records.radius[at] / records.radius[j]) ** 2
    weight *= np.where(tilted[at], 1, beside)
    agreement = _agreement(records, j, at, smoothing)
    # A record agrees with itself; no weight may round to zero.
    weights = weight * np.maximum(agreement.T, np.where(j == at, 1, 0))

    def mean(values: Floats, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(i, weight * column, count) for column in columns]
        return np.stack(sums, axis=1) / np.bincount(i, weight, count)[:, None]

    E, difference = _expected(records, j, at), _differences(records, j, at)
    # Each half with the weights that the other half's guide gives.
    whole = (mean(E + difference, weights[1]) + mean(E - difference, weights[0])) / 2
    lasting = weights.sum(axis=0) * np.minimum(1, records.radius[j] / records.radius[at]) ** 4
    return whole, mean(records.translation[j], lasting), mean(records.rotation[j], lasting)


def _heard(records: Records, position: Floats, reach: Floats) -> NDArray[np.intp]:
    """Rows of the records within the reach (metres) of any of some places."""
    near = np.zeros(len(records), bool)
    for pairs in pairs_within(records.position, position, reach):
        near[pairs.site] = True
    return np.flatnonzero(near)


def _with_confirmed_gradients(records: Records, rows: NDArray[np.intp], smoothing: Smoothing) -> Records:
    """The records with as much of their gradients by position as what their neighbours measured confirms.

    The gradient of a hemisphere takes each change between two strata for the edge of what is nearer in them. Where the
    edge of a partition and the sill of a far window lie in one stratum, it moves the window with the partition, and the
    gradient is many times too large. Neighbours know better: s is the slope of what they measured over what the
    gradient says of it, by weighted least squares, with a mean of 1 and a standard deviation of 1 before any is asked.
    What a neighbour measured is uncertain by its standard error and, since light bends, by tolerance / errors of the
    brighter of both. s is clipped to [0, 1]: gradients that noise hides become shorter on average, and none longer.

    Args:
        records: R records.
        rows: of those whose gradients are asked for; the others keep theirs.
        smoothing: as in `smooth`.
    """
    E = np.maximum(records.irradiance.mean(axis=2).sum(axis=1, dtype=np.float64), np.finfo(np.float32).tiny)
    gradient = records.translation.mean(axis=2).sum(axis=1, dtype=np.float64)
    error = np.sqrt(np.square(records.standard_error, dtype=np.float64).sum(axis=1))
    wide = dataclasses.replace(records, radius=records.radius * np.float32(STRETCH))
    confirmed = np.ones(len(records), np.float32)
    for places, place, j in pairs_within(records.position, records.position[rows], wide.radius[rows]):
        i, at = rows[place], place - places.start
        weight = pair_weights(records.position[i], records.normal[i], wide, j).astype(np.float64)
        weight *= np.minimum(1, records.radius[i] / records.radius[j]) ** 2
        weight *= compatible(records.normal[i], records.normal[j], ALIKE)
        measured, noise = E[j] / E[i], error[j] / E[i]
        weight /= noise**2 + np.square(smoothing.tolerance / smoothing.errors * np.maximum(measured, 1))
        # By the mean of both gradients, as `_expected`.
        offset = records.position[j] - records.position[i]
        said = np.einsum("px,px->p", gradient[i] + gradient[j], offset) / (2 * E[i])
        powers = (weight, weight * said, weight * measured, weight * said**2, weight * said * measured)
        w, x, y, xx, xy = (np.bincount(at, power, places.stop - places.start) for power in powers)
        slope = (1 + xy - x * y / w) / (1 + np.maximum(xx - x**2 / w, 0))
        confirmed[rows[places]] = np.clip(slope, 0, 1)
    part = confirmed[:, None, None, None]
    return dataclasses.replace(
        records, translation=records.translation * part, guide_translation=records.guide_translation * part
    )


def _tilted(records: Records) -> NDArray[np.bool_]:
    """(R,) whether one guide of a record, or both, saw far less of its gradient than all of its paths did."""
    gradient = np.linalg.norm(records.translation.mean(axis=(1, 2), dtype=np.float64), axis=1)
    guided = np.linalg.norm(records.guide_translation.mean(axis=1, dtype=np.float64), axis=2)
    whole, guides = records.irradiance.mean(axis=(1, 2), dtype=np.float64), records.guide.mean(axis=1)
    # Steepness is gradient over irradiance; this way nothing is divided by 0.
    return np.asarray((gradient[:, None] * guides > TILTED * guided * whole[:, None]).any(axis=1))


class _Way(NamedTuple):
    """From records to others."""

    offset: Floats  # (P, 3) metres
    turn: Floats  # (P, 3) rotation vector of the normal
    lean: Floats  # (P,) 1 - cos of its angle


def _way(records: Records, j: NDArray[np.intp], at: NDArray[np.intp]) -> _Way:
    n_j, normal = records.normal[j], records.normal[at]
    offset = records.position[at] - records.position[j]
    return _Way(offset, np.cross(n_j, normal), 1 - np.einsum("px,px->p", n_j, normal))


def _expected(records: Records, j: NDArray[np.intp], at: NDArray[np.intp]) -> Floats:
    """(P, K, 3) irradiance that records `j` expect at those `at`.

    By the mean of the gradients of both, which is exact for light that changes with the square of the distance: by the
    gradients of `j` alone, neighbours would expect too much all around whatever is brightest.
    """
    offset, turn, lean = _way(records, j, at)
    gradient = (records.translation[j] + records.translation[at]) / 2
    return np.asarray(
        records.irradiance[j] * (1 - records.curvature[j] * lean[:, None])[..., None]
        + np.einsum("pkcx,px->pkc", gradient, offset)
        + np.einsum("pkcx,px->pkc", records.rotation[j], turn)
    )


def _differences(records: Records, j: NDArray[np.intp], at: NDArray[np.intp]) -> Floats:
    """(P, K, 3) half of the difference between what the two halves of records `j` expect at those `at`.

    Weights know one half's gradients; with these in what they weigh, light would be lost.
    """
    offset, turn, _ = _way(records, j, at)
    translation, rotation = (
        g[..., 0, :] - g[..., 1, :] for g in (records.guide_translation, records.guide_rotation)
    )
    grown = np.einsum("pkx,px->pk", (translation[j] + translation[at]) / 2, offset)
    grown += np.einsum("pkx,px->pk", rotation[j], turn)
    return np.asarray(records.difference[j] + grown[..., None] / 2)


def _agreement(
    records: Records, j: NDArray[np.intp], at: NDArray[np.intp], smoothing: Smoothing
) -> NDArray[np.float64]:
    """(P, 2) how far what records `j` expect at those `at` agrees with these, by each guide: from 0 to 1."""
    offset, turn, lean = _way(records, j, at)
    whole = records.guide.sum(axis=1, dtype=np.float64)
    translation, rotation = records.guide_translation.sum(axis=1), records.guide_rotation.sum(axis=1)
    curvature = np.einsum("rk,rkg->rg", records.curvature, records.guide)
    expected = (
        whole[j]
        - curvature[j] * lean[:, None]
        + np.einsum("pgx,px->pg", (translation[j] + translation[at]) / 2, offset)
        + np.einsum("pgx,px->pg", rotation[j], turn)
    )
    error = np.sqrt(np.square(records.guide_error, dtype=np.float64).sum(axis=1))
    own = whole[at]
    allowed = smoothing.tolerance * np.maximum(own, np.finfo(np.float32).tiny)  # black records: no overflow
    allowed += smoothing.errors * np.hypot(error[j], error[at])
    unlike = np.abs(expected - own) / allowed
    return np.asarray(np.maximum(0, 1 - np.minimum(unlike, 1) ** 2) ** 2)
