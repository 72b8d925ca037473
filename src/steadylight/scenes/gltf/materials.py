"""Materials of a glTF scene as `pbr.Surface`.

Mitsuba's meshes have only one set of texture coordinates. A material's textures that use another set than its first
texture are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.description import Note
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.schema import Material, MetallicRoughness, Texture, TextureInfo
from steadylight.scenes.image_texture import size_of
from steadylight.scenes.pbr import Finish, Materials
from steadylight.scenes.surface import Surface, VertexColour
from steadylight.scenes.surface import Texture as Picture
from steadylight.scenes.world import LUMENS_PER_WATT

MOST_TEXELS: Final = 1 << 32
"""Maximum number of texels of all textures together: 12 GiB in every worker."""

_MANY_TEXELS: Final = 700_000_000
"""Number of texels from which there is a warning: about 2 GB."""

_WRAPS: Final = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST: Final = 9728
_NOT_READ: Final = {
    "sheen": "sheen",
    "iridescence": "iridescence",
    "anisotropy": "anisotropy: highlights are equally wide in all directions",
    "dispersion": "dispersion",
    "diffuse_transmission": "diffuse transmission: no light comes through from behind",
    "volume_scatter": "volume scattering",
}
_DEFAULT: Final = Material(name="")

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Look:
    """A material as a mesh uses it.

    Attributes:
        surface: appearance of the material.
        finish: entries of the material.
        uv_set: set of texture coordinates that it needs; None for none.
        both_sides: whether it emits from both sides.
    """

    surface: Surface
    finish: Finish
    uv_set: int | None
    both_sides: bool


@dataclass
class _Draft:
    """A material while it is being read.

    Attributes:
        name: name to show.
        place: place in the document, for messages.
        uv_set: set of texture coordinates of the textures so far.
        notes: notes so far.
    """

    name: str
    place: str
    uv_set: int | None = None
    notes: list[Note] = field(default_factory=list)

    def note(self, kind: str, text: str) -> None:
        """Add a note, unless it was added before."""
        note = Note(kind, f"material {self.name}", text)  # type: ignore[arg-type]
        if note not in self.notes:
            self.notes.append(note)


class MaterialReader:
    """Reads materials when meshes need them.

    Attributes:
        materials: all entries so far.
        notes: notes on what was approximated or left out.
    """

    def __init__(self, file: File) -> None:
        """Read nothing yet."""
        self._file = file
        self.materials = Materials()
        self.notes: list[Note] = []
        self._looks: dict[tuple[int | None, Vector | None], Look] = {}
        self._sizes: dict[int, int] = {}
        blender = "blender" in file.document.asset.generator.lower()
        self._photometric = bool(file.document.extensions.lights.lights) and not blender

    def look(self, index: int | None, tint: Vector | None, place: str) -> Look:
        """A material for a mesh.

        Args:
            index: index of the material; None for the default one.
            tint: colour of the mesh's vertices, if all have the same; None if they are the base colour.
            place: where the document refers to it, for messages.
        """
        key = (index, tint)
        if key not in self._looks:
            material = (
                _DEFAULT
                if index is None
                else self._file.item("materials", self._file.document.materials, index, place)
            )
            name = "(default)" if index is None else material.name or f"material {index}"
            draft = _Draft(name, f"materials[{index}]")
            surface = self._surface(material, tint, draft)
            if index is not None:
                self.notes += draft.notes
            self._looks[key] = Look(
                surface, self.materials.finish(surface), draft.uv_set, material.double_sided
            )
        return self._looks[key]

    def has_base_texture(self, index: int | None) -> bool:
        """Whether the base colour of a material is a texture."""
        if index is None or index >= len(self._file.document.materials):
            return False
        material = self._file.document.materials[index]
        gloss = material.extensions.specular_glossiness
        basic = material.pbr_metallic_roughness.base_color_texture
        return basic is not None or (gloss is not None and gloss.diffuse_texture is not None)

    def base_factor(self, index: int | None) -> Vector:
        """The factor of a material's base colour, without its texture."""
        if index is None or index >= len(self._file.document.materials):
            return (1.0, 1.0, 1.0)
        return self._file.document.materials[index].pbr_metallic_roughness.base_color_factor[:3]

    def _surface(self, material: Material, tint: Vector | None, draft: _Draft) -> Surface:
        """A material as a surface."""
        basic, more = material.pbr_metallic_roughness, material.extensions
        if more.specular_glossiness is not None:
            basic = self._from_glossiness(material, draft)
        tints = (1.0, 1.0, 1.0) if tint is None else tint
        factor = tuple(a * b for a, b in zip(basic.base_color_factor[:3], tints, strict=True))
        base = self._colour(basic.base_color_texture, factor, draft)  # type: ignore[arg-type]
        surface = Surface(
            draft.name,
            base_color=VertexColour() if tint is None else base,
            metallic=self._number(basic.metallic_roughness_texture, "b", basic.metallic_factor, draft),
            roughness=self._number(basic.metallic_roughness_texture, "g", basic.roughness_factor, draft),
            opacity=self._opacity(material, basic, draft),
            emission=self._emission(material, draft),
            normal=self._normal(material.normal_texture, draft),
        )
        if material.occlusion_texture is not None:
            draft.note("left out", "occlusion texture: occlusion is computed instead")
        for name, text in _NOT_READ.items():
            if getattr(more, name) is not None:
                draft.note("left out", text)
        if more.unlit is not None:
            draft.note("approximated", "is unlit: becomes a diffuse surface of its colour")
            return replace(surface, metallic=0.0, roughness=1.0, specular=0.0, normal=None)
        return self._extended(surface, material, draft)

    def _extended(self, surface: Surface, material: Material, draft: _Draft) -> Surface:
        """A surface with the properties that extensions add."""
        more = material.extensions
        if more.ior is not None:
            surface = replace(surface, ior=min(max(more.ior.ior, 1.0), 5.0) if more.ior.ior else 5.0)
        if more.specular is not None:
            surface = replace(
                surface,
                specular=self._number(
                    more.specular.specular_texture, "a", more.specular.specular_factor, draft
                ),
                specular_color=self._colour(
                    more.specular.specular_color_texture, more.specular.specular_color_factor, draft
                ),
            )
        if more.clearcoat is not None:
            coat = more.clearcoat
            surface = replace(
                surface,
                coat=self._number(coat.clearcoat_texture, "r", coat.clearcoat_factor, draft),
                coat_roughness=self._number(
                    coat.clearcoat_roughness_texture, "g", coat.clearcoat_roughness_factor, draft
                ),
            )
        if more.transmission is not None:
            glass = more.transmission
            weight = self._number(glass.transmission_texture, "r", glass.transmission_factor, draft)
            surface = replace(surface, transmission=weight)
        if more.volume is not None:
            surface = replace(
                surface,
                thin=more.volume.thickness_factor == 0,
                thickness=more.volume.thickness_factor,
                attenuation_color=more.volume.attenuation_color,
                attenuation_distance=more.volume.attenuation_distance or math.inf,
            )
        return surface

    def _from_glossiness(self, material: Material, draft: _Draft) -> MetallicRoughness:
        """Specular-glossiness as metallic-roughness."""
        gloss = material.extensions.specular_glossiness
        assert gloss is not None
        metal = max(gloss.specular_factor) > 0.5 and gloss.specular_glossiness_texture is None
        kind = "a metal of the same specular colour" if metal else "a dielectric of the same diffuse colour"
        draft.note("approximated", f"specular-glossiness, which is obsolete: becomes {kind}")
        factor = (*gloss.specular_factor, gloss.diffuse_factor[3]) if metal else gloss.diffuse_factor
        return MetallicRoughness(
            base_color_factor=tuple(min(part, 1.0) for part in factor),  # type: ignore[arg-type]
            base_color_texture=None if metal else gloss.diffuse_texture,
            metallic_factor=float(metal),
            roughness_factor=1 - gloss.glossiness_factor,
        )

    def _opacity(self, material: Material, basic: MetallicRoughness, draft: _Draft) -> float | Picture:
        """Opacity of the surface."""
        if material.alpha_mode == "OPAQUE":
            return 1.0
        opacity = self._number(basic.base_color_texture, "a", basic.base_color_factor[3], draft)
        if material.alpha_mode == "BLEND":
            return opacity
        if isinstance(opacity, Picture):
            return replace(opacity, threshold=material.alpha_cutoff)
        return float(opacity >= material.alpha_cutoff)

    def _emission(self, material: Material, draft: _Draft) -> Vector | Picture:
        """Radiance, W/(m² sr)."""
        strength = material.extensions.emissive_strength
        scale = 1.0 if strength is None else strength.emissive_strength
        if not any(material.emissive_factor) or not scale:
            return (0.0, 0.0, 0.0)
        if self._photometric:
            scale /= LUMENS_PER_WATT
            draft.note("converted", "emission in cd/m², as the lamps are in candela: divided by 683 lm/W")
        else:
            draft.note("converted", "emission taken as radiance, W/(m² sr)")
        r, g, b = (part * scale for part in material.emissive_factor)
        return self._colour(material.emissive_texture, (r, g, b), draft)

    def _normal(self, info: TextureInfo | None, draft: _Draft) -> Picture | None:
        """A normal map, with its scale applied to the texels."""
        picture = None if info is None else self._picture(info, draft)
        if info is None or picture is None:
            return None
        s = info.scale
        if s == 1:
            return picture
        return replace(picture, gain=(s, s, 1.0), bias=((1 - s) / 2, (1 - s) / 2, 0.0))

    def _colour(self, info: TextureInfo | None, factor: Vector, draft: _Draft) -> Vector | Picture:
        """A colour: a factor, or a texture times a factor."""
        picture = self._picture(info, draft) if info is not None and any(factor) else None
        if picture is None:
            return factor
        return replace(picture, srgb=True, gain=1.0 if factor == (1.0, 1.0, 1.0) else factor)

    def _number(
        self, info: TextureInfo | None, channel: str, factor: float, draft: _Draft
    ) -> float | Picture:
        """A number: a factor, or a channel of a texture times a factor."""
        picture = self._picture(info, draft) if info is not None and factor else None
        return factor if picture is None else replace(picture, channels=channel, gain=factor)

    def _picture(self, info: TextureInfo, draft: _Draft) -> Picture | None:
        """The image of a texture reference, with its look-up; None if it cannot be used."""
        place = draft.place
        texture = self._file.item("textures", self._file.document.textures, info.index, place)
        number = texture.extensions.webp.source if texture.extensions.webp else texture.source
        transform = info.extensions.transform
        uv_set = info.tex_coord if transform is None or transform.tex_coord is None else transform.tex_coord
        if number is None:
            draft.note("left out", f"texture {info.index}: its image format is not supported")
            return None
        if draft.uv_set is None:
            draft.uv_set = uv_set
        elif draft.uv_set != uv_set:
            draft.note(
                "left out", f"texture {info.index}: it uses other texture coordinates than the first texture"
            )
            return None
        source = self._file.image(number, f"textures[{info.index}]")
        picture = Picture(source)
        self._check(number, picture)
        wrap, nearest = self._look_up(texture, info.index, draft)
        if transform is None:
            return replace(picture, wrap=wrap, nearest=nearest)
        return replace(
            picture,
            wrap=wrap,
            nearest=nearest,
            to_uv=uv_matrix(transform.offset, transform.rotation, transform.scale),
        )

    def _check(self, number: int, picture: Picture) -> None:
        """Read the header of an image, and count its texels."""
        if number in self._sizes:
            return
        try:
            width, height = size_of(picture.entry())
        except SceneError as error:
            raise self._file.fault(f"images[{number}]", str(error)) from None
        self._sizes[number] = width * height
        if sum(self._sizes.values()) > MOST_TEXELS:
            raise self._file.fault(
                "images", f"have more than {MOST_TEXELS:,} pixels in total; scale them down"
            )

    def _look_up(self, texture: Texture, index: int, draft: _Draft) -> tuple[str, bool]:
        """Wrap mode, and whether texels are not interpolated."""
        if texture.sampler is None:
            return "repeat", False
        sampler = self._file.item(
            "samplers", self._file.document.samplers, texture.sampler, f"textures[{index}]"
        )
        if sampler.wrap_s != sampler.wrap_t:
            draft.note("approximated", f"texture {index}: its horizontal wrap mode is used vertically, too")
        return _WRAPS.get(sampler.wrap_s, "repeat"), sampler.mag_filter == _NEAREST

    def all_notes(self) -> list[Note]:
        """Notes of all materials, and on the size of the textures."""
        total = sum(self._sizes.values())
        many = [
            Note(
                "warning",
                "textures",
                f"have {total / 1e6:,.0f} million pixels: about {3 * total / 1e9:.0f} GB in every worker",
            )
        ]
        return [*self.notes, *self.materials.notes, *(many if total > _MANY_TEXELS else [])]


def uv_matrix(offset: Sequence[float], rotation: float, scale: Sequence[float]) -> NDArray[np.float64]:
    """KHR_texture_transform as a (3, 3) matrix: first scale, then rotate counter-clockwise, then translate."""
    c, s = math.cos(rotation), math.sin(rotation)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    move = np.array([[1.0, 0.0, offset[0]], [0.0, 1.0, offset[1]], [0.0, 0.0, 1.0]])
    return np.asarray(move @ turn @ np.diag([scale[0], scale[1], 1.0]))
