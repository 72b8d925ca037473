"""The smooth curves through keyframes.

Position and orientation follow cubic Hermite curves through the keyframes, with one rule for the velocity at a keyframe
(see `_velocities`). A cubic spline with continuous acceleration would overshoot: it leaves the room at a sharp turn,
and drifts where two equal keyframes hold the camera still. PCHIP and Akima curves do not overshoot, but they treat x, y
and z separately, so that the shape of the path would depend on the orientation of the scene. The rule used here holds
still where it should, stays near the chords (within 22 % of their length), and is invariant to rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.camera.values import Array

_LEVEL_MARGIN = math.radians(5)  # closer to straight up or down, there is no horizon to level


class Keys(NamedTuple):
    """Keyframes as arrays: times (K,), origins (K, 3), axes (K, 3, 3) of `axes_of`, ups (K, 3) and fovs (K,)."""

    times: Array
    origins: Array
    axes: Array
    ups: Array
    fovs: Array


class Curve:
    """Hermite curves of a path: piecewise cubic position, rotation vector and field of view.

    Segment i runs from key i to i+1 in u = 0..1. Its rotation is key i's rotation times the exponential of a
    rotation vector that is cubic in u (in the camera frame of key i), as in scipy's RotationSpline, but with
    the velocities of `_velocities` at the keys.
    """

    def __init__(self, keys: Keys, loop: bool) -> None:
        from scipy.spatial.transform import Rotation  # loading it takes longer than most commands

        self.times, self.origins, self.fovs = keys.times, keys.origins, keys.fovs
        self.up = keys.ups[0] / np.linalg.norm(keys.ups[0])
        self.rotations = Rotation.from_matrix(keys.axes)
        self.level = False
        if len(self.times) == 1:
            return
        self.steps = np.diff(self.times)
        self.velocities = _velocities(self.steps, np.diff(self.origins, axis=0) / self.steps[:, None], loop)
        # The turn from key to key has the same components in the camera frames of both.
        self.turns = (self.rotations[:-1].inv() * self.rotations[1:]).as_rotvec()
        self.spins = _velocities(self.steps, self.turns / self.steps[:, None], loop)
        self.fov = _fov_curve(self.times, self.fovs, loop)
        self.level = self._has_horizon(keys.ups)

    def _has_horizon(self, ups: Array) -> bool:
        """Whether all keys share one up direction that the view direction never approaches.

        Interpolating the rotation between two level cameras tilts the horizon in between, so such paths are levelled
        again.
        """
        ups = ups / np.linalg.norm(ups, axis=1, keepdims=True)
        if np.abs(ups - ups[0]).max() > 1e-6:
            return False
        u = np.linspace(0, 1, 33)
        t = (self.times[:-1, None] + self.steps[:, None] * u).reshape(-1)
        height = self._directions(t)[:, :, 2] @ self.up
        return bool(np.abs(height).max() < math.cos(_LEVEL_MARGIN))

    def _locate(self, t: Array) -> tuple[NDArray[np.intp], Array]:
        """Segment of each time, and position in it (0..1)."""
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.steps) - 1)
        return i, (t - self.times[i]) / self.steps[i]

    def _directions(self, t: Array) -> Array:
        """Camera axes as columns (left, up, view) at each time, (T, 3, 3)."""
        from scipy.spatial.transform import Rotation

        i, u = self._locate(t)
        h = self.steps[i, None]
        # Except at 0, the rate of change of a rotation vector is not the angular velocity: the end needs a Jacobian.
        end = _inverse_jacobian(self.turns[i], self.spins[i + 1])
        vector = _hermite(u[:, None], np.zeros(3), self.turns[i], h * self.spins[i], h * end)
        return np.asarray((self.rotations[i] * Rotation.from_rotvec(vector)).as_matrix())

    def at(self, t: Array) -> tuple[Array, Array]:
        """Camera-to-world matrices, (T, 4, 4), and fields of view, (T,), at times within the path."""
        if len(self.times) == 1:
            axes = np.broadcast_to(self.rotations.as_matrix(), (len(t), 3, 3))
            origins = np.broadcast_to(self.origins, (len(t), 3))
            fovs = np.broadcast_to(self.fovs, len(t))
        else:
            i, u = self._locate(t)
            h = self.steps[i, None]
            origins = _hermite(
                u[:, None],
                self.origins[i],
                self.origins[i + 1],
                h * self.velocities[i],
                h * self.velocities[i + 1],
            )
            axes = self._directions(t)
            fovs = self.fov(t)
        to_world = np.tile(np.eye(4), (len(t), 1, 1))
        to_world[:, :3, :3] = [axes_of(axis[:, 2], self.up) for axis in axes] if self.level else axes
        to_world[:, :3, 3] = origins
        return to_world, fovs


def _velocities(steps: Array, slopes: Array, loop: bool) -> Array:
    """Velocity at each key from the mean velocities of the adjacent segments.

    At inner keys, the slope of the parabola through three neighbouring keys; at the ends of an open path, zero
    acceleration. The speed is limited to 1.5 times that of the slower adjacent segment: this keeps the curve near its
    chords, and gives zero velocity next to a segment without motion.

    Args:
        steps: (K-1,) durations of the segments, seconds.
        slopes: (K-1, 3) mean velocity in each segment.
        loop: whether the first segment follows the last.

    Returns:
        (K, 3) velocities.
    """
    velocity = np.zeros((len(steps) + 1, 3))
    h0, h1 = steps[:-1, None], steps[1:, None]
    velocity[1:-1] = (h1 * slopes[:-1] + h0 * slopes[1:]) / (h0 + h1)
    speed = np.linalg.norm(slopes, axis=1)
    limit = np.zeros(len(velocity))
    limit[1:-1] = np.minimum(speed[:-1], speed[1:])
    if loop:
        velocity[[0, -1]] = (steps[0] * slopes[-1] + steps[-1] * slopes[0]) / (steps[0] + steps[-1])
        limit[[0, -1]] = min(speed[0], speed[-1])
    elif len(steps) == 1:
        return np.repeat(slopes, 2, axis=0)
    else:
        velocity[0] = (3 * slopes[0] - velocity[1]) / 2
        velocity[-1] = (3 * slopes[-1] - velocity[-2]) / 2
        limit[0], limit[-1] = speed[0], speed[-1]
    length = np.linalg.norm(velocity, axis=1)
    shrink = np.minimum(1.0, 1.5 * limit / np.maximum(length, 1e-300))
    return np.asarray(velocity * shrink[:, None])


def _hermite(u: Array, start: Array, end: Array, start_slope: Array, end_slope: Array) -> Array:
    """Cubic Hermite curve at u in 0..1; slopes are derivatives with respect to u."""
    v = 1.0 - u
    return (
        (1 + 2 * u) * v * v * start
        + u * u * (3 - 2 * u) * end
        + u * v * v * start_slope
        - u * u * v * end_slope
    )


def _inverse_jacobian(turn: Array, spin: Array) -> Array:
    """Rate of change of a rotation vector, given the angular velocity in the rotating frame.

    Args:
        turn: (T, 3) rotation vectors, radians, up to half a turn.
        spin: (T, 3) angular velocities in the rotated frame.
    """
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    safe = np.maximum(angle, 1e-4)
    half = safe / 2
    factor = np.where(angle < 1e-4, 1 / 12, (1 - half / np.tan(half)) / safe**2)
    across = np.cross(turn, spin)
    return np.asarray(spin + across / 2 + factor * np.cross(turn, across))


def _fov_curve(times: Array, fovs: Array, loop: bool) -> Callable[[Array], Array]:
    """Curve of the field of view; monotone between keys, so that it stays in range.

    A loop is closed by wrapping one key around at each end.
    """
    if (fovs == fovs[0]).all():
        return np.polynomial.Polynomial(fovs[:1])
    from scipy.interpolate import PchipInterpolator  # loading it takes longer than the rest of `plan`

    if loop:
        period = times[-1] - times[0]
        times = np.concatenate([[times[-2] - period], times, [times[1] + period]])
        fovs = np.concatenate([[fovs[-2]], fovs, [fovs[1]]])
    curve: Callable[[Array], Array] = PchipInterpolator(times, fovs)
    return curve


def axes_of(view: Any, up: Any) -> Array:
    """Camera axes as columns: left, up, view, (3, 3); left = up x view as in Mitsuba."""
    view = np.asarray(view, dtype=np.float64)
    left = np.cross(up, view)
    left /= np.linalg.norm(left)
    return np.stack([left, np.cross(view, left), view], axis=1)
