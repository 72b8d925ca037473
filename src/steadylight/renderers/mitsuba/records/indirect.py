"""Radiance along the paths of a gather: a path tracer that ends in the secondary cache where possible."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.cache.lookup import ANSWERED
from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.bsdf.lobes import (
    NOT_DIFFUSE_REFLECTION,
    OTHER_FLAGS,
    BSDFTraits,
    DiffuseLobe,
)
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.panes import MOST_PANES
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Lighting,
    Met,
    Receiver,
    all_lobes,
    emission,
    emitter_samples,
    look_beyond,
)
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.photon_grid import PhotonGrid
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, VertexSamples, roulette

MOST_VERTICES = 128
"""Maximum number of vertices of a path with all bounces; Russian roulette ends nearly all much earlier."""

WORTH = 2.0
"""Survival probability of a path over its throughput. Once the secondary cache has provided the diffuse lobe, the
remaining throughput is seldom worth its rays: 1, 2 and 4 are about equally good. Without roulette, the same noise
costs 1.3 to 1.7 times as much (living-room; docs/experiments.md)."""

ROULETTE_FROM = 4
"""Vertices after which Russian roulette may end paths of any throughput: by then, a path is past the surfaces whose
direct light its record sees, and past those that the secondary cache did not cover."""

NEAR = 0.25
"""Beyond the first hit, a secondary record is used only if the last ray is longer than this fraction of its radius. At
the first hit, the ray must be longer than the whole radius. Later hits may be less accurate, since the path's
throughput scales their error; in cluttered places, paths then end sooner (docs/experiments.md)."""

ENDING = 0.5
"""Probability that a path ends at a surface of which the secondary cache provides only the diffuse lobe."""

SURVIVAL = 0.95
"""Maximum survival probability, so that paths between perfect mirrors end."""


class Secondary:
    """What paths of a gather look up at the surfaces that they hit. All whose cache has no fallback share one kernel.

    Not a dataclass: kernels read it, but it is not one of their loop variables.

    Attributes:
        cache: the records.
        everywhere: Bool, whether every hit is looked up; if not, only the first is.
        all_covered: Bool, whether all diffuse surfaces are black, as if covered by black records.
        covered_black: Bool, whether surfaces that records cover are black, caustics included.
        least: Float, sum of weights from which records cover a surface.
        nearness: Float, factor on the distance within which a record is too near; see `NEAR`. 0 if none is.
        casts: Bool, whether photons carry caustics, so that paths leave them out.
        photons: these; the records are without their light.
    """

    def __init__(
        self,
        cache: DeviceCache,
        *,
        everywhere: bool = True,
        all_covered: bool = False,
        least: float = ANSWERED,
        nearness: float = 1.0,
        photons: PhotonGrid | None = None,
    ) -> None:
        self.cache = cache
        self.casts, self.photons = dr.opaque(mi.Bool, photons is not None), photons or PhotonGrid(None)
        self.everywhere, self.all_covered = dr.opaque(mi.Bool, everywhere), dr.opaque(mi.Bool, all_covered)
        self.covered_black = dr.opaque(mi.Bool, False)
        self.least, self.nearness = dr.opaque(mi.Float, least), dr.opaque(mi.Float, nearness)

    @classmethod
    def black(cls, *, photons: bool = False) -> Secondary:
        """Paths return the light of one diffuse bounce, glossy bounces included; without caustics if `photons`."""
        cache = DeviceCache(Records.empty(), np.zeros(0, np.float32))
        return cls(cache, all_covered=True, photons=PhotonGrid(None) if photons else None)

    @classmethod
    def black_where_covered(cls, cache: DeviceCache, photons: PhotonGrid | None = None) -> Secondary:
        """The same where this cache covers surfaces, by more distant records too; paths continue at others.

        Args:
            cache: the records.
            photons: that carry caustics; None if paths find all of them.
        """
        dark = copy.copy(cache)
        dark.light = dr.zeros(mi.Float, dr.width(cache.light))
        dr.make_opaque(dark.light)
        made = cls(dark, least=0.0, nearness=0.0, photons=photons)
        made.covered_black = dr.opaque(mi.Bool, True)
        return made

    @dr.syntax
    def looked_up(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        lobe: DiffuseLobe,
        number: mi.Float,
        away: mi.Float,
        first: mi.Bool,
    ) -> Said:
        """What records say of a surface.

        Args:
            scene: for visibility of the record.
            si: the surface.
            lobe: its diffuse lobe.
            number: in [0, 1), draws the record.
            away: length of the last ray, metres.
            first: lanes in which this is the first hit.
        """
        asks = lobe.active & (first | self.everywhere)
        known, irradiance, caustics = asks & self.all_covered, mi.Color3f(0), mi.Color3f(0)
        if asks & ~self.all_covered:
            found = self.cache.draw_in_sight(scene, si.p, lobe.normal, number, mi.Bool(True), lobe.facing)
            # Records are used only within their own radius: in dark corners without a record, more distant ones would
            # be far too bright. Nor are they used after a short ray, over which light varies faster than they resolve.
            within = self.nearness * dr.select(first, mi.Float(1), NEAR)
            known = (found.row != NO_ROW) & (found.weight >= self.least)
            known &= away > within * self.cache.radius_of(found.row)
            irradiance = dr.select(known, found.irradiance, 0)
            beneath = dr.dot(si.n, lobe.normal) < 0
            n = dr.select(beneath, -si.n, si.n)
            brought = asks & self.casts & ~(known & self.covered_black)
            caustics = self.photons.irradiance(si.p, n, brought)
        return Said(known, irradiance, asks & ~known & self.casts, caustics)

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this object, for `frozen`."""
        covered = (self.everywhere, self.all_covered, self.covered_black, self.least, self.nearness)
        return [*covered, self.casts, self.photons.arrays(), self.cache.arrays()]


