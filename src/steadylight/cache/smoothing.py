"""Averages the noise of neighbouring records before the second pass reads them.

A record is a Monte Carlo estimate, and its noise would show as a splotch of the record's size. The records around it
measured nearly the same light. Each record is replaced by the weighted mean of what its neighbours predict at its
position, by their gradients. The files of the earlier stages keep the measured records; the second pass reads another
file.

Weights that depend on the noise that they average would lose light: a record that is bright by chance would count as
different, and be left out. So each record keeps what two halves of its paths measured. What one half measured is
weighted by how well the records agree according to the other half, and the two results are averaged (as in Rousselle,
Knaus & Zwicker 2012, doi:10.1145/2366145.2366214).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import CompatibleSites, Pairs
from steadylight.cache.lookup import STEP, height_over, pair_weights, step_between
from steadylight.cache.records import Floats, Records

STRETCH = 3.0
"""Neighbours are averaged up to this many times their radius. Noise falls with the inverse of this factor. Where
irradiance is not quadratic, the error of what neighbours predict by both gradients grows with its cube."""

ALIKE = 0.2
"""Fraction of the tolerance of normals within which two records count as parallel. Only such records indicate how light
changes along a common plane."""

TILTED = 3.0
"""A record is tilted if its gradient, relative to its irradiance, is more than this many times that of one of its
guides."""

OUTLYING = 2.0
"""Maximum contribution of the brightest path of half of a record's paths, relative to what the other paths of that half
measured, as a multiple of the tolerance. If some hundred paths share the light evenly, each contributes less than a
hundredth."""

RESIDUE = 1e-5
"""Fraction of a half's light: if less remains without the half's brightest path, it counts as rounding error."""

GROWTH = 1.5
"""The search for records similar to an outlier continues only while each doubling of its reach finds more than this
many times as much. On a wall, twice the reach finds four times as much, along a shelf twice. On a small object, the
search would otherwise go through whole rooms in vain."""

LIKE = 4
"""Exponent that reduces the share of records that are brighter or dimmer than an outlier: to a sixteenth if one has
half of the other's light."""

_SIGNS = np.array([1.0, -1.0])
"""Signs with which `Records.difference` enters the two halves."""

ASIDE = 0.2
"""Two records lie on one surface, which may be curved, if neither lies higher above the plane of the other than this
fraction of their distance."""


@dataclass(frozen=True)
class Smoothing:
    """How strongly neighbouring records are averaged.

    Attributes:
        tolerance: two records disagree if they differ by more than this fraction of their light plus `errors` standard
            errors of their difference.
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

    A neighbour's weight is that of a look-up with STRETCH times its radius. If its radius is longer than the record's,
    the weight is multiplied by (radius / its radius)²: a record far from any edge must not blur one beside an edge. A
    tilted record is averaged without this factor: a single bright path makes its radius short, and without its
    neighbours it would be a bright dot. The weight falls to zero where the two records disagree by more than
    `smoothing` allows, so that a dark joint stays dark. Agreement is judged by the guides: what one half measured is
    weighted by the guide of the other half.

    Gradients of a neighbour with a shorter radius have a further factor (its radius / radius)⁴ in their weight. The
    density of records grows with the inverse square of their radius, and the change of light over the last centimetre
    before an edge says nothing about the metre that this record covers. All values of a record are averaged with the
    same weights, which depend on their sum. Of the gradients by position, only the part that neighbours confirm is
    averaged.

    Args:
        records: R records.
        rows: rows of the records to smooth; all if None. The result for each depends only on the records within STRETCH
            times the longest radius, on those within the same distance of these, and on their order.
        smoothing: how strongly; the default, that of normal quality, if None.
        longest: longest radius in the whole cache, metres; the longest of `records` if infinite.

    Returns:
        The records at `rows`, in that order, at the same places, with the same radii, standard errors and halves.
    """
    rows = np.arange(len(records)) if rows is None else rows
    if len(rows) == 0:
        return records.take(rows)
    smoothing = smoothing or Smoothing()
    longest = float(records.radius.max()) if np.isinf(longest) else longest
    here, parallel = records.take(rows), CompatibleSites(records.position, records.normal, ALIKE)
    tilted = _tilted(here)
    reach = here.radius * np.float32(STRETCH)
    records, received = _outliers_spread(records, parallel, rows, smoothing, longest)
    heard = _heard(records, rows, reach)
    records = _with_confirmed_gradients(records, parallel, heard, smoothing)
    rows = np.searchsorted(heard, rows)
    # Neighbours within the record's own wide radius are near enough: those with longer radii have little weight beyond
    # it, and a tilted record needs no others.
    sites = CompatibleSites(records.position, records.normal)
    guides, wide = _Guides.of(records), _stretched(records)
    E, translation, rotation = (np.zeros_like(a) for a in (here.irradiance, here.translation, here.rotation))
    for pairs in sites.near(here.position, here.normal, reach):
        means = _smoothed(wide, guides, tilted, rows, pairs, smoothing)
        for every, some in zip((E, translation, rotation), means, strict=True):
            every[pairs.places] = some
    return dataclasses.replace(
        here,
        irradiance=(np.maximum(E, 0) + received).astype(np.float32),
        translation=translation,
        rotation=rotation,
    )


