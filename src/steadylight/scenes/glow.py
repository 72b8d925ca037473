"""Emissive meshes: whether they are closed, and which triangles emit if the emission is a texture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.image_texture import linear_texels
from steadylight.scenes.surface import Texture

_MOST_TEXELS = 1 << 22
"""Larger images are reduced to blocks, which count as bright if one of their texels is."""

FAINT = 1e-3
"""Texels up to this fraction of the brightest one count as dark: compression leaves such values in areas that were
meant to be black."""


def is_closed(points: NDArray[Any], triangles: NDArray[Any]) -> bool:
    """Whether every edge, identified by the positions of its ends, belongs to two triangles or more.

    Args:
        points: (V, 3) positions.
        triangles: (F, 3) indices of points.
    """
    _, place = np.unique(points, axis=0, return_inverse=True)
    corners = place.reshape(-1)[triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    return bool((counts > 1).all())


def glowing_faces(emission: Texture, uv: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Mask, (F,), of triangles whose box in texture space has a bright texel: all that emit, and perhaps others.

    Args:
        emission: the texture.
        uv: (V, 2) texture coordinates.
        faces: (F, 3) indices of vertices.
    """
    values = linear_texels(emission.entry()).max(axis=2)
    bright = values > FAINT * values.max(initial=0.0)
    step = int(np.ceil(np.sqrt(bright.size / _MOST_TEXELS))) if bright.size > _MOST_TEXELS else 1
    if step > 1:
        height, width = (-(-side // step) for side in bright.shape)
        padded = np.zeros((height * step, width * step), bool)
        padded[: bright.shape[0], : bright.shape[1]] = bright
        bright = padded.reshape(height, step, width, step).any(axis=(1, 3))
    if emission.wrap == "mirror":
        bright = np.block([[bright, bright[:, ::-1]], [bright[::-1], bright[::-1, ::-1]]])
    height, width = bright.shape
    scale = np.array([width, height]) / (2 if emission.wrap == "mirror" else 1)
    matrix = np.eye(3) if emission.to_uv is None else emission.to_uv
    at = (uv.astype(np.float64) @ matrix[:2, :2].T + matrix[:2, 2]) * scale
    corners = np.clip(at, -1e9, 1e9)[faces]
    # One more texel on each side, because of interpolation.
    low = np.floor(corners.min(axis=1) - 1).astype(np.int64)
    high = np.ceil(corners.max(axis=1) + 1).astype(np.int64)
    if emission.wrap == "clamp":
        low, high = (np.clip(bound, 0, [width - 1, height - 1]) for bound in (low, high - 1))
        high = np.maximum(high, low) + 1
    # The image is repeated 2 x 2 times, so that any box no larger than the image fits without wrapping.
    table = np.zeros((2 * height + 1, 2 * width + 1), np.int64)
    table[1:, 1:] = np.tile(bright, (2, 2)).cumsum(axis=0).cumsum(axis=1)
    span = np.minimum(high - low, [width, height])
    start = np.mod(low, [width, height])
    end = start + span
    count = (
        table[end[:, 1], end[:, 0]]
        - table[start[:, 1], end[:, 0]]
        - table[end[:, 1], start[:, 0]]
        + table[start[:, 1], start[:, 0]]
    )
    return np.asarray(count > 0)
