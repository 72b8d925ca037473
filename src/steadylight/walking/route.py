"""Routes: the shortest path between places that keeps away from walls, and tours through all rooms."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import CameraError
from steadylight.walking.space import Array, Floor, distances, parts

COMFORT: Final = 0.7
"""Distance to walls and furniture that people keep where they can, metres."""

_DOOR: Final = 0.55
"""Half the width of a wide door, metres: spaces connected only by narrower gaps are separate rooms."""
_SMALLEST_ROOM: Final = 1.5
"""Minimum floor area of a room, square metres."""
_SPACING: Final = 3.5
"""Metres between the points that a tour visits in one room."""
_MOST_POINTS: Final = 24


def way(floor: Floor, stops: Sequence[int], names: Sequence[str]) -> tuple[Array, NDArray[np.int64]]:
    """The path from stop to stop.

    Args:
        floor: where a person can walk.
        stops: indices of places.
        names: names of the stops, for messages.

    Returns:
        Points on the floor, (N, 3) in the level frame, and the indices of the stops among them.

    Raises:
        CameraError: two stops are not connected.
    """
    graph = floor.graph(_discomfort(floor), floor.free)
    points: list[int] = [stops[0]]
    at = [0]
    for number, (start, end) in enumerate(pairwise(stops)):
        _, before = distances(graph, start, return_predecessors=True)
        leg = [end]
        while leg[-1] != start:
            previous = int(before[leg[-1]])
            if previous < 0:
                raise CameraError(_no_way(floor, names[number], names[number + 1], (start, end)))
            leg.append(previous)
        points += leg[-2::-1]
        at.append(len(points) - 1)
    return floor.places[points], np.array(at)


def tour(floor: Floor, start: Array | None) -> list[int]:
    """Places to visit, in order, in the rooms that are connected to the start; see `_points_to_see`.

    Args:
        floor: where a person can walk.
        start: a point in the level frame, on the floor or above it. The tour begins at the nearest place to visit. If
            None, or if there is no suitable floor near it, the tour covers the largest connected space.

    Raises:
        CameraError: there is no room.
    """
    indoors = floor.free & floor.roofed if (floor.free & floor.roofed).any() else floor.free
    label = parts(floor.graph(kept=indoors))
    first = None if start is None else floor.nearest(start, 1.5)
    if first is None or not indoors[first]:
        sizes = np.bincount(label[indoors], minlength=1) if indoors.any() else np.zeros(1)
        if not sizes.any():
            raise CameraError("there is no room to walk in; give points with --through")
        first = int(np.flatnonzero(indoors & (label == sizes.argmax()))[0])
    here = indoors & (label == label[first])
    points = _points_to_see(floor, here)
    if not points:
        raise CameraError("there is no room to walk in; give points with --through")
    graph = floor.graph(_discomfort(floor), here)
    distance = distances(graph, points)[:, points]
    begin = int(distances(graph, first)[points].argmin())
    return [points[number] for number in _short_order(distance, begin)]


def _points_to_see(floor: Floor, here: NDArray[np.bool_]) -> list[int]:
    """Points to visit in rooms of at least _SMALLEST_ROOM; at most _MOST_POINTS.

    The first point of a room is a wide place near its middle. Others are added until no place away from the walls is
    farther than _SPACING from all of them. If that gives only one point in total, the two ends of the space replace it.
    """
    wide = here & (floor.clearance >= _DOOR)
    if wide.sum() * floor.cell**2 < _SMALLEST_ROOM:
        wide = here
    room = parts(floor.graph(kept=wide))
    sizes = np.bincount(room[wide], minlength=1)
    chosen: list[tuple[float, int]] = []
    for number in np.argsort(-sizes, kind="stable"):
        if sizes[number] * floor.cell**2 < _SMALLEST_ROOM:
            break
        inside = wide & (room == number)
        members = np.flatnonzero(inside)
        graph = floor.graph(kept=inside)
        middle = floor.places[members].mean(axis=0)
        off = np.linalg.norm(floor.places[members] - middle, axis=1)
        point = int(members[np.argmin(off - 2 * floor.clearance[members])])
        away = distances(graph, point)
        chosen.append((np.inf, point))
        # Only places away from the walls: nobody walks into a corner.
        airy = members[floor.clearance[members] >= 0.9 * floor.clearance[members].max()]
        while True:
            farthest = int(airy[np.argmax(away[airy])])
            if not away[farthest] > _SPACING:
                break
            chosen.append((float(away[farthest]), farthest))
            away = np.minimum(away, distances(graph, farthest))
    if len(chosen) == 1:
        return _ends(floor, here)
    chosen.sort(key=lambda each: -each[0])
    return [point for _, point in chosen[:_MOST_POINTS]]


def _ends(floor: Floor, here: NDArray[np.bool_]) -> list[int]:
    """The two places that are farthest from each other, away from walls."""
    members = np.flatnonzero(here & (floor.clearance >= 0.9 * floor.clearance[here].max()))
    graph = floor.graph(kept=here)
    start = members[0]
    for _ in range(2):
        away = distances(graph, start)[members]
        end, start = start, members[np.where(np.isfinite(away), away, -1).argmax()]
    return [int(end), int(start)]


def _short_order(distance: Array, begin: int) -> list[int]:
    """A short open tour: always to the nearest remaining place, then improved by reversing stretches (2-opt)."""
    order = [begin]
    left = {number for number in range(len(distance)) if np.isfinite(distance[begin, number])} - {begin}
    while left:
        order.append(min(left, key=lambda number: (distance[order[-1], number], number)))
        left.remove(order[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                old = distance[order[i - 1], order[i]]
                new = distance[order[i - 1], order[j]]
                if j + 1 < len(order):
                    old = old + distance[order[j], order[j + 1]]
                    new = new + distance[order[i], order[j + 1]]
                if new < old - 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    better = True
    return order


def _discomfort(floor: Floor) -> Array:
    """Factor on the length of steps at each place, (P,): 1, or more where walls and furniture are near."""
    return 1 + 6 * np.clip(1 - floor.clearance / COMFORT, 0, 1) ** 2


def _no_way(floor: Floor, start: str, end: str, stops: tuple[int, int]) -> str:
    label = parts(floor.graph(kept=floor.free))
    areas = [(label[floor.free] == label[stop]).sum() * floor.cell**2 for stop in stops]
    return (
        f"there is no way from {start} ({areas[0]:.1f} m² to walk in) to {end} ({areas[1]:.1f} m²): a door is closed, "
        f"a step is higher than 25 cm, or a gap is narrower than {2 * floor.body.radius:g} m; see --clearance"
    )
