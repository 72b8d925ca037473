"""Walks: a camera path through given points, or through all rooms, of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from steadylight.camera import CameraPath
from steadylight.camera.values import Vector
from steadylight.errors import CameraError
from steadylight.renderers.base import Geometry
from steadylight.walking.motion import Gait, Route, walk_along
from steadylight.walking.route import tour, way
from steadylight.walking.space import Array, Body, Floor, Frame, region_around

_MARGINS = (6.0, 25.0)
"""Metres around the points within which a path is searched: at first, and if there is none."""
_ROOMS = 25.0
"""Metres around the start within which rooms are searched."""


@dataclass(frozen=True)
class Walker:
    """A person who walks in a scene.

    Attributes:
        geometry: surfaces of the scene.
        up: axis of the world that is up.
        body: size of the person.
        gait: how the person walks and looks.
        fov: horizontal field of view, degrees.
    """

    geometry: Geometry
    up: Vector
    body: Body = field(default_factory=Body)
    gait: Gait = field(default_factory=Gait)
    fov: float = 65.0

    def through(self, points: Sequence[Vector]) -> CameraPath:
        """A walk through points, each on the floor, at eye height, or in between.

        Raises:
            CameraError: there is no place to stand near a point, or no path between two points.
        """
        frame = Frame(self.up)
        stops = frame.local(points)
        bounds = self._bounds(frame)
        for number, point in enumerate(points, start=1):
            level = stops[number - 1, :2]
            if (level < bounds[0, :2] - 1).any() or (level > bounds[1, :2] + 1).any():
                raise CameraError(
                    f"{_named(number, point)} is outside the scene, which extends from "
                    f"{_shown(self.geometry.bounds[0])} to {_shown(self.geometry.bounds[1])}"
                )
        for margin in _MARGINS:
            try:
                return self._walk(frame, region_around(stops, bounds, margin), points)
            except CameraError:
                if margin == _MARGINS[-1]:
                    raise
        raise AssertionError

    def _walk(self, frame: Frame, region: Array, points: Sequence[Vector]) -> CameraPath:
        floor = Floor(self.geometry, frame, self.body, region, frame.local(points))
        stops, names = [], []
        for number, point in enumerate(points, start=1):
            place = floor.nearest(frame.local(point))
            if place is None:
                raise CameraError(self._nowhere(floor, number, point))
            stops.append(place)
            names.append(_named(number, point))
        return self._along(floor, stops, names)

    def rooms(self, start: Vector | None) -> CameraPath:
        """A walk that visits all rooms connected to its start.

        Args:
            start: a point on the floor, at eye height, or in between; None for the largest space around the middle of
                the scene.

        Raises:
            CameraError: there is no room, or too little space for a walk.
        """
        frame = Frame(self.up)
        bounds = self._bounds(frame)
        begin = None if start is None else frame.local(start)
        middle = bounds.mean(axis=0) if begin is None else begin
        region = region_around(middle[None], bounds, _ROOMS)
        near = np.empty((0, 3)) if begin is None else begin[None]
        floor = Floor(self.geometry, frame, self.body, region, near)
        stops = tour(floor, begin)
        if len(stops) == 1:
            raise CameraError("there is too little room for a walk; give points with --through")
        names = [f"place {number}" for number in range(1, len(stops) + 1)]
        return self._along(floor, stops, names, 1.0)

    def _along(
        self, floor: Floor, stops: Sequence[int], names: Sequence[str], leeway: float = 0.3
    ) -> CameraPath:
        """The walk from stop to stop, which passes each within `leeway` metres."""
        route, at = way(floor, stops, names)
        if np.linalg.norm(np.diff(route, axis=0), axis=1).sum() < 0.5:
            raise CameraError("the points are less than half a metre apart; a walk needs more")
        return walk_along(floor, Route(route, at, leeway), self.gait, self.fov)

    def _bounds(self, frame: Frame) -> Array:
        corners = frame.local(self.geometry.bounds)
        bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
        if not np.isfinite(bounds).all():
            raise CameraError("the scene has no surfaces to walk on")
        return bounds

    def _nowhere(self, floor: Floor, number: int, point: Vector) -> str:
        """Message about a point without a place to stand; names the nearest one."""
        free = floor.places[floor.free]
        said = f"{_named(number, point)}: there is no place to stand within 0.75 m"
        if not len(free):
            return f"{said}, nor anywhere near; see --clearance and --eye"
        nearest = free[np.linalg.norm(free - floor.frame.local(point), axis=1).argmin()]
        return f"{said}; the nearest is at {_shown(floor.frame.world(nearest))}"


def _named(number: int, point: Vector) -> str:
    return f"point {number} ({_shown(point)})"


def _shown(point: Sequence[float] | Array) -> str:
    return ",".join(f"{value:.4g}" for value in np.asarray(point) + 0.0)
