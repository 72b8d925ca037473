"""Appearance of a surface, as readers of glTF, USD, IFC and MTL describe it; `pbr` converts it to Mitsuba."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

SMOOTH: Final = 0.07
"""Roughness up to which a lobe counts as a mirror: 0.3 degrees, less than a pixel of most pictures."""

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image over a surface.

    Attributes:
        source: (N,) uint8, the bytes of an image file; or the absolute path of one.
        channels: `rgb`, or the single channel that is used.
        srgb: whether the values of `rgb` are sRGB-encoded.
        gain: value becomes gain * value + bias; one number, or one for each of three channels.
        bias: see `gain`.
        threshold: values below it (after gain and bias) become 0, others 1; None to keep them.
        power: exponent, applied to the values last.
        to_uv: (3, 3) transform of texture coordinates; None for the identity.
        wrap: how the image continues beyond its edges.
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
    """Appearance of a surface. Colours are scene-linear; weights lie between 0 and 1.

    Attributes:
        name: name of the material in the file.
        base_color: colour of the diffuse base, of the metal, and of transmitted light.
        metallic: fraction that is metal.
        roughness: perceptual roughness: its square is the microfacet roughness alpha.
        ior: index of refraction.
        specular: weight of the dielectric's reflection at normal incidence.
        specular_color: tint of that reflection.
        transmission: fraction of the light that enters and is transmitted instead of diffusely reflected.
        transmission_color: colour of transmitted light; `base_color` if None.
        thin: whether the transmitting surface is a sheet; otherwise it is the boundary of a solid body.
        attenuation_color: what remains of white light after `attenuation_distance` in a solid body.
        attenuation_distance: metres; infinite for clear bodies.
        thickness: metres that light travels in a solid body, for its attenuation.
        coat: weight of a clear coat.
        coat_roughness: as `roughness`.
        emission: radiance, W/(m² sr).
        opacity: fraction of the surface that is present.
        normal: normal map with values from 0 to 1.
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
        """Colour of transmitted light."""
        return self.base_color if self.transmission_color is None else self.transmission_color

    @property
    def is_clear(self) -> bool:
        """Whether one can see sharply through the surface, if it transmits."""
        return isinstance(self.roughness, float) and self.roughness <= 2 * SMOOTH
