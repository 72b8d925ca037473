"""Light on the surfaces that the camera sees, direct or cached, by itself: for pixels that take more samples of it.

A few pixels have most of the noise of direct light: bars in front of a lamp, rims of spotlight cones, the first
centimetres beside a window. Cached light has hardly any noise of its own, but it varies within pixels that contain
an edge or a fine texture. The other pixels need no further samples.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.bsdf.lobes import NOT_DIFFUSE_REFLECTION
from steadylight.renderers.mitsuba.light.clusters import facing_normal
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Lighting,
    Receiver,
    all_lobes,
    emission,
    emitter_samples,
    look_beyond,
)
from steadylight.renderers.mitsuba.paths.shading import ends_at_first
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Purpose, Samples


def direct_light(
    lighting: Lighting, samples: Samples, ray: mi.Ray3f, cache: DeviceCache | None
) -> mi.Color3f:
    """Radiance that the first surface on each ray scatters from emitters, by all its lobes except delta ones.

    Its mean is that of `Shade.direct`: one emitter sample, and one BSDF sample.

    Args:
        lighting: of the scene.
        samples: random numbers of the camera rays.
        ray: camera rays.
        cache: selects the record whose emitter table is used; its irradiance is not.
    """
    si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, True)
    bsdf = si.bsdf(ray)
    flags = bsdf.flags()
    smooth = si.is_valid() & mi.has_flag(flags, mi.BSDFFlags.Smooth)
    numbers = samples.at(mi.UInt32(0), mi.UInt32(0))
    row = mi.UInt32(NO_ROW)
    if cache is not None:
        row = cache.look_up(si.p, facing_normal(si), smooth & mi.has_flag(flags, mi.BSDFFlags.Diffuse)).row

    # Sample an emitter.
    emitters_only = smooth & ((flags & NOT_DIFFUSE_REFLECTION) == 0)
    emitters_only &= lighting.emitters.emitters_only(row, smooth)
    if ends_at_first(lighting, cache):
        emitters_only = smooth
    cached = mi.Bool(cache is not None)
    receiver = Receiver(si, row, mi.UInt32(1), emitters_only, cached)

    L = emitter_samples(lighting, receiver, all_lobes(bsdf, si), numbers.sample_2d(Purpose.EMITTER), smooth)

    # Sample the BSDF; delta lobes are left to camera paths.
    bs, weight = bsdf.sample(mi.BSDFContext(), si, *numbers.draw(), smooth)
    weight = lighting.bsdfs.finite(weight)
    goes = smooth & ~emitters_only & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    goes &= dr.any(weight != 0)
    onward = si.spawn_ray(si.to_world(bs.wo))
    there = lighting.scene.ray_intersect(onward, mi.RayFlags.All, False, goes)
    met = look_beyond(lighting, there, onward, goes, goes)
    found = emission(lighting, met, Departure(si, row, bs.pdf, mi.Bool(False), mi.Float(1)), goes)
    radiance = found.radiance * (1 - found.cached) if cache is not None else found.radiance
    return dr.select(found.active, L + weight * radiance * found.mis, L)


def indirect_light(
    lighting: Lighting, samples: Samples, ray: mi.Ray3f, cache: DeviceCache
) -> tuple[mi.Color3f, mi.Bool]:
    """Radiance that the diffuse lobe of the first surface on each ray scatters from the cache: `Shade.indirect`.

    No audit has followed these rays, so a few in 100,000 meet a point that no record covers.

    Args:
        lighting: of the scene.
        samples: random numbers of the camera rays.
        ray: camera rays.
        cache: to look up.

    Returns:
        The radiance, and whether it is known: False where the cache has no record.
    """
    si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, True)
    numbers = samples.at(mi.UInt32(0), mi.UInt32(0))
    diffuse = lighting.bsdfs.diffuse_lobe(si, si.bsdf(ray), numbers, si.is_valid())
    look = cache.look_up(si.p, diffuse.normal, diffuse.active, diffuse.facing)
    light = diffuse.albedo * look.irradiance * dr.inv_pi
    return dr.select(diffuse.active, light, 0), ~diffuse.active | (look.row != NO_ROW)
