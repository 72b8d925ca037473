"""Fireflies: single light paths far brighter than the picture around them, and a bound for what they may add to it.

Direct light on what the camera sees and what shines at it are never bounded: of those, more samples are taken where
they are noisy (`adaptive`, `visible_emitters`).
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
"""Pixels on a side of what is around a pixel. With 9, as much is cut off and the error is the same."""

FEWEST: Final = 16
"""The bound is never less than that of so many samples: with fewer, each one is a large part of its pixel."""


class Bounded(NamedTuple):
    """What is left of samples.

    Attributes:
        radiance: Color3f, samples of a pixel side by side.
        cut: (rows, width, 3) what the samples of a pixel have lost, summed.
        bound: (rows, width) on the luminance of a sample, whatever the others of its pixel are.
    """

    radiance: mi.Color3f
    cut: NDArray[np.float32]
    bound: NDArray[np.float32]


def sample_limit(firefly: float, spp: int) -> float:
    """The most that a sample may bring, in mean luminances of the picture around it.

    Args:
        firefly: the most that it may add to its pixel.
        spp: samples per pixel.
    """
    return firefly * max(spp, FEWEST)


def bounded(L: mi.Color3f, beside: mi.Color3f, raster: tuple[int, int], limit: float) -> Bounded:
    """Light paths, none of which brightens its pixel by much more than all paths around it do.

    The brightest pixel around does not count: the path would otherwise raise its own bound. Nor is a sample bounded
    below the mean of the others of its pixel: edges, lines and dots are left as they are. As samples increase, the
    bound on each rises, and the loss goes to nothing.

    Args:
        L: radiance that paths bring back.
        beside: what the same camera rays see besides, which is part of the picture around.
        raster: pixels in a row, and samples of each.
        limit: see `sample_limit`.
    """
    width, spp = raster
    own = mi.luminance(L)
    total = dr.block_reduce(dr.ReduceOp.Add, own, spp)
    whole = total + dr.block_reduce(dr.ReduceOp.Add, mi.luminance(beside), spp)
    around = (limit / spp * _around(download(whole), width)).astype(np.float32)
    most = upload(mi.Float, around.ravel())
    pixel = dr.arange(mi.UInt32, dr.width(L)) // dr.opaque(mi.UInt32, spp)
    others = (dr.gather(mi.Float, total, pixel) - own) / max(spp - 1, 1)
    bound = dr.maximum(dr.gather(mi.Float, most, pixel), others)
    cut = own > bound
    part = dr.select(cut, bound / own, 1)
    lost = mi.Color3f(
        *(dr.block_reduce(dr.ReduceOp.Add, dr.select(cut, channel * (1 - part), 0), spp) for channel in L)
    )
    radiance = L * part
    dr.eval(radiance, lost)
    return Bounded(radiance, download(lost).reshape(-1, width, 3), around)


def _around(values: NDArray[np.float32], width: int) -> NDArray[np.float64]:
    """Mean of the pixels around each, itself included and the greatest left out."""
    picture = values.reshape(-1, width).astype(np.float64)
    there = np.ones_like(picture)
    total, count = (uniform_filter(each, WINDOW, mode="constant") * WINDOW**2 for each in (picture, there))
    total -= maximum_filter(picture, WINDOW, mode="nearest")
    # The filter's running sums may end a little below 0. A picture of one pixel has nothing around it.
    return np.where(count > 1.5, np.maximum(total, 0) / np.maximum(count - 1, 1), picture)
