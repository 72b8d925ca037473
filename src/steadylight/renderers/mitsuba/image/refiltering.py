"""Pictures made with a box filter, softened as the film's wider filter would have made them.

A denoiser needs a filter no wider than a pixel, since it takes noise that pixels share for texture. What it returns is
softened here like the rest of the picture.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from steadylight.renderers.mitsuba.upload import upload

DARK = np.float32(0.01)
"""An albedo below this tells nothing of the light."""


def as_filtered(image: NDArray[np.float32], rfilter: mi.ReconstructionFilter) -> NDArray[np.float32]:
    """A picture made with a box filter as it would look through a wider one: each pixel takes a part of its neighbours.

    The part is such that edges, wherever they lie in a pixel, differ least in the mean square from what the filter
    makes of them.

    Args:
        image: (height, width, channels).
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, channels).
    """
    radius = rfilter.radius() + 1.5  # pixels; beyond, edges are the same
    steps = round(512 * radius)
    t = ((np.arange(steps) + 0.5) / steps * 2 - 1) * radius
    f = np.array(rfilter.eval(upload(mi.Float, t.astype(np.float32))), np.float64) * (
        np.abs(t) <= rfilter.radius()
    )

    def boxed(pixels: int) -> NDArray[np.float64]:
        return np.clip(t - pixels + 0.5, 0, 1)

    spread = boxed(1) + boxed(-1) - 2 * boxed(0)
    lacking = (np.cumsum(f) - f / 2) / f.sum() - boxed(0)
    part = np.float32(round(float((lacking * spread).sum() / (spread**2).sum()), 5))
    for axis in (0, 1):
        padded = np.pad(image, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
        before, after = (padded.take(range(k, k + image.shape[axis]), axis) for k in (0, 2))
        image = (1 - 2 * part) * image + part * (before + after)
    return image


def lit_as_filtered(
    lit: NDArray[np.float32],
    albedo: NDArray[np.float32],
    filtered: NDArray[np.float32],
    rfilter: mi.ReconstructionFilter,
) -> NDArray[np.float32]:
    """As `as_filtered`, with textures and outlines as sharp as the wider filter makes them.

    Softened albedo differs from filtered albedo. The difference, times the light that falls on the surface, is what the
    softened picture lacks. That light is a mean over the pixels that the filter covers: gloss on a dark surface must
    not count as light that brightens a pale surface beside it.

    Args:
        lit: (height, width, 3) light that surfaces scatter, by a box filter.
        albedo: (height, width, 3) theirs, by a box filter.
        filtered: (height, width, 3) the same by `rfilter`.
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, 3).
    """
    both = np.concatenate([lit, albedo], axis=2)
    softened, softened_albedo = np.split(as_filtered(both, rfilter), 2, axis=2)
    lit_around, albedo_around = np.split(uniform_filter(both, (5, 5, 1)), 2, axis=2)
    lacking = lit_around / np.maximum(albedo_around, DARK) * (filtered - softened_albedo)
    return np.maximum(softened + lacking, np.minimum(softened, 0))
