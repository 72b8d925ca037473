"""Error of a still image against a reference: relative RMSE and bias, and FLIP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from steadylight.errors import InputError
from steadylight.images import animation_exposure, to_display

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLOOR = 0.1
"""Added to the reference in relative errors, as a fraction of its mean."""

SMOOTHED = 9
"""Pixels, in each direction, over which the divisor of robust errors is averaged."""

TRIMMED = 0.01
"""Fraction of the differences, the largest ones, that `Errors.rel_trimmed` leaves out."""

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


@dataclass(frozen=True)
class Errors:
    """Error of an image against one reference, or against two that differ in their seed only.

    Attributes:
        brightness: sum of the image over sum of the reference: 0.93 is 7 % too dark. Noise cancels out.
        rel_rmse: relative RMSE; against two references, as against a reference without noise (at least 0).
        rel_bias: signed mean of the same ratio.
        rel_trimmed: relative RMSE without the largest hundredth of the differences, such as fireflies.
        rel_median: median of the absolute relative difference.
        noise: relative standard deviation of the noise of the reference: estimated for one, measured for the mean of
            two.
    """

    brightness: float
    rel_rmse: float
    rel_bias: float
    rel_trimmed: float
    rel_median: float
    noise: float


def errors_against(
    image: NDArray[np.floating], a: NDArray[np.floating], b: NDArray[np.floating] | None = None
) -> Errors:
    """Errors of an image.

    Against one reference, `rel_rmse` and `rel_bias` are those of the functions of the same names. Against two with
    independent noise, the mean of the product of the two differences is the squared error without that noise, as
    against a reference with infinitely many samples. All other relative errors, and all against two references, divide
    by a smoothed reference. If each pixel were divided by its own noisy reference, that noise would count as error. It
    would also count as bias, since too small a divisor weighs more than too large a one (10 % noise gives 1 % bias,
    20 % gives 4 %).

    Args:
        image: (height, width, 3) scene-linear RGB.
        a: (height, width, 3) scene-linear RGB: the reference.
        b: (height, width, 3): a second reference.

    Raises:
        InputError: the sizes differ.
    """
    from scipy.ndimage import uniform_filter

    whole, bias = rel_rmse(image, a), rel_bias(image, a)  # also compares the sizes
    test, first = np.asarray(image, np.float64), np.asarray(a, np.float64)
    truth = first if b is None else (first + np.asarray(b, np.float64)) / 2
    scale = uniform_filter(truth, (SMOOTHED, SMOOTHED, 0)) + FLOOR * truth.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(test == truth, 0.0, np.abs(test - truth) / scale)
        brightness = 1.0 if (test == truth).all() else float(test.sum() / truth.sum())
    noise = estimated_noise(truth, scale)
    if b is not None:
        rest = (first - np.asarray(b, np.float64)) / 2
        product = (test - truth) ** 2 - rest**2  # = (test - a) (test - b)
        with np.errstate(divide="ignore", invalid="ignore"):
            squared = float(np.mean(np.where(product == 0.0, 0.0, product / scale**2)))
            bias = float(np.mean(np.where(test == truth, 0.0, (test - truth) / scale)))
            whole = float(np.sqrt(max(0.0, squared)))
            noise = float(np.sqrt(np.mean(np.where(rest == 0.0, 0.0, rest / scale) ** 2)))
    kept = np.sort(off, axis=None)[: max(1, round((1 - TRIMMED) * off.size))]
    return Errors(
        brightness, whole, bias, float(np.sqrt(np.mean(np.square(kept)))), float(np.median(off)), noise
    )


def estimated_noise(image: NDArray[np.floating], scale: NDArray[np.floating] | float) -> float:
    """Relative standard deviation of an image's noise, estimated from the image alone.

    After Immerkaer 1996, "Fast Noise Variance Estimation", doi:10.1006/cviu.1996.0060: the response to the difference
    of two Laplacians, which cancels planes and edges along the axes. We deviate twice: neighbours are two pixels apart,
    since the reconstruction filter correlates the noise of adjacent pixels; and the median replaces the mean, since
    edges and textures are not noise. It therefore misses fireflies.

    Args:
        image: (height, width, 3) scene-linear RGB.
        scale: what the noise is divided by.

    Returns:
        At least 0; 0.1 means 10 %.
    """
    from scipy.ndimage import convolve1d

    second = np.array([1.0, 0.0, -2.0, 0.0, 1.0])
    response = convolve1d(convolve1d(np.asarray(image, np.float64), second, axis=0), second, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(response == 0.0, 0.0, np.abs(response) / 6 / scale)
    return float(1.4826 * np.median(relative))  # of a normal distribution


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
