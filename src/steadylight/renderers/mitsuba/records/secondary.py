"""The secondary cache: gather paths look it up at the surfaces that they hit, so that most of them end there.

With a fixed number of bounces, only the first hit is looked up; otherwise, every hit is. The records are few and
coarse, since a gather averages over its hemisphere.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing, smooth
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import (
    Gather,
    Hemispheres,
    Paths,
    Places,
    gather_records,
    off_surface,
    single_paths,
)
from steadylight.renderers.mitsuba.records.hemisphere import angles, direction, jittered, split
from steadylight.renderers.mitsuba.records.importance import (
    MOST_MORE_EXCHANGE,
    MOST_MORE_LIGHT,
    Doubles,
    Effort,
    importance,
    shared_out,
)
from steadylight.renderers.mitsuba.records.indirect import (
    MOST_VERTICES,
    PathEnd,
    Secondary,
    path_end,
)
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of, seed_of
from steadylight.renderers.mitsuba.upload import download, upload

SMOOTHING = Smoothing()
"""As at normal quality, whatever the quality: the secondary records hardly change with it."""

LEFT_OUT = 0.001
"""Fraction of the light below which further bounces are extrapolated rather than followed: a tenth of what
`--bounces auto` may leave out, since the extrapolation errs too, and a sweep takes only hundredths of a second."""

PLACING = 4
"""Strata in elevation of the hemispheres that determine the spacing of secondary records; four times as many in
azimuth, so 64 pilot and 64 refinement paths."""

MOST_BOUNCES = 100
"""Maximum number of bounces that are followed: in a closed room without absorption, the series would not converge."""

MOST_PASSED_ON = 0.99
"""Upper bound of the fraction of light that a bounce passes on, in extrapolating further bounces."""

REACH = 8.0
"""Maximum distance at which a secondary record is used, in units of the radius that its light allows. Its own radius is
often longer. If the record that is drawn lies further away, the path continues. No other record replaces it: dark ones
from corners would darken open surfaces, or bright ones from the open would light up corners. With 1 to 16, gathers are
within 0.3 % of path-traced light in three rooms; with 1 they take 50 % longer than without a bound, with 8, 10 %."""

NEAREST = 1.0
"""In the exchange, a record is used at the first surface of a path only if the path is longer than this fraction of its
radius, as in a gather. The record represents light further out; close to the surface where the path starts, it is
darker. At later surfaces, the error matters less."""

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


def secondary_cache(gather: Gather, points: Points, bounds: RadiusBounds) -> SecondaryRecords | None:
    """Indirect irradiance at the surfaces that gather rays may hit, with one bounce less than that of the records.

    Irradiance is E = A + T E, where A is the light of one diffuse bounce and of the environment, and T the transport
    between surfaces. Each is measured once, at places that a gather of the environment alone has chosen.

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
        return SecondaryRecords(records, records.radius)
    made = _of_first_bounce(gather, records, bounds, seed_of(1))
    if gather.bounces != 1:  # with a single bounce, there is no exchange
        unknown = _unknown(gather, made, bounds)
        further = filler.fill(unknown, seed_of(2))
        records = Records.concatenate(records, further)
        made = Records.concatenate(made, _of_first_bounce(gather, further, bounds, seed_of(3)))
    effort = _effort(gather, made, bounds)
    made = _measured_again(gather, made, bounds, effort.light)
    first = _with_least_radius(made, bounds)
    if gather.bounces is None:
        irradiance = _of_all_bounces(gather, first, effort.exchange)
    else:
        irradiance = _of_bounces(gather, first, effort.exchange, _light(records), gather.bounces - 1)
    # Smoothing dims the brightest records slightly, and these light all others: so exchange the light as measured.
    known = smooth(first, smoothing=SMOOTHING)
    irradiance = np.maximum(irradiance - _light(first) + _light(known), 0)
    known = dataclasses.replace(known, irradiance=irradiance[:, None].astype(np.float32))
    return SecondaryRecords(known, (REACH * made.radius).astype(np.float32))


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
    """The gather without a secondary cache; the same kernel for any number of bounces."""
    return dataclasses.replace(
        gather, bounces=bounces, context=gather.context._replace(secondary=Secondary.black())
    )


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


