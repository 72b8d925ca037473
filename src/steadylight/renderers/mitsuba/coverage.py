"""Filling the cache for what cameras see: the filler for a camera path, and a private cache for a single view."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from steadylight.cache.placement import least_nearby, level_of, thin_and_count, totals
from steadylight.cache.records import Records
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.light.clusters import facing_normal
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.grid import Grid, walk
from steadylight.renderers.mitsuba.records.caustics import CausticMap, with_caustics
from steadylight.renderers.mitsuba.records.filling import Filler, Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Gather
from steadylight.renderers.mitsuba.records.indirect import Secondary
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.photons import FEWEST_PHOTONS, MOST_PHOTONS, Photons, trace_photons
from steadylight.renderers.mitsuba.records.secondary import (
    FINER,
    SecondaryRecords,
    first_bounce,
    secondary_cache,
)
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.sampling import seed_of
from steadylight.renderers.mitsuba.upload import upload
from steadylight.renderers.mitsuba.view import View, diagonal, on_host

SPARSE = (512, 4096, 32768)
"""Pixels searched for misses in the rounds before every pixel is, when the cache is empty at first."""

WALK_RAYS = 2048
WALK_CAMERAS = 16
"""Random walks that sample where gather rays end: number from each camera, and maximum number of cameras."""

FAINT = 0.1
"""Fraction of the median irradiance in the darkest picture that is added to a record's own in the denominator of its
relative error, so that errors of fainter light count by their absolute size. At a tenth of mid-grey, a relative error
spans two fifths of the sRGB steps that it spans at mid-grey."""

_PHOTONS = 5
"""Purpose of a seed; the first ones are those of the secondary cache."""

FULL_ROUNDS = 3
"""Maximum number of rounds through every pixel, each at other positions in the pixels."""


class Prepared(NamedTuple):
    """What reduces the noise of the gather and is slow to make.

    Attributes:
        grid: guides emitter sampling where gather rays end.
        secondary: the secondary cache, without the caustics that photons carry; None if there is no light for it.
        photons: that carry caustics; None if paths from records find these.
        faint: irradiance, W/m²; see `Gather`.
    """

    grid: Grid
    secondary: SecondaryRecords | None
    photons: Photons | None
    faint: float

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays, for a file."""
        named = {f"grid.{name}": array for name, array in self.grid._asdict().items()}
        named["faint"] = np.array([self.faint])
        if self.secondary is not None:
            records, reach = self.secondary
            named |= {f"secondary.{name}": getattr(records, name) for name in Records.SHAPES}
            named["secondary.reach"] = reach
        if self.photons is not None:
            named |= {f"photons.{name}": array for name, array in self.photons._asdict().items()}
        return named

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Prepared:
        """Inverse of `arrays`."""
        grid = Grid(*(arrays[f"grid.{name}"] for name in Grid._fields))
        secondary = photons = None
        if any(name.startswith("secondary.") for name in arrays):
            records = Records(**{name: arrays[f"secondary.{name}"] for name in Records.SHAPES})
            secondary = SecondaryRecords(records, arrays["secondary.reach"])
        if "photons.power" in arrays:
            photons = Photons(*(arrays[f"photons.{name}"] for name in Photons._fields))
        return cls(grid, secondary, photons, float(arrays["faint"][0]))


def make_filler(view: View, poses: Sequence[Pose], bounces: int | None) -> Filler:
    """The filler for a camera path; prepares it first."""
    return filler_of(prepare(view, poses, bounces), view, poses, bounces)


def filler_of(prepared: Prepared, view: View, poses: Sequence[Pose], bounces: int | None) -> Filler:
    """The filler for a camera path, from what `prepare` made for the same path."""
    quality = view.quality
    grid = view.gather_emitters().go_by(prepared.grid)
    secondary = caustics = None
    if prepared.photons is not None:
        caustics = CausticMap(view.scene, prepared.photons)
    if prepared.secondary is not None:
        cache = DeviceCache(prepared.secondary.records, prepared.secondary.reach, finer=FINER)
        photons = None if caustics is None else caustics.grid
        secondary = Secondary(cache, everywhere=bounces is None, photons=photons)
    context = GatherContext(view.lit_by(grid, quality.records.emitter_samples), secondary, caustics)
    bounds = RadiusBounds(poses, view.camera.width, diagonal(view.scene), quality.records, view.longest)
    return Filler(Gather(quality.records, bounces, context, prepared.faint), bounds)


def answering_cache(secondary: SecondaryRecords, caustics: CausticMap | None) -> DeviceCache:
    """The secondary cache as frames look it up where surfaces are seen faintly: with caustics, in one look-up."""
    return DeviceCache(with_caustics(secondary.records, caustics), secondary.reach, finer=FINER)


