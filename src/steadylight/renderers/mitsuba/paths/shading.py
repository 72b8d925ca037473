"""Light paths of the second pass: direct light, the cache for diffuse lobes, and traced rays for all other lobes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.bsdf.lobes import (
    GLOSSY_FLAGS,
    NOT_DIFFUSE_REFLECTION,
    OTHER_FLAGS,
    BSDFTraits,
    Choice,
    DiffuseLobe,
    cosine_pdf,
    other_context,
)
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Emission,
    Lighting,
    Receiver,
    Scatter,
    emission,
    emitter_samples,
    look_beyond,
    sky_in_layer,
)
from steadylight.renderers.mitsuba.paths.branches import Branches, CameraPath, PathLimits
from steadylight.renderers.mitsuba.records.lookup import DeviceAnswer, DeviceCache
from steadylight.renderers.mitsuba.sampling import Draw, Purpose, Samples

CERTAIN = 0.999
"""Probability of passing above which a mask counts as a hole: one stopped sample in a thousand shows no grain."""

NEARLY = 1.01
"""Factor on `faint`, for rounding: what the audit, another kernel, classed as faint must be faint in the frame too."""


class Layers(NamedTuple):
    """The radiance in two parts, and the features of the surface that a denoiser uses; Color3f each.

    The surface is the first that does more than reflect or transmit without scattering, seen through delta dielectrics
    if there are any; black if there is none.

    Attributes:
        cached: light from the cache on that surface, without noise, if mirrors, clear glass or holes come before it. On
            the first surface of the camera ray, it is `Shade.indirect`. Behind a mask that is passed at random, it has
            the noise of that choice and belongs to `rest`.
        rest: everything except cached, direct and emitted light; mostly glossy reflections. Negative where rays
            subtract the excess of the Lambertian part of a BSDF (see `lobes`). A picture adds direct light to it.
        albedo: from 0 to 1.
        normal: shading normal in world space, facing the ray, from -1 to 1.
    """

    cached: mi.Color3f
    rest: mi.Color3f
    albedo: mi.Color3f
    normal: mi.Color3f


class Shade(NamedTuple):
    """Result of a path.

    Attributes:
        radiance: Color3f, or Layers of it, without the lights that follow.
        direct: direct light on the first surface; see `first_surface.direct_light`.
        indirect: light from the cache on the first surface; see `first_surface.indirect_light`. Without layers, it is
            part of the radiance, and this is black.
        emitted: emission that the camera sees, directly or by mirrors and clear glass.
        missed: look-ups without a record in reach; surfaces seen faintly by glossy reflection are not looked up.
    """

    radiance: mi.Color3f | Layers
    direct: mi.Color3f
    indirect: mi.Color3f
    emitted: mi.Color3f
    missed: mi.UInt32


@dataclass
class _Sums:
    """Result of a path so far: variables of the loop. The last five are None without layers."""

    radiance: mi.Color3f
    direct: mi.Color3f
    indirect: mi.Color3f
    emitted: mi.Color3f
    missed: mi.UInt32
    cached: mi.Color3f | None
    albedo: mi.Color3f | None
    normal: mi.Color3f | None
    first: mi.Bool | None  # only mirrors, clear glass and holes so far
    certain: mi.Bool | None  # ... and all samples of the pixel would have taken this path

    @classmethod
    def nothing(cls, *, layered: bool) -> _Sums:
        cached, albedo, normal = (mi.Color3f(0) if layered else None for _ in range(3))
        first, certain = (mi.Bool(True) if layered else None for _ in range(2))
        radiance, direct, indirect, emitted = (mi.Color3f(0) for _ in range(4))
        nothing = (radiance, direct, indirect, emitted, mi.UInt32(0))
        return cls(*nothing, cached, albedo, normal, first, certain)

    def shade(self) -> Shade:
        """The final result."""
        radiance = self.radiance
        if self.cached is not None:
            radiance = Layers(self.cached, self.radiance, self.albedo, self.normal)
        return Shade(radiance, self.direct, self.indirect, self.emitted, self.missed)


@dataclass
class _Tail:
    """What the next hit needs to know about the previous vertex: variables of the loop.

    Attributes:
        departure: that vertex, for MIS.
        throughput: of all its lobes, for emission at the next hit.
        base: whether the very last branch is to leave the diffuse base under a specular layer.
        looked: whether the path has since passed only straight through panes, behind which an earlier ray has already
            looked for emitters; None in a scene without panes.
        sky_share: weight of a ray that finds cached sky: one over the number of rays that look for it.
        faint: whether the following vertices are seen faintly by glossy reflection; see `PathLimits`.
    """

    departure: Departure
    throughput: mi.Color3f
    base: mi.Bool
    looked: mi.Bool | None
    sky_share: mi.Float
    faint: mi.Bool

    @classmethod
    def begin(cls, looked: mi.Bool | None) -> _Tail:
        """At the camera."""
        base, faint = mi.Bool(False), mi.Bool(False)
        return cls(Departure.nowhere(), mi.Color3f(1), base, looked, mi.Float(1), faint)


@dataclass
class _Vertex:
    """A surface that a path has met, and how it continues from there.

    Attributes:
        si: the surface.
        bsdf: `si.bsdf()`.
        flags: of its lobes.
        fresh: not met by an earlier branch.
        primary: the camera sees it, directly or through delta dielectrics.
        diffuse: its diffuse lobe.
        row: record with the best estimate of the emitters here.
        unknown: no cache serves its diffuse lobe, so the path continues by all lobes, to surfaces that the secondary
            cache lights.
        pane: whether light passes straight through, at least in part; None if the scene has no panes.
        layer: the path leaves by its specular layer alone.
        near: ... and an emitter is so near that a ray from the diffuse base must look for it too.
        emitters_only: no ray looks for emitters.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    flags: mi.UInt32
    fresh: mi.Bool
    primary: mi.Bool
    diffuse: DiffuseLobe
    row: mi.UInt32
    unknown: mi.Bool
    pane: mi.Bool | None
    layer: mi.Bool | None = None
    near: mi.Bool | None = None
    emitters_only: mi.Bool | None = None


