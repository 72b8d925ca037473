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

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits, bsdfs_of

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

    Solid clear glass may be taken for panes as well, each of its faces for one: an approximation that the user chooses.
    Surfaces that shine are no panes, whatever their BSDF lets through: rays that look for emitters end there.

    Attributes:
        some: whether there are any, so that kernels can leave out what serves them.
    """

    def __init__(self, scene: mi.Scene, solid: BSDFTraits | None = None) -> None:
        """Look through the BSDFs of a scene.

        Args:
            scene: whose panes.
            solid: of this scene, if its solid clear glass is taken for panes, too: exact for two parallel faces, but
                that light is not set off sideways.
        """
        self._scene = scene
        self._solid = None if solid is None or solid.dielectric is None else solid
        holes = any(
            int(bsdf.flags()) & int(mi.BSDFFlags.Null) for bsdf in bsdfs_of(mi.traverse(scene).hierarchy)
        )
        self.some = holes or self._solid is not None

    def arrays(self) -> list[mi.Bool]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        return [] if self._solid is None else [self._solid.dielectric]

    def transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of the light that goes straight through surfaces; 0 for what is no pane.

        A BSDF that lets light through and cannot say how much (`bumpmap` over glass) is no pane either.
        """
        bsdf = si.bsdf()
        clear = active & si.is_valid() & ~si.shape.is_emitter()
        through = clear & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        fraction = dr.select(through, bsdf.eval_null_transmission(si, through), 0)
        if self._solid is None:
            return fraction
        # Seen from outside, whichever way light goes: at parallel faces it enters and leaves at the same angle. The
        # first random number decides (see `lobes`), and as importance, transmitted light is not compressed.
        solid = clear & ~through & self._solid.is_dielectric(bsdf, clear)
        outside = mi.SurfaceInteraction3f(si)
        outside.wi.z = dr.abs(si.wi.z)
        context = mi.BSDFContext()
        context.mode = mi.TransportMode.Importance
        number = dr.one_minus_epsilon(mi.Float)
        bs, weight = bsdf.sample(context, outside, mi.Float(number), mi.Point2f(0.5), solid)
        solid &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
        return dr.select(solid, weight * bs.pdf, fraction)

    def transmits(self, bs: mi.BSDFSample3f) -> mi.Bool:
        """Whether a path that leaves a pane so goes where light is taken to go straight."""
        straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if self._solid is None:
            return straight
        return straight | mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)

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
            bsdf = hit.shape.bsdf()
            through = goes & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            if dr.hint(self._solid is not None, mode="scalar"):
                through |= self._solid.is_dielectric(bsdf, goes)
            through &= met < MOST_PANES
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
