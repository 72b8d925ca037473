"""Guides emitter sampling where gather rays end: a coarse grid of points met on random walks."""

from __future__ import annotations

from typing import NamedTuple, Self

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.light.clusters import facing_normal
from steadylight.renderers.mitsuba.light.emitters import NO_ROW, EmitterSampling, EmitterTable, Floats, Sites
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.panes import Panes
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of
from steadylight.renderers.mitsuba.upload import download

GRID_SITES = 6
"""Maximum number of points per voxel and direction from which shadow rays fill the grid."""

VOXELS = 32
"""Voxels along each edge of the grid."""

WALK_LENGTH = 3
"""Surfaces met on each random walk that fills the grid."""


class Grid(NamedTuple):
    """Emitter tables of the voxels of a grid.

    Attributes:
        lower: (3,) corner of the grid, metres.
        edge: (1,) of a voxel, metres.
        keys: (rows,) voxel and direction of each row.
        shares: (tables, rows, patches) as in `EmitterTable`: for all of the environment, and if there is one, without
            its cached part.
        emitters_only: (tables, rows) as in `EmitterTable`.
    """

    lower: NDArray[np.float64]
    edge: NDArray[np.float64]
    keys: NDArray[np.int64]
    shares: Floats
    emitters_only: NDArray[np.bool_]


class GridEmitterSampling(EmitterSampling):
    """Emitter choice with a row for each voxel and each of the six axis directions that a surface may face.

    Attributes:
        grid: the tables.
    """

    def __init__(self, scene: mi.Scene, environment: Environment, panes: Panes | None = None) -> None:
        """Divide the emitters; call `measure_at` or `go_by` next.

        Args:
            scene: mi.Scene.
            environment: of the scene, all of which is sampled.
            panes: of the scene; without solid ones if None.
        """
        super().__init__(scene, environment, panes, whole=True)
        self._wholes = [True, False] if environment.exists else [True]

    def measure_at(self, position: Floats, normal: Floats, rays: int) -> Self:
        """Measure visibility of every emitter at surface points, and choose by that.

        Args:
            position: (P, 3) points spread over the surfaces that rays will hit, metres.
            normal: (P, 3) unit normals on the lit side.
            rays: shadow rays from each of the points that fill the grid.
        """
        if len(position) == 0:
            position, normal = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
        # The central 98 % of the points: a distant horizon must not make the voxels of the room coarse.
        lower, upper = np.quantile(position, [0.01, 0.99], axis=0)
        edge = max(float((upper - lower).max()) / VOXELS, 1e-6)
        cell = np.clip(np.floor((position - lower) / edge), 0, VOXELS - 1).astype(np.int64)
        along = np.abs(normal).argmax(axis=1)
        face = 2 * along + (np.take_along_axis(normal, along[:, None], axis=1)[:, 0] < 0)
        key = ((cell[:, 2] * VOXELS + cell[:, 1]) * VOXELS + cell[:, 0]) * 6 + face
        order = np.argsort(key, kind="stable")
        keys, begin, number = np.unique(key[order], return_index=True, return_counts=True)
        chosen = np.arange(len(key)) - np.repeat(begin, number) < GRID_SITES
        rows, order = np.repeat(np.arange(len(keys)), number)[chosen], order[chosen]
        position, normal = position[order], normal[order]
        radius = np.zeros(len(position), np.float32)  # the points of a voxel are already spread
        sites = Sites(position, normal, radius)
        tables = self.measure_rows(sites, rays, rows, self._wholes)
        shares = np.stack([table.shares for table in tables])
        emitters_only = np.stack([table.emitters_only for table in tables])
        return self.go_by(Grid(lower, np.array([edge]), keys, shares, emitters_only))

    def go_by(self, grid: Grid) -> Self:
        """Choose by a grid that was measured before."""
        self.grid = grid
        self.use([EmitterTable(*table) for table in zip(grid.shares, grid.emitters_only, strict=True)])
        # Where the cached part of the environment need not be sampled, rows of the second table are used.
        self._rest = dr.opaque(mi.UInt32, len(grid.keys)) if len(grid.shares) > 1 else None
        table = np.full(6 * VOXELS**3, NO_ROW, np.uint32)
        table[grid.keys] = np.arange(len(grid.keys))
        self._rows = mi.UInt32(table)
        self._lower = mi.Point3f(grid.lower.tolist())
        self._per_metre = mi.Float(1 / float(grid.edge[0]))
        dr.make_opaque(self._lower, self._per_metre)
        return self

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        rest = [] if self._rest is None else [self._rest]
        return [*super().arrays(), self._rows, self._lower, self._per_metre, rest]

    def row_at(self, si: mi.SurfaceInteraction3f, cached: mi.Bool, active: mi.Bool) -> mi.UInt32:
        """Row for a surface point, on the side from which it was hit."""
        if not self.guided:
            return mi.UInt32(NO_ROW)
        cell = mi.Point3u(dr.clip((si.p - self._lower) * self._per_metre, 0, VOXELS - 1))
        n = si.sh_frame.n
        a = dr.abs(n)
        axis = dr.select(
            (a.x >= a.y) & (a.x >= a.z), mi.UInt32(0), dr.select(a.y >= a.z, mi.UInt32(1), mi.UInt32(2))
        )
        along = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
        back = (along < 0) ^ (si.wi.z < 0)
        face = 2 * axis + dr.select(back, mi.UInt32(1), mi.UInt32(0))
        voxel = (cell.z * VOXELS + cell.y) * VOXELS + cell.x
        row = dr.gather(mi.UInt32, self._rows, voxel * 6 + face, active)
        return row if self._rest is None else dr.select(cached & (row != NO_ROW), row + self._rest, row)


def walk(
    scene: mi.Scene, rays: mi.Ray3f, count: int, panes: Panes
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Points and facing normals met by diffuse random walks, through panes: roughly where the gather's rays will end.

    Args:
        scene: mi.Scene.
        rays: first ray of each walk.
        count: number of walks.
        panes: of the scene.

    Returns:
        (P, 3) positions, metres; (P, 3) unit normals; (P,) mask of the points on surfaces with a diffuse lobe, where
        rays may look up a cache.
    """
    ray, active = mi.Ray3f(rays.o, rays.d), dr.full(mi.Bool, True, count)
    dr.make_opaque(active)  # as at later steps, which share the kernel
    points: list[tuple[Floats, Floats, NDArray[np.bool_]]] = []
    for step in range(WALK_LENGTH):
        si = scene.ray_intersect(ray, active)
        met = []
        if panes.some:
            through = panes.transmission(si, active)
            # The opaque part of a mask scatters light too.
            scatters = active & dr.any(through != 0) & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Diffuse)
            met.append((si.p, facing_normal(si), scatters, scatters))
            si = panes.beyond(si, ray.d, through, active).si
        active &= si.is_valid()
        n = facing_normal(si)
        met.append((si.p, n, active, mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Diffuse)))
        numbers = samples_of(mi.UInt32(1), dr.arange(mi.UInt32, count), mi.UInt32(0))
        sample = numbers.at(mi.UInt32(0), dr.opaque(mi.UInt32, step)).sample_2d(Purpose.DIRECTION)
        ray = si.spawn_ray(mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(sample)))
        ray = mi.Ray3f(ray.o, ray.d)
        dr.eval(met, ray)
        for p, facing, kept, diffuse in met:
            rows = np.array(kept)
            points.append((download(p)[rows], download(facing)[rows], np.array(diffuse)[rows]))
    position, normal, diffuse = (np.concatenate(parts) for parts in zip(*points, strict=True))
    return position.astype(np.float32), normal.astype(np.float32), diffuse
