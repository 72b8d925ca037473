"""A whole frame from the cache: light paths, adaptive samples where they are noisy, antialiased emitters, denoising."""

from __future__ import annotations

from functools import cached_property, partial
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.images import luminance
from steadylight.renderers.mitsuba.image.adaptive import (
    Estimates,
    control_weight,
    estimates,
    give,
    refine_by_error,
    samples_by_error,
    weight_of,
    worst_around,
)
from steadylight.renderers.mitsuba.image.denoising import Denoiser, balanced, mixed, scale_of
from steadylight.renderers.mitsuba.image.picture import (
    Noisy,
    Picture,
    Rendered,
    Sampled,
    SurfaceLight,
    render_layers,
)
from steadylight.renderers.mitsuba.image.pixels import Look, Rows, Sampling
from steadylight.renderers.mitsuba.image.refiltering import lit_as_filtered
from steadylight.renderers.mitsuba.paths.first_surface import direct_light, indirect_light
from steadylight.renderers.mitsuba.paths.shading import Layers
from steadylight.renderers.mitsuba.paths.visible_emitters import VisibleEmitters, visible_emission
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.sampling import Samples, seed_of
from steadylight.renderers.mitsuba.view import View

# Purposes of a frame's samples; mixed into its seed so that no two share random numbers.
_DIRECT, _EMISSION, _REST, _FIRST, _INDIRECT = 1, 2, 3, 4, 5


class Shaded(NamedTuple):
    """A frame.

    Attributes:
        image: scene-linear RGB.
        missed: look-ups that found no record, without those of pixels that were sampled again.
        firefly_loss: fraction of its light that was clamped from fireflies; denoising restores most of it.
    """

    image: Picture
    missed: int
    firefly_loss: float


class Added(NamedTuple):
    """What adaptively sampled pixels add to a picture; (height, width, 3) each.

    Attributes:
        indirect: light from the cache, through the film's filter.
        filtered: other light, through the film's filter.
        mean: of each pixel, other light.
        noise: an independent sample of the error of `mean`; see `Estimates.noise`.
        where: (height, width) mask of the pixels whose other light was sampled again.
    """

    indirect: Picture
    filtered: Picture
    mean: Picture
    noise: Picture
    where: NDArray[np.bool_]

    @classmethod
    def nothing(cls, size: tuple[int, int]) -> Added:
        """No additions to a picture of (width, height) pixels."""
        width, height = size
        indirect, filtered, mean, noise = np.zeros((4, height, width, 3), np.float32)
        return cls(indirect, filtered, mean, noise, np.zeros((height, width), np.bool_))

    def put(self, rows: Rows, pixels: NDArray[np.intp], found: Estimates) -> None:
        """Add the estimates of (M,) pixels of some rows and of the rows around them.

        What they splat through the filter must still be divided by `weight_of`.
        """
        top, bottom = rows.want
        width = self.where.shape[1]
        give(self.filtered[top:bottom], top, found.taps, pixels)
        own = (pixels >= top * width) & (pixels < bottom * width)
        self.mean.reshape(-1, 3)[pixels[own]] += found.mean[own]
        self.noise.reshape(-1, 3)[pixels[own]] += found.noise[own]
        self.where.reshape(-1)[pixels[own]] = True

    def put_indirect(self, rows: Rows, pixels: NDArray[np.intp], found: Estimates) -> None:
        """Add the light from the cache of (M,) pixels of some rows, to be divided by `weight_of`."""
        top, bottom = rows.want
        give(self.indirect[top:bottom], top, found.taps, pixels)


