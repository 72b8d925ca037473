"""What a sensor sees that the cache cannot answer, and filling the cache for one view."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import mitsuba as mi
from steadylight.cache.placement import thin
from steadylight.cache.records import Records
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.image.reconstruction import (
    Samples,
    camera_rays,
    make_sampler,
    samples_of_image,
    seed_of,
)
from steadylight.renderers.mitsuba.light.emitters import (
    EmitterSampling,
    GridEmitterSampling,
    record_emitter_sampling,
    walk,
)
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.memory import MISSES_AT_ONCE
from steadylight.renderers.mitsuba.paths.misses import MissList
from steadylight.renderers.mitsuba.paths.shading import Shade, trace
from steadylight.renderers.mitsuba.quality import MitsubaQuality
from steadylight.renderers.mitsuba.records.filling import SHORTEST, Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Gather, GatherContext
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.obstacles import Trust
from steadylight.renderers.mitsuba.records.secondary import secondary_cache
from steadylight.renderers.mitsuba.scene import field_of_view, set_pose
from steadylight.renderers.mitsuba.upload import upload

SPARSE = (512, 4096, 32768)
"""Pixels looked through before every pixel is, when a cache is made from nothing."""

WALK_RAYS = 2048
WALK_CAMERAS = 16
"""Random walks that tell where gather rays end: how many from each camera, and cameras along the path at most."""

FULL_ROUNDS = 3
"""Times that every pixel is looked through, each time elsewhere in the pixel."""


class Answers(Protocol):
    """What can be asked as a cache can."""

    def weight(self, position: Any, normal: Any, longest: Any, active: Any) -> Any:
        """See `DeviceCache.weight`."""


class Missed(NamedTuple):
    """Points that the cache could not answer."""

    points: Points
    looked_up: int  # rays
    missed: int  # points, of which some may have been left out as too close to others

    @classmethod
    def concatenate(cls, parts: Sequence[Missed]) -> Missed:
        """All that several looks missed."""
        points = Points.concatenate([part.points for part in parts])
        return cls(points, sum(part.looked_up for part in parts), sum(part.missed for part in parts))


class View:
    """A sensor in a scene; the sensor may be moved between calls."""

    def __init__(
        self,
        scene: Any,
        sensor: Any,
        size: tuple[int, int],
        depth: int,
        quality: MitsubaQuality,
        longest: float = np.inf,
    ) -> None:
        """Prepare to trace.

        Args:
            scene: mi.Scene.
            sensor: mi.Sensor.
            size: width and height, pixels.
            depth: most non-diffuse interactions of a path.
            quality: budgets and tolerances.
            longest: no radius is longer, metres.
        """
        self.scene = scene
        self.sensor = sensor
        self.size = size
        self.quality = quality
        self.longest = longest
        self.bsdfs = BSDFTraits(scene)
        self.environment = Environment(scene)
        self.depth = dr.opaque(mi.UInt32, depth)
        self._lights: tuple[DeviceCache | None, EmitterSampling] | None = None

    def rays_through(self, film: NDArray[np.float32], seed: int) -> tuple[Any, Any]:
        """Camera rays through (Q, 2) film positions in [0, 1)², and the sampler that goes with them."""
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), len(film))
        position = upload(mi.Point2f, film)
        ray, _ = self.sensor.sample_ray(0.0, sampler.next_1d(), position, sampler.next_2d())
        return sampler, ray

    def trace(self, sampler: Any, ray: Any, cache: DeviceCache | None, *, layered: bool = False) -> Shade:
        """Light camera rays; see `transport.trace`."""
        emitters = self.prepare(cache)
        return trace(
            self.scene,
            sampler,
            ray,
            cache,
            emitters,
            self.environment,
            self.bsdfs,
            self.depth,
            layered=layered,
        )

    def prepare(self, cache: DeviceCache | None) -> EmitterSampling:
        """Learn which emitters matter where; before rays are made, or the first frame gets a kernel of its own."""
        if self._lights is None or self._lights[0] is not cache:
            parts = () if cache is None else cache.parts
            self._lights = (cache, record_emitter_sampling(self.scene, parts, self.environment))
        return self._lights[1]

    def demand(self) -> Trust:
        """How near a record must have been made to be trusted, seen from where the sensor is."""
        fov = field_of_view(self.sensor)
        pixel = 2 * np.tan(np.radians(fov) / 2) / self.size[0]
        extent = diagonal(self.scene)
        eye = mi.Point3f(self.sensor.world_transform().translation())
        dr.make_opaque(eye)
        return Trust(
            eye,
            dr.opaque(mi.Float, self.quality.records.minimum_spacing * pixel),
            dr.opaque(mi.Float, SHORTEST * extent),
            dr.opaque(mi.Float, min(self.quality.records.maximum_spacing * extent, self.longest)),
        )

    def missed_through(
        self, film: NDArray[np.float32], cache: Answers, seed: int
    ) -> tuple[Points, NDArray[np.uint32]]:
        """What the cache is not to be trusted with on paths through (Q, 2) film positions in [0, 1)².

        Returns:
            The points, and for each the row of the film position whose path met it.
        """
        return self.missed(lambda: self.rays_through(film, seed), cache, len(film), self.demand())

    def missed_in_pixels(self, cache: DeviceCache, seed: int) -> Missed:
        """What the cache is not to be trusted with on one path through every pixel."""
        lanes = self.size[0] * self.size[1]
        sampler = make_sampler(1)

        def rays() -> tuple[Any, Any]:
            sampler.seed(dr.opaque(mi.UInt32, seed), lanes)
            ray, _ = camera_rays(self.sensor, sampler, self.size, dr.arange(mi.UInt32, lanes))
            return sampler, ray

        points, _ = self.missed(rays, cache, lanes, self.demand())
        return Missed(points, lanes, len(points.position))

    def missed_in_image(self, cache: DeviceCache, spp: int, seed: int, border: int) -> Missed:
        """What the cache cannot answer when an image is rendered with these arguments; see `film.render_image`."""
        parts = []
        for samples in samples_of_image(self.size, spp, seed, border):
            for pass_seed in samples.seeds:
                rays = partial(self._rays_of, samples, pass_seed)
                points, _ = self.missed(rays, cache, samples.lanes)
                parts.append(Missed(points, samples.lanes, len(points.position)))
        return Missed.concatenate(parts)

    def _rays_of(self, samples: Samples, seed: int) -> tuple[Any, Any]:
        """The sampler and the camera rays of one pass."""
        ray, _ = samples.rays(self.sensor, self.size, seed)
        return samples.sampler, ray

    def missed(
        self,
        rays: Callable[[], tuple[Any, Any]],
        cache: Answers,
        lanes: int,
        demand: Trust | None = None,
    ) -> tuple[Points, NDArray[np.uint32]]:
        """What finds no answer on paths from the camera.

        Args:
            rays: makes a seeded sampler and Ray3f; called again if there are more points than room for them.
            cache: is asked.
            lanes: how many rays.
            demand: when its answer is not to be trusted; None if any answer will do.

        Returns:
            The points, by path and then along it, and the number of each one's path.
        """
        room = min(4 * lanes, MISSES_AT_ONCE)
        while True:
            sampler, ray = rays()
            found = MissList(room)
            seen = trace(
                self.scene, sampler, ray, cache, None, self.environment, self.bsdfs, self.depth, demand, found
            )
            dr.eval(seen.missed)
            if found.count <= room:
                *arrays, path = found.read()
                return Points(*arrays), path
            room = found.count


def make_filler(view: View, poses: Sequence[Pose], bounces: int) -> Filler:
    """What makes records along a camera path, with all that makes the gather quiet.

    Random walks from cameras spread over the path tell where gather rays will end; there the emitter choice and the
    secondary cache are prepared.

    Args:
        view: its sensor is moved.
        poses: all camera poses of the film.
        bounces: indirect diffuse bounces.
    """
    cameras = min(WALK_CAMERAS, len(poses))
    chosen = sorted({round(k * (len(poses) - 1) / max(cameras - 1, 1)) for k in range(cameras)})
    sobol = qmc.Sobol(2, rng=np.random.default_rng(0))
    parts = []
    for number in chosen:
        set_pose(view.sensor, poses[number])
        _, ray = view.rays_through(draw(sobol, WALK_RAYS), number)
        parts.append(np.stack([np.array(ray.o).T, np.array(ray.d).T]))
    o, d = np.concatenate(parts, axis=1)
    rays = mi.Ray3f(upload(mi.Point3f, o), upload(mi.Vector3f, d))
    position, normal = walk(view.scene, rays, WALK_RAYS * len(chosen))
    points = Points(position, normal, np.full(len(position), np.inf, np.float32))
    quality = view.quality
    bounds = RadiusBounds(poses, view.size[0], diagonal(view.scene), quality.secondary)
    context = GatherContext(view.environment, GridEmitterSampling(view.scene, position, normal))
    secondary = secondary_cache(Gather(view.scene, quality.secondary, bounces, context), points, bounds)
    gather = Gather(view.scene, quality.records, bounces, context._replace(secondary=secondary))
    bounds = RadiusBounds(poses, view.size[0], diagonal(view.scene), quality.records, view.longest)
    return Filler(gather, bounds)


def diagonal(scene: Any) -> float:
    """Length of the diagonal of the scene's bounding box, metres."""
    box = scene.bbox()
    return float(np.linalg.norm(np.array(box.max) - np.array(box.min)))


