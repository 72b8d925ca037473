"""Convert Radiance's scenes for the Mitsuba renderer.

All surfaces of a material become one mesh, so that a room of ten thousand polygons is a dozen shapes. Emitting surfaces
stay separate, because light is sampled by shape. Radiances and reflectances are kept channel by channel.
"""

from __future__ import annotations

import copy
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.description import Note, SceneDescription
from steadylight.scenes.radiance.commands import Expansion
from steadylight.scenes.radiance.grammar import Primitive
from steadylight.scenes.radiance.instances import expanded, mesh_triangles, octree_primitives
from steadylight.scenes.radiance.materials import MATERIALS, Material, material_of, rgb
from steadylight.scenes.radiance.modifiers import MIXTURES, TEXTURES, Modifier, Surface, surfaces_of
from steadylight.scenes.radiance.patterns import MOST_PICTURES, SIDE, mean_of, picture_of
from steadylight.scenes.radiance.sources import emitters_of, sources_of
from steadylight.scenes.radiance.surfaces import SURFACES, Triangles, bounds, fault, joined, triangles_of
from steadylight.scenes.radiance.view import view_of
from steadylight.scenes.sun import sky_file
from steadylight.settings import SceneOptions

LUMENS_PER_WATT: Final = 179.0
"""Luminous efficacy that Radiance assigns to white."""

MOST_LAMPS: Final = 500
"""Maximum number of surfaces of one luminous material that stay separate; more of them become one mesh."""

WIDEST_SPOT: Final = 170.0
"""Maximum cone of a spotlight, degrees across; a wider one becomes an ordinary light."""


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a Radiance scene for the Mitsuba renderer.

    Args:
        path: a `.rad` file, or an octree.
        options: `sky`: a `.rad` file with sky and sun, read before the scene.

    Raises:
        SceneError: a file cannot be read, or something in it has no counterpart; the message says where.
        BackendError: pyradiance is needed (for commands in the file, or for a sky with a pattern), but not installed.
    """
    path = path.absolute()
    sky = sky_file(options)
    for file in (sky, path):
        if file is not None and not file.is_file():
            raise SceneError(f"{file}: no such scene file")
    expansion = Expansion.of(path, anywhere=options.allow_outside)
    if path.suffix.lower() == ".oct":
        primitives = octree_primitives(path, expansion)
    else:
        before = [] if sky is None else Expansion.of(sky, anywhere=options.allow_outside).file(sky)
        primitives = [_found_anywhere(each, path.parent, sky) for each in before] + expansion.file(path)
    conversion = Conversion(path.parent, expansion)
    conversion.add(expanded(surfaces_of(primitives), expansion))
    return SceneDescription(
        name=path.stem,
        content=conversion.content,
        about=str(path),
        notes=tuple(conversion.notes),
        **view_of(path, *conversion.bounds),
    )


def _found_anywhere(given: Primitive, folder: Path, sky: Path | None) -> Primitive:
    """A primitive of a sky with full paths of its pictures and data, because only the scene's folder is searched."""
    if sky is None or sky.parent == folder:
        return given
    files = {word: sky.parent / word for word in given.words if "." in word}
    return replace(
        given,
        words=tuple(
            str(files[word]) if word in files and files[word].is_file() else word for word in given.words
        ),
    )


def sky_entries(
    file: Path, lumens_per_watt: float, up: NDArray[np.float64], *, anywhere: bool = False
) -> tuple[dict[str, Any], list[Note]]:
    """Sun and sky of a Radiance file, for a scene of another format.

    Args:
        file: the file, of which only distant sources are used.
        lumens_per_watt: rate of that scene's radiances.
        up: (4, 4) rotation from z up to the up axis of that scene.
        anywhere: whether the file may refer to files outside its folder.

    Returns:
        Entries of a scene description, and notes.
    """
    if not file.is_file():
        raise SceneError(f"{file}: no such sky file")
    expansion = Expansion.of(file, anywhere=anywhere)
    surfaces = surfaces_of(expansion.file(file))
    conversion = Conversion(file.parent, expansion)
    for surface in surfaces:
        if surface.primitive.kind != "source":
            conversion.tell(
                "left out",
                surface.primitive.name,
                "not a distant source: only sun and sky are read from this file",
            )
    entries = emitters_of(sources_of(surfaces, conversion.tell), file.parent, conversion.tell)
    if not entries:
        raise SceneError(
            f"{file}: has no source that emits light; a sky is a `glow` on a `source`, such as "
            "`skyglow source sky 0 0 4 0 0 1 180`"
        )
    scale = LUMENS_PER_WATT / lumens_per_watt
    return {name: _turned(entry, scale, up) for name, entry in entries.items()}, conversion.notes


