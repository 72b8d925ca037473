"""Textures of floors, ceilings and veneers as small repeating images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from steadylight.scenes.furnishings import Floats

Picture = NDArray[np.float32]
"""(H, W, 3) linear RGB reflectance in 0.02 to 0.85; row 0 is the top."""


def clouds(
    rng: np.random.Generator, size: tuple[int, int], features: tuple[float, float], slope: float = 2.0
) -> Floats:
    """Periodic fractal noise, mean 0 and standard deviation 1.

    Args:
        rng: random generator of the noise.
        size: (width, height), pixels.
        features: number of the largest features across and down.
        slope: how fast the amplitude falls off towards higher frequencies; 1 is rough, 3 is smooth.

    Returns:
        (H, W) array.
    """
    width, height = size
    across = np.fft.fftfreq(width)[None, :] * width / features[0]
    up = np.fft.fftfreq(height)[:, None] * height / features[1]
    spectrum = np.fft.fft2(rng.normal(size=(height, width))) / (1.0 + np.hypot(across, up)) ** slope
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return np.asarray(noise / noise.std())


def painted(shade: Floats, tone: Sequence[float]) -> Picture:
    """An image from a (H, W) brightness around 1 and an RGB colour, clipped to the albedo of paint."""
    return np.asarray(np.clip(shade[..., None] * np.array(tone), 0.02, 0.85), dtype=np.float32)


def herringbone() -> Picture:
    """Oak blocks with sides 1 to 4 in a herringbone pattern; the image is 16 block widths across."""
    rng = np.random.default_rng(21)
    n, cells, length = 256, 16, 4
    tones = rng.uniform(0.82, 1.16, (cells, cells))
    y, x = np.mgrid[0:n, 0:n] * cells / n
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    phase = (i - j) % (2 * length)  # the steps of the pattern run along the diagonal
    rise = (j - i - 1) % (2 * length)
    lying = phase < length
    u = np.where(lying, phase + x - i, rise + y - j)
    v = np.where(lying, y - j, x - i)
    tone = tones[np.where(lying, i - phase, i) % cells, np.where(lying, j, j - rise) % cells]
    grain = 1.0 + 0.05 * np.sin(40.0 * v + 63.0 * tone + 0.8 * np.sin(2.0 * u + 30.0 * tone))
    seam = np.minimum.reduce([u, length - u, v, 1.0 - v])
    return painted(tone * grain * (0.72 + 0.28 * np.clip(seam / 0.07, 0.0, 1.0)), (0.40, 0.235, 0.115))


def flagstones() -> Picture:
    """Limestone slabs of varying tone with narrow joints; the image is 4 slabs across."""
    rng = np.random.default_rng(22)
    n, cells = 256, 4
    tones = rng.uniform(0.88, 1.1, (cells, cells))
    y, x = np.mgrid[0:n, 0:n] * cells / n
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    edge = np.minimum.reduce([x - i, 1 - x + i, y - j, 1 - y + j])
    mottle = clouds(rng, (n, n), (6.0, 6.0), 1.6)
    return painted(
        tones[i, j] * (1.0 + 0.05 * mottle) * np.where(edge < 0.016, 0.62, 1.0), (0.42, 0.39, 0.33)
    )


def linoleum() -> Picture:
    """Marbled linoleum, grey-green."""
    rng = np.random.default_rng(33)
    cloud, vein = (clouds(rng, (256, 256), (9.0, 3.6), 1.5) for _ in range(2))
    return painted(1.0 + 0.055 * cloud - 0.10 * np.exp(-((4.0 * vein) ** 2)), (0.30, 0.33, 0.31))


def ceiling_tile() -> Picture:
    """A mineral fibre ceiling tile in its rail, with pinholes."""
    rng = np.random.default_rng(34)
    n = 128
    image = np.full((n, n), 0.76)
    image[rng.integers(5, n - 5, 420), rng.integers(5, n - 5, 420)] = 0.56
    y, x = np.mgrid[0:n, 0:n] + 0.5
    edge = np.minimum.reduce([x, n - x, y, n - y])
    return painted(np.where(edge < 2.6, 0.62, np.where(edge < 4.0, 0.46, image)), (1.0, 1.0, 1.0))


def veneer(seed: int, tone: Sequence[float]) -> Picture:
    """Plain-sawn veneer, grain upright."""
    rng = np.random.default_rng(seed)
    size = (96, 192)
    figure = np.sin(4.0 * clouds(rng, size, (5.0, 1.0), 3.0))
    return painted(1.0 + 0.10 * figure + 0.07 * clouds(rng, size, (40.0, 3.0), 1.5), tone)
