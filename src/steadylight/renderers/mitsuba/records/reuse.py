"""Spatial reuse: strata of a record's hemisphere that see what the pilot samples of other records found bright.

The inside of a lampshade or a patch of sun may be a thousandth of a record's hemisphere and a fifth of its light. Its
own pilot samples, one per stratum, usually miss it; those of all records that are made together hardly ever do. Each
record therefore traces paths to some of their hits, chosen in proportion to brightness and to the cosine at the record,
much as ReSTIR GI reuses paths of neighbouring pixels (Ouyang et al. 2021, doi:10.1111/cgf.14378). These paths only
guide the refinement samples, whose mean remains unbiased.
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
"""Such paths per record: at most a tenth of all its paths. In a room lit from within a lamp's tube, the noise of most
records falls from 32 to 4.2 % with 8, 3.0 % with 16 and 2.8 % with 64 (docs/experiments.md)."""

CANDIDATES = 12
"""Hits among which each of them is chosen, by the cosine at the record: half of what is bright lies behind its wall."""


class Looks(NamedTuple):
    """Paths towards bright hits; one lane per path, `SAMPLES` consecutive ones per record."""

    record: mi.UInt32  # of the batch
    stratum: mi.UInt32
    place: mi.Point2f  # in the stratum, [0, 1)²
    number: mi.UInt32  # index within the record
    possible: mi.Bool  # whether the hit is above the horizon; if not, the path follows the normal


def looks_at_bright(
    seen: mi.Float,
    pilot: PathSamples,
    place: mi.Point2f,
    origin: mi.Point3f,
    normal: mi.Normal3f,
    strata: tuple[mi.UInt32, mi.UInt32],
) -> Looks | None:
    """Paths from records towards hits of pilot samples, chosen in proportion to their brightness.

    Args:
        seen: Float, luminance of the surfaces that the pilot paths hit, at least 0; 0 where they hit none.
        pilot: one path in each stratum of each record.
        place: Point2f, positions of these paths in their strata.
        origin: Point3f, origin of each record's paths.
        normal: Normal3f, unit, of the records.
        strata: M in elevation, N in azimuth.

    Returns:
        None if no surface was bright.
    """
    M, N = strata
    count = dr.width(origin)
    found = _chosen(np.array(seen), count)
    if found is None:
        return None
    sample = upload(mi.UInt32, found)
    finder, stratum = split(sample, M * N)
    away = direction(*angles(stratum, dr.gather(mi.Point2f, place, sample), M, N))
    frame = mi.Frame3f(dr.gather(mi.Normal3f, normal, finder))
    away = frame.to_world(away) * dr.gather(mi.Float, pilot.distance, sample)
    hit = mi.Point3f(dr.gather(mi.Point3f, origin, finder) + away)
    record, _ = split(dr.arange(mi.UInt32, len(found)), CANDIDATES * SAMPLES)
    d = dr.normalize(hit - dr.gather(mi.Point3f, origin, record))
    cosine = dr.maximum(dr.dot(d, dr.gather(mi.Normal3f, normal, record)), 0)
    dr.eval(hit, cosine)

    kept = upload(mi.UInt32, _kept(np.array(cosine).reshape(count, -1)))
    record, number = split(dr.arange(mi.UInt32, count * SAMPLES), SAMPLES)
    d = mi.Frame3f(dr.gather(mi.Normal3f, normal, record)).to_local(
        dr.gather(mi.Point3f, hit, kept) - dr.gather(mi.Point3f, origin, record)
    )
    possible = d.z > 0
    d = dr.select(possible, dr.normalize(d), mi.Vector3f(0, 0, 1))
    looks = Looks(record, *place_towards(d, M, N), number, possible)
    dr.eval(*looks)
    return looks


def _chosen(luminance: NDArray[np.float32], count: int) -> NDArray[np.uint32] | None:
    """(count * CANDIDATES * SAMPLES,) pilot samples, drawn in proportion to luminance; None if all are black.

    Drawn at even steps of the cumulative luminance, interleaved so that each record's draws are spread over all.
    """
    total = np.cumsum(luminance, dtype=np.float64)
    if not total[-1] > 0:
        return None
    each = CANDIDATES * SAMPLES
    steps = (np.arange(count * each) + 0.5) / (count * each) * total[-1]
    found = np.searchsorted(total, steps, side="right").astype(np.uint32)
    return np.ascontiguousarray(found.reshape(each, count).T.ravel())


def _kept(cosine: NDArray[np.float32]) -> NDArray[np.uint32]:
    """(count * SAMPLES,) of (count, CANDIDATES * SAMPLES) candidates, drawn in each row in proportion to the cosine."""
    count, each = cosine.shape
    total = np.cumsum(cosine, axis=1, dtype=np.float64)
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES * total[:, -1:]
    kept = [(total <= step[:, None]).sum(axis=1) for step in steps.T]
    rows = np.minimum(np.stack(kept, axis=1), each - 1) + each * np.arange(count)[:, None]
    return rows.ravel().astype(np.uint32)
