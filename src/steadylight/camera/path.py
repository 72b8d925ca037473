"""Camera paths: keyframes, and the pose of the camera at any time.

Frames: right-handed world, metres; time in seconds, frame i (counted from 1) is at time (i-1)/fps; fields of
view are horizontal, in degrees. The first keyframe of a path is at time 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from steadylight.camera.curve import Curve, Keys, axes_of
from steadylight.camera.values import Array, Vector, checked_number, checked_vector
from steadylight.errors import CameraError

_PARALLEL = 1e-6  # sine of the angle below which two directions count as parallel
_TIME_SLACK = 1e-6  # seconds: (i-1)/fps may miss the end of the path by rounding


@dataclass(frozen=True)
class Keyframe:
    """Camera position, view and field of view at one time.

    Attributes:
        time: seconds from the start of the path.
        origin: position of the camera, world, metres.
        target: point that the camera looks at, world, metres; only the direction from origin matters.
        up: up direction of the image, world; need not be normalized or perpendicular to the view.
        fov: horizontal field of view, degrees, between 0 and 180.

    Raises:
        CameraError: a value is not finite, origin is target, up is parallel to the view, or fov is out
            of range.
    """

    time: float
    origin: Vector
    target: Vector
    up: Vector = (0.0, 0.0, 1.0)
    fov: float = 60.0

    def __post_init__(self) -> None:
        for name in ("time", "fov"):
            object.__setattr__(self, name, checked_number(name, getattr(self, name)))
        for name in ("origin", "target", "up"):
            object.__setattr__(self, name, checked_vector(name, getattr(self, name)))
        if not 0.0 < self.fov < 180.0:
            raise CameraError(f"`fov` is {self.fov:g}; it must be between 0 and 180 degrees")
        view = np.subtract(self.target, self.origin)
        if not view.any():
            raise CameraError(
                f"`origin` and `target` are the same point {list(self.origin)}; give different points"
            )
        length = np.linalg.norm(self.up) * np.linalg.norm(view)
        if length == 0 or np.linalg.norm(np.cross(self.up, view)) <= _PARALLEL * length:
            raise CameraError(
                f"`up` {list(self.up)} is zero, or parallel to the view from `origin` to `target`; give a "
                "direction that points up in the image, such as [0, 0, 1]"
            )

    @property
    def view(self) -> Array:
        """Unit view direction, world, (3,)."""
        view = np.subtract(self.target, self.origin)
        return np.asarray(view / np.linalg.norm(view))


@dataclass(frozen=True)
class Pose:
    """A camera pose at one time.

    Attributes:
        to_world: (4, 4) camera-to-world; its columns are left, up, view direction and origin (the camera
            looks along its +z, as with `mi.Transform4f.look_at`).
        fov: horizontal field of view, degrees.
        time: seconds from the start of the animation, for scenes that change over time.
    """

    to_world: Array
    fov: float
    time: float = 0.0

    @property
    def origin(self) -> Array:
        """Position, world, metres, (3,)."""
        return self.to_world[:3, 3]

    @property
    def direction(self) -> Array:
        """Unit view direction, world, (3,)."""
        return self.to_world[:3, 2]


@dataclass(frozen=True)
class CameraPath:
    """A smooth path through keyframes.

    Attributes:
        keyframes: in order of time, the first at time 0. A single keyframe (at any time) is a still view.
        loop: the path repeats. Its last keyframe must repeat the first one (origin, view, up and fov), at the
            time when the loop closes; the curve is smooth there too.

    Raises:
        CameraError: no keyframes, times that do not increase from 0, or a loop that does not close.
    """

    keyframes: tuple[Keyframe, ...]
    loop: bool = False

    def __post_init__(self) -> None:
        keys = tuple(self.keyframes)
        object.__setattr__(self, "keyframes", keys)
        if not keys:
            raise CameraError("a camera path needs at least one keyframe")
        if len(keys) > 1 and keys[0].time != 0.0:
            raise CameraError(
                f"keyframe 1: is at {keys[0].time:g} s; the path must start at time 0 (which is frame 1)"
            )
        for number, (before, after) in enumerate(itertools.pairwise(keys), start=2):
            if after.time <= before.time:
                raise CameraError(
                    f"keyframe {number}: is at {after.time:g} s, not later than keyframe {number - 1} at "
                    f"{before.time:g} s; times must increase"
                )
        if self.loop:
            self._check_loop()

    def _check_loop(self) -> None:
        first, last = self.keyframes[0], self.keyframes[-1]
        if len(self.keyframes) < 3:
            raise CameraError("a loop needs at least three keyframes, the last of which repeats the first")
        size = max(1.0, float(np.abs([first.origin, last.origin]).max()))
        closed = (
            np.allclose(first.origin, last.origin, rtol=0, atol=1e-6 * size)
            and np.allclose(axes_of(first.view, first.up), axes_of(last.view, last.up), rtol=0, atol=1e-6)
            and math.isclose(first.fov, last.fov, rel_tol=1e-6)
        )
        if not closed:
            raise CameraError(
                f"keyframe {len(self.keyframes)}: the last keyframe of a loop must repeat the first; add one "
                "with the origin, target, up and fov of keyframe 1 at the time when the loop closes"
            )

    @property
    def duration(self) -> float:
        """Seconds from the first to the last keyframe; 0 for a still view."""
        return self.keyframes[-1].time - self.keyframes[0].time

    @property
    def upright(self) -> Vector:
        """The world axis nearest to the up vectors of the keyframes: the scene's own up direction."""
        up = sum(np.asarray(key.up) / np.linalg.norm(key.up) for key in self.keyframes)
        axis = int(np.abs(up).argmax())
        direction = [0.0, 0.0, 0.0]
        direction[axis] = float(np.sign(np.asarray(up)[axis])) or 1.0
        return direction[0], direction[1], direction[2]

    def frame_count(self, fps: float) -> int:
        """Number of frames of the path: 1 for a still view; a loop does not repeat its first pose at the end."""
        if len(self.keyframes) == 1:
            return 1
        last = self.duration * fps
        slack = _TIME_SLACK * fps
        return max(1, math.ceil(last - slack)) if self.loop else math.floor(last + slack) + 1

    def frame_poses(self, frames: Sequence[int], fps: float) -> list[Pose]:
        """Poses of frames counted from 1.

        Raises:
            CameraError: a frame is beyond the end of the path; the message gives the number of frames.
        """
        count = self.frame_count(fps)
        beyond = [frame for frame in frames if frame > count]
        if beyond and not self.loop and len(self.keyframes) > 1:
            raise CameraError(
                f"frame {beyond[0]} is beyond the end of the camera path, which lasts {self.duration:g} s: "
                f"{count} frames at {fps:g} frames per second"
            )
        return self.poses([(frame - 1) / fps for frame in frames])

    def pose(self, time: float) -> Pose:
        """Pose at a time in seconds; see `poses`."""
        return self.poses([time])[0]

    def poses(self, times: Sequence[float] | Array) -> list[Pose]:
        """Poses at times in seconds. A still view is the same at all times, a loop repeats.

        Raises:
            CameraError: a time is before 0 or, unless the path repeats, beyond the end.
        """
        moments = np.asarray(times, dtype=np.float64).reshape(-1)
        t = moments
        if len(self.keyframes) == 1:
            t = np.zeros_like(t)
        elif self.loop:
            t = np.mod(t, self.duration)
        else:
            wrong = t[~((t >= -_TIME_SLACK) & (t <= self.duration + _TIME_SLACK))]
            if wrong.size:
                raise CameraError(
                    f"time {wrong[0]:g} s is outside the camera path, which runs from 0 to {self.duration:g} s"
                )
            t = t.clip(0.0, self.duration)
        to_world, fovs = self._curve.at(t)
        return [
            Pose(matrix, float(fov), float(moment))
            for matrix, fov, moment in zip(to_world, fovs, moments, strict=True)
        ]

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the curve, which is computed from the keyframes."""
        return {name: value for name, value in self.__dict__.items() if name != "_curve"}

    @cached_property
    def _curve(self) -> Curve:
        keys = self.keyframes
        arrays = Keys(
            times=np.array([key.time for key in keys]),
            origins=np.array([key.origin for key in keys]),
            axes=np.stack([axes_of(key.view, key.up) for key in keys]),
            ups=np.array([key.up for key in keys]),
            fovs=np.array([key.fov for key in keys]),
        )
        return Curve(arrays, self.loop)