class Said(NamedTuple):
    """What the secondary cache says of a surface.

    Attributes:
        known: whether records cover it.
        irradiance: what they give it, W/m², without caustics that photons carry; black if they do not cover it.
        casts: whether photons bring the caustics of a surface that no record covers. Few paths would find them, each
            of them very bright.
        caustics: irradiance by photons there, W/m².
    """

    known: mi.Bool
    irradiance: mi.Color3f
    casts: mi.Bool
    caustics: mi.Color3f


class PathEnd(NamedTuple):
    """End of a path that searches for a surface covered by the secondary cache.

    Attributes:
        row: of the record used there.
        throughput: of the path, with the albedo of the surface. Times the surface's irradiance, it is the path's
            contribution to the irradiance at its start. 0 if the path found no such surface.
        change: what the record's gradients add to that contribution.
        position: of the end, metres.
        normal: unit, on the lit side.
        bounces: scattering events on the way, including that surface, without panes passed straight through. 0 if the
            path found no such surface.
        missed: lanes that met a diffuse surface earlier for which no record was used: none visible, or too near.
        missed_position: of the first such surface, metres.
        missed_normal: unit, on the lit side.
        missed_throughput: of the path up to there, with the albedo of the surface.
        missed_bounces: as `bounces`, including that surface.
    """

    row: mi.UInt32
    throughput: mi.Color3f
    change: mi.Color3f
    position: mi.Point3f
    normal: mi.Normal3f
    bounces: mi.UInt32
    missed: mi.Bool
    missed_position: mi.Point3f
    missed_normal: mi.Normal3f
    missed_throughput: mi.Color3f
    missed_bounces: mi.UInt32


@dataclass
class _Passage:
    """Panes that a path has passed straight through: variables of the loop.

    Attributes:
        panes: number of panes.
        distance: from the start of the path to the last one before the first hit, metres.
        looked: whether a ray has looked for emitters behind the panes, and the path has met only panes since.
    """

    panes: mi.UInt32
    distance: mi.Float
    looked: mi.Bool

    @classmethod
    def begin(cls) -> _Passage:
        """No panes yet."""
        return cls(mi.UInt32(0), mi.Float(0), mi.Bool(False))


