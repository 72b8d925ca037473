"""Inputs of a surface shader as numbers, colours and textures for our materials; others are noted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from steadylight.scenes.surface import Texture, Tint, VertexColour
from steadylight.scenes.usd.networks import Network
from steadylight.scenes.usd.values import Coordinates, Image, NotPlain


@dataclass
class Inputs:
    """Inputs of a surface shader.

    Attributes:
        network: evaluates the inputs.
        shader: the surface shader.
        other: inputs of the UsdPreviewSurface of the same material, for colours that cannot be evaluated.
        lost: what is left out, as text.
        used: textures that were used.
    """

    network: Network
    shader: Any
    other: Inputs | None
    lost: list[str]
    used: list[Image] = field(default_factory=list)

    def raw(self, name: str, default: Any) -> Any:
        """The value of an input; if it cannot be evaluated, the default, with a remark in `lost`."""
        try:
            value = self.network.value(self.shader, name, default)
        except NotPlain as reason:
            self.lost.append(f"{name}: {reason}")
            return default
        if isinstance(value, Coordinates):
            self.lost.append(f"{name}: texture coordinates are shown as a colour")
            return default
        if isinstance(value, Image):
            self.used.append(value)
        return value

    def number(self, name: str, default: float) -> Any:
        """A number, or one channel of a texture."""
        value = self.raw(name, default)
        if isinstance(value, Image):
            return value.channel(0).texture
        if isinstance(value, tuple):
            return float(np.mean(value))
        if isinstance(value, VertexColour | str):
            self.lost.append(f"{name}: is not a number; {default:g} is used")
            return default
        return float(value)

    def constant(self, name: str, default: float) -> float:
        """A number; the default for a texture."""
        value = self.number(name, default)
        if isinstance(value, Texture):
            self.lost.append(f"{name}: a texture; {default:g} is used")
            return default
        return float(value)

    def colour(self, name: str, default: tuple[float, float, float]) -> Tint:
        """A colour, a texture, or the colours of the mesh."""
        if self.other is not None:
            try:
                self.network.value(self.shader, name)
            except NotPlain as reason:
                twin = {"base_color": "diffuseColor", "emission_color": "emissiveColor"}.get(name, "")
                self.lost.append(
                    f"{name}: {reason}" + ("; that of its UsdPreviewSurface is used" if twin else "")
                )
                return self.other.colour(twin, default) if twin else default
        value = self.raw(name, default)
        if isinstance(value, Image):
            return value.texture
        if isinstance(value, float | bool):
            return (float(value),) * 3
        if isinstance(value, tuple) and len(value) >= 3:
            return value[0], value[1], value[2]
        return value if isinstance(value, VertexColour) else default

    def flag(self, name: str) -> bool:
        """Whether an input is true."""
        return bool(self.raw(name, default=False))

    def weighted(self, colour: Tint, weight: Any) -> Tint:
        """A colour times a number."""
        if weight == 1.0:
            return colour
        if isinstance(colour, tuple) and isinstance(weight, float):
            return colour[0] * weight, colour[1] * weight, colour[2] * weight
        try:
            if isinstance(colour, Texture) and isinstance(weight, float):
                return Image(colour, None).affine(weight, 0.0).texture
            if isinstance(weight, Texture) and isinstance(colour, tuple):
                return Image(weight, None).affine(colour, 0.0).texture
        except NotPlain as reason:
            self.lost.append(str(reason))
            return colour
        self.lost.append("a texture that weights another one")
        return colour

    def normal(self, name: str) -> Texture | None:
        """A normal map with values between 0 and 1."""
        value = self.raw(name, None)
        if not isinstance(value, Image):
            return None
        if value.texture.gain in (1.0, (1.0, 1.0, 1.0)):
            return value.texture
        return value.affine(0.5, 0.5).texture

    def mention(self, text: str, names: Mapping[str, float]) -> None:
        """Add to `lost` if an input differs from the value at which it has no effect."""
        for name, without in names.items():
            value = self.raw(name, without)
            if isinstance(value, Image) or (isinstance(value, float) and abs(value - without) > 1e-3):
                self.lost.append(text)
