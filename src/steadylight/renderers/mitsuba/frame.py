"""A whole frame from the cache: light paths, more samples where they are noisy, emitters with fine edges, denoising."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.images import luminance
from steadylight.renderers.mitsuba.image.adaptive import Refinement, refine, weight_of
from steadylight.renderers.mitsuba.image.denoising import Denoiser, balanced, mixed, scale_of
from steadylight.renderers.mitsuba.image.picture import (
    DirectLight,
    Picture,
    Rendered,
    Sampled,
    render_layers,
)
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
from steadylight.renderers.mitsuba.image.refiltering import lit_as_filtered
from steadylight.renderers.mitsuba.paths.direct import direct_light
from steadylight.renderers.mitsuba.paths.shading import Layers
from steadylight.renderers.mitsuba.paths.visible_emitters import VisibleEmitters, visible_emission
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Samples, seed_of
from steadylight.renderers.mitsuba.view import View

# What the samples of a frame are for; mixed into its seed so that no two share random numbers.
_DIRECT, _EMISSION = 1, 2


class Shaded(NamedTuple):
    """A frame.

    Attributes:
        image: scene-linear RGB.
        missed: look-ups that no record answered.
        firefly_loss: part of its light that fireflies have lost; a denoised frame gets most of it back.
    """

    image: Picture
    missed: int
    firefly_loss: float


class Direct(NamedTuple):
    """Direct light of the pixels that got more samples for it; (height, width, 3) each, 0 elsewhere.

    Attributes:
        filtered: through the filter of the picture.
        mean: of each pixel.
        noise: an independent sample of the error of `mean`; see `Refined.noise`.
    """

    filtered: Picture
    mean: Picture
    noise: Picture


class FrameShader:
    """Shades frames from the place where the camera of a view is."""

    def __init__(self, view: View, spp: int, *, denoise: bool) -> None:
        """Make it ready.

        Args:
            view: where to look from, and with what quality.
            spp: samples per pixel.
            denoise: direct light and gloss go through Open Image Denoise.
        """
        self._view, self._spp, self._denoise = view, spp, denoise
        self._rfilter = view.camera.sensor.film().rfilter()
        self._cache: DeviceCache | None = None
        self._seen, self._direct_seen, self._emission_seen = (
            Look(view.camera, seen, self._state) for seen in (self._shade, self._light, self._emit)
        )

    def _state(self) -> list[object]:
        return self._view.arrays(self._cache)

    def _shade(self, samples: Samples, ray: mi.Ray3f) -> Sampled:
        found = self._view.shade(samples, ray, self._cache, layered=True)
        layers, cached = found.radiance, None
        if self._denoise:
            pictures = (*layers, layers.albedo)
        else:
            pictures, cached = (layers.rest,), layers.cached
        return Sampled(pictures, found.missed, cached, found.direct, found.emitted)

    def _light(self, samples: Samples, ray: mi.Ray3f) -> mi.Color3f:
        return direct_light(self._view.lighting(self._cache), samples, ray, self._cache)

    def _emit(self, samples: Samples, ray: mi.Ray3f) -> mi.Color3f:
        return visible_emission(self._view.lighting(self._cache), samples, ray, self._view.limits)

    def shade(self, cache: DeviceCache | None, seed: int) -> Shaded:
        """A frame whose every look-up this cache answers, or nothing does.

        Args:
            cache: read only; None if there is no indirect light.
            seed: decides all random numbers of the frame.
        """
        view, self._cache = self._view, cache
        view.lighting(cache)
        denoiser = self.denoiser if self._denoise else None  # before the work: it may be missing here
        filters = [self._rfilter]
        if self._denoise:
            box = self._box
            filters = [self._rfilter, box, box, box, self._rfilter]  # Layers, and albedo once more
        layer = Layers._fields.index("rest") if self._denoise else 0
        direct_to = DirectLight(layer, view.quality.adaptive.direct)
        noise_of = layer if self._denoise and self._spp > 1 else None
        sampling, firefly = Sampling(self._spp, seed), view.quality.shading.firefly
        if self._denoise and noise_of is None:
            firefly = None  # nothing would give back what is cut
        rendered = render_layers(self._seen, filters, sampling, direct_to, noise_of, firefly)
        direct = self._direct(rendered, seed_of(seed, _DIRECT))
        emitted = self._emission(rendered, direct.filtered, seed_of(seed, _EMISSION))
        if denoiser is None:
            image = rendered.images[0] + direct.filtered + emitted
        else:
            image = self._denoised(denoiser, rendered, direct, emitted)
        cut, left = (float(luminance(each).mean(dtype=np.float64)) for each in (rendered.cut, image))
        whole = cut + left if denoiser is None else max(left, cut)
        return Shaded(image, rendered.count, cut / whole if cut else 0.0)

    def _denoised(self, denoiser: Denoiser, rendered: Rendered, direct: Direct, emitted: Picture) -> Picture:
        """The frame with all that the cache did not give denoised; `direct` is not in `rendered` yet."""
        *layered, albedo = rendered.images
        layers = Layers(*layered)
        rest = layers.rest + direct.mean
        noisy = self._view.camera.random_aperture or self._view.bsdfs.random_transparency
        scale = scale_of(layers.cached + rest + emitted)
        # What is below 0 makes up for something in the other layer, and a denoiser would drop it.
        light, debt = np.maximum(rest, 0), np.minimum(rest, 0)
        clean = denoiser.clean(light, layers.albedo, layers.normal, scale=scale, prefilter=noisy)
        if rendered.noise is not None:
            noise = rendered.noise + direct.noise
            clean = balanced(light, mixed(light, clean, noise), noise, rendered.cut)
        rest = lit_as_filtered(clean + debt, layers.albedo, albedo, self._rfilter)
        return layers.cached + rest + emitted

    def _direct(self, rendered: Rendered, seed: int) -> Direct:
        """Direct light of the pixels for which `rendered` lacks it."""
        camera, quality = self._view.camera, self._view.quality.adaptive.direct
        width, height = camera.size
        direct = Direct(*(np.zeros((height, width, 3), np.float32) for _ in Direct._fields))
        if not any(len(band.pixels) for band in rendered.noisy):
            return direct
        filtered, mean, noise = direct.filtered, direct.mean.reshape(-1, 3), direct.noise.reshape(-1, 3)
        for band in rendered.noisy:
            top, bottom = band.rows.want
            refinement = Refinement(band.pixels, band.rows.want, quality.samples, quality.rays)
            refined = refine(self._direct_seen, self._rfilter, Sampling(self._spp, seed), refinement)
            filtered[top:bottom] = refined.given
            own = (band.pixels >= top * width) & (band.pixels < bottom * width)
            mean[band.pixels[own]], noise[band.pixels[own]] = refined.mean[own], refined.noise[own]
        filtered /= weight_of(self._rfilter, camera.size)[..., None].astype(np.float32)
        return direct

    def _emission(self, rendered: Rendered, direct: Picture, seed: int) -> Picture:
        """What shines at the camera itself, besides what was rendered and the direct light that this lacks."""
        assert rendered.emitted is not None
        shares = 2 if self._denoise else 1  # of the images, these make up the picture
        picture = np.sum(rendered.images[:shares], axis=0) + rendered.emitted.mean + direct
        brightness = float(luminance(picture).mean(dtype=np.float64))
        edges = VisibleEmitters(self._emission_seen, self._rfilter, self._view.quality.adaptive.emission)
        return edges.picture(Sampling(self._spp, seed), rendered.emitted, brightness)

    @cached_property
    def _box(self) -> mi.ReconstructionFilter:
        return mi.load_dict({"type": "box"})

    @cached_property
    def denoiser(self) -> Denoiser:
        """Loaded when it is first needed."""
        return Denoiser(dr.thread_count(), thorough=self._view.quality.denoising.large_network)
