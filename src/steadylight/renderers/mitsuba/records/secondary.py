"""The secondary cache: gather paths look it up at the surfaces that they hit, so that most of them end there.

With a fixed number of bounces, only the first hit is looked up; otherwise, every hit is. The records are few and
coarse, since a gather averages over its hemisphere.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing, smooth
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.exchange import (
    LEFT_OUT,
    MOST_BOUNCES,
    irradiance_of,
    of_all_bounces,
    of_bounces,
    path_ends,
    strata_of_exchange,
)
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.importance import (
    MOST_MORE_EXCHANGE,
    MOST_MORE_LIGHT,
    Doubles,
    Effort,
    importance,
    shared_out,
)
from steadylight.renderers.mitsuba.records.indirect import MOST_VERTICES, PathEnd, Secondary
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import seed_of
from steadylight.renderers.mitsuba.upload import download

SMOOTHING = Smoothing()
"""As at normal quality, whatever the quality: the secondary records hardly change with it."""

PLACING = 4
"""Strata in elevation of the hemispheres that determine the spacing of secondary records; four times as many in
azimuth, so 64 pilot and 64 refinement paths."""

REACH = 8.0
"""Maximum distance at which a secondary record is used, in units of the radius that its light allows. Its own radius is
often longer. If the record that is drawn lies further away, the path continues. No other record replaces it: dark ones
from corners would darken open surfaces, or bright ones from the open would light up corners. With 1 to 16, gathers are
within 0.3 % of path-traced light in three rooms; with 1 they take 50 % longer than without a bound, with 8, 10 %."""

FINER = 2
"""Additional levels of its octree. In cluttered places, its records have long radii and face all directions: in
living-room, a look-up met 35 records with no additional level, 20 with one, 13 with two. The cache is small, and every
path looks it up."""

SHORT, OUTLIER, AROUND, ERRORS = 4.0, 3.0, 8, 3.0
"""A record is an outlier if the smallest radius is more than SHORT times what its light allows, and it is, by more than
ERRORS standard errors, more than OUTLIER times as bright as the median of its AROUND nearest neighbours."""


class SecondaryRecords(NamedTuple):
    """The records of the secondary cache.

    Attributes:
        records: R records of one value.
        reach: (R,) maximum distance at which a gather uses each, metres.
    """

    records: Records
    reach: Floats


class FirstBounce(NamedTuple):
    """The first step towards the secondary cache: its places, and their light of one diffuse bounce.

    Attributes:
        records: R records of that light, A, without caustics that photons carry.
        sky: (R, 3) irradiance of the cached part of the environment alone, W/m².
        expected: (R,) rough estimate of the irradiance of all bounces, mean of the channels, W/m².
        exchange: (R,) factors on the number of paths of the exchange.
        reach: (R,) as in `SecondaryRecords`.
    """

    records: Records
    sky: Doubles
    expected: Doubles
    exchange: NDArray[np.intp]
    reach: Floats


def first_bounce(gather: Gather, points: Points, bounds: RadiusBounds) -> FirstBounce | None:
    """The light of the first bounce, at places that a gather of the environment alone has chosen.

    Args:
        gather: scene, quality of the secondary records, bounces of the records that will use them, and context.
        points: where gather rays may end, roughly spread.
        bounds: of the radius.

    Returns:
        None if there is nothing to store: no bounce before the last and no environment.
    """
    exists = gather.context.lighting.environment.exists
    if gather.bounces == 0 or (gather.bounces == 1 and not exists):
        return None
    filler = Filler(dataclasses.replace(_by_itself(gather, 0), quality=_of_places(gather)), bounds)
    records = filler.fill(points, seed_of(0))
    if len(records) == 0:
        none = irradiance_of(records)
        return FirstBounce(records, none, none[:, 0], np.zeros(0, np.intp), records.radius)
    made = _of_first_bounce(gather, records, bounds, seed_of(1))
    if gather.bounces != 1:  # with a single bounce, there is no exchange
        unknown = _unknown(gather, made, bounds)
        further = filler.fill(unknown, seed_of(2))
        records = Records.concatenate(records, further)
        made = Records.concatenate(made, _of_first_bounce(gather, further, bounds, seed_of(3)))
    effort, expected = _effort(gather, made, bounds)
    made = _measured_again(gather, made, bounds, effort.light)
    reach = (REACH * made.radius).astype(np.float32)
    first = _with_least_radius(made, bounds)
    return FirstBounce(first, irradiance_of(records), expected, effort.exchange, reach)


def secondary_cache(gather: Gather, found: FirstBounce) -> SecondaryRecords:
    """Indirect irradiance at the surfaces that gather rays may hit, with one bounce less than that of the records.

    Irradiance is E = A + T E, where A is the light of one diffuse bounce and of the environment, and T the transport
    between surfaces. Each is measured once.

    Args:
        gather: as in `first_bounce`.
        found: A.
    """
    first = found.records
    if len(first) == 0:
        return SecondaryRecords(first, found.reach)
    if gather.bounces is None:
        irradiance = of_all_bounces(gather, first, found.exchange)
    else:
        irradiance = of_bounces(gather, first, found.exchange, found.sky, gather.bounces - 1)
    # Smoothing dims the brightest records slightly, and these light all others: so exchange the light as measured.
    known = smooth(first, smoothing=SMOOTHING)
    irradiance = np.maximum(irradiance - irradiance_of(first) + irradiance_of(known), 0)
    known = dataclasses.replace(known, irradiance=irradiance[:, None].astype(np.float32))
    return SecondaryRecords(known, found.reach)


def _of_places(gather: Gather) -> RecordQuality:
    """Quality of the records that determine where secondary records are placed.

    With a fixed number of bounces, their irradiance is used too. With all bounces, only their places are, which depend
    on the radii; a few paths are enough for these.
    """
    if gather.bounces is not None:
        return gather.quality
    strata = 4 * PLACING**2
    return dataclasses.replace(
        gather.quality, polar_strata=PLACING, azimuth_strata=4 * PLACING, refinement_paths=(strata,)
    )


def _by_itself(gather: Gather, bounces: int) -> Gather:
    """The gather without a secondary cache, and without caustics; the same kernel for any number of bounces."""
    black = Secondary.black(photons=gather.context.caustics is not None)
    context = gather.context._replace(secondary=black, caustics=None)
    return dataclasses.replace(gather, bounces=bounces, context=context)


def _of_first_bounce(
    gather: Gather, records: Records, bounds: RadiusBounds, seed: int, times: int = 1
) -> Records:
    """A, measured at the places of the records, with `times` as many paths as their quality specifies."""
    limits = bounds.at(records.position)
    free = limits._replace(smallest=np.minimum(limits.smallest, bounds.floor).astype(np.float32))
    once = _by_itself(gather, MOST_VERTICES if gather.bounces is None else gather.bounces - 1)
    paths = tuple(times * each for each in gather.quality.refinement_paths)
    once = dataclasses.replace(once, quality=dataclasses.replace(once.quality, refinement_paths=paths))
    return gather_records(once, Places(records.position, records.normal, free), seed)


def _effort(gather: Gather, made: Records, bounds: RadiusBounds) -> tuple[Effort, Doubles]:
    """Number of paths of each record, from a few paths that estimate the transport between records.

    Args:
        gather: as in `first_bounce`.
        made: A, with the same number of paths for each record.
        bounds: of the radius.

    Returns:
        The number of paths, and (R,) an estimate of the irradiance of all bounces, mean of the channels.
    """
    A = irradiance_of(made).mean(axis=1)
    if gather.bounces == 1:  # there is no exchange
        return Effort.even(len(made)), A
    ends = _few_path_ends(gather, made, bounds)
    throughput = np.concatenate([download(end.throughput).mean(axis=1, dtype=np.float64) for end in ends])
    drawn = np.concatenate([download(end.row) for end in ends])
    paths = len(drawn) // len(made)
    receives = np.repeat(np.arange(len(made)), paths)
    T = csr_array((throughput / paths, (receives, drawn)), (len(made), len(made)))
    bounces = MOST_BOUNCES if gather.bounces is None else gather.bounces - 1
    counts, E = importance(T, A, bounces, LEFT_OUT)
    whole = counts @ A
    if whole <= 0:  # a black scene
        return Effort.even(len(made)), E
    of_light = np.sqrt(np.square(made.standard_error, dtype=np.float64).sum(axis=1)) / whole
    of_exchange = (throughput * E[drawn]).reshape(-1, paths).std(axis=1) / (
        2 * strata_of_exchange(gather) * whole
    )
    light = shared_out(counts, of_light, MOST_MORE_LIGHT)
    return Effort(light, shared_out(counts, of_exchange, MOST_MORE_EXCHANGE)), E


def _measured_again(gather: Gather, made: Records, bounds: RadiusBounds, times: NDArray[np.intp]) -> Records:
    """A, where records of more than the usual number of paths are measured again with `times` as many."""
    rows, parts = [], []
    for more in np.unique(times).tolist():
        rows.append(np.flatnonzero(times == more))
        some = made.take(rows[-1])
        again = some if more == 1 else _of_first_bounce(gather, some, bounds, seed_of(4, more), more)
        parts.append(again)
    return Records.concatenate(*parts).take(np.argsort(np.concatenate(rows)))


def _with_least_radius(made: Records, bounds: RadiusBounds) -> Records:
    return with_least_radius(made, bounds.at(made.position).smallest)


def _unknown(gather: Gather, made: Records, bounds: RadiusBounds) -> Points:
    """Surface points that records see but that no visible record covers, as found by a few paths from each record.

    They need records of their own: where a path of the exchange meets an unknown surface, a single further path
    estimates the light of its first bounce (`Exchange.from_missed`).

    Args:
        gather: as in `first_bounce`.
        made: the records; only their geometry is used, not their irradiance.
        bounds: of the radius.
    """
    found = []
    for end in _few_path_ends(gather, made, bounds):
        rows = np.array(end.missed)
        found.append(Points.anywhere(download(end.missed_position)[rows], download(end.missed_normal)[rows]))
    return Points.concatenate(found)


def _few_path_ends(gather: Gather, made: Records, bounds: RadiusBounds) -> list[PathEnd]:
    """`path_ends` from every record, with a third of its strata in elevation, rounded up.

    Without a minimum distance: placing further records would not satisfy it.
    """
    cache = DeviceCache(_with_least_radius(made, bounds)).with_fallback()
    return path_ends(gather, cache, (gather.quality.polar_strata + 2) // 3, np.arange(len(made)), 0)


def with_least_radius(records: Records, smallest: Floats) -> Records:
    """The records of the secondary cache, with at least the smallest radius, except for outliers.

    The smallest radius spans many pixels. A bright record in a recess beside a lamp must not light metres of ceiling
    around it: it keeps the radius that its light allows. A record that is bright only by noise is not an outlier, or
    light would be lost. Nor is a dark record in a corner, since bright ones outside reach just as far into it.

    Args:
        records: with the radius that their light allows.
        smallest: (R,) metres.
    """
    if len(records) == 0:
        return records
    short = records.radius * SHORT < smallest
    near = compatible_neighbours(records.position, records.normal, AROUND + 1, within=2 * smallest)
    others, alike = near.rows[:, 1:], near.compatible[:, 1:]
    brightness = records.irradiance.sum(axis=1).mean(axis=1)
    surely = brightness - ERRORS * np.sqrt(np.square(records.standard_error).sum(axis=1))
    around = np.full(len(records), np.inf, np.float32)
    some = alike.any(axis=1)
    around[some] = np.nanmedian(np.where(alike, brightness[others], np.nan)[some], axis=1)
    outlier = short & (surely > OUTLIER * around)
    radius = np.where(outlier, records.radius, np.maximum(records.radius, smallest))
    trust = (records.radius / radius)[:, None, None, None]  # as in `gather`
    return dataclasses.replace(
        records,
        radius=radius,
        translation=records.translation * trust,
        guide_translation=records.guide_translation * trust,
    )