class FrameShader:
    """Shades frames from the current camera of a view."""

    def __init__(self, view: View, spp: int, *, denoise: bool) -> None:
        """Prepare the kernels.

        Args:
            view: camera, scene and quality.
            spp: samples per pixel.
            denoise: whether Open Image Denoise filters direct light and glossy reflections.
        """
        self._view, self._spp, self._denoise = view, spp, denoise
        self._rfilter = view.camera.sensor.film().rfilter()
        self._cache: DeviceCache | None = None
        ways = (
            self._shade,
            self._light,
            self._emit,
            self._look_up,
            partial(self._beyond, many=False),
            partial(self._beyond, many=True),
        )
        looks = [Look(view.camera, seen, self._state) for seen in ways]
        self._seen, self._direct_seen, self._emission_seen, self._indirect_seen, *self._rest_seen = looks

    def _state(self) -> list[object]:
        return self._view.arrays(self._cache)

    def _shade(self, samples: Samples, ray: mi.Ray3f) -> Sampled:
        found = self._view.shade(samples, ray, self._cache, layered=True)
        layers, cached = found.radiance, None
        if self._denoise:
            pictures = (*layers, layers.albedo)
        else:
            pictures, cached = (layers.rest,), layers.cached
        indirect = None if self._cache is None else found.indirect
        return Sampled(pictures, found.missed, cached, found.direct, indirect, found.emitted)

    def _light(self, samples: Samples, ray: mi.Ray3f) -> mi.Color3f:
        return direct_light(self._view.lighting(self._cache), samples, ray, self._cache)

    def _emit(self, samples: Samples, ray: mi.Ray3f) -> mi.Color3f:
        return visible_emission(self._view.lighting(self._cache), samples, ray, self._view.limits)

    def _look_up(self, samples: Samples, ray: mi.Ray3f) -> tuple[mi.Color3f, mi.Bool]:
        assert self._cache is not None
        return indirect_light(self._view.lighting(self._cache), samples, ray, self._cache)

    def _beyond(self, samples: Samples, ray: mi.Ray3f, *, many: bool) -> mi.Color3f:
        return self._view.rest(samples, ray, self._cache, many=many)

    def shade(self, cache: DeviceCache | None, seed: int) -> Shaded:
        """Shade a frame from this cache; no records are made where it misses.

        Args:
            cache: read only; None if there is no indirect light.
            seed: decides all random numbers of the frame.
        """
        view, self._cache = self._view, cache
        view.lighting(cache)
        denoiser = self.denoiser if self._denoise else None  # load first: it may be missing here
        filters = [self._rfilter]
        if self._denoise:
            box = self._box
            filters = [self._rfilter, box, box, box, self._rfilter]  # Layers, and albedo a second time
        layer = Layers._fields.index("rest") if self._denoise else 0
        adaptive = view.quality.adaptive
        answered = cache is None or view.limits.secondary is not None
        rest = adaptive.rest if answered else None
        surface = SurfaceLight(layer, adaptive.direct, rest, adaptive.indirect, adaptive.worth_indirect)
        noise_of = layer if self._spp > 1 else None
        sampling, firefly = Sampling(self._spp, seed), view.quality.shading.firefly
        if self._denoise and noise_of is None:
            firefly = None  # nothing would restore what is clamped
        rendered = render_layers(self._seen, filters, sampling, surface, noise_of, firefly)
        added = self._added(rendered, seed)
        emitted = self._emission(rendered, added, seed_of(seed, _EMISSION))
        if denoiser is None:
            image = rendered.images[0] + added.indirect + added.filtered + emitted
        else:
            image = self._denoised(denoiser, rendered, added, emitted)
        cut, left = (float(luminance(each).mean(dtype=np.float64)) for each in (rendered.cut, image))
        whole = cut + left if denoiser is None else max(left, cut)
        return Shaded(image, rendered.count, cut / whole if cut else 0.0)

    def _denoised(self, denoiser: Denoiser, rendered: Rendered, added: Added, emitted: Picture) -> Picture:
        """The frame, with `added`: direct light and gloss are denoised, cached light and emitters are not."""
        *layered, albedo = rendered.images
        layers = Layers(*layered)
        cached = layers.cached + added.indirect
        rest = layers.rest + added.mean
        noisy = self._view.camera.random_aperture or self._view.bsdfs.random_transparency
        scale = scale_of(cached + rest + emitted)
        # Negative values cancel light in another layer, and a denoiser would clamp them.
        light, debt = np.maximum(rest, 0), np.minimum(rest, 0)
        clean = denoiser.clean(light, layers.albedo, layers.normal, scale=scale, prefilter=noisy)
        if rendered.noise is not None:
            noise = rendered.noise + added.noise
            clean = balanced(light, mixed(light, clean, noise, added.where), noise, rendered.cut)
        rest = lit_as_filtered(clean + debt, layers.albedo, albedo, self._rfilter)
        return cached + rest + emitted

    def _added(self, rendered: Rendered, seed: int) -> Added:
        """Sample noisy pixels again: light on the first surface that `rendered` lacks, and corrections to the rest."""
        size = self._view.camera.size
        added = Added.nothing(size)
        better = _noise_of_rest(rendered) >= self._view.quality.adaptive.worth_rest
        for band in rendered.noisy:
            if len(band.direct.pixels):
                added.put(band.rows, band.direct.pixels, self._direct(band, seed))
            if len(band.indirect.pixels):
                added.put_indirect(band.rows, band.indirect.pixels, self._indirect(band, seed))
            if better and len(band.rest.pixels):
                assert rendered.noise is not None  # with one sample per pixel, none would be noisy
                added.put(band.rows, band.rest.pixels, self._better_rest(band, rendered.noise, seed))
        given = [picture for picture in (added.indirect, added.filtered) if picture.any()]
        if given:
            weight = weight_of(self._rfilter, size)[..., None].astype(np.float32)
            for picture in given:
                picture[:] /= weight
        return added

    def _direct(self, band: Noisy, seed: int) -> Estimates:
        """Direct light of the pixels that lack it.

        The samples that decide how many a pixel gets are not part of its mean. Otherwise, a pixel where they missed a
        rare glint, such as the sun on a wire in one sample of a thousand, would be too dark.
        """
        pixels, around = band.direct.pixels, band.direct.around
        rays, width = self._view.quality.adaptive.direct.rays, self._view.camera.width
        told = Sampling(self._spp, seed_of(seed, _FIRST))
        first = estimates(self._direct_seen, self._rfilter, told, pixels)
        worst = worst_around(pixels, first.error / around, width)
        samples = self._by_error(worst, band.direct.threshold, band.rows, rays)
        sampling = Sampling(self._spp, seed_of(seed, _DIRECT))
        return refine_by_error(self._direct_seen, self._rfilter, sampling, pixels, samples)

    def _indirect(self, band: Noisy, seed: int) -> Estimates:
        """Light from the cache of the pixels that lack it."""
        pixels, rays = band.indirect.pixels, self._view.quality.adaptive.indirect.rays
        samples = self._by_error(band.indirect.error, band.indirect.threshold, band.rows, rays)
        sampling = Sampling(self._spp, seed_of(seed, _INDIRECT))
        return refine_by_error(self._indirect_seen, self._rfilter, sampling, pixels, samples)

    def _better_rest(self, band: Noisy, noise: Picture, seed: int) -> Estimates:
        """A correction of noisy pixels' `rest`, with the secondary cache as a control variate.

        Records may not cover rays that no audit has followed, but the secondary cache nearly covers them. Its estimate
        by the picture's own rays is subtracted and one by many more rays is added, weighted by how well the noise of
        the first matches the picture's. The mean remains that of the records. The noise of the few rays is left only in
        the difference between records and secondary cache.
        """
        same, more = self._rest_seen
        sampling = Sampling(self._spp, seed_of(seed, _REST))
        pixels, rays, width = band.rest.pixels, self._view.quality.adaptive.rest.rays, self._view.camera.width
        samples = self._by_error(band.rest.error, band.rest.threshold, band.rows, rays)
        fine = refine_by_error(more, self._rfilter, sampling, pixels, samples, band.bound)
        had = estimates(same, self._rfilter, Sampling(self._spp, seed), pixels, band.bound)
        weight = control_weight(noise.reshape(-1, 3)[pixels], had.noise, pixels, width)
        return fine.less(had, weight)

    def _by_error(
        self, error: NDArray[np.float64], threshold: float, rows: Rows, rays: float
    ) -> NDArray[np.intp]:
        """Samples of each noisy pixel of some rows, by its error; at most `rays` times the picture's in these rows."""
        top, bottom = rows.want
        most = rays * self._view.camera.width * (bottom - top) * self._spp
        return samples_by_error(error, threshold, self._spp, most)

    def _emission(self, rendered: Rendered, added: Added, seed: int) -> Picture:
        """The emitters that the camera sees; `added` only adds to the brightness that scales their contrast."""
        assert rendered.emitted is not None
        shares = 2 if self._denoise else 1  # images that sum to the picture
        picture = np.sum(rendered.images[:shares], axis=0) + rendered.emitted.mean
        picture = picture + added.indirect + added.filtered
        brightness = float(luminance(picture).mean(dtype=np.float64))
        edges = VisibleEmitters(self._emission_seen, self._rfilter, self._view.quality.adaptive)
        return edges.picture(Sampling(self._spp, seed), rendered.emitted, brightness)

    @cached_property
    def _box(self) -> mi.ReconstructionFilter:
        return mi.load_dict({"type": "box"})

    @cached_property
    def denoiser(self) -> Denoiser:
        """Open Image Denoise, loaded on first use."""
        return Denoiser(dr.thread_count(), thorough=self._view.quality.denoising.large_network)


def _noise_of_rest(rendered: Rendered) -> float:
    """Noise of the picture due to pixels with noisy `rest`: relative, root mean square over all pixels."""
    if rendered.noise is None:
        return 0.0
    noise = luminance(rendered.noise).ravel()
    noisy = [band.rest for band in rendered.noisy]
    squares = (np.square(noise[rest.pixels] / rest.around).sum() for rest in noisy)
    return float(np.sqrt(sum(squares) / noise.size))