@dataclass
class _Direction:
    """A direction in which a path continues: the BSDF sample, its weight, and the number of directions."""

    sample: mi.BSDFSample3f
    weight: mi.Color3f
    count: mi.Float


def ends_at_first(lighting: Lighting, cache: DeviceCache | None) -> bool:
    """Whether emitter samples alone find what the cache does not hold, and nothing else is worth a further ray."""
    alone = lighting.environment.exists and cache is not None and lighting.environment.only_emitter
    return alone and lighting.bsdfs.only_diffuse


def _rough_layers_under_sky(lighting: Lighting, cache: DeviceCache | None) -> bool:
    """Whether there may be a rough layer over a diffuse base, and cached sky."""
    layers = lighting.bsdfs.layered is not None and lighting.bsdfs.glossy
    return lighting.environment.exists and cache is not None and layers


@dr.syntax
def shade(
    lighting: Lighting,
    samples: Samples,
    ray: mi.Ray3f,
    cache: DeviceCache | None,
    limits: PathLimits,
    layered: bool = False,
) -> Shade:
    """Follow camera rays through mirrors, glass and gloss, and light every diffuse lobe on the way from the cache.

    Emission that the camera sees, directly or by mirrors and clear glass, is kept separate, and so is light on the
    first surface, direct or cached: some pixels take more samples of it. Each surface adds other emission, weighted
    by MIS; emitter samples; and diffuse reflectance times cached indirect irradiance / pi. The path continues in one
    direction sampled from all lobes. At its end, emission that the cache does not hold counts for all lobes,
    everything else for the non-diffuse ones. A purely diffuse surface without an emitter near needs no such
    direction. See `branches` for surfaces where a path continues in several directions.

    A surface whose share of the sample, by glossy reflection, is small is lit by the secondary cache, like the end of a
    gather path. Where that cache has no record, the path continues by all lobes.

    Args:
        lighting: of the scene.
        samples: random numbers of the camera rays.
        ray: camera rays.
        cache: read only; None if there is no indirect light (zero bounces).
        limits: how far paths are followed.
        layered: return `Layers`. If `limits` disable records, only their `rest` is meaningful.
    """
    bsdfs = lighting.bsdfs
    path, branches = CameraPath.begin(ray), Branches.begin()
    sums = _Sums.nothing(layered=layered)
    looked = mi.Bool(False) if lighting.panes.some else None
    tail = _Tail.begin(looked)

    while path.active:
        # Find the next surface.
        si = lighting.scene.ray_intersect(path.ray, mi.RayFlags.All, path.depth == 0, path.active)
        fresh = path.active & branches.fresh()

        # Add its emission, or that of an emitter behind it.
        unseen = fresh if tail.looked is None else fresh & ~tail.looked
        met = look_beyond(lighting, si, path.ray, unseen & ~tail.departure.delta, path.active)
        _add_emission(sums, emission(lighting, met, tail.departure, unseen), path, tail, cache is not None)
        path.active &= si.is_valid() & (path.depth <= limits.depth)
        numbers = branches.numbers(samples, path.depth)
        # Before the roulette, as in the audit: the raised throughput of survivors would make no path faint.
        tail.faint = tail.faint | path.is_faint(limits, NEARLY)
        path.roulette(numbers, limits.negligible)

        # Look up its diffuse lobe in the cache, or in the secondary cache if it is seen faintly by glossy reflection.
        bsdf = si.bsdf(path.ray)
        diffuse = bsdfs.diffuse_lobe(si, bsdf, numbers, path.active)
        faint = tail.faint if limits.recorded else path.depth > 0
        faint = faint & diffuse.active & fresh & mi.Bool(cache is not None)
        look = _look_up(cache if limits.recorded else None, si, diffuse, diffuse.active & ~faint)
        missed = diffuse.active & ~faint & fresh & (look.weight <= 0)
        sums.missed = sums.missed + dr.select(missed, mi.UInt32(1), 0)
        said = limits.answer(lighting.scene, si, diffuse, numbers, faint)
        irradiance = dr.select(faint, said.irradiance, look.irradiance)
        row = dr.select(faint, said.row, look.row)
        unknown = ((faint & (row == NO_ROW)) | diffuse.turned) & limits.recorded
        primary = branches.primary(path.depth)
        vertex = _Vertex(si, bsdf, bsdf.flags(), fresh, primary, diffuse, row, unknown, met.pane)
        _know_emitters(lighting, vertex, path.active, ends_at_first(lighting, cache))
        if not limits.recorded:
            # Direct light on the first surface is known, and a diffuse one contributes nothing else.
            diffuse_only = (vertex.flags & NOT_DIFFUSE_REFLECTION) == 0
            vertex.emitters_only |= path.active & (path.depth == 0) & diffuse_only

        # Choose the lobes by which the path continues.
        dielectric, reflected = branches.at_dielectric(bsdfs, bsdf, path.active)
        ways = limits.glossy_branches
        split = branches.at_gloss(bsdfs, vertex.flags, ways, path.active & vertex.primary & ~vertex.layer)
        from_base = _base_branch(bsdfs, branches, path, tail, vertex, reflected | ~dielectric)
        choice = Choice(vertex.layer & ~from_base, from_base, dielectric, reflected)

        # Sample emitters.
        smooth = path.active & fresh & mi.has_flag(vertex.flags, mi.BSDFFlags.Smooth)
        if not limits.recorded:
            smooth &= path.depth > 0
        count = dr.select(vertex.primary, mi.UInt32(lighting.emitter_samples), 1)
        receiver = Receiver(si, row, count, vertex.emitters_only, mi.Bool(cache is not None))
        sample = numbers.sample_2d(Purpose.EMITTER)
        light = emitter_samples(lighting, receiver, _scatter(bsdfs, vertex), sample, smooth)
        given = path.throughput * light
        sums.direct += dr.select(path.depth == 0, given, 0)
        sums.radiance += dr.select(path.depth == 0, 0, given)

        # Sample the BSDF.
        draw = branches.draw(samples, path.depth, ways, split)
        direction = _direction(bsdfs, vertex, draw, choice, path.active)
        cached = dr.select(
            diffuse.active & fresh, path.throughput * diffuse.albedo * irradiance * dr.inv_pi, 0
        )
        _add_cached(sums, cached, path, vertex, direction, dielectric)

        # From a rough layer, look for the cached sky in further directions.
        if _rough_layers_under_sky(lighting, cache):
            directions = limits.sky_directions
            rough = path.active & choice.layer & fresh & ((vertex.flags & GLOSSY_FLAGS) != 0)
            sums.radiance += path.throughput * sky_in_layer(lighting, si, bsdf, numbers, directions, rough)
            tail.sky_share = dr.select(rough, dr.rcp(mi.Float(directions)), 1)

        # Continue: emission counts for all lobes, everything else for the non-diffuse ones.
        _split(bsdfs, direction, split, ways)
        _leave(lighting, path, tail, vertex, choice, direction)
        if ends_at_first(lighting, cache):
            path.active &= vertex.unknown
        restart = branches.leave(bsdfs, path, dielectric, reflected)
        tail.departure.delta |= restart
        tail.faint &= ~restart
        tail.throughput = dr.select(restart, mi.Color3f(1), tail.throughput)
        tail.looked = None if tail.looked is None else tail.looked & ~restart
    return sums.shade()