def _turned(entry: dict[str, Any], scale: float, up: NDArray[np.float64]) -> dict[str, Any]:
    """An entry of daylight, scaled to other units and turned to another up axis."""
    if entry["type"] == "envmap":
        data = (entry["data"] * scale).astype(np.float32)
        return entry | {"data": data, "to_world": up @ entry["to_world"]}
    if entry["type"] == "constant":
        return entry | {"radiance": rgb(scale * np.array(entry["radiance"]["value"]))}
    direction = up[:3, :3] @ np.array(entry["direction"])
    irradiance = rgb(scale * np.array(entry["irradiance"]["value"]))
    return entry | {"direction": direction.tolist(), "irradiance": irradiance}


@dataclass
class Conversion:
    """Makes the content of a scene description.

    Attributes:
        folder: folder of the scene.
        expansion: the expansion that read the scene.
        content: content so far.
        notes: notes so far, without duplicates.
    """

    folder: Path
    expansion: Expansion
    content: dict[str, Any] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    bounds: tuple[Any, Any] = (np.full(3, np.inf), np.full(3, -np.inf))

    def tell(
        self, kind: Literal["converted", "approximated", "left out", "warning"], where: str, text: str
    ) -> None:
        """Note what became of something."""
        note = Note(kind, where, text)
        if note not in self.notes:
            self.notes.append(note)

    def add(self, surfaces: Sequence[Surface]) -> None:
        """Convert surfaces with their materials."""
        groups: dict[Modifier, list[Surface]] = defaultdict(list)
        for surface in surfaces:
            if surface.primitive.kind not in (*SURFACES, "mesh"):
                continue
            if surface.modifier is None:
                self.tell(
                    "left out", surface.primitive.name, "a surface without a material, which is invisible"
                )
            else:
                groups[surface.modifier].append(surface)
        for modifier, members in groups.items():
            self._group(modifier, members)
        self.content |= emitters_of(sources_of(surfaces, self.tell), self.folder, self.tell)

    def _group(self, modifier: Modifier, members: Sequence[Surface]) -> None:
        """Convert all surfaces of one material."""
        name = modifier.primitive.name
        material = self._material(modifier, members[0].primitive)
        surfaces = [(member.primitive, self._triangles(member.primitive)) for member in members]
        surfaces = [pair for pair in surfaces if len(pair[1].faces)]
        if modifier.patterns and surfaces:
            colours = _colours(material)
            flat = all(surface.kind == "polygon" for surface, _ in surfaces)
            if flat and len(surfaces) <= MOST_PICTURES and material.radiance is None and len(colours) == 1:
                self._pictured(modifier, material, surfaces)
                return
            material = self._averaged(modifier, material, [triangles for _, triangles in surfaces])
        if material.kind == "spotlight" and modifier.primitive.numbers[3] <= WIDEST_SPOT:
            for surface, triangles in surfaces:
                self._spot(modifier.primitive, surface, triangles, material)
            return
        bsdf = self._name(name, "material")
        self.content[bsdf] = material.bsdf
        links: dict[str, Any] = {"bsdf": {"type": "ref", "id": bsdf}}
        if material.radiance is not None:
            links["emitter"] = {"type": "area", "radiance": rgb(material.radiance)}
        if material.radiance is None or len(surfaces) > MOST_LAMPS:
            self._meshes(name, [triangles for _, triangles in surfaces], links)
            return
        for surface, triangles in surfaces:
            self._lamp(surface, triangles, links)

    def _pictured(
        self, modifier: Modifier, material: Material, surfaces: Sequence[tuple[Primitive, Triangles]]
    ) -> None:
        """Convert polygons, each with its own picture of the pattern."""
        name = modifier.primitive.name
        self.tell(
            "converted",
            name,
            f"its pattern ({modifier.pattern_names()}) becomes pictures of up to {SIDE} texels",
        )
        for _, triangles in surfaces:
            picture = picture_of(modifier, triangles, self.folder)
            bsdf = copy.deepcopy(material.bsdf)
            ((owner, key),) = _colours(Material(bsdf))
            owner[key] = picture.texture(owner[key]["value"], most=1.0)
            entry = self._name(name, "material")
            self.content[entry] = bsdf
            links = {"bsdf": {"type": "ref", "id": entry}, "uv": picture.uv}
            self.content[self._name(name, "surfaces")] = triangles.entry | links
            self._include([triangles])

    def _averaged(self, modifier: Modifier, material: Material, surfaces: Sequence[Triangles]) -> Material:
        """A material multiplied by the mean of its pattern."""
        shines = material.radiance is not None
        what = "it emits the same light in all directions" if shines else "it is uniform"
        self.tell(
            "approximated",
            modifier.primitive.name,
            f"its pattern ({modifier.pattern_names()}) becomes its mean: {what}",
        )
        mean = mean_of(modifier, surfaces, self.folder)
        bsdf = copy.deepcopy(material.bsdf)
        for owner, key in [] if shines else _colours(Material(bsdf)):
            owner[key] = rgb(np.clip(mean * owner[key]["value"], 0, 1))
        red, green, blue = (
            (mean * material.radiance).tolist() if material.radiance is not None else (0.0, 0.0, 0.0)
        )
        return replace(material, bsdf=bsdf, radiance=(red, green, blue) if shines else None)

    def _material(self, modifier: Modifier, surface: Primitive) -> Material:
        """The material of a surface, below patterns and textures."""
        kind = modifier.primitive.kind
        if kind in MIXTURES:
            raise fault(
                modifier.primitive,
                "is a mixture, which the Mitsuba renderer does not support; use one of the mixed materials, or give "
                "--renderer radiance",
            )
        if kind not in MATERIALS:
            raise SceneError(
                f"{surface.place}: `{surface.name}` is made of {kind} `{modifier.primitive.name}`, which "
                "is not a material"
            )
        each = modifier.below
        while each is not None:
            if each.primitive.kind in TEXTURES:
                self.tell(
                    "left out",
                    each.primitive.name,
                    f"{each.primitive.kind}, which perturbs normals: surfaces stay smooth",
                )
            each = each.below
        material = material_of(modifier.primitive, self.tell)
        if kind == "illum":
            self.tell("approximated", modifier.primitive.name, "an illum is visible as a light source")
        if kind == "glow" and modifier.primitive.numbers[3] < 0:
            self.tell(
                "approximated",
                modifier.primitive.name,
                "a glow that should illuminate nothing (radius below 0) does illuminate",
            )
        return material

    def _meshes(self, name: str, parts: Sequence[Triangles], links: dict[str, Any]) -> None:
        """Add surfaces as one faceted mesh, and curved ones as one mesh with normals."""
        for smooth in (False, True):
            chosen = [part for part in parts if (part.normals is not None) == smooth]
            if chosen:
                self.content[self._name(name, "curved" if smooth else "surfaces")] = (
                    joined(chosen).entry | links
                )
        self._include(parts)

    def _lamp(self, surface: Primitive, triangles: Triangles, links: dict[str, Any]) -> None:
        """Add one emitting surface."""
        entry = triangles.entry
        if surface.kind == "sphere" and surface.numbers[3] > 0:
            entry = {"type": "sphere", "center": list(surface.numbers[:3]), "radius": surface.numbers[3]}
        self.content[self._name(surface.name)] = entry | links
        self._include([triangles])

    def _triangles(self, surface: Primitive) -> Triangles:
        if surface.kind == "mesh":
            return mesh_triangles(surface, self.expansion)
        return triangles_of(surface)

    def _include(self, parts: Sequence[Triangles]) -> None:
        low, high = bounds(parts)
        self.bounds = (np.minimum(self.bounds[0], low), np.maximum(self.bounds[1], high))

    def _spot(self, light: Primitive, surface: Primitive, triangles: Triangles, material: Material) -> None:
        """Add a lamp that emits into a cone, as a spotlight at the centre of its surface."""
        aim = np.array(light.numbers[4:7], np.float64)
        length = float(np.linalg.norm(aim))
        if not length > 0:
            raise SceneError(f"{light.place}: spotlight `{light.name}` has no direction")
        aim /= length
        a, b, c = (triangles.vertices[triangles.faces[:, corner]] for corner in range(3))
        area = float(np.maximum(np.cross(b - a, c - a) @ aim / 2, 0).sum())  # projected area
        centre = (triangles.vertices.min(axis=0) + triangles.vertices.max(axis=0)) / 2
        half = light.numbers[3] / 2
        self.content[self._name(surface.name)] = {
            "type": "spot",
            "intensity": rgb(area * np.array(material.radiance, np.float64)),
            "cutoff_angle": half,
            "beam_width": half * (1 - 1e-3),
            "to_world": _looking(centre, aim),
        }
        self.tell(
            "approximated",
            light.name,
            "a spotlight emits from one point, uniformly within its cone, and is invisible",
        )
        self._include([triangles])

    def _name(self, stem: str, suffix: str = "") -> str:
        """An unused name without dots and other characters that have a meaning for Mitsuba."""
        wish = re.sub(r"[^\w-]+", "_", f"{stem}_{suffix}" if suffix else stem) or "surface"
        name, number = wish, 1
        while name in self.content:
            number += 1
            name = f"{wish}_{number}"
        return name


def _colours(material: Material) -> list[tuple[dict[str, Any], str]]:
    """Places of the material's colour in its BSDF, which a pattern changes."""
    found: list[tuple[dict[str, Any], str]] = []
    pending = [material.bsdf]
    while pending:
        bsdf = pending.pop()
        for key, value in bsdf.items():
            if isinstance(value, dict) and value.get("type") == "rgb":
                found.append((bsdf, key))
            elif isinstance(value, dict):
                pending.append(value)
    return found


def _looking(origin: Any, direction: Any) -> Any:
    """A frame, (4, 4), with its z axis along the direction."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([x, np.cross(direction, x), direction, origin])
    return matrix
