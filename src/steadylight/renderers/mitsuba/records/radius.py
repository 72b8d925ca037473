"""The radius of a record, from what its hemisphere saw: two measures, of which `RecordQuality.radii` chooses one.

The radius is `RecordQuality.accuracy` times the measure, and at most `accuracy` times the distance over which the
gradient alone would bring irradiance to zero (Krivanek et al. 2005). Unless `RecordQuality.clamped` is off, it does not
pass the nearest surface: a thin ledge hardly changes what a hemisphere sees, but what lies under it is dark.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.quality import RecordQuality

AS_SPLIT_SPHERE = 6.0
"""Factor with which the same accuracy gives about as many records by the Hessian as by the split sphere, in the
bundled scenes with few pixels between records."""


COVERED = 0.5
"""Part of the smallest radius down to which records shrink that stand under or beside something low."""


class Bounds(NamedTuple):
    """Smallest and largest radius at each point, metres; the same whatever frame looks."""

    smallest: Floats  # (P,)
    largest: Floats  # (P,)

    def under(self, headroom: Floats) -> Bounds:
        """These where something covers the point: what is hidden by it must not answer far beyond its edge.

        Args:
            headroom: (P,) free height over each point, metres; see `Records`.
        """
        smallest = np.clip(headroom, COVERED * self.smallest, self.smallest)
        return Bounds(smallest.astype(np.float32), np.maximum(self.largest, smallest))


def extrapolated_radius(sums: Mapping[str, Floats], smallest: Floats, quality: RecordQuality) -> Floats:
    """Radius up to which a record's gradient tells how its light changes, metres; infinite where nothing limits it.

    Args:
        sums: by record, `closeness` and `nearest` as in `gradients.reduced`; for the occlusion Hessian also `xx`, `xy`
            and `yy` (`hessian.second_derivatives`).
        smallest: (P,) smallest radius, metres.
        quality: `radii`, `accuracy` and `clamped` count.

    Returns:
        (P,) positive.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if quality.radii == "occlusion-hessian":
            measure = occlusion_hessian(sums["xx"], sums["xy"], sums["yy"], smallest)
        else:
            measure = split_sphere(sums["closeness"], quality.strata)
    radius = quality.accuracy * measure
    return np.minimum(radius, sums["nearest"]) if quality.clamped else radius


def wanted_radius(extrapolated: Floats, steepness: Floats, quality: RecordQuality) -> Floats:
    """Radius of each record before the bounds apply, metres; infinite where nothing limits it.

    Args:
        extrapolated: (P,) what `extrapolated_radius` returned.
        steepness: (P,) size of the translational gradient over irradiance, 1/metres; may be NaN where it is black.
        quality: `accuracy` counts.

    Returns:
        (P,) positive.
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
    """Radius over which what the gradient leaves out adds up to a fixed error, metres.

    Schwarzhaupt, Jensen & Jarosz 2012 (doi:10.1145/2366145.2366212): R = (4 e / (pi (l1 + l2)))^(1/4), with l the sizes
    of the eigenvalues of the Hessian of relative irradiance and e the error summed over the disk. Theirs is a constant
    area. We take that of a square as wide as the smallest radius: what a picture shows is the error summed over pixels,
    and no scene needs a constant of its own. The radius goes by the mean of both directions: records are round.

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
    # Something that touches the point makes its mesh degenerate.
    return np.asarray(np.where(np.isnan(radius), 0, radius))
