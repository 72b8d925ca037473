"""Where rays from a surface begin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

OWN = 1 / 8
"""Rays start at a small offset from a surface. Hits within this fraction of the offset are taken for that surface."""

ROUNDED = 2**-21
"""Rounding error of a point's position, relative to the scene's largest coordinate: four units in the last place."""


def ray_offset(p: mi.Point3f) -> mi.Float:
    """Offset of ray origins from a surface, metres; the same as Mitsuba's own."""
    far = dr.maximum(dr.abs(p.x), dr.maximum(dr.abs(p.y), dr.abs(p.z)))
    return mi.Float((1 + far) * mi.math.RayEpsilon)


def off_surface(scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> mi.Point3f:
    """Origins of rays from records: just off the surface, but not beyond the next one.

    At the foot of a pot, where the normal points down, the floor may be nearer than the usual offset. Starting beyond
    it, a record would measure the light below the floor.

    Args:
        scene: mi.Scene.
        p: position of the record, on its surface.
        n: unit normal, on the record's side.
    """
    away, far = mi.Vector3f(n), ray_offset(p)
    box = scene.bbox()
    extent = float(np.abs([box.min, box.max]).max())
    # Any nearer, the ray might hit the surface itself, since points on it are rounded.
    near = dr.maximum(OWN * far, dr.opaque(mi.Float, extent * ROUNDED))
    ray = mi.Ray3f(p + away * near, away)
    ray.maxt = far - near
    hit = scene.ray_intersect_preliminary(ray, coherent=False, active=near < far)
    between = (near + hit.t) / 2
    return mi.Point3f(p + away * dr.select(hit.is_valid(), between, far))
