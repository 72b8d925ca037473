"""Irradiance by caustic photons where paths meet surfaces without a record of their own.

Records know their caustics (`CausticMap`). But a path also meets surfaces too near to its start or too far from any
record, such as a recess in a window frame; a record outside would tell it of the caustics of the open. There, the
kernel itself estimates the density of photons.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.records.discs import ALIKE
from steadylight.renderers.mitsuba.records.photons import Photons
from steadylight.renderers.mitsuba.upload import upload

MOST = 16
"""Maximum number of photons in a bucket of the grid; where there are more, these stand for all. It bounds the time."""

FLAT = 0.5
"""Maximum distance of photons from the plane of a disc, as a part of its radius: more than that of a record's disc, as
curved things are met too."""

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

    def __init__(self, photons: Photons | None, radius: float = 1.0) -> None:
        """Sort the photons into the grid.

        Args:
            photons: in a random order; None if there are none.
            radius: of the discs, metres.
        """
        if photons is None:
            none = np.zeros((0, 3), np.float32)
            photons = Photons(none, none, none)
        count = len(photons.position)
        buckets = 1 << max(count // 4, 1).bit_length()
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
        """Irradiance at surface points, W/m² (Epanechnikov's kernel on a disc).

        At an edge or a wall, part of the disc is not there: darker by up to half, within its small radius.

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