@dataclass
class _Path:
    """State of a path and the radiance so far: variables of the loop.

    Attributes:
        ray: to the next surface.
        L: radiance so far.
        throughput: of the lobes that the secondary cache does not provide.
        whole: of all lobes, for emission at the next hit.
        depth: surfaces met so far, without panes passed straight through.
        distance: to the first hit, metres.
        passage: through panes; None if the scene has none.
        known: whether the secondary cache was used at the last surface.
        departure: from the last surface.
        active: whether the path continues.
        searched: part of what casters send to the last diffuse surface, or to the record, that the path brings, by
            channel; photons bring the rest. The path has since been scattered without a diffuse lobe.
        cast: whether the last surface that it did not pass straight through is a caster.
    """

    ray: mi.Ray3f
    L: mi.Color3f
    throughput: mi.Color3f
    whole: mi.Color3f
    depth: mi.UInt32
    distance: mi.Float
    passage: _Passage | None
    known: mi.Bool
    departure: Departure
    active: mi.Bool
    searched: mi.Color3f
    cast: mi.Bool

    @classmethod
    def begin(cls, lighting: Lighting, ray: mi.Ray3f, casts: mi.Bool) -> _Path:
        """At a record, for which photons may carry caustics."""
        return cls(
            ray=mi.Ray3f(ray),
            L=mi.Color3f(0),
            throughput=mi.Color3f(1),
            whole=mi.Color3f(1),
            depth=mi.UInt32(0),
            distance=mi.Float(dr.inf),
            passage=_Passage.begin() if lighting.panes.some else None,
            known=mi.Bool(False),
            departure=Departure.nowhere(),
            active=mi.Bool(True),
            searched=mi.Color3f(dr.select(casts, mi.Float(0), 1)),
            cast=mi.Bool(False),
        )


@dr.syntax
def indirect_radiance(
    lighting: Lighting,
    samples: Samples,
    ray: mi.Ray3f,
    bounces: mi.UInt32,
    secondary: Secondary | None,
) -> tuple[mi.Color3f, mi.Float]:
    """Radiance that arrives along a ray from surfaces and from the cached part of the environment.

    Emission of the first surface hit, and the rest of the environment, is direct light and left to the second pass.
    Where the secondary cache covers a surface, it provides the indirect light of the diffuse lobe. The path continues
    with the other lobes; its next ray still looks for emitters for all of them, since near a lamp, emitter samples
    alone have infinite variance. If there is no other lobe and no lamp is near, the path ends there; beyond the next
    surface, it continues by Russian roulette.

    If photons carry caustics, a path does not collect what casters send to a record, or to a diffuse lobe.

    A pane that the ray passes straight through is no surface: neither the first hit nor a bounce. The distance is that
    of what lies behind the pane, even for a path that the pane reflects: a record on a window sill does not depend on
    the distance of the glass. A mask that scatters is a surface.

    Args:
        lighting: of the scene.
        samples: random numbers of the paths.
        ray: from the record.
        bounces: maximum number of scattering events, the first hit included; MOST_VERTICES for all.
        secondary: indirect irradiance; None to trace all paths to the end.

    Returns:
        Radiance, W/(m² sr), and distance to the first hit, metres, infinite if there is none.
    """
    path = _Path.begin(lighting, ray, mi.Bool(False) if secondary is None else secondary.casts)
    while path.active:
        _vertex(lighting, samples, path, bounces, secondary)
    return path.L, path.distance


