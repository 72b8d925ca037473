"""Converts physically based materials (glTF's metallic-roughness, OpenPBR) to Mitsuba BSDFs.

Our kernels handle the lobes of a material separately if Mitsuba exposes them separately. A surface therefore becomes a
mixture of simple BSDFs: a dielectric base is `roughplastic` or `plastic`, a metal `roughconductor`, a thin pane
`thindielectric`, a solid body `dielectric` or `roughdielectric`. Weights and their textures mix them (`blendbsdf`), and
opacity is a `mask`. `principled` is used only for what cannot be separated, such as a clear coat over metal.

Opaque surfaces are two-sided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from steadylight.scenes.description import Note
from steadylight.scenes.image_texture import linear_texels
from steadylight.scenes.surface import SMOOTH, Colour, Number, Surface, Texture, Tint, VertexColour

NOTHING, ALL = 0.01, 0.99
"""A weight below the first becomes 0, and one above the second becomes 1 (except `specular`). A texture whose values
differ by less than the first becomes its mean. In 8-bit files, smaller differences are rarely intended."""

NO_GLOSS: Final = 1e-3
"""Reflectance at normal incidence below which a dielectric becomes `diffuse`."""

_WHITE: Final = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Finish:
    """What the entry of a mesh needs from its surface.

    Attributes:
        bsdf: a reference to the material's entry.
        emitter: an area emitter, or None. Meshes that emit must not be instanced.
        opaque: whether no light passes through.
    """

    bsdf: Mapping[str, Any]
    emitter: Mapping[str, Any] | None
    opaque: bool


@dataclass
class Materials:
    """The materials and textures of a scene: entries of its content, each made once.

    Attributes:
        entries: textures and BSDFs by name; they must come before the meshes that refer to them.
        notes: notes on what was approximated.
    """

    entries: dict[str, Any] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    _textures: dict[Any, str] = field(default_factory=dict)
    _ranges: dict[Any, tuple[float, float, float]] = field(default_factory=dict)

    def finish(self, surface: Surface) -> Finish:
        """Add a surface to the entries."""
        surface = self._settled(surface)
        bsdf, opaque = self._bsdf(surface)
        if surface.normal is not None:
            if opaque:
                bsdf = {"type": "normalmap", "normalmap": self.texture(surface.normal), "bsdf": bsdf}
            else:
                self._note(surface, "left out", "normal map: not supported on a transmissive surface")
        if opaque:
            bsdf = {"type": "twosided", "bsdf": bsdf}
        if surface.opacity != 1.0:
            bsdf = {"type": "mask", "opacity": self._value(surface.opacity), "bsdf": bsdf}
        name = unique(f"material {surface.name}", self.entries)
        self.entries[name] = bsdf
        return Finish({"type": "ref", "id": name}, self._emitter(surface), opaque and surface.opacity == 1.0)

    def texture(self, texture: Texture) -> dict[str, Any]:
        """A reference to the entry of a texture."""
        entry = texture.entry()
        key = _key(entry)
        if key not in self._textures:
            name = unique(f"texture {len(self._textures) + 1}", self.entries)
            self._textures[key] = name
            self.entries[name] = entry
        return {"type": "ref", "id": self._textures[key]}

    def _emitter(self, surface: Surface) -> dict[str, Any] | None:
        """The area emitter of a surface; None if it does not emit."""
        emission = surface.emission
        if isinstance(emission, tuple) and not any(emission):
            return None
        return {"type": "area", "radiance": self._tint(emission)}

    def _settled(self, surface: Surface) -> Surface:
        """The surface with textures without variation replaced by numbers, and weights near 0 or 1 rounded."""
        names = ("metallic", "roughness", "transmission", "coat", "coat_roughness", "specular", "opacity")
        settled: dict[str, Any] = {}
        for name in names:
            value = getattr(surface, name)
            if isinstance(value, Texture):
                low, high, mean = self._range(value)
                value = mean if high - low < NOTHING else value
            if isinstance(value, float) and name not in ("roughness", "coat_roughness"):
                value = 0.0 if value < NOTHING else 1.0 if value > ALL and name != "specular" else value
            settled[name] = value
        return replace(surface, **settled)

    def _bsdf(self, surface: Surface) -> tuple[dict[str, Any], bool]:
        """The BSDF without normal map and opacity, and whether it is opaque."""
        if surface.metallic != 0.0 and surface.coat != 0.0:
            return self._principled(surface), True
        through = surface.transmission != 0.0 and surface.metallic != 1.0
        parts: dict[str, Any] = {}
        if surface.transmission != 1.0:
            parts["base"] = self._mixed(
                surface.coat, lambda: self._dielectric(surface), lambda: self._coated(surface)
            )
        inner = (
            parts.get("base")
            if not through
            else self._mixed(surface.transmission, lambda: parts["base"], lambda: self._glass(surface))
        )
        mixed = self._mixed(surface.metallic, lambda: inner, lambda: self._metal(surface))
        if through and isinstance(surface.transmission, float) and surface.transmission < 1.0:
            self._note(surface, "approximated", "its opaque part is seen from the front only")
        return mixed, not through

    def _mixed(self, weight: Number, first: Any, second: Any) -> dict[str, Any]:
        """A mixture of two BSDFs, or one of them if the weight is 0 or 1; only those needed are made."""
        if weight in (0.0, 1.0):
            return dict(first() if weight == 0.0 else second())
        return {"type": "blendbsdf", "weight": self._value(weight), "first": first(), "second": second()}

    def _dielectric(self, surface: Surface) -> dict[str, Any]:
        """A diffuse base under a reflecting boundary."""
        tint, strength = self._reflection(surface)
        f0 = strength * ((surface.ior - 1) / (surface.ior + 1)) ** 2
        base = self._tint(surface.base_color)
        if f0 < NO_GLOSS:
            return {"type": "diffuse", "reflectance": base}
        if isinstance(surface.base_color, VertexColour):
            return self._glossy_vertex_colours(surface, surface.roughness, _ior_of(f0))
        bsdf = self._layer(self._one_roughness(surface, surface.roughness), _ior_of(f0))
        return {**bsdf, "diffuse_reflectance": base, **tint}

    def _coated(self, surface: Surface) -> dict[str, Any]:
        """A dielectric base under a clear coat, of which only the coat's boundary reflects."""
        if isinstance(surface.base_color, VertexColour):
            return self._glossy_vertex_colours(surface, surface.coat_roughness, 1.5)
        bsdf = self._layer(self._one_roughness(surface, surface.coat_roughness, "coat's "), 1.5)
        return {**bsdf, "diffuse_reflectance": self._tint(surface.base_color)}

    @staticmethod
    def _layer(roughness: float, ior: float) -> dict[str, Any]:
        """A reflecting boundary over a base, rough or smooth."""
        if roughness <= SMOOTH:
            return {"type": "plastic", "int_ior": ior}
        return {"type": "roughplastic", "alpha": roughness**2, "int_ior": ior}

    def _reflection(self, surface: Surface) -> tuple[dict[str, Any], float]:
        """Tint of a dielectric's reflection, and its strength relative to that which its ior gives."""
        colour = surface.specular_color
        if isinstance(colour, Texture | VertexColour):
            return {"specular_reflectance": self._tint(colour)}, 1.0
        if isinstance(surface.specular, Texture):
            return {"specular_reflectance": self._value(surface.specular)}, max(colour)
        most = max(colour)
        if most <= 0:
            return {}, 0.0
        tint = tuple(part / most for part in colour)
        return ({} if min(tint) > ALL else {"specular_reflectance": rgb(tint)}), most * surface.specular

    def _metal(self, surface: Surface) -> dict[str, Any]:
        """A conductor that has the base colour at normal incidence, and turns white towards grazing."""
        colour = surface.base_color
        if isinstance(colour, Texture | VertexColour):
            bsdf: dict[str, Any] = {"material": "none", "specular_reflectance": self._tint(colour)}
        else:
            # With eta = 1 the reflectance at normal incidence is k² / (4 + k²).
            k = tuple(2 * math.sqrt(min(f, 0.9999) / (1 - min(f, 0.9999))) for f in colour)
            bsdf = {"eta": rgb((1.0, 1.0, 1.0)), "k": rgb(k)}
        if isinstance(surface.roughness, float) and surface.roughness <= SMOOTH:
            return {"type": "conductor", **bsdf}
        return {"type": "roughconductor", "alpha": self._alpha(surface.roughness), **bsdf}

    def _glass(self, surface: Surface) -> dict[str, Any]:
        """A pane, or the boundary of a body."""
        if surface.thin:
            if surface.is_clear:
                tint = (
                    {}
                    if surface.through == _WHITE
                    else {"specular_transmittance": self._tint(surface.through)}
                )
                return {"type": "thindielectric", "int_ior": surface.ior, **tint}
            return {
                "type": "principledthin",
                "base_color": self._tint(surface.through),
                "roughness": self._value(surface.roughness),
                "spec_trans": 1.0,
                "eta": surface.ior,
            }
        left = self._left(surface)
        tint = (
            {} if surface.through == left == _WHITE else {"specular_transmittance": self._body(surface, left)}
        )
        bsdf: dict[str, Any] = {"int_ior": surface.ior, **tint}
        if surface.is_clear:
            return {"type": "dielectric", **bsdf}
        return {"type": "roughdielectric", "alpha": self._alpha(surface.roughness), **bsdf}

    def _left(self, surface: Surface) -> Colour:
        """Fraction of white light that remains after it has crossed a body."""
        if not (math.isfinite(surface.attenuation_distance) and surface.thickness > 0):
            return _WHITE
        depth = surface.thickness / surface.attenuation_distance
        r, g, b = (float(np.clip(part, 1e-6, 1.0)) ** depth for part in surface.attenuation_color)
        self._note(
            surface, "approximated", "absorption in the body: applied at its surface, for its thickness"
        )
        return r, g, b

    def _body(self, surface: Surface, left: Colour) -> Any:
        """Transmittance of each of the two boundaries of a body: the square root of that of both together."""
        colour = surface.through
        if isinstance(colour, VertexColour):
            return self._tint(colour)
        if isinstance(colour, Texture):
            gain = np.broadcast_to(np.asarray(colour.gain), 3) * np.asarray(left)
            return self.texture(replace(colour, gain=tuple(gain.tolist()), power=0.5))
        return rgb(tuple(math.sqrt(max(a * b, 0.0)) for a, b in zip(colour, left, strict=True)))

    def _principled(self, surface: Surface) -> dict[str, Any]:
        """A coat over metal, which cannot be separated into simple BSDFs."""
        self._note(surface, "approximated", "a clear coat over metal: becomes `principled`, with some noise")
        gloss = 1 - self._one_roughness(surface, surface.coat_roughness, "coat's ")
        return {
            "type": "principled",
            "base_color": self._tint(surface.base_color),
            "metallic": self._value(surface.metallic),
            "roughness": self._value(surface.roughness),
            "eta": max(surface.ior, 1.01),
            "clearcoat": self._value(surface.coat),
            "clearcoat_gloss": gloss,
        }

    def _glossy_vertex_colours(self, surface: Surface, roughness: Number, ior: float) -> dict[str, Any]:
        """Gloss over vertex colours, whose mean Mitsuba's `plastic` does not know."""
        self._note(
            surface, "approximated", "gloss over vertex colours: becomes `principled`, with some noise"
        )
        return {
            "type": "principled",
            "base_color": self._tint(surface.base_color),
            "roughness": self._value(roughness),
            "eta": ior,
        }

    def _one_roughness(self, surface: Surface, roughness: Number, of: str = "") -> float:
        """A single roughness for the whole surface, as `roughplastic` requires."""
        if not isinstance(roughness, Texture):
            return roughness
        low, high, mean = self._range(roughness)
        if high - low > 0.1:
            text = f"{of}roughness from {low:.2f} to {high:.2f}: {mean:.2f} is used wherever it is not metal"
            self._note(surface, "approximated", text)
        return mean

    def _alpha(self, roughness: Number) -> Any:
        """Microfacet roughness alpha, a number or a texture."""
        if isinstance(roughness, Texture):
            return self.texture(replace(roughness, power=2.0))
        return max(roughness, SMOOTH) ** 2

    def _value(self, value: Number) -> Any:
        return self.texture(value) if isinstance(value, Texture) else float(value)

    def _tint(self, value: Tint) -> Any:
        if isinstance(value, VertexColour):
            return {"type": "mesh_attribute", "name": "vertex_color"}
        return self.texture(value) if isinstance(value, Texture) else rgb(value)

    def _range(self, texture: Texture) -> tuple[float, float, float]:
        """Lowest and highest value, without the outer hundredths, and the mean."""
        entry = texture.entry()
        key = _key(entry)
        if key not in self._ranges:
            values = linear_texels(entry).ravel()
            values = values[:: max(1, len(values) >> 20)]
            low, high = np.percentile(values, (1, 99))
            self._ranges[key] = (float(low), float(high), float(values.mean(dtype=np.float64)))
        return self._ranges[key]

    def _note(self, surface: Surface, kind: Any, text: str) -> None:
        self.notes.append(Note(kind, f"material {surface.name}", text))


def rgb(colour: Sequence[float]) -> dict[str, Any]:
    """A colour as a Mitsuba entry."""
    return {"type": "rgb", "value": [float(part) for part in colour]}


def unique(wish: str, taken: Mapping[str, Any]) -> str:
    """A name for an entry that is not taken; dots, which Mitsuba reads as paths, are replaced."""
    wish = wish.replace(".", "_").strip() or "unnamed"
    if wish not in taken:
        return wish
    # Files may have thousands of parts of the same name, so the next free number is found by bisection.
    low, high = 1, 2
    while f"{wish} ({high})" in taken:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if f"{wish} ({middle})" in taken else (low, middle)
    return f"{wish} ({high})"


def _ior_of(f0: float) -> float:
    """Index of refraction that gives a reflectance at normal incidence."""
    root = math.sqrt(min(f0, 0.9))
    return (1 + root) / (1 - root)


def _key(entry: Mapping[str, Any]) -> Any:
    """Key of a texture entry. Encoded bytes are compared by identity: their owner keeps one array per image."""
    return tuple(
        (
            name,
            id(value)
            if name == "encoded"
            else value.tobytes()
            if isinstance(value, np.ndarray)
            else str(value),
        )
        for name, value in entry.items()
    )
