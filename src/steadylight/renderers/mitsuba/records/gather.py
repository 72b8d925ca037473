"""First-pass work: sample the hemisphere above surface points and make irradiance records from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.records import Floats, Records
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.barriers import nearest_barriers
from steadylight.renderers.mitsuba.records.caustics import with_caustics
from steadylight.renderers.mitsuba.records.gradients import reduced
from steadylight.renderers.mitsuba.records.hemisphere import (
    RIM,
    Halves,
    PathSamples,
    Strata,
    allocate,
    brightness,
    combined,
    error_of_one_path,
    grey,
    jittered,
    split,
    stratum_of,
    undivided,
)
from steadylight.renderers.mitsuba.records.hessian import second_derivatives
from steadylight.renderers.mitsuba.records.indirect import MOST_VERTICES
from steadylight.renderers.mitsuba.records.origins import Hemispheres
from steadylight.renderers.mitsuba.records.radius import Bounds, extrapolated_radius, wanted_radius
from steadylight.renderers.mitsuba.records.reuse import looks_at_bright
from steadylight.renderers.mitsuba.records.sky import sky_in_strata
from steadylight.renderers.mitsuba.records.tracing import (
    Constants,
    GatherContext,
    Paths,
    traced,
)
from steadylight.renderers.mitsuba.upload import download, upload

CROWDED = 0.5
"""Fraction of its usual paths that a record at the smallest radius takes, as look-ups average it with many others."""

STEEPEST = 0.5
"""Fraction of a record's irradiance that its gradient may add or subtract over the radius: half of what would bring it
to zero."""

NEARBY = 8
"""Number of nearest records, itself included, over which a record's noise is averaged."""


@dataclass(frozen=True)
class Gather:
    """How records are made.

    Attributes:
        quality: strata, paths, and measure of the radius.
        bounces: indirect bounces, glossy ones included; at least 1 (0 gives black records); None for all.
        context: what its paths meet.
        faint: irradiance, W/m², added to a record's own in the denominator of its relative error: errors of fainter
            light are not visible in the pictures.
    """

    quality: RecordQuality
    bounces: int | None
    context: GatherContext
    faint: float = 0.0


class Places(NamedTuple):
    """Where records are made."""

    position: Floats  # (P, 3) surface points, metres
    normal: Floats  # (P, 3) unit, on the lit side
    bounds: Bounds  # of the radius

    def take(self, rows: NDArray[Any] | slice) -> Places:
        """The places at `rows`."""
        limits = Bounds(self.bounds.smallest[rows], self.bounds.largest[rows])
        return Places(self.position[rows], self.normal[rows], limits)


