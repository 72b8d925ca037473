"""Pictures by Mitsuba's own integrators, with our reconstruction: the baseline and the reference."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.frozen import frozen, loaded
from steadylight.renderers.mitsuba.image.denoising import Denoiser, scale_of
from steadylight.renderers.mitsuba.image.picture import Picture
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling, passes
from steadylight.renderers.mitsuba.image.reconstruction import border_of, reconstruct
from steadylight.renderers.mitsuba.sampling import seed_of

_LAYER_SPP = 16
"""Maximum samples per pixel of albedo and normals: with more, the denoised picture hardly improves."""


def path_traced(
    scene: mi.Scene,
    camera: Camera,
    integrator: mi.SamplingIntegrator | _Layer,
    sampling: Sampling,
    rfilter: mi.ReconstructionFilter | None = None,
) -> Picture:
    """Render a picture.

    The integrator uses Mitsuba's multijitter sampler (Kensler 2013), its best.

    Args:
        scene: mi.Scene.
        camera: in that scene.
        integrator: traces camera rays.
        sampling: samples per pixel, rounded up to a number that the sampler supports, and the seed.
        rfilter: reconstruction filter; that of the film if None.

    Returns:
        (height, width, 3) float32 scene-linear RGB.
    """
    width, height = camera.size
    rfilter = rfilter or camera.sensor.film().rfilter()
    image = np.zeros((height, width, 3), np.float32)
    total = np.zeros(())
    for wanted in passes(camera, sampling.spp, border_of(rfilter)):
        sampler = _multijitter(wanted.spp)
        part = wanted._replace(spp=sampler.sample_count())
        seed = seed_of(sampling.seed, part.rows.have[0], part.first)
        _, ray, offset = part.rays(camera, seed)
        dr.eval(ray, offset)
        traced = _Traced(scene, integrator, sampler, part.lanes(camera))
        L = _frozen_radiance(traced, ray, dr.opaque(mi.UInt32, seed))
        given = reconstruct(L, offset, rfilter, part.rows, width)
        total = given if part.first == 0 else total + given
        if part.last:
            top, bottom = part.rows.want
            image[top:bottom] = total[..., :3] / np.where(total[..., 3:] != 0, total[..., 3:], 1)
    return image


class _Traced(NamedTuple):
    """What a recording of `_radiance` is of; see `frozen`."""

    scene: mi.Scene
    integrator: mi.SamplingIntegrator | _Layer
    sampler: mi.Sampler
    lanes: int

    def state(self) -> list[Any]:
        """All that the kernel reads, or that is compiled into it."""
        # Mitsuba compiles constants of a scene into kernels without Dr.Jit's knowledge: its id separates recordings.
        which = (id(self.scene), str(self.integrator), self.sampler.sample_count(), self.lanes)
        return [loaded(self.scene), *which]


def _radiance(traced: _Traced, ray: mi.Ray3f, seed: mi.UInt32) -> mi.Color3f:
    """Radiance along rays."""
    traced.sampler.seed(seed, traced.lanes)
    L, _, _ = traced.integrator.sample(traced.scene, traced.sampler, ray)
    dr.eval(L)
    return L


_frozen_radiance = frozen(_radiance, _Traced.state)


def path_traced_and_denoised(
    scene: mi.Scene,
    camera: Camera,
    integrator: mi.SamplingIntegrator,
    sampling: Sampling,
    denoiser: Denoiser,
) -> Picture:
    """Render a picture and denoise all of it: the usual alternative to a cache.

    A box filter is used, as the denoiser expects: with a wider filter, it takes noise for texture.

    Args:
        scene: mi.Scene.
        camera: in that scene.
        integrator: traces camera rays.
        sampling: samples per pixel, and the seed.
        denoiser: Open Image Denoise.

    Returns:
        (height, width, 3) float32 scene-linear RGB.
    """
    box = mi.load_dict({"type": "box"})
    noisy = path_traced(scene, camera, integrator, sampling, box)
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    few = Sampling(min(sampling.spp, _LAYER_SPP), sampling.seed)
    albedo, normal = (path_traced(scene, camera, _Layer(aov, first), few, box) for first in (0, 3))
    noise_in_layers = camera.random_aperture
    return denoiser.clean(
        np.maximum(noisy, 0),
        albedo.clip(0, 1),
        normal.clip(-1, 1),
        scale=scale_of(noisy),
        prefilter=noise_in_layers,
    )


class _Layer:
    """Three values of Mitsuba's `aov` integrator, returned as radiance."""

    def __init__(self, aov: mi.SamplingIntegrator, first: int) -> None:
        self._aov, self._first = aov, first

    def __str__(self) -> str:
        return f"{self._aov} from {self._first}"

    def sample(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
        """As for an integrator."""
        _, valid, values = self._aov.sample(scene, sampler, ray)
        return mi.Color3f(*values[self._first : self._first + 3]), valid, []


def _multijitter(spp: int) -> mi.Sampler:
    """A sampler of at least `spp` samples: it may round up to a grid."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    mi.set_log_level(level)
    sampler.set_samples_per_wavefront(sampler.sample_count())
    return sampler
