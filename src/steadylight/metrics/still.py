"""Error of a still image against a reference: relative RMSE and bias, and FLIP."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from steadylight.errors import InputError
from steadylight.images import animation_exposure, to_display

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLOOR = 0.1
"""Added to the reference in relative errors, as a fraction of its mean."""

PIXELS_PER_DEGREE = 67.0
"""FLIP's default: a 0.7 m wide 4K display viewed from 0.7 m."""


def relative_difference(image: NDArray[np.floating], reference: NDArray[np.floating]) -> NDArray[np.floating]:
    """(image - reference) / (reference + 0.1 mean(reference)), pixel by pixel and channel by channel.

    The mean is over all pixels and channels. The floor keeps dark pixels from dominating.

    Args:
        image: (height, width, 3) scene-linear RGB.
        reference: (height, width, 3) scene-linear RGB.

    Returns:
        (height, width, 3) float64; if the whole reference is black, 0 for black pixels and infinity
        for others.

    Raises:
        InputError: the sizes differ.
    """
    test, truth = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if test.shape != truth.shape:
        raise InputError(f"an image of shape {test.shape} cannot be compared with one of {truth.shape}")
    difference = test - truth
    divisor = truth + FLOOR * truth.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(difference == 0.0, 0.0, difference / divisor))


def rel_rmse(image: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Relative root-mean-square error: sqrt(mean(((image - ref) / (ref + 0.1 mean(ref)))^2)).

    Args:
        image: (height, width, 3) scene-linear RGB.
        reference: (height, width, 3) scene-linear RGB.

    Returns:
        At least 0; 0.03 means 3 %.

    Raises:
        InputError: the sizes differ.
    """
    return float(np.sqrt(np.mean(np.square(relative_difference(image, reference)))))


def rel_bias(image: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Relative bias: mean((image - ref) / (ref + 0.1 mean(ref))), signed; positive if the image is too bright.

    Args:
        image: (height, width, 3) scene-linear RGB.
        reference: (height, width, 3) scene-linear RGB.

    Returns:
        0.01 means 1 % too bright.

    Raises:
        InputError: the sizes differ.
    """
    return float(np.mean(relative_difference(image, reference)))


def flip(
    image: NDArray[np.floating], reference: NDArray[np.floating], exposure: float | None = None
) -> float:
    """Mean FLIP: the difference that a viewer sees when flipping between the two images.

    Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild 2020, "FLIP: A Difference Evaluator
    for Alternating Images", doi:10.1145/3406183, computed with the authors' package. This is the LDR measure on
    the images as steadylight displays them (`images.to_display`), not HDR-FLIP, which chooses new exposures for each
    reference frame and reports the worst, so that its values would not be comparable along a sequence.

    Args:
        image: (height, width, 3) scene-linear RGB.
        reference: (height, width, 3) scene-linear RGB.
        exposure: factor on scene-linear values; by default that of the reference alone. For a sequence, give
            one value for all frames.

    Returns:
        0 (no visible difference) to 1, mean over the image, at 67 pixels per degree.

    Raises:
        InputError: the sizes differ.
    """
    if np.shape(image) != np.shape(reference):
        raise InputError(
            f"an image of shape {np.shape(image)} cannot be compared with one of {np.shape(reference)}"
        )
    import flip_evaluator  # not at the top, because the rest of the package works without it

    factor = animation_exposure([np.asarray(reference)]) if exposure is None else exposure
    truth, test = (np.ascontiguousarray(to_display(np.asarray(x), factor)) for x in (reference, image))
    _, mean, _ = flip_evaluator.evaluate(
        truth, test, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE}
    )
    return float(mean)