def gather_records(gather: Gather, places: Places, seed: int) -> Records:
    """Make one record at each place.

    Ward, Rubinstein & Clear 1988 (doi:10.1145/54852.378490) for the record, Ward & Heckbert 1992 for the strata
    and gradients; see `hemisphere` for the distribution of the paths.

    Args:
        gather: how.
        places: where.
        seed: determines all random numbers, together with the order of the places.

    Returns:
        A record for each place, in the same order.
    """
    at_once = max(1, PATHS_AT_ONCE // gather.quality.refinement_paths[-1])
    parts = [
        _gather_batch(gather, places.take(slice(begin, begin + at_once)), begin, seed)
        for begin in range(0, len(places.position), at_once)
    ]
    return with_caustics(Records.concatenate(*parts), gather.context.caustics)


class Pilot(NamedTuple):
    """What is known of each stratum of each record before refinement."""

    samples: PathSamples  # one per stratum
    bright: mi.Float  # `brightness` of these, of the sky seen by emitter samples, and of paths of `reuse`


@dataclass(frozen=True)
class _Batch:
    """Records that are made together.

    Numbers of strata are opaque: the secondary cache has fewer, and would otherwise need its own kernels.
    """

    gather: Gather
    hemispheres: Hemispheres
    first: int  # number of the first record, among all of one call
    M: mi.UInt32  # strata in elevation
    N: mi.UInt32  # strata in azimuth

    @classmethod
    def begin(cls, gather: Gather, hemispheres: Hemispheres, first: int) -> _Batch:
        """Set up the strata."""
        quality = gather.quality
        strata = (dr.opaque(mi.UInt32, number) for number in (quality.polar_strata, quality.azimuth_strata))
        return cls(gather, hemispheres, first, *strata)

    def paths(
        self, record: mi.UInt32, stratum: mi.UInt32, number: mi.UInt32, index: mi.UInt32, seed: int
    ) -> Paths:
        """Path `number` of each stratum, which is path `index` of its record."""
        lane = (record + dr.opaque(mi.UInt32, self.first)) * (self.M * self.N) + stratum
        place = jittered(lane, number, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))
        dr.eval(place, record, stratum, index)
        return Paths(record, stratum, place, index)

    def trace(self, paths: Paths, seed: int) -> PathSamples:
        """Trace paths."""
        gather = self.gather
        constants = Constants(
            dr.opaque(mi.UInt32, seed & 0xFFFFFFFF),
            dr.opaque(mi.UInt32, self.first),
            dr.opaque(mi.UInt32, MOST_VERTICES if gather.bounces is None else gather.bounces),
            self.M,
            self.N,
            dr.opaque(mi.UInt32, 1),
        )
        return PathSamples(*traced(gather.context, self.hemispheres, paths, constants))


def _gather_batch(gather: Gather, places: Places, first: int, seed: int) -> Records:
    count = len(places.position)
    if count == 1:
        # Dr.Jit compiles other kernels for arrays of one element, so a single record is made twice.
        twice = places.take(np.zeros(2, np.intp))
        return _gather_batch(gather, twice, first, seed).take(np.zeros(1, np.intp))
    p = upload(mi.Point3f, places.position)
    n = upload(mi.Normal3f, places.normal)
    hemispheres = Hemispheres.above(gather.context.lighting.scene, p, n)
    dr.eval(hemispheres)
    batch = _Batch.begin(gather, hemispheres, first)
    origin = hemispheres.origin
    M, N = batch.M, batch.N

    # Pilot samples: one path per stratum.
    record, stratum = split(dr.arange(mi.UInt32, count * gather.quality.strata), M * N)
    # A copy: passing one array twice makes a different kernel of the same code, which takes half a second here.
    index = stratum + dr.opaque(mi.UInt32, 0)
    first_paths = batch.paths(record, stratum, mi.UInt32(0), index, seed)
    samples = batch.trace(first_paths, seed)

    # Refinement samples, grouped by the number of paths.
    strata = gather.quality.polar_strata, gather.quality.azimuth_strata
    sky = sky_in_strata(gather.context.lighting, origin, n, strata, seed, first)
    bright = dr.maximum(mi.luminance(samples.L), 0)
    seen = dr.maximum(bright, sky)
    surfaces = dr.select(dr.isfinite(samples.distance), bright, 0)
    closeness = dr.rcp(samples.distance)
    above = dr.select(samples.tangent < RIM, samples.distance, mi.Float(dr.inf))
    dr.eval(seen, surfaces, closeness, above)
    looks = looks_at_bright(surfaces, samples, first_paths.place, origin, n, (M, N))
    if looks is not None:
        light = batch.trace(Paths(looks.record, looks.stratum, looks.place, looks.number), seed + 2).L
        # The maximum, as for the sky.
        stratum = looks.record * (M * N) + looks.stratum
        dr.scatter_reduce(
            dr.ReduceOp.Max, seen, mi.luminance(light), stratum, looks.possible, mode=dr.ReduceMode.Direct
        )
        dr.eval(seen)
    pilot = Pilot(samples, brightness(seen, M, N))
    faint = dr.opaque(mi.Float, gather.faint)
    error = np.array(error_of_one_path(seen, pilot.bright, count, (M, N), faint))
    error = _shared_error(error, places)
    step = refinement_step(error, _crowded(closeness, above, places.bounds, gather.quality), gather.quality)
    sums: dict[str, Any] = {}
    for number, paths in enumerate(gather.quality.refinement_paths):
        rows = np.flatnonzero(step == number)
        if len(rows):
            # As above: no arrays of one element.
            rows = np.repeat(rows, 2) if len(rows) == 1 else rows
            group = _refine(batch, pilot, rows, paths, seed + 1)
            for name, values in group.items():
                sums.setdefault(name, np.zeros((count, *values.shape[1:]), np.float32))[rows] = values
    surface = np.ascontiguousarray(download(hemispheres.surface), np.float32)
    return _records(places, surface, gather.quality, sums)


