"""What light goes straight through: thin glass, null surfaces, and what a mask leaves open.

Light that is neither bent nor scattered arrives as if nothing were there, but for the part that is lost. So a pane is
no vertex between a surface and an emitter: shadow rays go on behind it, with the product of the transmittances, and
rays that look for emitters look behind it, weighted against emitter samples at the surface that they left. What a pane
reflects, and what it shows to the camera, is another matter: there it is a surface like any other.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

MOST_PANES = 256
"""Panes, one behind the other, that light goes straight through, at most. Nobody stacks so much glass; among leaves
that are cut out by masks, a ray seldom meets more. What is behind the last is dark: for shadow rays and for rays that
look for emitters alike."""


class Beyond(NamedTuple):
    """What a ray meets behind panes.

    Attributes:
        si: the first surface that is no pane, or none.
        transmittance: of all panes before it, in [0, 1].
        distance: from the start of the ray, metres; infinite if there is no surface.
    """

    si: mi.SurfaceInteraction3f
    transmittance: mi.Color3f
    distance: mi.Float


class Panes:
    """The panes of one scene. No dataclass: kernels read it, and it is not their variable.

    Surfaces that shine are no panes, whatever their BSDF lets through: rays that look for emitters end there.

    Attributes:
        some: whether there are any, so that kernels can leave out what serves them.
    """

    def __init__(self, scene: mi.Scene) -> None:
        """Look through the BSDFs of a scene."""
        self._scene = scene
        bsdfs = {shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}
        self.some = any(int(bsdf.flags()) & int(mi.BSDFFlags.Null) for bsdf in bsdfs)

    def transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of the light that goes straight through surfaces; 0 for what is no pane.

        A BSDF that lets light through and cannot say how much (`bumpmap` over glass) is no pane either.
        """
        bsdf = si.bsdf()
        through = active & si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        through &= ~si.shape.is_emitter()
        return dr.select(through, bsdf.eval_null_transmission(si, through), 0)

    @dr.syntax
    def between(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of the light that arrives from a point: 1 in the open, 0 in shadow or where not active.

        Args:
            si: where it arrives.
            target: world, metres.
            active: lanes.
        """
        ray = si.spawn_ray_to(target)
        # ---- variables of the loop -------------------------------------------------------
        transmittance = mi.Color3f(1)
        goes = mi.Bool(active)
        met = mi.UInt32(0)
        while goes:
            hit = self._scene.ray_intersect_preliminary(ray, coherent=False, active=goes)
            goes &= hit.is_valid()
            # Only what may be a pane is looked at closely.
            through = goes & mi.has_flag(hit.shape.bsdf().flags(), mi.BSDFFlags.Null) & (met < MOST_PANES)
            pane = hit.compute_surface_interaction(ray, mi.RayFlags.All, through)
            transmittance *= dr.select(goes, self.transmission(pane, through), 1)
            goes &= dr.any(transmittance != 0)
            ray = pane.spawn_ray_to(target)
            met += 1
        return dr.select(active, transmittance, 0)

    @dr.syntax
    def beyond(
        self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, through: mi.Color3f, active: mi.Bool
    ) -> Beyond:
        """What a ray meets behind panes; all as it is where not active.

        Args:
            si: where it met the first surface.
            direction: of the ray, world.
            through: `transmission` of that surface.
            active: lanes.
        """
        # ---- variables of the loop -------------------------------------------------------
        si = mi.SurfaceInteraction3f(si)
        through = mi.Color3f(through)
        transmittance = mi.Color3f(1)
        distance = mi.Float(si.t)
        goes = active & dr.any(through != 0)
        met = mi.UInt32(0)
        while goes:
            transmittance *= through
            si = self._scene.ray_intersect(si.spawn_ray(direction), mi.RayFlags.All, False, goes)
            distance += si.t
            met += 1
            through = self.transmission(si, goes & (met < MOST_PANES))
            goes &= dr.any(through != 0)
        return Beyond(si, transmittance, distance)
