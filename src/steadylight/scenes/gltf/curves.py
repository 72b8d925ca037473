"""Curves of glTF animations: step, linear and cubic spline, as the specification defines them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.schema import AnimationSampler

Array = NDArray[np.float64]

_SLACK = 1e-5
"""Seconds by which rounding to single precision may move a key away from its frame."""


class Curve:
    """Values over time.

    Attributes:
        times: (K,) times of the keys, seconds, increasing.
        values: (K, W), or for a cubic spline (K, 3, W): in-tangent, value, out-tangent.
        interpolation: LINEAR, STEP or CUBICSPLINE.
    """

    def __init__(self, file: File, sampler: AnimationSampler, width: int, place: str) -> None:
        """Read a curve.

        Args:
            file: the glTF file.
            sampler: the sampler to read.
            width: numbers per value, W; a value of four is a rotation.
            place: place in the document, for messages.

        Raises:
            SceneError: times do not increase, or the number of values does not match that of times.
        """
        self.interpolation = sampler.interpolation
        self.times = file.numbers(sampler.input, place, 1)[:, 0].astype(np.float64)
        values = file.numbers(sampler.output, place, width).astype(np.float64)
        each = 3 if self.interpolation == "CUBICSPLINE" else 1
        if not len(self.times) or len(values) != each * len(self.times):
            raise file.fault(
                place, f"has {len(self.times)} times and {len(values)} values; {each} for each are needed"
            )
        if (np.diff(self.times) < 0).any():
            raise file.fault(place, "its times must increase")
        self.values = values.reshape(-1, 3, width) if each == 3 else values
        self._turns = width == 4

    def at(self, times: Array) -> Array:
        """Values at times, (T, W); before the first key and after the last, the value of that key."""
        if len(self.times) == 1:
            key = self.values[0, 1] if self.interpolation == "CUBICSPLINE" else self.values[0]
            return np.broadcast_to(key, (len(times), len(key)))
        t = np.clip(times, self.times[0], self.times[-1])
        i = np.clip(np.searchsorted(self.times - _SLACK, t, side="right") - 1, 0, len(self.times) - 2)
        span = self.times[i + 1] - self.times[i]
        u = np.where(span > 0, (t - self.times[i]) / np.where(span > 0, span, 1.0), 1.0)
        u = np.where(t > self.times[i + 1] - _SLACK, 1.0, np.maximum(u, 0.0))[:, None]
        if self.interpolation == "STEP":
            return np.asarray(np.where(u < 1, self.values[i], self.values[i + 1]))
        if self.interpolation == "CUBICSPLINE":
            return self._spline(i, u, span[:, None])
        start, end = self.values[i], self.values[i + 1]
        return _slerp(start, end, u) if self._turns else np.asarray(start + (end - start) * u)

    def _spline(self, i: NDArray[np.intp], u: Array, span: Array) -> Array:
        """Cubic Hermite curve between keys; rotations are normalized where they are used."""
        start, leaving = self.values[i, 1], self.values[i, 2]
        arriving, end = self.values[i + 1, 0], self.values[i + 1, 1]
        v = 1 - u
        return np.asarray(
            (1 + 2 * u) * v * v * start
            + u * u * (3 - 2 * u) * end
            + span * (u * v * v * leaving - u * u * v * arriving)
        )


def _slerp(start: Array, end: Array, u: Array) -> Array:
    """Spherical linear interpolation of quaternions, (T, 4), along the shorter arc."""
    start, end = _unit(start), _unit(end)
    dot = (start * end).sum(axis=1, keepdims=True)
    end = np.where(dot < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - u, np.sin((1 - u) * angle) / safe)
    second = np.where(near, u, np.sin(u * angle) / safe)
    return np.asarray(first * start + second * end)


def _unit(quaternions: Array) -> Array:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.asarray(quaternions / np.where(length > 0, length, 1.0))
