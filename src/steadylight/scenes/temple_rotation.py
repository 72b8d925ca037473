"""Bundled animation `temple-rotation`: once around the temple on a circle that crosses its open court.

Represents the Kalabsha rotation of Aggarwal, Chalmers & Debattista (EGPGV 2008): the temple from outside and inside.
The circle passes through both side gates of the court at eye height and rises outside. The camera looks at the hall,
but ahead where it nears and leaves a gate, as a visitor does: there the hall lies behind a wall.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.scenes import temple
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import Deferred, SceneDescription

ANIMATION = BUNDLED["temple-rotation"]
FRAMES, FPS = ANIMATION.frames, ANIMATION.fps

_CENTRE = (0.0, 50.0)  # of the circle, in plan, metres
_RADIUS = 36.0
_TARGET = (0.0, 27.0)  # in plan: the centre of the hall
_START = -100.0  # degrees from the court, counter-clockwise seen from above
_STEPS = 72  # keyframes of the circle


def describe() -> SceneDescription:
    """The temple with a camera that circles around its house and through its court."""
    return SceneDescription(
        name="temple-rotation",
        content=Deferred(temple.describe_content),
        camera=camera(),
        **dataclasses.asdict(ANIMATION),
    )


def camera() -> CameraPath:
    """A loop of 1441 frames at constant speed; the last keyframe repeats the first."""
    keyframes = []
    for k in range(_STEPS + 1):
        angle = _START + 360.0 * (k % _STEPS) / _STEPS
        turn = np.radians(angle)
        away = abs((angle + 180.0) % 360.0 - 180.0)  # degrees from the centre of the court
        rise = _smooth((away - 30.0) / 60.0)
        # Coming, the camera sees the gate from afar; leaving, it sees nothing but sand.
        seen = 90.0 if angle < 0 else 50.0
        ahead = _smooth((away - 2.0) / 20.0) * _smooth((seen - away) / (seen - 27.0))
        x, y = _CENTRE[0] + _RADIUS * np.sin(turn), _CENTRE[1] - _RADIUS * np.cos(turn)
        keyframes.append(
            Keyframe(
                time=FRAMES / FPS * k / _STEPS,
                origin=(float(x), float(y), 1.75 + 8.25 * rise),
                target=(*_seen_from(x, y, turn, ahead), 2.9 + 1.1 * rise),
                up=(0.0, 0.0, 1.0),
                fov=64.0,
            )
        )
    return CameraPath(keyframes=tuple(keyframes), loop=True)


def _seen_from(x: float, y: float, turn: float, ahead: float) -> tuple[float, float]:
    """Where the camera looks in plan: at the hall, turned towards the tangent of the circle by the part `ahead`."""
    offset = complex(_TARGET[0] - x, _TARGET[1] - y)
    tangent = np.exp(1j * turn)
    towards = offset * np.exp(1j * ahead * np.angle(tangent / offset))
    return float(x + towards.real), float(y + towards.imag)


def _smooth(t: float) -> float:
    """0 before 0, 1 after 1, with zero slope at both."""
    c = min(max(t, 0.0), 1.0)
    return c * c * (3.0 - 2.0 * c)
