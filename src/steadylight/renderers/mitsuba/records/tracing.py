"""Paths from records into their hemispheres, traced by one kernel for all kinds of records."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.frozen import frozen, widths
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.records.caustics import CausticMap
from steadylight.renderers.mitsuba.records.hemisphere import angles, direction
from steadylight.renderers.mitsuba.records.indirect import Secondary, indirect_radiance
from steadylight.renderers.mitsuba.records.origins import Hemispheres
from steadylight.renderers.mitsuba.sampling import samples_of


class GatherContext(NamedTuple):
    """What the gather's paths meet, and what reduces their noise without changing their mean.

    Attributes:
        lighting: of the scene.
        secondary: irradiance at surfaces that paths hit (see `indirect_radiance`); None to trace all paths to the end.
        caustics: light that paths leave out, for records; None if there is none.
    """

    lighting: Lighting
    secondary: Secondary | None = None
    caustics: CausticMap | None = None

    def state(self) -> list[object]:
        """All that a kernel reads through these, for `frozen`."""
        cache = [] if self.secondary is None else self.secondary.arrays()
        return [*self.lighting.arrays(), cache]


@dataclass
class Paths:
    """Paths to trace, one lane per path."""

    record: mi.UInt32  # of the batch
    stratum: mi.UInt32
    place: mi.Point2f  # in the stratum, [0, 1)²
    index: mi.UInt32  # number of the path within the record: its index in the point set that they share


@dataclass
class Constants:
    """Constants of all paths that are traced together."""

    seed: mi.UInt32  # opaque
    first: mi.UInt32  # opaque: number of the batch's first record
    # Opaque: as a literal, each number of bounces of the secondary cache would compile its own kernels.
    bounces: mi.UInt32
    polar_strata: mi.UInt32  # opaque
    azimuth_strata: mi.UInt32  # opaque
    share: mi.UInt32  # opaque: number of consecutive records whose paths share a point set


def _trace_paths(
    context: GatherContext,
    hemispheres: Hemispheres,
    paths: Paths,
    constants: Constants,
) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """Radiance, distance and tangent of paths: the fields of `PathSamples`.

    What lies below a record's own surface moves with it, as if it were infinitely far. Called through `traced`.

    Args:
        context: of the gather.
        hemispheres: of the records.
        paths: which to trace.
        constants: the same for all.
    """
    M, N = constants.polar_strata, constants.azimuth_strata
    cos_theta, sin_theta, phi = angles(paths.stratum, paths.place, M, N)
    frame = mi.Frame3f(dr.gather(mi.Normal3f, hemispheres.normal, paths.record))
    d = frame.to_world(direction(cos_theta, sin_theta, phi))
    ray, beneath = hemispheres.ray(paths.record, d)
    samples = samples_of(constants.seed, paths.record // constants.share + constants.first, paths.index)
    L, distance = indirect_radiance(context.lighting, samples, ray, constants.bounces, context.secondary)
    L *= hemispheres.transmittance(context.lighting.bsdfs, paths.record, cos_theta)
    # One path that hits a singularity must not stop an animation.
    L = dr.select(dr.all(dr.isfinite(L)), L, 0)
    distance = dr.select(beneath, dr.inf, distance)
    tangent = sin_theta / dr.maximum(cos_theta, 1e-4)
    dr.eval(L, distance, tangent)
    return L, distance, tangent


_Lanes = TypeVar("_Lanes", Hemispheres, Paths, "mi.UInt32")

_recorded = frozen(_trace_paths, GatherContext.state)


def traced(
    context: GatherContext, hemispheres: Hemispheres, paths: Paths, constants: Constants
) -> tuple[mi.Color3f, mi.Float, mi.Float]:
    """See `_trace_paths`. A recording fits batches of all sizes: lanes are repeated until the widths are unique."""
    count, taken = dr.width(paths.record), widths(context.state())
    hemispheres = _wider(hemispheres, dr.width(hemispheres.bsdf), taken)
    taken.add(dr.width(hemispheres.bsdf))
    bounces = constants.bounces  # of each path, or of all
    if dr.width(bounces) > 1:
        constants = replace(constants, bounces=_wider(bounces, count, taken))
    paths = _wider(paths, count, taken)
    L, distance, tangent = _recorded(context, hemispheres, paths, constants)
    if dr.width(paths.record) > count:
        row = dr.arange(mi.UInt32, count)
        L = dr.gather(mi.Color3f, L, row)
        distance, tangent = (dr.gather(mi.Float, each, row) for each in (distance, tangent))
        dr.eval(L, distance, tangent)
    return L, distance, tangent


def _wider(lanes: _Lanes, count: int, taken: set[int]) -> _Lanes:
    """The same lanes, and the last of them until the width is not taken."""
    width = count
    while width in taken:
        width += 1
    if width == count:
        return lanes
    row = dr.minimum(dr.arange(mi.UInt32, width), dr.opaque(mi.UInt32, count - 1))
    wider = dr.gather(type(lanes), lanes, row)
    dr.eval(wider)
    return wider


def single_paths(
    context: GatherContext, start: Hemispheres, paths: Paths, share: int, seed: int, bounces: mi.UInt32 | int
) -> mi.Color3f:
    """Radiance along single paths into hemispheres, of which `share` consecutive ones belong to one record.

    Args:
        context: of the gather.
        start: of all hemispheres.
        paths: `record` is the hemisphere of each; there is one stratum.
        share: number of hemispheres whose paths share a point set.
        seed: of the paths.
        bounces: maximum number of scattering events, of each path or of all.
    """
    none, polar, azimuth, each = (dr.opaque(mi.UInt32, number) for number in (0, 1, 1, share))
    constants = Constants(dr.opaque(mi.UInt32, seed), none, mi.UInt32(bounces), polar, azimuth, each)
    dr.make_opaque(start, constants.bounces)
    dr.make_opaque(paths.record, paths.stratum, paths.place, paths.index)
    return traced(context, start, paths, constants)[0]
