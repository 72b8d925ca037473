"""Where rays from a surface begin."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits

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


@dataclass
class Hemispheres:
    """Where the paths of each record begin.

    The normals of a smooth mesh are interpolated, and part of a record's hemisphere may lie below its surface. As in
    Mitsuba, paths in these directions begin below.

    Attributes:
        origin: just off the surface.
        normal: unit, of the hemisphere.
        surface: unit geometric normal, on the side of `normal`.
        below: just below the surface.
        bsdf: Mitsuba's registry number of the surface's BSDF; 0 if it was not found.
    """

    origin: mi.Point3f
    normal: mi.Normal3f
    surface: mi.Normal3f
    below: mi.Point3f
    bsdf: mi.UInt32

    @classmethod
    def above(cls, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Hemispheres:
        """Hemispheres of points on surfaces.

        Args:
            scene: mi.Scene.
            p: the points.
            n: unit normals, on the lit side.
        """
        origin = off_surface(scene, p, n)
        back = mi.Ray3f(origin, -mi.Vector3f(n))
        back.maxt = 2 * dr.norm(origin - p)
        met = scene.ray_intersect_preliminary(back, coherent=False)
        si = met.compute_surface_interaction(back, mi.RayFlags.Minimal)
        surface = mi.Normal3f(dr.select(met.is_valid(), dr.mulsign(si.n, dr.dot(si.n, n)), n))
        below = mi.Point3f(p - mi.Vector3f(surface) * ray_offset(p))
        return cls(origin, mi.Normal3f(n), surface, below, dr.reinterpret_array(mi.UInt32, si.bsdf()))

    def ray(self, record: mi.UInt32, d: mi.Vector3f) -> tuple[mi.Ray3f, mi.Bool]:
        """A ray from a record, and whether it leaves below the surface.

        Args:
            record: index of the hemisphere.
            d: unit direction within it.
        """
        beneath = dr.dot(d, dr.gather(mi.Normal3f, self.surface, record)) < 0
        origin = dr.gather(mi.Point3f, self.origin, record)
        below = dr.gather(mi.Point3f, self.below, record)
        return mi.Ray3f(dr.select(beneath, below, origin), d), beneath

    def transmittance(self, bsdfs: BSDFTraits, record: mi.UInt32, cosine: mi.Float) -> mi.Float:
        """Weight of light at this cosine of incidence; see `BaseTransmittance`."""
        if bsdfs.base_transmittance is None:
            return mi.Float(1)
        return bsdfs.base_transmittance.at(dr.gather(mi.UInt32, self.bsdf, record), cosine)