def _vertex(
    lighting: Lighting,
    samples: Samples,
    path: _Path,
    bounces: mi.UInt32,
    secondary: Secondary | None,
) -> None:
    """Advance a path to the next surface, add the light found there, and choose how it continues.

    Args:
        lighting: of the scene.
        samples: random numbers of the paths.
        path: updated in place.
        bounces: as in `indirect_radiance`.
        secondary: as in `indirect_radiance`.
    """
    environment, emitters, bsdfs = lighting.environment, lighting.emitters, lighting.bsdfs
    passage, departure = path.passage, path.departure
    first = path.depth == 0
    si = lighting.scene.ray_intersect(path.ray, mi.RayFlags.All, first, path.active)
    met = look_beyond(lighting, si, path.ray, _unseen(passage, first | ~departure.delta), path.active)
    path.distance = dr.select(first, _first_distance(passage, si, met, path.distance), path.distance)
    _add_emission(lighting, path, met)

    # Stop after the last bounce, or by Russian roulette.
    numbers = samples.at(mi.UInt32(0), path.depth if passage is None else path.depth + passage.panes)
    active = path.active & si.is_valid() & (path.depth < bounces)
    most = dr.select(path.depth < ROULETTE_FROM, mi.Float(1), SURVIVAL)
    survival = dr.minimum(WORTH * dr.max(dr.abs(path.throughput)), most)
    path.throughput, active = roulette(numbers, path.throughput, survival, active)

    # Look up the diffuse lobe in the secondary cache.
    bsdf = si.bsdf(path.ray)
    flags = bsdf.flags()
    lobe = bsdfs.diffuse_lobe(si, bsdf, numbers, active)
    path.known, casts = mi.Bool(False), mi.Bool(False)
    if secondary is not None:
        number = numbers.sample_1d(Purpose.RECORD)
        away = dr.select(first, path.distance, si.t)
        said = secondary.looked_up(lighting.scene, si, lobe, number, away, first)
        path.known, casts = said.known, said.casts
        irradiance = said.irradiance + said.caustics
        path.L += path.throughput * lobe.albedo * irradiance * dr.inv_pi

    # Sample emitters.
    smooth = active & mi.has_flag(flags, mi.BSDFFlags.Smooth)
    caster = bsdfs.casters.cast(bsdf, dr.any(path.searched != 1))
    left = dr.select(caster & bsdfs.casters.is_never_diffuse(bsdf), path.searched, 1)
    smooth &= dr.any(left != 0)
    row = emitters.row_at(si, path.known, smooth)
    count = dr.select(first, mi.UInt32(lighting.emitter_samples), 1)
    # No ray looks for emitters where sampling them is enough, and nothing else is to be found.
    ends = (path.known | (path.depth + 1 >= bounces)) & ((flags & NOT_DIFFUSE_REFLECTION) == 0)
    ends &= emitters.emitters_only(row, smooth)
    if environment.only_emitter:
        ends |= path.known & ((flags & OTHER_FLAGS) == 0)
    receiver = Receiver(si, row, count, ends, path.known)
    light = emitter_samples(
        lighting, receiver, all_lobes(bsdf, si), numbers.sample_2d(Purpose.EMITTER), smooth
    )
    path.L += path.throughput * left * light

    # Continue in a direction sampled from the BSDF: emission counts for all lobes, everything else for the lobes that
    # the secondary cache did not provide.
    bs, weight = _direction(bsdfs, si, bsdf, lobe, numbers, active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    path.whole = path.throughput * weight
    searched = mi.Color3f(1)
    if secondary is not None:
        # Photons bring caustics to the diffuse lobe of an uncovered surface, and the path brings those of the others.
        divided = (path.known | casts) & ~delta
        by_others = bsdfs.weight_of_others(si, bsdf, bs, 1, lobe, divided)
        searched = dr.select(casts & ~delta, dr.select(weight != 0, by_others / weight, 0), 1)
        weight = dr.select(path.known & ~delta, by_others, weight)
    path.throughput = path.throughput * weight
    scatters, straight = bsdfs.casters.scatters(bsdf, bs), lighting.panes.transmits(bs)
    path.searched = dr.select(scatters, path.searched, searched)
    path.cast = dr.select(straight, path.cast, caster & scatters)
    path.depth += _surfaces(passage, si, met, straight, first | ~departure.delta)
    path.departure = Departure(si, row, bs.pdf, delta, mi.Float(count))
    path.ray = si.spawn_ray(si.to_world(bs.wo))
    path.active = active & dr.any(path.whole != 0) & ~ends
    path.active &= True if passage is None else passage.panes < MOST_PANES


def _add_emission(lighting: Lighting, path: _Path, met: Met) -> None:
    """Add the emission of an emitter hit by BSDF sampling.

    From the record itself, only the cached part of the environment counts. Where the secondary cache was used, it
    already includes that part for the diffuse lobe.
    """
    first = path.depth == 0
    counts = _unseen(path.passage, path.active & (~first | ~met.si.is_valid()))
    found = emission(lighting, met, path.departure, counts)
    held = found.radiance * found.cached
    given = path.whole * found.radiance * found.mis
    beyond = path.throughput * held + path.whole * (found.radiance - held) * found.mis
    given = dr.select(path.known, beyond, given)
    # Of what casters send to the last diffuse surface, the sky that a cache holds is no photon.
    brought = path.whole * held
    given = dr.select(path.cast, dr.lerp(brought, given, path.searched), given)
    given = dr.select(first, path.throughput * held, given)
    path.L = dr.select(found.active, path.L + given, path.L)


@dr.syntax
def path_end(
    lighting: Lighting, samples: Samples, ray: mi.Ray3f, secondary: DeviceCache, nearest: mi.Float
) -> PathEnd:
    """Follow paths to the first surface whose diffuse lobe the secondary cache covers, by more distant records too.

    One visible record, drawn by its weight, is used for the surface. At a surface that also has other lobes, chance
    decides whether the path ends there or continues by these.

    Args:
        lighting: of the scene; its emitters are not used.
        samples: random numbers of the paths.
        ray: first ray of each path.
        secondary: the secondary cache.
        nearest: at the first surface, a record is used only if the path is longer than this fraction of its radius.
    """
    bsdfs, panes = lighting.bsdfs, lighting.panes
    # ---- variables of the loop -----------------------------------------------------------
    ray = mi.Ray3f(ray)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(0)  # surfaces met so far
    passed = mi.UInt32(0)  # of these, panes passed straight through
    length = mi.Float(0)  # metres
    end, change = mi.Color3f(0), mi.Color3f(0)  # throughput where the path ended, and what gradients add
    end_row, end_position, end_normal = mi.UInt32(0), mi.Point3f(0), mi.Normal3f(0, 0, 1)
    missed = mi.Bool(False)  # whether a surface was met for which no record was used
    missed_position, missed_normal = mi.Point3f(0), mi.Normal3f(0, 0, 1)
    missed_throughput, missed_bounces = mi.Color3f(0), mi.UInt32(0)
    active = mi.Bool(True)

    while active:
        si = lighting.scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        active &= si.is_valid() & (depth < MOST_VERTICES)
        numbers = samples.at(mi.UInt32(0), depth)
        survival = dr.select(depth < ROULETTE_FROM, 1, dr.minimum(dr.max(dr.abs(throughput)), SURVIVAL))
        throughput, active = roulette(numbers, throughput, survival, active)

        # End here if the cache covers the surface.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        lobe = bsdfs.diffuse_lobe(si, bsdf, numbers, active)
        number = numbers.sample_1d(Purpose.RECORD)
        look = secondary.draw_in_sight(lighting.scene, si.p, lobe.normal, number, lobe.active, lobe.facing)
        length += si.t
        far = (depth > passed) | (length > nearest * secondary.radius_of(look.row))
        known = lobe.active & (look.row != NO_ROW) & far
        alone = (flags & OTHER_FLAGS) == 0
        # Emitters are not sampled here, so their random number is free.
        ends = known & (alone | (numbers.sample_1d(Purpose.EMITTER) < ENDING))
        end = dr.select(ends, throughput * lobe.albedo / dr.select(alone, mi.Float(1), ENDING), end)
        change = dr.select(ends, end * secondary.change(look), change)
        end_row = dr.select(ends, look.row, end_row)
        end_position = dr.select(ends, si.p, end_position)
        end_normal = dr.select(ends, lobe.normal, end_normal)
        active &= ~ends
        first = lobe.active & ~known & ~missed
        missed |= first
        missed_position = dr.select(first, si.p, missed_position)
        missed_normal = dr.select(first, lobe.normal, missed_normal)
        missed_throughput = dr.select(first, throughput * lobe.albedo, missed_throughput)
        missed_bounces = dr.select(first, depth + 1 - passed, missed_bounces)

        # Continue by the remaining lobes.
        bs, weight = _direction(bsdfs, si, bsdf, lobe, numbers, active)
        others = active & known & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        weight = dr.select(others, bsdfs.weight_of_others(si, bsdf, bs, 1, lobe, others), weight)
        throughput = throughput * dr.select(known, weight / (1 - ENDING), weight)
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(throughput != 0)
        depth += 1
        if dr.hint(panes.some, mode="scalar"):
            straight = panes.transmits(bs) & dr.any(panes.transmission(si, active) != 0)
            passed += dr.select(straight, mi.UInt32(1), 0)
    return PathEnd(
        end_row,
        end,
        change,
        end_position,
        end_normal,
        dr.select(dr.any(end != 0), depth - passed, 0),
        missed,
        missed_position,
        missed_normal,
        missed_throughput,
        missed_bounces,
    )


def _direction(
    bsdfs: BSDFTraits,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    lobe: DiffuseLobe,
    numbers: VertexSamples,
    active: mi.Bool,
) -> tuple[mi.BSDFSample3f, mi.Color3f]:
    """A direction sampled from the BSDF, and its weight; if all BSDFs are diffuse, the sample that gave the albedo."""
    if bsdfs.only_diffuse and bsdfs.uneven is None:
        return lobe.sample, lobe.albedo
    sample, weight = bsdf.sample(mi.BSDFContext(), si, *numbers.draw(), active)
    return sample, bsdfs.finite(weight)


def _unseen(passage: _Passage | None, lanes: mi.Bool) -> mi.Bool:
    """The lanes in which no earlier ray has looked for emitters behind what this ray meets."""
    return lanes if passage is None else lanes & ~passage.looked


def _first_distance(
    passage: _Passage | None, si: mi.SurfaceInteraction3f, met: Met, distance: mi.Float
) -> mi.Float:
    """Distance to the first hit, metres, updated while only panes have been met.

    Args:
        passage: panes passed so far.
        si: the surface met now.
        met: what is behind it.
        distance: value so far.
    """
    if passage is None:
        return si.t
    scatters = ~met.pane | mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
    clear = dr.select(passage.looked, distance, met.distance)
    return dr.select(scatters, passage.distance + si.t, clear)


def _surfaces(
    passage: _Passage | None, si: mi.SurfaceInteraction3f, met: Met, transmits: mi.Bool, looks: mi.Bool
) -> mi.UInt32:
    """Number of surfaces to count when a path leaves one: 0 if it passes straight through a pane, else 1.

    Args:
        passage: of the path; updated in place.
        si: the surface.
        met: what is behind it.
        transmits: whether the path leaves it by transmission, like light through a pane.
        looks: lanes whose ray looks for emitters behind panes.
    """
    if passage is None:
        return mi.UInt32(1)
    straight = met.pane & transmits
    passage.looked = straight & (passage.looked | looks)
    passage.distance = passage.distance + dr.select(straight, si.t, 0)
    passage.panes = passage.panes + dr.select(straight, mi.UInt32(1), 0)
    return dr.select(straight, mi.UInt32(0), 1)
