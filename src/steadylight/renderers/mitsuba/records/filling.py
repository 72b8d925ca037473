"""Make records until every point of a given set is answered, in rounds without sequential dependence."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from steadylight.cache.lookup import ANSWERED, NORMAL_TOLERANCE
from steadylight.cache.placement import answered_weight, select
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import smooth
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.image.reconstruction import seed_of
from steadylight.renderers.mitsuba.records.gather import Bounds, GatherContext, gather_records
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.settings import CacheSettings

ROUNDS = 12
NARROWING = 0.4
"""Spacing shrinks by this factor each round; the last takes whatever is left."""

FEW = 24
"""So few points are not worth further rounds: each gets its record."""

FLOOR = 1e-5
"""No record reaches less than this part of the scene's diagonal."""


class Points(NamedTuple):
    """Surface points that wait for a record."""

    position: Floats  # (P, 3) metres, world
    normal: Floats  # (P, 3) unit, on the lit side
    longest: Floats  # (P,) records that reach further are not trusted here, metres

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        """All points of the parts, in that order."""
        none = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
        return cls(*(np.concatenate([empty, *(part[i] for part in parts)]) for i, empty in enumerate(none)))

    def take(self, rows: Any) -> Points:
        """The points at `rows` (indices or a mask)."""
        return Points(self.position[rows], self.normal[rows], self.longest[rows])


class RadiusBounds:
    """Smallest and largest radius of a record, from the whole camera path and never from the frame that looks.

    The smallest is a number of pixels as wide as they ever appear at that point: seen from the nearest camera
    position, whether or not anything stands between. The largest is a fraction of the scene's diagonal,
    and no longer than a cache in parts allows.
    """

    def __init__(
        self,
        poses: Sequence[Pose],
        width: int,
        diagonal: float,
        settings: CacheSettings,
        longest: float = np.inf,
    ) -> None:
        self._cameras = cKDTree(np.array([pose.to_world[:3, 3] for pose in poses]))
        narrowest = min(np.tan(np.radians(pose.fov) / 2) for pose in poses)
        self._per_metre = settings.minimum_spacing * 2 * narrowest / width
        self.floor = FLOOR * diagonal
        self.largest = min(settings.maximum_spacing * diagonal, longest)

    def at(self, position: Floats, longest: Floats | float = np.inf) -> Bounds:
        """Bounds at (P, 3) points, metres; the largest no larger than `longest`."""
        distance, _ = self._cameras.query(position)
        smallest = np.clip(self._per_metre * distance, self.floor, self.largest)
        smallest = smallest.astype(np.float32)
        largest = np.minimum(np.full_like(smallest, self.largest), longest)
        return Bounds(smallest, np.maximum(largest, smallest))


class Filler:
    """Makes records in one scene.

    Attributes:
        bounds: limits of every radius.
        context: what makes its gather quiet.
    """

    def __init__(
        self, scene: Any, bounds: RadiusBounds, settings: CacheSettings, bounces: int, context: GatherContext
    ) -> None:
        self._scene = scene
        self._settings = settings
        self._bounces = bounces
        self.context = context
        self.bounds = bounds

    def fill(self, points: Points, seed: int) -> Records:
        """Records that together answer every one of the points.

        Each round chooses points no closer than the round's spacing, gathers there, and drops every point that the
        new records answer. Early rounds are sparse, so that where light is smooth few records do; later ones go
        where the short radius of those left holes.

        Args:
            points: P points that the cache cannot answer.
            seed: of the order of preference and of the gather.

        Returns:
            At most P records.
        """
        points = points.take(np.random.default_rng(seed).permutation(len(points.position)))
        made: list[Records] = []
        weight = np.zeros(len(points.position), np.float32)
        if len(points.position) == 0:
            return Records.empty()
        extent = float(np.ptp(points.position, axis=0).max())
        coarse = min(self.bounds.largest, max(extent, 1e-6))
        for number in range(ROUNDS):
            if len(points.position) == 0:
                break
            limits = self.bounds.at(points.position, points.longest)
            spacing = np.maximum(coarse * NARROWING**number, limits.smallest / 4).astype(np.float32)
            last = number == ROUNDS - 1 or len(spacing) <= FEW
            rows = np.arange(len(spacing)) if last else select(points.position, points.normal, spacing)
            new = gather_records(
                self._scene,
                points.position[rows],
                points.normal[rows],
                Bounds(limits.smallest[rows], limits.largest[rows]),
                self._settings,
                bounces=self._bounces,
                seed=seed_of(seed, number),
                context=self.context,
            )
            made.append(new)
            weight += answered_weight(*points, new)
            waiting = weight < ANSWERED
            waiting[rows] = False
            points, weight = points.take(waiting), weight[waiting]
        return Records.joined(*made)


