"""Patterns, evaluated with `rtrace`: as pictures on flat surfaces if these are few, otherwise as their mean.

A pattern is evaluated on a surface that glows with 1. Whatever it is made of (pictures, data, functions, text), its
values are then those of Radiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.radiance.grammar import Primitive
from steadylight.scenes.radiance.modifiers import Modifier, renamed
from steadylight.scenes.radiance.sources import traced
from steadylight.scenes.radiance.surfaces import Triangles

Floats = NDArray[np.float64]

MOST_PICTURES: Final = 32
"""Maximum number of surfaces of one material that get a picture each."""

SIDE: Final = 512
"""Texels along the longer side of a picture."""

SAMPLES: Final = 2048
"""Number of rays for a mean."""

_SEED = 20
_NEAR = 1e-4
_GLOW = "looked-at"


@dataclass(frozen=True)
class Picture:
    """A pattern on a flat surface.

    Attributes:
        values: (H, W, 3) values; the first row is at v = 0.
        uv: (V, 2) texture coordinates of the surface's vertices.
    """

    values: NDArray[np.float32]
    uv: NDArray[np.float32]

    def texture(self, colour: Sequence[float], most: float = np.inf) -> dict[str, Any]:
        """The pattern times a colour, as a texture with values of at most `most`."""
        values = np.minimum(self.values * np.asarray(colour, np.float32), most).astype(np.float32)
        return {"type": "bitmap", "data": values, "raw": True, "wrap_mode": "clamp"}


def _glowing(modifier: Modifier) -> list[Primitive]:
    """The patterns below a material, applied to a glow of 1."""
    below = modifier.below
    assert below is not None
    found, names = renamed(below.chain())
    return [*found, Primitive(names[below], "glow", _GLOW, (), (1.0, 1.0, 1.0, 0.0))]


def picture_of(modifier: Modifier, surface: Triangles, folder: Path) -> Picture:
    """The pattern of a material over a polygon.

    Args:
        modifier: the material.
        surface: a flat surface.
        folder: folder of the scene, where functions and pictures are searched.
    """
    a, b, c = (surface.vertices[surface.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a).sum(axis=0)
    normal /= np.linalg.norm(normal)
    edges = np.roll(surface.vertices, -1, axis=0) - surface.vertices
    edge = edges[np.argmax(np.linalg.norm(edges, axis=1))]
    u = edge / np.linalg.norm(edge)
    v = np.cross(normal, u)
    flat = surface.vertices @ np.stack([u, v], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = high - low
    width, height = np.maximum(np.round(SIDE * size / size.max()), 1).astype(int)
    x = low[0] + (np.arange(width) + 0.5) / width * size[0]
    y = low[1] + (np.arange(height) + 0.5) / height * size[1]
    level = float(surface.vertices[0] @ normal)
    points = (x[None, :, None] * u + y[:, None, None] * v).reshape(-1, 3) + level * normal
    reach = size.max() * 0.01
    corners = [(low[0] - reach, low[1] - reach), (high[0] + reach, low[1] - reach)]
    corners += [(high[0] + reach, high[1] + reach), (low[0] - reach, high[1] + reach)]
    sheet = [s * u + t * v + level * normal for s, t in corners]
    polygon = Primitive(_GLOW, "polygon", "sheet", (), tuple(np.concatenate(sheet).tolist()))
    lifted = points + _NEAR * size.max() * normal
    seen = traced([*_glowing(modifier), polygon], lifted, np.broadcast_to(-normal, lifted.shape), folder)
    return Picture(
        np.maximum(seen.reshape(height, width, 3), 0).astype(np.float32),
        ((flat - low) / size).astype(np.float32),
    )


def mean_of(modifier: Modifier, surfaces: Sequence[Triangles], folder: Path) -> Floats:
    """Mean of a pattern over the area of surfaces and over directions weighted by their cosine, (3,).

    With this mean, a lamp emits as much light as with its pattern.
    """
    random = np.random.default_rng(_SEED)
    areas = np.concatenate([surface.areas for surface in surfaces])
    corners = np.concatenate([surface.vertices[surface.faces] for surface in surfaces])
    chosen = corners[random.choice(len(corners), SAMPLES, p=areas / areas.sum())]
    first, second = random.random((2, SAMPLES, 1))
    root = np.sqrt(first)
    points = (1 - root) * chosen[:, 0] + root * (1 - second) * chosen[:, 1] + root * second * chosen[:, 2]
    normal = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Points on the unit sphere around the tip of the normal: directions weighted by the cosine.
    z = 2 * random.random(SAMPLES) - 1
    azimuth = 2 * np.pi * random.random(SAMPLES)
    across = np.sqrt(1 - z * z)
    away = normal + np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    polygons = [
        Primitive(_GLOW, "polygon", f"t{number}", (), tuple(corner.ravel().tolist()))
        for number, corner in enumerate(corners)
    ]
    reach = _NEAR * float(np.sqrt(areas.mean()))
    seen = traced([*_glowing(modifier), *polygons], points + reach * away, -away, folder)
    mean: Floats = seen.mean(axis=0)
    return mean