def _add_emission(sums: _Sums, found: Emission, path: CameraPath, tail: _Tail, cached_sky: bool) -> None:
    """Add what a surface or the environment emits towards the previous vertex."""
    at_once = found.active & path.clear
    sums.emitted = dr.select(at_once, sums.emitted + tail.throughput * found.radiance, sums.emitted)
    lit = found.active & ~at_once
    radiance = found.radiance
    if cached_sky:
        # The cache holds this part of the environment for all diffuse lobes.
        held = radiance * found.cached
        for_others = path.throughput * tail.sky_share * held
        sums.radiance = dr.select(lit, sums.radiance + for_others, sums.radiance)
        radiance = radiance - held
    given = tail.throughput * radiance * found.mis
    from_first = lit & (path.depth == 1)
    sums.direct = dr.select(from_first, sums.direct + given, sums.direct)
    sums.radiance = dr.select(lit & ~from_first, sums.radiance + given, sums.radiance)


def _look_up(
    cache: DeviceCache | None, si: mi.SurfaceInteraction3f, diffuse: DiffuseLobe, asks: mi.Bool
) -> DeviceAnswer:
    """Irradiance, W/m², weight, and the record of the largest weight; black without a cache."""
    if cache is None:
        return DeviceAnswer(mi.Color3f(0), mi.Float(1), mi.UInt32(NO_ROW))
    return cache.look_up(si.p, diffuse.normal, asks, diffuse.facing)


