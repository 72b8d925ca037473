"""Light at one vertex of a path, shared by frames, by the gather and by extra samples of noisy pixels.

A vertex receives light in two ways: its scattered ray hits an emitter (`emission`), and emitters are sampled
(`emitter_samples`). Both are weighted by multiple importance sampling with the power heuristic (Veach 1997, eq. 9.13).
Cached sky is not among the sampled emitters; for glossy lobes, several rays may look for it (`sky_in_layer`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits, other_context
from steadylight.renderers.mitsuba.frozen import loaded
from steadylight.renderers.mitsuba.light.emitters import NO_ROW, EmitterSampling
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.panes import Panes
from steadylight.renderers.mitsuba.sampling import GOLDEN, VertexSamples, spread, wrapped

Scatter = Callable[["mi.Vector3f", "mi.Bool"], tuple["mi.Color3f", "mi.Float"]]
"""(direction in the local frame, active) -> BSDF value times cosine, and its density per steradian, for MIS."""


class Lighting:
    """What kernels need of a scene to light a vertex.

    Not a dataclass: Dr.Jit would treat it as loop variables.

    Attributes:
        scene: mi.Scene.
        bsdfs: lobes of its surfaces.
        environment: how it is divided between cache and direct light.
        emitters: which emitter to sample where.
        emitter_samples: number at the vertex that matters most: the primary surface in a frame, the first hit of a
            gather path.
        still: the scene never changes, so recordings need not check it.
    """

    def __init__(
        self,
        scene: mi.Scene,
        bsdfs: BSDFTraits,
        environment: Environment,
        emitters: EmitterSampling,
        emitter_samples: int,
        *,
        still: bool = False,
    ) -> None:
        self.scene, self.bsdfs, self.environment = scene, bsdfs, environment
        self.emitters, self.emitter_samples, self.still = emitters, emitter_samples, still

    @property
    def panes(self) -> Panes:
        """What light passes straight through."""
        return self.emitters.panes

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, or that is compiled into it, for `frozen`."""
        parts = (self.environment, self.emitters, self.panes, self.bsdfs)
        scene = loaded(self.scene, self.emitters.unasked) if self.still else [self.scene]
        # Mitsuba compiles constants of a scene into kernels without Dr.Jit's knowledge: a number separates recordings.
        number = self.environment.scene_number
        return [scene, number, self.emitter_samples, *(part.arrays() for part in parts)]