def _shared_error(standard_error: Floats, places: Places) -> Floats:
    """The error of each record, or the mean error of compatible neighbours in the same batch if that is larger.

    A record whose pilot samples missed the light that its neighbours saw appears to have no noise. Without more paths,
    it would be a dark spot on the wall.
    """
    near = compatible_neighbours(places.position, places.normal, NEARBY)
    mean = np.sum(standard_error[near.rows] * near.compatible, axis=1) / near.compatible.sum(axis=1)
    return np.maximum(standard_error, mean)


def refinement_step(
    standard_error: Floats, crowded: NDArray[np.bool_], quality: RecordQuality
) -> NDArray[np.intp]:
    """How many refinement paths each record takes, as an index into `quality.refinement_paths`.

    The number that would reduce its standard error to `quality.standard_error`, rounded to the nearest one by ratio. It
    depends only on samples that are not part of the mean. Otherwise, records that found little light would stop early,
    and the cache would be biased dark.

    Args:
        standard_error: (P,) of one path, relative; see `hemisphere.error_of_one_path`.
        crowded: (P,) mask; see `_crowded`.
        quality: of the records.
    """
    wanted = np.square(standard_error / quality.standard_error) * np.where(crowded, CROWDED, 1)
    paths = quality.refinement_paths
    middles = np.sqrt(np.multiply(paths[1:], paths[:-1], dtype=np.float64))
    return np.searchsorted(middles, wanted)


def _crowded(
    closeness: mi.Float, above: mi.Float, bounds: Bounds, quality: RecordQuality
) -> NDArray[np.bool_]:
    """Records that will be held at their smallest radius, as predicted from the pilot samples.

    They are so dense that look-ups average the noise of several: each needs fewer paths.

    Args:
        closeness: Float, 1 / distance of each pilot sample, 1/metres.
        above: Float, distance of those whose hit is above the rim, metres; infinite for the others.
        bounds: of the radius of each record.
        quality: of the records.
    """
    strata = quality.strata
    wanted = np.full(len(bounds.smallest), np.inf)
    if quality.clamped:
        wanted = np.array(dr.block_reduce(dr.ReduceOp.Min, above, strata))
    if quality.radii == "split-sphere":
        sums = np.array(dr.block_reduce(dr.ReduceOp.Add, closeness, strata))
        with np.errstate(divide="ignore"):
            wanted = np.minimum(quality.accuracy * strata / sums, wanted)
    crowded: NDArray[np.bool_] = wanted <= bounds.smallest
    return crowded


