"""Stone buildings: solids made of added and carved boxes, and the blocks and slabs on their faces.

A building is a sequence of axis-aligned boxes, added to or carved out of space. Its boundary is one closed
mesh, so that walls are light-tight however the boxes meet; the visible stones are thin skins in front of it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.modelling import Floats, Mesh, frustums, join

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

_BURIED = 0.006  # metres by which a stone's rim lies behind the wall plane, so that no gap can open


@dataclass(frozen=True)
class Face:
    """An axis-aligned rectangle on the boundary of a building.

    Attributes:
        axis: 0, 1 or 2: the axis that is normal to it.
        sign: +1 or -1: the side that is open.
        plane: coordinate along the axis, metres.
        lower: smaller coordinates along the other two axes, in the order x, y, z.
        upper: larger coordinates, in the same order.
    """

    axis: int
    sign: int
    plane: float
    lower: tuple[float, float]
    upper: tuple[float, float]

    @property
    def centre(self) -> Floats:
        """(3,) centre of the rectangle, world."""
        middle = np.add(self.lower, self.upper) / 2
        return np.insert(middle, self.axis, self.plane)

    def points(self, u: Floats, v: Floats, height: Floats) -> Floats:
        """World positions (..., 3) at in-plane coordinates and a height above the plane, on the open side."""
        across = self.plane + self.sign * height
        parts = [u, v]
        parts.insert(self.axis, across)
        return np.stack(np.broadcast_arrays(*parts), axis=-1)

    @property
    def flipped(self) -> bool:
        """Whether (u, v, outward) is left-handed."""
        return (self.sign < 0) != (self.axis == 1)


@dataclass
class Masonry:
    """A building of boxes: each `add` fills its box, each `carve` empties it, in the order of the calls."""

    _boxes: list[tuple[Floats, Floats, bool]] = field(default_factory=list)

    def add(self, lower: ArrayLike, upper: ArrayLike) -> None:
        """Fill a box."""
        self._boxes.append((np.asarray(lower, float), np.asarray(upper, float), True))

    def carve(self, lower: ArrayLike, upper: ArrayLike) -> None:
        """Empty a box."""
        self._boxes.append((np.asarray(lower, float), np.asarray(upper, float), False))

    def faces(self) -> list[Face]:
        """The boundary as rectangles, widest first along x or y, so that courses of stones are continuous."""
        ticks = [
            np.unique(np.round([corner[k] for low, high, _ in self._boxes for corner in (low, high)], 9))
            for k in range(3)
        ]
        solid = np.zeros([len(t) + 1 for t in ticks], dtype=bool)  # surrounded by one empty cell
        for low, high, filled in self._boxes:
            span = [
                slice(*(np.searchsorted(t, np.round((a, b), 9)) + 1))
                for t, a, b in zip(ticks, low, high, strict=True)
            ]
            solid[tuple(span)] = filled
        return [face for axis in range(3) for face in _boundary(solid, ticks, axis)]


def _boundary(solid: NDArray[np.bool_], ticks: list[Floats], axis: int) -> Iterator[Face]:
    """Rectangles between filled and empty cells along one axis."""
    cells = np.moveaxis(solid, axis, 0)
    u, v = (ticks[k] for k in range(3) if k != axis)
    for k, plane in enumerate(ticks[axis]):
        for sign in (1, -1):
            below, above = cells[k][1:-1, 1:-1], cells[k + 1][1:-1, 1:-1]
            open_side = below & ~above if sign > 0 else above & ~below
            for i0, i1, j0, j1 in _rectangles(open_side):
                yield Face(axis, sign, float(plane), (u[i0], v[j0]), (u[i1], v[j1]))


def _rectangles(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Cover a mask by disjoint rectangles (i0, i1, j0, j1): runs along i, then merged along j."""
    left = mask.copy()
    for j in range(mask.shape[1]):
        while left[:, j].any():
            i0 = int(np.argmax(left[:, j]))
            stop = np.flatnonzero(~left[i0:, j])
            i1 = i0 + int(stop[0]) if stop.size else mask.shape[0]
            j1 = j + 1
            while j1 < mask.shape[1] and left[i0:i1, j1].all() and not _continues(left[:, j1], i0, i1):
                j1 += 1
            left[i0:i1, j:j1] = False
            yield i0, i1, j, j1


