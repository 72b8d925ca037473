"""Sizes: the rooms around the camera, the height of its eye, and whether the units are plausible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.renderers.base import Geometry
from steadylight.walking.checks import directions_around
from steadylight.walking.space import Frame

_RAYS: Final = 2048
_LOWEST, _HIGHEST = 0.3, 12.0
"""Plausible range of the height of the eye above the floor, metres."""
_NARROWEST, _WIDEST = 0.8, 300.0
"""Plausible minimum height and maximum length of a room, metres."""
_UNITS: Final = (("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254), ("feet", 0.3048))


@dataclass(frozen=True)
class Room:
    """What surrounds the camera at a frame.

    Attributes:
        frame: number of the frame.
        box: (2, 3) lowest and highest corner of the surroundings, in the level frame turned by `yaw`.
        yaw: direction of the walls, radians.
        open_share: fraction of all directions in which there is no surface.
    """

    frame: int
    box: NDArray[np.float64]
    yaw: float
    open_share: float

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height, metres; the longer side first."""
        x, y, z = (self.box[1] - self.box[0]).tolist()
        return max(x, y), min(x, y), z

    def __str__(self) -> str:
        words = " x ".join(f"{side:.1f}" if side < 100 else f"{side:.0f}" for side in self.size)
        kind = "the room" if self.open_share < 0.2 else "what surrounds the camera"
        return f"{kind} at frame {self.frame} is {words} m"


def room_at(geometry: Geometry, frame: Frame, pose: Pose, number: int) -> Room | None:
    """The room around a camera: the box around the ray hits, without the outermost hundredth of them on each side."""
    directions = directions_around(_RAYS)
    origin = np.broadcast_to(pose.origin, directions.shape)
    hits = geometry.cast(origin, directions)
    met = np.isfinite(hits.distance)
    if met.sum() < 16:
        return None
    points = frame.local(origin[met] + hits.distance[met, None] * directions[met])
    normals = frame.local(hits.normal[met])
    upright = np.abs(normals[:, 2]) < 0.2
    # Averaging four times the angle makes walls at right angles count as parallel.
    angle = 4 * np.arctan2(normals[upright, 1], normals[upright, 0])
    yaw = float(np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()) / 4) if upright.any() else 0.0
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    turned = points @ turn.T
    return Room(number, np.percentile(turned, (1, 99), axis=0), yaw, float(1 - met.mean()))


def different_rooms(rooms: Sequence[Room], most: int = 3) -> list[Room]:
    """Rooms that differ by more than a third in some dimension: the first of each size, at most `most`."""
    kept: list[Room] = []
    for room in rooms:
        if all(np.max(np.abs(np.log(np.array(room.size) / np.array(other.size)))) > 0.3 for other in kept):
            kept.append(room)
    return kept[:most]


def eye_heights(geometry: Geometry, frame: Frame, origins: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of each origin, (N, 3) world, above the floor below it, (N,) metres; NaN without a floor."""
    down = np.broadcast_to(-frame.matrix[2], origins.shape)
    distance = geometry.cast(origins, down).distance
    return np.where(np.isfinite(distance), distance, np.nan)


def doubts(rooms: Sequence[Room], heights: NDArray[np.float64]) -> list[str]:
    """What is implausible if one unit is a metre, as sentences without a full stop."""
    found = []
    known = heights[np.isfinite(heights)]
    if len(known) and not _LOWEST <= np.median(known) <= _HIGHEST:
        eye = float(np.median(known))
        found.append(f"the camera is {eye:.3g} m above the floor; {_in_other_units(eye)}")
    for room in rooms:
        largest, _, height = room.size
        if room.open_share < 0.2 and not (height >= _NARROWEST and largest <= _WIDEST):
            found.append(f"{room}, which is unusual; is one unit of the scene a metre?")
            break
    return found


def _in_other_units(eye: float) -> str:
    likely = [
        f"in {name}, it would be {eye * unit:.2f} m" for name, unit in _UNITS if 1.0 <= eye * unit <= 2.2
    ]
    return " or ".join(likely) if likely else "is one unit of the scene a metre, and up the right axis?"