def _stretched(records: Records) -> Records:
    """The records, with STRETCH times their radii."""
    return dataclasses.replace(records, radius=records.radius * np.float32(STRETCH))


def _outliers_spread(
    records: Records, parallel: CompatibleSites, rows: NDArray[np.intp], smoothing: Smoothing, longest: float
) -> tuple[Records, NDArray[np.float64]]:
    """Take the light that single paths brought to outliers from the records, and spread it over their neighbours.

    A caustic may reach one record in a hundred, by a single path. If the other half of the record's paths did not find
    it, no neighbour agrees with the record, which would remain a disc of light. The contribution of such a path is
    therefore given to the surrounding records on the same surface that have similar light (`_alike`), such that the sum
    of irradiance times covered area is preserved. It is spread so far that it adds no more to them than a path may add
    to its half, but at most to STRETCH times the longest radius. Each half is judged separately, so that the weights,
    which come from the other half, do not depend on it. What is taken from a record depends on that record alone.
    Gradients and guides are not changed.

    Args:
        records: R records.
        parallel: the records, to search for parallel ones.
        rows: rows of the records whose received light is wanted; at least one.
        smoothing: as in `smooth`.
        longest: as in `smooth`.

    Returns:
        The records, and the irradiance to be added to those at `rows` after smoothing, (N, K, 3).
    """
    E, difference = (a.mean(axis=2, dtype=np.float64) for a in (records.irradiance, records.difference))
    mean = E[..., None] + difference[..., None] * _SIGNS  # (R, K, 2)
    others = mean - records.brightest
    others[others < RESIDUE * mean] = 0
    light = np.maximum(others.mean(axis=2).sum(axis=1), 0)
    allowed = OUTLYING * smoothing.tolerance
    excess = np.clip(records.brightest - allowed * np.maximum(others, 0), 0, np.maximum(mean, 0))
    outliers = np.flatnonzero(excess.any(axis=(1, 2)))
    # What both halves measured, (O, K, 2, 3).
    halves = records.irradiance[outliers, :, None] + records.difference[outliers, :, None] * _SIGNS[:, None]
    part = (excess[outliers] / np.where(excess[outliers] > 0, mean[outliers], 1))[..., None]
    taken, left = (halves * part).mean(axis=2), halves * (1 - part)
    area = np.square(records.radius, dtype=np.float64)
    brought = taken.mean(axis=2).sum(axis=1) * area[outliers]
    received = np.zeros(records.irradiance.shape)
    most = np.float32(STRETCH * longest)
    # Records further away reach none of the rows.
    low, high = records.position[rows].min(axis=0) - most, records.position[rows].max(axis=0) + most
    position, normal, radius = (a[outliers] for a in (records.position, records.normal, records.radius))
    near = ((position >= low) & (position <= high)).all(axis=1)
    waiting = np.flatnonzero(near & (brought != 0))
    reach = np.minimum(radius[waiting] * np.float32(STRETCH), most)
    found = np.zeros(len(waiting))  # light times area of similar records
    while len(waiting):
        before, found = found, np.zeros(len(waiting))
        further = np.zeros(len(waiting), bool)
        for pairs in parallel.near(position[waiting], normal[waiting], reach):
            places, at, j = pairs
            some, which = waiting[places], waiting[places][at]
            i = outliers[which]
            weight = _along_surface(records, i, j, reach[places][at]) * _alike(light[i], light[j])
            total = np.bincount(at, weight * area[j], len(some))
            found[places] = total
            last = (reach[places] >= most) | (total <= GROWTH * before[places])
            far = ~last & (brought[some] > allowed * total)
            further[places] = far
            alone = last & (total == 0)  # no record has similar light
            received[outliers[some[alone]]] += taken[some[alone]]
            given = ~far & (total > 0)
            gets = np.flatnonzero(given[at] & (weight > 0))
            share = weight[gets] * area[i[gets]] / total[at[gets]]
            np.add.at(received, j[gets], share[:, None, None] * taken[which[gets]])
        waiting, found = waiting[further], found[further]
        reach = np.minimum(2 * reach[further], most)
    irradiance, difference = records.irradiance.copy(), records.difference.copy()
    irradiance[outliers] = left.mean(axis=2)
    difference[outliers] = (left[:, :, 0] - left[:, :, 1]) / 2
    return dataclasses.replace(records, irradiance=irradiance, difference=difference), received[rows]


