"""What the tasks of a run do on Mitsuba: first pass, coverage audit, filling, frames, path-traced frames."""

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
from steadylight.cache.placement import answered_weight, counts, divided, least_nearby
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import smooth
from steadylight.cache.stretching import answerable, stretched
from steadylight.camera import Pose
from steadylight.renderers.base import Box, Frame, Surfaces
from steadylight.renderers.mitsuba.coverage import (
    Prepared,
    draw,
    fill_view,
    filler_of,
    make_filler,
    prepare,
    thin_rows,
    thinned,
)
from steadylight.renderers.mitsuba.frame import FrameShader, Shaded
from steadylight.renderers.mitsuba.image.path_tracing import path_traced, path_traced_and_denoised
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling
from steadylight.renderers.mitsuba.paths.audit import Nothing
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
"""First-pass rays between two checks of the stopping rule, at most."""

LEAST_WEIGHT = 1e-6
"""Sum of weights that is an answer in the second pass, with room for rounding."""

# What a seed is for; mixed into it so that no two uses share random numbers.
_SOBOL, _BLOCK, _FIRST, _AUDIT, _FILL, _PRIVATE, _SHADE = range(7)


@dataclass(frozen=True)
class FirstPass:
    """What one selected frame gave: its records, and how many rays hit, missed, or were left to other frames."""

    records: Records
    rays: int
    hits: int
    misses: int
    left: int


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
            poses: camera pose of every frame of the animation, by frame number.
            settings: what decides the bytes.
            partition: of the cache; None if it is in one part.
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
        """Makes records for the whole animation; prepared when the first is needed, unless that was read."""
        if self._shared_filler is None:
            self.use(self.prepare())
        assert self._shared_filler is not None
        return self._shared_filler

    def prepare(self) -> Prepared:
        """Make what all records need; moves the camera."""
        return prepare(self.view, self._along(self._settings.frames), self._bounces)

    def use(self, prepared: Prepared) -> None:
        """Make records by what `prepare` made, here or elsewhere."""
        along = self._along(self._settings.frames)
        self._shared_filler = filler_of(prepared, self.view, along, self._bounces)
        secondary = self._shared_filler.gather.context.secondary
        if self._by_surfaces and isinstance(secondary, DeviceCache):
            self.view.answer_faint(secondary)

    @property
    def _bounces(self) -> int | None:
        return None if self._settings.bounces == "auto" else self._settings.bounces

    def _along(self, frames: Sequence[int]) -> list[Pose]:
        return [self._poses[frame] for frame in frames]

    def load(self, cache: Records | Mapping[str, Records]) -> PartedCache:
        """Bring records to the device: the cache, or parts of it by name."""
        named = {"": cache} if isinstance(cache, Records) else cache
        parts = {name: Part(records) for name, records in named.items()}
        return PartedCache(parts, cube=self._cube)

    def _smooth(self, cache: DeviceCache) -> DeviceCache:
        """A cache with the private records of a frame, its noise smoothed; kept in case the next needs none."""
        if self._smoothed is None or self._smoothed[0] is not cache:
            records = smooth(cache.records, smoothing=self.view.quality.smoothing)
            self._smoothed = (cache, DeviceCache(records).with_fallback())
        return self._smoothed[1]

    # ---- the first pass ------------------------------------------------------------------

    def first_pass(self, frame: int, selected: Sequence[int] = ()) -> FirstPass:
        """Records for a selected frame: Sobol pixels until hits : misses reach the threshold.

        As in the paper (section 3.2.1), the rule is checked only after the base rays. Rays are taken in blocks of
        growing size; within a block, a ray is a miss if it made a record and a hit if another ray's record answers
        it, as if the rays had come one by one.

        Args:
            frame: its number.
            selected: all selected frames, which share out what several of them see; none to leave nothing to others,
                as published. What is left counts neither as hit nor as miss.
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
        """New records, so that rays through `film` find an answer wherever they ask that is not left to other frames.

        Returns:
            The records; how many rays made one; and how many made none and lack only points left to other frames.
        """
        points, ray = self.view.missed_through(film, DeviceCache(records), seed)
        points = points.asking_alike()
        mine = wanted(points)
        made = self.filler.fill(points.take(mine), seed_of(seed, _FIRST))
        # A path that meets several diffuse surfaces may make several records: it is one miss all the same.
        makers = np.unique(ray[mine])
        return made, min(len(made), len(makers)), len(np.setdiff1d(ray[~mine], makers))

    # ---- the first pass by surfaces ------------------------------------------------------

    def look(self, frames: Sequence[int]) -> Missed:
        """What some frames look up: one path through every pixel, thinned to what one record answers, as a rule."""
        s = self._settings
        parts: list[Missed] = []
        for frame in frames if s.bounces else ():
            self._look_from(frame)
            seen = self.view.missed_in_pixels(Nothing(), seed_of(s.seed, _AUDIT, frame))
            parts.append(seen._replace(points=thinned(seen.points, self._bounds)))
        found = Missed.concatenate(parts)
        return found._replace(points=thinned(found.points, self._bounds))

    def fill_box(self, found: Sequence[Points], box: Box) -> tuple[Records, int]:
        """Records that answer all that was looked up in a box of space.

        Args:
            found: points of each window in the part of the box, in a fixed order.
            box: no two share random numbers.

        Returns:
            The records, in Morton order, and how many points they answer.
        """
        points = Points.concatenate(found)
        points = points.take(divided(points.position, box.count) == box.number)
        if len(points.position) == 0:
            return Records.empty(), 0
        smallest = self._bounds.of(points).smallest
        points = points._replace(smallest=least_nearby(points.position, points.normal, smallest))
        points = thinned(points, self._bounds)
        seed = seed_of(self._settings.seed, _FILL, 0, box.part, box.number)
        made = self.filler.fill_adaptively(points, seed, self.view.quality.smoothing)
        return made.take(canonical_order(made)), len(points.position)

    def stretch(self, found: Sequence[Points], records: Records) -> tuple[Records, int]:
        """A smoothed part of the cache, and stretched records for the points of the last audit that it still misses.

        Args:
            found: points that it missed in each window.
            records: the part; those of it that were made since answer too.

        Returns:
            All records, in Morton order, and how many look-ups the stretched ones answer.
        """
        points = Points.concatenate(found)
        left = points.take(answered_weight(points.position, points.normal, points.longest, records) <= 0)
        if len(left.position) == 0:
            return records, 0
        # The smallest radius that the camera path asks for, whichever path missed the point: if a reflection, which
        # asks for coarse records, chose the radius, the record would also answer where measured records do.
        radius = self._bounds.at(left.position).smallest
        whole = Records.concatenate(records, stretched(left.position, left.normal, radius, records))
        return whole.take(canonical_order(whole)), len(left.position)

    def worth_records(self, found: Sequence[Points], records: Records, samples: int) -> Points:
        """The points that the last audit missed and that are worth a record; stretched records answer for the others.

        A point is worth a record if no record further off can answer it, or if at least `SurfaceQuality.enough` missed
        look-ups share its cell, about as wide as the smallest radius there. If too many points are left for stretched
        records (`SurfaceQuality.stretched`), those in the fullest cells are worth one too.

        Args:
            found: points that it missed in each window.
            records: of the part.
            samples: camera samples that they stand for.

        Returns:
            Points as `fill` takes them.
        """
        points = Points.concatenate(found)
        surfaces = self.view.quality.surfaces
        crowd = counts(points.position, points.normal, self._bounds.of(points).smallest)
        worth = (crowd >= surfaces.enough) | ~answerable(points.position, points.normal, records)
        excess = int(np.count_nonzero(~worth) - surfaces.stretched * samples)
        if excess > 0:
            others = np.flatnonzero(~worth)
            worth[others[np.argsort(-crowd[others], kind="stable")[:excess]]] = True
        return points.take(worth)

    # ---- the coverage audit --------------------------------------------------------------

    def audit(self, frames: Sequence[int], cache: DeviceCache, *, last: bool) -> Missed:
        """Look along some frames for what the cache cannot answer.

        Args:
            frames: their numbers.
            cache: as it is so far.
            last: walk the very paths that will light the frames, and find every point without an answer. Otherwise
                walk one path in every pixel, and probe for obstacles: long radii are not trusted near them.
        """
        s = self._settings
        parts: list[Missed] = []
        for frame in frames if s.bounces else ():
            self._look_from(frame)
            if last:
                # In the picture, any weight is an answer. By frames, where every miss makes a record, ask for more.
                least = LEAST_WEIGHT if self._by_surfaces else ANSWERED
                missed = self.view.missed_in_image(cache, s.spp, self._shade_seed(frame), least)
            else:
                missed = self.view.missed_in_pixels(cache, seed_of(s.seed, _AUDIT, frame))
                missed = missed._replace(points=thinned(missed.points.asking_alike(), self._bounds))
            parts.append(missed)
        found = Missed.concatenate(parts)
        return found if last else found._replace(points=thinned(found.points, self._bounds))

    def fill(self, found: Sequence[Points], records: Records, number: int, part: int = 0) -> Records:
        """The records, and new ones that answer the points which the audits of a round found.

        Args:
            found: points of each audit, in a fixed order.
            records: the part of the cache that was audited.
            number: of the round.
            part: its number; no two parts share random numbers.
        """
        points = Points.concatenate(found)
        made = [records]
        if len(points.position) == 0:
            return records  # without preparing the filler, which takes a while
        filler = self.filler
        if self._by_surfaces:
            filler = filler.with_fewer_paths(self.view.quality.surfaces.added)
        # One record mostly answers all points of a cell. Where it does not, as behind a corner, another is made.
        while len(points.position):
            seed = seed_of(self._settings.seed, _FILL, number, part, len(made))
            rows = thin_rows(points, self._bounds)
            new = filler.fill(points.take(rows), seed)
            made.append(new)
            waiting = answered_weight(points.position, points.normal, points.longest, new) < ANSWERED
            waiting[rows] = False
            points = points.take(waiting)
        whole = Records.concatenate(*made)
        return whole.take(canonical_order(whole))

    # ---- the second pass -----------------------------------------------------------------

    def shade(self, frame: int, cache: DeviceCache | None) -> Frame:
        """A whole frame.

        Args:
            frame: its number.
            cache: the smoothed cache with `coverage` full; the merged records of the first pass with `coverage`
                off. None makes a private cache for this frame alone (single-pass).

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
            # A frame rendered alone knows nothing of the rest of the animation.
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
            # The audit walked these very paths; but on another kind of machine they may end a hair from there.
            shaded = self._shader.shade(cache.with_fallback(), self._shade_seed(frame))
        return shaded

    def path(self, frame: int) -> Frame:
        """A whole frame by Mitsuba's path tracer, with the same number of bounces; the same filter, unless denoised."""
        bounces = self._settings.bounces
        # Russian roulette starts beyond the last bounce: it would only add noise to so few.
        depths = {"max_depth": -1} if bounces == "auto" else {"max_depth": bounces + 2, "rr_depth": 1 << 20}
        # `path` ends shadow rays at panes that light goes straight through; `volpath` does not.
        kind = "volpath" if self.view.panes.some else "path"
        integrator = mi.load_dict({"type": kind, **depths})
        self._look_from(frame)
        sampling = Sampling(self._settings.spp, self._shade_seed(frame))
        where = (self.view.scene, self.view.camera)
        if self._settings.denoise:
            return Frame(path_traced_and_denoised(*where, integrator, sampling, self._shader.denoiser))
        return Frame(path_traced(*where, integrator, sampling))

    def surfaces(self, frame: int) -> Surfaces:
        """What the centre of each pixel of a frame sees."""
        self._look_from(frame)
        return self.view.surfaces(self._poses[frame])

    def asked(self, frame: int, pixel: tuple[int, int]) -> tuple[Floats, Floats]:
        """Positions and normals at which the path through the middle of a pixel asks the cache, in its order."""
        self._look_from(frame)
        column, row = pixel
        s = self._settings
        film = np.array([[(column + 0.5) / s.width, (row + 0.5) / s.height]], np.float32)
        points, _ = self.view.missed(
            lambda: self.view.rays_through(film, self._shade_seed(frame)), Nothing(), 1, least=ANSWERED
        )
        return points.position, points.normal

    def _look_from(self, frame: int) -> None:
        self.view.camera.look(self._poses[frame])

    def _shade_seed(self, frame: int) -> int:
        """Of the samples that light a frame, and of the audit that walks the same paths."""
        return seed_of(self._settings.seed, _SHADE, frame)
