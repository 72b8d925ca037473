"""Irradiance by caustic photons where paths of a gather meet surfaces.

The records that frames look up know their caustics (`CausticMap`). Those of the secondary cache do not: they are too
coarse. A few of them would stand for the sill of a frosted window, the brightest surface of the room, and one outside
of a recess would tell a path of the caustics of the open. So the kernel itself estimates the density of photons at the
very place. A path averages over hundreds of places, and no power may be lost at the edges of sills and bars.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.records.discs import ALIKE, surface_under
from steadylight.renderers.mitsuba.records.photons import Photons
from steadylight.renderers.mitsuba.upload import upload

MOST = 16
"""Maximum number of photons in a bucket of the grid; where there are more, these stand for all. It bounds the time."""

FLAT = 0.5
"""Maximum distance of photons from the plane of a disc, as a part of its radius: more than that of a record's disc, as
curved things are met too."""

RAYS = 8
"""Rays that measure which part of a photon's disc is surface."""

_AT_ONCE = 1 << 17  # photons whose rays are traced together
_ROW = 12  # floats: position, normal, power, and three of padding
_PRIMES = (73856093, 19349663, 83492791)  # Teschner et al. 2003, "Optimized Spatial Hashing"


class PhotonGrid:
    """Photons in the cells of a grid, hashed into buckets, as device arrays. All grids share a kernel.

    Attributes:
        radius: Float, of the discs, metres.
        cells_per_metre: Float. Cells are twice as wide as the discs' radius.
        mask: UInt32, number of buckets - 1.
        first: UInt32, by bucket, its first row; one more for the end of the last.
        rows: Float, _ROW for each photon.
    """

    def __init__(self, photons: Photons | None, radius: float = 1.0, scene: mi.Scene | None = None) -> None:
        """Sort the photons into the grid.

        Args:
            photons: in a random order; None if there are none.
            radius: of the discs, metres.
            scene: tells which part of each photon's disc is surface; all of it is if None.
        """
        if photons is None:
            none = np.zeros((0, 3), np.float32)
            photons = Photons(none, none, none)
        count = len(photons.position)
        buckets = 1 << max(count, 1).bit_length()
        cells_per_metre = np.float32(1 / (2 * radius))  # the very number that the kernel multiplies by
        cells = np.floor(photons.position * cells_per_metre).astype(np.int32).view(np.uint32)
        x, y, z = (cells * np.array(_PRIMES, np.uint32)).T
        bucket = (x ^ y ^ z) & np.uint32(buckets - 1)
        there = np.bincount(bucket, minlength=buckets)
        order = np.argsort(bucket, kind="stable")
        rank = np.arange(count) - np.repeat(np.cumsum(there) - there, there)
        order = order[rank < MOST]
        kept = np.minimum(there, MOST)
        power = photons.power[order] * (there / np.maximum(kept, 1))[bucket[order], None]
        if scene is not None and len(order):
            part = _part_that_is_surface(scene, photons.position[order], photons.normal[order], radius)
            power = power / part[:, None]
        rows = np.zeros((max(len(order), 1), _ROW), np.float32)
        rows[: len(order), :9] = np.hstack([photons.position[order], photons.normal[order], power])
        self.radius, self.mask = dr.opaque(mi.Float, radius), dr.opaque(mi.UInt32, buckets - 1)
        self.cells_per_metre = dr.opaque(mi.Float, float(cells_per_metre))
        self.first = upload(mi.UInt32, np.append(0, np.cumsum(kept)).astype(np.uint32))
        self.rows = upload(mi.Float, rows.ravel())

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this object, for `frozen`."""
        return [self.radius, self.cells_per_metre, self.mask, self.first, self.rows]

    @dr.syntax
    def irradiance(self, position: mi.Point3f, normal: mi.Normal3f, active: mi.Bool) -> mi.Color3f:
        """Irradiance at surface points, W/m²: each photon spreads its power over its disc (Epanechnikov's kernel).

        At an edge, it spreads it over what is there of the disc, so that no power is lost.

        Args:
            position: world, metres.
            normal: unit, on the lit side.
            active: lanes that ask.
        """
        corner = dr.floor(position * self.cells_per_metre - 0.5)  # of the eight cells that the disc may reach
        total, k = mi.Color3f(0), mi.UInt32(0)
        while active & (k < 8):
            step = mi.Vector3f(mi.Float(k & 1), mi.Float((k >> 1) & 1), mi.Float(k >> 2))
            cell = mi.Vector3f(corner) + step
            row, end = self._rows_in(cell, active)
            while active & (row < end):
                total += self._from(row, cell, position, normal)
                row += 1
            k += 1
        return total * 2 * dr.inv_pi / dr.square(self.radius)

    def _rows_in(self, cell: mi.Vector3f, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """The first row of the bucket of a cell, and one past the last."""
        x, y, z = (mi.UInt32(mi.Int32(part)) * prime for part, prime in zip(cell, _PRIMES, strict=True))
        bucket = (x ^ y ^ z) & self.mask
        row, end = (dr.gather(mi.UInt32, self.first, bucket + i, active) for i in (0, 1))
        return row, end

    def _from(
        self, row: mi.UInt32, cell: mi.Vector3f, position: mi.Point3f, normal: mi.Normal3f
    ) -> mi.Color3f:
        """Weighted power of a photon; black unless it lies in the cell: others may share the bucket."""
        a = dr.gather(mi.Vector4f, self.rows, 3 * row)
        p = mi.Point3f(a.x, a.y, a.z)
        offset = p - position
        apart = dr.squared_norm(offset) / dr.square(self.radius)
        near = (apart < 1) & dr.all(dr.floor(p * self.cells_per_metre) == cell)
        near &= dr.abs(dr.dot(offset, normal)) < FLAT * self.radius
        b, c = (dr.gather(mi.Vector4f, self.rows, 3 * row + i, near) for i in (1, 2))
        near &= a.w * normal.x + b.x * normal.y + b.y * normal.z > ALIKE
        return dr.select(near, mi.Color3f(b.z, b.w, c.x) * (1 - apart), 0)


def _part_that_is_surface(scene: mi.Scene, position: Floats, normal: Floats, radius: float) -> Floats:
    """(P,) the part of the disc around each photon on which its power can arrive, by Epanechnikov's kernel.

    Args:
        scene: mi.Scene.
        position: (P, 3) of the photons, world, metres.
        normal: (P, 3) of their surfaces, unit.
        radius: of the discs, metres.
    """
    parts = []
    for begin in range(0, len(position), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        lane = dr.arange(mi.UInt32, len(position[some]) * RAYS)
        photon = lane // RAYS
        number = mi.Float(lane - photon * RAYS) + 0.5
        turn, _ = mi.sample_tea_32(photon, mi.UInt32(0))
        # Equal parts of the kernel's weight: 1 - (1 - x)² of it lies within the part x of the area.
        out = dr.sqrt(1 - dr.sqrt(1 - number / RAYS))
        sine, cosine = dr.sincos(number * (dr.pi * (3 - 5**0.5)) + mi.Float(turn) * (2 * dr.pi * 2.0**-32))
        p = dr.gather(mi.Point3f, upload(mi.Point3f, position[some]), photon)
        n = dr.gather(mi.Normal3f, upload(mi.Normal3f, normal[some]), photon)
        across = mi.Frame3f(n).to_world(mi.Vector3f(out * cosine, out * sine, FLAT))
        there = surface_under(scene, p + radius * across, n, FLAT * radius)
        parts.append(np.array(dr.block_sum(dr.select(there, mi.Float(1), 0), RAYS)))
    return np.asarray(np.maximum(np.concatenate(parts), 1) / np.float32(RAYS), np.float32)
