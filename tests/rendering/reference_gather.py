"""The readable twin of `gather._reduce`: irradiance and its gradients from a stratified hemisphere."""

from __future__ import annotations

from typing import Any

import numpy as np


def reduce_strata(
    L: np.ndarray, r: np.ndarray, tangent: np.ndarray, frame: np.ndarray, rim: float
) -> dict[str, np.ndarray]:
    """Sums over M elevation x N azimuth strata of a cosine-weighted hemisphere.

    Ward & Heckbert, Irradiance Gradients, 1992. Stratum (j, k) spans sin² theta in [j/M, (j+1)/M] and phi in
    2 pi [k/N, (k+1)/N]. The sums of L and of L tan theta still lack the factor pi / (M N).

    Args:
        L: (M, N, 3) radiance.
        r: (M, N) distance, metres; may be infinite.
        tangent: (M, N) tan theta of each sample.
        frame: (3, 3) columns s, t, n of the local frame in the world.
        rim: tan theta from which on a hit is no obstacle.

    Returns:
        `E` (3,), `closeness` (the sum of 1/r), `nearest` (the least r above the rim), `translation` and
        `rotation` (3 channels, 3).
    """
    M, N, _ = L.shape
    L, r, tangent = L.astype(np.float64), r.astype(np.float64), tangent.astype(np.float64)
    rotation = np.zeros((3, 3))
    translation = np.zeros((3, 3))
    for k in range(N):
        middle, border = 2 * np.pi * (k + 0.5) / N, 2 * np.pi * k / N
        u = np.array([np.cos(middle), np.sin(middle), 0])
        v = np.array([-np.sin(middle), np.cos(middle), 0])
        v_border = np.array([-np.sin(border), np.cos(border), 0])
        for j in range(M):
            # Turning the normal about v leans it towards u: a direction's cosine grows by sin theta, that is
            # by tan theta for every unit of cosine that the sampling density has taken up.
            rotation += np.outer(L[j, k] * tangent[j, k], v)
            # Moving along u widens or narrows the strata at their border with the ring above ...
            if j > 0:
                sin_border = np.sqrt(j / M)
                cos2_border = 1 - j / M
                nearer = min(r[j, k], r[j - 1, k])
                change = 2 * np.pi / N * sin_border * cos2_border / nearer
                translation += np.outer(L[j, k] - L[j - 1, k], change * u)
            # ... and along v at their border with the neighbour in the ring (k = 0 follows k = N - 1).
            nearer = min(r[j, k], r[j, k - 1])
            change = (np.sqrt((j + 1) / M) - np.sqrt(j / M)) / nearer
            translation += np.outer(L[j, k] - L[j, k - 1], change * v_border)
    return {
        "E": L.sum((0, 1)),
        "closeness": (1 / r).sum(),
        "nearest": r[tangent < rim].min(),
        "translation": translation @ frame.T,
        "rotation": rotation @ frame.T,
    }


def polygon_irradiance(corners: np.ndarray, position: np.ndarray, normal: np.ndarray) -> Any:
    """Irradiance from a polygon of unit radiance that lies above the horizon (Lambert 1760).

    E = 1/2 sum over edges of (angle that the edge subtends) * (normal of the plane of edge and point) . n.

    Args:
        corners: (C, 3) in order; the sign of the result depends on it and is dropped.
        position: (3,).
        normal: (3,).
    """
    to = (corners - position) / np.linalg.norm(corners - position, axis=1, keepdims=True)
    following = np.roll(to, -1, axis=0)
    across = np.cross(to, following)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.arctan2(length[:, 0], (to * following).sum(axis=1))
    return abs((angle * ((across / length) @ normal)).sum()) / 2
