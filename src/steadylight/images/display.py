"""8-bit images for people, made from scene-linear ones with one exposure and a tone curve."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from steadylight.errors import InputError, StorageError
from steadylight.images.exr import last_sentence, read_exr
from steadylight.tone import VIEWS, apply_curve

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec. 709 luminance of linear R, G and B."""

MIDDLE_GREY = 0.18
"""Value to which `animation_exposure` maps the log-average luminance of a frame that is not bright all over."""

SHOULDER = 0.6
"""Exposed values up to this one are shown unchanged; brighter ones are compressed (see `to_display`)."""


def luminance(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rec. 709 luminance, scene-linear.

    Args:
        image: (..., 3) scene-linear RGB.

    Returns:
        (...) in the unit of the image.
    """
    weighted: NDArray[np.float64] = np.asarray(image, dtype=np.float64) @ np.array(LUMINANCE_WEIGHTS)
    return weighted


def animation_exposure(images: Iterable[NDArray[np.floating]]) -> float:
    """One exposure for a whole animation: the factor that shows its middle luminance as middle grey, or brighter.

    The key of a frame is its log-average luminance (Reinhard, Stark, Shirley and Ferwerda 2002, "Photographic
    tone reproduction for digital images", eq. 1, doi:10.1145/566654.566575), here over the pixels that are
    lit at all (more than 1/10000 of the frame's mean) instead of with their small additive delta. It becomes middle
    grey. In a frame that is bright nearly everywhere, such as a desert under the sun, which would otherwise look like
    dusk, it becomes brighter (Reinhard 2002, "Parameter estimation for photographic tone reproduction", Journal of
    Graphics Tools 7(1), eq. 4: 0.18 * 4^f, where f is how much nearer the key is to the brightest hundredth than
    to the darkest, on a logarithmic scale). It never becomes darker, so that rooms with a bright window stay visible.
    The exposure of the animation is the median over frames, so that black frames, fades and a brief look into a lamp
    have no influence.

    Args:
        images: frames, or a sample of them, (height, width, 3) scene-linear RGB.

    Returns:
        Factor > 0 by which to multiply scene-linear values; 1 if nothing is lit.
    """
    exposures = []
    for image in images:
        values = luminance(image)
        values = values[np.isfinite(values)]
        lit = values[values > 1e-4 * max(values.mean(), 0.0)] if values.size else values
        if lit.size and values.mean() > 1e-12:
            logs = np.log(lit)
            low, key, high = np.percentile(logs, 1), logs.mean(), np.percentile(logs, 99)
            nearer = (2 * key - low - high) / (high - low) if high - low > 1e-6 else 0.0
            exposures.append(np.log(MIDDLE_GREY) + max(nearer, 0.0) * np.log(4.0) - key)
    return float(np.exp(np.median(exposures))) if exposures else 1.0


def exposure_of_files(paths: Sequence[Path], sample: int = 16) -> float:
    """`animation_exposure` over frames in EXR files, at most `sample` of them, equally spaced over the animation.

    Raises:
        InputError: a frame is missing or does not decode.
    """
    count = min(sample, len(paths))
    chosen = np.linspace(0, len(paths) - 1, count).round().astype(int)
    return animation_exposure(read_exr(paths[index]) for index in chosen)


def to_display(image: NDArray[np.floating], exposure: float, tone: str = "srgb") -> NDArray[np.float32]:
    """Display values in [0, 1]: exposure, a tone curve, the sRGB transfer function (IEC 61966-2-1).

    With x = exposure * value, the curve of `srgb` has a knee k = 0.6: each channel keeps x where x <= k and becomes
    k + (1 - k) (1 - exp(-(x - k) / (1 - k))) above: continuous with its slope, never clipped, and white only
    in the limit. Mid-tones therefore are plain sRGB, and windows and lamps keep their detail. `none` has no curve and
    clips x at 1. `agx` and `filmic` are Blender's (`steadylight.tone`). Images and video all use this function, so they
    look the same.

    Args:
        image: (..., 3) scene-linear RGB; negative values count as 0, NaN as 0.
        exposure: factor, from `animation_exposure`.
        tone: `agx`, `filmic`, `srgb` or `none`.

    Returns:
        (..., 3) float32 in [0, 1], sRGB-encoded.
    """
    x = np.nan_to_num(np.asarray(image, dtype=np.float32) * np.float32(exposure), nan=0.0, posinf=1e6)
    x = np.maximum(x, 0.0)
    if tone in VIEWS:
        return apply_curve(x, tone)
    if tone == "srgb":
        span = np.float32(1.0 - SHOULDER)
        x = np.where(
            x <= SHOULDER, x, SHOULDER - span * np.expm1((SHOULDER - np.maximum(x, SHOULDER)) / span)
        )
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(encoded, 0.0, 1.0), dtype=np.float32)


def tone_map(image: NDArray[np.floating], exposure: float, tone: str = "srgb") -> NDArray[np.uint8]:
    """An 8-bit sRGB version of a scene-linear image; see `to_display` for the curves.

    Args:
        image: (height, width, 3) scene-linear RGB.
        exposure: factor, from `animation_exposure`.
        tone: as in `to_display`.

    Returns:
        (height, width, 3) uint8.
    """
    return np.asarray(np.rint(to_display(image, exposure, tone) * 255.0), dtype=np.uint8)


def validate_png(path: Path) -> None:
    """Read a picture back and check that it is complete.

    Raises:
        InputError: it does not decode.
    """
    try:
        with Image.open(path) as picture:
            picture.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: is not a readable PNG image: {last_sentence(error)}") from None


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an 8-bit sRGB image, from `tone_map`, as a PNG file.

    Args:
        path: where to write; an existing file is replaced.
        picture: (height, width, 3) uint8.

    Raises:
        StorageError: the file cannot be written.
    """
    try:
        Image.fromarray(np.ascontiguousarray(picture, dtype=np.uint8)).save(path, format="PNG")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None
