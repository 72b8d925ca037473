"""The tasks of a run on Mitsuba: first pass, coverage audit, filling, shaded frames, path-traced frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from steadylight.cache.lookup import ANSWERED
from steadylight.cache.merge import canonical_order
from steadylight.cache.partition import Partition
from steadylight.cache.placement import answered_weight, rows_in_box, totals
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import smooth
from steadylight.cache.stretching import answerable, stretched
from steadylight.camera import Pose
from steadylight.quality import FEW_FRAMES
from steadylight.renderers.base import Box, Frame, Surfaces
from steadylight.renderers.mitsuba.coverage import (
    Prepared,
    answering_cache,
    draw,
    fill_view,
    filler_of,
    make_filler,
    prepare,
    thin_rows,
    thinned,
    worth_look_ups,
)
from steadylight.renderers.mitsuba.frame import FrameShader, Shaded
from steadylight.renderers.mitsuba.image.path_tracing import path_traced, path_traced_and_denoised
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling
from steadylight.renderers.mitsuba.memory import POINTS_AT_ONCE
from steadylight.renderers.mitsuba.quality import quality_of
from steadylight.renderers.mitsuba.records.assignment import left_to_others
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.lookup import DeviceCache, Part, PartedCache
from steadylight.renderers.mitsuba.sampling import seed_of
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
from steadylight.renderers.mitsuba.view import Missed, View, diagonal
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

LARGEST_BLOCK = 1 << 15
"""Maximum number of first-pass rays between two checks of the stopping rule."""

LEAST_WEIGHT = 1e-6
"""Sum of weights that counts as a hit in the second pass, with a margin for rounding."""

# Purposes of a seed, mixed into it so that no two uses share random numbers.
_SOBOL, _BLOCK, _FIRST, _AUDIT, _FILL, _PRIVATE, _SHADE = range(7)


@dataclass(frozen=True)
class FirstPass:
    """Result of one selected frame: its records, and how many rays hit, missed, or were left to other frames."""

    records: Records
    rays: int
    hits: int
    misses: int
    left: int


class Renderer:
    """Renders one scene along one camera path; built once per process and used for many tasks."""

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
            poses: camera pose of every frame of the animation, by frame number.
            settings: the render settings.
            partition: of the cache; None if it is undivided.
        """
        self._cube = None if partition is None else partition.cube
        longest = np.inf if partition is None else partition.radius
        self._settings, self._poses = settings, poses
        self._smoothed: tuple[DeviceCache, DeviceCache] | None = None
        scene = build_scene(description)
        size = (settings.width, settings.height)
        camera = Camera(build_sensor(description, poses[settings.frames[0]], *size), size)
        self._perspective = description.sensor.get("type", "perspective") != "orthographic"
        quality = quality_of(settings)
        self.view = View(scene, camera, settings.depth, quality, longest)
        self._by_surfaces = settings.first_pass == "surface"
        if self._by_surfaces:
            self.view.ask_by_worth(settings.bounces)
        self._shader = FrameShader(self.view, settings.spp, denoise=settings.denoise)
        along = [poses[frame] for frame in settings.frames]
        self._bounds = RadiusBounds(along, settings.width, diagonal(scene), quality.records, longest)
        self._shared_filler: Filler | None = None

    @property
    def filler(self) -> Filler:
        """Makes records for the whole animation; prepared on first use unless `use` was called before."""
        if self._shared_filler is None:
            self.use(self.prepare())
        assert self._shared_filler is not None
        return self._shared_filler

    def prepare(self) -> Prepared:
        """Prepare what all records need; moves the camera."""
        return prepare(self.view, self._along(self._settings.frames), self._bounces)

    def use(self, prepared: Prepared) -> None:
        """Make records with what `prepare` made, here or in another process."""
        along = self._along(self._settings.frames)
        self._shared_filler = filler_of(prepared, self.view, along, self._bounces)
        secondary, caustics = prepared.secondary, self._shared_filler.gather.context.caustics
        if self._by_surfaces and secondary is not None:
            self.view.answer_faint(answering_cache(secondary, caustics))

    @property
    def _bounces(self) -> int | None:
        return None if self._settings.bounces == "auto" else self._settings.bounces

    def _along(self, frames: Sequence[int]) -> list[Pose]:
        return [self._poses[frame] for frame in frames]

    def load(self, cache: Records | Mapping[str, Records]) -> PartedCache:
        """Upload records to the device: the cache, or parts of it by name."""
        named = {"": cache} if isinstance(cache, Records) else cache
        parts = {name: Part(records) for name, records in named.items()}
        return PartedCache(parts, cube=self._cube)

    def _smooth(self, cache: DeviceCache) -> DeviceCache:
        """Smooth a cache with a frame's private records; the result is kept in case the next frame adds none."""
        if self._smoothed is None or self._smoothed[0] is not cache:
            records = smooth(cache.records, smoothing=self.view.quality.smoothing)
            self._smoothed = (cache, DeviceCache(records).with_fallback())
        return self._smoothed[1]

    # ---- the first pass ------------------------------------------------------------------

    def first_pass(self, frame: int, selected: Sequence[int] = ()) -> FirstPass:
        """Records for a selected frame: Sobol' pixels until hits : misses reach the threshold.

        As in the paper (section 3.2.1), the rule is checked only after the base rays. Rays are traced in blocks of
        growing size. Within a block, a ray is a miss if it made a record and a hit if it found another ray's record, as
        if the rays had come one by one.

        Args:
            frame: its number.
            selected: all selected frames, which divide among them what several of them see; empty to leave nothing to
                others, as published. What is left counts neither as hit nor as miss.
        """
        s = self._settings
        _ = self.filler  # preparing it moves the camera
        self._look_from(frame)
        sobol = qmc.Sobol(2, rng=np.random.default_rng(seed_of(s.seed, _SOBOL, frame)))
        others = [self._poses[number] for number in selected] if self._perspective else []
        mine = list(selected).index(frame) if others else 0

        def wanted(points: Points) -> NDArray[np.bool_]:
            """(P,) mask of the points that are not left to other frames."""
            if len(others) < 2 or len(points.position) == 0:
                return np.ones(len(points.position), bool)
            return ~left_to_others(self.view.scene, self.view.bsdfs, points, others, mine, s.width / s.height)

        records = Records.empty()
        rays = misses = left = number = 0
        block = s.base_rays
        limit = 4 * s.width * s.height
        while s.bounces and rays < limit:
            seed = seed_of(s.seed, _BLOCK, frame, number)
            made, missed, to_others = self._answer(draw(sobol, block), records, seed, wanted)
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
        film: NDArray[np.float32],
        records: Records,
        seed: int,
        wanted: Callable[[Points], NDArray[np.bool_]],
    ) -> tuple[Records, int, int]:
        """New records that cover every look-up along rays through `film`, except those left to other frames.

        Returns:
            The records; the number of rays that made one; and the number that made none but left points to others.
        """
        points, ray = self.view.missed_through(film, DeviceCache(records), seed)
        points = points.asking_alike()
        mine = wanted(points)
        made = self.filler.fill(points.take(mine), seed_of(seed, _FIRST))
        # A path that meets several diffuse surfaces may make several records, but counts as one miss.
        makers = np.unique(ray[mine])
        return made, min(len(made), len(makers)), len(np.setdiff1d(ray[~mine], makers))

    # ---- the first pass by surfaces ------------------------------------------------------

    def look(self, frames: Sequence[int]) -> Missed:
        """Look-up points of some frames: one path per pixel, thinned to about one point per record."""
        s = self._settings
        parts: list[Missed] = []
        for frame in frames if s.bounces else ():
            self._look_from(frame)
            parts.append(self.view.missed_in_pixels(None, seed_of(s.seed, _AUDIT, frame)))
            if sum(len(part.points.position) for part in parts) > POINTS_AT_ONCE:
                parts = [self._thinned(parts)]
        return self._thinned(parts)

    def _thinned(self, parts: Sequence[Missed]) -> Missed:
        """The misses of several searches together, thinned."""
        found = Missed.concatenate(parts)
        return found._replace(points=thinned(found.points, self._bounds))

    def fill_box(self, found: Sequence[Points], box: Box) -> tuple[Records, int]:
        """Records that cover all look-up points in a box of space.

        Args:
            found: points of each window in the part that the box belongs to, in a fixed order.
            box: which one; each box has its own random numbers.

        Returns:
            The records, in Morton order, and how many points they cover.
        """
        points = Points.concatenate(found)
        points = points.take(rows_in_box(points.position, box.number, box.count))
        if len(points.position) == 0:
            return Records.empty(), 0
        points = worth_look_ups(points, self._bounds, self._enough_look_ups)
        points = thinned(points, self._bounds)
        seed = seed_of(self._settings.seed, _FILL, 0, box.part, box.number)
        made = self.filler.fill_adaptively(points, seed, self.view.quality.smoothing)
        return made.take(canonical_order(made)), len(points.position)

    @property
    def _enough_look_ups(self) -> float:
        """Look-ups in a square as wide as the smallest radius that are worth records of that radius."""
        quality = self.view.quality
        frames = quality.surfaces.seen_by * min(len(self._settings.frames) / FEW_FRAMES, 1)
        return frames * quality.records.minimum_spacing**2

    def stretch(self, found: Sequence[Points], records: Records) -> tuple[Records, int]:
        """Add stretched records to a smoothed part, for the points of the last audit that it still misses.

        Args:
            found: points that the audit missed in each window.
            records: the part, including records made since that audit.

        Returns:
            All records, in Morton order, and how many look-ups the stretched ones serve.
        """
        points = Points.concatenate(found)
        left = points.take(answered_weight(points.position, points.normal, points.longest, records) <= 0)
        if len(left.position) == 0:
            return records, 0
        # The smallest radius that the camera path asks for, however the point was reached. With the radius of a
        # reflection, which asks for coarse records, the record would also contribute where measured records do.
        radius = self._bounds.at(left.position).smallest
        whole = Records.concatenate(records, stretched(left.position, left.normal, radius, records))
        return whole.take(canonical_order(whole)), len(left.position)

    def worth_records(self, found: Sequence[Points], records: Records, samples: int) -> Points:
        """The points missed by the last audit that are worth a record; stretched records serve the others.

        A point is worth a record if no record can be stretched to reach it, or if at least `SurfaceQuality.enough`
        missed look-ups share its cell, about as wide as the smallest radius there. If too many points remain for
        stretched records (`SurfaceQuality.stretched`), those in the fullest cells are worth one too.

        Args:
            found: points that the audit missed in each window.
            records: of the part.
            samples: camera samples that the points come from.

        Returns:
            Points, as `fill` takes them.
        """
        points = Points.concatenate(found)
        surfaces = self.view.quality.surfaces
        spacing = self._bounds.of(points).smallest
        crowd = totals(points.position, points.normal, spacing, points.number)
        worth = (crowd >= surfaces.enough) | ~answerable(points.position, points.normal, records)
        excess = int(np.count_nonzero(~worth) - surfaces.stretched * samples)
        if excess > 0:
            others = np.flatnonzero(~worth)
            worth[others[np.argsort(-crowd[others], kind="stable")[:excess]]] = True
        return points.take(worth)

    # ---- the coverage audit --------------------------------------------------------------

    def audit(self, frames: Sequence[int], cache: DeviceCache, *, last: bool) -> Missed:
        """Search some frames for points that the cache does not cover.

        Args:
            frames: their numbers.
            cache: the cache so far.
            last: follow exactly the paths that will light the frames, and find every miss. Otherwise, follow one path
                per pixel, and probe for obstacles: records of long radius are not trusted near them.
        """
        s = self._settings
        parts: list[Missed] = []
        for frame in frames if s.bounces else ():
            self._look_from(frame)
            if last:
                # In the picture, any weight is a hit. By frames, where every miss makes a record, require more.
                least = LEAST_WEIGHT if self._by_surfaces else ANSWERED
                missed = self.view.missed_in_image(cache, s.spp, self._shade_seed(frame), least)
            else:
                missed = self.view.missed_in_pixels(cache, seed_of(s.seed, _AUDIT, frame))
                missed = missed._replace(points=thinned(missed.points.asking_alike(), self._bounds))
            parts.append(missed)
        return Missed.concatenate(parts) if last else self._thinned(parts)

    def fill(self, found: Sequence[Points], records: Records, number: int, part: int = 0) -> Records:
        """The records, and new ones that cover the misses of an audit round.

        Args:
            found: misses of each window, in a fixed order.
            records: the part of the cache that was audited.
            number: of the round.
            part: its number; each part has its own random numbers.
        """
        points = Points.concatenate(found)
        made = [records]
        if len(points.position) == 0:
            return records  # without preparing the filler, which is slow
        filler = self.filler
        if self._by_surfaces:
            filler = filler.with_fewer_paths(self.view.quality.surfaces.added)
        # One record usually covers all points of a cell. Where it does not, as around a corner, another is made.
        while len(points.position):
            seed = seed_of(self._settings.seed, _FILL, number, part, len(made))
            rows, _ = thin_rows(points, self._bounds)
            new = filler.fill(points.take(rows), seed)
            made.append(new)
            waiting = answered_weight(points.position, points.normal, points.longest, new) < ANSWERED
            waiting[rows] = False
            points = points.take(waiting)
        whole = Records.concatenate(*made)
        return whole.take(canonical_order(whole))

    # ---- the second pass -----------------------------------------------------------------

    def shade(self, frame: int, cache: DeviceCache | None) -> Frame:
        """Render a whole frame.

        Args:
            frame: its number.
            cache: the smoothed cache with `coverage` full; the merged records of the first pass with `coverage`
                off. None makes a private cache for this frame alone (single-pass).

        Returns:
            The frame. With `coverage` off, or without a cache, misses get private records, which serve this frame
            alone, as in the paper.
        """
        s = self._settings
        self._look_from(frame)
        new_records = 0
        if s.bounces == 0:
            cache = None
        elif cache is None or s.coverage == "off":
            before = cache or self.load(Records.empty())
            # A frame rendered alone must not depend on the rest of the animation.
            alone = cache is None
            filler = make_filler(self.view, self._along([frame]), self._bounces) if alone else self.filler
            self._look_from(frame)
            cache = fill_view(self.view, filler, before, seed_of(s.seed, _PRIVATE, frame))
            new_records = len(cache.records) - len(before.records)
            cache = self._smooth(cache)
        shaded = self._shade(frame, cache)
        return Frame(shaded.image, shaded.missed, new_records, firefly_loss=shaded.firefly_loss)

    def _shade(self, frame: int, cache: DeviceCache | None) -> Shaded:
        shaded = self._shader.shade(cache, self._shade_seed(frame))
        if cache is not None and cache.relaxed is None and shaded.missed:
            # The audit followed these very paths; but on another kind of machine, their hit points may differ slightly.
            shaded = self._shader.shade(cache.with_fallback(), self._shade_seed(frame))
        return shaded

    def path(self, frame: int) -> Frame:
        """Path-trace a frame with Mitsuba, with the same number of bounces and, unless denoised, the same filter."""
        bounces = self._settings.bounces
        # Russian roulette starts beyond the last bounce: with so few bounces, it would only add noise.
        depths = {"max_depth": -1} if bounces == "auto" else {"max_depth": bounces + 2, "rr_depth": 1 << 20}
        # In `path`, panes block shadow rays; in `volpath`, they do not.
        kind = "volpath" if self.view.panes.some else "path"
        integrator = mi.load_dict({"type": kind, **depths})
        self._look_from(frame)
        sampling = Sampling(self._settings.spp, self._shade_seed(frame))
        where = (self.view.scene, self.view.camera)
        if self._settings.denoise:
            return Frame(path_traced_and_denoised(*where, integrator, sampling, self._shader.denoiser))
        return Frame(path_traced(*where, integrator, sampling))

    def surfaces(self, frame: int) -> Surfaces:
        """The surface that the centre of each pixel of a frame sees."""
        self._look_from(frame)
        return self.view.surfaces(self._poses[frame])

    def asked(self, frame: int, pixel: tuple[int, int]) -> tuple[Floats, Floats]:
        """Positions and normals of the cache look-ups along the path through the centre of a pixel, in path order."""
        self._look_from(frame)
        column, row = pixel
        s = self._settings
        film = np.array([[(column + 0.5) / s.width, (row + 0.5) / s.height]], np.float32)
        points, _ = self.view.missed(
            lambda: self.view.rays_through(film, self._shade_seed(frame)), None, 1, least=ANSWERED
        )
        return points.position, points.normal

    def _look_from(self, frame: int) -> None:
        self.view.camera.look(self._poses[frame])

    def _shade_seed(self, frame: int) -> int:
        """Seed of the samples that light a frame, and of the audit that follows the same paths."""
        return seed_of(self._settings.seed, _SHADE, frame)
