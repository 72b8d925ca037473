"""First-pass work: sample the hemisphere over surface points and make irradiance records of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import mitsuba as mi
from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.lookup import ANSWERED
from steadylight.cache.records import Floats, Records
from steadylight.renderers.mitsuba.bsdf.lobes import OTHER_FLAGS
from steadylight.renderers.mitsuba.light.emitters import GridEmitterSampling
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE, RECORDINGS
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.hemisphere import (
    RIM,
    PathSamples,
    allocate,
    angles,
    brightness,
    combined,
    direction,
    error_of_one_path,
    jittered,
    reduced,
    stratum_of,
)
from steadylight.renderers.mitsuba.records.hessian import second_derivatives
from steadylight.renderers.mitsuba.records.lookup import NO_RECORD, DeviceCache
from steadylight.renderers.mitsuba.records.radius import Bounds, wanted_radius
from steadylight.renderers.mitsuba.upload import upload

EMITTER_SAMPLES = 2
"""Emitter samples at the first hit of a path."""

GOLDEN = 0.6180339887
"""Fraction of a golden section: steps of the second coordinate of emitter samples."""

CROWDED = 0.5
"""Part of its paths that a record takes when it is held at its smallest radius: its neighbours share their noise."""

NEARBY = 8
"""Records whose noise is compared: so many of the nearest, itself included."""


class GatherContext(NamedTuple):
    """What makes the gather quieter without changing what it measures."""

    environment: Environment  # divides the surroundings into cached and direct light
    emitters: GridEmitterSampling | None = None  # chooses emitters at the hits; as Mitsuba does if None
    secondary: DeviceCache | None = None

    def arrays(self) -> list[Any]:
        """All that a kernel reads through these, for `drjit.freeze`."""
        emitters = [] if self.emitters is None else self.emitters.arrays()
        return [
            self.environment.arrays(),
            emitters,
            [] if self.secondary is None else self.secondary.arrays(),
        ]


@dataclass(frozen=True)
class Gather:
    """How records are made.

    Attributes:
        scene: where.
        quality: strata, paths, and what the radius goes by.
        bounces: indirect diffuse bounces; at least 1 (0 gives black records).
        context: what makes it quieter.
    """

    scene: mi.Scene
    quality: RecordQuality
    bounces: int
    context: GatherContext


class Places(NamedTuple):
    """Where records are made."""

    position: Floats  # (P, 3) surface points, metres
    normal: Floats  # (P, 3) unit, on the lit side
    bounds: Bounds  # of the radius

    def take(self, rows: NDArray[Any] | slice) -> Places:
        """Those at `rows`."""
        limits = Bounds(self.bounds.smallest[rows], self.bounds.largest[rows])
        return Places(self.position[rows], self.normal[rows], limits)


def gather_records(gather: Gather, places: Places, seed: int) -> Records:
    """Make one record at each place.

    Ward, Rubinstein & Clear 1988 (doi:10.1145/54852.378490) for the record, Ward & Heckbert 1992 for the strata
    and gradients; `hemisphere` tells how the paths are divided.

    Args:
        gather: how.
        places: where.
        seed: decides all random numbers together with the order of the places.

    Returns:
        A record for each place, in the same order.
    """
    at_once = max(1, PATHS_AT_ONCE // gather.quality.refinement_paths[-1])
    parts = [
        _gather_batch(gather, places.take(slice(begin, begin + at_once)), seed + 0x9E3779B9 * begin)
        for begin in range(0, len(places.position), at_once)
    ]
    return Records.concatenate(*parts)


@dataclass  # not a named tuple, through which Dr.Jit does not look; nor frozen, since it writes fields back
class Hemispheres:
    """Where paths start, by record."""

    origin: mi.Point3f  # just off the surface
    normal: mi.Normal3f


@dataclass
class Paths:
    """Which paths are traced, one lane a path."""

    record: mi.UInt32
    stratum: mi.UInt32
    number: mi.UInt32  # which path of the stratum


@dataclass
class _Constants:
    """What is the same for all paths that are traced together."""

    seed: mi.UInt32  # opaque
    bounces: (
        mi.UInt32
    )  # opaque; as a constant, each level of the secondary cache would compile kernels of its own
    polar_strata: int
    azimuth_strata: int
    # The sampler's sample count and the number of the scene (see `Environment`). Mitsuba compiles constants of both
    # into the kernel unseen by Dr.Jit, so that these must tell recordings apart.
    identity: tuple[int, int]


class Pilot(NamedTuple):
    """What the pilot samples saw, one in each stratum of each record."""

    samples: PathSamples
    bright: mi.Float  # `brightness` of them


@dataclass(frozen=True)
class _Batch:
    """Records that are made together."""

    gather: Gather
    hemispheres: Hemispheres

    def trace(self, paths: Paths, sampler: mi.Sampler, seed: int) -> PathSamples:
        """Trace paths with random numbers from `sampler`, which is seeded here."""
        gather = self.gather

        def once() -> PathSamples:
            opaque = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
            sampler.seed(opaque, dr.width(paths.record))
            constants = _Constants(
                opaque,
                dr.opaque(mi.UInt32, gather.bounces),
                gather.quality.polar_strata,
                gather.quality.azimuth_strata,
                (sampler.sample_count(), gather.context.environment.scene_number),
            )
            return PathSamples(
                *_frozen_paths(gather.scene, sampler, gather.context, self.hemispheres, paths, constants)
            )

        try:
            return once()
        except RuntimeError:
            # A recording does not outlive a change of what Mitsuba has loaded, for this scene or another.
            _frozen_paths.clear()
            return once()


def _gather_batch(gather: Gather, places: Places, seed: int) -> Records:
    count, strata = len(places.position), gather.quality.strata
    p = upload(mi.Point3f, places.position)
    n = upload(mi.Normal3f, places.normal)
    # Rays start just off the surface, as far as Mitsuba's own; the record itself stays on it.
    far = dr.maximum(dr.abs(p.x), dr.maximum(dr.abs(p.y), dr.abs(p.z)))
    origin = mi.Point3f(p + mi.Vector3f(n) * ((1 + far) * mi.math.RayEpsilon))
    dr.eval(origin)
    batch = _Batch(gather, Hemispheres(origin, n))

    # Pilot samples: a path in each stratum.
    lane = dr.arange(mi.UInt32, count * strata)
    record = lane // strata
    sampler = mi.load_dict({"type": "independent"})
    samples = batch.trace(Paths(record, lane - record * strata, mi.UInt32(0)), sampler, seed)

    # Refinement samples, in groups by the number of paths.
    M, N = gather.quality.polar_strata, gather.quality.azimuth_strata
    pilot = Pilot(samples, brightness(samples.L, count, M, N))
    error = _shared_error(np.array(error_of_one_path(samples.L, pilot.bright, count, M, N)), places)
    step = refinement_step(error, _crowded(samples, places.bounds, gather.quality), gather.quality)
    sums: dict[str, Any] = {}
    for number, paths in enumerate(gather.quality.refinement_paths):
        rows = np.flatnonzero(step == number)
        if len(rows):
            group = _refine(batch, pilot, rows, paths, seed + 1)
            for name, values in group.items():
                sums.setdefault(name, np.zeros((count, *values.shape[1:]), np.float32))[rows] = values
    return _records(places, gather.quality, sums)


def _trace_paths(
    scene: mi.Scene,
    sampler: mi.Sampler,
    context: GatherContext,
    hemispheres: Hemispheres,
    paths: Paths,
    constants: _Constants,
) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """What paths see, as the fields of `PathSamples`.

    Called through `_frozen_paths`: after the first call with arguments of these kinds the kernel runs without this
    being traced again, which took longer than the kernel where there are few records or many cores.

    Args:
        scene: where.
        sampler: seeded for as many lanes as there are paths.
        context: of the gather.
        hemispheres: of the records.
        paths: which.
        constants: the same for all.
    """
    M, N = constants.polar_strata, constants.azimuth_strata
    place = jittered(paths.record * (M * N) + paths.stratum, paths.number, constants.seed)
    cos_theta, sin_theta, phi = angles(paths.stratum, place, M, N)
    frame = mi.Frame3f(dr.gather(mi.Normal3f, hemispheres.normal, paths.record))
    d = frame.to_world(direction(cos_theta, sin_theta, phi))
    ray = mi.Ray3f(dr.gather(mi.Point3f, hemispheres.origin, paths.record), d)
    # A copy: what a frozen function leaves in its arguments is evaluated after it, by a kernel that traced all again.
    L, distance = indirect_radiance(scene, sampler.clone(), ray, constants.bounces, context)
    # One path that hit a singularity must not end an animation.
    L = dr.select(dr.all(dr.isfinite(L)), L, 0)
    tangent = sin_theta / dr.maximum(cos_theta, 1e-4)
    dr.eval(L, distance, tangent)
    return L, distance, tangent


_frozen_paths: Any = dr.freeze(
    _trace_paths, state_fn=lambda *call: call[2].arrays(), limit=RECORDINGS, warn_after=1 << 30
)


def _shared_error(standard_error: Floats, places: Places) -> Floats:
    """The error of each record, no less than the mean among compatible records that are begun with it and stand nearby.

    A record whose pilot samples missed the light that the others saw believes itself quiet; without more paths it would
    be a dark spot on the wall.
    """
    near = compatible_neighbours(places.position, places.normal, NEARBY)
    mean = np.sum(standard_error[near.rows] * near.compatible, axis=1) / near.compatible.sum(axis=1)
    return np.maximum(standard_error, mean)


def refinement_step(
    standard_error: Floats, crowded: NDArray[np.bool_], quality: RecordQuality
) -> NDArray[np.intp]:
    """How many refinement paths each record takes: which of `quality.refinement_paths`.

    As many as bring its standard error down to `quality.standard_error`: to the nearest of the numbers, by ratio. What
    the pilot samples saw decides, and hardly counts in the mean: records that found little light would otherwise stop
    early, and the cache would be too dark.

    Args:
        standard_error: (P,) of one path, relative; see `hemisphere.error_of_one_path`.
        crowded: (P,) mask; see `_crowded`.
        quality: of the records.
    """
    wanted = np.square(standard_error / quality.standard_error) * np.where(crowded, CROWDED, 1)
    paths = quality.refinement_paths
    middles = np.sqrt(np.multiply(paths[1:], paths[:-1], dtype=np.float64))
    return np.searchsorted(middles, wanted)


def _crowded(pilot: PathSamples, bounds: Bounds, quality: RecordQuality) -> NDArray[np.bool_]:
    """Which records will be held at their smallest radius, as far as the pilot samples can tell.

    They stand in a crowd whose members share their noise: each needs fewer paths.
    """
    strata = quality.strata
    closeness = dr.block_reduce(dr.ReduceOp.Add, dr.rcp(pilot.distance), strata)
    above = dr.select(pilot.tangent < RIM, pilot.distance, mi.Float(dr.inf))
    nearest = dr.block_reduce(dr.ReduceOp.Min, above, strata)
    dr.eval(closeness, nearest)
    wanted = np.array(nearest) if quality.clamped else np.full(len(bounds.smallest), np.inf)
    if quality.radii == "split-sphere":
        with np.errstate(divide="ignore"):
            wanted = np.minimum(quality.accuracy * strata / np.array(closeness), wanted)
    crowded: NDArray[np.bool_] = wanted <= bounds.smallest
    return crowded


def _refine(batch: _Batch, pilot: Pilot, rows: NDArray[np.intp], paths: int, seed: int) -> dict[str, Floats]:
    """Sums over the hemispheres of some records: see `hemisphere.reduced`, and `hessian` if their radius goes by it.

    A record's paths share a low-discrepancy point set for what follows their first hit.

    Args:
        batch: traces paths.
        pilot: samples of all records of the batch.
        rows: G of its records.
        paths: of each record.
        seed: of the paths.

    Returns:
        Arrays of G rows.
    """
    quality = batch.gather.quality
    M, N = quality.polar_strata, quality.azimuth_strata
    count, strata = len(rows), M * N
    which = upload(mi.UInt32, rows.astype(np.uint32))
    lane = dr.arange(mi.UInt32, count * strata)
    record = lane // strata
    source = dr.gather(mi.UInt32, which, record) * strata + (lane - record * strata)
    first = PathSamples(*(dr.gather(type(array), array, source) for array in pilot.samples))
    bright = dr.gather(mi.Float, pilot.bright, source)
    dr.eval(*first, bright)
    begin = allocate(bright, count, strata, paths)
    dr.eval(begin)

    # Trace: lane = record of the group * paths + path.
    lane = dr.arange(mi.UInt32, count * paths)
    record = lane // paths
    path = lane - record * paths
    stratum = stratum_of(begin, record, path, strata)
    number = path - dr.gather(mi.UInt32, begin, record * strata + stratum)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": paths})
    sampler.set_samples_per_wavefront(paths)
    more = batch.trace(Paths(dr.gather(mi.UInt32, which, record), stratum, number + 1), sampler, seed)

    seen = combined(first, more, begin, strata, paths)
    dr.eval(*seen)
    sums = reduced(seen, dr.gather(mi.Normal3f, batch.hemispheres.normal, which), M, N)
    if quality.radii == "occlusion-hessian":
        sums |= zip(("xx", "xy", "yy"), second_derivatives(seen, M, N), strict=True)
    dr.eval(sums)
    return {name: np.ascontiguousarray(np.array(value).T, np.float32) for name, value in sums.items()}


@dr.syntax
def indirect_radiance(scene: Any, sampler: Any, ray: Any, bounces: Any, context: GatherContext) -> Any:
    """Radiance that arrives along a ray from surfaces and soft sky, without what the first surface hit emits.

    A path tracer with emitter and BSDF sampling and multiple importance sampling (Veach 1997, power heuristic). What
    the first hit emits, and the bright part of the surroundings, is direct light and is left to the second pass.
    Where the first hit is diffuse and the secondary cache knows its indirect light, the path ends there; it is
    followed one ray further only for emitters that BSDF sampling finds, if there are any (`Sky.alone`): next to a lamp,
    emitter samples alone have no finite variance.

    Args:
        scene: mi.Scene.
        sampler: a seeded wavefront sampler.
        ray: Ray3f.
        bounces: UInt32 or int, scattering events, the first hit included.
        context: sky, emitter choice and secondary cache.

    Returns:
        radiance (Color3f) and distance to the first hit (Float, infinite if there is none).
    """
    ctx = mi.BSDFContext()
    environment, emitters, secondary = context
    # ---- loop state ----------------------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)  # radiance so far
    beta = mi.Color3f(1)  # path throughput
    depth = mi.UInt32(0)  # surfaces met so far
    distance = mi.Float(dr.inf)  # to the first hit
    known = mi.Bool(False)  # the secondary cache spoke at the last surface: only hard emission is left
    prev_si = dr.zeros(mi.SurfaceInteraction3f)  # where the current ray starts
    prev_row = mi.UInt32(NO_RECORD)  # what `lights` knows there
    prev_pdf = mi.Float(1)  # density of its direction
    prev_delta = mi.Bool(True)  # ... unless it was the only one possible
    active = mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        distance = dr.select(depth == 0, si.t, distance)

        # Add what an emitter hit by BSDF sampling gives, weighted against emitter sampling.
        emitter = si.emitter(scene)
        lit = active & (emitter != None)  # noqa: E711 - element-wise
        Le = emitter.eval(si, lit)
        if dr.hint(environment.exists, mode="scalar"):
            # From the surface itself only the soft part of the surroundings counts; where the secondary cache
            # spoke, only the rest.
            soft = dr.select(si.is_valid(), 0, environment.cached_fraction(Le))
            Le = dr.select(depth == 0, Le * soft, dr.select(known, Le * (1 - soft), Le))
            lit &= (depth > 0) | ~si.is_valid()
        else:
            lit &= depth > 0
        ds = mi.DirectionSample3f(scene, si, prev_si)
        if dr.hint(emitters is None, mode="scalar"):
            pdf_em = scene.pdf_emitter_direction(prev_si, ds, lit & ~prev_delta)
        else:
            pdf_em = emitters.pdf(prev_si, ds, emitter, prev_row, lit & ~prev_delta)
        pdf_em *= dr.select(depth == 1, mi.Float(EMITTER_SAMPLES), 1)
        L = dr.select(lit, L + beta * Le * mis_weight(prev_pdf, pdf_em), L)

        # Stop after the last bounce.
        active &= si.is_valid() & (depth < bounces) & ~known

        # Ask the secondary cache at a first hit that is diffuse and nothing else.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        E = mi.Color3f(0)
        if dr.hint(secondary is not None, mode="scalar"):
            asks = active & (depth == 0) & ((flags & OTHER_FLAGS) == 0)
            n = mi.Normal3f(si.sh_frame.n * dr.select(si.wi.z < 0, mi.Float(-1), mi.Float(1)))
            # Only records within their own radius: in the dark corners where none is, those from further off would be
            # far too bright. And not from beside it: there the light changes faster than records so coarse can tell.
            look = secondary.look_up_near(si.p, n, asks)
            radius = dr.rcp(dr.gather(mi.Float, secondary.decide, 8 * look.row + 3, look.row != NO_RECORD))
            known = asks & (look.weight >= ANSWERED) & (si.t > radius)
            E = dr.select(known, look.irradiance, 0)

        # Sample emitters, at the first hit in strata of one 2D sample.
        smooth = active & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        row = mi.UInt32(NO_RECORD)
        if dr.hint(emitters is not None, mode="scalar"):
            row = emitters.row_at(si, smooth)
        sample_em = sampler.next_2d(smooth)
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        samples = dr.select(depth == 0, mi.UInt32(EMITTER_SAMPLES), 1)
        per_sample = dr.rcp(mi.Float(samples))
        k = mi.UInt32(0)
        while smooth & (k < samples):
            stratum = emitter_stratum(sample_em, k, per_sample)
            if dr.hint(emitters is None, mode="scalar"):
                ds, em_weight = scene.sample_emitter_direction(si, stratum, True, smooth)
                em_radiance = em_weight * ds.pdf
            else:
                ds, em_weight, em_radiance = emitters.sample(si, stratum, row, smooth)
            if dr.hint(environment.exists, mode="scalar"):
                soft = dr.select(
                    known & ds.emitter.is_environment(), environment.cached_fraction(em_radiance), 0
                )
                em_weight *= 1 - soft
            value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
            alone = known if environment.only_emitter else mi.Bool(False)
            mis_em = dr.select(ds.delta | alone, 1, mis_weight(ds.pdf * mi.Float(samples), pdf))
            L = dr.select(ds.pdf > 0, L + beta * value * em_weight * (mis_em * per_sample), L)
            k += 1
        L = dr.select(known, L + beta * weight * E * dr.inv_pi, L)

        # Go on in a direction of the BSDF's choice.
        beta *= weight
        prev_si = si
        prev_row = row
        prev_pdf = bs.pdf
        prev_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(beta != 0)
        if dr.hint(environment.only_emitter, mode="scalar"):
            active &= ~known
        depth += 1
    return L, distance


def emitter_stratum(sample: Any, k: Any, per_sample: Any) -> Any:
    """The k-th of several emitter samples made from one: strata in x, golden-section steps in y.

    Args:
        sample: Point2f in [0, 1)².
        k: UInt32, from 0.
        per_sample: Float, one over their number.
    """
    y = sample.y + GOLDEN * mi.Float(k)
    return mi.Point2f((sample.x + mi.Float(k)) * per_sample, y - dr.floor(y))


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Power heuristic: weight of a sample drawn with density `pdf_a` that could have come from b."""
    a2 = dr.square(pdf_a)
    weight = a2 / (a2 + dr.square(pdf_b))
    # Zero over zero, and infinity over infinity where a path lands on the emitter that it samples.
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))


