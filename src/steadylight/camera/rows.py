"""Rows of poses, as in CSV and TUM files: settings in comment lines, rotations, and the path through all rows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

import numpy as np

from steadylight.camera.keyframes import DEFAULT_FPS, checked_first_frame, checked_fps, frame_time
from steadylight.camera.path import CameraPath, Keyframe
from steadylight.camera.values import Array
from steadylight.errors import CameraError

MOST_ROWS: Final = 100_000
"""Maximum number of poses in a file: about the maximum number of frames of an animation."""

Axes = Literal["opencv", "opengl"]
"""Camera axes of a rotation: the camera looks along +z with y down (opencv), or along -z with y up (opengl)."""

_SETTING = re.compile(r"#\s*(fps|fov|up|loop|axes|first_frame)\s*[:=]\s*(.*?)\s*$", re.IGNORECASE)
_NORM = 0.02  # by how much the length of a quaternion may miss 1: rounding in the file


@dataclass(frozen=True)
class Header:
    """Settings of the whole file, from comment lines such as `# fps: 30`.

    Attributes:
        fps: frames per second; None if not given.
        fov: horizontal field of view of rows without one, degrees.
        up: up direction of rows without one and without a rotation.
        loop: see `CameraPath`.
        axes: see `Axes`.
        first_frame: number of the first frame; None if not given.
    """

    fps: float | None = None
    fov: float | None = None
    up: tuple[float, ...] | None = None
    loop: bool = False
    axes: Axes = "opencv"
    first_frame: int | None = None

    def with_comment(self, comment: str) -> Header:
        """The header with the setting in a comment line, if there is one."""
        match = _SETTING.match(comment.strip())
        if match is None:
            return self
        name, text = match[1].lower(), match[2]
        return replace(self, **{name: _value(name, text)})


@dataclass(frozen=True)
class Row:
    """A pose in a file.

    Attributes:
        line: line number, counted from 1.
        moment: seconds, or a frame number if the file counts frames.
        values: fields of a `Keyframe`, except for its time.
    """

    line: int
    moment: float
    values: Mapping[str, Any] = field(default_factory=dict)


def path_of(
    rows: Sequence[Row], header: Header, first_frame: int | None, *, counts_frames: bool
) -> tuple[CameraPath, float | None]:
    """The path through rows with times or frame numbers; times count from the first row.

    Raises:
        CameraError: there are too few or too many rows, or one is not valid; the message names its line.
    """
    if len(rows) < 2:
        raise CameraError(f"has {len(rows)} pose{'s' * (not rows)}; a camera path needs at least two")
    if len(rows) > MOST_ROWS:
        raise CameraError(
            f"line {rows[MOST_ROWS].line}: more than {MOST_ROWS:,} poses; keep, for example, every second one"
        )
    fps = header.fps or (DEFAULT_FPS if counts_frames else None)
    first = header.first_frame if first_frame is None else first_frame
    defaults = {name: value for name in ("fov", "up") if (value := getattr(header, name)) is not None}
    keyframes: list[Keyframe] = []
    for row in rows:
        try:
            if counts_frames:
                time = frame_time(_whole(row.moment), first, fps or DEFAULT_FPS, "a line `# first_frame: {}`")
            else:
                time = row.moment - rows[0].moment
            keyframes.append(Keyframe(time=time, **{**defaults, **row.values}))
            _check_order(keyframes[-2:], "frame" if counts_frames else "time", row.moment)
        except CameraError as error:
            raise CameraError(f"line {row.line}: {error}") from None
    return CameraPath(tuple(keyframes), header.loop), fps


def _check_order(last: Sequence[Keyframe], name: str, moment: float) -> None:
    if len(last) == 2 and last[1].time <= last[0].time:
        raise CameraError(f"`{name}` {moment:.15g} is not later than that of the row before")


def turned(origin: Sequence[float], quaternion: Sequence[float], axes: Axes) -> dict[str, Any]:
    """`origin`, `target` and `up` of a camera from its position and rotation.

    Args:
        origin: position, world, metres.
        quaternion: (x, y, z, w) rotation from the camera's axes to the world's.
        axes: convention of the camera's axes.

    Raises:
        CameraError: the quaternion is not a rotation.
    """
    x, y, z, w = quaternion
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _NORM:
        raise CameraError(
            f"the quaternion (qx qy qz qw) has length {length:.3g}, but a rotation has length 1; check the order of "
            "the columns"
        )
    x, y, z, w = np.asarray(quaternion) / length
    # Second and third column of the rotation matrix.
    second = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    third = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    view, up = (third, -second) if axes == "opencv" else (-third, second)
    return {
        "origin": tuple(origin),
        "target": tuple((_exact(origin) + view).tolist()),
        "up": tuple(up.tolist()),
    }


def finite(text: str, name: str) -> float:
    """Parse a finite number.

    Raises:
        CameraError: the text is not a number, or not finite.
    """
    try:
        number = float(text) if text.isascii() and "_" not in text else None
    except ValueError:
        number = None
    shown = text if len(text) <= 40 else text[:40] + "..."
    if number is None:
        raise CameraError(f"`{name}` is {shown!r}, not a number")
    if not np.isfinite(number):
        raise CameraError(f"`{name}` is {shown}; it must be a finite number")
    return number


def _exact(origin: Sequence[float]) -> Array:
    return np.asarray(origin, dtype=np.float64)


def _whole(moment: float) -> int:
    if moment != int(moment):
        raise CameraError(f"`frame` is {moment:g}; it must be a whole number, counted from 1")
    return int(moment)


def _value(name: str, text: str) -> Any:
    """The value of a setting in a comment line."""
    if name == "loop":
        if text.lower() not in {"true", "false"}:
            raise CameraError(f"`loop` is {text!r}; it must be true or false")
        return text.lower() == "true"
    if name == "axes":
        if text.lower() not in {"opencv", "opengl"}:
            raise CameraError(
                f"`axes` is {text!r}; it must be opencv (looks along +z, y down) or opengl (looks along -z, y up)"
            )
        return text.lower()
    if name == "first_frame":
        return checked_first_frame(_whole(finite(text, name)))
    numbers = [finite(word, name) for word in text.replace(",", " ").split()]
    if len(numbers) != (3 if name == "up" else 1):
        raise CameraError(
            f"`{name}` is {text!r}; it must be {'three numbers' if name == 'up' else 'one number'}"
        )
    if name == "fps":
        return checked_fps(numbers[0])
    return tuple(numbers) if name == "up" else numbers[0]