def _know_emitters(lighting: Lighting, vertex: _Vertex, active: mi.Bool, only_samples: bool) -> None:
    """Decide whether rays look for emitters, and by which lobes."""
    enough = lighting.emitters.emitters_only(vertex.row, active)
    alone = ((vertex.flags & NOT_DIFFUSE_REFLECTION) == 0) & ~vertex.unknown
    vertex.emitters_only = active & alone & enough
    if only_samples:
        vertex.emitters_only = ~vertex.unknown
    vertex.layer = vertex.near = mi.Bool(False)
    if lighting.bsdfs.layered is not None:
        vertex.layer = active & vertex.primary & lighting.bsdfs.is_layered(vertex.bsdf, active)
        vertex.near = vertex.layer & ~enough


def _base_branch(
    bsdfs: BSDFTraits, branches: Branches, path: CameraPath, tail: _Tail, vertex: _Vertex, arrived: mi.Bool
) -> mi.Bool:
    """Lanes that leave the diffuse base under a specular layer: the last branch, if an emitter is near."""
    if bsdfs.layered is None:
        return mi.Bool(False)
    branches.add(1, vertex.near)
    tail.base = tail.base | (vertex.near & (branches.number == 0))
    last = tail.base & vertex.primary & arrived & (branches.number > 0) & (branches.pending == 0)
    # On an edge, the same ray may hit another surface this time, and would continue where the audit has never been.
    path.active = path.active & (vertex.near | ~last)
    return vertex.near & last


def _scatter(bsdfs: BSDFTraits, vertex: _Vertex) -> Scatter:
    """All lobes for emitter samples, with the combined density of the rays that look for emitters."""

    def scatter(wo: mi.Vector3f, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si, wo, active)
        if bsdfs.layered is not None:
            of_layer = vertex.bsdf.pdf(other_context(), vertex.si, wo, active & vertex.layer)
            of_base = dr.select(vertex.near, cosine_pdf(vertex.si.wi, wo), 0)
            pdf = dr.select(vertex.layer, of_layer + of_base, pdf)
        return value, pdf

    return scatter


def _direction(bsdfs: BSDFTraits, vertex: _Vertex, draw: Draw, choice: Choice, active: mi.Bool) -> _Direction:
    """The direction in which a path continues; if all BSDFs are diffuse, the sample that estimated the albedo."""
    if bsdfs.only_diffuse and bsdfs.uneven is None:
        return _Direction(vertex.diffuse.sample, vertex.diffuse.albedo, mi.Float(1))
    bs, weight = bsdfs.sample(vertex.si, vertex.bsdf, draw, choice, active & ~vertex.emitters_only)
    return _Direction(bs, weight, mi.Float(1))


def _split(bsdfs: BSDFTraits, direction: _Direction, split: mi.Bool, ways: mi.UInt32) -> None:
    """Divide the weight of a direction among the directions of a split."""
    if bsdfs.glossy:
        direction.count = dr.select(split, mi.Float(ways), 1)
        direction.weight = direction.weight / direction.count