def _refine(batch: _Batch, pilot: Pilot, rows: NDArray[np.intp], paths: int, seed: int) -> dict[str, Floats]:
    """Sums over the hemispheres of some records: see `gradients.reduced`, and `hessian` if it determines the radius.

    A record's paths share a low-discrepancy point set for everything after their first hit.

    Args:
        batch: traces paths.
        pilot: samples of all records of the batch.
        rows: G of its records.
        paths: number per record.
        seed: of the paths.

    Returns:
        Arrays of G rows.
    """
    quality, M, N = batch.gather.quality, batch.M, batch.N
    count, strata = len(rows), M * N
    which = upload(mi.UInt32, rows.astype(np.uint32))
    record, stratum = split(dr.arange(mi.UInt32, count * quality.strata), strata)
    source = dr.gather(mi.UInt32, which, record) * strata + stratum
    first = PathSamples(*(dr.gather(type(array), array, source) for array in pilot.samples))
    bright, light = dr.gather(mi.Float, pilot.bright, source), grey(first.L)
    of_pilot = undivided(first)
    dr.eval(*first, bright, light, *of_pilot)
    each = dr.opaque(mi.UInt32, paths)  # one kernel for all numbers of paths
    begin = allocate(bright, count, strata, each)
    dr.eval(begin)

    # Trace: lane = record of the group * paths + path.
    record, path = split(dr.arange(mi.UInt32, count * paths), each)
    stratum = stratum_of(begin, record, path, strata)
    number = path - dr.gather(mi.UInt32, begin, record * strata + stratum)
    some = batch.paths(dr.gather(mi.UInt32, which, record), stratum, number + 1, path, seed)
    more = batch.trace(some, seed)

    seen, halves = combined(first, more, begin, M, N, each)
    # Dr.Jit does not traverse nested named tuples, and would evaluate each of their arrays separately.
    dr.eval(*seen, *seen.parts, *halves, *halves.guides[0], *halves.guides[1])
    normal = dr.gather(mi.Normal3f, batch.hemispheres.normal, which)
    sums = reduced(seen, normal, M, N)
    sums |= _sums_of_guides(seen, halves, normal, batch)
    sums["barrier_0"], sums["barrier_1"] = nearest_barriers(seen.closeness, normal, M, N)
    if quality.radii == "occlusion-hessian":
        # A record's irradiance and its radius must have independent noise; see `_records`.
        seconds = second_derivatives(light, seen.closeness, quality.polar_strata, quality.azimuth_strata)
        sums |= zip(("xx", "xy", "yy"), seconds, strict=True)
        again = reduced(seen._replace(L=first.L, parts=of_pilot), normal, M, N)
        sums |= {f"pilot_{name}": again[name] for name in ("E", "t_r", "t_g", "t_b")}
    dr.eval(sums)
    return {name: np.ascontiguousarray(download(value), np.float32) for name, value in sums.items()}


def _sums_of_guides(seen: Strata, halves: Halves, normal: mi.Normal3f, batch: _Batch) -> dict[str, Any]:
    """Sums over the hemispheres of some records, for their halves and their guides.

    Returns:
        By record: `difference`, sum over the strata; `brightest_0` and `brightest_1`, maximum over the strata; `v_0`
        and `v_1`, variances of the guides' sums; and, prefixed with `guide_`, what `gradients.reduced` returns for the
        two guides (mean of the channels), which take the place of the first two channels.
    """
    one, other = halves.guides
    strata = batch.gather.quality.strata
    none = mi.Float(0)
    parts = seen.parts._replace(
        near_light=mi.Color3f(one.near_light, other.near_light, none),
        far_light=mi.Color3f(one.far_light, other.far_light, none),
    )
    guides = reduced(seen._replace(L=mi.Color3f(one.L, other.L, none), parts=parts), normal, batch.M, batch.N)
    sums = {f"guide_{name}": guides[name] for name in ("E", "t_r", "t_g", "r_r", "r_g")}
    each = {"difference": halves.difference, "v_0": one.variance, "v_1": other.variance}
    sums |= {name: dr.block_reduce(dr.ReduceOp.Add, part, strata) for name, part in each.items()}
    brightest = zip(("brightest_0", "brightest_1"), halves.brightest, strict=True)
    return sums | {name: dr.block_reduce(dr.ReduceOp.Max, part, strata) for name, part in brightest}


