"""Materials of a USD stage: selects the network of a material, and collects what meshes need."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from steadylight.scenes.description import Note
from steadylight.scenes.pbr import Finish, Materials
from steadylight.scenes.surface import Surface, VertexColour
from steadylight.scenes.usd.inputs import Inputs
from steadylight.scenes.usd.networks import Network, names_of, node_of
from steadylight.scenes.usd.stage import Stage, label
from steadylight.scenes.usd.surfaces import SURFACES
from steadylight.scenes.usd.values import NotPlain


@dataclass(frozen=True)
class Painted:
    """A material as meshes need it.

    Attributes:
        finish: BSDF and emitter.
        surface: the surface that they were made from.
        uv: name of the texture coordinates that it uses; None for the first.
    """

    finish: Finish
    surface: Surface
    uv: str | None


@dataclass
class Palette:
    """The materials of a stage, each made once.

    Attributes:
        stage: the stage.
        materials: entries of the materials.
        notes: notes on what was left out.
    """

    stage: Stage
    materials: Materials
    notes: list[Note] = field(default_factory=list)
    _painted: dict[Any, Painted] = field(default_factory=dict)

    def of(self, prim: Any, *, colored: bool, glow: tuple[float, float, float] | None = None) -> Painted:
        """The material bound to a prim; without one, its display colour.

        Args:
            prim: a mesh, a shape or a subset of a mesh.
            colored: whether the mesh has vertex colours.
            glow: radiance to add, if the mesh is a light.
        """
        from pxr import UsdShade

        bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(UsdShade.Tokens.full)[0]
        colour: Any = None
        if not bound:
            colour = VertexColour() if colored else _display_colour(prim, self.stage.start)
            if _is_see_through(prim, self.stage.start):
                self.notes.append(Note("left out", label(prim), "its displayOpacity; give it a material"))
        key = (str(bound.GetPath()) if bound else "", colour if isinstance(colour, tuple) else colored, glow)
        if key not in self._painted:
            if bound:
                surface, uv = self._surface(bound)
            else:
                surface, uv = Surface("without a material", base_color=colour, specular=0.0), None
            if glow is not None:
                base = surface.emission if isinstance(surface.emission, tuple) else (0.0, 0.0, 0.0)
                r, g, b = (np.array(base) + glow).tolist()
                surface = replace(surface, emission=(r, g, b))
            self._painted[key] = Painted(self.materials.finish(surface), surface, uv)
        return self._painted[key]

    def _surface(self, material: Any) -> tuple[Surface, str | None]:
        """Surface of a material, and its texture coordinates, from the MaterialX network, or else the universal one."""
        name = _name(material)
        found: list[tuple[str, Any]] = []
        for context in ("mtlx", ""):
            source = material.ComputeSurfaceSource(context)
            shader = source[0] if isinstance(source, tuple) else source
            if shader and (node_of(shader) in SURFACES) and shader not in [made for _, made in found]:
                found.append((node_of(shader), shader))
        if not found:
            self._note(name, "left out", "has no supported surface; a grey, matt one is used")
            return Surface(name, specular=0.0), None
        lost: list[str] = []
        network = Network(self.stage.assets, f"material {name}")
        preview = found[-1] if len(found) > 1 else None
        other = (
            Inputs(network, preview[1], None, []) if preview and preview[0] == "UsdPreviewSurface" else None
        )
        inputs = Inputs(network, found[0][1], other, lost)
        try:
            surface = SURFACES[found[0][0]](inputs, name)
        except NotPlain as reason:
            if preview is None:
                self._note(name, "left out", f"{reason}; a grey, matt surface is used")
                return Surface(name, specular=0.0), None
            self._note(name, "approximated", f"{reason}; its UsdPreviewSurface is used")
            inputs = Inputs(network, preview[1], None, lost)
            surface = SURFACES[preview[0]](inputs, name)
        for text in dict.fromkeys(lost):
            self._note(name, "left out", text)
        sets = names_of(inputs.used)
        if len(sets) > 1:
            self._note(
                name, "approximated", f"of the texture coordinates {', '.join(sets)} only the first are used"
            )
        if material.GetDisplacementOutput() and material.ComputeDisplacementSource()[0]:
            self._note(name, "left out", "its displacement")
        return surface, sets[0] if sets else None

    def _note(self, name: str, kind: Any, text: str) -> None:
        self.notes.append(Note(kind, f"material {name}", text))


def _name(material: Any) -> str:
    given = material.GetPrim().GetAttribute("userProperties:blender:data_name")
    return str(given.Get()) if given and given.Get() else str(material.GetPrim().GetName())


def _is_see_through(prim: Any, time: Any) -> bool:
    """Whether a prim has a display opacity below 1."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity")
    values = primvar.Get(time) if primvar and primvar.HasValue() else None
    return values is not None and len(values) > 0 and min(values) < 1


def _display_colour(prim: Any, time: Any) -> tuple[float, float, float]:
    """The constant display colour of a prim; grey without one."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
    values = primvar.Get(time) if primvar and primvar.HasValue() else None
    if values is not None and len(values):
        r, g, b = (float(np.clip(part, 0.0, 1.0)) for part in values[0])
        return r, g, b
    return 0.5, 0.5, 0.5
