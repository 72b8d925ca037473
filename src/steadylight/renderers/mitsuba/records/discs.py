"""Discs around surface points, and which part of each is surface that the point sees.

The density of photons on a disc is their power over the area on which they may lie. At an edge, part of a disc is not
there; at a wall, part of it may lie behind, in the dark or in another room.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.records.origins import off_surface
from steadylight.renderers.mitsuba.upload import upload

Rows = NDArray[np.intp]

ALIKE = 0.8
"""Minimum cosine between the normals of a record and of surfaces on which its photons lie."""

FLAT = 0.1
"""Maximum distance of its photons from a record's plane, as a part of the radius of the disc; at most half the height
that is free above the record, so that what lies on a rug does not count for the floor."""

CELLS = 32
"""Cells of a disc, of equal weight. At a wall, half of a disc may lie behind it, in the dark or in another room: cells
that the record does not see have no photons. At an edge, half of it is not there: the part of the cells that the record
sees and that are surface is what its photons are divided by."""

BROAD = 0.2
"""That part below which a disc is too wide for its surface, such as a bar of a window. Then it becomes half as wide, as
long as it holds FEWEST photons."""

HALVINGS = 4
"""Times that a disc may become half as wide."""

PARTIAL = 0.5
"""Part of a disc that is surface, below which it is measured by FINER times as many rays: photons are divided by it, so
its noise makes them too bright."""

FINER = 4
"""See `PARTIAL`."""


class Discs(NamedTuple):
    """Discs around surface points.

    Attributes:
        radius: (R,) metres.
        height: (R,) maximum distance of photons from the plane, metres.
        hidden: (R, CELLS) cells that the point does not see.
        covered: (R,) part of the cells that it sees and that are surface; above 0.
    """

    radius: Floats
    height: Floats
    hidden: NDArray[np.bool_]
    covered: Floats

    def take(self, rows: slice | Rows) -> Discs:
        """The discs in some rows."""
        return Discs(*(array[rows] for array in self))

    def hide(self, normal: Floats, rows: Rows, offset: Floats) -> NDArray[np.bool_]:
        """(P,) whether places on the discs lie in cells that are hidden.

        Args:
            normal: (R, 3) of the discs, unit.
            rows: (P,) the disc of each place.
            offset: (P, 3) from its middle, metres.
        """
        across = [np.einsum("pi,pi->p", offset, axis[rows]) / self.radius[rows] for axis in _axes(normal)]
        centres = _spiral(0.5)
        nearest = np.stack(across, axis=1) @ centres.T - np.square(centres).sum(axis=1) / 2
        return np.asarray(self.hidden[rows, nearest.argmax(axis=1)])


def measured(scene: mi.Scene, position: Floats, normal: Floats, radius: Floats, least: Floats) -> Discs:
    """Discs around R surface points, narrowed where the surface is much narrower.

    Args:
        scene: mi.Scene.
        position: (R, 3) world, metres.
        normal: (R, 3) unit.
        radius: (R,) of the discs, metres.
        least: (R,) radius below which none is narrowed, metres.
    """
    count = len(radius)
    discs = Discs(
        radius.copy(), FLAT * radius, np.zeros((count, CELLS), np.bool_), np.ones(count, np.float32)
    )
    rows, free = _not_one(np.arange(count)), np.zeros_like(radius)
    if len(rows):
        free[rows] = _free_height(scene, position[rows], normal[rows], discs.height[rows])
    for halving in range(HALVINGS + 1):
        if len(rows) == 0:
            break
        if halving:
            discs.radius[rows] = np.maximum(discs.radius[rows] / 2, least[rows])
        discs.height[rows] = np.minimum(FLAT * discs.radius[rows], free[rows] / 2)
        cells = _cells(scene, position[rows], normal[rows], discs.take(rows), 0.5)
        discs.hidden[rows], discs.covered[rows] = cells
        rows = _not_one(rows[(discs.covered[rows] < BROAD) & (discs.radius[rows] > least[rows])])
    rows = _not_one(np.flatnonzero(discs.covered < PARTIAL))
    if len(rows):
        turns = (np.arange(FINER) + 0.5) / FINER
        some = discs.take(rows)
        parts = [_cells(scene, position[rows], normal[rows], some, turn)[1] for turn in turns]
        discs.covered[rows] = np.maximum(np.mean(parts, axis=0), 1 / (FINER * CELLS))
    return discs


def _not_one(rows: Rows) -> Rows:
    """The rows; a single one twice, since Dr.Jit compiles other kernels for arrays of one element."""
    return np.repeat(rows, 2) if len(rows) == 1 else rows


def _free_height(scene: mi.Scene, position: Floats, normal: Floats, most: Floats) -> Floats:
    """(R,) height above each point that is free, metres; twice `most` where it is more."""
    p, n = upload(mi.Point3f, position), upload(mi.Normal3f, normal)
    ray = mi.Ray3f(off_surface(scene, p, n), mi.Vector3f(n))
    ray.maxt = 2 * upload(mi.Float, most)
    above = scene.ray_intersect_preliminary(ray, coherent=False)
    return np.array(dr.select(above.is_valid(), above.t, ray.maxt))


def _cells(
    scene: mi.Scene, position: Floats, normal: Floats, discs: Discs, turn: float
) -> tuple[NDArray[np.bool_], Floats]:
    """`hidden` and `covered` of discs of these radii and heights, by other rays for each `turn`; see `_spiral`."""
    lane = dr.arange(mi.UInt32, CELLS * len(position))
    disc = lane // CELLS
    radius, height = (dr.gather(mi.Float, upload(mi.Float, each), disc) for each in discs[:2])
    p = dr.gather(mi.Point3f, upload(mi.Point3f, position), disc)
    n = dr.gather(mi.Normal3f, upload(mi.Normal3f, normal), disc)
    s, t = (dr.gather(mi.Vector3f, upload(mi.Vector3f, axis), disc) for axis in _axes(normal))
    cell = dr.gather(mi.Point2f, upload(mi.Point2f, _spiral(turn)), lane - disc * CELLS) * radius

    # At the given height across to the cell, then down to the surface.
    start = p + n * height
    over = start + s * cell.x + t * cell.y
    across = mi.Ray3f(start, over - start)
    across.maxt = 1
    hidden = scene.ray_test(across, coherent=False)
    covered = ~hidden & surface_under(scene, over, n, height)
    dr.eval(hidden, covered)
    by_disc = [np.array(each).reshape(-1, CELLS) for each in (hidden, covered)]
    return by_disc[0], by_disc[1].mean(axis=1, dtype=np.float32)


def surface_under(
    scene: mi.Scene, over: mi.Point3f, normal: mi.Normal3f, height: mi.Float | float
) -> mi.Bool:
    """Whether there is surface under places over a disc, near its plane and with a normal like its own.

    Args:
        scene: mi.Scene.
        over: places at this height over the plane of the disc, world, metres.
        normal: of the disc, unit.
        height: maximum distance of the surface from the plane, metres.
    """
    down = mi.Ray3f(over, -mi.Vector3f(normal))
    down.maxt = 2 * height
    hit = scene.ray_intersect(down, mi.RayFlags.Minimal, coherent=False)
    return hit.is_valid() & (dr.abs(dr.dot(hit.n, normal)) > ALIKE)


def _axes(normal: Floats) -> tuple[Floats, Floats]:
    """(R, 3) axes, twice, that span the planes of these normals (Duff et al. 2017, "Building an Orthonormal Basis")."""
    x, y, z = normal.T
    sign = np.copysign(np.float32(1), z)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def _spiral(turn: float) -> Floats:
    """(CELLS, 2) points in the cells of a disc of radius 1.

    They share the weight of Epanechnikov's kernel evenly: 1 - (1 - x)² of it lies within the part x of the area.

    Args:
        turn: how far the points are moved along their spiral, 0 to 1; 0.5 for the centres of the cells.
    """
    number = np.arange(CELLS) + turn
    area = 1 - np.sqrt(1 - number / CELLS)
    angle = number * np.pi * (3 - 5**0.5)
    return (np.sqrt(area) * np.stack([np.cos(angle), np.sin(angle)])).T.astype(np.float32)
