"""Smooths noisy thumbnails: an edge-avoiding wavelet filter, guided by the surfaces that the pixels see.

Dammertz, Sewtz, Hanika & Lensch 2010, Edge-Avoiding À-Trous Wavelet Transform for fast Global Illumination Filtering.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.renderers.base import Geometry

Array = NDArray[np.float64]

_LEVELS: Final = 4
"""Levels of the wavelet: together they span 61 pixels, and the widest of them 33."""
_KERNEL: Final = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)
_NORMAL: Final = 0.15
"""Scale of the difference of normals that indicates another surface."""
_PLANE: Final = 0.02
"""Scale of the distance from a pixel's plane, relative to its distance from the camera, that does the same."""
_LIGHT: Final = 4.0
"""Scale of the difference in brightness, relative to the noise, that indicates an edge; halved at each level."""
_DARKEST: Final = 0.05
"""Minimum divisor for reflectance; channels darker than this also count less for their neighbours."""


@dataclass(frozen=True)
class Surfaces:
    """What the pixels of a thumbnail see.

    Attributes:
        position: (H, W, 3) position relative to the camera, metres.
        normal: (H, W, 3) normal towards the camera; zero without a surface.
        colour: (H, W, 3) reflectance; 1 where it is unknown.
    """

    position: Array
    normal: Array
    colour: Array


def surfaces_of(geometry: Geometry, pose: Pose, size: tuple[int, int]) -> Surfaces:
    """What the centres of pixels see, for a perspective camera.

    Args:
        geometry: the surfaces.
        pose: pose of the camera.
        size: width and height of the image, pixels.
    """
    width, height = size
    half = np.tan(np.radians(pose.fov) / 2)
    x = (1 - 2 * (np.arange(width) + 0.5) / width) * half
    y = (1 - 2 * (np.arange(height) + 0.5) / height) * half * height / width
    across = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    directions = across @ pose.to_world[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(pose.origin, directions.shape)
    hits = geometry.cast(origins, directions)
    colours = geometry.colours(origins, directions)
    distance = np.where(np.isfinite(hits.distance), hits.distance, 1e4)
    facing = -np.sign((hits.normal * directions).sum(axis=1, keepdims=True))
    shape = (height, width, 3)
    return Surfaces(
        (distance[:, None] * directions).reshape(shape),
        (hits.normal * facing).reshape(shape),
        np.where(np.isfinite(colours), colours, 1.0).reshape(shape),
    )


def smoothed(image: Array, seen: Surfaces) -> Array:
    """Smooth the noise of an image, (H, W, 3), along surfaces; their colours, outlines and shadows are kept."""
    tint = np.maximum(seen.colour, _DARKEST)
    trust = np.clip((seen.colour / _DARKEST) ** 2, 0.01, 1.0).astype(np.float32)
    # Lamps with a black surface, and gloss, are brighter than their reflectance allows.
    brighter = (seen.colour < _DARKEST) & (image / tint > 2 * _mean3(image / tint))
    shining = np.all(brighter, axis=-1, keepdims=True)
    tint, trust = np.where(shining, 1.0, tint), np.where(shining, np.float32(1), trust)
    light = np.log1p(_despeckled(image / tint) * _gain(image)).astype(np.float32)
    normals, positions = seen.normal.astype(np.float32), seen.position.astype(np.float32)
    plane = (_PLANE * np.maximum(np.linalg.norm(seen.position, axis=-1), 1e-6)).astype(np.float32)
    along = (positions * normals).sum(axis=-1)
    noise = max(float(np.median(np.abs(light - _mean3(light)))), 1e-3)
    for level in range(_LEVELS):
        step = 1 << level
        total, weights = np.zeros_like(light), np.zeros_like(light)
        spread = _LIGHT * noise / (1 << level)
        for dy, wy in zip(range(-2, 3), _KERNEL, strict=True):
            for dx, wx in zip(range(-2, 3), _KERNEL, strict=True):
                other, trusted, normal, position = (
                    _shifted(each, dy * step, dx * step) for each in (light, trust, normals, positions)
                )
                both = np.minimum(trust, trusted)
                unlike = (both * np.abs(other - light)).sum(axis=-1) / both.sum(axis=-1)
                brightness = unlike / np.float32(spread)
                turn = ((normal - normals) ** 2).sum(axis=-1) / np.float32(_NORMAL**2)
                off = np.abs(np.einsum("ijk,ijk->ij", position, normals) - along) / plane
                alike = np.exp(-np.clip(brightness + turn + off, 0, 50))
                weight = np.float32(wy * wx) * alike[..., None] * trusted
                total += weight * other
                weights += weight
        light = total / weights
    return np.asarray(np.expm1(light) / _gain(image) * tint)


def _gain(image: Array) -> float:
    """Factor that maps the median brightness to 1, around which the logarithm treats dark and bright alike."""
    mean = float(np.median(image.mean(axis=-1)))
    return 1.0 / mean if mean > 0 else 1.0 / max(float(image.mean()), 1e-9)


def _despeckled(image: Array) -> Array:
    """Limit each pixel to twice the mean of its neighbours."""
    around = _mean3(image)
    return np.minimum(image, 2.0 * around)


def _mean3(image: NDArray[Any]) -> NDArray[Any]:
    """Mean of the eight neighbours."""
    total = np.zeros_like(image)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy or dx:
                total += _shifted(image, dy, dx)
    return np.asarray(total / 8)


def _shifted(values: NDArray[Any], dy: int, dx: int) -> Any:
    """Values of the pixels `dy` rows below and `dx` columns to the right; the outermost ones repeat."""
    rows = (np.arange(values.shape[0]) + dy).clip(0, values.shape[0] - 1)
    columns = (np.arange(values.shape[1]) + dx).clip(0, values.shape[1] - 1)
    return values[rows][:, columns]