SECONDARY = CacheSettings(
    polar_strata=9,
    azimuth_strata=36,
    paths=(576,),
    accuracy=0.3,
    radii="split-sphere",
    minimum_spacing=12.0,
)
"""Records of the secondary cache are few and coarse: a gather averages over all that its hemisphere sees. Twice as far
apart, so many beside lamps are left out as glares (`_without_glares`) that indirect light was 1 to 1.7 % too dark."""

SECONDARY_NOISY = 4.0
"""`smoothing.NOISY` for the secondary cache, where nobody sees a glint: what is dropped with one would be lacking once
more with each bounce. 1.2 took 5 % of the light of a room lit through a door ajar (six bounces), this takes 2.6 %, and
1.6 % are lacking without smoothing, at more noise elsewhere."""


SHORT, OUTLIER, AROUND = 4.0, 3.0, 8
"""A record of the secondary cache is left out if its smallest radius is more than SHORT times what its light allows, and
it is more than GLARE times as bright as most of the AROUND nearest are."""


def _without_outliers(records: Records, smallest: Floats) -> Records:
    """The records of the secondary cache, which reach at least as far as the smallest radius.

    Many pixels may lie between records so coarse. One in a recess beside a lamp must not speak for metres of ceiling
    around it. Dark ones in corners are kept: bright ones from the open reach into these as far.

    Args:
        records: with the radius that their light allows.
        smallest: (R,) metres.
    """
    if len(records) == 0:
        return records
    short = records.radius * SHORT < smallest
    distance, near = cKDTree(records.position).query(records.position, range(2, AROUND + 2))
    near = np.minimum(near, len(records) - 1)  # where there are fewer, those at infinity
    alike = np.einsum("rx,rnx->rn", records.normal, records.normal[near]) > 1 - NORMAL_TOLERANCE
    alike &= distance <= 2 * smallest[:, None]
    brightness = records.irradiance.mean(axis=1)
    around = np.ma.median(np.ma.array(brightness[near], mask=~alike), axis=1).filled(np.inf)
    rows = np.flatnonzero(~(short & (brightness > OUTLIER * around)))
    records, smallest = records.take(rows), smallest[rows]
    radius = np.maximum(records.radius, smallest)
    trust = (records.radius / radius)[:, None, None]  # as in `gather`
    return dataclasses.replace(records, radius=radius, translation=records.translation * trust)


def secondary_cache(
    scene: Any, points: Points, bounds: RadiusBounds, bounces: int, context: GatherContext
) -> DeviceCache | None:
    """Indirect irradiance at the surfaces that gather rays may hit, one bounce less than the records have.

    Built from the light outwards: records of the soft sky alone, then of one bounce more each time, at the same
    places.

    Args:
        scene: mi.Scene.
        points: where gather rays may end, roughly spread.
        bounds: limits of the radius.
        bounces: of the records that will use it.
        context: what it may use itself.

    Returns:
        None where there is nothing to know: no bounce before the last and no soft sky.
    """
    if bounces == 0 or (bounces == 1 and not context.environment.exists):
        return None
    records = Filler(scene, bounds, SECONDARY, 0, context).fill(points, seed_of(0))
    limits = bounds.at(records.position)
    free = limits._replace(smallest=np.minimum(limits.smallest, bounds.floor).astype(np.float32))
    cache: DeviceCache | None = None
    for level in range(0 if context.environment.exists else 1, bounces):
        records = gather_records(
            scene,
            records.position,
            records.normal,
            free,
            SECONDARY,
            bounces=level,
            seed=seed_of(level),
            context=context._replace(secondary=cache),
        )
        cache = DeviceCache(smooth(_without_outliers(records, limits.smallest), noisy=SECONDARY_NOISY))
    return cache
