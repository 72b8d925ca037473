"""Direct light on the surfaces that the camera sees, by itself: for pixels that take more samples of it.

A few pixels have most of the noise of direct light: bars in front of a lamp, rims of spotlight cones, the first
centimetres beside a window. The others need no further samples.
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

    Its mean is that of `Shade.direct` of `shading.shade`: one emitter sample, and one BSDF sample.

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
