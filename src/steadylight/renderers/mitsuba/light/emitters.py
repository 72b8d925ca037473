"""Choice of which part of which emitter to sample, by what reaches surface points nearby.

With many lamps of which each point sees a few, or a wide window of which it sees a slit, uniform choice causes most of
the noise of direct light. All emitters are divided into patches. The second pass takes the importance of patches from
the nearest record, a surface point that all frames share. The gather, whose rays end where there may be no record,
takes it from a coarse grid of points met on random walks from the camera path. This only guides sampling: the estimate
remains unbiased, since every patch keeps a share.
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
from steadylight.renderers.mitsuba.light.patches import Patches
from steadylight.renderers.mitsuba.memory import PATHS_AT_ONCE
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of
from steadylight.renderers.mitsuba.upload import download, upload

Floats = NDArray[np.float32]

NO_ROW = 0xFFFFFFFF
"""Row of a point without a record."""

MOST_RAYS = 16
"""Maximum number of shadow rays from a site to a patch: neighbours share theirs."""

SHARES = (0.75, 0.2, 0.05)
"""Shares of the choice by what reaches the record, by what would reach it unshadowed, and by equal emitters."""

NEAR = 0.5
"""Steradians. Where no emitter sample stands for a larger solid angle, emitters are sampled without BSDF samples: these
would seldom hit an emitter, and then add more noise than they remove. Nearer to emitters, some emitter samples would
have far larger weights than others."""

NEIGHBOURS = 16
"""Number of nearest records that share their shadow rays if they are compatible."""

SITES_AT_ONCE = 1 << 16
"""Sites whose rows are made at once, to bound temporary memory."""


class EmitterSample(NamedTuple):
    """A direction towards an emitter.

    Attributes:
        direction: its pdf is the density of all choices that led to it, for MIS; 0 in shadow.
        weight: radiance / density of the sample, attenuated by panes; zero in shadow.
        radiance: of the emitter in that direction, without panes; may be zero in shadow.
    """

    direction: mi.DirectionSample3f
    weight: mi.Color3f
    radiance: mi.Color3f


class Sites(NamedTuple):
    """Discs at which the visibility of emitters is measured; each stands for the surface around it.

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
        shares: (rows, patches) cumulative; no columns if the choice is left to Mitsuba.
        emitters_only: (rows,) whether emitter sampling is enough there, without BSDF samples.
    """

    shares: Floats
    emitters_only: NDArray[np.bool_]


class EmitterSampling:
    """Emitter choice for one scene: a row of shares for each record or place where visibility was measured.

    The division of the emitters depends on the scene alone, and the shares for a part of the cache on that part alone,
    so parts can be combined freely.

    Attributes:
        guided: whether there is more than one patch to choose from.
        panes: of the scene; shadow rays pass through them.
    """

    def __init__(
        self, scene: mi.Scene, environment: Environment, panes: Panes | None = None, *, whole: bool = False
    ) -> None:
        """Divide the emitters; there are no rows yet.

        Args:
            scene: mi.Scene.
            environment: of the scene.
            panes: of the scene; without solid ones if None.
            whole: sample all of the environment; otherwise without its cached part, which needs no emitter samples.
        """
        self._scene, self._environment, self._whole = scene, environment, whole
        self.panes = Panes(scene) if panes is None else panes
        self._patches = Patches(scene, environment, whole=whole)
        self.guided = self._patches.count > 1
        if self.guided:
            self.use([])

    def measure(self, sites: Sites, rays: int) -> EmitterTable:
        """Measure at every site the light that arrives from every patch.

        Args:
            sites: S sites; may be none. Each gets a row of its own, and shares its shadow rays with its neighbours.
            rays: shadow rays from each site.

        Returns:
            A table for `use`.
        """
        count = len(sites.position)
        if not self.guided:
            return self._untold(count)
        (received,), largest = self._received(sites, self._samples(rays), [self._whole])
        around = compatible_neighbours(sites.position, sites.normal, NEIGHBOURS, 2 * sites.radius)
        table = EmitterTable(np.zeros((count, self._patches.count), np.float32), np.zeros(count, bool))
        for begin in range(0, count, SITES_AT_ONCE):
            some = slice(begin, begin + SITES_AT_ONCE)
            near, counts = around.rows[some], around.compatible[some]
            table.shares[some] = self._shares(_mean(received, near, counts))
            # Beside the frame of a window, a single site may not notice how near the window is.
            table.emitters_only[some] = np.where(counts, largest[near], 0).max(axis=1) <= NEAR
        return table

    def measure_rows(
        self, sites: Sites, rays: int, rows: NDArray[np.intp], wholes: Sequence[bool]
    ) -> list[EmitterTable]:
        """Measure at every site the light that arrives from every patch, for tables where several sites share a row.

        Args:
            sites: S sites.
            rays: shadow rays from each site.
            rows: (S,) row of each site, from 0.
            wholes: for each table, whether it includes all of the environment, or only what the cache does not hold.
        """
        count = int(rows.max(initial=-1)) + 1
        if not self.guided:
            return [self._untold(count) for _ in wholes]
        each, largest = self._received(sites, self._samples(rays), wholes)
        emitters_only = np.ones(count, bool)
        np.logical_and.at(emitters_only, rows, largest <= NEAR)
        return [EmitterTable(self._shares(_summed(part, rows, count)), emitters_only) for part in each]

    def _samples(self, rays: int) -> int:
        """Shadow rays from a site to each patch, given their total."""
        return min(max(rays // self._patches.count, 1), MOST_RAYS)

    def _shares(self, received: Floats) -> Floats:
        """(rows, patches) cumulative shares from (rows, 2 patches) of received light, with shadows and without."""
        shares = np.broadcast_to(SHARES[-1] * self._patches.alike, (len(received), self._patches.count))
        for share, part in zip(SHARES, np.split(received, 2, axis=1), strict=False):
            total = part.sum(axis=1, keepdims=True, dtype=np.float64)
            shares = shares + np.where(total > 0, share * part / np.where(total > 0, total, 1), 0)
        shares = shares / shares.sum(axis=1, keepdims=True)
        return np.cumsum(shares, axis=1).astype(np.float32)

    @staticmethod
    def _untold(count: int) -> EmitterTable:
        return EmitterTable(np.zeros((count, 0), np.float32), np.zeros(count, bool))

    def use(self, tables: Sequence[EmitterTable]) -> None:
        """Choose by the rows of these tables, one after the other."""
        if not self.guided:
            return
        # Each row begins with 0: the share of patches a to b is element b + 1 minus element a. An additional row is for
        # points without a site: there all emitters have equal shares.
        count = sum(len(table.shares) for table in tables)
        cumulative = np.zeros((count + 1, self._patches.count + 1), np.float32)
        begin = 0
        for shares in (*(table.shares for table in tables), np.cumsum(self._patches.alike)[None]):
            cumulative[begin : begin + len(shares), 1:] = shares
            begin += len(shares)
        cumulative[:, -1] = 1
        self._cumulative = upload(mi.Float, cumulative.ravel())
        self._unknown = dr.opaque(mi.UInt32, count)
        emitters_only = np.concatenate([*(table.emitters_only for table in tables), np.zeros(1, bool)])
        self._emitters_only = upload(mi.Bool, emitters_only)

    @property
    def unasked(self) -> list[mi.Emitter]:
        """Emitters that kernels never call: everything is read from tables."""
        return self._patches.unasked

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        rows = [self._cumulative, self._unknown, self._emitters_only] if self.guided else []
        return [*self._patches.arrays(), *rows]

    def row_at(self, si: mi.SurfaceInteraction3f, cached: mi.Bool, active: mi.Bool) -> mi.UInt32:
        """Row for a surface point without a record: none in this class.

        Args:
            si: the point.
            cached: whether a cache holds its part of the environment there, so that only the rest must be sampled.
            active: lanes.
        """
        del si, cached, active
        return mi.UInt32(NO_ROW)

    def emitters_only(self, row: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether emitter sampling is enough, without samples of a diffuse BSDF; False without a record."""
        if not self.guided:
            return mi.Bool(False)
        return dr.gather(mi.Bool, self._emitters_only, dr.minimum(row, self._unknown), active)

    def sample(
        self, si: mi.SurfaceInteraction3f, sample: mi.Point2f, row: mi.UInt32, active: mi.Bool
    ) -> EmitterSample:
        """Choose a patch by a row's shares and a direction to it, and trace a shadow ray.

        Args:
            si: where.
            sample: x selects the patch and is rescaled for reuse, so its strata serve both.
            row: of the table, or NO_ROW.
            active: lanes.
        """
        if self._patches.count == 0:
            return EmitterSample(dr.zeros(mi.DirectionSample3f), mi.Color3f(0), mi.Color3f(0))
        patch, share = mi.UInt32(0), mi.Float(1)
        if self.guided:
            base = self._base(row)
            patch = dr.binary_search(
                0,
                self._patches.count - 1,
                lambda i: dr.gather(mi.Float, self._cumulative, base + i + 1, active) <= sample.x,
            )
            before, share = self._share(base, patch, active)
            sample = mi.Point2f(dr.clip((sample.x - before) / share, 0, 1 - 2**-24), sample.y)
        ds, radiance = self._patches.sample(patch, si, sample, active)
        useful = active & (ds.pdf > 0) & dr.any(radiance != 0)
        arrives = self.arrives(si, ds, useful)
        lit = useful & dr.any(arrives != 0)
        ds.pdf = dr.select(lit, ds.pdf * share, 0)
        return EmitterSample(ds, dr.select(lit, radiance * arrives / ds.pdf, 0), radiance)

    def pdf(
        self,
        departure: mi.SurfaceInteraction3f,
        row: mi.UInt32,
        hit: mi.SurfaceInteraction3f,
        emitter: mi.EmitterPtr,
        active: mi.Bool,
    ) -> mi.Float:
        """The density, 1/sr, with which `sample` would draw the direction of a ray that hit an emitter.

        Args:
            departure: where the ray began.
            row: of the table there, or NO_ROW.
            hit: where the ray ends; invalid if it left the scene.
            emitter: the emitter that was hit.
            active: lanes.
        """
        if self._patches.count == 0:
            return mi.Float(0)
        towards = mi.DirectionSample3f(self._scene, hit, departure)
        patch, pdf = self._patches.find(departure, hit, emitter, towards, active)
        if not self.guided:
            return pdf
        return pdf * self._share(self._base(row), patch, active)[1]

    def _received(self, sites: Sites, samples: int, wholes: Sequence[bool]) -> tuple[list[Floats], Floats]:
        """Measure the light that sites receive.

        Returns:
            For each of `wholes`, luminance of direct irradiance by patch with shadows, then without, (S, 2 patches);
            and (S,) the largest solid angle that one sample stands for, steradians.
        """
        count, patches = len(sites.position), self._patches.count
        received = [np.zeros((count, 2 * patches), np.float32) for _ in wholes]
        largest = np.zeros(count, np.float32)
        batch = max(1, PATHS_AT_ONCE // (samples * patches))
        for begin in range(0, count, batch):
            part = slice(begin, begin + batch)
            some = Sites(*(array[part] for array in sites))
            columns = self._received_by(some, samples, begin, wholes)
            *each, solid_angle = np.split(columns, 2 * patches * np.arange(1, len(wholes) + 1), axis=1)
            for whole, values in zip(received, each, strict=True):
                whole[part] = values
            largest[part] = solid_angle.max(axis=1)
        return received, largest

    def _received_by(self, sites: Sites, samples: int, first: int, wholes: Sequence[bool]) -> Floats:
        """Columns of `_received` for some sites; `first` is the number of the first one among all."""
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
        ds, radiance = self._patches.sample(patch, si, numbers.sample_2d(Purpose.EMITTER), mi.Bool(True))
        sky = ds.emitter.is_environment()
        rest = dr.select(sky, 1 - self._environment.cached_fraction(radiance), 1)
        if not any(wholes):
            radiance *= rest
        cosine = dr.maximum(dr.dot(ds.d, n), 0)
        received = cosine * mi.luminance(radiance) / ds.pdf
        received = dr.select(dr.isfinite(received) & (ds.pdf > 0), received, 0)
        # Sky is never near.
        solid_angle = dr.select((received > 0) & ~ds.delta & ~sky, dr.rcp(ds.pdf), 0)
        arrives = self.arrives(si, ds, received > 0)
        shadowed = dr.select(received > 0, cosine * mi.luminance(radiance * arrives) / ds.pdf, 0)
        values = []
        for whole in wholes:
            part = 1 if whole or not any(wholes) else rest
            values += [shadowed * part, received * part]
        dr.eval(values, solid_angle)
        columns = [download(dr.block_sum(value, samples)) / np.float32(samples) for value in values]
        columns.append(download(dr.block_reduce(dr.ReduceOp.Max, solid_angle, samples)))
        return np.concatenate([column.reshape(points, -1) for column in columns], axis=1)

    def arrives(self, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of an emitter's light that arrives: 0 in shadow and in inactive lanes."""
        if self.panes.some:
            return self.panes.between(si, ds.p, active)
        shadowed = self._scene.ray_test(si.spawn_ray_to(ds.p), active)
        return dr.select(active & ~shadowed, mi.Color3f(1), 0)

    def _base(self, row: mi.UInt32) -> mi.UInt32:
        return dr.minimum(row, self._unknown) * (self._patches.count + 1)

    def _share(self, base: mi.UInt32, patch: mi.UInt32, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Cumulative share before a patch, and the patch's own."""
        lower = dr.gather(mi.Float, self._cumulative, base + patch, active)
        upper = dr.gather(mi.Float, self._cumulative, base + patch + 1, active)
        return lower, dr.maximum(upper - lower, 1e-7)


def _summed(received: Floats, rows: NDArray[np.intp], count: int) -> Floats:
    """Sums of (S, n) by row, (count, n)."""
    columns = (np.bincount(rows, column, count) for column in received.T)
    return np.stack(list(columns), axis=1).astype(np.float32)


def _mean(received: Floats, near: NDArray[np.int32], counts: NDArray[np.bool_]) -> Floats:
    """(P, n) means of the (S, n) rows over the neighbours of each of P sites: (P, k) rows `near` where `counts` is set.

    A single site easily misses a slit of a window.
    """
    weight = counts.astype(np.float32)
    mean = np.zeros((len(near), received.shape[1]), np.float32)
    for k in range(weight.shape[1]):
        mean += weight[:, k, None] * received[near[:, k]]
    mean /= weight.sum(axis=1, keepdims=True)
    return mean
