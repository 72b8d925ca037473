"""Bundled animation `temple-walk`: a few steps into the columned hall of the temple, towards the inner rooms.

Represents the Kalabsha walkthrough of Aggarwal, Chalmers & Debattista (EGPGV 2008): the hall is lit by sun
patches, by the bright court behind, and mostly by indirect light from its stones.
"""

from __future__ import annotations

import dataclasses

from steadylight.camera import CameraPath, Keyframe
from steadylight.scenes import temple
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import Deferred, SceneDescription

ANIMATION = BUNDLED["temple-walk"]
FRAMES, FPS = ANIMATION.frames, ANIMATION.fps
_EYE = 1.65  # metres above the floor


def describe() -> SceneDescription:
    """The temple with a walk from the front of its hall to the middle."""
    return SceneDescription(
        name="temple-walk",
        content=Deferred(temple.describe_content),
        camera=camera(),
        **dataclasses.asdict(ANIMATION),
    )


def camera() -> CameraPath:
    """Eight metres at eye height in 3.6 s, between the columns of the left aisle, turning to the right."""
    steps = [
        # origin x, y; target x, y, height above the eye
        ((-5.6, 24.7), (-1.4, 33.0, 0.75)),
        ((-4.7, 26.4), (0.6, 34.2, 0.70)),
        ((-3.9, 28.1), (3.1, 34.8, 0.60)),
        ((-2.3, 29.1), (6.4, 33.8, 0.50)),
        ((-0.7, 29.3), (9.0, 31.2, 0.50)),
    ]
    eye = temple.HALL_FLOOR + _EYE
    last = (FRAMES - 1) / FPS
    return CameraPath(
        keyframes=tuple(
            Keyframe(
                time=last * k / (len(steps) - 1),
                origin=(x, y, eye),
                target=(tx, ty, eye + rise),
                up=(0.0, 0.0, 1.0),
                fov=68.0,
            )
            for k, ((x, y), (tx, ty, rise)) in enumerate(steps)
        ),
        loop=False,
    )
