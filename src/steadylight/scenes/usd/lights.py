"""Converts UsdLux lights to Mitsuba emitters.

A light of intensity 1 has radiance 1, since UsdLux says that it gives a pixel of value 1. Lights are opaque and black.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from steadylight.scenes.description import Note
from steadylight.scenes.environment import Sun, with_suns
from steadylight.scenes.pbr import Materials, rgb, unique
from steadylight.scenes.surface import Texture
from steadylight.scenes.usd.domes import Domes
from steadylight.scenes.usd.lux import Light, Matrix, rotation
from steadylight.scenes.usd.stage import Stage, label

_BLACK: Final = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}}
_FACING: Final = np.diag([-1.0, 1.0, -1.0, 1.0])
"""From Mitsuba's flat shapes, which face +z, to UsdLux's lights, which face -z."""
_UPSIDE_DOWN: Final = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
_POINT: Final = 1e-6
"""Radius below which a light is a point, metres."""

KINDS: Final = (
    "RectLight",
    "DiskLight",
    "SphereLight",
    "CylinderLight",
    "DistantLight",
    "DomeLight",
    "DomeLight_1",
)
_UNKNOWN: Final = ("PortalLight", "GeometryLight", "PluginLight")


@dataclass
class Lights:
    """The lights of a stage.

    Attributes:
        stage: the stage.
        materials: for the textures of rectangular lights.
        entries: emitters and emitting shapes, by name.
        notes: notes on what was changed.
    """

    stage: Stage
    materials: Materials
    entries: dict[str, Any] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._domes = Domes(self.stage)
        self._suns: list[Sun] = []

    def add(self, prim: Any, to_world: Matrix) -> bool:
        """Add a light; False if the prim is not a light."""
        kind = str(prim.GetTypeName())
        if kind in _UNKNOWN:
            self._note("left out", prim, f"{kind}, which is not supported")
            return True
        if kind not in KINDS:
            return False
        light = Light(self.stage, prim, to_world)
        self._mention_extras(prim)
        made = getattr(self, f"_{kind.removesuffix('_1').removesuffix('Light').lower()}")(light)
        if made is not None:
            self.entries[unique(f"light {label(prim)}", self.entries)] = made
        return True

    def emission(self, prim: Any) -> tuple[float, float, float]:
        """Radiance of a mesh that is a light (MeshLightAPI)."""
        light = Light(self.stage, prim, np.eye(4))
        if light.get("normalize", False):
            self._note("approximated", prim, "its brightness is not divided by its area")
        r, g, b = light.radiance.tolist()
        return r, g, b

    def _note(self, kind: Any, prim: Any, text: str) -> None:
        self.notes.append(Note(kind, label(prim), text))

    def _mention_extras(self, prim: Any) -> None:
        """Note properties that our emitters do not support."""
        from pxr import UsdLux

        for name in ("diffuse", "specular"):
            value = prim.GetAttribute(f"inputs:{name}").Get(self.stage.start)
            if value is not None and value != 1:
                self._note(
                    "left out",
                    prim,
                    f"its factor {value:g} for {name} light; diffuse and specular light are not separated",
                )
        if prim.GetAttribute("inputs:shadow:enable").Get(self.stage.start) is False:
            self._note("left out", prim, "its setting to cast no shadows")
        if prim.GetRelationship("light:filters").GetTargets():
            self._note("left out", prim, "its light filters")
        if prim.HasAPI("CollectionAPI") and UsdLux.LightAPI(prim):
            for link in ("lightLink", "shadowLink"):
                root = prim.GetAttribute(f"collection:{link}:includeRoot").Get()
                if root is False or prim.GetRelationship(f"collection:{link}:excludes").GetTargets():
                    self._note("left out", prim, f"its {link}: it lights everything")

    def _rect(self, light: Light) -> dict[str, Any]:
        width, height = light.size("width", 1.0), light.size("height", 1.0)
        to_world = light.to_world @ np.diag([width / 2, height / 2, 1.0, 1.0]) @ _FACING
        radiance: Any = rgb(self._radiance(light, light.area(width * height)))
        asset = light.get("texture:file", None)
        source = self.stage.assets.source(asset, label(light.prim)) if asset and asset.path else None
        if source is not None:
            gain = self._radiance(light, light.area(width * height))
            radiance = self.materials.texture(
                Texture(source, srgb=_is_encoded(asset), gain=gain, wrap="clamp", to_uv=_UPSIDE_DOWN)
            )
        self._mention_shaping(light)
        return _shining({"type": "rectangle", "to_world": to_world}, radiance)

    def _disk(self, light: Light) -> dict[str, Any]:
        radius = light.size("radius", 0.5)
        to_world = light.to_world @ np.diag([radius, radius, 1.0, 1.0]) @ _FACING
        self._mention_shaping(light)
        return _shining(
            {"type": "disk", "to_world": to_world},
            rgb(self._radiance(light, light.area(math.pi * radius**2))),
        )

    def _sphere(self, light: Light) -> dict[str, Any] | None:
        scale = float(np.prod(light.scale) ** (1 / 3))
        if not np.allclose(light.scale, scale, rtol=1e-3):
            self._note("approximated", light.prim, "a stretched sphere: becomes one of the mean radius")
        radius = light.size("radius", 0.5) * scale
        point = bool(light.prim.GetAttribute("treatAsPoint").Get()) or radius < _POINT
        centre = light.to_world[:3, 3]
        # Intensity is radiance times the area of the outline; if normalized, it does not depend on the radius.
        stage_radius = radius / self.stage.unit
        if light.normalized:
            intensity = light.radiance / 4 * self.stage.unit**2
            radiance = light.radiance / (4 * math.pi * max(stage_radius, 1e-30) ** 2)
        else:
            intensity = light.radiance * math.pi * radius**2
            radiance = light.radiance
        if not intensity.any():
            self._note("left out", light.prim, "its radius or intensity is 0")
            return None
        if light.has_cone:
            return self._spot(light, intensity)
        self._mention_shaping(light)
        if point:
            return {"type": "point", "position": centre.tolist(), "intensity": rgb(intensity.tolist())}
        if self.stage.blender:
            self._note(
                "approximated", light.prim, "is visible as a glowing sphere; Blender hides it from the camera"
            )
        return _shining(
            {"type": "sphere", "center": centre.tolist(), "radius": radius}, rgb(radiance.tolist())
        )

    def _spot(self, light: Light, intensity: Matrix) -> dict[str, Any]:
        """A light with a cone, as Mitsuba's spot, which is a point: no other emitter has a cone."""
        cutoff = min(float(light.get("shaping:cone:angle", 90.0)), 179.0)
        softness = float(np.clip(light.get("shaping:cone:softness", 0.0), 0.0, 1.0))
        beam = cutoff * (1 - softness)
        self._mention_shaping(light, cone=True)
        text = "a spot light without a size: shadows have sharp edges" + (
            "; the cone fades linearly" if softness else ""
        )
        self._note("approximated", light.prim, text)
        return {
            "type": "spot",
            "to_world": rotation(light.to_world) @ _FACING,
            "intensity": rgb(intensity.tolist()),
            "cutoff_angle": max(cutoff, 1e-3),
            "beam_width": float(np.clip(beam, 0.0, max(cutoff, 1e-3) * 0.999)),
        }

    def _cylinder(self, light: Light) -> dict[str, Any]:
        length, radius = light.size("length", 1.0), light.size("radius", 0.5)
        along, *across = light.scale
        mean = math.sqrt(across[0] * across[1])
        if not np.allclose(across, mean, rtol=1e-3):
            self._note("approximated", light.prim, "an oval cylinder: becomes a round one of the mean radius")
        ends = [(light.to_world @ [side * length / 2, 0, 0, 1])[:3].tolist() for side in (-1.0, 1.0)]
        area = 2 * math.pi * radius * mean * length * along / self.stage.unit**2
        self._mention_shaping(light)
        return _shining(
            {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": radius * mean},
            rgb(self._radiance(light, area)),
        )

    def _distant(self, light: Light) -> None:
        angle = float(np.clip(light.get("angle", 0.53), 0.0, 180.0))
        received = light.radiance
        if self.stage.blender:
            # Blender's exporter (5.0) writes a quarter of the strength, and half of the angle.
            received, angle = received * 4, angle * 2
            self._note(
                "converted",
                light.prim,
                "strength and angle of a sun are read as Blender's exporter writes them",
            )
        if not light.normalized and angle > 0:
            received = received * math.pi * math.sin(math.radians(angle / 2)) ** 2
        towards = light.to_world[:3, 2] / np.linalg.norm(light.to_world[:3, 2])
        self._suns.append(Sun(label(light.prim), towards, angle, received))

    def _dome(self, light: Light) -> None:
        self._domes.add(light)

    def surround(self, world: Mapping[str, Any] | None = None) -> None:
        """Add the environment, made from all domes and wide distant lights, and the other distant lights.

        Args:
            world: the environment, if it does not come from the stage.
        """
        found = self._domes.entry() if world is None else ("world", world)
        name, entry = ("light environment", None) if found is None else found
        entry, narrow = with_suns(entry, self._suns)
        if entry is not None:
            self.entries[unique(name, self.entries)] = entry
        for sun in self._suns:
            if sun not in narrow:
                text = f"a source {sun.angle:.3g}° wide: becomes a visible disc in the environment"
                self.notes.append(Note("converted", sun.name, text))
                continue
            self.entries[unique(f"light {sun.name}", self.entries)] = sun.parallel
            if sun.angle > 0:
                text = f"a source {sun.angle:.3g}° wide: becomes parallel light, with sharp shadows"
                self.notes.append(Note("approximated", sun.name, text))
        self.notes.extend(self._domes.notes)

    def _radiance(self, light: Light, area: float) -> tuple[float, float, float]:
        """Radiance of an area light; `area` in the stage's units."""
        r, g, b = (light.radiance / (max(area, 1e-30) if light.normalized else 1.0)).tolist()
        return r, g, b

    def _mention_shaping(self, light: Light, *, cone: bool = False) -> None:
        """Note shaping that our emitters do not support."""
        lost = []
        if float(light.get("shaping:focus", 0.0)) > 0:
            lost.append("focus")
        if not cone and light.has_cone:
            lost.append("cone")
        profile = light.get("shaping:ies:file", None)
        if profile and profile.path:
            lost.append("IES profile")
        if lost:
            self._note("left out", light.prim, f"its {' and '.join(lost)}: it emits uniformly")


def _shining(shape: dict[str, Any], radiance: Any) -> dict[str, Any]:
    return {**shape, "bsdf": _BLACK, "emitter": {"type": "area", "radiance": radiance}}


def _is_encoded(asset: Any) -> bool:
    """Whether an image file, by its extension, has 8 bits, which are sRGB-encoded by convention."""
    return Path(str(asset.path)).suffix.lower() not in (".exr", ".hdr", ".tif", ".tiff")
