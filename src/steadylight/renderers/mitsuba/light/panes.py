"""Surfaces that light passes straight through: thin glass, null surfaces, and the open part of masks.

Light that is neither refracted nor scattered arrives as if nothing were there, but attenuated. A pane between a surface
and an emitter is therefore not a vertex: shadow rays continue behind it, with the product of the transmittances, and
rays that look for emitters look behind it, weighted against emitter samples at the surface that they left. For what a
pane reflects, and for what it shows to the camera, it is a surface like any other.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits, bsdfs_of

MOST_PANES = 256
"""Maximum number of panes, one behind the other, that light passes straight through. Nobody stacks so much glass; among
leaves cut out by masks, a ray seldom meets more. What is behind the last is dark, both for shadow rays and for rays
that look for emitters."""


class Beyond(NamedTuple):
    """What a ray meets behind panes.

    Attributes:
        si: the first surface that is not a pane; invalid if there is none.
        transmittance: of all panes in front of it, in [0, 1].
        distance: from the origin of the ray, metres; infinite if there is no surface.
    """

    si: mi.SurfaceInteraction3f
    transmittance: mi.Color3f
    distance: mi.Float


class Panes:
    """The panes of a scene. Not a dataclass: kernels read it, but it is not one of their loop variables.

    Optionally, each face of solid clear glass counts as a pane too: an approximation that the user may choose. Emitters
    are never panes, whatever their BSDF transmits: rays that look for emitters end there.

    Attributes:
        some: whether there are any, so that kernels can omit the code for them.
    """

    def __init__(self, scene: mi.Scene, solid: BSDFTraits | None = None) -> None:
        """Inspect the BSDFs of a scene.

        Args:
            scene: the scene.
            solid: of this scene, to treat its solid clear glass as panes too: exact for two parallel faces, except for
                the lateral shift of light.
        """
        self._scene = scene
        self._solid = None if solid is None or solid.dielectric is None else solid
        holes = any(
            int(bsdf.flags()) & int(mi.BSDFFlags.Null) for bsdf in bsdfs_of(mi.traverse(scene).hierarchy)
        )
        self.some = holes or self._solid is not None

    def arrays(self) -> list[mi.Bool]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        return [] if self._solid is None else [self._solid.dielectric]

    def transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of the light that passes straight through surfaces; 0 if a surface is not a pane.

        A BSDF that transmits but does not report how much (`bumpmap` over glass) is not a pane either.
        """
        bsdf = si.bsdf()
        clear = active & si.is_valid() & ~si.shape.is_emitter()
        through = clear & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        fraction = dr.select(through, bsdf.eval_null_transmission(si, through), 0)
        if self._solid is None:
            return fraction
        # Evaluated from outside in either direction: at parallel faces, light enters and leaves at the same angle. The
        # first random number selects the lobe (see `lobes`); in importance mode, radiance is not scaled by eta².
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
        """Whether a path leaves a pane in the direction that is treated as straight."""
        straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if self._solid is None:
            return straight
        return straight | mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)

    @dr.syntax
    def between(self, si: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool) -> mi.Color3f:
        """Fraction of the light that arrives from a point: 1 in the open, 0 in shadow and in inactive lanes.

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
            # Only a possible pane needs its full surface interaction.
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
        """What a ray meets behind panes; unchanged in inactive lanes.

        Args:
            si: the first surface that it met.
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
