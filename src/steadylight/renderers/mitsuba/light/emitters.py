"""Which emitter to sample, and which part of it: chosen by what reaches surface points nearby.

With many lamps of which each point sees a few, or a wide window of which it sees a slit, choosing uniformly makes most
of the noise of direct light. Area lights are divided into patches: cells of the unit square from which their samples
are made, whatever their shape. The second pass asks the nearest record which patches matter: a surface point that every
frame shares. The gather, whose rays end where no record may be, asks a coarse grid of points met on random walks from
the camera path. The choice only guides sampling: the estimate stays unbiased, since every patch keeps a share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import compatible_neighbours
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.panes import Panes
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of
from steadylight.renderers.mitsuba.upload import upload

Floats = NDArray[np.float32]

NO_ROW = 0xFFFFFFFF
"""Row of a point of which no record knows anything."""

MOST_PATCHES = 64
"""With more emitters than this, tables would grow too large: all are chosen as Mitsuba does."""

DIVISIONS = (8, 4, 2)
"""Each area light is divided into so many times so many patches: the most that keep within MOST_PATCHES."""

GRID_SITES = 16
"""Points of a voxel and direction, at most, that send the shadow rays which fill the grid."""

SHARES = (0.75, 0.2, 0.05)
"""Parts of the choice by what reaches the record, by what would reach it unshadowed, and uniform."""

NEAR = 0.5
"""Steradians. Emitters of which no sample stands for more are left to emitter sampling alone: a ray by the BSDF would
seldom hit one, and then add more noise than it takes. Nearer, some samples of them would weigh far more than others."""

NEIGHBOURS = 16
"""Records that share their shadow rays: so many of the nearest, if they are compatible."""

UNIFORM_PATCHES = 0.25
"""Part of an emitter's samples that is spread uniformly over its patches. MIS knows the density of an emitter, not that
of a patch: a sample from a patch thought to be dark must not weigh more than one over this."""

VOXELS = 32
"""Cells along each edge of the grid that guides the gather."""

WALK_LENGTH = 3
"""Surfaces met on each random walk that fills the grid."""


class EmitterSample(NamedTuple):
    """A direction towards an emitter.

    Attributes:
        direction: its pdf, for MIS, knows how the emitter was chosen, not its patch.
        weight: radiance / density of the sample, less what panes take of it; zero in shadow.
        radiance: of the emitter in that direction, without panes; may be zero in shadow.
    """

    direction: mi.DirectionSample3f
    weight: mi.Color3f
    radiance: mi.Color3f


class Sites(NamedTuple):
    """Where visibility of emitters is measured: discs that stand for the surface around them.

    Attributes:
        position: (S, 3) world, metres.
        normal: (S, 3) unit.
        radius: (S,) metres.
    """

    position: Floats
    normal: Floats
    radius: Floats


class EmitterTable(NamedTuple):
    """What was measured at some sites, by row.

    Attributes:
        shares: (rows, patches) cumulative; no columns if the choice is Mitsuba's own.
        emitters_only: (rows,) whether emitter sampling is enough there, without rays by the BSDF.
    """

    shares: Floats
    emitters_only: NDArray[np.bool_]


class _Patches:
    """The patches of a scene's emitters, by number, as device arrays: emitter, and cell of the unit square."""

    def __init__(self, scene: mi.Scene, per_emitter: NDArray[np.intp]) -> None:
        count = int(per_emitter.sum())
        which = np.repeat(np.arange(len(per_emitter)), per_emitter)
        cell = np.concatenate([np.arange(number) for number in per_emitter])
        division = np.sqrt(np.repeat(per_emitter, per_emitter)).round()
        corner = np.stack([cell % division, cell // division], axis=1) / division[:, None]
        listed = scene.emitters_dr()
        self.count = count
        self.emitter = dr.gather(mi.EmitterPtr, listed, upload(mi.UInt32, which.astype(np.uint32)))
        self.corner = upload(mi.Point2f, corner.astype(np.float32))
        self.edge = upload(mi.Float, (1 / division).astype(np.float32))
        # Emitters, by the number that Mitsuba knows them by: their first patch, and the first that is not theirs.
        ids = np.array(dr.reinterpret_array(mi.UInt32, listed))
        ends = np.zeros((int(ids.max()) + 1, 2), np.uint32)
        ends[ids, 1] = np.cumsum(per_emitter)
        ends[ids, 0] = ends[ids, 1] - per_emitter
        self.ends = upload(mi.UInt32, ends.ravel())
        dr.eval(self.emitter, self.corner, self.edge, self.ends)

    def sample(
        self, patch: mi.UInt32, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
    ) -> EmitterSample:
        """A direction to a patch, with the weight of the patch alone, unshadowed."""
        edge = dr.gather(mi.Float, self.edge, patch, active)
        corner = dr.gather(mi.Point2f, self.corner, patch, active)
        emitter = dr.gather(mi.EmitterPtr, self.emitter, patch, active)
        within = dr.clip(corner + sample * edge, 0, 1 - 2**-24)
        ds, weight = emitter.sample_direction(si, within, active)
        return EmitterSample(ds, weight * dr.square(edge), weight * ds.pdf)

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this."""
        return [self.emitter, self.corner, self.edge, self.ends]


class EmitterSampling:
    """Emitter choice for one scene: a row of shares for each record or place where visibility was measured.

    How the emitters are divided follows from the scene alone, and the shares of a part of the cache from that part
    alone, so that parts go together in any number.

    Attributes:
        guided: False if the choice is Mitsuba's own.
        panes: of the scene; shadow rays go through them.
    """

    def __init__(
        self, scene: mi.Scene, environment: Environment | None = None, panes: Panes | None = None
    ) -> None:
        """Divide the emitters; no row is known yet.

        Args:
            scene: whose emitters.
            environment: leave out its cached part, for which emitters are not sampled; leave out nothing if None.
            panes: of the scene; without solid ones if None.
        """
        self._scene = scene
        self._environment = environment
        self.panes = Panes(scene) if panes is None else panes
        self._per_emitter = _patches_per_emitter(scene.emitters())
        count = int(self._per_emitter.sum())
        self.guided = 1 < count <= MOST_PATCHES
        if self.guided:
            self._patches = _Patches(scene, self._per_emitter)
            self.use([])

    def measure(self, sites: Sites, rays: int, rows: NDArray[np.intp] | None = None) -> EmitterTable:
        """Measure at every site what arrives from every patch.

        Args:
            sites: S sites; may be none.
            rays: shadow rays from each site.
            rows: (S,) row that each site counts for, from 0; each its own if None.

        Returns:
            What `use` takes.
        """
        count = len(sites.position) if rows is None else int(rows.max(initial=-1)) + 1
        if not self.guided:
            return EmitterTable(np.zeros((count, 0), np.float32), np.zeros(count, bool))
        patches = self._patches.count
        received = self._received(sites, max(rays // patches, 1))
        received, largest = received[:, : 2 * patches], received[:, 2 * patches :].max(axis=1)
        if rows is None:
            received, largest = _pooled(received, largest, sites)
            rows = np.arange(count)
        else:
            received = _summed(received, rows, count)
        shares = _shares(received[:, :patches], received[:, patches:], self._per_emitter)
        emitters_only = np.ones(count, bool)
        np.logical_and.at(emitters_only, rows, largest <= NEAR)
        return EmitterTable(np.cumsum(shares, axis=1).astype(np.float32), emitters_only)

    def use(self, tables: Sequence[EmitterTable]) -> None:
        """Choose by these rows, one table after the other."""
        if not self.guided:
            return
        # Each row begins with 0: the share of patches a to b is element b + 1 less element a. One more row for points
        # of which no site knows: there all emitters are alike.
        count = sum(len(table.shares) for table in tables)
        per_emitter = self._per_emitter
        alike = np.cumsum(np.repeat(1 / (len(per_emitter) * per_emitter), per_emitter))
        cumulative = np.zeros((count + 1, self._patches.count + 1), np.float32)
        cumulative[:, 1:] = np.concatenate([*(table.shares for table in tables), alike[None]])
        cumulative[:, -1] = 1
        self._cumulative = upload(mi.Float, cumulative.ravel())
        self._unknown = dr.opaque(mi.UInt32, count)
        emitters_only = np.concatenate([*(table.emitters_only for table in tables), np.zeros(1, bool)])
        self._emitters_only = upload(mi.Bool, emitters_only)

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        if not self.guided:
            return []
        return [*self._patches.arrays(), self._cumulative, self._unknown, self._emitters_only]

    def row_at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """Row for a surface point where no record is asked: none here."""
        del si, active
        return mi.UInt32(NO_ROW)

    def emitters_only(self, row: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether emitter sampling is enough, without rays by a diffuse BSDF; False where no record knows."""
        if not self.guided:
            return mi.Bool(False)
        return dr.gather(mi.Bool, self._emitters_only, dr.minimum(row, self._unknown), active)

    def sample(
        self, si: mi.SurfaceInteraction3f, sample: mi.Point2f, row: mi.UInt32, active: mi.Bool
    ) -> EmitterSample:
        """Choose a patch by a row's shares and a direction to it, with a shadow ray.

        Args:
            si: where.
            sample: x chooses and is used again, so that its strata serve both.
            row: of the table, or NO_ROW.
            active: lanes.
        """
        if not self.guided:
            ds, weight = self._scene.sample_emitter_direction(si, sample, not self.panes.some, active)
            radiance = weight * ds.pdf
            if self.panes.some:
                arrives = self.panes.between(si, ds.p, active & (ds.pdf != 0))
                weight *= arrives
                ds.pdf = dr.select(dr.any(arrives != 0), ds.pdf, 0)
            return EmitterSample(ds, weight, radiance)
        base = self._base(row)
        patch = dr.binary_search(
            0,
            self._patches.count - 1,
            lambda i: dr.gather(mi.Float, self._cumulative, base + i + 1, active) <= sample.x,
        )
        before, share = self._share(base, patch, patch + 1, active)
        again = mi.Point2f((sample.x - before) / share, sample.y)
        ds, weight, radiance = self._patches.sample(patch, si, again, active)
        useful = active & (ds.pdf != 0) & dr.any(weight != 0)
        if self.panes.some:
            arrives = self.panes.between(si, ds.p, useful)
            weight *= arrives
            lit = useful & dr.any(arrives != 0)
        else:
            lit = useful & ~self._scene.ray_test(si.spawn_ray_to(ds.p), useful)
        # Who hits the emitter by chance does not know the patch, so MIS must not know it either.
        ds.pdf = dr.select(lit, ds.pdf * self._emitter_share(base, ds.emitter, lit), 0)
        return EmitterSample(ds, dr.select(lit, weight / share, 0), radiance)

    def pdf(
        self,
        si: mi.SurfaceInteraction3f,
        row: mi.UInt32,
        towards: mi.DirectionSample3f,
        emitter: mi.EmitterPtr,
        active: mi.Bool,
    ) -> mi.Float:
        """The density, 1/sr, that `sample` states at `si` for the direction to the emitter that was hit."""
        if not self.guided:
            return self._scene.pdf_emitter_direction(si, towards, active)
        share = self._emitter_share(self._base(row), emitter, active)
        return emitter.pdf_direction(si, towards, active) * share

    def _received(self, sites: Sites, samples: int) -> Floats:
        """What the sites receive by patch, (S, 3 patches).

        Luminance of direct irradiance with shadows, then without; and the largest solid angle for which one sample of
        the patch stands, steradians.
        """
        count, patches = len(sites.position), self._patches.count
        received = np.zeros((count, 3 * patches), np.float32)
        batch = max(1, PATHS_AT_ONCE // (samples * patches))
        for begin in range(0, count, batch):
            part = slice(begin, begin + batch)
            some = Sites(*(array[part] for array in sites))
            received[part] = self._received_by(some, samples, begin)
        return received

    def _received_by(self, sites: Sites, samples: int, first: int) -> Floats:
        """`_received` of some sites, of which the first has this number among all."""
        points, patches = len(sites.position), self._patches.count
        lane = dr.arange(mi.UInt32, points * patches * samples)
        group = lane // samples
        point = group // patches
        patch = group - point * patches
        place = group + dr.opaque(mi.UInt32, first * patches)
        numbers = samples_of(mi.UInt32(0), place, lane - group * samples).at(mi.UInt32(0), mi.UInt32(0))
        si = dr.zeros(mi.SurfaceInteraction3f, points * patches * samples)
        n = dr.gather(mi.Normal3f, upload(mi.Normal3f, sites.normal), point)
        p = dr.gather(mi.Point3f, upload(mi.Point3f, sites.position), point)
        radius = dr.gather(mi.Float, upload(mi.Float, sites.radius), point)
        disc = mi.warp.square_to_uniform_disk_concentric(numbers.sample_2d(Purpose.PIXEL)) * radius
        si.n = n
        si.sh_frame = mi.Frame3f(n)
        si.p = p + si.sh_frame.to_world(mi.Vector3f(disc.x, disc.y, 0))
        si.t = mi.Float(1)
        ds, weight, radiance = self._patches.sample(
            patch, si, numbers.sample_2d(Purpose.EMITTER), mi.Bool(True)
        )
        if self._environment is not None:
            cached = self._environment.cached_fraction(radiance)
            weight *= dr.select(ds.emitter.is_environment(), 1 - cached, 1)
        cosine = dr.maximum(dr.dot(ds.d, n), 0)
        received = cosine * mi.luminance(weight)
        received = dr.select(dr.isfinite(received) & (ds.pdf > 0), received, 0)
        edge = dr.gather(mi.Float, self._patches.edge, patch)
        solid_angle = dr.select((received > 0) & ~ds.delta, dr.square(edge) / ds.pdf, 0)
        if self.panes.some:
            arrives = self.panes.between(si, ds.p, received > 0)
            shadowed = cosine * mi.luminance(weight * arrives)
            lit = (received > 0) & dr.any(arrives != 0)
        else:
            shadowed = received
            lit = (received > 0) & ~self._scene.ray_test(si.spawn_ray_to(ds.p), received > 0)
        shadowed = dr.select(lit, shadowed, 0)
        dr.eval(received, shadowed, solid_angle)
        columns = [dr.block_sum(values, samples) / samples for values in (shadowed, received)]
        columns.append(dr.block_reduce(dr.ReduceOp.Max, solid_angle, samples))
        dr.eval(columns)
        return np.concatenate([np.array(values).reshape(points, -1) for values in columns], axis=1)

    def _base(self, row: mi.UInt32) -> mi.UInt32:
        return dr.minimum(row, self._unknown) * (self._patches.count + 1)

    def _emitter_share(self, base: mi.UInt32, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Float:
        number = dr.reinterpret_array(mi.UInt32, emitter)
        first, end = (dr.gather(mi.UInt32, self._patches.ends, 2 * number + i, active) for i in (0, 1))
        return self._share(base, first, end, active)[1]

    def _share(
        self, base: mi.UInt32, first: mi.UInt32, end: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Cumulative share before some patches, and their own."""
        lower = dr.gather(mi.Float, self._cumulative, base + first, active)
        upper = dr.gather(mi.Float, self._cumulative, base + end, active)
        return lower, dr.maximum(upper - lower, 1e-7)


class GridEmitterSampling(EmitterSampling):
    """Emitter choice with a row for each voxel and each of the six main directions in which a surface may face."""

    def __init__(
        self, scene: mi.Scene, position: Floats, normal: Floats, rays: int, panes: Panes | None = None
    ) -> None:
        """Measure visibility of every emitter at surface points.

        Args:
            scene: whose emitters.
            position: (P, 3) points spread over the surfaces that rays will hit, metres.
            normal: (P, 3) unit normals on the lit side.
            rays: shadow rays from each of the points that fill the grid.
            panes: of the scene; without solid ones if None.
        """
        if len(position) == 0:
            position, normal = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
        # The middle 98 % of the points: a distant horizon must not make the voxels of the room coarse.
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
        radius = np.zeros(len(position), np.float32)  # the points of a voxel are spread already
        super().__init__(scene, None, panes)
        self.use([self.measure(Sites(position, normal, radius), rays, rows)])
        table = np.full(6 * VOXELS**3, NO_ROW, np.uint32)
        table[keys] = np.arange(len(keys))
        self._rows = mi.UInt32(table)
        self._lower = mi.Point3f(lower.tolist())
        self._per_metre = mi.Float(1 / edge)
        dr.make_opaque(self._lower, self._per_metre)

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        return [*super().arrays(), self._rows, self._lower, self._per_metre]

    def row_at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """Row for a surface point, on the side from which it was met."""
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
        return dr.gather(mi.UInt32, self._rows, voxel * 6 + face, active)


def _patches_per_emitter(emitters: Sequence[mi.Emitter]) -> NDArray[np.intp]:
    """How many patches each emitter has: a square number."""
    divided = np.array([mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) for emitter in emitters], bool)
    for division in DIVISIONS:
        patches = np.where(divided, division**2, 1)
        if patches.sum() <= MOST_PATCHES:
            return patches
    return np.ones(len(emitters), np.intp)


def _shares(seen: Floats, open_: Floats, patches: NDArray[np.intp]) -> NDArray[np.float64]:
    """Shares of the patches in each row, (rows, patches), from what they receive of each; they sum to one."""
    shares = np.full(seen.shape, SHARES[-1] / seen.shape[1])
    for share, received in zip(SHARES, (seen, open_), strict=False):
        total = received.sum(axis=1, keepdims=True, dtype=np.float64)
        shares += np.where(total > 0, share * received / np.where(total > 0, total, 1), 0)
    shares /= shares.sum(axis=1, keepdims=True)
    whole = np.add.reduceat(shares, np.cumsum(patches) - patches, axis=1)
    uniform = np.repeat(whole / patches, patches, axis=1)
    return UNIFORM_PATCHES * uniform + (1 - UNIFORM_PATCHES) * shares


def _summed(received: Floats, rows: NDArray[np.intp], count: int) -> Floats:
    """Sums of (S, n) by row, (count, n)."""
    columns = (np.bincount(rows, column, count) for column in received.T)
    return np.stack(list(columns), axis=1).astype(np.float32)


def _pooled(received: Floats, largest: Floats, sites: Sites) -> tuple[Floats, Floats]:
    """Means of (S, n), and largest of (S,), over sites nearby that face alike.

    A slit of a window is easily missed by one site alone, and so is how near it is beside its frame.
    """
    if len(received) < 2:
        return received, largest
    near, counts = compatible_neighbours(sites.position, sites.normal, NEIGHBOURS, 2 * sites.radius)
    weight = counts.astype(np.float32)
    mean = np.zeros_like(received)
    for k in range(weight.shape[1]):
        mean += weight[:, k, None] * received[near[:, k]]
    return mean / weight.sum(axis=1, keepdims=True), np.where(counts, largest[near], 0).max(axis=1)


def walk(scene: mi.Scene, rays: mi.Ray3f, count: int, panes: Panes) -> tuple[Floats, Floats]:
    """Points and facing normals met by diffuse random walks, through panes: where the gather's rays will end, roughly.

    Args:
        scene: what they meet.
        rays: to start with.
        count: how many.
        panes: of the scene.

    Returns:
        (P, 3) positions, metres, and (P, 3) unit normals.
    """
    numbers = samples_of(mi.UInt32(1), dr.arange(mi.UInt32, count), mi.UInt32(0))
    ray, active = mi.Ray3f(rays), mi.Bool(True)
    points: list[tuple[Floats, Floats]] = []
    for step in range(WALK_LENGTH):
        si = scene.ray_intersect(ray, active)
        if panes.some:
            si = panes.beyond(si, ray.d, panes.transmission(si, active), active).si
        active &= si.is_valid()
        n = mi.Normal3f(si.sh_frame.n * dr.select(si.wi.z < 0, mi.Float(-1), mi.Float(1)))
        sample = numbers.at(mi.UInt32(0), mi.UInt32(step)).sample_2d(Purpose.DIRECTION)
        ray = si.spawn_ray(mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(sample)))
        dr.eval(si.p, n, active, ray)
        kept = np.array(active)
        points.append((np.array(si.p).T[kept], np.array(n).T[kept]))
    position, normal = (np.concatenate([part[i] for part in points]).astype(np.float32) for i in (0, 1))
    return position, normal
