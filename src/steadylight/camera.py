"""Camera: interpolates keyframes to one smooth pose per frame, and selects the frames of the first pass.

Frames: right-handed world, metres; time in seconds, frame i (counted from 1) is at time (i-1)/fps; fields of
view are horizontal, in degrees. The first keyframe of a path is at time 0.

Interpolation. Position and orientation follow cubic Hermite curves through the keyframes, with one rule for
the velocity at a keyframe (see `_velocities`). A cubic spline with continuous acceleration would overshoot: it
leaves the room at a sharp turn, and drifts where two equal keyframes hold the camera still. PCHIP and Akima curves do
not overshoot, but they treat x, y and z separately, so that the shape of the path would depend on the orientation of
the scene. The rule used here holds still where it should, stays near the chords (within 22 % of their length), and is
invariant to rotation.
"""

from __future__ import annotations

import difflib
import itertools
import json
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path

Vector = tuple[float, float, float]
Array = NDArray[np.float64]

_DEFAULT_FPS = 25.0
_FILE_KEYS = ("keyframes", "fps", "loop", "up", "fov")
_KEYFRAME_KEYS = ("time", "frame", "origin", "target", "up", "fov")
_PARALLEL = 1e-6  # sine of the angle below which two directions count as parallel
_LEVEL_MARGIN = math.radians(5)  # closer to straight up or down, there is no horizon to level
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
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        for name in ("origin", "target", "up"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))
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
            and np.allclose(_frame(first.view, first.up), _frame(last.view, last.up), rtol=0, atol=1e-6)
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

    def frame_count(self, fps: float) -> int:
        """Number of frames of the path: 1 for a still view; a loop does not repeat its first pose."""
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
        poses = self._curve.poses(t)
        return [replace(pose, time=float(moment)) for pose, moment in zip(poses, moments, strict=True)]

    @cached_property
    def _curve(self) -> _Curve:
        return _Curve(self.keyframes, self.loop)


class _Curve:
    """Hermite curves of a path: piecewise cubic position, rotation vector and field of view.

    Segment i runs from key i to i+1 in u = 0..1. Its rotation is key i's rotation times the exponential of a
    rotation vector that is cubic in u (in the camera frame of key i), as in scipy's RotationSpline, but with
    the velocities of `_velocities` at the keys.
    """

    def __init__(self, keys: tuple[Keyframe, ...], loop: bool) -> None:
        from scipy.spatial.transform import Rotation  # loading it takes longer than most commands

        self.times = np.array([key.time for key in keys])
        self.origins = np.array([key.origin for key in keys])
        self.fovs = np.array([key.fov for key in keys])
        self.up = np.asarray(keys[0].up) / np.linalg.norm(keys[0].up)
        self.rotations = Rotation.from_matrix(np.stack([_frame(key.view, key.up) for key in keys]))
        self.level = False
        if len(keys) == 1:
            return
        self.steps = np.diff(self.times)
        self.velocities = _velocities(self.steps, np.diff(self.origins, axis=0) / self.steps[:, None], loop)
        # The turn from key to key has the same components in the camera frames of both.
        self.turns = (self.rotations[:-1].inv() * self.rotations[1:]).as_rotvec()
        self.spins = _velocities(self.steps, self.turns / self.steps[:, None], loop)
        self.fov = _fov_curve(self.times, self.fovs, loop)
        self.level = self._has_horizon(np.array([key.up for key in keys]))

    def _has_horizon(self, ups: Array) -> bool:
        """Whether all keys share one up direction that the view direction never approaches.

        Interpolating the rotation between two level cameras tilts the horizon in between; such paths are
        levelled again.
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
        # Except at 0, the rate of a rotation vector is not the angular velocity: the end needs a Jacobian.
        end = _inverse_jacobian(self.turns[i], self.spins[i + 1])
        vector = _hermite(u[:, None], np.zeros(3), self.turns[i], h * self.spins[i], h * end)
        return np.asarray((self.rotations[i] * Rotation.from_rotvec(vector)).as_matrix())

    def poses(self, t: Array) -> list[Pose]:
        """Poses at times within the path."""
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
        poses = []
        for axis, origin, fov in zip(axes, origins, fovs, strict=True):
            to_world = np.eye(4)
            to_world[:3, :3] = _frame(axis[:, 2], self.up) if self.level else axis
            to_world[:3, 3] = origin
            poses.append(Pose(to_world, float(fov)))
        return poses


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
    """Rate of a rotation vector, given the angular velocity in the rotating frame.

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
    """Monotone between keys, so that it stays in range; a loop is closed by wrapping one key around at each end."""
    if (fovs == fovs[0]).all():
        return np.polynomial.Polynomial(fovs[:1])
    from scipy.interpolate import PchipInterpolator  # loading it takes longer than the rest of `plan`

    if loop:
        period = times[-1] - times[0]
        times = np.concatenate([[times[-2] - period], times, [times[1] + period]])
        fovs = np.concatenate([[fovs[-2]], fovs, [fovs[1]]])
    curve: Callable[[Array], Array] = PchipInterpolator(times, fovs)
    return curve


def _frame(view: Any, up: Any) -> Array:
    """Camera axes as columns: left, up, view, (3, 3); left = up x view as in Mitsuba."""
    view = np.asarray(view, dtype=np.float64)
    left = np.cross(up, view)
    left /= np.linalg.norm(left)
    return np.stack([left, np.cross(view, left), view], axis=1)


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