def fill_view(view: View, filler: Filler, cache: DeviceCache, seed: int) -> DeviceCache:
    """The cache with private records wherever this view misses: sparse pixels first if it is empty, then all."""
    width, height = view.size
    sobol = qmc.Sobol(2, rng=np.random.default_rng(seed))
    if len(cache.records) == 0:
        for number, pixels in enumerate(n for n in SPARSE if 2 * n < width * height):
            points, _ = view.missed_through(draw(sobol, pixels), cache, seed_of(seed, 1, number))
            cache = _filled(filler, cache, points, seed_of(seed, 2, number))
    for number in range(FULL_ROUNDS):
        missed = view.missed_in_pixels(cache, seed_of(seed, 3, number))
        if missed.missed == 0:
            break
        cache = _filled(filler, cache, missed.points, seed_of(seed, 4, number))
    return cache


def _filled(filler: Filler, cache: DeviceCache, points: Points, seed: int) -> DeviceCache:
    if len(points.position) == 0:
        return cache
    made = filler.fill(thinned(points, filler.bounds), seed)
    return DeviceCache(Records.concatenate(cache.records, made))


def thinned(points: Points, bounds: RadiusBounds) -> Points:
    """Without points so close to another that one record answers both, as a rule."""
    return points.take(thin_rows(points, bounds))


def thin_rows(points: Points, bounds: RadiusBounds) -> NDArray[np.intp]:
    """Rows of the points that `thinned` keeps: the most demanding of each cell."""
    order = np.argsort(points.longest, kind="stable")
    if len(order) == 0:
        return order
    points = points.take(order)
    return order[thin(points.position, points.normal, bounds.at(points.position).smallest / 2)]


def draw(sobol: qmc.Sobol, count: int) -> NDArray[np.float32]:
    """The next `count` points of a Sobol sequence in [0, 1)²."""
    with warnings.catch_warnings():
        # Balance holds for powers of two; the number of base rays is the user's.
        warnings.simplefilter("ignore", UserWarning)
        return np.minimum(sobol.random(count), np.float32(1 - 2**-24)).astype(np.float32)
