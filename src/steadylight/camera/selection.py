"""Frame selection: how much the view changes along a path, and the frames of the first pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from steadylight.camera.path import Pose
from steadylight.camera.values import Array


def change_measure(poses: Sequence[Pose]) -> Array:
    """Measure gamma = alpha + beta: how much the view changes from each frame to the next.

    Aggarwal, Chalmers & Debattista 2008, High-Fidelity Rendering of Animations on the Grid. alpha is the
    angle between the view directions of neighbouring frames, beta the distance between their positions; each
    is divided by its sum over the path, so that rotation and translation have the same weight. A term that never
    changes is 0 throughout.

    Args:
        poses: F poses, one for each frame.

    Returns:
        (F-1,) gamma of each frame step; sums to 2, or to 1 if the camera only rotates or only moves.
    """
    directions = np.array([pose.direction for pose in poses]).reshape(-1, 3)
    origins = np.array([pose.origin for pose in poses]).reshape(-1, 3)
    sine = np.linalg.norm(np.cross(directions[:-1], directions[1:]), axis=1)
    alpha = np.arctan2(sine, (directions[:-1] * directions[1:]).sum(axis=1))
    beta = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    size = max(1.0, float(np.abs(origins).max(initial=0.0)))
    return _share(alpha, 1e-9) + _share(beta, 1e-9 * size)


def _share(change: Array, rounding: float) -> Array:
    """Each change as its share of the sum; zeros if the sum is within rounding error."""
    total = float(change.sum())
    return change / total if total > rounding else np.zeros_like(change)


def select_frames(poses: Sequence[Pose], count: int) -> list[int]:
    """Choose the frames of the first pass: equally spaced in cumulative gamma (`change_measure`).

    The first and last frame are included; if `count` is 1, the middle one is chosen. Where two targets fall on the same
    frame, the frame farthest from all chosen ones replaces one of them, so that `count` frames are found whenever
    that many differ.

    Args:
        poses: F poses, one for each frame.
        count: number of frames to select, at least 1.

    Returns:
        Sorted indices from 0, without duplicates: all frames if `count` is F or more; only the first if the
        camera never moves.
    """
    cumulative = np.concatenate([[0.0], np.cumsum(change_measure(poses))])
    total = cumulative[-1]
    if total == 0.0:
        return [0]
    if count >= len(poses):
        return list(range(len(poses)))
    targets = np.linspace(0.0, total, count) if count > 1 else np.array([total / 2])
    chosen = {int(np.abs(cumulative - target).argmin()) for target in targets}
    while len(chosen) < count:
        gaps = np.abs(cumulative[:, None] - cumulative[sorted(chosen)]).min(axis=1)
        if gaps.max() <= 1e-12 * total:
            break
        chosen.add(int(gaps.argmax()))
    return sorted(chosen)