def _continues(row: NDArray[np.bool_], i0: int, i1: int) -> bool:
    """Whether the run [i0, i1) of a row is part of a longer one."""
    return bool((i0 > 0 and row[i0 - 1]) or (i1 < len(row) and row[i1]))


def core(faces: list[Face]) -> Mesh:
    """The closed boundary itself, two triangles for each rectangle."""
    corners = np.array([_quad(f, (*f.lower, *f.upper), np.zeros(4)) for f in faces])
    index = 4 * np.arange(len(faces))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(corners.reshape(-1, 3), index.reshape(-1, 3))


@dataclass(frozen=True)
class Bond:
    """Stone layout of a face.

    Attributes:
        course: height of a course, metres (on floors and ceilings: its extent along y).
        length: mean length of a stone, metres.
        bevel: width of the bevelled rim, metres.
        depth: minimum and maximum height of a stone's front above the plane, metres.
        tilt: maximum height deviation of a stone's corner, metres.
    """

    course: float = 0.52
    length: float = 1.15
    bevel: float = 0.012
    depth: tuple[float, float] = (0.012, 0.022)
    tilt: float = 0.0


def stones(face: Face, bond: Bond, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The stones of a face as low bevelled blocks; joints are at world heights, so that adjoining walls match.

    Returns:
        (N, 4, 3) rims of the stones, just behind the plane, and (N, 4, 3) fronts.
    """
    (u0, v0), (u1, v1) = face.lower, face.upper
    rows = _cuts(v0, v1, bond.course, 0.0)
    cells = []
    for low, high in itertools.pairwise(rows):
        joints = _cuts(u0, u1, bond.length, float(rng.uniform(0.0, bond.length)), rng)
        cells += [(a, low, b, high) for a, b in itertools.pairwise(joints)]
    rim = np.array([_quad(face, cell, np.full(4, -_BURIED)) for cell in cells])
    inset = bond.bevel * np.array([1.0, 1.0, -1.0, -1.0])
    depth = rng.uniform(*bond.depth, (len(cells), 1)) + rng.uniform(-bond.tilt, bond.tilt, (len(cells), 4))
    front = np.array([_quad(face, np.add(cell, inset), d) for cell, d in zip(cells, depth, strict=True)])
    return rim, front


def masonry_skin(faces: list[Face], bond: Bond, hues: int, rng: np.random.Generator) -> list[Mesh]:
    """The stones of many faces, distributed at random over `hues` meshes, which may get different materials.

    A face too small for a stone shows the plain core.
    """
    wide = [face for face in faces if min(np.subtract(face.upper, face.lower)) > 6 * bond.bevel]
    laid = [stones(face, bond, rng) for face in wide]
    if not laid:
        return [join([])] * hues
    rims, fronts = (np.concatenate(part) for part in zip(*laid, strict=True))
    hue = rng.integers(0, hues, len(rims))
    return [frustums(rims[hue == k], fronts[hue == k]) for k in range(hues)]


def _quad(face: Face, rectangle: ArrayLike, height: Floats) -> Floats:
    """(4, 3) corners of a rectangle on a face, counter-clockwise seen from the open side."""
    u0, v0, u1, v1 = np.asarray(rectangle, dtype=np.float64)
    u, v = np.array([u0, u1, u1, u0]), np.array([v0, v0, v1, v1])
    corners = face.points(u, v, height)
    return corners[::-1] if face.flipped else corners


def _cuts(
    start: float, stop: float, step: float, phase: float, rng: np.random.Generator | None = None
) -> list[float]:
    """Joints between two ends: multiples of a step (shifted, jittered), at least 0.4 steps from the ends."""
    joints = np.arange(np.floor(start / step) - 1, np.ceil(stop / step) + 1) * step + phase
    if rng is not None:
        joints = joints + rng.uniform(-0.22, 0.22, len(joints)) * step
    inner = joints[(joints > start + 0.4 * step) & (joints < stop - 0.4 * step)]
    return [start, *inner.tolist(), stop]
