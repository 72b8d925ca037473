"""Strata of a record's hemisphere that see the environment, found by emitter samples.

A slit of a window behind furniture may be a thousandth of the hemisphere and a fifth of its light. The pilot samples,
one per stratum, usually miss it, and then it gets hardly any refinement samples: this is most of the noise of records
in rooms lit by the sky. Emitter samples, whose grid stores where the sky is visible, find it. They only guide the
refinement samples, whose mean remains unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.frozen import frozen
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.records.hemisphere import split, stratum_towards
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of

SAMPLES = 64
"""Emitter samples per record: about a tenth of the number of its paths, each at a third of the cost of a path."""


@dataclass
class _Given:
    """Inputs of the emitter samples, one lane per sample."""

    record: mi.UInt32  # of the batch
    number: mi.UInt32  # of the sample
    seed: mi.UInt32  # opaque
    first: mi.UInt32  # opaque: number of the batch's first record


def sky_in_strata(
    lighting: Lighting,
    origin: mi.Point3f,
    normal: mi.Normal3f,
    strata: tuple[int, int],
    seed: int,
    first: int,
) -> mi.Float:
    """Luminance of the cached part of the environment in each stratum, where emitter samples see it; 0 elsewhere.

    Args:
        lighting: of the scene.
        origin: Point3f, origin of each record's paths.
        normal: Normal3f, unit, of each record.
        strata: M in elevation, N in azimuth.
        seed: of the records.
        first: number of the first record.

    Returns:
        Float, by stratum.
    """
    count = dr.width(origin)
    seen = dr.zeros(mi.Float, count * strata[0] * strata[1])
    if lighting.environment.exists:
        samples = split(dr.arange(mi.UInt32, count * SAMPLES), SAMPLES)
        given = _Given(*samples, dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, first))
        divided = dr.opaque(mi.UInt32, strata[0]), dr.opaque(mi.UInt32, strata[1])
        stratum, value = _frozen_look(lighting, origin, normal, given, divided)
        # The maximum rather than the mean: sums would depend on the order in which threads add.
        dr.scatter_reduce(dr.ReduceOp.Max, seen, value, stratum, value > 0, mode=dr.ReduceMode.Direct)
    dr.eval(seen)
    return seen


def _look(
    lighting: Lighting,
    origin: mi.Point3f,
    normal: mi.Normal3f,
    given: _Given,
    strata: tuple[mi.UInt32, mi.UInt32],
) -> tuple[mi.UInt32, mi.Float]:
    """Stratum of each sample, among those of all records, and the luminance that it sees there.

    Called through `_frozen_look`.
    """
    M, N = strata
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = dr.gather(mi.Point3f, origin, given.record)
    si.n = dr.gather(mi.Normal3f, normal, given.record)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(0, 0, 1)
    si.t = mi.Float(1)
    # Branch 1, as paths use branch 0.
    numbers = samples_of(given.seed, given.record + given.first, given.number).at(mi.UInt32(1), mi.UInt32(0))
    row = lighting.emitters.row_at(si, mi.Bool(False), mi.Bool(True))
    found = lighting.emitters.sample(si, numbers.sample_2d(Purpose.EMITTER), row, mi.Bool(True))
    d = si.to_local(found.direction.d)
    arrives = dr.any(found.weight != 0) & found.direction.emitter.is_environment() & (d.z > 0)
    # As a path sees it: through panes.
    radiance = found.weight * found.direction.pdf
    held = mi.luminance(radiance) * lighting.environment.cached_fraction(found.radiance)
    value = dr.select(arrives & dr.isfinite(held), held, 0)
    stratum = given.record * (M * N) + stratum_towards(d, M, N)
    dr.eval(stratum, value)
    return stratum, value


_frozen_look = frozen(_look, Lighting.arrays)
