"""Free space: where a person can stand, and how far from walls and furniture, found with rays.

The floor is a set of places, one for each surface with headroom in each cell of a level grid, so stairs and storeys
need no special treatment. As in navigation meshes for games, a place is connected to its neighbours if the step up or
down is small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera.values import Vector
from steadylight.errors import CameraError
from steadylight.renderers.base import Geometry

Array = NDArray[np.float64]

STEP: Final = 0.25
"""Maximum height of a step that a person takes without thinking, metres."""

REACH: Final = 1.0
"""Maximum clearance that is measured, metres: farther walls do not matter."""

_CELLS: Final = 250_000
"""Approximate maximum number of cells of a grid; larger regions get larger cells."""
_FINEST, _COARSEST = 0.1, 0.25
_LAYERS: Final = 32
"""Maximum number of surfaces, one above another, that are examined in a cell."""
_SLOPE: Final = 0.7
"""Cosine of the steepest slope that people stand on: 45 degrees."""
_DIRECTIONS: Final = 16
_STOREYS: Final = 30.0
"""Metres above and below the points of a walk within which floors are searched."""
_HEADROOM: Final = 0.15
"""Free height that a person needs above the eye, metres."""


class Frame:
    """A level frame: x and y span the floor, z is up."""

    def __init__(self, up: Vector) -> None:
        """Take an axis of the world as up."""
        axis = np.asarray(up, np.float64)
        across = np.roll(axis, 1)
        self.matrix = np.stack([across, np.cross(axis, across), axis])

    def local(self, points: Any) -> Array:
        """Convert from world coordinates, (..., 3)."""
        return np.asarray(points, np.float64) @ self.matrix.T

    def world(self, points: Any) -> Array:
        """Convert to world coordinates, (..., 3)."""
        return np.asarray(points, np.float64) @ self.matrix


@dataclass(frozen=True)
class Body:
    """Size of the person who walks.

    Attributes:
        eye: height of the eyes above the floor, metres.
        radius: minimum distance from the middle of the body to walls and furniture, metres.
    """

    eye: float = 1.6
    radius: float = 0.25

    @property
    def heights(self) -> Array:
        """Heights above the floor at which walls and furniture are searched: above what one steps over."""
        return np.linspace(STEP + 0.05, self.eye, 6)


class Floor:
    """Places where a person can stand, in a level frame.

    Attributes:
        frame: the level frame.
        body: the person.
        cell: edge of a cell, metres.
        places: (P, 3) centre of each place, on the floor.
        roofed: (P,) whether there is something overhead.
    """

    def __init__(self, geometry: Geometry, frame: Frame, body: Body, region: Array, near: Array) -> None:
        """Find the floor.

        Args:
            geometry: the surfaces.
            frame: the level frame.
            body: the person.
            region: (2, 3) lowest and highest corner of the region to search, in the level frame.
            near: (N, 3) points; only floor that can be reached in steps from one of them is kept. If there is no floor
                at any of them, all floor is kept.

        Raises:
            CameraError: there is nowhere to stand.
        """
        self._geometry, self.frame, self.body = geometry, frame, body
        size = np.maximum(region[1] - region[0], 1e-3)
        self.cell = float(max(_FINEST, np.sqrt(size[0] * size[1] / _CELLS)))
        if self.cell > _COARSEST:
            raise CameraError(
                f"the scene is too large to look for a way in all of it ({size[0]:.0f} x {size[1]:.0f} m); give points "
                "that are nearer to each other, or check its units"
            )
        self._corner = region[0, :2]
        self._shape = tuple(int(count) for count in np.ceil(size[:2] / self.cell).astype(int))
        cells, heights, self.roofed = self._surfaces(region)
        if not len(cells):
            raise CameraError(
                "there is no floor with enough room above it; check the eye height, up and the units"
            )
        self._cells = cells
        self.places = np.column_stack([self._middle(cells), heights])
        label = parts(self.graph())
        joined = np.unique(np.concatenate([np.zeros(0, int), *(label[self._under(point)] for point in near)]))
        kept = np.isin(label, joined) if len(joined) else np.ones(len(cells), bool)
        self._cells, self.places, self.roofed = cells[kept], self.places[kept], self.roofed[kept]
        del self.links  # of all places

    def _middle(self, cells: NDArray[np.int64]) -> Array:
        return self._corner + (cells + 0.5) * self.cell

    def _surfaces(self, region: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
        """Cell and height of every level surface with headroom, and whether it is roofed."""
        cells = np.stack(np.meshgrid(*map(np.arange, self._shape), indexing="ij"), axis=-1).reshape(-1, 2)
        top = region[1, 2] + 0.01
        start = np.full(len(cells), top)
        above = np.full(len(cells), np.inf)
        need = self.body.eye + _HEADROOM
        found: list[tuple[NDArray[np.int64], Array, NDArray[np.bool_]]] = []
        for _ in range(_LAYERS):
            origins = self.frame.world(np.column_stack([self._middle(cells), start]))
            down = np.broadcast_to(-self.frame.matrix[2], origins.shape)
            hits = self._geometry.cast(origins, down)
            z = start - hits.distance
            level = np.abs(hits.normal @ self.frame.matrix[2]) > _SLOPE
            stands = np.isfinite(hits.distance) & level & (above - z > need) & (z > region[0, 2] - 0.01)
            found.append((cells[stands], z[stands], np.isfinite(above[stands])))
            on = np.isfinite(hits.distance) & (z > region[0, 2])
            if not on.any():
                break
            cells, above = cells[on], z[on]
            start = z[on] - 1e-3
        parts = list(zip(*found, strict=True))
        return np.concatenate(parts[0]), np.concatenate(parts[1]), np.concatenate(parts[2])

    @cached_property
    def links(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Neighbouring places connected by a step: both ends, and the horizontal distance."""
        order = np.lexsort((self.places[:, 2], self._cells[:, 1], self._cells[:, 0]))
        code = self._cells[:, 0] * self._shape[1] + self._cells[:, 1]
        sorted_code = code[order]
        first, second, length = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            column = self._cells[:, 1] + dy
            wanted = (self._cells[:, 0] + dx) * self._shape[1] + column
            wanted = np.where((column >= 0) & (column < self._shape[1]), wanted, -1)
            begin, end = (np.searchsorted(sorted_code, wanted, side=side) for side in ("left", "right"))
            for layer in range(int((end - begin).max(initial=0))):
                rows = np.flatnonzero(begin + layer < end)
                other = order[begin[rows] + layer]
                near = np.abs(self.places[rows, 2] - self.places[other, 2]) <= STEP
                first.append(rows[near])
                second.append(other[near])
                length.append(np.full(near.sum(), self.cell * np.hypot(dx, dy)))
        return np.concatenate(first), np.concatenate(second), np.concatenate(length)

    def graph(self, weight: Array | None = None, kept: NDArray[np.bool_] | None = None) -> Any:
        """Lengths of the steps between places as a sparse matrix, (P, P).

        Args:
            weight: (P,) factor at each place; a length is multiplied by the mean of both ends. None for 1.
            kept: (P,) only steps between these places are in the matrix; all if None.
        """
        from scipy.sparse import coo_array

        first, second, length = self.links
        if kept is not None:
            both = kept[first] & kept[second]
            first, second, length = first[both], second[both], length[both]
        if weight is not None:
            length = length * (weight[first] + weight[second]) / 2
        count = len(self.places)
        rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
        return coo_array((np.tile(length, 2), (rows, columns)), shape=(count, count)).tocsr()

    @cached_property
    def clearance(self) -> Array:
        """Distance from each place to the nearest obstacle or edge of the floor, (P,) metres, at most REACH."""
        first, second, _ = self.links
        neighbours = np.bincount(first, minlength=len(self.places)) + np.bincount(
            second, minlength=len(self.places)
        )
        edge = np.flatnonzero(neighbours < 8)
        clearance = np.full(len(self.places), REACH)
        if len(edge):
            reached = distances(self.graph(), edge, min_only=True, limit=REACH)
            clearance = np.minimum(clearance, reached + self.cell / 2)
        free = np.flatnonzero(clearance >= self.body.radius)
        clearance[free] = np.minimum(clearance[free], self._measured(self.places[free]))
        return clearance

    def _measured(self, places: Array) -> Array:
        """Distance to the nearest hit of level rays at several heights of the body, (N,) metres, at most REACH."""
        nearest = np.full(len(places), REACH)
        for height in self.body.heights:
            origins = self.frame.world(places + np.array((0.0, 0.0, height)))
            for angle in np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS:
                direction = self.frame.world((np.cos(angle), np.sin(angle), 0.0))
                hits = self._geometry.cast(origins, np.broadcast_to(direction, origins.shape), REACH)
                nearest = np.minimum(nearest, hits.distance)
        return nearest

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Places with room for the body, (P,)."""
        return self.clearance >= self.body.radius

    def nearest(self, point: Array, reach: float = 0.75) -> int | None:
        """The nearest free place for a point on the floor, at eye height, or in between; None if there is none."""
        near = self._under(point, reach)
        near = near[self.free[near]]
        if not len(near):
            return None
        # Vertical distance counts little, because the point may be at eye height.
        offset = self.places[near] - point
        return int(near[np.argmin(np.hypot(offset[:, 0], offset[:, 1]) + 0.2 * np.abs(offset[:, 2]))])

    def _under(self, point: Array, reach: float = 1.5) -> NDArray[np.int64]:
        """Places within `reach`, horizontally, of a point on the floor, at eye height, or in between."""
        offset = self.places - point
        high = (offset[:, 2] < STEP) & (offset[:, 2] > -(self.body.eye + 0.6))
        return np.flatnonzero(high & (np.hypot(offset[:, 0], offset[:, 1]) < reach))


def distances(graph: Any, start: int | Sequence[int] | NDArray[np.int64], **options: Any) -> Any:
    """Shortest distances from one or several places to all, and the paths if requested; see SciPy's `dijkstra`."""
    from scipy.sparse import csgraph

    search: Any = csgraph.dijkstra
    return search(graph, indices=start, **options)


def parts(graph: Any) -> NDArray[np.int64]:
    """For each place, the number of the connected part of the graph that it belongs to."""
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(graph, directed=False)
    return np.asarray(label, np.int64)


def region_around(points: Array, bounds: Array, margin: float) -> Array:
    """A box around points, (2, 3) in the level frame, within the bounds of the scene.

    It extends beyond the points by `margin` to each side, and by _STOREYS up and down.
    """
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    region = np.array([np.maximum(low, bounds[0]), np.minimum(high, bounds[1])])
    height = points[:, 2].clip(*bounds[:, 2])
    region[:, 2] = np.clip((height.min() - _STOREYS, height.max() + _STOREYS), *bounds[:, 2])
    return region
