"""Radiance along the paths of a gather: a path tracer that ends in the secondary cache where it can."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import OTHER_FLAGS, BSDFTraits, DiffuseLobe
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.panes import MOST_PANES
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Lighting,
    Met,
    Receiver,
    all_lobes,
    emission,
    emitter_samples,
    look_beyond,
)
from steadylight.renderers.mitsuba.records.lookup import DeviceAnswer, DeviceCache
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, VertexSamples

MOST_VERTICES = 128
"""Vertices of a path without a number of bounces; Russian roulette ends nearly all long before."""

ROULETTE_FROM = 4
"""Vertices before Russian roulette begins: by then a path has left what its record sees of direct light, and what the
secondary cache could not answer."""

ENDING = 0.5
"""Probability that a path ends at a surface of which the secondary cache knows only the diffuse lobe."""

SURVIVAL = 0.95
"""Greatest probability of survival, so that paths between perfect mirrors end."""


class NoIndirectLight:
    """Answers black everywhere: paths then bring back the light of one diffuse bounce, by any number of others."""

    def look_up_near(
        self,
        position: mi.Point3f,
        normal: mi.Normal3f,
        active: mi.Bool,
        facing: mi.Normal3f | None = None,
    ) -> DeviceAnswer:
        """Black."""
        del position, normal, active, facing
        return DeviceAnswer(mi.Color3f(0), mi.Float(1), mi.UInt32(NO_ROW))

    def radius_of(self, row: mi.UInt32) -> mi.Float:
        """No surface is too near."""
        del row
        return mi.Float(0)

    def arrays(self) -> list[Any]:
        """Nothing, but not the same as no cache."""
        return [mi.Float(0)]


Secondary = DeviceCache | NoIndirectLight
"""What a path asks at the surfaces that it meets."""


class PathEnd(NamedTuple):
    """Where paths end that look for a surface of which the secondary cache knows.

    Attributes:
        position: world, metres.
        normal: unit, on the lit side.
        throughput: of the path, with the albedo of the surface; times its irradiance, a path's share of that at the
            beginning. 0 where the path found none.
    """

    position: mi.Point3f
    normal: mi.Normal3f
    throughput: mi.Color3f


@dataclass
class _Passage:
    """What a path knows of the panes that it has gone straight through: variables of the loop.

    Attributes:
        panes: how many.
        distance: from the start of the path to the last one before the first hit, metres.
        looked: whether it has met nothing else since a ray looked for emitters behind them.
    """

    panes: mi.UInt32
    distance: mi.Float
    looked: mi.Bool

    @classmethod
    def begin(cls) -> _Passage:
        """None yet."""
        return cls(mi.UInt32(0), mi.Float(0), mi.Bool(False))


@dr.syntax
def indirect_radiance(
    lighting: Lighting,
    samples: Samples,
    ray: mi.Ray3f,
    bounces: mi.UInt32 | None,
    secondary: Secondary | None,
) -> tuple[mi.Color3f, mi.Float]:
    """Radiance that arrives along a ray from surfaces and from the cached part of the environment.

    What the first surface hit emits, and the rest of the environment, is direct light and is left to the second pass.
    Where the secondary cache knows the indirect light of a surface, it answers for the diffuse lobe. The path goes on
    with what the other lobes scatter; its next ray still looks for emitters for all of them, since next to a lamp,
    emitter samples alone have no finite variance.

    Panes that the ray goes straight through are no surfaces: neither for that, nor among the bounces, nor for the
    distance. What they transmit and what they reflect lies behind them, or as far before: a record on a window sill
    does not change with its distance from the glass. Where a mask scatters, it is a surface.

    Args:
        lighting: of the scene.
        samples: random numbers of the paths.
        ray: from the record.
        bounces: scattering events, the first hit included; None for all.
        secondary: indirect irradiance, asked at first hits, or at all where `bounces` is None; None to trace all.

    Returns:
        Radiance, W/(m² sr), and distance to the first hit, metres, infinite if there is none.
    """
    environment, emitters, bsdfs = lighting.environment, lighting.emitters, lighting.bsdfs
    endless = bounces is None
    last = mi.UInt32(MOST_VERTICES) if bounces is None else bounces
    # ---- variables of the loop -----------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)  # radiance so far
    throughput = mi.Color3f(1)  # of the lobes for which the secondary cache does not answer
    whole = mi.Color3f(1)  # of all lobes: for emission at the next hit
    depth = mi.UInt32(0)  # surfaces met so far, without panes gone straight through
    distance = mi.Float(dr.inf)  # to the first hit
    passage = _Passage.begin() if lighting.panes.some else None
    known = mi.Bool(False)  # the secondary cache answered at the last surface
    departure = Departure.nowhere()
    active = mi.Bool(True)

    while active:
        si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        looks = _unseen(passage, (depth == 0) | ~departure.delta)
        met = look_beyond(lighting, si, ray, looks, active)
        distance = dr.select(depth == 0, _first_distance(passage, si, met, distance), distance)

        # Add what an emitter hit by BSDF sampling gives: from the record itself only the cached part of the environment
        # counts; where the secondary cache answered, it answered for that part in the diffuse lobe.
        counts = _unseen(passage, active & ((depth > 0) | ~met.si.is_valid()))
        found = emission(lighting, met, departure, counts)
        held = found.radiance * found.cached
        given = whole * found.radiance * found.mis
        given = dr.select(known, throughput * held + whole * (found.radiance - held) * found.mis, given)
        given = dr.select(depth == 0, throughput * held, given)
        L = dr.select(found.active, L + given, L)

        # Stop after the last bounce, or by Russian roulette.
        numbers = samples.at(mi.UInt32(0), depth if passage is None else depth + passage.panes)
        active &= si.is_valid() & (depth < last) & dr.any(throughput != 0)
        if dr.hint(endless, mode="scalar"):
            survival = dr.minimum(dr.max(dr.abs(throughput)), SURVIVAL)
            survival = dr.select(depth < ROULETTE_FROM, 1, survival)
            active &= numbers.sample_1d(Purpose.ROULETTE) < survival
            throughput = dr.select(active, throughput / survival, throughput)

        # Ask the secondary cache for the diffuse lobe.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        alone = (flags & OTHER_FLAGS) == 0
        lobe = bsdfs.diffuse_lobe(si, bsdf, numbers, active)
        known = mi.Bool(False)
        if dr.hint(secondary is not None, mode="scalar"):
            # Only records within their own radius: in the dark corners where none is, those from further off would be
            # far too bright. And not from beside it: there the light changes faster than records so coarse can tell.
            asks = lobe.active & ((depth == 0) | endless)
            away = dr.select(depth == 0, distance, si.t)
            look = secondary.look_up_near(si.p, lobe.normal, asks, lobe.facing)
            known = asks & (look.weight >= ANSWERED) & (away > secondary.radius_of(look.row))
            L = dr.select(known, L + throughput * lobe.albedo * look.irradiance * dr.inv_pi, L)

        # Sample emitters.
        smooth = active & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        row = emitters.row_at(si, known, smooth)
        count = dr.select(depth == 0, mi.UInt32(lighting.emitter_samples), 1)
        emitters_only = known & alone & mi.Bool(environment.only_emitter)
        receiver = Receiver(si, row, count, emitters_only, known)

        sample = numbers.sample_2d(Purpose.EMITTER)
        L += throughput * emitter_samples(lighting, receiver, all_lobes(bsdf, si), sample, smooth)

        # Go on in a direction of the BSDF's choice: emission counts for all lobes, everything else for those for which
        # the secondary cache did not answer.
        bs, weight = _direction(bsdfs, si, bsdf, lobe, numbers, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        whole = throughput * weight
        if dr.hint(secondary is not None, mode="scalar"):
            weight = dr.select(known & ~delta, _by_others(bsdfs, si, bsdf, lobe, bs, known & ~delta), weight)
        throughput = throughput * weight
        depth += _surfaces(passage, si, met, lighting.panes.transmits(bs), (depth == 0) | ~departure.delta)
        departure = Departure(si, row, bs.pdf, delta, mi.Float(count))
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(whole != 0) & ~emitters_only
        active &= True if passage is None else passage.panes < MOST_PANES
    return L, distance


@dr.syntax
def path_end(lighting: Lighting, samples: Samples, ray: mi.Ray3f, secondary: DeviceCache) -> PathEnd:
    """Follow paths to the first surface whose diffuse lobe the secondary cache knows, by records further off too.

    At a surface that has other lobes besides, chance decides whether the path ends there or goes on by these.

    Args:
        lighting: of the scene; its emitters are not asked for.
        samples: random numbers of the paths.
        ray: with which they begin.
        secondary: is asked.
    """
    bsdfs = lighting.bsdfs
    # ---- variables of the loop -----------------------------------------------------------
    ray = mi.Ray3f(ray)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(0)  # surfaces met so far
    end = mi.Color3f(0)  # throughput where the path ended
    position, normal = mi.Point3f(0), mi.Normal3f(0, 0, 1)
    active = mi.Bool(True)

    while active:
        si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        active &= si.is_valid() & (depth < MOST_VERTICES)
        numbers = samples.at(mi.UInt32(0), depth)
        survival = dr.select(depth < ROULETTE_FROM, 1, dr.minimum(dr.max(dr.abs(throughput)), SURVIVAL))
        active &= numbers.sample_1d(Purpose.ROULETTE) < survival
        throughput = dr.select(active, throughput / survival, throughput)

        # End here, if the cache knows the surface.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        lobe = bsdfs.diffuse_lobe(si, bsdf, numbers, active)
        look = secondary.look_up(si.p, lobe.normal, lobe.active)
        known = lobe.active & (look.row != NO_ROW)
        alone = (flags & OTHER_FLAGS) == 0
        ends = known & (alone | (numbers.sample_1d(Purpose.MASK) < ENDING))
        end = dr.select(ends, throughput * lobe.albedo / dr.select(alone, mi.Float(1), ENDING), end)
        position, normal = dr.select(ends, si.p, position), dr.select(ends, lobe.normal, normal)
        active &= ~ends

        # Go on by the lobes that are left.
        bs, weight = _direction(bsdfs, si, bsdf, lobe, numbers, active)
        others = active & known & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        weight = dr.select(others, _by_others(bsdfs, si, bsdf, lobe, bs, others), weight)
        throughput = throughput * dr.select(known, weight / (1 - ENDING), weight)
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(throughput != 0)
        depth += 1
    return PathEnd(position, normal, end)


def _direction(
    bsdfs: BSDFTraits,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    lobe: DiffuseLobe,
    numbers: VertexSamples,
    active: mi.Bool,
) -> tuple[mi.BSDFSample3f, mi.Color3f]:
    """A direction of the BSDF's choice, and its weight; where all BSDFs are diffuse, that which drew the albedo."""
    if bsdfs.only_diffuse and bsdfs.uneven is None:
        return lobe.sample, lobe.albedo
    choice, direction = numbers.sample_1d(Purpose.LOBE), numbers.sample_2d(Purpose.DIRECTION)
    sample, weight = bsdf.sample(mi.BSDFContext(), si, choice, direction, active)
    return sample, bsdfs.finite(weight)


