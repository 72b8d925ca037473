"""Caustic photons: light that mirrors, glass and rough metal send from emitters to diffuse surfaces.

A path from a record finds a lamp behind glass, or the sun in a mirror, by luck only: the few that do are so bright that
they are most of the noise of all records in the room. So this light is traced the other way (Jensen 1996, "Global
illumination using photon maps", doi:10.1007/978-3-7091-7484-5_3), and paths from records leave it out. It has come
from an emitter, straight or through panes, to a *caster*, and from there to the diffuse surface by further surfaces
that scatter it without a diffuse lobe (`Casters`).

Emitters are sampled from points on the casters, as from any other vertex. Photons begin at those points that receive
most, so that all carry about the same power.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.collected import Collected
from steadylight.renderers.mitsuba.light.vertex import Lighting, Receiver, not_cached
from steadylight.renderers.mitsuba.records.origins import ray_offset
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, roulette, samples_of, seed_of
from steadylight.renderers.mitsuba.upload import download, upload

FEWEST_PHOTONS, MOST_PHOTONS = 1 << 16, 1 << 21
"""Bounds of the number of photons that leave casters. Where a lamp has a little metal, the fewest are plenty; in a room
with a chandelier of rough glass, the most leave 3 % noise. These take 70 MB in the run directory."""

STARTS = 4
"""Lit points on casters from which each photon's beginning is chosen."""

PILOT = 1 << 17
"""Points on casters that tell how much light each of their cells receives."""

PILOT_IN_CELL = 64
"""Pilot points of a cell, whose emitter samples are noisy; fewer if there are more than 512 casters."""

ACROSS = 4
"""Cells along the first coordinate of the unit square from which points on a caster are drawn. There are as many along
the second, by which Mitsuba chooses the face of a mesh, as pilot points allow."""

BY_AREA = 0.1
"""Part of the points on casters that are distributed by area, whatever the pilot points received."""

MOST_SURFACES = 128
"""Maximum number of surfaces that a photon meets; Russian roulette ends nearly all much earlier."""

ROULETTE_FROM = 4
"""Surfaces after which Russian roulette ends photons by what is left of their power."""

MOST_CORRECTED = 10.0
"""Maximum correction for a shading normal, past the start of a photon. At the silhouettes of smooth meshes it has no
bound, and single photons of a thousand times the usual power would leave spots."""

OFF = 1 / 8
"""Distance from which a ray looks for the point drawn on a caster, as a part of the usual offset of rays: less than
that, so that nothing else lies in between."""


class Photons(NamedTuple):
    """Photons on diffuse surfaces.

    Attributes:
        position: (P, 3) world, metres.
        normal: (P, 3) unit, of the surface on the side that the photon reaches.
        power: (P, 3) W, scene-linear RGB.
    """

    position: Floats
    normal: Floats
    power: Floats


class _Lit(NamedTuple):
    """Points on casters, and light that arrives there from one sampled direction.

    Attributes:
        cell: (P,) number of the cell, among those of all casters.
        origin, towards: (P, 3) a ray that meets the point.
        from_light: (P, 3) unit, towards the emitter.
        power: (P, 3) W that the point would receive at right angles, for all the surface that it stands for. Photons
            begin by it: with shading normals, what leaves a surface may be far more than what falls on it.
    """

    cell: NDArray[np.intp]
    origin: Floats
    towards: Floats
    from_light: Floats
    power: Floats

    def take(self, rows: NDArray[np.intp]) -> _Lit:
        return _Lit(*(array[rows] for array in self))


