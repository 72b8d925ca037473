"""Casters: shapes that send light on without a diffuse lobe. Photons carry their caustics (`records.photons`)."""

from __future__ import annotations

from collections.abc import Iterable

import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.bsdf.tables import is_in, table_of

SAMPLED = ("Sphere", "Rectangle", "Disk", "Cylinder")
"""Mitsuba classes of shapes, besides meshes, on which points can be drawn."""


class Casters:
    """The casters of a scene. Not a dataclass: kernels read it, but it is not one of their loop variables.

    A caster has a BSDF with delta lobes, or without a diffuse lobe. Light that shapes in groups, emitters and curves
    cast is left to paths from records.

    Attributes:
        number: (C,) numbers of the casters in `scene.shapes()`.
        area: (C,) m².
        table: of their BSDFs; None if there are none.
    """

    def __init__(self, scene: mi.Scene, nodes: Iterable[mi.Object], bsdfs: Iterable[mi.BSDF]) -> None:
        """Find them.

        Args:
            scene: mi.Scene.
            nodes: all objects of the scene.
            bsdfs: of all shapes, those in groups included.
        """
        shapes = scene.shapes()
        places = [k for k, shape in enumerate(shapes) if _can_be_sampled(shape) and not shape.is_emitter()]
        sampled = {shapes[k] for k in places}
        # A table of BSDFs cannot tell two shapes of one BSDF apart.
        others = {node.bsdf() for node in nodes if isinstance(node, mi.Shape) and node not in sampled}
        casting = [bsdf for bsdf in bsdfs if bsdf not in others and _casts(bsdf)]
        places = [k for k in places if shapes[k].bsdf() in casting]
        self.number = np.array(places, np.uint32)
        self.area = np.array([float(mi.Float(shapes[k].surface_area())[0]) for k in places])
        self.table = table_of(bsdfs, casting)

    def scatters(self, bsdf: mi.BSDFPtr, sample: mi.BSDFSample3f) -> mi.Bool:
        """Whether a sample of a BSDF carries caustics on: a delta lobe, or a BSDF without a diffuse lobe."""
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        return delta | self.is_never_diffuse(bsdf)

    def is_never_diffuse(self, bsdf: mi.BSDFPtr) -> mi.Bool:
        """Whether BSDFs have no diffuse lobe."""
        return ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)

    def cast(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether BSDFs are those of casters; False in inactive lanes."""
        return is_in(self.table, bsdf, active)


def _can_be_sampled(shape: mi.Shape) -> bool:
    return isinstance(shape, mi.Mesh) or shape.class_name() in SAMPLED


def _casts(bsdf: mi.BSDF) -> bool:
    scattering = int(bsdf.flags()) & int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Null)
    diffuse = scattering & int(mi.BSDFFlags.Diffuse)
    return bool(scattering & int(mi.BSDFFlags.Delta) if diffuse else scattering)
