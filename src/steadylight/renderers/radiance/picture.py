"""Downsampling of larger pictures with the scene's reconstruction filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.description import SceneDescription

Floats = NDArray[np.float64]

GAUSSIAN: Final = 0.5
"""Default standard deviation of Mitsuba's Gaussian filter, pixels; it is cut off at four of them."""


def filter_weights(film: Mapping[str, Any]) -> tuple[Callable[[Floats], Floats], float]:
    """Mitsuba's reconstruction filter as a function of the distance in pixels, and its radius.

    Raises:
        SceneError: the filter is not supported.
    """
    kind = str(film.get("type", "gaussian"))
    if kind == "gaussian":
        deviation = float(film.get("stddev", GAUSSIAN))
        end = 4 * deviation
        least = np.exp(-(end**2) / (2 * deviation**2))
        return lambda x: np.maximum(np.exp(-(x**2) / (2 * deviation**2)) - least, 0), end
    if kind == "box":
        return lambda x: (np.abs(x) < 0.5).astype(np.float64), 0.5
    if kind == "tent":
        radius = float(film.get("radius", 1.0))
        return lambda x: np.maximum(1 - np.abs(x) / radius, 0), radius
    if kind in ("mitchell", "catmullrom"):
        b, c = (film.get("B", 1 / 3), film.get("C", 1 / 3)) if kind == "mitchell" else (0.0, 0.5)
        return lambda x: _cubic(np.abs(x), float(b), float(c)), 2.0
    raise SceneError(
        f"reconstruction filter `{kind}` is not supported with --renderer radiance; supported: gaussian, box, tent, "
        "mitchell, catmullrom"
    )


def _cubic(x: Floats, b: float, c: float) -> Floats:
    """The family of Mitchell & Netravali 1988, equation 8 (DOI 10.1145/54852.378514)."""
    inner = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + (6 - 2 * b)
    outer = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + (8 * b + 24 * c)
    return np.where(x < 1, inner, np.where(x < 2, outer, 0.0)) / 6


def filtered(
    image: NDArray[np.floating[Any]], oversampling: int, film: Mapping[str, Any] | None = None
) -> NDArray[np.float32]:
    """A picture, (k H, k W, 3), filtered to (H, W, 3).

    Pixels beyond the border do not count, as with Mitsuba's film.

    Args:
        image: the larger picture.
        oversampling: k.
        film: the filter; Mitsuba's Gaussian if None.
    """
    k = oversampling
    weight, end = filter_weights(film or {})
    # The centre of a pixel is the centre of a column if k is odd, and lies between two columns if k is even.
    reach = int(np.ceil(end)) * k
    taps = np.arange(-reach, reach + k % 2) + (0.0 if k % 2 else 0.5)
    weights = weight(taps / k)
    total = np.asarray(image, np.float64)
    count = np.ones((*image.shape[:2], 1))
    for axis in (0, 1):
        total, count = (_decimated(each, weights, axis, k) for each in (total, count))
    return (total / count).astype(np.float32)


def _decimated(values: Floats, weights: Floats, axis: int, k: int) -> Floats:
    """Filtered along an axis, with one result per k values."""
    from scipy.ndimage import convolve1d  # importing it takes longer than `cache info`

    # For an even kernel, SciPy's result belongs half a column to the right of where it is stored.
    smooth: Floats = convolve1d(values, weights, axis=axis, mode="constant")
    return np.take(smooth, np.arange((k - 1) // 2, values.shape[axis], k), axis=axis)


def check_film(scene: SceneDescription) -> None:
    """Raise SceneError if the scene's reconstruction filter is not supported."""
    filter_weights(scene.film)