def _effort(gather: Gather, made: Records, bounds: RadiusBounds) -> Effort:
    """Number of paths of each record, from a few paths that estimate the transport between records.

    Args:
        gather: as in `secondary_cache`.
        made: A, with the same number of paths for each record.
        bounds: of the radius.
    """
    if gather.bounces == 1:  # there is no exchange
        return Effort.even(len(made))
    ends = _few_path_ends(gather, made, bounds)
    throughput = np.concatenate([download(end.throughput).mean(axis=1, dtype=np.float64) for end in ends])
    drawn = np.concatenate([download(end.row) for end in ends])
    paths = len(drawn) // len(made)
    receives = np.repeat(np.arange(len(made)), paths)
    T = csr_array((throughput / paths, (receives, drawn)), (len(made), len(made)))
    A = _light(made).mean(axis=1)
    bounces = MOST_BOUNCES if gather.bounces is None else gather.bounces - 1
    counts, E = importance(T, A, bounces, LEFT_OUT)
    whole = counts @ A
    if whole <= 0:  # a black scene
        return Effort.even(len(made))
    of_light = np.sqrt(np.square(made.standard_error, dtype=np.float64).sum(axis=1)) / whole
    of_exchange = (throughput * E[drawn]).reshape(-1, paths).std(axis=1) / (2 * _strata(gather) * whole)
    return Effort(
        shared_out(counts, of_light, MOST_MORE_LIGHT), shared_out(counts, of_exchange, MOST_MORE_EXCHANGE)
    )


def _strata(gather: Gather) -> int:
    """Strata in elevation, M, of the paths that measure the exchange: 4 M² paths per record."""
    return (gather.quality.polar_strata + 1) // 2


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
    estimates the light of its first bounce (`_Exchange.from_missed`).

    Args:
        gather: as in `secondary_cache`.
        made: the records; only their geometry is used, not their irradiance.
        bounds: of the radius.
    """
    found = []
    for end in _few_path_ends(gather, made, bounds):
        rows = np.array(end.missed)
        found.append(Points.anywhere(download(end.missed_position)[rows], download(end.missed_normal)[rows]))
    return Points.concatenate(found)


def _light(records: Records) -> Doubles:
    """(R, 3) irradiance of records of one value."""
    return records.irradiance[:, 0].astype(np.float64)


def _of_all_bounces(gather: Gather, first: Records, times: NDArray[np.intp]) -> Doubles:
    """The irradiance E of all bounces, (R, 3), from that of the first, A: a Neumann series.

    Each bounce adds T times what the previous one added.
    """
    exchange = _Exchange(gather, first, times)
    irradiance = added = _light(first) + exchange.from_gradients(None) + exchange.from_missed(None)
    for _ in range(MOST_BOUNCES):
        further = exchange.passed_on(added)
        irradiance, rest, added = irradiance + further, _rest(further, added, np.inf), further
        if rest.sum() <= LEFT_OUT * irradiance.sum():
            return irradiance + rest
    return irradiance


def _of_bounces(
    gather: Gather, first: Records, times: NDArray[np.intp], of_none: Doubles, bounces: int
) -> Doubles:
    """The irradiance of a fixed number of bounces, (R, 3).

    Glossy surfaces may scatter a path before it ends at a diffuse lobe, and each scattering counts as a bounce. E(n) is
    A, plus the sum over j of T(j) E(n - j), where T(j) is the transport by paths of j bounces, plus what gradients add
    to it, plus the light of surfaces without a record.

    Args:
        gather: as in `secondary_cache`.
        times: as in `_Exchange`.
        first: A, as measured with the most bounces. It is used for fewer bounces too; the error is light that has been
            scattered by glossy surfaces alone more often than these allow.
        of_none: (R, 3) irradiance of the cached part of the environment alone.
        bounces: number of bounces.
    """
    once = _light(first)
    if bounces == 0 or (bounces == 1 and not of_none.any()):
        return once  # there is no earlier bounce
    known = [of_none]
    exchange = _Exchange(gather, first, times)
    for n in range(1, bounces + 1):
        ways = range(1, min(n, exchange.most) + 1)
        passed = [exchange.passed_on(known[n - j], j) for j in ways if known[n - j].any()]
        known.append(once + sum(passed) + exchange.from_gradients(n) + exchange.from_missed(n))
        if n > 1:
            rest = _rest(known[n] - known[n - 1], known[n - 1] - known[n - 2], bounces - n)
            if rest.sum() <= LEFT_OUT * known[n].sum():
                return known[n] + rest
    return known[-1]


def _rest(added: Doubles, before: Doubles, bounces: float) -> Doubles:
    """What `bounces` more bounces would add if they continued as a geometric series; (R, 3).

    Args:
        added: (R, 3) by the last bounce.
        before: (R, 3) by the previous one.
        bounces: how many more, or infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.clip(np.nan_to_num(added.sum(axis=0) / before.sum(axis=0)), 0, MOST_PASSED_ON)
    return added * ratio * (1 - ratio**bounces) / (1 - ratio)


