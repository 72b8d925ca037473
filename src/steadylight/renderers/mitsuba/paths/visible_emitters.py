"""Visible emitters, antialiased more finely than the surfaces that they light.

A lamp or a window is often a hundred times as bright as the wall beside it. The few camera rays of a pixel are enough
for an edge between wall and floor. At the edge of a lamp, the same uncertainty makes a ragged line that crawls when the
camera moves, and changes the brightness of the whole picture. Visible emission needs only camera rays, and mirrors and
glass on their way. Pixels where emission differs between neighbours therefore get many more camera rays, and so do
those beside pixels where these find what the few missed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

from steadylight.images import luminance
from steadylight.renderers.mitsuba.bsdf.lobes import Choice
from steadylight.renderers.mitsuba.image.adaptive import Refinement, refine, weight_of
from steadylight.renderers.mitsuba.image.picture import Emitted, Picture
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
from steadylight.renderers.mitsuba.image.reconstruction import integral_of
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.paths.branches import Branches, CameraPath, PathLimits
from steadylight.renderers.mitsuba.quality import AdaptiveQuality
from steadylight.renderers.mitsuba.sampling import Samples


class VisibleEmitters:
    """Renders the emitters that a camera sees."""

    def __init__(self, look: Look, rfilter: mi.ReconstructionFilter, quality: AdaptiveQuality) -> None:
        """Store the settings.

        Args:
            look: `visible_emission` of camera rays.
            rfilter: of the film.
            quality: how edges are sampled.
        """
        self._look, self._rfilter, self._quality = look, rfilter, quality

    def picture(self, sampling: Sampling, emitted: Emitted, brightness: float) -> Picture:
        """The emitters that the camera sees, directly or by mirrors and clear glass, without surfaces that they light.

        Args:
            sampling: samples per pixel that `emitted` is from, and a different seed.
            emitted: emission found by the samples of the picture.
            brightness: mean luminance of the picture, emission included.

        Returns:
            (height, width, 3) float32 scene-linear RGB.
        """
        width, height = self._look.camera.size
        given = np.zeros((height, width, 3), np.float32)
        if not emitted.highest.any():
            return given
        threshold, rays = self._quality.emission.threshold * brightness, self._quality.emission.rays
        uniform = emitted.highest - emitted.lowest <= threshold
        coarse = luminance(emitted.mean)
        sampled = np.zeros((height, width), bool)
        waiting = maximum_filter(emitted.highest, 3) - minimum_filter(emitted.lowest, 3) > threshold
        while waiting.any():
            pixels = np.flatnonzero(waiting)
            refinement = Refinement(pixels, (0, height), self._quality.emission_samples, rays)
            found = refine(self._look, self._rfilter, sampling, refinement)
            given += found.given
            sampled |= waiting
            rays -= len(pixels) * refinement.spp(width, sampling.spp) / (sampled.size * sampling.spp)
            # Where many samples see what few missed, such as a glint as thin as a wire, neighbours may have missed it.
            missed = np.zeros_like(sampled)
            missed.flat[pixels] = np.abs(luminance(found.mean) - coarse.flat[pixels]) > threshold
            waiting = maximum_filter(missed & uniform, 3) & ~sampled
        # Elsewhere, take a pixel for uniform.
        image = np.where(sampled[..., None], 0, emitted.mean)
        weights = integral_of(self._rfilter)
        for axis in (0, 1):
            image = correlate1d(image, weights, axis, mode="constant")
        total = weight_of(self._rfilter, (width, height))
        return np.asarray((image + given) / total[..., None], np.float32)


@dr.syntax
def visible_emission(lighting: Lighting, samples: Samples, ray: mi.Ray3f, limits: PathLimits) -> mi.Color3f:
    """Emission seen by rays, directly or by mirrors and clear glass: `emitted` of `shading.shade`.

    Args:
        lighting: of the scene.
        samples: random numbers of the camera rays.
        ray: camera rays.
        limits: how far paths are followed.
    """
    bsdfs = lighting.bsdfs
    path, branches = CameraPath.begin(ray), Branches.begin()
    L = mi.Color3f(0)
    while path.active:
        si = lighting.scene.ray_intersect(path.ray, mi.RayFlags.All, path.depth == 0, path.active)
        emitter = si.emitter(lighting.scene)
        lit = path.active & branches.fresh() & (emitter != None)  # noqa: E711 - element-wise
        L = dr.select(lit, L + path.throughput * emitter.eval(si, lit), L)

        bsdf = si.bsdf(path.ray)
        path.active &= si.is_valid() & (path.depth <= limits.depth)
        path.active &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        layer = path.active & bsdfs.is_layered(bsdf, path.active)
        dielectric, reflected = branches.at_dielectric(bsdfs, bsdf, path.active)
        choice = Choice(layer, mi.Bool(False), dielectric, reflected)
        bs, weight = bsdfs.sample(si, bsdf, branches.numbers(samples, path.depth).draw(), choice, path.active)
        path.active &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & dr.any(weight != 0)
        path.throughput *= weight
        path.ray = si.spawn_ray(si.to_world(bs.wo))
        branches.leave(bsdfs, path, dielectric, reflected)
    return L
