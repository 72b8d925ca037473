"""Radiance along the paths of a gather: a path tracer that ends in the secondary cache where it can."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import OTHER_FLAGS
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Lighting,
    Receiver,
    all_lobes,
    emission,
    emitter_samples,
)
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Purpose, Samples


@dr.syntax
def indirect_radiance(
    lighting: Lighting, samples: Samples, ray: mi.Ray3f, bounces: mi.UInt32, secondary: DeviceCache | None
) -> tuple[mi.Color3f, mi.Float]:
    """Radiance that arrives along a ray from surfaces and from the cached part of the environment.

    What the first surface hit emits, and the rest of the environment, is direct light and is left to the second pass.
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
    depth = mi.UInt32(0)  # surfaces met so far
    distance = mi.Float(dr.inf)  # to the first hit
    known = mi.Bool(False)  # the secondary cache answered at the last surface: only direct light is left
    departure = Departure.nowhere()
    active = mi.Bool(True)

    while active:
        si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        distance = dr.select(depth == 0, si.t, distance)

        # Add what an emitter hit by BSDF sampling gives: from the record itself only the cached part of the environment
        # counts; where the secondary cache answered, only the rest.
        found = emission(lighting, si, departure, active & ((depth > 0) | ~si.is_valid()))
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
            known = asks & (look.weight >= ANSWERED) & (si.t > secondary.radius_of(look.row))
            E = dr.select(known, look.irradiance, 0)

        # Sample emitters.
        numbers = samples.at(mi.UInt32(0), depth)
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
        weight = lighting.bsdfs.finite(weight)
        L = dr.select(known, L + throughput * weight * E * dr.inv_pi, L)

        throughput *= weight
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        departure = Departure(si, row, bs.pdf, delta, mi.Float(count))
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(throughput != 0) & ~emitters_only
        depth += 1
    return L, distance
