"""Direct light on what the camera sees, without all else: for pixels that get more samples of it.

A few pixels have most of the noise of direct light: bars before a lamp, rims of spots' cones, the first centimetres
beside a window. Others need no more samples than they have.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

import mitsuba as mi
from steadylight.renderers.mitsuba.bsdf.lobes import NOT_REFLECTED, BSDFTraits
from steadylight.renderers.mitsuba.light.emitters import EmitterSampling
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.paths.shading import ends_at_first
from steadylight.renderers.mitsuba.records.gather import mis_weight
from steadylight.renderers.mitsuba.records.lookup import NO_RECORD, DeviceCache

FINE, PART = 128, 1 / 8
"""Pixels that are sampled again get so many samples, unless this were more than that part of the picture's own rays;
see `sampled_again`."""


def direct_light(
    scene: Any,
    sampler: Any,
    ray: Any,
    cache: DeviceCache | None,
    emitters: EmitterSampling,
    environment: Environment,
    bsdfs: BSDFTraits,
) -> Any:
    """Radiance that the first surface on each ray scatters from emitters, by all its lobes but mirrors and holes.

    Its mean is that of `Shade.direct` of `transport.trace`: one emitter sample, and one direction by the BSDF.

    Args:
        scene: mi.Scene.
        sampler: a seeded wavefront sampler.
        ray: camera rays.
        cache: tells which record knows the emitters here; its irradiance is not asked for.
        emitters: chooses emitters.
        environment: what of the surroundings is cached is no direct light.
        bsdfs: of this scene.

    Returns:
        Color3f.
    """
    ctx = mi.BSDFContext()
    caches_environment = environment.exists and cache is not None
    si = scene.ray_intersect(ray, mi.RayFlags.All, True)
    bsdf = si.bsdf(ray)
    flags = bsdf.flags()
    smooth = si.is_valid() & mi.has_flag(flags, mi.BSDFFlags.Smooth)
    row = mi.UInt32(NO_RECORD)
    if cache is not None:
        n = mi.Normal3f(si.sh_frame.n * dr.select(si.wi.z < 0, mi.Float(-1), mi.Float(1)))
        row = cache.look_up(si.p, n, smooth & mi.has_flag(flags, mi.BSDFFlags.Diffuse)).row

    # Sample an emitter.
    samples_alone = smooth & ((flags & NOT_REFLECTED) == 0) & emitters.suffice(row, smooth)
    if ends_at_first(environment, cache, bsdfs):
        samples_alone = smooth
    ds, em_weight, em_radiance = emitters.sample(si, sampler.next_2d(smooth), row, smooth)
    if caches_environment:
        em_weight *= dr.select(ds.emitter.is_environment(), 1 - environment.cached_fraction(em_radiance), 1)
    value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
    mis = dr.select(ds.delta | samples_alone, 1, mis_weight(ds.pdf, pdf))
    L = dr.select(smooth & (ds.pdf > 0), value * em_weight * mis, mi.Color3f(0))

    # Sample the BSDF; what a mirror or a hole shows is seen by the camera itself.
    bs, weight = bsdf.sample(ctx, si, sampler.next_1d(smooth), sampler.next_2d(smooth), smooth)
    goes = smooth & ~samples_alone & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    goes &= dr.any(weight != 0)
    there = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), mi.RayFlags.All, False, goes)
    emitter = there.emitter(scene)
    lit = goes & (emitter != None)  # noqa: E711 - element-wise
    Le = emitter.eval(there, lit)
    if caches_environment:
        Le *= 1 - dr.select(there.is_valid(), 0, environment.cached_fraction(Le))
    towards = mi.DirectionSample3f(scene, there, si)
    pdf_em = emitters.pdf(si, towards, emitter, row, lit)
    return dr.select(lit, L + weight * Le * mis_weight(bs.pdf, pdf_em), L)
