"""The exchange of light between the surfaces of the secondary cache: all bounces from that of the first.

Irradiance is E = A + T E, where A is the light of one diffuse bounce and of the environment, and T the transport
between surfaces. T is measured once, by paths from each record to the surfaces that it sees; E is a Neumann series.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.records.gather import Gather
from steadylight.renderers.mitsuba.records.hemisphere import angles, direction, jittered, split
from steadylight.renderers.mitsuba.records.importance import Doubles
from steadylight.renderers.mitsuba.records.indirect import MOST_VERTICES, PathEnd, Secondary, path_end
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.origins import Hemispheres
from steadylight.renderers.mitsuba.records.tracing import Paths, single_paths
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of, seed_of
from steadylight.renderers.mitsuba.upload import download, upload

LEFT_OUT = 0.001
"""Fraction of the light below which further bounces are extrapolated rather than followed: a tenth of what
`--bounces auto` may leave out, since the extrapolation errs too, and a sweep takes only hundredths of a second."""

MOST_BOUNCES = 100
"""Maximum number of bounces that are followed: in a closed room without absorption, the series would not converge."""

MOST_PASSED_ON = 0.99
"""Upper bound of the fraction of light that a bounce passes on, in extrapolating further bounces."""

NEAREST = 1.0
"""In the exchange, a record is used at the first surface of a path only if the path is longer than this fraction of its
radius, as in a gather. The record represents light further out; close to the surface where the path starts, it is
darker. At later surfaces, the error matters less."""


def irradiance_of(records: Records) -> Doubles:
    """(R, 3) irradiance of records of one value."""
    return records.irradiance[:, 0].astype(np.float64)


def of_all_bounces(gather: Gather, first: Records, times: NDArray[np.intp]) -> Doubles:
    """The irradiance E of all bounces, (R, 3), from that of the first, A: a Neumann series.

    Each bounce adds T times what the previous one added. If photons carry caustics, C, these are part of the light that
    surfaces pass on, but not of the result: E - C = A + T C + T (E - C).

    Args:
        gather: as in `secondary.first_bounce`.
        first: A.
        times: as in `Exchange`.
    """
    exchange = Exchange(gather, first, times)
    added = irradiance_of(first) + exchange.from_gradients(None) + exchange.from_missed(None)
    if gather.context.caustics is not None:
        added += exchange.from_caustics()
    irradiance = added
    for _ in range(MOST_BOUNCES):
        further = exchange.passed_on(added)
        irradiance, rest, added = irradiance + further, _rest(further, added, np.inf), further
        if rest.sum() <= LEFT_OUT * irradiance.sum():
            return irradiance + rest
    return irradiance


def of_bounces(
    gather: Gather, first: Records, times: NDArray[np.intp], of_none: Doubles, bounces: int
) -> Doubles:
    """The irradiance of a fixed number of bounces, (R, 3).

    Glossy surfaces may scatter a path before it ends at a diffuse lobe, and each scattering counts as a bounce. E(n) is
    A, plus the sum over j of T(j) E(n - j), where T(j) is the transport by paths of j bounces, plus what gradients add
    to it, plus the light of surfaces without a record.

    Args:
        gather: as in `secondary.first_bounce`.
        times: as in `Exchange`.
        first: A, as measured with the most bounces. It is used for fewer bounces too; the error is light that has been
            scattered by glossy surfaces alone more often than these allow.
        of_none: (R, 3) irradiance of the cached part of the environment alone.
        bounces: number of bounces.
    """
    once = irradiance_of(first)
    if bounces == 0 or (bounces == 1 and not of_none.any()):
        return once  # there is no earlier bounce
    known = [of_none]
    exchange = Exchange(gather, first, times)
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


def strata_of_exchange(gather: Gather) -> int:
    """Strata in elevation, M, of the paths that measure the exchange: 4 M² paths per record."""
    return gather.quality.polar_strata // 2 + 1


class Exchange:
    """The transport T between surfaces, measured by paths from each record to the surfaces that it sees.

    Most records need only one path in each of about a third as many strata: irradiance varies less over surfaces than
    emitted light, and the gather averages it once more. A single record is therefore used where a path ends. The light
    of the first bounce is extrapolated from the record to that point by its gradients; otherwise edges and corners
    would be too bright, since the records used there stand further out. The light of further bounces changes less.

    Attributes:
        most: maximum number of bounces of a path that found a surface.
    """

    def __init__(self, gather: Gather, first: Records, times: NDArray[np.intp]) -> None:
        """Trace the paths.

        Args:
            gather: as in `secondary.first_bounce`.
            first: A.
            times: (R,) factor on the number of paths of each record.
        """
        M = strata_of_exchange(gather)
        self._paths = 4 * M**2
        self._times = times
        cache = DeviceCache(first).with_fallback()
        caustics = gather.context.caustics
        covered = Secondary.black_where_covered(cache, None if caustics is None else caustics.grid)
        self._context = gather.context._replace(secondary=covered)
        self._ends = path_ends(gather, cache, M, np.repeat(np.arange(len(first)), times), NEAREST)
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
        to another. Photons carry caustics. In furnished rooms, 5 to 10 % of the light
        of secondary records is found in this way.

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
                # Different from the seed in `path_ends`, by which the surface was found.
                seed = seed_of(number, len(self._ends), 1)
                rows = np.array(lane)
                L = download(self._along_one_path(end, lane, seed, left))
                irradiance = np.pi * L + download(self._caustics(end, lane))
                light = download(end.missed_throughput)[rows] * irradiance
                value[rows] = np.where(np.isfinite(light).all(axis=1, keepdims=True), light, 0)
            means.append(value.reshape(-1, self._paths, 3).mean(axis=1))
        return self._by_record(means)

    def from_caustics(self) -> Doubles:
        """Contribution of caustics to the light that surfaces pass on, T C, (R, 3).

        C is that of the very place where a path ends. It varies faster than the records are spaced: on a window sill,
        a few of them would have to stand for the brightest light of the room.
        """
        means = []
        secondary = self._context.secondary
        for end in self._ends:
            C = secondary.photons.irradiance(end.position, end.normal, end.bounces > 0)
            means.append(_means(end.throughput * C, self._paths))
        return self._by_record(means)

    def _caustics(self, end: PathEnd, lane: mi.UInt32) -> mi.Color3f:
        """Irradiance by photons of the missed surface of each of these lanes."""
        secondary = self._context.secondary
        p, n = (dr.gather(type(each), each, lane) for each in (end.missed_position, end.missed_normal))
        return secondary.photons.irradiance(p, n, mi.Bool(secondary.casts))

    def _along_one_path(
        self, end: PathEnd, lane: mi.UInt32, seed: int, bounces: mi.UInt32 | int
    ) -> mi.Color3f:
        """Radiance along one path from the missed surface of each of these lanes; see `from_missed`."""
        index = lane % self._paths
        samples = samples_of(dr.opaque(mi.UInt32, seed), lane // self._paths, index)
        place = samples.at(mi.UInt32(1), mi.UInt32(0)).sample_2d(Purpose.DIFFUSE_LOBE)
        p, n = (dr.gather(type(each), each, lane) for each in (end.missed_position, end.missed_normal))
        found = Hemispheres.above(self._context.lighting.scene, p, n)
        start = Hemispheres(
            **{name: _spread(part, lane, dr.width(end.row)) for name, part in vars(found).items()}
        )
        paths = Paths(lane, dr.zeros(mi.UInt32, dr.width(lane)), place, index)
        return single_paths(self._context, start, paths, self._paths, seed, bounces)


def path_ends(
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
        start = Hemispheres.above(lighting.scene, p, n)
        dr.eval(start)
        frame = mi.Frame3f(dr.gather(mi.Normal3f, n, record))
        ray, _ = start.ray(record, frame.to_world(direction(cos_theta, sin_theta, phi)))
        end = path_end(lighting, samples_of(seed, record, stratum), ray, cache, least)
        share = start.transmittance(lighting.bsdfs, record, cos_theta)
        end = end._replace(
            throughput=end.throughput * share,
            change=end.change * share,
            missed_throughput=end.missed_throughput * share,
        )
        dr.eval(*end)
        ends.append(end)
    return ends


def _spread(values: Any, lane: mi.UInt32, width: int) -> Any:
    """An array of this width with values in these lanes, and zero in the others."""
    spread = dr.zeros(type(values), width)
    dr.scatter(spread, values, lane)
    return spread


def _means(value: mi.Color3f, paths: int) -> Doubles:
    """(H, 3) means over the paths of each of H hemispheres, `paths` per hemisphere."""
    dr.eval(value)
    sums = [np.array(dr.block_sum(channel, paths)) for channel in value]
    return np.stack(sums, axis=1).astype(np.float64) / paths
