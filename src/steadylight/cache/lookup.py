"""Weights and extrapolation of records at surface points: the readable twin of `renderers/mitsuba/records/lookup.py`.

A record contributes to a query point within an ellipsoid that is flat along the record's surface, for normals that
differ little. Its weight is

    w = max(0, 1 - d² - (1 - n·n_i) / t)²,   d² = (|x - p_i|² + (k² - 1) h²) / radius²

with k = FLATNESS, t = NORMAL_TOLERANCE, and the height h of the point over the record (`height_over`). The two terms
are those of Ward, Rubinstein & Clear's error (1988, eq. 4, doi:10.1145/54852.378490), each squared. The outer square
makes the weight and its first derivative zero at the border, so that no seam is visible where a record begins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.records import Floats, Records

Reals = NDArray[np.floating]

FLATNESS = 3.0
"""k: weight of a displacement away from the record's surface relative to one along it."""

STEP = 0.05
"""A record is rejected if its surface lies in front of or behind that of the query point by more than this fraction of
its radius. A record on a tile sees more than the joint between tiles does, and one in the joint sees less than the tile
does."""

HEADROOM = 0.5
"""A query point is rejected if it lies above or below the record's surface by more than this fraction of the free
height above the record. What covers the record, such as a table top, also has a side that faces the same way as the
record. Where both surfaces curve away, as the two skins of a lampshade do, that side may even lie below the record's
surface."""

BEHIND = 1.1
"""A query point is rejected beyond this many times the distance of a wall beside the record, which sees none of what
lights the other side. This matters where the radius cannot become as small as that distance. The distance of a wall is
known within some percent; at 1.0, what stands at the foot of a wall would need 10 % more records."""

STRETCHED = 3.0
"""Factor on radius and tolerance of normals of the records that are used where none is within its own radius."""

ANSWERED = 0.05
"""Minimum sum of weights that counts as a hit when records are made; the second pass also accepts smaller sums."""

ROUNDING = 1e-3
"""Relative difference within which two radii count as equal."""


class Answer(NamedTuple):
    """Result of a look-up at Q points."""

    irradiance: Floats  # (Q, 3) W/m², zero on a miss
    weight: Floats  # (Q,) sum of weights


def height_over(offset: Reals, normal: Reals, surface: Reals) -> Reals:
    """Height of points over a surface, metres, at least 0, whether it is as flat as its triangles or curves as shown.

    A mesh with interpolated normals may stand for a curved surface, to which these are perpendicular, or for a flat
    wall, which they have nothing to do with. We take the lower of both heights.

    Args:
        offset: (..., 3) from the surface to the points, metres.
        normal: (..., 3) unit normal, which may be interpolated.
        surface: (..., 3) unit normal of the triangle.
    """
    curved, flat = (np.abs(np.einsum("...i,...i", offset, each)) for each in (normal, surface))
    return np.asarray(np.minimum(curved, flat))


def step_between(offset: Reals, normal: Reals, surface: Reals, other: Reals) -> Reals:
    """Height of one point over another, metres, at least 0: 0 on a plane, and on a surface of constant curvature.

    As `height_over`, but along the mean of both interpolated normals.

    Args:
        offset: (..., 3) from the second point to the first, metres.
        normal: (..., 3) unit, at the second point.
        surface: (..., 3) unit normal of the triangle there.
        other: (..., 3) unit, at the first point.
    """
    return height_over(offset, (normal + other) / 2, surface)