def _alike(light: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) the light of other records, times how similar it is to that of outliers without their brightest paths.

    Suppose that a few records measured a small lamp well, and most missed it. If single paths of some that missed it
    hit the lamp after all, their light belongs to the records that missed it, not to the few that measured it. Nor do
    dim records beside a bright spot lack light.
    """
    ratio = np.divide(light, other, out=np.zeros_like(other), where=other > 0)
    inverse = np.divide(other, light, out=np.zeros_like(other), where=light > 0)
    return np.asarray(other * np.minimum(ratio, inverse) ** LIKE)


def _along_surface(
    records: Records, i: NDArray[np.intp], j: NDArray[np.intp], reach: Floats
) -> NDArray[np.float64]:
    """(P,) proximity of records `j` to parallel `i` on the same surface: 1 at the same place, 0 at the reach or off it.

    What a path brought to the lit front of an object must not go to its shaded back, a hand's breadth behind.
    """
    offset = records.position[j].astype(np.float64) - records.position[i]
    distance = np.linalg.norm(offset, axis=1)
    height = np.maximum(
        *(height_over(offset, records.normal[rows], records.surface[rows]) for rows in (i, j))
    )
    aside = height > ASIDE * distance
    return np.where(aside, 0, np.maximum(1 - distance / reach, 0))


class _Guides(NamedTuple):
    """What both guides of each record say about the sum of its values; see `Records`."""

    light: NDArray[np.float64]  # (R, 2)
    error: NDArray[np.float64]  # (R, 2)
    translation: Floats  # (R, 2, 3)
    rotation: Floats  # (R, 2, 3)

    @classmethod
    def of(cls, records: Records) -> Self:
        """The guides of some records."""
        return cls(
            records.guide.sum(axis=1, dtype=np.float64),
            np.sqrt(np.square(records.guide_error, dtype=np.float64).sum(axis=1)),
            records.guide_translation.sum(axis=1),
            records.guide_rotation.sum(axis=1),
        )


class _Way(NamedTuple):
    """Displacement and rotation from records `j` to records `at`."""

    j: NDArray[np.intp]  # (P,)
    at: NDArray[np.intp]  # (P,)
    offset: Floats  # (P, 3) metres
    turn: Floats  # (P, 3) along the rotation axis of the normal, of length 2 tan(angle / 2)


def _smoothed(
    records: Records,
    guides: _Guides,
    tilted: NDArray[np.bool_],
    rows: NDArray[np.intp],
    pairs: Pairs,
    smoothing: Smoothing,
) -> tuple[NDArray[np.float64], ...]:
    """Weighted means for C of the records: irradiance (C, K, 3) and both gradients (C, K, 3, 3).

    Args:
        records: R records, with radii times STRETCH.
        guides: theirs.
        tilted: (N,) whether each record that is smoothed is tilted.
        rows: (N,) rows of the records that are smoothed.
        pairs: for C of these, the records nearby.
        smoothing: as in `smooth`.
    """
    place, j, at = pairs.at, pairs.site, rows[pairs.place]
    position, normal = records.position[at], records.normal[at]
    weight = pair_weights(position, normal, records, j)
    # Most pairs have no weight: the search covers a ball, but records contribute within a flat ellipsoid.
    near = np.flatnonzero(weight)
    place, j, at = place[near], j[near], at[near]
    normal, weight = normal[near], weight[near].astype(np.float64)
    offset = position[near] - records.position[j]
    # Of this length, light that follows a cosine is predicted exactly.
    turn = 2 * np.cross(records.normal[j], normal) / (1 + np.vecdot(records.normal[j], normal))[:, None]
    way = _Way(j, at, offset, turn)
    # A step between two surfaces is judged by the shorter of both radii.
    step = step_between(offset, records.normal[j], records.surface[j], normal)
    weight[step > STEP / STRETCH * np.minimum(records.radius[at], records.radius[j])] = 0
    beside = np.minimum(1, records.radius[at] / records.radius[j]) ** 2
    weight *= np.where(tilted[pairs.places][place], 1, beside)
    agreement = _agreement(guides, way, smoothing)
    # A record agrees with itself; its weight must not round to zero.
    weights = weight * np.maximum(agreement.T, np.where(j == at, 1, 0))
    begin = np.searchsorted(place, np.arange(len(pairs.places)))

    def mean(values: Floats, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        weight = weight.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(weight * values, begin) / np.add.reduceat(weight, begin))

    E, difference = _expected(records, way), _differences(records, way)
    # Average each half with the weights from the other half's guide.
    whole = (mean(E + difference, weights[1]) + mean(E - difference, weights[0])) / 2
    lasting = weights.sum(axis=0) * np.minimum(1, records.radius[j] / records.radius[at]) ** 4
    return whole, mean(records.translation[j], lasting), mean(records.rotation[j], lasting)


def _heard(records: Records, rows: NDArray[np.intp], reach: Floats) -> NDArray[np.intp]:
    """Some rows, and those of the compatible records within the reach (metres) of any of them."""
    near = np.zeros(len(records), bool)
    near[rows] = True
    others = np.flatnonzero(~near)
    sites = CompatibleSites(records.position[others], records.normal[others])
    for pairs in sites.near(records.position[rows], records.normal[rows], reach):
        near[others[pairs.site]] = True
    return np.flatnonzero(near)


def _with_confirmed_gradients(
    records: Records, parallel: CompatibleSites, rows: NDArray[np.intp], smoothing: Smoothing
) -> Records:
    """Some records, with their gradients by position scaled down to what their neighbours' measurements confirm.

    The gradient of a hemisphere takes each change of light between two strata for an edge of the nearer surface. Where
    the edge of a partition and the sill of a far window lie in one stratum, the window is assumed to move with the
    partition, and the gradient is many times too large. What the neighbours measured shows this. The gradient is
    multiplied by s, the slope of the measured over the predicted changes by weighted least squares, with a prior of
    mean 1 and standard deviation 1. A neighbour's value has two uncertainties: its standard error and, since irradiance
    is not linear, tolerance / errors of the brighter of both records. s is clipped to [0, 1]: gradients below the noise
    become shorter on average, and none becomes longer.

    Args:
        records: R records.
        parallel: the records, to search for parallel ones.
        rows: rows of the records that are wanted.
        smoothing: as in `smooth`.
    """
    E = np.maximum(records.irradiance.mean(axis=2, dtype=np.float64).sum(axis=1), np.finfo(np.float32).tiny)
    gradient = records.translation.mean(axis=2, dtype=np.float64).sum(axis=1)
    error = np.sqrt(np.square(records.standard_error, dtype=np.float64).sum(axis=1))
    wide = _stretched(records)
    confirmed = np.ones(len(rows), np.float32)
    position, normal = records.position[rows], records.normal[rows]
    for pairs in parallel.near(position, normal, wide.radius[rows]):
        weight = pair_weights(position[pairs.place], normal[pairs.place], wide, pairs.site).astype(np.float64)
        near = np.flatnonzero(weight)
        places, at, j, weight = pairs.places, pairs.at[near], pairs.site[near], weight[near]
        i = rows[places][at]
        weight *= np.minimum(1, records.radius[i] / records.radius[j]) ** 2
        measured, noise = E[j] / E[i], error[j] / E[i]
        weight /= noise**2 + np.square(smoothing.tolerance / smoothing.errors * np.maximum(measured, 1))
        # Predicted by the mean of both gradients, as in `_expected`.
        offset = records.position[j] - records.position[i]
        said = np.einsum("px,px->p", gradient[i] + gradient[j], offset) / (2 * E[i])
        powers = (weight, weight * said, weight * measured, weight * said**2, weight * said * measured)
        w, x, y, xx, xy = (np.bincount(at, power, len(places)) for power in powers)
        slope = (1 + xy - x * y / w) / (1 + np.maximum(xx - x**2 / w, 0))
        confirmed[places] = np.clip(slope, 0, 1)
    records, part = records.take(rows), confirmed[:, None, None, None]
    return dataclasses.replace(
        records, translation=records.translation * part, guide_translation=records.guide_translation * part
    )


def _tilted(records: Records) -> NDArray[np.bool_]:
    """(R,) whether either guide of a record saw far less of its gradient than all of its paths did."""
    gradient = np.linalg.norm(records.translation.mean(axis=(1, 2), dtype=np.float64), axis=1)
    guided = np.linalg.norm(records.guide_translation.mean(axis=1, dtype=np.float64), axis=2)
    whole, guides = records.irradiance.mean(axis=(1, 2), dtype=np.float64), records.guide.mean(axis=1)
    # Steepness is gradient over irradiance; cross-multiplied to avoid division by 0.
    return np.asarray((gradient[:, None] * guides > TILTED * guided * whole[:, None]).any(axis=1))


def _expected(records: Records, way: _Way) -> Floats:
    """(P, K, 3) irradiance that records `j` predict at records `at`.

    Gradients are the mean of both records', which is exact to second order: in position, in the direction of the
    normal, and in both together, as along a curved surface. With the gradients of `j` alone, neighbours would predict
    too much all around a maximum, and too little on a pillar that a floor lights.
    """
    j, at, offset, turn = way
    translation, rotation = ((g[j] + g[at]) / 2 for g in (records.translation, records.rotation))
    return np.asarray(
        records.irradiance[j]
        + np.einsum("pkcx,px->pkc", translation, offset)
        + np.einsum("pkcx,px->pkc", rotation, turn)
    )


def _differences(records: Records, way: _Way) -> Floats:
    """(P, K, 3) half of the difference between what the two halves of records `j` predict at records `at`.

    Each half is extrapolated by the gradients of its own guide. If both were extrapolated by the mean gradients, each
    would contain gradients on which its weights depend, and light would be lost.
    """
    j, at, offset, turn = way
    translation, rotation = ((g[j] + g[at]) / 2 for g in (records.guide_translation, records.guide_rotation))
    grown = np.einsum("pkgx,px->pkg", translation, offset) + np.einsum("pkgx,px->pkg", rotation, turn)
    return np.asarray(records.difference[j] + (grown @ _SIGNS)[..., None] / 2)


def _agreement(guides: _Guides, way: _Way, smoothing: Smoothing) -> NDArray[np.float64]:
    """(P, 2) agreement of what records `j` predict at records `at` with the latter, by each guide: from 0 to 1."""
    j, at, offset, turn = way
    translation, rotation = ((g[j] + g[at]) / 2 for g in (guides.translation, guides.rotation))
    expected = guides.light[j]
    expected = (
        expected + np.einsum("pgx,px->pg", translation, offset) + np.einsum("pgx,px->pg", rotation, turn)
    )
    own = guides.light[at]
    allowed = smoothing.tolerance * np.maximum(own, np.finfo(np.float32).tiny)  # black records: no overflow
    allowed += smoothing.errors * np.hypot(guides.error[j], guides.error[at])
    unlike = np.abs(expected - own) / allowed
    return np.asarray(np.maximum(0, 1 - np.minimum(unlike, 1) ** 2) ** 2)
