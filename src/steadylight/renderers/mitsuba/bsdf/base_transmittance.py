"""Transmittance of a specular layer over a diffuse base, for incident light.

The diffuse lobe of `plastic` and `roughplastic` is a product of two Fresnel transmittances: that of the layer for
incident light, and that for light that leaves towards the viewer. Records on such a surface weigh the light that they
gather by the first. By irradiance alone, light of all directions would count alike, though hardly any passes the layer
at grazing incidence: a closed room of varnish was 0.7 % too dark.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.bsdf.tables import numbers_of

STEPS = 64
"""Number of cosines in the table, which is interpolated linearly."""

LAMBERTIAN = 1e-3
"""Deviation of all entries from 1 below which a lobe is Lambertian."""

PRODUCT = 0.01
"""Relative deviation of a lobe from a product of two functions above which the table does not apply."""

_PLACES = (0.13, 0.37, 0.61, 0.89)
"""Texture coordinates at which a BSDF is evaluated: the brightest of these, since a black one tells nothing."""

_VIEWS = (1.0, 0.2)
"""Cosines of the view: the transmittance is told by the first, and whether the lobe is a product by the second."""


class BaseTransmittance:
    """Relative transmittances: over the mean for uniform light, by BSDF instance and cosine of incidence."""

    def __init__(self, rows: dict[int, NDArray[np.float32]]) -> None:
        """Make the table.

        Args:
            rows: (STEPS,) by the number of a BSDF; 1 for all others.
        """
        table = np.ones((max(rows) + 1, STEPS), np.float32)
        for number, row in rows.items():
            table[number] = row
        self.table = mi.Float(table.ravel())

    @classmethod
    def of(cls, bsdfs: Iterable[mi.BSDF], context: mi.BSDFContext) -> Self | None:
        """The table of some BSDFs; None if all are Lambertian.

        Args:
            bsdfs: evaluated in the local frame; those whose diffuse lobe is no product count as Lambertian.
            context: restricts them to their diffuse lobe.
        """
        rows = {number: _relative_transmittance(bsdf, context) for bsdf, number in numbers_of(bsdfs).items()}
        rows = {number: row for number, row in rows.items() if np.abs(row - 1).max() > LAMBERTIAN}
        return cls(rows) if rows else None

    def at(self, number: mi.UInt32, cosine: mi.Float) -> mi.Float:
        """Transmittance at this cosine of incidence, over that for uniform light.

        Args:
            number: of the BSDF, from Mitsuba's registry; 0 if there is none.
            cosine: in [0, 1].
        """
        known = number < dr.width(self.table) // STEPS
        x = dr.clip(cosine * STEPS - 0.5, 0, STEPS - 1)
        lower = dr.minimum(mi.UInt32(x), STEPS - 2)
        a, b = (dr.gather(mi.Float, self.table, number * STEPS + lower + i, known) for i in (0, 1))
        return dr.select(known, dr.lerp(a, b, x - mi.Float(lower)), 1)


def _relative_transmittance(bsdf: mi.BSDF, context: mi.BSDFContext) -> NDArray[np.float32]:
    """(STEPS,) relative transmittance at each cosine; 1 where the lobe is no product."""
    cosine = (np.arange(STEPS) + 0.5) / STEPS
    # Place, view and cosine of each lane.
    u, wi, mu = (np.ravel(each) for each in np.meshgrid(_PLACES, _VIEWS, cosine, indexing="ij"))
    wo = mi.Vector3f(mi.Float(np.sqrt(1 - mu**2)), 0, mi.Float(mu))
    si = dr.zeros(mi.SurfaceInteraction3f, len(mu))
    si.t, si.n, si.sh_frame = mi.Float(1), mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv, si.wi = mi.Point2f(mi.Float(u), 0.37), mi.Vector3f(0, mi.Float(np.sqrt(1 - wi**2)), mi.Float(wi))
    value = np.array(mi.luminance(bsdf.eval(context, si, wo)), np.float64)
    above, aslant = max(value.reshape(len(_PLACES), len(_VIEWS), STEPS), key=np.sum)
    if not (np.isfinite([above, aslant]).all() and above.sum() > 0 and aslant.sum() > 0):
        return np.ones(STEPS, np.float32)
    if np.abs(aslant * above.sum() - above * aslant.sum()).max() > PRODUCT * above.max() * aslant.sum():
        return np.ones(STEPS, np.float32)
    # The value contains the cosine.
    return (above / cosine * (cosine.sum() / above.sum())).astype(np.float32)
