"""Radiance along the paths of a gather: a path tracer that ends in the secondary cache where it can."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import OTHER_FLAGS
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
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Purpose, Samples


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
    lighting: Lighting, samples: Samples, ray: mi.Ray3f, bounces: mi.UInt32, secondary: DeviceCache | None
) -> tuple[mi.Color3f, mi.Float]:
    """Radiance that arrives along a ray from surfaces and from the cached part of the environment.

    What the first surface hit emits, and the rest of the environment, is direct light and is left to the second pass.
    Panes that the ray goes straight through are no surfaces: neither for that, nor among the bounces, nor for the
    distance. What they transmit and what they reflect lies behind them, or as far before: a record on a window sill
    does not change with its distance from the glass. Where a mask scatters, it is a surface.

    Where the first hit is diffuse and the secondary cache knows its indirect light, the path ends there; it is
    followed one ray further only for emitters that BSDF sampling finds, if there are any: next to a lamp, emitter
    samples alone have no finite variance.

    Args:
        lighting: of the scene.
        samples: random numbers of the paths.
        ray: from the record.
        bounces: scattering events, the first hit included.
        secondary: indirect irradiance at first hits; None to trace all.

    Returns:
        Radiance, W/(m² sr), and distance to the first hit, metres, infinite if there is none.
    """
    environment, emitters = lighting.environment, lighting.emitters
    ctx = mi.BSDFContext()
    # ---- variables of the loop -----------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)  # radiance so far
    throughput = mi.Color3f(1)
    depth = mi.UInt32(0)  # surfaces met so far, without panes gone straight through
    distance = mi.Float(dr.inf)  # to the first hit
    passage = _Passage.begin() if lighting.panes.some else None
    known = mi.Bool(False)  # the secondary cache answered at the last surface: only direct light is left
    departure = Departure.nowhere()
    active = mi.Bool(True)

    while active:
        si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        looks = _unseen(passage, (depth == 0) | ~departure.delta)
        met = look_beyond(lighting, si, ray, looks, active)
        distance = dr.select(depth == 0, _first_distance(passage, si, met, distance), distance)

        # Add what an emitter hit by BSDF sampling gives: from the record itself only the cached part of the environment
        # counts; where the secondary cache answered, only the rest.
        counts = _unseen(passage, active & ((depth > 0) | ~met.si.is_valid()))
        found = emission(lighting, met, departure, counts)
        part = dr.select(depth == 0, found.cached, dr.select(known, 1 - found.cached, 1))
        L = dr.select(found.active, L + throughput * found.radiance * (part * found.mis), L)

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
            known = asks & (look.weight >= ANSWERED) & (distance > secondary.radius_of(look.row))
            E = dr.select(known, look.irradiance, 0)

        # Sample emitters.
        numbers = samples.at(mi.UInt32(0), depth if passage is None else depth + passage.panes)
        smooth = active & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        row = emitters.row_at(si, smooth)
        count = dr.select(depth == 0, mi.UInt32(lighting.emitter_samples), 1)
        emitters_only = known & mi.Bool(environment.only_emitter)
        receiver = Receiver(si, row, count, emitters_only, known)

        sample = numbers.sample_2d(Purpose.EMITTER)
        L += throughput * emitter_samples(lighting, receiver, all_lobes(bsdf, si), sample, smooth)

        # Go on in a direction of the BSDF's choice.
        lobe, direction = numbers.sample_1d(Purpose.LOBE), numbers.sample_2d(Purpose.DIRECTION)
        bs, weight = bsdf.sample(ctx, si, lobe, direction, active)
        L = dr.select(known, L + throughput * weight * E * dr.inv_pi, L)

        throughput *= weight
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        depth += _surfaces(passage, si, met, lighting.panes.transmits(bs), (depth == 0) | ~departure.delta)
        departure = Departure(si, row, bs.pdf, delta, mi.Float(count))
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(throughput != 0) & ~emitters_only
        active &= True if passage is None else passage.panes < MOST_PANES
    return L, distance


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
