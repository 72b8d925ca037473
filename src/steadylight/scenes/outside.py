"""The camera of scenes that have none: it sees everything from outside."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from steadylight.camera import CameraPath, Keyframe

FOV = 60.0
"""Horizontal, degrees."""

_AWAY = np.array([0.5, -1.0, 0.5]) / np.sqrt(1.5)


def outside(low: ArrayLike, high: ArrayLike) -> CameraPath:
    """A still view of a whole bounding box, slightly from above; z is up.

    Args:
        low: lower corner of the box, (3,).
        high: upper corner, (3,). A box that is empty or not finite counts as two metres wide.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        low, high = -np.ones(3), np.ones(3)
    centre = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    # A margin of half the angle, because most films are wider than high.
    origin = centre + _AWAY * radius / np.sin(np.radians(FOV / 3))
    return CameraPath((Keyframe(0.0, tuple(origin.tolist()), tuple(centre.tolist()), fov=FOV),))
