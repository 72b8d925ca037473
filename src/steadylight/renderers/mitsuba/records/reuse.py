"""Spatial reuse: which strata of a record's hemisphere see what the pilot samples of other records found bright.

The inside of a lampshade or a patch of sun may be a thousandth of a record's hemisphere and a fifth of its light. Its
own pilot samples, one in each stratum, miss it more often than not; those of all records that are made together hardly
do. So each record looks at some of the places that they hit, the brighter the likelier, much as ReSTIR GI reuses paths
of neighbouring pixels (Ouyang et al. 2021, doi:10.1111/cgf.14378). The paths there only tell where refinement samples
are worth most; what these measure stays unbiased.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.records.hemisphere import (
    PathSamples,
    angles,
    direction,
    place_towards,
    split,
)
from steadylight.renderers.mitsuba.upload import upload

SAMPLES = 16
"""Such paths of a record: a tenth of all that it takes, or less. In a room lit from within a lamp's tube, the noise of
most records falls from 32 to 4.2 % with 8, 3.0 % with 16 and 2.8 % with 64 (docs/experiments.md)."""


class Looks(NamedTuple):
    """Paths towards what was found; one lane a path, `SAMPLES` for each record in turn."""

    record: mi.UInt32  # of the batch
    stratum: mi.UInt32
    place: mi.Point2f  # in the stratum, [0, 1)²
    number: mi.UInt32  # which of the record
    possible: mi.Bool  # whether it is above the horizon; if not, the path goes along the normal


def looks_at_bright(
    seen: mi.Float,
    pilot: PathSamples,
    place: mi.Point2f,
    origin: mi.Point3f,
    normal: mi.Normal3f,
    strata: tuple[mi.UInt32, mi.UInt32],
) -> Looks | None:
    """Where else records should look: at places that pilot samples hit, as likely as these are bright.

    Args:
        seen: Float, luminance that the paths saw, at least 0.
        pilot: one path in each stratum of each record.
        place: Point2f, of these paths in their strata.
        origin: Point3f, where each record's paths start.
        normal: Normal3f, unit, of the records.
        strata: M in elevation, N in azimuth.

    Returns:
        None where no surface was bright.
    """
    M, N = strata
    count = dr.width(origin)
    found = _chosen(np.array(dr.select(dr.isfinite(pilot.distance), seen, 0)), count)
    if found is None:
        return None
    sample = upload(mi.UInt32, found)
    finder, stratum = split(sample, M * N)
    away = direction(*angles(stratum, dr.gather(mi.Point2f, place, sample), M, N))
    frame = mi.Frame3f(dr.gather(mi.Normal3f, normal, finder))
    hit = dr.gather(mi.Point3f, origin, finder)
    hit += frame.to_world(away) * dr.gather(mi.Float, pilot.distance, sample)

    record, number = split(dr.arange(mi.UInt32, count * SAMPLES), SAMPLES)
    d = mi.Frame3f(dr.gather(mi.Normal3f, normal, record)).to_local(
        hit - dr.gather(mi.Point3f, origin, record)
    )
    possible = d.z > 0
    d = dr.select(possible, dr.normalize(d), mi.Vector3f(0, 0, 1))
    looks = Looks(record, *place_towards(d, M, N), number, possible)
    dr.eval(*looks)
    return looks


def _chosen(luminance: NDArray[np.float32], count: int) -> NDArray[np.uint32] | None:
    """(count * SAMPLES,) numbers of pilot samples, each as likely as it is bright; None if none is.

    At even steps of the sum of the luminances: each record's samples are spread over all.
    """
    total = np.cumsum(luminance, dtype=np.float64)
    if not total[-1] > 0:
        return None
    steps = (np.arange(count * SAMPLES) + 0.5) / (count * SAMPLES) * total[-1]
    found = np.searchsorted(total, steps, side="right").astype(np.uint32)
    return np.ascontiguousarray(found.reshape(SAMPLES, count).T.ravel())
