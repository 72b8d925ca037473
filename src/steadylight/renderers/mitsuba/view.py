"""A camera in a scene: its light paths, and the points on them that the cache does not cover."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.lookup import ANSWERED
from steadylight.cache.records import Records
from steadylight.camera import Pose
from steadylight.renderers.base import Surfaces
from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.image.pixels import Camera, Pass, Rows, passes
from steadylight.renderers.mitsuba.light.emitters import EmitterSampling, EmitterTable, Sites
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.grid import GridEmitterSampling
from steadylight.renderers.mitsuba.light.panes import Panes
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.memory import MISSES_AT_ONCE
from steadylight.renderers.mitsuba.paths.audit import Audit, note_misses
from steadylight.renderers.mitsuba.paths.branches import PathLimits
from steadylight.renderers.mitsuba.paths.misses import MissList
from steadylight.renderers.mitsuba.paths.shading import Shade, shade
from steadylight.renderers.mitsuba.quality import MitsubaQuality
from steadylight.renderers.mitsuba.records.filling import SHORTEST, Points
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.obstacles import Trust
from steadylight.renderers.mitsuba.sampling import Samples, samples_of
from steadylight.renderers.mitsuba.scene import field_of_view
from steadylight.renderers.mitsuba.upload import download, upload

Rays = Callable[[], tuple[Samples, "mi.Ray3f"]]
"""Generates random numbers and camera rays."""


class Missed(NamedTuple):
    """Look-ups that missed.

    Attributes:
        points: where.
        looked_up: number of camera rays.
        missed: number of points, including those that thinning has removed from `points`.
    """

    points: Points
    looked_up: int
    missed: int

    @classmethod
    def concatenate(cls, parts: Sequence[Missed]) -> Missed:
        """The misses of several searches together."""
        points = Points.concatenate([part.points for part in parts])
        return cls(points, sum(part.looked_up for part in parts), sum(part.missed for part in parts))


class View:
    """A camera in a scene; the camera may be moved between calls.

    Attributes:
        scene: mi.Scene.
        camera: in that scene.
        quality: budgets and tolerances.
        bsdfs: of the scene.
        environment: of the scene.
        panes: of the scene.
        limits: how far paths are followed.
        longest: upper bound of every record's radius, metres.
        weakest: throughput below which the requested radius no longer grows; 1 if it does not depend on throughput.
        still: the scene never changes.
    """

    def __init__(
        self, scene: mi.Scene, camera: Camera, depth: int, quality: MitsubaQuality, longest: float = np.inf
    ) -> None:
        """Prepare to trace.

        Args:
            scene: mi.Scene.
            camera: in that scene.
            depth: maximum number of non-diffuse interactions of a path.
            quality: budgets and tolerances.
            longest: upper bound of every record's radius, metres.
        """
        self.scene, self.camera, self.quality, self.longest = scene, camera, quality, longest
        self.weakest, self.still = 1.0, True
        self.bsdfs = BSDFTraits(scene)
        self.environment = Environment(scene)
        self.panes = Panes(scene, self.bsdfs if quality.panes == "straight" else None)
        self.limits = PathLimits(depth, quality.shading)
        self._secondary: DeviceCache | None = None
        self._secondary_emitters: EmitterTable | None = None
        self._emitters: dict[bool, EmitterSampling] = {}
        self._unlit = self.lit_by(self._emitter_sampling(whole=False))
        self._lit: tuple[DeviceCache | None, Lighting] | None = None

    def lit_by(self, emitters: EmitterSampling, samples: int | None = None) -> Lighting:
        """What kernels need of the scene, with a given emitter sampling.

        Args:
            emitters: which emitter to sample where.
            samples: emitter samples at the vertices where they matter most; the number for frames if None.
        """
        count = self.quality.shading.emitter_samples if samples is None else samples
        parts = (self.bsdfs, self.environment, emitters, count)
        return Lighting(self.scene, *parts, still=self.still)

    def lighting(self, cache: DeviceCache | None) -> Lighting:
        """Measure which emitters matter where. Call before making rays, or the first frame compiles its own kernel."""
        if self._lit is None or self._lit[0] is not cache:
            # Without a cache, all of the environment is direct light.
            emitters = self._emitter_sampling(whole=cache is None)
            parts = () if cache is None else cache.parts
            for part in parts:
                if part.emitters is None:
                    sites = Sites(part.records.position, part.records.normal, part.records.radius)
                    part.emitters = emitters.measure(sites, self.quality.shading.emitter_rays)
            tables = [part.emitters for part in parts if part.emitters is not None]
            if cache is not None and self._secondary is not None:
                self.limits = self.limits.answered(self._secondary, len(cache.records))
                tables.append(self._measured_at_secondary(emitters))
            emitters.use(tables)
            self._lit = (cache, self.lit_by(emitters))
        return self._lit[1]

    def arrays(self, cache: DeviceCache | None) -> list[object]:
        """All that a kernel of `shade` reads besides the camera, for `frozen`."""
        answers = [] if cache is None else cache.arrays()
        lighting = self.lighting(cache).arrays()  # decides the limits
        return [*self.limits.state(), lighting, answers]

    def ask_by_worth(self, bounces: int | str) -> None:
        """Let a path's throughput decide the radius it requests at a surface, and whether it looks up records at all.

        Args:
            bounces: of the run. With one, the secondary cache holds no bounce, so every surface is looked up.
        """
        surfaces = self.quality.surfaces
        self.weakest = surfaces.weakest
        if bounces not in (0, 1) and self.bsdfs.glossy:
            self.limits = self.limits.asking(surfaces.faint)

    def answer_faint(self, secondary: DeviceCache) -> None:
        """Use the secondary cache for surfaces seen faintly by glossy reflection, if these look up no records."""
        if self.limits.faint[0] > 0:
            self._secondary, self._secondary_emitters, self._lit = secondary, None, None

    def _measured_at_secondary(self, emitters: EmitterSampling) -> EmitterTable:
        """The emitter table of the secondary records, measured once."""
        if self._secondary_emitters is None:
            assert self._secondary is not None
            records = self._secondary.records
            sites = Sites(records.position, records.normal, records.radius)
            self._secondary_emitters = emitters.measure(sites, self.quality.shading.emitter_rays)
        return self._secondary_emitters

    def gather_emitters(self) -> GridEmitterSampling:
        """Emitter sampling for a gather: it shares the patches, which are made once, and has its own tables."""
        return copy.copy(self._grid)

    @cached_property
    def _grid(self) -> GridEmitterSampling:
        return GridEmitterSampling(self.scene, self.environment, self.panes)

    @cached_property
    def _no_records(self) -> DeviceCache:
        return DeviceCache(Records.empty())

    def _emitter_sampling(self, *, whole: bool) -> EmitterSampling:
        """Emitter sampling of the scene; its patches are made once."""
        if whole not in self._emitters:
            self._emitters[whole] = EmitterSampling(self.scene, self.environment, self.panes, whole=whole)
        return self._emitters[whole]

    def rays_through(self, film: NDArray[np.float32], seed: int) -> tuple[Samples, mi.Ray3f]:
        """Random numbers and camera rays through (Q, 2) film positions in [0, 1)²."""
        lane = dr.arange(mi.UInt32, len(film))
        samples = samples_of(dr.opaque(mi.UInt32, seed), lane, mi.UInt32(0))
        return samples, self.camera.rays(samples, upload(mi.Point2f, film))

    def shade(
        self, samples: Samples, ray: mi.Ray3f, cache: DeviceCache | None, *, layered: bool = False
    ) -> Shade:
        """Light camera rays; see `paths.shading`."""
        lighting = self.lighting(cache)  # decides the limits
        return shade(lighting, samples, ray, cache, self.limits, layered)

    def rest(self, samples: Samples, ray: mi.Ray3f, cache: DeviceCache | None, *, many: bool) -> mi.Color3f:
        """Another estimate of `Layers.rest`, along paths that were not audited: the secondary cache replaces records.

        Args:
            samples: random numbers of camera rays.
            ray: camera rays.
            cache: of the frame; not looked up.
            many: the pixel takes many samples; see `PathLimits.unrecorded`. The mean is the same.
        """
        lighting = self.lighting(cache)  # decides the limits
        found = shade(lighting, samples, ray, cache, self.limits.unrecorded(many=many), True)
        return found.radiance.rest

    def surfaces(self, pose: Pose) -> Surfaces:
        """The first surface at the centre of each pixel; the camera must be at `pose`."""
        width, height = self.camera.size
        rows, columns = np.divmod(np.arange(width * height), width)
        film = np.stack([(columns + 0.5) / width, (rows + 0.5) / height], axis=-1).astype(np.float32)
        ray = self.camera.rays(self.rays_through(film[:1], 0)[0], upload(mi.Point2f, film))
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, True, mi.Bool(True))
        normal = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n)
        hit = np.array(si.is_valid()).reshape(height, width)
        position, facing = (np.array(v).T.reshape(height, width, 3) for v in (si.p, normal))
        depth = (position - pose.origin) @ pose.direction
        return Surfaces(
            position=np.where(hit[..., None], position, 0).astype(np.float32),
            normal=np.where(hit[..., None], facing, 0).astype(np.float32),
            depth=np.where(hit, depth, np.inf).astype(np.float32),
        )

    def trust(self) -> Trust:
        """Bounds on the radius of records that may be trusted or are requested, for look-ups from this camera."""
        records = self.quality.records
        fov = field_of_view(self.camera.sensor)
        pixel = 2 * np.tan(np.radians(fov) / 2) / self.camera.width
        extent = diagonal(self.scene)
        eye = mi.Point3f(self.camera.sensor.world_transform().translation())
        dr.make_opaque(eye)
        return Trust(
            eye,
            dr.opaque(mi.Float, records.minimum_spacing * pixel),
            dr.opaque(mi.Float, SHORTEST * extent),
            dr.opaque(mi.Float, min(records.maximum_spacing * extent, self.longest)),
            dr.opaque(mi.Float, self.weakest),
        )

    def missed_through(
        self, film: NDArray[np.float32], cache: DeviceCache, seed: int
    ) -> tuple[Points, NDArray[np.uint32]]:
        """Points without a trusted record on paths through (Q, 2) film positions in [0, 1)².

        Returns:
            The points, and for each the row of the film position whose path met it.
        """
        return self.missed(lambda: self.rays_through(film, seed), cache, len(film))

    def missed_in_pixels(self, cache: DeviceCache | None, seed: int) -> Missed:
        """Points without a trusted record on one path through every pixel; all look-up points if there is no cache."""
        lanes, height = self.camera.pixels, self.camera.size[1]
        whole = Pass(Rows((0, height), (0, height)), 0, 1, True)
        points, _ = self.missed(partial(self._rays_of, whole.rays, seed), cache, lanes)
        return Missed(points, lanes, len(points.position))

    def missed_in_image(self, cache: DeviceCache, spp: int, seed: int, least: float = ANSWERED) -> Missed:
        """Misses when a picture is rendered with these samples; see `image.pixels`.

        Args:
            cache: the cache.
            spp: samples per pixel.
            seed: of the picture.
            least: sum of weights that counts as a hit.
        """
        parts = []
        for part in passes(self.camera, spp, 0):
            lanes = part.lanes(self.camera)
            points, _ = self.missed(partial(self._rays_of, part.rays, seed), cache, lanes, least=least)
            parts.append(Missed(points, lanes, len(points.position)))
        return Missed.concatenate(parts)

    def _rays_of(
        self, rays: Callable[[Camera, int], tuple[Samples, mi.Ray3f, mi.Point2f]], seed: int
    ) -> tuple[Samples, mi.Ray3f]:
        samples, ray, _ = rays(self.camera, seed)
        return samples, ray

    def missed(
        self,
        rays: Rays,
        cache: DeviceCache | None,
        lanes: int,
        trust: Trust | None = None,
        *,
        least: float | None = None,
    ) -> tuple[Points, NDArray[np.uint32]]:
        """Points on paths from the camera that the cache does not cover.

        Args:
            rays: called again if there are more points than the list has room for.
            cache: the cache; None for an empty one: all points are then found.
            lanes: number of rays.
            trust: which records are trusted; those of this view if None.
            least: sum of weights that counts as a hit, whether trusted or not; None to count trusted records only.

        Returns:
            The points, ordered by path and along it, and the number of each point's path.
        """
        room = min(4 * lanes, MISSES_AT_ONCE)
        while True:
            samples, ray = rays()
            found = MissList(room)
            asked = Audit(
                self._no_records if cache is None else cache,
                trust or self.trust(),
                found,
                probed=least is None,
                least=ANSWERED if least is None else least,
            )
            note_misses(self._unlit, samples, ray, asked, self.limits)
            if found.count <= room:
                *arrays, path = found.read()
                return Points.of_look_ups(*arrays), path
            room = found.count


def on_host(ray: mi.Ray3f, count: int) -> NDArray[np.float32]:
    """Origins and directions of `count` rays, (2, count, 3); an orthographic sensor has a single direction."""
    dr.eval(ray.o, ray.d)
    return np.stack([np.broadcast_to(download(part), (count, 3)) for part in (ray.o, ray.d)])


def diagonal(scene: mi.Scene) -> float:
    """Length of the diagonal of the scene's bounding box, metres."""
    box = scene.bbox()
    return float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
