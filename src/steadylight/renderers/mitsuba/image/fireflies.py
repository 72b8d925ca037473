"""Fireflies: single light paths far brighter than the surrounding picture, and a bound on their contribution.

Direct light on surfaces that the camera sees, and visible emission, are never bounded: where they are noisy, more
samples are taken (`adaptive`, `visible_emitters`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from steadylight.renderers.mitsuba.upload import download, upload

WINDOW: Final = 5
"""Edge of the window around a pixel, pixels. With 9, the same amount is clamped and the error is the same."""

FEWEST: Final = 16
"""Minimum samples per pixel for the bound: with fewer samples, each one is a large part of its pixel."""


class Bounded(NamedTuple):
    """Samples after clamping.

    Attributes:
        radiance: Color3f; samples of a pixel are adjacent. Not evaluated yet.
        lost: Color3f, what was clamped from each sample. Not evaluated yet.
        bound: (rows, width) on the luminance of a sample, regardless of the other samples of its pixel.
    """

    radiance: mi.Color3f
    lost: mi.Color3f
    bound: NDArray[np.float32]


def sample_limit(firefly: float, spp: int) -> float:
    """Maximum luminance of a sample, in mean luminances of the surrounding picture.

    Args:
        firefly: maximum contribution of a sample to its pixel, in the same unit.
        spp: samples per pixel.
    """
    return firefly * max(spp, FEWEST)


def bounded(L: mi.Color3f, beside: mi.Color3f, raster: tuple[int, int], limit: float) -> Bounded:
    """Clamp light paths so that none brightens its pixel far beyond the average path around it.

    The brightest pixel in the window is left out: otherwise, a path would raise its own bound. Nor is a sample clamped
    below the mean of the other samples of its pixel, so edges, lines and dots are left as they are. With more samples
    per pixel, the bound on each rises, and the loss tends to zero.

    Args:
        L: radiance of the paths.
        beside: other radiance along the same camera rays, which is part of the surrounding picture.
        raster: pixels per row, and samples per pixel.
        limit: see `sample_limit`.
    """
    width, spp = raster
    own, other = mi.luminance(L), mi.luminance(beside)
    dr.eval(own, other)  # in one kernel
    total = dr.block_reduce(dr.ReduceOp.Add, own, spp)
    whole = download(total) + download(dr.block_reduce(dr.ReduceOp.Add, other, spp))
    around = (limit / spp * _around(whole, width)).astype(np.float32)
    most = upload(mi.Float, around.ravel())
    pixel = dr.arange(mi.UInt32, dr.width(L)) // dr.opaque(mi.UInt32, spp)
    others = (dr.gather(mi.Float, total, pixel) - own) / max(spp - 1, 1)
    bound = dr.maximum(dr.gather(mi.Float, most, pixel), others)
    cut = own > bound
    part = dr.select(cut, bound / own, 1)
    return Bounded(L * part, dr.select(cut, L * (1 - part), 0), around)


def _around(values: NDArray[np.float32], width: int) -> NDArray[np.float64]:
    """Mean of the window around each pixel, including the pixel but without the maximum."""
    picture = values.reshape(-1, width).astype(np.float64)
    there = np.ones_like(picture)
    total, count = (uniform_filter(each, WINDOW, mode="constant") * WINDOW**2 for each in (picture, there))
    total -= maximum_filter(picture, WINDOW, mode="nearest")
    # The filter's running sums may end slightly below 0. A picture of a single pixel has no surroundings.
    return np.where(count > 1.5, np.maximum(total, 0) / np.maximum(count - 1, 1), picture)