def pair_weights(
    position: Floats,
    normal: Floats,
    records: Records,
    rows: NDArray[np.intp] | slice = slice(None),
    stretch: float = 1.0,
) -> Floats:
    """Weight of record `rows[i]` at point i.

    Args:
        position: (..., 3) world position, metres; broadcasts against the records.
        normal: (..., 3) unit normal on the lit side.
        records: the cache.
        rows: row of the record that belongs to each point.
        stretch: multiplies radius and tolerance of normals.

    Returns:
        (...) non-negative weights, not normalised.
    """
    n_i = records.normal[rows]
    offset = position - records.position[rows]
    surface = records.surface[rows]
    height = height_over(offset, n_i, surface)
    distance2 = np.einsum("...i,...i", offset, offset)
    radius = records.radius[rows] * np.float32(stretch)
    cosine = np.einsum("...i,...i", np.broadcast_to(normal, offset.shape), n_i)
    error = (distance2 + (FLATNESS**2 - 1) * height**2) / radius**2 + (1 - cosine) / (
        NORMAL_TOLERANCE * stretch
    )
    weight = np.maximum(0, 1 - error) ** 2
    # A record in front of the point sees a different half space (Ward et al. 1988, eq. 5), as does one behind it.
    step = step_between(offset, n_i, surface, normal)
    hidden = (step > STEP * radius) | (height > HEADROOM * records.headroom[rows])
    hidden |= (np.einsum("...i,...ji->...j", offset, records.barriers[rows]) > BEHIND).any(axis=-1)
    return np.where(hidden, 0, weight).astype(np.float32)


def extrapolated(
    position: Floats,
    normal: Floats,
    records: Records,
    rows: NDArray[np.intp] | slice = slice(None),
    facing: Floats | None = None,
) -> Floats:
    """Irradiance that record `rows[i]` predicts at point i: E (1 - c (1 - cos phi)) plus the gradient terms.

    phi is the angle between the normals, and c is the rotational curvature. On a curved surface, the gradients alone
    (Ward & Heckbert 1992) would overestimate irradiance, since a cosine is concave.

    Args:
        position: (..., 3) world position, metres; broadcasts against the records.
        normal: (..., 3) unit normal on the lit side.
        records: the cache.
        rows: row of the record that belongs to each point.
        facing: (..., 3) unit normal of the diffuse lobe, which a normal map may turn; `normal` if None. A turned lobe
            gains half as much light as a turned surface, since the surface hides the rest: its curvature is
            (1 + c) / 2.

    Returns:
        (..., K, 3) W/m², for each value separately; may be negative far from the record.
    """
    n_i = records.normal[rows]
    offset = position - records.position[rows]
    facing = normal if facing is None else facing
    turn = np.cross(n_i, facing)
    lean = 1 - np.einsum("...x,...x", n_i, np.broadcast_to(normal, offset.shape))
    turned = 1 - np.einsum("...x,...x", normal, facing)
    c = records.curvature[rows]
    return np.asarray(
        records.irradiance[rows] * (1 - c * lean[..., None] - (1 + c) / 2 * turned[..., None])[..., None]
        + np.einsum("...kcx,...x->...kc", records.translation[rows], offset)
        + np.einsum("...kcx,...x->...kc", records.rotation[rows], turn)
    )


def look_up(position: Floats, normal: Floats, records: Records, facing: Floats | None = None) -> Answer:
    """Interpolated irradiance at Q points, by brute force over all records: the reference implementation.

    Args:
        position: (Q, 3) world position, metres.
        normal: (Q, 3) unit normal on the lit side.
        records: R records.
        facing: (Q, 3) unit; see `extrapolated`.

    Returns:
        Irradiance, the sum of all values, each extrapolated by the gradients (Ward & Heckbert 1992) and clamped to be
        non-negative; and the sum of weights.
    """
    weight = pair_weights(position[:, None], normal[:, None], records)
    turned = None if facing is None else facing[:, None]
    every = slice(None)
    E = np.maximum(extrapolated(position[:, None], normal[:, None], records, every, turned), 0).sum(axis=-2)
    share = weight / records.radius**2
    irradiance = np.einsum("qr,qrc->qc", share, E)
    irradiance /= np.maximum(share.sum(axis=1), np.finfo(np.float32).tiny)[:, None]
    return Answer(irradiance.astype(np.float32), weight.sum(axis=1).astype(np.float32))
