"""Orbits: a camera on a level circle that looks at a point, from a line of text such as `radius=4,height=1.6`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from steadylight.camera.path import CameraPath, Keyframe
from steadylight.camera.rows import finite
from steadylight.camera.values import Array, Vector
from steadylight.errors import CameraError

_KEYS_A_TURN: Final = 36
"""Keyframes per turn: the curve between them is within 0.01 % of the circle."""

_MARGIN: Final = 1.1
"""Factor on the distance that leaves room around the scene in the picture."""

_FORM: Final = "radius=4,height=1.6,around=0:0:1,turns=1,frames=250,fov=60"


@dataclass(frozen=True)
class Orbit:
    """A circle around a point, or around the whole scene.

    Attributes:
        around: the point that the camera looks at, world, metres; the middle of the scene if None.
        radius: radius of the circle, metres; if None, such that the scene fits into the picture.
        height: height of the camera above the point, metres; if None, a third of the radius around a scene, 0 around a
            point.
        turns: number of turns; negative for clockwise, seen from above. Whole turns make a path that repeats.
        frames: number of frames of the whole orbit.
        fov: horizontal field of view, degrees.
    """

    around: Vector | None = None
    radius: float | None = None
    height: float | None = None
    turns: float = 1.0
    frames: int = 250
    fov: float = 60.0

    @classmethod
    def parse(cls, text: str) -> Orbit:
        """Parse text such as `radius=4,height=1.6`, or `scene` for a circle around the scene.

        Raises:
            CameraError: the text is not valid; the message names the fault.
        """
        orbit = cls()
        for item in text.split(",") if text.strip() != "scene" else ():
            name, equals, value = (part.strip() for part in item.partition("="))
            read = _READ.get(name)
            if read is None or not equals:
                near = difflib.get_close_matches(name, _READ, n=1)
                hint = f"; did you mean `{near[0]}`?" if near and near[0] != name else ""
                raise CameraError(
                    f"--orbit: `{item.strip()}` is not valid{hint}; give scene, or some of {_FORM}"
                )
            try:
                orbit = replace(orbit, **{name: read(value, name)})
            except CameraError as error:
                raise CameraError(f"--orbit: {error}") from None
        return orbit

    @property
    def needs_bounds(self) -> bool:
        """Whether the path depends on the extent of the scene."""
        return self.around is None or self.radius is None

    def path(self, up: Vector, fps: float, bounds: Array | None = None) -> CameraPath:
        """The camera path.

        Args:
            up: axis of the circle.
            fps: frames per second.
            bounds: (2, 3) lowest and highest corner of the scene, if needed (see `needs_bounds`).

        Raises:
            CameraError: the scene is empty or infinite.
        """
        axis = np.asarray(up, np.float64)
        radius, around = self.radius, self.around
        if bounds is not None and self.needs_bounds:
            if not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).any():
                raise CameraError("--orbit: the scene has no extent; give around=X:Y:Z and radius=R")
            if around is None:
                x, y, z = bounds.mean(axis=0).tolist()
                around = (x, y, z)
            if radius is None:
                reach = float(np.linalg.norm(bounds[1] - bounds[0])) / 2
                radius = _MARGIN * reach / math.sin(math.radians(min(self.fov, 60.0)) / 2)
        if radius is None or around is None:
            raise CameraError("--orbit: give around=X:Y:Z and radius=R")
        height = self.height if self.height is not None else (radius / 3 if self.around is None else 0.0)
        across = np.roll(axis, 1)
        along = np.cross(axis, across)
        count = max(2, math.ceil(abs(self.turns) * _KEYS_A_TURN))
        closed = abs(self.turns - round(self.turns)) < 1e-9 and abs(self.turns) >= 1
        duration = (self.frames if closed else self.frames - 1) / fps
        keyframes = []
        for number in range(count + 1):
            angle = 2 * math.pi * self.turns * number / count
            if closed and number == count:
                angle = 0.0
            place = around + height * axis + radius * (math.cos(angle) * across + math.sin(angle) * along)
            x, y, z = place.tolist()
            keyframes.append(Keyframe(duration * number / count, (x, y, z), around, up, self.fov))
        return CameraPath(tuple(keyframes), loop=closed)


def _point(text: str, name: str) -> Vector:
    words = text.split(":")
    if len(words) != 3:
        raise CameraError(f"`{name}` is {text!r}; it must be a point X:Y:Z")
    x, y, z = (finite(word, name) for word in words)
    return x, y, z


def _positive(text: str, name: str) -> float:
    value = finite(text, name)
    if value <= 0:
        raise CameraError(f"`{name}` is {value:g}; it must be greater than 0")
    return value


def _turns(text: str, name: str) -> float:
    value = finite(text, name)
    if value == 0 or abs(value) > 1000:
        raise CameraError(f"`{name}` is {value:g}; it must not be 0, and at most 1000")
    return value


def _frames(text: str, name: str) -> int:
    value = finite(text, name)
    if value != int(value) or not 2 <= value <= 99_999:
        raise CameraError(f"`{name}` is {text}; it must be a whole number from 2 to 99999")
    return int(value)


_READ: Final[dict[str, Callable[[str, str], Any]]] = {
    "around": _point,
    "radius": _positive,
    "height": finite,
    "turns": _turns,
    "frames": _frames,
    "fov": _positive,
}