def _records(places: Places, quality: RecordQuality, sums: dict[str, Any]) -> Records:
    """Turn sums into records of one value: scale, then choose the radius (see `radius`) and keep gradients within it.

    The radius stays within bounds that do not depend on the frame.
    """
    strata, bounds = quality.strata, places.bounds
    E = sums["E"] * np.float32(np.pi / strata)
    translation = np.stack([sums["t_r"], sums["t_g"], sums["t_b"]], axis=1)
    rotation = np.stack([sums["r_r"], sums["r_g"], sums["r_b"]], axis=1) * np.float32(np.pi / strata)
    with np.errstate(divide="ignore", invalid="ignore"):
        steepness = np.linalg.norm(translation, axis=2).sum(axis=1) / E.sum(axis=1)
    wanted = wanted_radius(sums, steepness, bounds.smallest, quality)
    radius = np.clip(wanted, bounds.smallest, np.maximum(bounds.largest, bounds.smallest)).astype(np.float32)
    # Where the lower bound made the radius longer than the gradient is good for, flatten the gradient.
    trust = np.minimum(1, wanted / radius).astype(np.float32)
    translation *= trust[:, None, None]
    # Turning by phi, E loses what a cosine loses and gains what rises over the horizon, L_h: averaged over all ways to
    # turn, E'' = -E + pi L_h.
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = 1 - np.pi * sums["horizon"] / quality.azimuth_strata / E.mean(axis=1)
    curvature = np.clip(np.nan_to_num(curvature), -1, 1)
    standard_error = np.sqrt(sums["variance"]) * (np.pi / strata)

    def one_value(array: NDArray[Any]) -> Floats:
        return np.ascontiguousarray(array[:, None], np.float32)

    return Records(
        position=np.ascontiguousarray(places.position, np.float32),
        normal=np.ascontiguousarray(places.normal, np.float32),
        irradiance=one_value(E),
        translation=one_value(translation),
        rotation=one_value(rotation),
        curvature=one_value(curvature),
        radius=np.ascontiguousarray(radius, np.float32),
        standard_error=one_value(standard_error),
    )