@dataclass
class Departure:
    """The vertex that a ray left, as needed for MIS at an emitter that the ray hits.

    Attributes:
        si: the vertex.
        row: row of the emitter table that is used there.
        pdf: density of the ray's direction, per steradian.
        delta: whether no other direction was possible: emitter samples could not have found it.
        samples: number of emitter samples that were taken there.
    """

    si: mi.SurfaceInteraction3f
    row: mi.UInt32
    pdf: mi.Float
    delta: mi.Bool
    samples: mi.Float

    @classmethod
    def nowhere(cls) -> Departure:
        """Departure of a ray that no vertex scattered."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        return cls(si, mi.UInt32(NO_ROW), mi.Float(1), mi.Bool(True), mi.Float(1))


@dataclass
class Receiver:
    """A vertex at which emitters are sampled.

    Attributes:
        si: the vertex.
        row: row of the emitter table that is used here.
        samples: number of emitter samples.
        emitters_only: emitter sampling is enough: no scattered ray looks for emitters, and samples have MIS weight 1.
        cached: the cache holds its part of the environment's light here.
    """

    si: mi.SurfaceInteraction3f
    row: mi.UInt32
    samples: mi.UInt32
    emitters_only: mi.Bool
    cached: mi.Bool


class Emission(NamedTuple):
    """Emission met by a ray.

    Attributes:
        radiance: towards the origin of the ray, W/(m² sr).
        mis: its weight against emitter samples at the origin of the ray.
        cached: fraction of it that the cache holds for diffuse lobes; 0 except for the environment.
        active: lanes that hit an emitter.
    """

    radiance: mi.Color3f
    mis: mi.Float
    cached: mi.Float
    active: mi.Bool


class Met(NamedTuple):
    """End of a ray that looks for emitters: behind panes, if light passes straight through the first surface.

    Attributes:
        si: the surface; invalid if the ray leaves the scene.
        pane: whether the first surface is a pane, at least in part; None if the scene has none.
        transmittance: of the panes in between; None if the scene has none.
        distance: from the origin of the ray, metres; infinite if there is no surface.
    """

    si: mi.SurfaceInteraction3f
    pane: mi.Bool | None
    transmittance: mi.Color3f | None
    distance: mi.Float


def look_beyond(
    lighting: Lighting, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, looks: mi.Bool, active: mi.Bool
) -> Met:
    """Find the end of a ray that looks for emitters.

    Args:
        lighting: of the scene.
        si: the first surface that it meets.
        ray: the ray.
        looks: lanes that look behind panes: emitters are sampled at their origin, or the second pass does so.
        active: lanes.
    """
    panes = lighting.panes
    if not panes.some:
        return Met(si, None, None, si.t)
    through = panes.transmission(si, active)
    beyond = panes.beyond(si, ray.d, through, looks)
    return Met(beyond.si, dr.any(through != 0), beyond.transmittance, beyond.distance)


def emission(lighting: Lighting, met: Met, departure: Departure, active: mi.Bool) -> Emission:
    """Emission at the end of a ray.

    Args:
        lighting: of the scene.
        met: where the ray ends.
        departure: where it began.
        active: lanes.
    """
    si = met.si
    emitter = si.emitter(lighting.scene)
    lit = active & (emitter != None)  # noqa: E711 - element-wise
    radiance = emitter.eval(si, lit)
    looks = lit & ~departure.delta
    pdf = lighting.emitters.pdf(departure.si, departure.row, si, emitter, looks) * departure.samples
    mis = dr.select(departure.delta, 1, mis_weight(departure.pdf, pdf))
    cached = dr.select(si.is_valid(), 0, lighting.environment.cached_fraction(radiance))
    if met.transmittance is not None:
        radiance = radiance * met.transmittance
    return Emission(radiance, mis, cached, lit)


@dr.syntax
def emitter_samples(
    lighting: Lighting, vertex: Receiver, scatter: Scatter, sample: mi.Point2f, active: mi.Bool
) -> mi.Color3f:
    """Radiance that a vertex scatters from emitters, estimated by sampling these.

    Args:
        lighting: of the scene.
        vertex: where, and how many samples.
        scatter: the BSDF, and the density of scattered rays that look for emitters too.
        sample: point in [0, 1)² from which all samples are made, in strata.
        active: lanes.

    Returns:
        W/(m² sr), without the throughput of the path; 0 in inactive lanes.
    """
    L = mi.Color3f(0)
    per_sample = dr.rcp(mi.Float(vertex.samples))
    k = mi.UInt32(0)
    while active & (k < vertex.samples):
        place = spread(sample, k, per_sample)
        ds, weight, radiance = lighting.emitters.sample(vertex.si, place, vertex.row, active)
        weight *= not_cached(lighting, vertex, ds, radiance)
        value, pdf = scatter(vertex.si.to_local(ds.d), active)
        value = lighting.bsdfs.finite(value)
        mis = mis_weight(ds.pdf * mi.Float(vertex.samples), pdf)
        mis = dr.select(ds.delta | vertex.emitters_only, 1, mis)
        L += dr.select(ds.pdf > 0, value * weight * (mis * per_sample), 0)
        k += 1
    return L


@dr.syntax
def sky_in_layer(
    lighting: Lighting,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    numbers: VertexSamples,
    directions: mi.UInt32,
    active: mi.Bool,
) -> mi.Color3f:
    """Radiance of the cached sky that a specular layer reflects, by directions that look for nothing else.

    Emitter samples omit the cached part of the sky, for all lobes. A path that leaves the layer samples it in one
    glossy direction; each further direction here takes a BSDF sample and a shadow ray only.

    Args:
        lighting: of a scene with an environment.
        si: the vertex.
        bsdf: `si.bsdf()`.
        numbers: of the vertex; the direction of the path that continues uses them too.
        directions: number of equally weighted directions, including that of the path, which is omitted here.
        active: lanes.

    Returns:
        W/(m² sr), without the throughput of the path; 0 in inactive lanes.
    """
    L = mi.Color3f(0)
    first = numbers.draw()
    share = dr.rcp(mi.Float(directions) - 1)  # of the directions sampled here
    k = mi.UInt32(1)
    while active & (k < directions):
        lobe, place = wrapped(first.lobe + GOLDEN * mi.Float(k)), spread(first.place, k - 1, share)
        bs, weight = bsdf.sample(other_context(), si, lobe, place, active)
        weight = lighting.bsdfs.finite(weight)
        ds, radiance = lighting.environment.towards(si, si.to_world(bs.wo), active)
        held = weight * radiance * lighting.environment.cached_fraction(radiance)
        L += held * lighting.emitters.arrives(si, ds, active & dr.any(held != 0)) / mi.Float(directions)
        k += 1
    return L


def all_lobes(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f) -> Scatter:
    """The whole BSDF of a surface, with the density of its own samples."""
    return lambda wo, active: bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)


def not_cached(
    lighting: Lighting, vertex: Receiver, ds: mi.DirectionSample3f, radiance: mi.Color3f
) -> mi.Float:
    """Fraction of an emitter's radiance that the cache does not hold at a vertex."""
    if not lighting.environment.exists:
        return mi.Float(1)
    held = vertex.cached & ds.emitter.is_environment()
    return dr.select(held, 1 - lighting.environment.cached_fraction(radiance), 1)


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic: weight of a sample drawn with density `pdf_a` that could have come from b."""
    # By their ratio: squares of densities exceed the range in which CUDA divides correctly.
    weight = dr.rcp(1 + dr.square(pdf_b / pdf_a))
    # 0 / 0, or inf / inf where a path lands on the emitter that it samples.
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))
