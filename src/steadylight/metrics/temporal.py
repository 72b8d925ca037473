"""Flicker of a sequence over a region: brightness, BFM, overshoot, BFM excess, and the static deviation.

The brightness flickering metric is the paper's (Aggarwal, Chalmers and Debattista 2008, "High-Fidelity
Rendering of Animations on the Grid: A Case Study", section 4.1), after the Moscow State University Video
Quality Measurement Tool: the absolute difference of the average brightness of successive frames. A moving camera
changes the brightness too; overshoot and BFM excess exclude that trend.

Frames are given as paths of EXR files, read one at a time, or as arrays (height, width, 3), scene-linear RGB.
A region is a `Region`, four edges x0, y0, x1, y1 (integers: pixels; floats: fractions of the image), or
None for the whole image.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from steadylight.errors import InputError
from steadylight.images import luminance, read_exr
from steadylight.metrics.region import Region
from steadylight.metrics.still import FLOOR

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

    Frame = Path | NDArray[np.floating]
    AnyRegion = Region | Sequence[float] | None


def mean_luminance(frame: Frame, region: AnyRegion = None) -> float:
    """Mean Rec. 709 luminance of a region of one frame, scene-linear.

    Raises:
        InputError: the frame does not decode, or the region extends beyond it.
    """
    image = _image(frame)
    rows, columns = Region.of(region).slices(image.shape[1], image.shape[0])
    return float(luminance(image[rows, columns]).mean())


def brightness_series(frames: Iterable[Frame], region: AnyRegion = None) -> NDArray[np.float64]:
    """Brightness b(t): mean luminance of the region, divided by its mean over the sequence.

    Args:
        frames: T frames in the order of the sequence.
        region: region to measure.

    Returns:
        (T,) with mean 1; all 0 if the region is black in every frame.

    Raises:
        InputError: a frame does not decode, or the region extends beyond it.
    """
    return normalised(np.array([mean_luminance(frame, region) for frame in frames]))


def normalised(luminances: ArrayLike) -> NDArray[np.float64]:
    """Mean luminances of the frames of a sequence, (T,), divided by their mean; all 0 for a black sequence."""
    values = np.asarray(luminances, dtype=np.float64)
    mean = values.mean() if values.size else 0.0
    return values / mean if mean > 0 else np.zeros_like(values)


def bfm(brightness: ArrayLike) -> NDArray[np.float64]:
    """The brightness flickering metric of each frame step: BFM(t) = |b(t) - b(t-1)|, the paper's graph.

    Args:
        brightness: (T,) from `brightness_series`.

    Returns:
        (T-1,); the first value belongs to the second frame.
    """
    return np.abs(np.diff(np.asarray(brightness, dtype=np.float64)))


def overshoot(brightness: ArrayLike) -> float:
    """Mean over t of |b(t) - (b(t-1) + b(t+1)) / 2|: flicker without the trend caused by the camera.

    Args:
        brightness: (T,) from `brightness_series`.

    Returns:
        At least 0; 0 for brightness that changes linearly.

    Raises:
        InputError: fewer than 3 frames.
    """
    b = np.asarray(brightness, dtype=np.float64)
    if b.size < 3:
        raise InputError(f"overshoot needs at least 3 neighbouring frames, not {b.size}")
    return float(np.mean(np.abs(b[1:-1] - (b[:-2] + b[2:]) / 2)))


def bfm_excess(brightness: ArrayLike, reference: ArrayLike) -> float:
    """Mean over t of |BFM(t) - BFM of the reference sequence(t)|: flicker beyond that of the scene itself.

    Args:
        brightness: (T,) of the sequence, from `brightness_series`.
        reference: (T,) of a path-traced sequence of the same frames and region.

    Returns:
        At least 0.

    Raises:
        InputError: the sequences differ in length, or have fewer than 2 frames.
    """
    sequence, truth = np.asarray(brightness, np.float64), np.asarray(reference, np.float64)
    if sequence.shape != truth.shape:
        raise InputError(f"a sequence of {sequence.size} frames cannot be compared with one of {truth.size}")
    if sequence.size < 2:
        raise InputError(f"BFM excess needs at least 2 neighbouring frames, not {sequence.size}")
    return float(np.mean(np.abs(bfm(sequence) - bfm(truth))))


def static_deviation(frames: Iterable[Frame], reference: Frame, region: AnyRegion = None) -> float:
    """How much an image changes if only the seed changes.

    The standard deviation over the frames of a still camera with a different seed for each frame, divided by
    (ref + 0.1 mean(ref)), for each pixel and channel of scene-linear RGB, then averaged over the region. mean(ref) is
    over the whole reference. It is the population standard deviation (divided by T).

    Args:
        frames: T frames, read one at a time.
        reference: converged image of the same view.
        region: region to measure.

    Returns:
        At least 0; 0.01 means 1 %.

    Raises:
        InputError: fewer than 2 frames, frames of different sizes, or one that does not decode.
    """
    truth = _image(reference).astype(np.float64)
    count, mean, squares = 0, np.zeros_like(truth), np.zeros_like(truth)
    for image in _images(frames, truth.shape):  # Welford's algorithm, with one frame in memory
        count += 1
        step = image - mean
        mean += step / count
        squares += step * (image - mean)
    if count < 2:
        raise InputError(f"the static deviation needs at least 2 frames, not {count}")
    deviation = np.sqrt(squares / count)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(deviation == 0.0, 0.0, deviation / (truth + FLOOR * truth.mean()))
    rows, columns = Region.of(region).slices(truth.shape[1], truth.shape[0])
    return float(relative[rows, columns].mean())


def _image(frame: Frame) -> NDArray[np.floating]:
    return read_exr(frame) if isinstance(frame, Path) else frame


def _images(frames: Iterable[Frame], shape: tuple[int, ...]) -> Iterator[NDArray[np.floating]]:
    """The frames as arrays, all of the same shape."""
    for number, frame in enumerate(frames, start=1):
        image = _image(frame)
        if image.shape != shape:
            name = frame if isinstance(frame, Path) else f"frame {number} of the sequence"
            found, right = (f"{s[1]}x{s[0]}" for s in (image.shape, shape))
            raise InputError(f"{name}: is {found} pixels; the reference is {right}")
        yield image