def _by_others(
    bsdfs: BSDFTraits,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    lobe: DiffuseLobe,
    sample: mi.BSDFSample3f,
    active: mi.Bool,
) -> mi.Color3f:
    """The part of a sample's weight that is due to other lobes than the diffuse one; 0 where not active."""
    if bsdfs.only_diffuse:
        return mi.Color3f(0)
    value = bsdfs.other_lobes(si, bsdf, sample.wo, lobe, active)
    return dr.select(active, value / dr.maximum(sample.pdf, 1e-12), 0)


def _unseen(passage: _Passage | None, lanes: mi.Bool) -> mi.Bool:
    """Lanes of which no ray has looked for emitters behind what this one meets."""
    return lanes if passage is None else lanes & ~passage.looked


def _first_distance(
    passage: _Passage | None, si: mi.SurfaceInteraction3f, met: Met, distance: mi.Float
) -> mi.Float:
    """Distance to the first hit, metres, where only panes have been met before.

    Args:
        passage: through these.
        si: what is met now.
        met: what is behind it.
        distance: as far as it is known.
    """
    if passage is None:
        return si.t
    scatters = ~met.pane | mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
    clear = dr.select(passage.looked, distance, met.distance)
    return dr.select(scatters, passage.distance + si.t, clear)


def _surfaces(
    passage: _Passage | None, si: mi.SurfaceInteraction3f, met: Met, transmits: mi.Bool, looks: mi.Bool
) -> mi.UInt32:
    """How many surfaces count for the path that leaves one: 0 where it goes straight through a pane, else 1.

    Args:
        passage: of the path; is brought up to date.
        si: the surface.
        met: what is behind it.
        transmits: whether the path leaves it by transmission, as light through a pane does.
        looks: lanes of which a ray looked for emitters behind it, or behind a pane before.
    """
    if passage is None:
        return mi.UInt32(1)
    straight = met.pane & transmits
    passage.looked = straight & (passage.looked | looks)
    passage.distance = passage.distance + dr.select(straight, si.t, 0)
    passage.panes = passage.panes + dr.select(straight, mi.UInt32(1), 0)
    return dr.select(straight, mi.UInt32(0), 1)
