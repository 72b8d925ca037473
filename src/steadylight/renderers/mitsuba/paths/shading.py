"""Light paths of the second pass: direct light, the cache for the diffuse lobe, traced rays for every other lobe."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

import mitsuba as mi
from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import (
    GLOSSY_FLAGS,
    LEFT,
    NOT_REFLECTED,
    OTHER_FLAGS,
    BSDFTraits,
    cosine_pdf,
    diffuse_lobe,
    other_lobes,
)
from steadylight.renderers.mitsuba.light.emitters import EmitterSampling
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.paths.misses import MissList
from steadylight.renderers.mitsuba.records.gather import emitter_stratum, mis_weight
from steadylight.renderers.mitsuba.records.lookup import NO_RECORD, DeviceCache
from steadylight.renderers.mitsuba.records.obstacles import Trust, trusted_radius

EMITTER_SAMPLES = 3
"""Emitter samples at the surface that a camera ray meets first, or through panes; one further on."""

GLOSSY_SAMPLES = 4
"""Directions drawn from the BSDF of that surface if it has a glossy lobe; one further on."""

NEGLIGIBLE = 1e-3
"""A path whose throughput fell below this ends."""


class Layers(NamedTuple):
    """The radiance in two parts, and what a denoiser wants to know of the surface; Color3f each.

    The surface is the first that is more than a mirror, clear glass or a hole, seen through panes where there are some;
    black where there is none.
    """

    kept: Any  # what the cache gave to that surface: no noise in it
    rest: Any  # all that gloss meets; below 0 where gloss makes up for cached sky. A picture adds direct light to it
    albedo: Any  # from 0 to 1
    normal: Any  # shading normal in world space, towards the ray, from -1 to 1


class Shade(NamedTuple):
    """What a path brought back."""

    radiance: Any  # Color3f, or Layers of it, without the two that follow
    direct: Any  # Color3f, direct light on the first surface; see `direct.direct_light`
    emitted: Any  # Color3f, what shines at the camera itself, or by mirrors and clear glass alone
    missed: Any  # UInt32, look-ups that no record answered at its normal radius


def ends_at_first(environment: Environment, cache: DeviceCache | None, bsdfs: BSDFTraits) -> bool:
    """Whether only emitter samples find what the cache does not hold, and nothing else is worth a further ray."""
    return environment.exists and cache is not None and environment.only_emitter and bsdfs.only_diffuse


@dr.syntax
def trace(
    scene: Any,
    sampler: Any,
    ray: Any,
    cache: DeviceCache | None,
    emitters: EmitterSampling | None,
    environment: Environment,
    bsdfs: BSDFTraits,
    depth_limit: Any,
    demand: Trust | None = None,
    misses: MissList | None = None,
    layered: bool = False,
) -> Shade:
    """Follow camera rays through mirrors, glass and gloss, and light every diffuse lobe on the way from the cache.

    What the camera sees shine, itself or by mirrors and clear glass, is kept apart, and so is direct light on the first
    surface: neither asks the cache. At each surface: what else it emits, weighted against emitter sampling; emitter
    samples; the diffuse lobe times the cached indirect irradiance / pi; one direction drawn from all lobes, which
    collects emission for all of them but goes on with what the non-diffuse lobes scatter into it. A surface that is
    diffuse and nothing else, with no emitter near, does without that direction.

    Some surfaces are left in several directions, one visit after the other, by beginning again at the camera: a glossy
    one that the camera sees, panes of clear glass before it, and, last, the base of a coat near an emitter. The first
    visit passes through the panes that it meets, the next is mirrored by the first of them, the one after that by the
    second, and so on.

    Args:
        scene: mi.Scene.
        sampler: a seeded wavefront sampler.
        ray: camera rays.
        cache: read only; None if there is no indirect light (zero bounces).
        emitters: chooses emitters; not needed if nothing is lit.
        environment: divides the surroundings.
        bsdfs: of this scene.
        depth_limit: UInt32, most non-diffuse interactions.
        demand: with `unanswered`, a stricter idea of what answers; None for that of lighting.
        misses: look up but do not light, and note here what finds no answer; None to light. Consumes the same
            random numbers, so it walks the same paths, but for the visit for the base of a coat, which asks nothing.
        layered: return `Layers`. Consumes the same random numbers.
    """
    ctx, ctx_diffuse, ctx_other = mi.BSDFContext(), diffuse_lobe(), other_lobes()
    find_missed = misses is not None
    caches_environment = environment.exists and cache is not None
    samples_only = ends_at_first(environment, cache, bsdfs)
    # ---- loop state ----------------------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)  # radiance so far
    beta = mi.Color3f(1)  # throughput of the non-diffuse lobes
    beta_e = mi.Color3f(1)  # throughput of all lobes, for emission at the next hit
    depth = mi.UInt32(0)  # non-diffuse interactions so far
    prev_si = dr.zeros(mi.SurfaceInteraction3f)  # where the current ray starts
    prev_row = mi.UInt32(NO_RECORD)  # the record that knows the emitters there
    prev_pdf = mi.Float(1)  # density of its direction
    prev_delta = mi.Bool(True)  # ... unless it was the only one possible
    prev_primary = mi.Bool(False)  # whether that surface is primary
    missed = mi.UInt32(0)
    emitted = mi.Color3f(0)
    direct = mi.Color3f(0)
    clear = mi.Bool(True)  # left by a mirror, clear glass or a hole each time, as it was sampled
    # Of surfaces that are left several times: the number of the visit, visits still to come, and how many of the
    # surfaces that visits share this one has met so far; LEFT after the last of them.
    repeated = bsdfs.some_glossy or bsdfs.some_coated or bsdfs.some_panes
    visit = mi.UInt32(0) if repeated else None
    more = mi.UInt32(0) if repeated else None
    met = mi.UInt32(0) if repeated else None
    waits = mi.Bool(False) if repeated else None  # goes nowhere
    based = mi.Bool(False) if bsdfs.some_coated else None  # the last visit is for the base of a coat
    step = mi.UInt32(0)  # surfaces that this lane has met
    # What a denoiser needs; nothing, so that it is no part of the loop, where there is none.
    kept = mi.Color3f(0) if layered else None
    seen_albedo = mi.Color3f(0) if layered else None
    seen_normal = mi.Color3f(0) if layered else None
    first = mi.Bool(True) if layered else None  # nothing but mirrors and clear glass so far
    travelled = mi.Float(0)  # metres from the camera
    camera_ray = mi.Ray3f(ray)
    path = dr.arange(mi.UInt32, dr.width(ray))
    active = mi.Bool(True)

    while active:
        traced = active
        if dr.hint(repeated, mode="scalar"):
            traced = active & ~waits
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, traced)
        fresh = mi.Bool(traced)  # not met by an earlier visit
        if dr.hint(repeated, mode="scalar"):
            fresh &= met >= visit
        # Primary is what the camera sees, itself or through panes.
        primary = depth == 0
        if dr.hint(bsdfs.some_panes, mode="scalar"):
            primary = depth == met

        # Add what is emitted here.
        if dr.hint(not find_missed, mode="scalar"):
            emitter = si.emitter(scene)
            ds = mi.DirectionSample3f(scene, si, prev_si)
            lit = fresh & (emitter != None)  # noqa: E711 - element-wise
            pdf_em = emitters.pdf(prev_si, ds, emitter, prev_row, lit & ~prev_delta)
            pdf_em *= dr.select(prev_primary, mi.Float(EMITTER_SAMPLES), 1)
            mis = dr.select(prev_delta, 1, mis_weight(prev_pdf, pdf_em))
            Le = emitter.eval(si, lit)
            at_once = lit & clear
            emitted = dr.select(at_once, emitted + beta_e * Le, emitted)
            lit &= ~at_once
            if dr.hint(caches_environment, mode="scalar"):
                # The cache holds the soft part of the surroundings for all diffuse lobes.
                soft = dr.select(si.is_valid(), 0, environment.cached_fraction(Le))
                L = dr.select(lit, L + beta * Le * soft, L)
                Le *= 1 - soft
            from_first = lit & (depth == 1)
            direct = dr.select(from_first, direct + beta_e * Le * mis, direct)
            L = dr.select(lit & ~from_first, L + beta_e * Le * mis, L)
        active &= si.is_valid() & (depth <= depth_limit) & (dr.max(dr.abs(beta)) > NEGLIGIBLE)

        # Diffuse lobe: on which side the irradiance arrives, and how much of it leaves towards us.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        diffuse = active & mi.has_flag(flags, mi.BSDFFlags.Diffuse)
        side_z = si.wi.z
        albedo = mi.Color3f(0)
        if dr.hint(not bsdfs.only_diffuse, mode="scalar"):
            bs_d, albedo = bsdf.sample(
                ctx_diffuse, si, sampler.next_1d(active), sampler.next_2d(active), diffuse
            )
            side_z = bs_d.wo.z
            number = dr.reinterpret_array(mi.UInt32, bsdf)
            if dr.hint(bsdfs.some_masks, mode="scalar"):
                masked = dr.gather(mi.Bool, bsdfs.masks, number, active)
                wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
                wo.z = dr.mulsign(wo.z, si.wi.z)
                value = bsdf.eval(ctx_diffuse, si, wo, diffuse & masked)
                albedo = dr.select(masked, value * dr.pi / dr.maximum(dr.abs(wo.z), 1e-6), albedo)
                side_z = dr.select(masked, si.wi.z, side_z)
            if dr.hint(bsdfs.some_whole, mode="scalar"):
                whole = dr.gather(mi.Bool, bsdfs.whole, number, active)
                rho = bsdf.eval_diffuse_reflectance(si, diffuse)
                rho = dr.select(dr.gather(mi.Bool, bsdfs.through, number, active), 0, rho)
                albedo = dr.select(whole, rho, albedo)
                side_z = dr.select(whole, si.wi.z, side_z)
            diffuse &= dr.any(albedo != 0)
        n = mi.Normal3f(si.sh_frame.n * dr.select(side_z < 0, mi.Float(-1), mi.Float(1)))

        # Ask the cache.
        E = mi.Color3f(0)
        row = mi.UInt32(NO_RECORD)
        miss = mi.Bool(False)
        if dr.hint(cache is None, mode="scalar"):
            pass
        elif dr.hint(find_missed, mode="scalar"):
            asks = diffuse & fresh
            travelled += dr.select(active, si.t, 0)
            trusted = mi.Float(dr.inf)
            if dr.hint(demand is not None, mode="scalar"):
                trusted = trusted_radius(scene, si, n, travelled, demand, asks)
            miss = asks & (cache.weight(si.p, n, trusted, asks) < ANSWERED)
            misses.note(path, step, si.p, n, trusted, miss)
        else:
            look = cache.look_up(si.p, n, diffuse)
            E = look.irradiance
            row = look.row
            miss = diffuse & fresh & (look.weight <= 0)
        missed += dr.select(miss, mi.UInt32(1), 0)

        # A primary surface with a coat is left by the coat alone: of its base, the cache knows the indirect light, and
        # emitter samples the direct light, but where an emitter is near.
        coated = mi.Bool(False)
        near = mi.Bool(False)
        if dr.hint(bsdfs.some_coated, mode="scalar"):
            coated = active & primary & bsdfs.coat(bsdf, active)

        # A pane of glass is left by what it lets through, and by what it mirrors.
        pane, mirrored = mi.Bool(False), mi.Bool(False)
        if dr.hint(bsdfs.some_panes, mode="scalar"):
            pane, mirrored = bsdfs.pane(bsdf, visit, met, active)
            more += dr.select(pane & (visit == 0), mi.UInt32(1), 0)

        # Another glossy one is left in several directions, one after the other. MIS knows of one: emitter samples are
        # stratified, and should not count less because of the others.
        directions = mi.Float(1)
        if dr.hint(bsdfs.some_glossy, mode="scalar"):
            split = active & primary & ((flags & GLOSSY_FLAGS) != 0) & ~coated
            directions = dr.select(split, mi.Float(GLOSSY_SAMPLES), 1)
            more += dr.select(split & (visit == 0), mi.UInt32(GLOSSY_SAMPLES - 1), 0)

        # Sample emitters: several times at a primary surface, in strata of one 2D sample.
        sample_em = sampler.next_2d(active)
        reflects_only = active & ((flags & NOT_REFLECTED) == 0)
        samples_alone = reflects_only  # the audit does not look for emitters
        if dr.hint(not find_missed, mode="scalar"):
            smooth = active & fresh & mi.has_flag(flags, mi.BSDFFlags.Smooth)
            # Where no emitter is near, no ray is sent, and emitter samples count in full.
            suffice = emitters.suffice(row, active)
            samples_alone = reflects_only & suffice
            if dr.hint(bsdfs.some_coated, mode="scalar"):
                # A ray from the base follows, after all else: the audit, which does not need it, has drawn the same
                # random numbers until then.
                near = coated & ~suffice
                based |= near & (visit == 0)
                more += dr.select(near & (visit == 0), mi.UInt32(1), 0)
                for_base = based & primary & (mirrored | ~pane) & (visit > 0) & (more == 0)
                # On an edge, the same ray may meet another surface this time, and from there go where the audit has
                # never been.
                active &= near | ~for_base
            samples = dr.select(primary, mi.UInt32(EMITTER_SAMPLES), 1)
            per_sample = dr.rcp(mi.Float(samples))
            k = mi.UInt32(0)
            while smooth & (k < samples):
                stratum = emitter_stratum(sample_em, k, per_sample)
                ds, em_weight, em_radiance = emitters.sample(si, stratum, row, smooth)
                wo = si.to_local(ds.d)
                value, pdf = bsdf.eval_pdf(ctx, si, wo, smooth)
                if dr.hint(bsdfs.some_coated, mode="scalar"):
                    by_coat = bsdf.pdf(ctx_other, si, wo, smooth & coated)
                    pdf = dr.select(coated, by_coat + dr.select(near, cosine_pdf(si.wi, wo), 0), pdf)
                if dr.hint(caches_environment, mode="scalar"):
                    soft = environment.cached_fraction(em_radiance)
                    em_weight *= dr.select(ds.emitter.is_environment(), 1 - soft, 1)
                mis = mis_weight(ds.pdf * mi.Float(samples), pdf)
                mis = mi.Float(1) if samples_only else dr.select(ds.delta | samples_alone, 1, mis)
                given = dr.select(ds.pdf > 0, beta * value * em_weight * (mis * per_sample), 0)
                direct = dr.select(depth == 0, direct + given, direct)
                L = dr.select(depth == 0, L, L + given)
                k += 1

        # Sample the BSDF: one direction of all lobes, or of a coat, or of the base under it.
        lobe, direction = sampler.next_1d(active), sampler.next_2d(active)
        drawn = active if bsdfs.only_diffuse else active & ~samples_alone
        from_base = mi.Bool(False)
        if dr.hint(bsdfs.some_coated and not find_missed, mode="scalar"):
            from_base = near & for_base
        bs, weight = bsdfs.sample(
            bsdf, si, lobe, direction, drawn & ~from_base, coated & ~from_base, pane, mirrored
        )
        if dr.hint(bsdfs.some_coated, mode="scalar"):
            bs_base, of_base = bsdf.sample(ctx_diffuse, si, lobe, direction, from_base)
            bs = dr.select(from_base, bs_base, bs)
            weight = dr.select(from_base, of_base, weight)
        if dr.hint(bsdfs.only_diffuse, mode="scalar"):
            albedo = weight
        if dr.hint(not find_missed, mode="scalar"):
            cached = dr.select(diffuse & fresh, beta * albedo * E * dr.inv_pi, 0)
            if dr.hint(layered, mode="scalar"):
                # What is seen by a glossy bounce has the noise of its direction.
                kept += dr.select(first, cached, 0)
                cached = dr.select(first, 0, cached)
            L += cached

        # Tell a denoiser which surface it looks at: the first that is more than a mirror, clear glass or a hole.
        if dr.hint(layered, mode="scalar"):
            first &= active
            through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            here = first & mi.has_flag(flags, mi.BSDFFlags.Smooth) & ~through
            rho_seen = bsdf.eval_diffuse_reflectance(si, here)
            rho_seen = dr.select(mi.has_flag(flags, mi.BSDFFlags.Diffuse), rho_seen, 1)
            seen_albedo = dr.select(here, dr.clip(beta * rho_seen, 0, 1), seen_albedo)
            towards = mi.Color3f(dr.mulsign(si.sh_frame.n, si.wi.z))
            seen_normal = dr.select(here, towards, seen_normal)
            first &= ~here

        # Go on: emission counts for all lobes, everything else for the non-diffuse ones.
        weight = weight / directions
        beta_e = beta * weight
        goes_on = (dr.any(beta_e != 0) | from_base) & ~samples_alone
        if dr.hint(repeated, mode="scalar"):
            # Whether a ray looks for an emitter, the audit does not know. Before another visit each lane waits as if it
            # did, or that visit would have other random numbers.
            waits = reflects_only & (more > 0) & ~goes_on
            goes_on |= waits
        prev_si = si
        prev_row = row
        prev_pdf = bs.pdf
        prev_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        prev_primary = primary
        clear &= prev_delta
        if dr.hint(bsdfs.only_diffuse, mode="scalar"):
            beta = mi.Color3f(0)
        else:
            has_other = (flags & OTHER_FLAGS) != 0
            others = active & has_other & ~prev_delta & ~coated
            value_o = bsdf.eval(ctx_other, si, bs.wo, others)
            if dr.hint(bsdfs.some_whole, mode="scalar"):
                value_o = dr.select(whole, value_o - rho * dr.inv_pi * dr.abs(bs.wo.z), value_o)
            share = dr.select(others, value_o / dr.maximum(bs.pdf * directions, 1e-12), 0)
            if dr.hint(bsdfs.some_coated and not find_missed, mode="scalar"):
                # Emission counts for coat and base, whichever the direction is from, and less by as much as the other
                # would have found it.
                by_pdf = coated & ~prev_delta
                of_both = bsdf.eval(ctx, si, bs.wo, by_pdf)
                pdf_coat = dr.select(from_base, bsdf.pdf(ctx_other, si, bs.wo, from_base), bs.pdf)
                pdf_both = pdf_coat + dr.select(near, cosine_pdf(si.wi, bs.wo), 0)
                of_both = dr.select(pdf_both > 0, of_both / pdf_both, 0)
                beta_e = dr.select(by_pdf, beta * of_both, beta_e)
                prev_pdf = dr.select(by_pdf, pdf_both, prev_pdf)
            beta *= dr.select(from_base, 0, dr.select(prev_delta | coated, weight, share))
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= goes_on
        if dr.hint(find_missed, mode="scalar"):
            worth = dr.max(dr.abs(beta)) > NEGLIGIBLE
            if dr.hint(repeated, mode="scalar"):
                worth |= more > 0  # go on as if to light it, for the same random numbers
            active &= worth
        if dr.hint(samples_only, mode="scalar"):
            active &= False
        depth += 1
        step += 1

        # Back to the camera for the next visit.
        if dr.hint(repeated, mode="scalar"):
            met = dr.select(pane & ~mirrored, met + 1, LEFT)
            back = ~active & (more > 0)
            waits &= active
            # Counted here: on an edge, the same ray may meet another surface the second time.
            more = dr.select(back, more - 1, more)
            ray = dr.select(back, camera_ray, ray)
            beta = dr.select(back, mi.Color3f(1), beta)
            beta_e = dr.select(back, mi.Color3f(1), beta_e)
            travelled = dr.select(back, mi.Float(0), travelled)
            depth = dr.select(back, mi.UInt32(0), depth)
            prev_delta |= back
            clear |= back
            met = dr.select(back, mi.UInt32(0), met)
            visit += dr.select(back, mi.UInt32(1), 0)
            active |= back
    return Shade(Layers(kept, L, seen_albedo, seen_normal) if layered else L, direct, emitted, missed)