def _add_cached(
    sums: _Sums,
    cached: mi.Color3f,
    path: CameraPath,
    vertex: _Vertex,
    direction: _Direction,
    both_ways: mi.Bool,
) -> None:
    """Add light from the cache; with layers, record the features of the surface for the denoiser."""
    if sums.cached is None:
        sums.radiance = sums.radiance + cached
        return
    # Light seen by a glossy bounce has the noise of its direction, and light behind a partial mask that of its random
    # choice. A hole in a mask is certain, and so are a mirror and a delta dielectric where the path branches.
    first, quiet = path.depth == 0, sums.first & sums.certain
    sums.indirect = sums.indirect + dr.select(first, cached, 0)
    sums.cached = sums.cached + dr.select(quiet & ~first, cached, 0)
    sums.radiance = sums.radiance + dr.select(quiet, 0, cached)
    first = sums.first & path.active
    through = mi.has_flag(direction.sample.sampled_type, mi.BSDFFlags.Null)
    chosen = mi.has_flag(direction.sample.sampled_type, mi.BSDFFlags.Delta) & ~both_ways
    sums.certain = sums.certain & (~chosen | (direction.sample.pdf > CERTAIN))
    here = first & mi.has_flag(vertex.flags, mi.BSDFFlags.Smooth) & ~through
    rho = vertex.bsdf.eval_diffuse_reflectance(vertex.si, here)
    rho = dr.select(mi.has_flag(vertex.flags, mi.BSDFFlags.Diffuse), rho, 1)
    sums.albedo = dr.select(here, dr.clip(path.throughput * rho, 0, 1), sums.albedo)
    towards = mi.Color3f(dr.mulsign(vertex.si.sh_frame.n, vertex.si.wi.z))
    sums.normal = dr.select(here, towards, sums.normal)
    sums.first = first & ~here


def _leave(
    lighting: Lighting,
    path: CameraPath,
    tail: _Tail,
    vertex: _Vertex,
    choice: Choice,
    direction: _Direction,
) -> None:
    """Continue the path: throughputs, and what the next hit needs to know."""
    bsdfs, si = lighting.bsdfs, vertex.si
    bs, weight = direction.sample, direction.weight
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    tail.throughput = path.throughput * weight
    pdf = bs.pdf
    goes_on = (dr.any(tail.throughput != 0) | choice.base) & ~vertex.emitters_only
    tail.faint = tail.faint | vertex.unknown
    if bsdfs.only_diffuse:
        path.throughput = dr.select(vertex.unknown, tail.throughput, 0)
    else:
        others = path.active & ((vertex.flags & OTHER_FLAGS) != 0) & ~delta & ~vertex.layer
        share = bsdfs.weight_of_others(si, vertex.bsdf, bs, direction.count, vertex.diffuse, others)
        if bsdfs.layered is not None:
            # Layer and base may each continue in one direction. Emission at the end of either counts for both lobes:
            # their value over the sum of the two densities (the balance heuristic).
            by_pdf = vertex.layer & ~delta
            of_both = vertex.bsdf.eval(mi.BSDFContext(), si, bs.wo, by_pdf)
            of_layer = vertex.bsdf.pdf(other_context(), si, bs.wo, choice.base)
            of_layer = dr.select(choice.base, of_layer, pdf)
            of_base = dr.select(vertex.near, cosine_pdf(si.wi, bs.wo), 0)
            pdf_both = of_layer + of_base
            of_both = bsdfs.finite(dr.select(pdf_both > 0, of_both / pdf_both, 0))
            tail.throughput = dr.select(by_pdf, path.throughput * of_both, tail.throughput)
            pdf = dr.select(by_pdf, pdf_both, pdf)
        after = dr.select(delta | vertex.layer | vertex.unknown, weight, share)
        path.throughput = path.throughput * dr.select(choice.base, 0, after)
        path.ways = path.ways * direction.count
    if vertex.pane is not None:
        straight = vertex.pane & lighting.panes.transmits(bs)
        tail.looked = straight & (tail.looked | ~tail.departure.delta)
    counted = dr.select(vertex.primary, mi.Float(lighting.emitter_samples), 1)
    tail.departure = Departure(si, vertex.row, pdf, delta, counted)
    path.clear = path.clear & delta
    path.ray = si.spawn_ray(si.to_world(bs.wo))
    path.active = path.active & goes_on
