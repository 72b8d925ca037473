"""Softens pictures made with a box filter as the film's wider filter would have.

A denoiser needs a filter no wider than a pixel, since it takes noise that is correlated between pixels for texture. Its
result is softened here to match the rest of the picture.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from steadylight.renderers.mitsuba.upload import upload

DARK = np.float32(0.01)
"""Albedo below which it says nothing about the incident light."""


def as_filtered(image: NDArray[np.float32], rfilter: mi.ReconstructionFilter) -> NDArray[np.float32]:
    """Apply a wider filter to a picture made with a box filter, approximately: blend each pixel with its neighbours.

    The weight minimises the mean square difference from the true filter, for edges at all positions in a pixel.

    Args:
        image: (height, width, channels).
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, channels).
    """
    radius = rfilter.radius() + 1.5  # pixels; further away, edges look the same
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
    """As `as_filtered`, but with textures and outlines as sharp as the wider filter makes them.

    Softened albedo differs from filtered albedo. The difference, times the incident light, is missing from the softened
    picture. The incident light is a mean over the pixels that the filter covers: a glossy reflection on a dark surface
    must not count as light that brightens a pale surface beside it.

    Args:
        lit: (height, width, 3) light scattered by surfaces, with a box filter.
        albedo: (height, width, 3) of the surfaces, with a box filter.
        filtered: (height, width, 3) the albedo with `rfilter`.
        rfilter: mi.ReconstructionFilter.

    Returns:
        (height, width, 3).
    """
    both = np.concatenate([lit, albedo], axis=2)
    softened, softened_albedo = np.split(as_filtered(both, rfilter), 2, axis=2)
    lit_around, albedo_around = np.split(uniform_filter(both, (5, 5, 1)), 2, axis=2)
    lacking = lit_around / np.maximum(albedo_around, DARK) * (filtered - softened_albedo)
    return np.maximum(softened + lacking, np.minimum(softened, 0))
