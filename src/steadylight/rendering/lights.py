"""Which emitter to sample: chosen by what reaches surface points nearby.

With many lamps of which each point sees a few, choosing among all of them evenly is most of the noise of direct
light. The second pass asks the nearest record: a surface point that every frame shares. The gather, whose rays end
where no record may be, asks a coarse grid of points met on random walks from the camera path. The choice only
guides sampling: the estimate stays unbiased, since every emitter keeps a share.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.records import Floats, Records
from steadylight.rendering.lookup import NO_RECORD
from steadylight.rendering.upload import upload

MOST = 64
"""With more emitters than this, tables per record would grow too large: all are chosen as Mitsuba does."""

SAMPLES = 32
"""Shadow rays from each record to each emitter, from points spread over the disc for which the record speaks."""

SHARES = (0.75, 0.2, 0.05)
"""Parts of the choice by what reaches the record, by what would reach it unshadowed, and even."""

LANES = 1 << 21

VOXELS = 32
"""Cells along each edge of the grid that guides the gather."""

WALK = 3
"""Surfaces met on each random walk that fills the grid."""


class EmitterSample(NamedTuple):
    """A direction towards an emitter."""

    direction: Any  # DirectionSample3f; its pdf includes the choice of the emitter
    weight: Any  # Color3f, radiance / pdf, zero in shadow


class Sites(NamedTuple):
    """Where emitters are asked for: discs that stand for the surface around them."""

    position: Floats  # (S, 3) metres
    normal: Floats  # (S, 3) unit
    radius: Floats  # (S,) metres


class Lights:
    """Emitter choice for one scene, by row: one row of shares for each site.

    Attributes:
        guided: False if the choice is Mitsuba's own.
    """

    def __init__(self, scene: Any, sites: Sites, rows: NDArray[np.intp] | None = None) -> None:
        """Ask at every site for every emitter.

        Args:
            scene: mi.Scene.
            sites: S sites; may be none.
            rows: (S,) row that each site counts for, from 0; each its own if None.
        """
        self._scene = scene
        emitters = scene.emitters()
        self._count = len(emitters)
        self.guided = 1 < self._count <= MOST
        if not self.guided:
            return
        self._emitters = scene.emitters_dr()
        ids = np.array(dr.reinterpret_array(mi.UInt32, self._emitters))
        index = np.zeros(int(ids.max()) + 1, np.uint32)
        index[ids] = np.arange(self._count)
        self._index = upload(mi.UInt32, index)
        count = len(sites.position)
        seen, open_ = self._received(sites)
        if rows is not None:
            count = int(rows.max(initial=-1)) + 1
            seen, open_ = (_summed(received, rows, count) for received in (seen, open_))
        shares = np.full((count, self._count), SHARES[-1] / self._count)
        for share, received in zip(SHARES, (seen, open_), strict=False):
            total = received.sum(axis=1, keepdims=True)
            shares += np.where(total > 0, share * received / np.where(total > 0, total, 1), 0)
        cumulative = np.cumsum(shares / shares.sum(axis=1, keepdims=True), axis=1)
        cumulative[:, -1] = 1
        # One more row, even, for points of which no site knows.
        even = np.arange(1, self._count + 1) / self._count
        self._cumulative = upload(mi.Float, np.vstack([cumulative, even]).astype(np.float32).ravel())
        self._unknown = dr.opaque(mi.UInt32, count)
        dr.eval(self._cumulative, self._index)

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        return [self._emitters, self._index, self._cumulative, self._unknown] if self.guided else []

    def _received(self, sites: Sites) -> tuple[Any, Any]:
        """Luminance of direct irradiance at the sites by emitter, (S, emitters): with shadows and without."""
        count = len(sites.position)
        seen, open_ = np.zeros((count, self._count)), np.zeros((count, self._count))
        batch = max(1, LANES // (SAMPLES * self._count))
        for begin in range(0, count, batch):
            part = slice(begin, begin + batch)
            seen[part], open_[part] = self._received_by(Sites(*(array[part] for array in sites)), begin)
        return seen, open_

    def _received_by(self, sites: Sites, seed: int) -> tuple[Any, Any]:
        points, lanes = len(sites.position), len(sites.position) * self._count * SAMPLES
        lane = dr.arange(mi.UInt32, lanes)
        group = lane // SAMPLES
        point = group // self._count
        which = group - point * self._count
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), lanes)
        si = dr.zeros(mi.SurfaceInteraction3f, lanes)
        n = dr.gather(mi.Normal3f, upload(mi.Normal3f, sites.normal), point)
        p = dr.gather(mi.Point3f, upload(mi.Point3f, sites.position), point)
        radius = dr.gather(mi.Float, upload(mi.Float, sites.radius), point)
        disc = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d()) * radius
        si.n = n
        si.sh_frame = mi.Frame3f(n)
        si.p = p + si.sh_frame.to_world(mi.Vector3f(disc.x, disc.y, 0))
        si.t = mi.Float(1)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, which)
        ds, weight = emitter.sample_direction(si, sampler.next_2d(), True)
        received = dr.maximum(dr.dot(ds.d, n), 0) * mi.luminance(weight)
        received = dr.select(dr.isfinite(received) & (ds.pdf > 0), received, 0)
        lit = (received > 0) & ~self._scene.ray_test(si.spawn_ray_to(ds.p), received > 0)
        shadowed = dr.select(lit, received, 0)
        dr.eval(received, shadowed)
        shape = (points, self._count, SAMPLES)
        shadowed, received = (np.array(a).reshape(shape).mean(axis=2) for a in (shadowed, received))
        return shadowed, received

    def sample(self, si: Any, sample: Any, row: Any, active: Any) -> EmitterSample:
        """Choose an emitter by the record's shares and a direction to it, with a shadow ray.

        Args:
            si: where.
            sample: Point2f; x chooses and is used again, so its strata serve both.
            row: the record that knows best, or NO_RECORD.
            active: lanes.
        """
        if not self.guided:
            return EmitterSample(*self._scene.sample_emitter_direction(si, sample, True, active))
        base = dr.minimum(row, self._unknown) * self._count
        which = dr.binary_search(
            0,
            self._count - 1,
            lambda i: dr.gather(mi.Float, self._cumulative, base + i, active) <= sample.x,
        )
        before, share = self._share(base, which, active)
        again = mi.Point2f(dr.clip((sample.x - before) / share, 0, 1 - 2**-24), sample.y)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, which, active)
        ds, weight = emitter.sample_direction(si, again, active)
        useful = active & (ds.pdf != 0) & dr.any(weight != 0)
        lit = useful & ~self._scene.ray_test(si.spawn_ray_to(ds.p), useful)
        ds.pdf = dr.select(lit, ds.pdf * share, 0)
        return EmitterSample(ds, dr.select(lit, weight / share, 0))

    def pdf(self, prev_si: Any, ds: Any, emitter: Any, row: Any, active: Any) -> Any:
        """Density with which `sample` would have found the direction `ds` to the emitter that was hit."""
        if not self.guided:
            return self._scene.pdf_emitter_direction(prev_si, ds, active)
        which = dr.gather(mi.UInt32, self._index, dr.reinterpret_array(mi.UInt32, emitter), active)
        _, share = self._share(dr.minimum(row, self._unknown) * self._count, which, active)
        return emitter.pdf_direction(prev_si, ds, active) * share

    def _share(self, base: Any, which: Any, active: Any) -> tuple[Any, Any]:
        """Cumulative share before an emitter, and its own."""
        upper = dr.gather(mi.Float, self._cumulative, base + which, active)
        lower = dr.select(
            which > 0, dr.gather(mi.Float, self._cumulative, base + which - 1, active & (which > 0)), 0
        )
        return lower, dr.maximum(upper - lower, 1e-7)


def _summed(received: Any, rows: NDArray[np.intp], count: int) -> Any:
    """Sums of (S, emitters) by row, (count, emitters)."""
    return np.stack([np.bincount(rows, column, count) for column in received.T], axis=1)


def record_lights(scene: Any, records: Records) -> Lights:
    """Emitter choice with a row for each record."""
    return Lights(scene, Sites(records.position, records.normal, records.reach))


class GridLights(Lights):
    """Emitter choice with a row for each voxel and each of the six main directions in which a surface may face."""

    def __init__(self, scene: Any, position: Floats, normal: Floats) -> None:
        """Ask for every emitter at surface points.

        Args:
            scene: mi.Scene.
            position: (P, 3) points spread over the surfaces that rays will hit, metres.
            normal: (P, 3) unit normals on the lit side.
        """
        self._lower, self._per_metre = mi.Point3f(0), mi.Float(0)
        self._rows = mi.UInt32(NO_RECORD)
        if not 1 < len(scene.emitters()) <= MOST:
            super().__init__(scene, Sites(*(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 3), (0,)))))
            return
        if len(position) == 0:
            position, normal = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
        # The middle 98 % of the points: a distant horizon must not make the voxels of the room coarse.
        lower, upper = np.quantile(position, [0.01, 0.99], axis=0)
        edge = max(float((upper - lower).max()) / VOXELS, 1e-6)
        cell = np.clip(np.floor((position - lower) / edge), 0, VOXELS - 1).astype(np.int64)
        along = np.abs(normal).argmax(axis=1)
        face = 2 * along + (np.take_along_axis(normal, along[:, None], axis=1)[:, 0] < 0)
        key = ((cell[:, 2] * VOXELS + cell[:, 1]) * VOXELS + cell[:, 0]) * 6 + face
        keys, rows = np.unique(key, return_inverse=True)
        radius = np.zeros(len(position), np.float32)  # the points of a voxel are spread already
        super().__init__(scene, Sites(position, normal, radius), rows)
        table = np.full(6 * VOXELS**3, NO_RECORD, np.uint32)
        table[keys] = np.arange(len(keys))
        self._rows = mi.UInt32(table)
        self._lower = mi.Point3f(lower.tolist())
        self._per_metre = mi.Float(1 / edge)
        dr.make_opaque(self._lower, self._per_metre)

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        return [*super().arrays(), self._rows, self._lower, self._per_metre]

    def row_at(self, si: Any, active: Any) -> Any:
        """Row for a surface point, on the side from which it was met."""
        if not self.guided:
            return mi.UInt32(NO_RECORD)
        cell = dr.clip((si.p - self._lower) * self._per_metre, 0, VOXELS - 1)
        index = mi.Point3u(cell)
        n = si.sh_frame.n
        a = dr.abs(n)
        axis = dr.select(
            (a.x >= a.y) & (a.x >= a.z), mi.UInt32(0), dr.select(a.y >= a.z, mi.UInt32(1), mi.UInt32(2))
        )
        along = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
        back = (along < 0) ^ (si.wi.z < 0)
        face = 2 * axis + dr.select(back, mi.UInt32(1), mi.UInt32(0))
        return dr.gather(
            mi.UInt32, self._rows, ((index.z * VOXELS + index.y) * VOXELS + index.x) * 6 + face, active
        )


def walk(scene: Any, rays: Any, count: int) -> tuple[Floats, Floats]:
    """Points and facing normals met by diffuse random walks: where the gather's rays will end, roughly.

    Args:
        scene: mi.Scene.
        rays: Ray3f to start with.
        count: how many.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 1), count)
    ray, active = mi.Ray3f(rays), mi.Bool(True)
    points: list[Any] = []
    for _ in range(WALK):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        n = mi.Normal3f(si.sh_frame.n * dr.select(si.wi.z < 0, mi.Float(-1), mi.Float(1)))
        out = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active)))
        ray = si.spawn_ray(out)
        dr.eval(si.p, n, active, ray)
        kept = np.array(active)
        points.append((np.array(si.p).T[kept], np.array(n).T[kept]))
    position, normal = (np.concatenate([part[i] for part in points]).astype(np.float32) for i in (0, 1))
    return position, normal
