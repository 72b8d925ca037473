"""The renderer behind the two passes: what makes records and what shades from them.

This is the seam at which another renderer with an irradiance cache would come in: a few methods, plain arrays in
and out, no knowledge of files, tasks or engines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import mitsuba as mi
from steadylight.cache.lookup import ANSWERED
from steadylight.cache.merge import canonical_order
from steadylight.cache.partition import Partition
from steadylight.cache.placement import answered_weight
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import smooth
from steadylight.camera import Pose
from steadylight.images import luminance
from steadylight.renderers.mitsuba.image.adaptive import sampled_again, weight_of
from steadylight.renderers.mitsuba.image.denoising import Denoiser, scale_of
from steadylight.renderers.mitsuba.image.reconstruction import (
    Rendered,
    Sampled,
    border_of,
    lit_as_filtered,
    render_image,
    render_layers,
    seed_of,
)
from steadylight.renderers.mitsuba.paths.direct import FINE, PART, direct_light
from steadylight.renderers.mitsuba.paths.shading import Layers
from steadylight.renderers.mitsuba.paths.visible_emitters import emission_image
from steadylight.renderers.mitsuba.quality import quality_of
from steadylight.renderers.mitsuba.records.assignment import left_to_others
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.lookup import DeviceCache, Part, PartedCache
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor, set_pose
from steadylight.renderers.mitsuba.view import (
    Missed,
    View,
    diagonal,
    draw,
    fill_view,
    make_filler,
    thin_rows,
    thinned,
)
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

LARGEST_BLOCK = 1 << 15
"""First-pass rays between two looks at the stopping rule, at most."""

# What a seed is for; mixed into it so that no two uses share random numbers.
_SOBOL, _BLOCK, _FIRST, _AUDIT, _COVER, _PRIVATE, _SHADE = range(7)


@dataclass(frozen=True)
class FirstPass:
    """What one selected frame gave: its records, and how many rays hit, missed, or were left to other frames."""

    records: Records
    rays: int
    hits: int
    misses: int
    left: int


@dataclass(frozen=True)
class Frame:
    """A rendered frame.

    Attributes:
        image: (height, width, 3) float32 scene-linear RGB.
        missed: look-ups that no record answered at its own radius.
        new_records: private records made for this frame alone.
    """

    image: NDArray[np.float32]
    missed: int
    new_records: int


class Renderer:
    """Lights one scene along one camera path; built once per process and used for many tasks."""

    def __init__(
        self,
        description: SceneDescription,
        poses: Mapping[int, Pose],
        settings: RenderSettings,
        partition: Partition | None = None,
    ) -> None:
        """Build the scene.

        Args:
            description: the scene.
            poses: camera pose of every frame of the film, by frame number.
            settings: what decides the bytes.
            partition: of the cache; None if it is in one part.
        """
        self._cube = None if partition is None else partition.cube
        longest = np.inf if partition is None else partition.radius
        self._settings = settings
        self._poses = poses
        self._smoothed: tuple[DeviceCache, DeviceCache] | None = None
        self._quality = quality_of(settings)
        scene = build_scene(description)
        size = (settings.width, settings.height)
        sensor = build_sensor(description, poses[settings.frames[0]], *size)
        self._perspective = description.sensor.get("type", "perspective") != "orthographic"
        self._rfilter = sensor.film().rfilter()
        self.view = View(scene, sensor, size, settings.depth, self._quality, longest)
        film = [poses[frame] for frame in settings.frames]
        self._bounds = RadiusBounds(film, settings.width, diagonal(scene), self._quality.records, longest)
        self._shared_filler: Filler | None = None

    @property
    def filler(self) -> Filler:
        """Makes records for the whole film; prepared when the first is needed."""
        if self._shared_filler is None:
            self._shared_filler = self._filler_along(self._settings.frames)
        return self._shared_filler

    def _filler_along(self, frames: Sequence[int]) -> Filler:
        poses = [self._poses[frame] for frame in frames]
        return make_filler(self.view, poses, self._settings.bounces)

    def load(self, cache: Records | Mapping[str, Records]) -> PartedCache:
        """Bring records to the device: the cache, or parts of it by name."""
        named = {"": cache} if isinstance(cache, Records) else cache
        parts = {name: Part(records) for name, records in named.items()}
        return PartedCache(parts, cube=self._cube)

    def _finished(self, cache: DeviceCache) -> DeviceCache:
        """A cache with the private records of a frame, its noise smoothed; kept in case the next needs none."""
        if self._smoothed is None or self._smoothed[0] is not cache:
            self._smoothed = (
                cache,
                DeviceCache(smooth(cache.records, smoothing=self._quality.smoothing)).with_fallback(),
            )
        return self._smoothed[1]

    # ---- the first pass ------------------------------------------------------------------

    def first_pass(self, frame: int, selected: Sequence[int] = ()) -> FirstPass:
        """Records for a selected frame: Sobol pixels until hits : misses reach the threshold.

        As in the paper (section 3.2.1), the rule is looked at only after the base rays. Rays are taken in blocks of
        growing size; within a block, a ray is a miss if it made a record and a hit if another ray's record answers
        it, as if the rays had come one by one.

        Args:
            frame: its number.
            selected: all selected frames, which share out what several of them see; none to leave nothing to others,
                as published. What is left counts neither as hit nor as miss.
        """
        s = self._settings
        filler = self.filler  # preparing it moves the sensor
        self._look_from(frame)
        sobol = qmc.Sobol(2, rng=np.random.default_rng(seed_of(s.seed, _SOBOL, frame)))
        others = [self._poses[number] for number in selected] if self._perspective else []
        mine = list(selected).index(frame) if others else 0

        def wanted(points: Points) -> NDArray[np.bool_]:
            """Which are not such that other frames see to them."""
            if len(others) < 2 or len(points.position) == 0:
                return np.ones(len(points.position), bool)
            return ~left_to_others(self.view.scene, self.view.bsdfs, points, others, mine, s.width / s.height)

        records = Records.empty()
        rays = misses = left = number = 0
        block = s.base_rays
        limit = 4 * s.width * s.height
        while s.bounces and rays < limit:
            seed = seed_of(s.seed, _BLOCK, frame, number)
            made, missed, to_others = self._answer(filler, draw(sobol, block), records, seed, wanted)
            records = Records.concatenate(records, made)
            rays += block
            misses += missed
            left += to_others
            number += 1
            if rays - left - misses >= s.threshold * misses:
                break
            block = min(rays, LARGEST_BLOCK)
        return FirstPass(records, rays, rays - left - misses, misses, left)

    def _answer(
        self,
        filler: Filler,
        film: NDArray[np.float32],
        records: Records,
        seed: int,
        wanted: Callable[[Points], NDArray[np.bool_]],
    ) -> tuple[Records, int, int]:
        """New records such that the rays through `film` find an answer wherever they ask, or others see to it.

        Returns:
            The records; how many rays made one; and how many lack nothing but what is left to others.
        """
        points, ray = self.view.missed_through(film, DeviceCache(records), seed)
        mine = wanted(points)
        made = filler.fill(points.take(mine), seed_of(seed, _FIRST))
        # A path that meets several diffuse surfaces may make several records: it is one miss all the same.
        makers = np.unique(ray[mine])
        return made, min(len(made), len(makers)), len(np.setdiff1d(ray[~mine], makers))

    # ---- the coverage audit --------------------------------------------------------------

    def audit(self, frames: Sequence[int], cache: DeviceCache, *, last: bool) -> Missed:
        """Look along some frames for what the cache cannot answer.

        Args:
            frames: their numbers.
            cache: as it is so far.
            last: walk the very paths that will light the frames, and find all that finds no record. Otherwise one
                path in every pixel, and with probes for records that should not be trusted where they are.
        """
        s = self._settings
        parts: list[Missed] = []
        for frame in frames if s.bounces else ():
            self._look_from(frame)
            if last:
                border = border_of(self._rfilter)
                missed = self.view.missed_in_image(cache, s.spp, self._shade_seed(frame), border)
            else:
                missed = self.view.missed_in_pixels(cache, seed_of(s.seed, _AUDIT, frame))
                missed = missed._replace(points=thinned(missed.points, self._bounds))
            parts.append(missed)
        joined = Missed.concatenate(parts)
        return joined if last else joined._replace(points=thinned(joined.points, self._bounds))

    def cover(
        self, found: Sequence[tuple[Floats, Floats, Floats]], records: Records, number: int, part: int = 0
    ) -> Records:
        """The records, and new ones that answer the points which the audits of a round found.

        Args:
            found: positions, normals and longest radiuses of each audit, in a fixed order.
            records: the part of the cache that was audited.
            number: of the round.
            part: its number; no two parts share random numbers.
        """
        points = Points.concatenate([Points(*each) for each in found])
        made = [records]
        # Of points close together one is enough, as a rule; where it is not, as behind a corner, the next is asked.
        while len(points.position):
            seed = seed_of(self._settings.seed, _COVER, number, part, len(made))
            rows = thin_rows(points, self._bounds)
            new = self.filler.fill(points.take(rows), seed)
            made.append(new)
            waiting = answered_weight(*points, new) < ANSWERED
            waiting[rows] = False
            points = points.take(waiting)
        if len(made) == 1:
            return records  # without preparing the filler, which takes a while
        joined = Records.concatenate(*made)
        return joined.take(canonical_order(joined))

    # ---- the second pass -----------------------------------------------------------------

    def shade(self, frame: int, cache: DeviceCache | None) -> Frame:
        """A whole frame.

        Args:
            frame: its number.
            cache: with full coverage finished, without what the first pass left. None makes a private cache for
                this frame alone (single-pass).

        Returns:
            The frame. With `coverage` off, or without a cache, points that nothing answers get private records,
            which serve this frame alone, as in the paper.
        """
        s = self._settings
        self._look_from(frame)
        new_records = 0
        if s.bounces == 0:
            cache = None
        elif cache is None or s.coverage == "off":
            before = cache or self.load(Records.empty())
            # A frame rendered alone knows nothing of the rest of the film.
            filler = self._filler_along([frame]) if cache is None else self.filler
            self._look_from(frame)
            cache = fill_view(self.view, filler, before, seed_of(s.seed, _PRIVATE, frame))
            new_records = len(cache.records) - len(before.records)
            cache = self._finished(cache)
        shaded = self._shade(frame, cache, new_records)
        if cache is not None and cache.relaxed is None and shaded.missed:
            # The audit walked these very paths; but on another kind of machine they may end a hair from there.
            shaded = self._shade(frame, cache.with_fallback(), new_records)
        return shaded

    def _shade(self, frame: int, cache: DeviceCache | None, new_records: int) -> Frame:
        """A frame whose every look-up this cache answers, or nothing does."""
        self.view.prepare(cache)
        s = self._settings
        denoiser = self._denoiser if s.denoise else None  # before the work: it may be missing here
        box = self._box
        filters: tuple[Any, ...] = (self._rfilter,)
        if s.denoise:
            filters = (*Layers(kept=self._rfilter, rest=box, albedo=box, normal=box), self._rfilter)

        def seen(sampler: Any, ray: Any) -> Sampled:
            shade = self.view.trace(sampler, ray, cache, layered=s.denoise)
            layers = (*shade.radiance, shade.radiance.albedo) if s.denoise else (shade.radiance,)
            return Sampled(layers, shade.missed, shade.direct, shade.emitted)

        seed = self._shade_seed(frame)
        direct_to = Layers._fields.index("rest") if s.denoise else 0
        rendered = render_layers(
            self.view.sensor, filters, self.view.size, s.spp, seed, seen, direct_to=direct_to
        )
        direct, means = self._direct(rendered, cache, seed)
        emitted = self._emission(rendered, direct, seed)
        if denoiser is None:
            return Frame(rendered.images[0] + direct + emitted, rendered.count, new_records)
        *layered, albedo = rendered.images
        layers = Layers(*layered)
        rest = layers.rest + means
        noisy = self.view.sensor.needs_aperture_sample() or self.view.bsdfs.some_chance
        scale = scale_of(layers.kept + rest + emitted)
        # What is below 0 makes up for something in the other layer, and a denoiser would drop it.
        rest = denoiser.clean(
            np.maximum(rest, 0), layers.albedo, layers.normal, scale=scale, prefilter=noisy
        ) + np.minimum(rest, 0)
        rest = lit_as_filtered(rest, layers.albedo, albedo, self._rfilter)
        image = layers.kept + rest + emitted
        return Frame(image, rendered.count, new_records)

    def _direct(
        self, rendered: Rendered, cache: DeviceCache | None, seed: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Direct light of the pixels for which `rendered` lacks it: through the filter, and as means of each pixel."""
        s, view = self._settings, self.view
        width, height = view.size
        image = np.zeros((height, width, 3), np.float32)
        means = np.zeros((height * width, 3), np.float32)
        if not any(len(band.pixels) for band in rendered.noisy):
            return image, means.reshape(height, width, 3)
        emitters = view.prepare(cache)

        def seen(sampler: Any, ray: Any) -> Any:
            return direct_light(view.scene, sampler, ray, cache, emitters, view.environment, view.bsdfs)

        for band in rendered.noisy:
            top, bottom = band.want
            image[top:bottom], mean = sampled_again(
                view.sensor, self._rfilter, view.size, s.spp, seed, band.pixels, seen, band.want, FINE, PART
            )
            own = (band.pixels >= top * width) & (band.pixels < bottom * width)
            means[band.pixels[own]] = mean[own]
        image /= weight_of(self._rfilter, view.size)[..., None].astype(np.float32)
        return image, means.reshape(height, width, 3)

    def _emission(self, rendered: Rendered, direct: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
        """What shines at the camera itself, besides what was rendered and the direct light that this lacks."""
        assert rendered.emitted is not None
        s = self._settings
        shares = 2 if s.denoise else 1  # of the images, these make up the picture
        picture = np.sum(rendered.images[:shares], axis=0) + rendered.emitted.mean + direct
        brightness = float(luminance(picture).mean(dtype=np.float64))
        return emission_image(
            self.view.scene,
            self.view.bsdfs,
            self.view.sensor,
            self._rfilter,
            self.view.size,
            s.spp,
            self.view.depth,
            seed,
            rendered.emitted,
            brightness,
        )

    @cached_property
    def _box(self) -> Any:
        return mi.load_dict({"type": "box"})

    @cached_property
    def _denoiser(self) -> Denoiser:
        return Denoiser(dr.thread_count(), thorough=self._quality.denoising.large_network)

    def path(self, frame: int) -> Frame:
        """A whole frame by Mitsuba's path tracer, with the same sampler, film and number of bounces."""
        # Russian roulette starts beyond the last bounce: it would only add noise to so few.
        integrator = mi.load_dict(
            {"type": "path", "max_depth": self._settings.bounces + 2, "rr_depth": 1 << 20}
        )
        self._look_from(frame)

        def radiance(sampler: Any, ray: Any) -> tuple[Any, Any]:
            L, _, _ = integrator.sample(self.view.scene, sampler, ray)
            return L, mi.UInt32(0)

        s = self._settings
        seed = self._shade_seed(frame)
        image, _ = render_image(self.view.sensor, self._rfilter, self.view.size, s.spp, seed, radiance)
        return Frame(image, 0, 0)

    def _look_from(self, frame: int) -> None:
        set_pose(self.view.sensor, self._poses[frame])

    def _shade_seed(self, frame: int) -> int:
        """Of the samples that light a frame, and of the audit that walks the same paths."""
        return seed_of(self._settings.seed, _SHADE, frame)