def _records(places: Places, surface: Floats, quality: RecordQuality, sums: dict[str, Any]) -> Records:
    """Turn sums into records of one value: scale, choose the radius (see `radius`), limit the gradients to it.

    With the occlusion Hessian, the radius depends on the radiance of the pilot samples alone, which is not part of the
    irradiance. If the same paths determined both, a record made brighter by one bright path would also get a smaller
    radius, and the cache would be biased dark: by 1 % on the floor of a cluttered room. With the split sphere, noise
    hardly affects the radius, and pilot samples have more of it. The bounds of the radius do not depend on the frame.
    """
    strata, bounds = quality.strata, places.bounds
    E = sums["E"] * np.float32(np.pi / strata)
    translation = _along(surface, np.stack([sums["t_r"], sums["t_g"], sums["t_b"]], axis=1))
    rotation = np.stack([sums["r_r"], sums["r_g"], sums["r_b"]], axis=1) * np.float32(np.pi / strata)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = steepness = np.linalg.norm(translation, axis=2).sum(axis=1) / E.sum(axis=1)
        if quality.radii == "occlusion-hessian":
            seen = sums["pilot_E"].sum(axis=1) * np.float32(np.pi / strata)
            gradient = sums["pilot_t_r"] + sums["pilot_t_g"] + sums["pilot_t_b"]
            steepness = np.linalg.norm(_along(surface, gradient[:, None])[:, 0], axis=1) / seen
    extrapolated = extrapolated_radius(sums, bounds.smallest, quality)
    wanted = wanted_radius(extrapolated, steepness, quality)
    limits = bounds.under(sums["headroom"])
    radius = np.clip(wanted, limits.smallest, np.maximum(limits.largest, limits.smallest)).astype(np.float32)
    # Where the radius exceeds the range over which the gradient is valid, by its second-order error, scale it down.
    with np.errstate(divide="ignore", invalid="ignore"):
        good = np.fmin(extrapolated, STEEPEST / own)
    trust = np.clip(good / radius, 0, 1).astype(np.float32)
    translation *= trust[:, None, None]
    # As the normal turns by phi, E loses what a cosine loses and gains what rises over the horizon, L_h: averaged over
    # all axes, E'' = -E + pi L_h.
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = 1 - np.pi * sums["horizon"] / quality.azimuth_strata / E.mean(axis=1)
    curvature = np.clip(np.nan_to_num(curvature), -1, 1)
    standard_error = np.sqrt(sums["variance"]) * (np.pi / strata)
    guide_error = np.sqrt(np.stack([sums["v_0"], sums["v_1"]], axis=1)) * (np.pi / strata)
    brightest = np.stack([sums["brightest_0"], sums["brightest_1"]], axis=1) * (np.pi / strata)
    guide_translation = _along(surface, np.stack([sums["guide_t_r"], sums["guide_t_g"]], axis=1))
    guide_translation *= trust[:, None, None]
    guide_rotation = np.stack([sums["guide_r_r"], sums["guide_r_g"]], axis=1) * np.float32(np.pi / strata)

    barriers = np.stack([sums["barrier_0"], sums["barrier_1"]], axis=1)

    def one_value(array: NDArray[Any]) -> Floats:
        return np.ascontiguousarray(array[:, None], np.float32)

    return Records(
        position=np.ascontiguousarray(places.position, np.float32),
        normal=np.ascontiguousarray(places.normal, np.float32),
        surface=surface,
        irradiance=one_value(E),
        translation=one_value(translation),
        rotation=one_value(rotation),
        curvature=one_value(curvature),
        radius=np.ascontiguousarray(radius, np.float32),
        standard_error=one_value(standard_error),
        headroom=np.ascontiguousarray(sums["headroom"], np.float32),
        barriers=np.ascontiguousarray(_along(surface, barriers), np.float32),
        difference=one_value(sums["difference"] * np.float32(np.pi / strata)),
        brightest=one_value(brightest),
        guide=one_value(sums["guide_E"][:, :2] * np.float32(np.pi / strata)),
        guide_error=one_value(guide_error),
        guide_translation=one_value(guide_translation),
        guide_rotation=one_value(guide_rotation),
    )


def _along(surface: Floats, gradient: Floats) -> Floats:
    """The part of (R, C, 3) gradients that lies within (R, 3) surfaces, along which points move."""
    across = np.einsum("rcx,rx->rc", gradient, surface)
    return gradient - across[..., None] * surface[:, None]
