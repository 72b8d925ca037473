"""Which emitter to sample, and which part of it: chosen by what reaches surface points nearby.

With many lamps of which each point sees a few, or a wide window of which it sees a slit, choosing evenly is most of the
noise of direct light. Area lights are divided into patches: cells of the unit square from which their samples are
made, whatever their shape. The second pass asks the nearest record which patches matter: a surface point that every
frame shares. The gather, whose rays end where no record may be, asks a coarse grid of points met on random walks from
the camera path. The choice only guides sampling: the estimate stays unbiased, since every patch keeps a share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import mitsuba as mi
from steadylight.cache.compatibility import compatible_neighbours
from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.records.lookup import NO_RECORD, Part
from steadylight.renderers.mitsuba.upload import upload

MOST = 64
"""With more emitters than this, tables would grow too large: all are chosen as Mitsuba does."""

DIVISIONS = (8, 4, 2)
"""Each area light is divided into so many times so many patches: the most that keep within MOST."""

RECORD_RAYS = 512
"""Shadow rays from each record, over all patches, from points spread over the disc for which the record speaks."""

GRID_RAYS, GRID_SITES = 512, 16
"""Shadow rays from each of the points that fill the grid, and how many points of a cell and direction ask."""

SHARES = (0.75, 0.2, 0.05)
"""Parts of the choice by what reaches the record, by what would reach it unshadowed, and even."""

NEAR = 0.5
"""Steradians. Emitters of which no sample stands for more are found by samples of them alone: a ray by the BSDF would
seldom hit one, and then add more noise than it takes. Nearer, some samples of them would weigh far more than others."""

NEIGHBOURS = 16
"""Records that share their shadow rays: so many of the nearest, itself included, if they are compatible."""

SURE = 0.25
"""Part of an emitter's samples that is spread evenly over its patches. MIS knows an emitter's density only, not that of
a patch: a sample from a patch thought to be dark must not weigh more than one over this."""

VOXELS = 32
"""Cells along each edge of the grid that guides the gather."""

WALK = 3
"""Surfaces met on each random walk that fills the grid."""


class EmitterSample(NamedTuple):
    """A direction towards an emitter."""

    direction: Any  # DirectionSample3f; its pdf, for MIS, knows how the emitter was chosen, not its patch
    weight: Any  # Color3f, radiance / density of the sample, zero in shadow
    radiance: Any  # Color3f of the emitter in that direction; may be zero in shadow


class Sites(NamedTuple):
    """Where emitters are asked for: discs that stand for the surface around them."""

    position: Floats  # (S, 3) metres
    normal: Floats  # (S, 3) unit
    radius: Floats  # (S,) metres


class Choice(NamedTuple):
    """What is known of the emitters at some sites, by row."""

    shares: Floats  # (rows, patches) cumulative; no columns if the choice is Mitsuba's own
    suffices: NDArray[np.bool_]  # (rows,) whether samples of emitters suffice, without rays by the BSDF


class EmitterSampling:
    """Emitter choice for one scene, by row: one row of shares for each record or place that knows better.

    How the emitters are divided follows from the scene alone, and the shares of a part of the cache from that part
    alone, so that parts go together in any number.

    Attributes:
        guided: False if the choice is Mitsuba's own.
    """

    def __init__(self, scene: Any, environment: Environment | None = None) -> None:
        """Divide the emitters; no row is known yet.

        Args:
            scene: mi.Scene.
            environment: leave out the soft part of the environment, which emitter samples are not asked for.
        """
        self._scene = scene
        self._sky = environment if environment is not None and environment.exists else None
        emitters = scene.emitters()
        patches = self._patches = _patches(emitters)
        self._count = int(patches.sum())
        self.guided = 1 < self._count <= MOST
        if not self.guided:
            return
        # Patches, by number: the emitter, the lower corner and the edge of its cell of the unit square.
        which = np.repeat(np.arange(len(emitters)), patches)
        cell = np.concatenate([np.arange(number) for number in patches])
        division = np.sqrt(np.repeat(patches, patches)).round()
        corner = np.stack([cell % division, cell // division], axis=1) / division[:, None]
        listed = scene.emitters_dr()
        self._emitters = dr.gather(mi.EmitterPtr, listed, upload(mi.UInt32, which.astype(np.uint32)))
        self._corner = upload(mi.Point2f, corner.astype(np.float32))
        self._edge = upload(mi.Float, (1 / division).astype(np.float32))
        # Emitters, by the number that Mitsuba knows them by: their first patch, and the first that is not theirs.
        ids = np.array(dr.reinterpret_array(mi.UInt32, listed))
        ends = np.zeros((int(ids.max()) + 1, 2), np.uint32)
        ends[ids, 1] = np.cumsum(patches)
        ends[ids, 0] = ends[ids, 1] - patches
        self._ends = upload(mi.UInt32, ends.ravel())
        dr.eval(self._emitters, self._corner, self._edge, self._ends)
        self.know([])

    def ask(self, sites: Sites, rays: int, rows: NDArray[np.intp] | None = None) -> Choice:
        """Ask at every site for every patch of every emitter.

        Args:
            sites: S sites; may be none.
            rays: shadow rays from each site.
            rows: (S,) row that each site counts for, from 0; each its own if None.

        Returns:
            What `know` takes.
        """
        count = len(sites.position) if rows is None else int(rows.max(initial=-1)) + 1
        if not self.guided:
            return Choice(np.zeros((count, 0), np.float32), np.zeros(count, bool))
        received = self._received(sites, max(rays // self._count, 1))
        received, largest = received[:, : 2 * self._count], received[:, 2 * self._count :].max(axis=1)
        if rows is None:
            received, largest = _pooled(received, largest, sites)
            rows = np.arange(count)
        else:
            received = _summed(received, rows, count)
        shares = _shares(received[:, : self._count], received[:, self._count :], self._patches)
        suffices = np.ones(count, bool)
        np.logical_and.at(suffices, rows, largest <= NEAR)
        return Choice(np.cumsum(shares, axis=1).astype(np.float32), suffices)

    def know(self, choices: Sequence[Choice]) -> None:
        """Take these rows, one after the other, for the choice."""
        if not self.guided:
            return
        # Each row begins with 0: the share of patches a to b is element b + 1 less element a. One more row for points
        # of which no site knows: there all emitters are alike.
        count = sum(len(choice.shares) for choice in choices)
        alike = np.cumsum(np.repeat(1 / (len(self._patches) * self._patches), self._patches))
        cumulative = np.zeros((count + 1, self._count + 1), np.float32)
        cumulative[:, 1:] = np.concatenate([*(choice.shares for choice in choices), alike[None]])
        cumulative[:, -1] = 1
        self._cumulative = upload(mi.Float, cumulative.ravel())
        self._unknown = dr.opaque(mi.UInt32, count)
        suffices = np.concatenate([*(choice.suffices for choice in choices), np.zeros(1, bool)])
        self._suffices = upload(mi.Bool, suffices)

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        if not self.guided:
            return []
        return [
            self._emitters,
            self._corner,
            self._edge,
            self._ends,
            self._cumulative,
            self._unknown,
            self._suffices,
        ]

    def suffice(self, row: Any, active: Any) -> Any:
        """Whether samples of emitters need no rays by a diffuse BSDF beside them; False where no record knows."""
        if not self.guided:
            return mi.Bool(False)
        return dr.gather(mi.Bool, self._suffices, dr.minimum(row, self._unknown), active)

    def _received(self, sites: Sites, samples: int) -> Floats:
        """What the sites receive by patch, (S, 3 patches).

        Luminance of direct irradiance with shadows, then without; and the largest solid angle for which one sample of
        the patch stands, steradians.
        """
        count = len(sites.position)
        received = np.zeros((count, 3 * self._count), np.float32)
        batch = max(1, PATHS_AT_ONCE // (samples * self._count))
        for begin in range(0, count, batch):
            part = slice(begin, begin + batch)
            some = Sites(*(array[part] for array in sites))
            received[part] = self._received_by(some, samples, begin)
        return received

    def _received_by(self, sites: Sites, samples: int, seed: int) -> Floats:
        points, lanes = len(sites.position), len(sites.position) * self._count * samples
        lane = dr.arange(mi.UInt32, lanes)
        group = lane // samples
        point = group // self._count
        patch = group - point * self._count
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
        ds, weight, radiance = self._towards(patch, si, sampler.next_2d(), mi.Bool(True))
        if self._sky is not None:
            weight *= dr.select(ds.emitter.is_environment(), 1 - self._sky.cached_fraction(radiance), 1)
        cosine = dr.maximum(dr.dot(ds.d, n), 0)
        received = cosine * mi.luminance(weight)
        received = dr.select(dr.isfinite(received) & (ds.pdf > 0), received, 0)
        edge = dr.gather(mi.Float, self._edge, patch)
        solid_angle = dr.select((received > 0) & ~ds.delta, dr.square(edge) / ds.pdf, 0)
        lit = (received > 0) & ~self._scene.ray_test(si.spawn_ray_to(ds.p), received > 0)
        shadowed = dr.select(lit, received, 0)
        dr.eval(received, shadowed, solid_angle)
        columns = [dr.block_sum(values, samples) / samples for values in (shadowed, received)]
        columns.append(dr.block_reduce(dr.ReduceOp.Max, solid_angle, samples))
        dr.eval(columns)
        return np.concatenate([np.array(values).reshape(points, -1) for values in columns], axis=1)

    def _towards(self, patch: Any, si: Any, sample: Any, active: Any) -> tuple[Any, Any, Any]:
        """Direction to a patch, its weight (of the patch alone, unshadowed) and the radiance behind it."""
        edge = dr.gather(mi.Float, self._edge, patch, active)
        corner = dr.gather(mi.Point2f, self._corner, patch, active)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, patch, active)
        within = dr.clip(corner + sample * edge, 0, 1 - 2**-24)
        ds, weight = emitter.sample_direction(si, within, active)
        return ds, weight * dr.square(edge), weight * ds.pdf

    def sample(self, si: Any, sample: Any, row: Any, active: Any) -> EmitterSample:
        """Choose a patch by the record's shares and a direction to it, with a shadow ray.

        Args:
            si: where.
            sample: Point2f; x chooses and is used again, so its strata serve both.
            row: the record that knows best, or NO_RECORD.
            active: lanes.
        """
        if not self.guided:
            ds, weight = self._scene.sample_emitter_direction(si, sample, True, active)
            return EmitterSample(ds, weight, weight * ds.pdf)
        base = self._base(row)
        patch = dr.binary_search(
            0,
            self._count - 1,
            lambda i: dr.gather(mi.Float, self._cumulative, base + i + 1, active) <= sample.x,
        )
        before, share = self._share(base, patch, patch + 1, active)
        again = mi.Point2f((sample.x - before) / share, sample.y)
        ds, weight, radiance = self._towards(patch, si, again, active)
        useful = active & (ds.pdf != 0) & dr.any(weight != 0)
        lit = useful & ~self._scene.ray_test(si.spawn_ray_to(ds.p), useful)
        # Who hits the emitter by chance does not know the patch, so MIS must not know it either.
        ds.pdf = dr.select(lit, ds.pdf * self._emitter_share(base, ds.emitter, lit), 0)
        return EmitterSample(ds, dr.select(lit, weight / share, 0), radiance)

    def pdf(self, prev_si: Any, ds: Any, emitter: Any, row: Any, active: Any) -> Any:
        """What `sample` gives as `pdf` for the direction `ds` to the emitter that was hit."""
        if not self.guided:
            return self._scene.pdf_emitter_direction(prev_si, ds, active)
        share = self._emitter_share(self._base(row), emitter, active)
        return emitter.pdf_direction(prev_si, ds, active) * share

    def _base(self, row: Any) -> Any:
        return dr.minimum(row, self._unknown) * (self._count + 1)

    def _emitter_share(self, base: Any, emitter: Any, active: Any) -> Any:
        number = dr.reinterpret_array(mi.UInt32, emitter)
        first, end = (dr.gather(mi.UInt32, self._ends, 2 * number + i, active) for i in (0, 1))
        return self._share(base, first, end, active)[1]

    def _share(self, base: Any, first: Any, end: Any, active: Any) -> tuple[Any, Any]:
        """Cumulative share before some patches, and their own."""
        lower = dr.gather(mi.Float, self._cumulative, base + first, active)
        upper = dr.gather(mi.Float, self._cumulative, base + end, active)
        return lower, dr.maximum(upper - lower, 1e-7)


def _patches(emitters: Sequence[Any]) -> NDArray[np.intp]:
    """How many patches each emitter has: a square number."""
    divided = np.array([mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) for emitter in emitters], bool)
    for division in DIVISIONS:
        patches = np.where(divided, division**2, 1)
        if patches.sum() <= MOST:
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
    return SURE * np.repeat(whole / patches, patches, axis=1) + (1 - SURE) * shares


def _summed(received: Floats, rows: NDArray[np.intp], count: int) -> Floats:
    """Sums of (S, n) by row, (count, n)."""
    columns = (np.bincount(rows, column, count) for column in received.T)
    return np.stack(list(columns), axis=1).astype(np.float32)


def _pooled(received: Floats, largest: Floats, sites: Sites) -> tuple[Floats, Floats]:
    """Means of (S, n), and largest of (S,), over sites nearby that face alike.

    A slit of a window is easily missed by one alone, and so is how near it is beside its frame.
    """
    if len(received) < 2:
        return received, largest
    near, compatible = compatible_neighbours(
        sites.position, sites.normal, NEIGHBOURS, within=2 * sites.radius
    )
    weight = compatible.astype(np.float32)
    mean = np.zeros_like(received)
    for k in range(near.shape[1]):
        mean += weight[:, k, None] * received[near[:, k]]
    return mean / weight.sum(axis=1, keepdims=True), np.where(weight > 0, largest[near], 0).max(axis=1)


def record_emitter_sampling(scene: Any, parts: Sequence[Part], environment: Environment) -> EmitterSampling:
    """Emitter choice with a row for each record, without the soft sky that the records hold.

    Args:
        scene: mi.Scene.
        parts: of the cache, in its order; asked for shadow rays only once.
        environment: divides the surroundings.
    """
    emitters = EmitterSampling(scene, environment)
    for part in parts:
        if part.choice is None:
            records = part.records
            part.choice = emitters.ask(Sites(records.position, records.normal, records.radius), RECORD_RAYS)
    emitters.know([part.choice for part in parts if part.choice is not None])
    return emitters


class GridEmitterSampling(EmitterSampling):
    """Emitter choice with a row for each voxel and each of the six main directions in which a surface may face."""

    def __init__(self, scene: Any, position: Floats, normal: Floats) -> None:
        """Ask for every emitter at surface points.

        Args:
            scene: mi.Scene.
            position: (P, 3) points spread over the surfaces that rays will hit, metres.
            normal: (P, 3) unit normals on the lit side.
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
        asked = np.arange(len(key)) - np.repeat(begin, number) < GRID_SITES
        rows, order = np.repeat(np.arange(len(keys)), number)[asked], order[asked]
        position, normal = position[order], normal[order]
        radius = np.zeros(len(position), np.float32)  # the points of a voxel are spread already
        super().__init__(scene)
        self.know([self.ask(Sites(position, normal, radius), GRID_RAYS, rows)])
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
