"""The radius of a record, from what its hemisphere saw: two measures, of which `RecordQuality.radii` selects one.

The radius is `RecordQuality.accuracy` times the measure, and at most `accuracy` times the distance over which the
gradient alone would reduce irradiance to zero (Krivanek et al. 2005). Unless `RecordQuality.clamped` is off, it is at
most the distance to the nearest surface: a thin ledge hardly changes what a hemisphere sees, but below it, it is dark.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.quality import RecordQuality

AS_SPLIT_SPHERE = 6.0
"""Factor that makes the Hessian give about as many records as the split sphere at the same accuracy, in the bundled
scenes with few pixels between records."""


COVERED = 0.5
"""Fraction of the smallest radius down to which records under or beside something low may shrink."""


class Bounds(NamedTuple):
    """Smallest and largest radius at each point, metres; the same for every frame."""

    smallest: Floats  # (P,)
    largest: Floats  # (P,)

    def under(self, headroom: Floats) -> Bounds:
        """Bounds at points with something overhead: records under it must not extend far beyond its edge.

        Args:
            headroom: (P,) free height above each point, metres; see `Records`.
        """
        smallest = np.clip(headroom, COVERED * self.smallest, self.smallest)
        return Bounds(smallest.astype(np.float32), np.maximum(self.largest, smallest))


def extrapolated_radius(sums: Mapping[str, Floats], smallest: Floats, quality: RecordQuality) -> Floats:
    """Radius within which a record's gradient predicts the change of its light, metres; infinite if unlimited.

    Args:
        sums: by record, `closeness` and `nearest` as in `gradients.reduced`; for the occlusion Hessian also `xx`, `xy`
            and `yy` (`hessian.second_derivatives`).
        smallest: (P,) smallest radius, metres.
        quality: `radii`, `accuracy` and `clamped` are used.

    Returns:
        (P,) non-negative.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if quality.radii == "occlusion-hessian":
            measure = occlusion_hessian(sums["xx"], sums["xy"], sums["yy"], smallest)
        else:
            measure = split_sphere(sums["closeness"], quality.strata)
    radius = quality.accuracy * measure
    return np.minimum(radius, sums["nearest"]) if quality.clamped else radius


def wanted_radius(extrapolated: Floats, steepness: Floats, quality: RecordQuality) -> Floats:
    """Radius of each record before the bounds apply, metres; infinite if unlimited.

    Args:
        extrapolated: (P,) result of `extrapolated_radius`.
        steepness: (P,) norm of the translational gradient over irradiance, 1/metres; may be NaN where it is black.
        quality: `accuracy` is used.

    Returns:
        (P,) non-negative.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.minimum(extrapolated, quality.accuracy * np.where(steepness > 0, 1 / steepness, np.inf))


def split_sphere(closeness: Floats, strata: int) -> Floats:
    """Harmonic mean distance of what the hemisphere sees (Ward, Rubinstein & Clear 1988, eq. 4), metres.

    Args:
        closeness: (P,) sum over the strata of 1 / distance, 1/metres.
        strata: their number.
    """
    return np.where(closeness > 0, strata / closeness, np.inf)


def occlusion_hessian(xx: Floats, xy: Floats, yy: Floats, smallest: Floats) -> Floats:
    """Radius over which the error of the gradient adds up to a fixed total, metres.

    Schwarzhaupt, Jensen & Jarosz 2012 (doi:10.1145/2366145.2366212): R = (4 e / (pi (l1 + l2)))^(1/4), where l are the
    absolute eigenvalues of the Hessian of relative irradiance and e is the error summed over the disk. Theirs is a
    constant area. We take the area of a square as wide as the smallest radius: a picture shows the error summed over
    pixels, and no scene needs a constant of its own. The radius averages both directions, since records are round.

    Args:
        xx: (P,) second derivative of relative irradiance in the tangent plane, 1/metres².
        xy: (P,) mixed.
        yy: (P,) the other.
        smallest: (P,) smallest radius, metres.
    """
    half = (xx + yy) / 2
    spread = np.hypot((xx - yy) / 2, xy)
    curvature = np.abs(half + spread) + np.abs(half - spread)
    radius = AS_SPLIT_SPHERE * np.sqrt(smallest) * (4 / (np.pi * curvature)) ** 0.25
    # A surface that touches the point makes its mesh degenerate.
    return np.asarray(np.where(np.isnan(radius), 0, radius))