def trace_photons(lighting: Lighting, seed: int, count: int = FEWEST_PHOTONS) -> Photons | None:
    """Trace caustic photons.

    Args:
        lighting: of the scene, with emitters guided by a grid.
        seed: of all random numbers.
        count: number of photons that leave casters.

    Returns:
        Photons in a random order, so that some of them, regularly chosen, stand for all; None if no caster is lit or
        nothing diffuse is reached.
    """
    casters = lighting.bsdfs.casters
    if not len(casters.number):
        return None
    along = max(PILOT // (PILOT_IN_CELL * ACROSS * len(casters.number)), 1)
    by_area = np.repeat(casters.area / casters.area.sum(), ACROSS * along) / (ACROSS * along)
    pilot = _lit_points(lighting, by_area, PILOT, seed_of(seed, 0))
    received = np.bincount(pilot.cell, pilot.power.sum(axis=1, dtype=np.float64), len(by_area))
    if received.sum() <= 0:
        return None
    chance = BY_AREA * by_area + (1 - BY_AREA) * received / received.sum()
    lit = _lit_points(lighting, chance, STARTS * count, seed_of(seed, 1))
    # Systematic resampling: photons begin at points in proportion to their power, and share it evenly.
    power = lit.power.sum(axis=1, dtype=np.float64)
    whole = np.cumsum(power)
    if whole[-1] <= 0:
        return None
    place = (np.arange(count) + 0.5) / count * whole[-1]
    rows = np.minimum(np.searchsorted(whole, place), len(power) - 1)
    starts = lit.take(rows)
    starts = starts._replace(
        power=(starts.power * (whole[-1] / count / power[rows])[:, None]).astype(np.float32)
    )
    photons = _followed(lighting, starts, seed_of(seed, 2))
    if len(photons.position) == 0:
        return None
    # In the order of their random numbers, every other photon would begin in one half of each caster.
    order = np.random.default_rng(seed).permutation(len(photons.position))
    return Photons(*(array[order] for array in photons))


def _lit_points(lighting: Lighting, chance: NDArray[Any], count: int, seed: int) -> _Lit:
    """Points on casters, uniform over both sides of each cell, and one emitter sample at each.

    Args:
        lighting: of the scene.
        chance: (C * cells,) relative probability of each cell of each caster; `ACROSS` cells are in a row.
        count: number of points.
        seed: of the random numbers.
    """
    scene, casters, chance = lighting.scene, lighting.bsdfs.casters, chance / chance.sum()
    cells = len(chance) // len(casters.number)
    each = (np.arange(count) + 0.5) / count
    cell = np.minimum(np.searchsorted(np.cumsum(chance), each), len(chance) - 1)
    shape = cell // cells
    pointer = dr.gather(mi.ShapePtr, scene.shapes_dr(), upload(mi.UInt32, casters.number[shape]))
    along, across = np.divmod(cell % cells, ACROSS)
    corner = mi.Point2f(
        upload(mi.UInt32, across.astype(np.uint32)), upload(mi.UInt32, along.astype(np.uint32))
    )
    samples = samples_of(dr.opaque(mi.UInt32, seed), mi.UInt32(0), dr.arange(mi.UInt32, count))
    numbers = samples.at(mi.UInt32(0), mi.UInt32(0))
    size = mi.Vector2f(1 / ACROSS, dr.opaque(mi.Float, ACROSS / cells))
    drawn = pointer.sample_position(mi.Float(0), (corner + numbers.sample_2d(Purpose.PIXEL)) * size)
    side = dr.select(numbers.sample_1d(Purpose.LOBE) < 0.5, mi.Float(1), mi.Float(-1))
    away = mi.Vector3f(drawn.n) * side
    step = OFF * ray_offset(drawn.p)
    ray = mi.Ray3f(drawn.p + away * step, -away)
    ray.maxt = 2 * step
    si = scene.ray_intersect(ray)
    met = si.is_valid() & (si.shape == pointer)
    row = lighting.emitters.row_at(si, mi.Bool(True), met)
    ds, weight, radiance = lighting.emitters.sample(si, numbers.sample_2d(Purpose.EMITTER), row, met)
    one = mi.UInt32(1)
    weight *= not_cached(lighting, Receiver(si, row, one, mi.Bool(False), mi.Bool(True)), ds, radiance)
    # The normal of the point drawn is a shading normal, which does not tell from which side light falls.
    faces = dr.dot(si.n, away) * dr.dot(si.n, ds.d) > 0
    power = dr.select(met & faces & (ds.pdf > 0), weight, 0)
    # Two sides; what each point stands for, per unit of probability.
    power *= upload(mi.Float, (2 * casters.area[shape] / (count * cells * chance[cell])).astype(np.float32))
    power = dr.select(dr.all(dr.isfinite(power)), power, 0)
    dr.eval(ray.o, ray.d, ds.d, power)
    return _Lit(cell, *(download(array) for array in (ray.o, ray.d, ds.d, power)))


def _followed(lighting: Lighting, starts: _Lit, seed: int) -> Photons:
    """Photons that begin at lit points of casters, where they reach diffuse surfaces."""
    count = len(starts.cell)
    ray = mi.Ray3f(upload(mi.Point3f, starts.origin), upload(mi.Vector3f, starts.towards))
    from_light, power = upload(mi.Vector3f, starts.from_light), upload(mi.Color3f, starts.power)
    samples = samples_of(dr.opaque(mi.UInt32, seed), mi.UInt32(0), dr.arange(mi.UInt32, count))

    def landed(room: int) -> Collected:
        found = Collected(room, (3, 3, 3))
        _follow(lighting, samples, ray, from_light, power, found)
        dr.eval(*found.arrays)
        return found

    found = landed(2 * count)
    if found.count > 2 * count:
        found = landed(found.count)
    _, photons = found.read()
    usable = np.isfinite(np.hstack(photons)).all(axis=1)
    return Photons(*(array[usable] for array in photons))


@dr.syntax
def _follow(
    lighting: Lighting,
    samples: Samples,
    ray: mi.Ray3f,
    from_light: mi.Vector3f,
    power: mi.Color3f,
    found: Collected,
) -> None:
    """Follow photons from casters until they are absorbed or scattered by a diffuse lobe.

    Args:
        lighting: of the scene.
        samples: random numbers of the photons.
        ray: to the first point of each.
        from_light: unit, from that point towards the emitter.
        power: W.
        found: photons that reach a diffuse surface are appended.
    """
    scene, casters = lighting.scene, lighting.bsdfs.casters
    context = mi.BSDFContext()
    context.mode = mi.TransportMode.Importance
    begin = dr.max(power)
    # ---- variables of the loop -----------------------------------------------------------
    si = scene.ray_intersect(ray)
    si.wi = si.to_local(from_light)
    power = mi.Color3f(power)
    number = dr.arange(mi.UInt32, dr.width(power))  # of the photon
    step = mi.UInt32(0)  # surfaces met before this one
    active = si.is_valid() & (begin > 0)

    while active:
        bsdf = si.bsdf()
        arrives = si.to_world(si.wi)
        lands = active & (step > 0) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        normal = mi.Normal3f(si.n * dr.select(dr.dot(si.n, arrives) < 0, mi.Float(-1), mi.Float(1)))
        found.append(number, step, (si.p, normal, power), lands)

        # Go on by lobes that a gather follows without looking up its cache.
        numbers = samples.at(mi.UInt32(0), step)
        bs, weight = bsdf.sample(context, si, *numbers.draw(), active)
        leaves = si.to_world(bs.wo)
        active &= casters.scatters(bsdf, bs) & ((step > 0) | ~lighting.panes.transmits(bs))
        power *= lighting.bsdfs.finite(weight) * _of_normals(si, arrives, leaves, step == 0)
        survival = dr.select(step < ROULETTE_FROM, 1, dr.minimum(dr.max(power) / begin, 1))
        power, active = roulette(numbers, power, survival, active & dr.any(power > 0))
        si = scene.ray_intersect(si.spawn_ray(leaves), mi.RayFlags.All, False, active)
        step += 1
        active &= si.is_valid() & (step < MOST_SURFACES)


def _of_normals(
    si: mi.SurfaceInteraction3f, arrives: mi.Vector3f, leaves: mi.Vector3f, starts: mi.Bool
) -> mi.Float:
    """Factor on the power of a photon for its angle at its start, and for shading normals (Veach 1997, eq. 5.19).

    Args:
        si: the surface.
        arrives: unit, world, towards where the photon comes from.
        leaves: unit, world, where it goes.
        starts: lanes whose power is that of light at right angles.
    """
    n = si.sh_frame.n
    outgoing = dr.abs(dr.dot(leaves, si.n) / dr.dot(leaves, n))
    incident = dr.abs(dr.dot(arrives, n))
    later = dr.minimum(outgoing * incident / dr.abs(dr.dot(arrives, si.n)), MOST_CORRECTED)
    factor = dr.select(starts, outgoing * incident, later)
    return dr.select(dr.isfinite(factor), factor, 0)
