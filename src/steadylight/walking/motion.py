"""Motion: turns a route into keyframes of a smooth walk with the speed, look-ahead and turning of a person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import CameraPath, Keyframe
from steadylight.walking.space import Array, Floor

_SPACING: Final = 0.05
"""Metres between the points of a smoothed route."""
_ROUNDS: Final = 400
"""Rounds of smoothing: corners become arcs of about a metre."""
_SHIFT: Final = 1.5
"""Metres by which smoothing may move a point of the route."""
_TURN: Final = np.radians(60)
"""Maximum rate at which the head turns while walking, radians per second."""
_EASE: Final = 0.8
"""Acceleration of a person who starts walking, m/s²."""
_STEADY: Final = 0.25
"""Seconds over which position and direction are averaged."""
_BEAT: Final = 0.4
"""Seconds between keyframes."""
_TICK: Final = 0.02
"""Seconds between samples of the motion."""


@dataclass(frozen=True)
class Gait:
    """How a person walks and looks.

    Attributes:
        speed: walking speed, m/s.
        look_ahead: metres along the path over which the direction of view is averaged.
        pitch: pitch of the view on level ground, degrees; negative looks down.
    """

    speed: float = 1.0
    look_ahead: float = 1.5
    pitch: float = -3.0


@dataclass(frozen=True)
class Route:
    """Where to walk.

    Attributes:
        points: (N, 3) on the floor, in the level frame.
        stops: indices of the points that the walk must pass.
        leeway: maximum distance at which it may pass them, metres.
    """

    points: Array
    stops: NDArray[np.int64]
    leeway: float


def walk_along(floor: Floor, route: Route, gait: Gait, fov: float) -> CameraPath:
    """The camera path of a person who walks a route.

    Args:
        floor: where a person can walk.
        route: where to walk.
        gait: how the person walks and looks.
        fov: horizontal field of view, degrees.
    """
    line = _smooth(floor, route)
    eyes = line + np.array((0.0, 0.0, floor.body.eye))
    yaw, pitch = _view_along(line, gait)
    times = _times(line, yaw, gait.speed)
    ticks = np.arange(0, times[-1] + _TICK, _TICK)
    place = np.column_stack([np.interp(ticks, times, eyes[:, axis]) for axis in range(3)])
    place = _averaged(place, _STEADY / _TICK)
    yaw = _averaged(np.interp(ticks, times, yaw)[:, None], _STEADY / _TICK)[:, 0]
    pitch = _averaged(np.interp(ticks, times, pitch)[:, None], _STEADY / _TICK)[:, 0]
    beats = np.linspace(0, len(ticks) - 1, max(2, round(ticks[-1] / _BEAT) + 1)).round().astype(int)
    up = tuple(floor.frame.matrix[2].tolist())
    keyframes = []
    for tick in beats:
        view = [
            np.cos(yaw[tick]) * np.cos(pitch[tick]),
            np.sin(yaw[tick]) * np.cos(pitch[tick]),
            np.sin(pitch[tick]),
        ]
        origin, target = (
            floor.frame.world(point).round(4) + 0.0 for point in (place[tick], place[tick] + view)
        )
        time = round(float(ticks[tick]), 4)
        keyframes.append(Keyframe(time, tuple(origin.tolist()), tuple(target.tolist()), up, fov))
    return CameraPath(tuple(keyframes))


def _even(route: Array, stops: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Points at even spacing along a route, and the indices of the stops among them."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(route[:, :2], axis=0), axis=1))])
    count = max(3, int(along[-1] / _SPACING) + 1)
    at = np.linspace(0, along[-1], count)
    even = np.column_stack([np.interp(at, along, route[:, axis]) for axis in range(3)])
    return even, np.searchsorted(at, along[stops] - 1e-9).clip(0, count - 1)


def _smooth(floor: Floor, route: Route) -> Array:
    """Straighten a route like an elastic band, as far as walls and furniture allow.

    A point moves towards the middle of its neighbours if its clearance stays comfortable or does not shrink. It stays
    within `_SHIFT` of its original position, or within `leeway` if it is a stop; both ends stay in place.
    """
    from scipy.spatial import cKDTree

    places = np.flatnonzero(floor.free)
    tree = cKDTree(floor.places[places])
    wish = min(2 * floor.body.radius, 0.5)
    line, stops = _even(route.points, route.stops)
    limit = np.full(len(line), _SHIFT)
    limit[stops] = route.leeway
    limit[[0, -1]] = 0.0
    origin = line[:, :2].copy()

    def around(points: Array) -> tuple[Array, Array]:
        """Clearance and height of the floor at points."""
        near: Any = tree.query(points, k=4)
        distance, number = near
        weight = 1 / np.maximum(distance, 1e-6)
        weight /= weight.sum(axis=1, keepdims=True)
        number = places[np.minimum(number, len(places) - 1)]
        clearance = (weight * floor.clearance[number]).sum(axis=1)
        off = np.where(distance[:, 0] > floor.cell, 0.0, clearance)  # off the floor
        return off, (weight * floor.places[number, 2]).sum(axis=1)

    clearance, _ = around(line)
    for _ in range(_ROUNDS):
        moved = line.copy()
        # More distant neighbours smooth long waves as quickly as short ones.
        for reach in (1, 4, 12):
            if len(line) > 2 * reach:
                middle = (moved[2 * reach :, :2] + moved[: -2 * reach, :2]) / 2
                moved[reach:-reach, :2] += 0.3 * (middle - moved[reach:-reach, :2])
        near, height = around(moved)
        fits = near >= np.minimum(wish, clearance)
        fits &= np.linalg.norm(moved[:, :2] - origin, axis=1) <= limit
        line[fits, :2] = moved[fits, :2]
        line[fits, 2] = height[fits]
        clearance[fits] = near[fits]
    even, _ = _even(_averaged(line, 3), np.zeros(1, np.int64))
    even[:, 2] = _averaged(even[:, 2:], 0.35 / _SPACING)[:, 0]  # legs even out stairs
    return even


def _view_along(line: Array, gait: Gait) -> tuple[Array, Array]:
    """Yaw and pitch of the view at each point, averaged over the path ahead; radians, yaw without jumps."""
    steps = np.gradient(line, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    slope = np.arctan2(steps[:, 2], np.hypot(steps[:, 0], steps[:, 1]))
    ahead = max(1, round(gait.look_ahead / _SPACING))
    padded = np.column_stack([heading, slope])
    padded = np.concatenate([padded, np.repeat(padded[-1:], ahead, axis=0)])
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(padded, axis=0)])
    mean = (total[ahead:] - total[:-ahead])[: len(line)] / ahead
    return mean[:, 0], 0.5 * mean[:, 1] + np.radians(gait.pitch)


def _times(line: Array, yaw: Array, speed: float) -> Array:
    """Seconds at which each point of a line is reached; slower in turns, at the start and at the end."""
    length = np.linalg.norm(np.diff(line, axis=0), axis=1)
    turn = np.abs(np.diff(yaw))
    limit = np.minimum(speed, length * _TURN / np.maximum(turn, 1e-9))
    for one, other in ((range(len(limit)), -1), (range(len(limit) - 1, -1, -1), 1)):
        for at in one:
            before = limit[at + other] if 0 <= at + other < len(limit) else 0.0
            limit[at] = min(limit[at], np.sqrt(before**2 + 2 * _EASE * length[at]))
    return np.concatenate([[0.0], np.cumsum(length / np.maximum(limit, 1e-6))])


def _averaged(values: Array, width: float) -> Array:
    """Values, (N, D), smoothed along N with a Gaussian; the ends stay in place."""
    from scipy.ndimage import gaussian_filter1d

    # Reflected about the end points, so that these do not move.
    count = min(len(values) - 1, int(4 * width) + 1)
    before = 2 * values[0] - values[count:0:-1]
    after = 2 * values[-1] - values[-2 : -2 - count : -1]
    padded = np.concatenate([before, values, after])
    smoothed: Array = gaussian_filter1d(padded, width, axis=0, mode="nearest")
    return smoothed[count : count + len(values)]
