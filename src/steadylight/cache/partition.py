"""The cache in parts: boxes of space that are merged, filled and smoothed independently.

The boxes, and which of them each window of frames sees, are fixed before the run by a survey of the animation
(`renderers/mitsuba/survey.py`). A task reads only the parts that the plan assigns to it. It may start as soon as these
are final, and its output does not depend on when it starts.

No record has a longer radius than `Partition.radius`. A window therefore reads the parts within this distance of the
surfaces that it sees. The records of a part are merged with those within MERGED times this distance, and smoothed with
those within MARGIN times it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from steadylight.cache.merge import canonical_order, redundant
from steadylight.cache.octree import Cube
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import STRETCH, Smoothing, smooth

MARGIN = 2 * STRETCH
"""Distance around a part from which records are read, as a multiple of the longest radius. Smoothing needs the largest
distance, since it depends on neighbours of neighbours."""

MERGED = 2.0
"""Distance around a part, as a multiple of the longest radius, in which merging looks for records that may replace its
own."""

CENTRAL = (0.05, 0.95)
"""Quantiles along each axis between which most of what the animation sees lies: a view to the horizon must not make a
room as large as the landscape."""

SLACK, PLACES = 0.2, 64
"""Largest deviation of the fraction of points below a plane from the target, and number of planes that are tried along
each axis."""

SEEN_TWICE = 0.25
"""Cost of a plane of which all windows see both sides. It equals that of a plane which leaves this fraction of the
points on the wrong side."""


@dataclass(frozen=True)
class Partition:
    """Boxes that fill space, and which of them the animation sees when.

    Attributes:
        splits: axis and coordinate (metres) of each plane, depth first: of n parts, the first n // 2 lie below it.
        radius: longest radius of any record, metres.
        cube: root of the octrees; None to fit it to the records. With several parts it is fixed, so that the result of
            a look-up does not depend on what else is loaded.
        windows: for each window of frames, in order, the parts that it sees: those within `radius` of a surface that it
            looks up; ascending.
    """

    splits: tuple[tuple[int, float], ...]
    radius: float
    cube: Cube | None
    windows: tuple[tuple[int, ...], ...]

    @classmethod
    def whole(cls, windows: int) -> Self:
        """One part, which every window sees: the cache without a survey."""
        return cls((), np.inf, None, ((0,),) * windows)

    @property
    def count(self) -> int:
        """Number of parts."""
        return len(self.splits) + 1

    @cached_property
    def boxes(self) -> NDArray[np.float64]:
        """(parts, 2, 3) lower and upper corners, metres; infinite where no other part lies beyond."""
        boxes: list[NDArray[np.float64]] = []
        splits = iter(self.splits)

        def divide(box: NDArray[np.float64], count: int) -> None:
            if count == 1:
                boxes.append(box)
                return
            axis, value = next(splits)
            below, above = box.copy(), box.copy()
            below[1, axis] = above[0, axis] = value
            divide(below, count // 2)
            divide(above, count - count // 2)

        divide(np.array([[-np.inf] * 3, [np.inf] * 3]), self.count)
        return np.array(boxes)

    def part_of(self, position: Floats) -> NDArray[np.intp]:
        """(P,) the part in which each of (P, 3) positions lies; there is always exactly one."""
        part = np.zeros(len(position), np.intp)
        splits, numbers = iter(self.splits), itertools.count()

        def descend(rows: NDArray[np.intp], count: int) -> None:
            if count == 1:
                part[rows] = next(numbers)
                return
            axis, value = next(splits)
            above = position[rows, axis] >= np.float64(value)
            descend(rows[~above], count // 2)
            descend(rows[above], count - count // 2)

        descend(np.arange(len(position)), self.count)
        return part

    def owner_of(self, position: Floats, seen: Sequence[int]) -> NDArray[np.intp]:
        """(P,) the part that must cover each of (P, 3) points of a window, which reads the parts `seen`.

        This is the part in which the point lies. If the window does not read that part, because the survey did not
        foresee the point, it is the nearest of the parts that the window reads.
        """
        part = self.part_of(position)
        strays = np.flatnonzero(~np.isin(part, seen))
        if len(strays) and len(seen):
            distance = np.stack([_distance(self.boxes[number], position[strays]) for number in seen])
            part[strays] = np.asarray(seen)[distance.argmin(axis=0)]
        return part

    def seen_from(self, position: Floats) -> tuple[int, ...]:
        """Parts within the radius of any of (P, 3) positions; ascending."""
        found: list[int] = []
        splits, numbers = iter(self.splits), itertools.count()

        def descend(position: Floats, count: int) -> None:
            # Few positions are near any one box: at each plane, drop those beyond the radius on the other side.
            if count == 1:
                number = next(numbers)
                if (_distance(self.boxes[number], position) <= self.radius).any():
                    found.append(number)
                return
            axis, value = next(splits)
            above = position[:, axis].astype(np.float64) - value
            descend(position[above <= self.radius], count // 2)
            descend(position[-above <= self.radius], count - count // 2)

        descend(position, self.count)
        return tuple(found)

    def around(self, parts: Iterable[int]) -> list[int]:
        """Some parts, and the neighbours whose records are needed to merge and smooth them; ascending."""
        near: set[int] = set()
        for number in parts:
            near.update(np.flatnonzero(self._near[number]).tolist())
        return sorted(near)

    @cached_property
    def _near(self) -> NDArray[np.bool_]:
        """(parts, parts) whether boxes, clipped to the root cube, are at most MARGIN times the radius apart."""
        if self.cube is None:
            return np.ones((1, 1), bool)
        low = np.array(self.cube.origin)
        boxes = np.clip(self.boxes, low, low + self.cube.size)
        gap = np.maximum(boxes[:, None, 0] - boxes[None, :, 1], boxes[None, :, 0] - boxes[:, None, 1])
        near: NDArray[np.bool_] = (np.maximum(gap, 0) ** 2).sum(axis=2) <= (MARGIN * self.radius) ** 2
        return near

    def plain(self) -> dict[str, Any]:
        """As plain data, for `run.json`."""
        assert self.cube is not None, "one part needs no record"
        cube = {"origin": list(self.cube.origin), "size": self.cube.size}
        splits, windows = ([list(each) for each in group] for group in (self.splits, self.windows))
        return {"splits": splits, "radius": self.radius, "cube": cube, "windows": windows}

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> Self:
        """Inverse of `plain`."""
        splits = tuple((int(axis), float(value)) for axis, value in data["splits"])
        x, y, z = map(float, data["cube"]["origin"])
        windows = tuple(tuple(map(int, window)) for window in data["windows"])
        return cls(splits, float(data["radius"]), Cube((x, y, z), float(data["cube"]["size"])), windows)


def _distance(box: NDArray[np.float64], position: Floats) -> NDArray[np.float64]:
    """(P,) distance of (P, 3) positions from a box, metres; zero within."""
    outside = np.maximum(np.maximum(box[0] - position, position - box[1]), 0)
    distance: NDArray[np.float64] = np.sqrt((outside**2).sum(axis=1))
    return distance


def central_box(position: Floats) -> NDArray[np.float64]:
    """(2, 3) corners of the box, along the axes, that holds most of (P, 3) positions; zeros if there are none."""
    if len(position) == 0:
        return np.zeros((2, 3))
    return np.quantile(position, CENTRAL, axis=0).astype(np.float64)


def divide_space(
    seen: Sequence[Floats],
    count: int,
    radius: float,
    bounds: NDArray[np.float64],
    crowd: Floats | None = None,
) -> Partition:
    """Divide space into boxes with about the same amount of work each.

    Args:
        seen: surface points that each window of frames looks up, (P, 3) each, metres.
        count: number of parts.
        radius: longest radius of any record, metres.
        bounds: (2, 3) corners of a box that contains all surfaces, metres.
        crowd: (C, 3) points that each stand for about the same number of records; all of `seen` if None.
    """
    points = np.concatenate([np.zeros((0, 3), np.float32), *seen])
    splits: list[tuple[int, float]] = []

    def divide(box: NDArray[np.float64], crowd: Floats, windows: Sequence[Floats], parts: int) -> None:
        if parts == 1:
            return
        below = parts // 2
        axis, value = _plane(crowd, windows, below / parts, radius)
        value = float(np.clip(value, *box[:, axis]))
        splits.append((axis, value))
        for corner, side, number in ((1, np.less, below), (0, np.greater_equal, parts - below)):
            half = box.copy()
            half[corner, axis] = value
            there = [window[side(window[:, axis], value)] for window in windows]
            divide(half, crowd[side(crowd[:, axis], value)], there, number)

    divide(np.array([[-np.inf] * 3, [np.inf] * 3]), points if crowd is None else crowd, seen, count)
    unseen = Partition(tuple(splits), radius, _root(points, radius, bounds), ())
    return replace(unseen, windows=tuple(unseen.seen_from(window) for window in seen))


def _plane(crowd: Floats, windows: Sequence[Floats], share: float, radius: float) -> tuple[int, float]:
    """Axis and coordinate of a plane with about this share of (C, 3) points below it.

    The plane should have few points close to it, and few windows that see both of its sides. A plane within a wall
    would leave all of the wall on one side or divide it by rounding errors, and planes across the shortest axis would
    make slabs that all frames see.
    """
    if len(crowd) == 0:
        return 0, 0.0
    ends = np.array(
        [[window.min(axis=0) - radius, window.max(axis=0) + radius] for window in windows if len(window)]
    )
    beside = float(np.diff(central_box(crowd), axis=0).max()) / (2 * PLACES)
    best = (np.inf, 0, 0.0)
    for axis in range(3):
        coordinate = np.sort(crowd[:, axis].astype(np.float64))
        low, high = np.quantile(coordinate, [max(share - SLACK, 0), min(share + SLACK, 1)])
        values = np.linspace(low, high, PLACES)
        below, first, last = (np.searchsorted(coordinate, values + by) for by in (0, -beside, beside))
        cost = (np.abs(below - share * len(crowd)) + last - first) / len(crowd)
        if len(ends):
            first, last = ends[:, :, axis, None].swapaxes(0, 1)
            cost += SEEN_TWICE * ((first < values) & (values <= last)).mean(axis=0)
        k = int(cost.argmin())
        best = min(best, (float(cost[k]), axis, float(values[k])))
    return best[1], best[2]


def _root(points: Floats, radius: float, bounds: NDArray[np.float64]) -> Cube:
    """A cube around all that may be seen: of a wide landscape, only what lies near the points of the survey."""
    low, high = bounds
    if len(points):
        first, last = (np.asarray(corner, np.float64) for corner in (points.min(axis=0), points.max(axis=0)))
        beyond = (last - first).max() + MARGIN * radius
        low, high = np.maximum(low, first - beyond), np.minimum(high, last + beyond)
    low, high = low - MARGIN * radius, high + MARGIN * radius
    x, y, z = map(float, low)
    return Cube((x, y, z), float((high - low).max()))


def merge_part(caches: Sequence[Records], partition: Partition, part: int) -> Records:
    """The records of a part that `merge_caches` would keep.

    Whether a record is kept depends on kept records of smaller radius near it, which in turn depend on others. To come
    from beyond the margin that is searched here, such a chain would need six links of the longest radius, all in one
    direction (MERGED / REDUNDANT). It is cut off at the margin.

    Args:
        caches: to be merged.
        partition: of space.
        part: its number.

    Returns:
        Kept records that lie in the part, in Morton order.
    """
    margin = MERGED * partition.radius
    low, high = partition.boxes[part] + [[-margin], [margin]]
    near = [cache.take(((cache.position >= low) & (cache.position <= high)).all(axis=1)) for cache in caches]
    records = Records.concatenate(*near)
    records = records.take(canonical_order(records))
    return records.take((partition.part_of(records.position) == part) & ~redundant(records))


def smooth_part(
    own: Records, around: Sequence[Records], longest: float, smoothing: Smoothing | None = None
) -> Records:
    """The records of a part, smoothed with those of its neighbours as they are in the whole cache.

    Args:
        own: of the part, in Morton order.
        around: of its neighbours.
        longest: radius of any record, metres: `Partition.radius`. Infinite for a single part.
        smoothing: see `smooth`.
    """
    records = Records.concatenate(own, *around)
    order = canonical_order(records)
    return smooth(records.take(order), np.flatnonzero(order < len(own)), smoothing, longest)


def concatenate_parts(parts: Sequence[Records]) -> Records:
    """One cache of all parts, in Morton order: the same bytes as `merge_caches`."""
    records = Records.concatenate(*parts)
    return records.take(canonical_order(records))
