"""Cameras: a pose as a Radiance view, and as rays through points of the image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.errors import SceneError
from steadylight.scenes.description import SceneDescription

_WITHOUT_MEANING = {"type", "scale", "near_clip", "far_clip", "shutter_open", "shutter_close", "srf"}


@dataclass(frozen=True)
class View:
    """A perspective view.

    Attributes:
        pose: of the camera.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    pose: Pose
    width: int
    height: int

    @property
    def words(self) -> list[str]:
        """Options of `rpict`."""
        half = math.tan(math.radians(self.pose.fov) / 2)
        vertical = 2 * math.degrees(math.atan(half * self.height / self.width))
        words = ["-vtv"]
        for option, vector in (
            ("-vp", self.pose.origin),
            ("-vd", self.pose.direction),
            ("-vu", self.pose.to_world[:3, 1]),
        ):
            words += [option, *(f"{value:.9g}" for value in vector)]
        return [*words, "-vh", f"{self.pose.fov:.9g}", "-vv", f"{vertical:.9g}"]

    def rays(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Origins and directions, (N, 6), through image points (N, 2) in [0, 1)², measured from the top left."""
        half = math.tan(math.radians(self.pose.fov) / 2)
        left, up, forward = self.pose.to_world[:3, :3].T
        across = (1 - 2 * points[:, :1]) * half
        above = (1 - 2 * points[:, 1:]) * half * self.height / self.width
        direction = forward + across * left + above * up
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.hstack([np.broadcast_to(self.pose.origin, direction.shape), direction])


def check_sensor(scene: SceneDescription) -> None:
    """Check that Radiance supports the scene's sensor.

    Raises:
        SceneError: it does not; says what is supported.
    """
    sensor: Mapping[str, Any] = scene.sensor
    if sensor.get("type", "perspective") != "perspective":
        raise SceneError(
            f"scene {scene.name}: sensor `{sensor['type']}` is not supported with --renderer radiance; "
            "supported: perspective"
        )
    unknown = sorted(set(sensor) - _WITHOUT_MEANING)
    if unknown:
        raise SceneError(
            f"scene {scene.name}: property `{unknown[0]}` of the sensor is not supported with --renderer radiance"
        )


def is_mirrored(scene: SceneDescription) -> bool:
    """Whether the scene's own sensor mirrors the image horizontally."""
    return float(np.asarray(scene.sensor.get("scale", (1.0, 1.0, 1.0)))[0]) < 0