def prepare(view: View, poses: Sequence[Pose], bounces: int | None) -> Prepared:
    """Prepare emitter sampling and the secondary cache, which reduce the noise of the gather along a camera path.

    Random walks from cameras along the path sample where gather rays will end; both are prepared for these points.

    Args:
        view: its camera is moved.
        poses: all camera poses of the animation.
        bounces: indirect diffuse bounces; None for all.
    """
    quality, width, extent = view.quality, view.camera.width, diagonal(view.scene)
    cameras = min(WALK_CAMERAS, len(poses))
    chosen = sorted({round(k * (len(poses) - 1) / max(cameras - 1, 1)) for k in range(cameras)})
    sobol = qmc.Sobol(2, rng=np.random.default_rng(0))
    parts = []
    for number in chosen:
        view.camera.look(poses[number])
        _, ray = view.rays_through(draw(sobol, WALK_RAYS), number)
        parts.append(on_host(ray, WALK_RAYS))
    o, d = np.concatenate(parts, axis=1)
    rays = mi.Ray3f(upload(mi.Point3f, o), upload(mi.Vector3f, d))
    position, normal, diffuse = walk(view.scene, rays, WALK_RAYS * len(chosen), view.panes)
    points = Points.anywhere(position[diffuse], normal[diffuse])
    grid = view.gather_emitters().measure_at(position, normal, quality.shading.emitter_rays)

    bounds = RadiusBounds(poses, width, extent, quality.secondary)
    lighting = view.lit_by(grid, quality.secondary.emitter_samples)
    # With a fixed number of bounces, a photon would have to know how many surfaces scattered it.
    photons = trace_photons(lighting, seed_of(_PHOTONS)) if bounces is None else None
    caustics = None if photons is None else CausticMap(view.scene, photons)
    gather = Gather(quality.secondary, bounces, GatherContext(lighting, caustics=caustics))
    first, secondary = first_bounce(gather, points, bounds), None
    if caustics is not None and first is not None:
        count = _enough_photons(
            caustics.noise_of(first.records, first.expected), quality.records.standard_error
        )
        if count > FEWEST_PHOTONS:
            photons = trace_photons(lighting, seed_of(_PHOTONS), count)
            caustics = CausticMap(view.scene, photons)
            gather = replace(gather, context=gather.context._replace(caustics=caustics))
    if first is not None:
        secondary = secondary_cache(gather, first)
    faint = 0.0
    if secondary is not None:
        known = with_caustics(secondary.records, caustics)
        faint = FAINT * usual_in_the_darkest(known, view.scene, rays, len(chosen))
    return Prepared(grid.grid, secondary, photons, faint)


def _enough_photons(noise: float, standard_error: float) -> int:
    """Number of photons, a power of two, that add half as much noise to records as paths may.

    Args:
        noise: relative, that the fewest photons add. With `times` as many, it is divided by about the third root of
            that: the square root where discs stay as large, nothing where they shrink.
        standard_error: relative, up to which records get paths.
    """
    times = (2 * noise / standard_error) ** 3
    return int(np.clip(FEWEST_PHOTONS * 2.0 ** np.rint(np.log2(max(times, 1))), FEWEST_PHOTONS, MOST_PHOTONS))


def usual_in_the_darkest(secondary: Records, scene: mi.Scene, rays: mi.Ray3f, cameras: int) -> float:
    """Median irradiance that a camera sees, for the camera where it is least, W/m² of luminance.

    Args:
        secondary: the secondary cache with its caustics, which provides the irradiance.
        scene: mi.Scene.
        rays: Ray3f, the same number from each camera, one camera after the other.
        cameras: number of cameras.
    """
    si = scene.ray_intersect(rays)
    look = DeviceCache(secondary).with_fallback().look_up(si.p, facing_normal(si), si.is_valid())
    luminance = mi.luminance(look.irradiance)
    dr.eval(look.row, luminance)
    irradiance = np.where(np.array(look.row) != NO_ROW, np.array(luminance), np.nan)
    seen = irradiance.reshape(cameras, -1)
    medians = [np.nanmedian(camera) for camera in seen if np.isfinite(camera).any()]
    return float(min(medians, default=0.0))


def fill_view(view: View, filler: Filler, cache: DeviceCache, seed: int) -> DeviceCache:
    """Add private records wherever this view misses: first at sparse pixels if the cache is empty, then at all."""
    sobol = qmc.Sobol(2, rng=np.random.default_rng(seed))
    if len(cache.records) == 0:
        for number, pixels in enumerate(n for n in SPARSE if 2 * n < view.camera.pixels):
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
    made = filler.fill(thinned(points.asking_alike(), filler.bounds), seed)
    return DeviceCache(Records.concatenate(cache.records, made))


def thinned(points: Points, bounds: RadiusBounds) -> Points:
    """Remove points so close to another that one record usually covers both; the others stand for their look-ups."""
    rows, number = thin_rows(points, bounds)
    return points if len(rows) == len(points.position) else points.take(rows)._replace(number=number)


def worth_look_ups(points: Points, bounds: RadiusBounds, enough: float) -> Points:
    """The same points; where few look-ups would share a record, they need a larger radius.

    A record costs the same everywhere, and the squared error of a look-up grows with the fourth power of the radius.
    The total error is least for a given number of records if the radius falls with the sixth root of the density of
    look-ups.

    Args:
        points: of all windows, thinned.
        bounds: of the radius.
        enough: look-ups in a square as wide as the smallest radius at and above which records have that radius.
    """
    smallest = least_nearby(points.position, points.normal, bounds.of(points).smallest)
    number = totals(points.position, points.normal, smallest, points.number)
    number *= (smallest / np.exp2(level_of(smallest))) ** 2  # cells are as wide as the power of two below
    smallest *= np.maximum((enough / number) ** (1 / 6), 1)
    # Near obstacles, trust the radius that a record here will have; otherwise it would not cover its neighbours.
    return points._replace(smallest=smallest, longest=np.maximum(points.longest, smallest))


def thin_rows(points: Points, bounds: RadiusBounds) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Rows of the points that `thinned` keeps: in each cell, the one with the smallest `longest`. And its look-ups."""
    spacing = bounds.of(points).smallest / 2
    return thin_and_count(points.position, points.normal, spacing, points.number, points.longest)


def draw(sobol: qmc.Sobol, count: int) -> NDArray[np.float32]:
    """The next `count` points of a Sobol' sequence in [0, 1)²."""
    with warnings.catch_warnings():
        # SciPy warns unless the count is a power of two, but the user chooses the number of base rays.
        warnings.simplefilter("ignore", UserWarning)
        return np.minimum(sobol.random(count), np.float32(1 - 2**-24)).astype(np.float32)