class _Exchange:
    """The transport T between surfaces, measured by paths from each record to the surfaces that it sees.

    Most records need only one path in each of about a quarter as many strata: irradiance varies less over surfaces than
    emitted light, and the gather averages it once more. A single record is therefore used where a path ends. The light
    of the first bounce is extrapolated from the record to that point by its gradients; otherwise edges and corners
    would be too bright, since the records used there stand further out. The light of further bounces changes less.

    Attributes:
        most: maximum number of bounces of a path that found a surface.
    """

    def __init__(self, gather: Gather, first: Records, times: NDArray[np.intp]) -> None:
        """Trace the paths.

        Args:
            gather: as in `secondary_cache`.
            first: A.
            times: (R,) factor on the number of paths of each record.
        """
        M = _strata(gather)
        self._paths = 4 * M**2
        self._times = times
        cache = DeviceCache(first).with_fallback()
        self._context = gather.context._replace(secondary=Secondary.black_where_covered(cache))
        self._ends = _path_ends(gather, cache, M, np.repeat(np.arange(len(first)), times), NEAREST)
        self.most = max(int(dr.max(end.bounces)[0]) for end in self._ends)

    def passed_on(self, irradiance: Doubles, bounces: int | None = None) -> Doubles:
        """T E, (R, 3): the mean over the paths of each record of throughput times irradiance where they end.

        Args:
            irradiance: E, (R, 3) of the records.
            bounces: use only paths with this many bounces; None for all.
        """
        known = upload(mi.Color3f, irradiance.astype(np.float32))
        means = []
        for end in self._ends:
            arrives = end.bounces > 0 if bounces is None else end.bounces == dr.opaque(mi.UInt32, bounces)
            value = end.throughput * dr.gather(mi.Color3f, known, end.row, arrives)
            means.append(_means(value, self._paths))
        return self._by_record(means)

    def from_gradients(self, bounces: int | None) -> Doubles:
        """Contribution of the gradients of A to T A, (R, 3).

        Args:
            bounces: of the irradiance, that of A included; None for all.
        """
        means = []
        for end in self._ends:
            counts = mi.Bool(True) if bounces is None else end.bounces < dr.opaque(mi.UInt32, bounces)
            means.append(_means(dr.select(counts, end.change, 0), self._paths))
        return self._by_record(means)

    def _by_record(self, means: list[Doubles]) -> Doubles:
        """(R, 3) means over the hemispheres of each record."""
        begin = np.cumsum(self._times) - self._times
        return np.asarray(np.add.reduceat(np.concatenate(means), begin) / self._times[:, None])

    def from_missed(self, bounces: int | None) -> Doubles:
        """Light from surfaces for which no visible record, or only one too near, was found, (R, 3).

        A path of the exchange that meets such a surface continues, and finds the light that known surfaces send to it.
        A further path from there, in a direction of its own, finds the rest: direct light on the surfaces that it
        meets, up to the first that the cache covers; but not light that glossy surfaces send from one unknown surface
        to another. In furnished rooms, 5 to 10 % of the light of secondary records is found in this way.

        Args:
            bounces: of the irradiance; None for all.
        """
        means = []
        for number, end in enumerate(self._ends):
            counts = end.missed if bounces is None else end.missed & (end.missed_bounces <= bounces)
            value = np.zeros((dr.width(end.row), 3))
            lane = dr.compress(counts)
            if len(lane) > 0:
                left = MOST_VERTICES
                if bounces is not None:
                    left = dr.opaque(mi.UInt32, bounces) - dr.gather(mi.UInt32, end.missed_bounces, lane)
                # Different from the seed in `_path_ends`, by which the surface was found.
                seed = seed_of(number, len(self._ends), 1)
                rows = np.array(lane)
                L = download(self._along_one_path(end, lane, seed, left))
                light = np.pi * download(end.missed_throughput)[rows] * L
                value[rows] = np.where(np.isfinite(light).all(axis=1, keepdims=True), light, 0)
            means.append(value.reshape(-1, self._paths, 3).mean(axis=1))
        return self._by_record(means)

    def _along_one_path(
        self, end: PathEnd, lane: mi.UInt32, seed: int, bounces: mi.UInt32 | int
    ) -> mi.Color3f:
        """Radiance along one path from the missed surface of each of these lanes; see `from_missed`."""
        index = lane % self._paths
        samples = samples_of(dr.opaque(mi.UInt32, seed), lane // self._paths, index)
        place = samples.at(mi.UInt32(1), mi.UInt32(0)).sample_2d(Purpose.DIFFUSE_LOBE)
        p, n = (dr.gather(type(each), each, lane) for each in (end.missed_position, end.missed_normal))
        origin = dr.zeros(mi.Point3f, dr.width(end.row))
        dr.scatter(origin, off_surface(self._context.lighting.scene, p, n), lane)
        paths = Paths(lane, dr.zeros(mi.UInt32, dr.width(lane)), place, index)
        start = Hemispheres(origin, end.missed_normal)
        return single_paths(self._context, start, paths, self._paths, seed, bounces)


def _means(value: mi.Color3f, paths: int) -> Doubles:
    """(H, 3) means over the paths of each of H hemispheres, `paths` per hemisphere."""
    dr.eval(value)
    sums = [np.array(dr.block_sum(channel, paths)) for channel in value]
    return np.stack(sums, axis=1).astype(np.float64) / paths


def _few_path_ends(gather: Gather, made: Records, bounds: RadiusBounds) -> list[PathEnd]:
    """`_path_ends` from every record, with a quarter of its strata in elevation, rounded up.

    Without a minimum distance: placing further records would not satisfy it.
    """
    cache = DeviceCache(_with_least_radius(made, bounds)).with_fallback()
    return _path_ends(gather, cache, (gather.quality.polar_strata + 3) // 4, np.arange(len(made)), 0)


def _path_ends(
    gather: Gather, cache: DeviceCache, M: int, rows: NDArray[np.intp], nearest: float
) -> list[PathEnd]:
    """Where paths from the records end at surfaces that the cache covers: one path in each of M x 4 M strata.

    Args:
        gather: scene and settings.
        cache: the cache that is looked up; paths start at its records.
        M: strata in elevation.
        rows: records from which paths start; may contain duplicates.
        nearest: as in `path_end`.
    """
    N = 4 * M
    records, lighting = cache.records.take(rows), gather.context.lighting
    at_once = max(1, PATHS_AT_ONCE // (M * N))
    # Opaque, so that all numbers of strata and distances share one kernel.
    rings, sectors, least = dr.opaque(mi.UInt32, M), dr.opaque(mi.UInt32, N), dr.opaque(mi.Float, nearest)
    ends = []
    for begin in range(0, len(records), at_once):
        some = records.take(np.arange(begin, min(begin + at_once, len(records))))
        lane = dr.arange(mi.UInt32, len(some) * M * N)
        record, stratum = split(lane, rings * sectors)
        seed = dr.opaque(mi.UInt32, seed_of(begin, len(records)))
        cos_theta, sin_theta, phi = angles(stratum, jittered(lane, mi.UInt32(0), seed), rings, sectors)
        p, n = upload(mi.Point3f, some.position), upload(mi.Normal3f, some.normal)
        start = off_surface(lighting.scene, p, n)
        dr.eval(start)
        frame = mi.Frame3f(dr.gather(mi.Normal3f, n, record))
        ray = mi.Ray3f(
            dr.gather(mi.Point3f, start, record), frame.to_world(direction(cos_theta, sin_theta, phi))
        )
        end = path_end(lighting, samples_of(seed, record, stratum), ray, cache, least)
        dr.eval(*end)
        ends.append(end)
    return ends


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