def load_camera(path: Path) -> tuple[CameraPath, float | None]:
    """Read a camera path from a TOML or JSON file (by its suffix, `.toml` or `.json`).

    Keys of the file: `keyframes`, a list of at least two; `fps`, frames per second; `loop`, see `CameraPath`;
    `up` and `fov`, defaults for keyframes without. Keys of a keyframe: `time` in seconds or `frame` counted
    from 1 (at the file's fps, or 25); `origin`, `target`; `up`, `fov`.

    Returns:
        The path, and the frames per second that the file gives or its frame numbers imply, or None.

    Raises:
        CameraError: the message names the file, the keyframe, the fault and the remedy.
    """
    content = _parse(path)
    try:
        return _path_from(content)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None


def _parse(path: Path) -> Any:
    """Parse the file to plain data; read and syntax errors become CameraError."""
    if path.suffix.lower() not in (".toml", ".json"):
        raise CameraError(f"{path}: a camera file must end in .toml or .json")
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    except FileNotFoundError:
        raise CameraError(f"{path}: no such camera file") from None
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise CameraError(f"{path}: is not UTF-8 text (byte {error.start})") from None
    except tomllib.TOMLDecodeError as error:
        raise CameraError(f"{path}: is not valid TOML: {error}") from None
    except RecursionError:
        raise CameraError(f"{path}: is nested too deeply; a camera file is a list of keyframes") from None
    except json.JSONDecodeError as error:
        raise CameraError(
            f"{path}: is not valid JSON: {error.msg} (at line {error.lineno}, column {error.colno})"
        ) from None


def _path_from(content: Any) -> tuple[CameraPath, float | None]:
    """The path from a parsed file."""
    _check_keys(content, _FILE_KEYS, "the file")
    if "keyframes" not in content:
        raise CameraError("`keyframes` is missing: a list of at least two keyframes")
    entries = content["keyframes"]
    if not isinstance(entries, list):
        raise CameraError(f"`keyframes` must be a list of keyframes, not {_kind(entries)}")
    if len(entries) < 2:
        raise CameraError(
            f"has {len(entries)} keyframe{'s' * (not entries)}; a camera path needs at least two"
        )
    loop = content.get("loop", False)
    if not isinstance(loop, bool):
        raise CameraError(f"`loop` must be true or false, not {_kind(loop)}")
    fps = _number("fps", content["fps"]) if "fps" in content else None
    if fps is not None and fps <= 0:
        raise CameraError(f"`fps` is {fps:g}; it must be greater than 0")
    defaults = {key: content[key] for key in ("up", "fov") if key in content}
    if any(isinstance(entry, Mapping) and "frame" in entry for entry in entries):
        fps = fps or _DEFAULT_FPS
    keyframes = []
    for number, entry in enumerate(entries, start=1):
        try:
            keyframes.append(_keyframe_from(entry, defaults, fps))
        except CameraError as error:
            raise CameraError(f"keyframe {number}: {error}") from None
    return CameraPath(tuple(keyframes), loop), fps


def _keyframe_from(entry: Any, defaults: Mapping[str, Any], fps: float | None) -> Keyframe:
    """One keyframe from its table."""
    _check_keys(entry, _KEYFRAME_KEYS, "a keyframe")
    missing = [f"`{key}`" for key in ("origin", "target") if key not in entry]
    if not {"time", "frame"} & entry.keys():
        missing.insert(0, "`time` (seconds) or `frame` (counted from 1)")
    if missing:
        raise CameraError(
            f"{' and '.join(missing)} missing; every keyframe needs {'them' if len(missing) > 1 else 'one'}"
        )
    if {"time", "frame"} <= entry.keys():
        raise CameraError("has both `time` and `frame`; give one of them")
    values = {**defaults, **entry}
    if "frame" in values:
        frame = values.pop("frame")
        if isinstance(frame, bool) or not isinstance(frame, int) or frame < 1:
            raise CameraError(f"`frame` is {frame!r}; it must be a whole number, counted from 1")
        values["time"] = (frame - 1) / (fps or _DEFAULT_FPS)
    return Keyframe(**values)


def _check_keys(table: Any, valid: Sequence[str], what: str) -> None:
    """Reject anything but a table, and unknown keys."""
    if not isinstance(table, Mapping):
        raise CameraError(f"{what} must be a table of keys and values, not {_kind(table)}")
    for key in table:
        if key not in valid:
            near = difflib.get_close_matches(key, valid, n=1)
            hint = f"; did you mean `{near[0]}`?" if near else ";"
            raise CameraError(f"`{key}` is not a valid key{hint} valid keys: {', '.join(valid)}")


def _number(name: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise CameraError(f"`{name}` must be a number, not {_kind(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise CameraError(f"`{name}` is {number}; it must be a finite number")
    return number


def _vector(name: str, value: Any) -> Vector:
    """Three finite numbers."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 3:
        raise CameraError(f"`{name}` must be three numbers [x, y, z], not {_kind(value)}")
    x, y, z = (_number(name, item) for item in value)
    return x, y, z


def _kind(value: Any) -> str:
    """A description of a value for messages."""
    if isinstance(value, list | tuple | np.ndarray):
        return f"a list of {len(value)}"
    if isinstance(value, Mapping):
        return "a table"
    return repr(value)
