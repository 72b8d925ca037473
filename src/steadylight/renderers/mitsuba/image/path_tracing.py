"""Pictures by one of Mitsuba's own integrators, with our reconstruction: the baseline and the reference."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.image.picture import Picture
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling, passes
from steadylight.renderers.mitsuba.image.reconstruction import border_of, reconstruct
from steadylight.renderers.mitsuba.sampling import seed_of


def path_traced(
    scene: mi.Scene, camera: Camera, integrator: mi.SamplingIntegrator, sampling: Sampling
) -> Picture:
    """A picture.

    The integrator draws from a sampler of Mitsuba's, multijitter (Kensler 2013): its own best.

    Args:
        scene: what is seen.
        camera: from where.
        integrator: traces camera rays.
        sampling: samples per pixel, rounded up to what the sampler can do, and the seed.

    Returns:
        (height, width, 3) float32 scene-linear RGB.
    """
    width, height = camera.size
    rfilter = camera.sensor.film().rfilter()
    image = np.zeros((height, width, 3), np.float32)
    total = np.zeros(())
    for wanted in passes(camera, sampling.spp, border_of(rfilter)):
        sampler = _multijitter(wanted.spp)
        part = wanted._replace(spp=sampler.sample_count())
        seed = seed_of(sampling.seed, part.rows.have[0], part.first)
        _, ray, offset = part.rays(camera, seed)
        sampler.seed(dr.opaque(mi.UInt32, seed), part.lanes(camera))
        L, _, _ = integrator.sample(scene, sampler, ray)
        dr.eval(L)
        given = reconstruct(L, offset, rfilter, part.rows, width)
        total = given if part.first == 0 else total + given
        if part.last:
            top, bottom = part.rows.want
            image[top:bottom] = total[..., :3] / np.where(total[..., 3:] != 0, total[..., 3:], 1)
    return image


def _multijitter(spp: int) -> mi.Sampler:
    """A sampler of at least so many samples: it may round up to a grid."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    mi.set_log_level(level)
    sampler.set_samples_per_wavefront(sampler.sample_count())
    return sampler
