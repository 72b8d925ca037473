"""What a surface looks like, as readers of glTF, USD, IFC and MTL say it; `pbr` puts it into Mitsuba's words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

SMOOTH: Final = 0.07
"""Roughness up to which a lobe is taken as a mirror: 0.3 degrees, less than a pixel of most pictures."""

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image over a surface.

    Attributes:
        source: (N,) uint8, the bytes of an image file; or the absolute path of one.
        channels: `rgb`, or the one that is used.
        srgb: whether the values of `rgb` are encoded in sRGB.
        gain: value becomes gain * value + bias; one number, or one for each of three channels.
        bias: see `gain`.
        threshold: values below it (after gain and bias) are 0, others 1; None to keep them.
        power: exponent of the values, at last.
        to_uv: (3, 3) transform of texture coordinates; None for the identity.
        wrap: what is beyond the image.
        nearest: whether texels are not interpolated.
    """

    source: NDArray[np.uint8] | str
    channels: str = "rgb"
    srgb: bool = False
    gain: float | Colour = 1.0
    bias: float | Colour = 0.0
    threshold: float | None = None
    power: float = 1.0
    to_uv: NDArray[np.float64] | None = None
    wrap: str = "repeat"
    nearest: bool = False

    def entry(self) -> dict[str, Any]:
        """The texture as an entry of a scene: see `image_texture`."""
        entry: dict[str, Any] = {"type": "image", "channels": self.channels}
        entry["filename" if isinstance(self.source, str) else "encoded"] = self.source
        for name, value, default in (
            ("srgb", self.srgb, False),
            ("gain", self.gain, 1.0),
            ("bias", self.bias, 0.0),
            ("threshold", self.threshold, None),
            ("power", self.power, 1.0),
            ("wrap_mode", self.wrap, "repeat"),
        ):
            if value != default:
                entry[name] = list(value) if isinstance(value, tuple) else value
        if self.nearest:
            entry["filter_type"] = "nearest"
        if self.to_uv is not None and not np.allclose(self.to_uv, np.eye(3)):
            matrix = np.eye(4)
            matrix[:2, :2], matrix[:2, 3] = self.to_uv[:2, :2], self.to_uv[:2, 2]
            entry["to_uv"] = matrix
        return entry


@dataclass(frozen=True)
class VertexColour:
    """The colours of a mesh's vertices (`colors` of its entry), as a colour of the surface."""


Number = float | Texture
Tint = Colour | Texture | VertexColour


@dataclass(frozen=True, eq=False)
class Surface:
    """What a surface looks like. Colours are scene-linear; weights lie between 0 and 1.

    Attributes:
        name: of the material, as in the file.
        base_color: of the diffuse base, of the metal, and of what is transmitted.
        metallic: share that is metal.
        roughness: perceptual: its square is the width of the microfacets' slopes (alpha).
        ior: index of refraction.
        specular: weight of the dielectric's reflection at normal incidence.
        specular_color: its tint.
        transmission: share of the light below the surface that goes through instead of being diffused.
        transmission_color: of what is transmitted; `base_color` if None.
        thin: whether what transmits is a sheet; else it is the boundary of a solid body.
        attenuation_color: what is left of white light after `attenuation_distance` in a solid body.
        attenuation_distance: metres; infinite for clear bodies.
        thickness: metres of a solid body that light crosses, for its attenuation.
        coat: weight of a clear coat.
        coat_roughness: as `roughness`.
        emission: radiance, W/(m² sr).
        opacity: share of the surface that is there.
        normal: normal map, values 0 to 1.
    """

    name: str
    base_color: Tint = (0.8, 0.8, 0.8)
    metallic: Number = 0.0
    roughness: Number = 0.5
    ior: float = 1.5
    specular: Number = 1.0
    specular_color: Tint = (1.0, 1.0, 1.0)
    transmission: Number = 0.0
    transmission_color: Tint | None = None
    thin: bool = True
    attenuation_color: Colour = (1.0, 1.0, 1.0)
    attenuation_distance: float = math.inf
    thickness: float = 0.0
    coat: Number = 0.0
    coat_roughness: Number = 0.0
    emission: Tint = (0.0, 0.0, 0.0)
    opacity: Number = 1.0
    normal: Texture | None = None

    @property
    def through(self) -> Tint:
        """Colour of what is transmitted."""
        return self.base_color if self.transmission_color is None else self.transmission_color

    @property
    def is_clear(self) -> bool:
        """Whether one sees sharply through it, if it transmits."""
        return isinstance(self.roughness, float) and self.roughness <= 2 * SMOOTH
