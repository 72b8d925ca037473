"""The secondary cache: what a gather asks at its first hits, so that most of its paths end there.

Its records are few and coarse, since a gather averages over all that its hemisphere sees.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing, smooth
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import seed_of

SMOOTHING = Smoothing()
"""As at normal quality, whatever the quality: its records hardly change with it."""

SHORT, OUTLIER, AROUND, ERRORS = 4.0, 3.0, 8, 3.0
"""A record is left out if its smallest radius is more than SHORT times what its light allows, and it is, by more than
ERRORS standard errors, more than OUTLIER times as bright as most of the AROUND nearest are."""


def secondary_cache(gather: Gather, points: Points, bounds: RadiusBounds) -> DeviceCache | None:
    """Indirect irradiance at the surfaces that gather rays may hit, one bounce less than the records have.

    Built from the light outwards: records of the cached part of the environment alone, then of one bounce more each
    time, at the same places.

    Args:
        gather: scene, quality of the secondary records, bounces of the records that will use them, and what it may use
            itself.
        points: where gather rays may end, roughly spread.
        bounds: limits of the radius.

    Returns:
        None where there is nothing to know: no bounce before the last and no environment.
    """
    exists = gather.context.lighting.environment.exists
    if gather.bounces == 0 or (gather.bounces == 1 and not exists):
        return None
    records = Filler(dataclasses.replace(gather, bounces=0), bounds).fill(points, seed_of(0))
    limits = bounds.at(records.position)
    free = limits._replace(smallest=np.minimum(limits.smallest, bounds.floor).astype(np.float32))
    places = Places(records.position, records.normal, free)
    cache: DeviceCache | None = None
    for level in range(0 if exists else 1, gather.bounces):
        context = gather.context._replace(secondary=cache)
        records = gather_records(
            dataclasses.replace(gather, bounces=level, context=context), places, seed_of(level)
        )
        cache = DeviceCache(smooth(without_outliers(records, limits.smallest), smoothing=SMOOTHING))
    return cache


def without_outliers(records: Records, smallest: Floats) -> Records:
    """The records of the secondary cache, with at least the smallest radius.

    Many pixels may lie between records so coarse. One in a recess beside a lamp must not speak for metres of ceiling
    around it. What is bright by its own noise is kept: light would be lost. Dark ones in corners are kept: bright ones
    from the open answer just as far into these.

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
    rows = np.flatnonzero(~(short & (surely > OUTLIER * around)))
    records, smallest = records.take(rows), smallest[rows]
    radius = np.maximum(records.radius, smallest)
    trust = (records.radius / radius)[:, None, None, None]  # as in `gather`
    return dataclasses.replace(
        records,
        radius=radius,
        translation=records.translation * trust,
        guide_translation=records.guide_translation * trust,
    )
