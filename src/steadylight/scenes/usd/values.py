"""Values of shader networks: a number, a colour (a tuple), a texture with a gain and a bias, or texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.surface import Texture


class NotPlain(Exception):  # noqa: N818 - not an error of the file
    """A network does not reduce to textures and constants; the message says where and why."""


@dataclass(frozen=True, eq=False)
class Image:
    """A texture as a value; `uv` is the name of its texture coordinates, or None."""

    texture: Texture
    uv: str | None

    def affine(self, gain: Any, bias: Any) -> Image:
        """The value times `gain` plus `bias`."""
        texture = self.texture
        if texture.threshold is not None or texture.power != 1:
            raise NotPlain("arithmetic after a threshold or a power")
        new_gain = np.multiply(texture.gain, gain)
        new_bias = np.multiply(texture.bias, gain) + np.asarray(bias)
        if texture.channels != "rgb" and (new_gain.ndim or new_bias.ndim):
            if np.ptp(new_gain) or np.ptp(new_bias):
                raise NotPlain("a channel of an image is used as a colour")
            new_gain, new_bias = new_gain.mean(), new_bias.mean()
        return replace(self, texture=replace(texture, gain=_even(new_gain), bias=_even(new_bias)))

    def channel(self, which: int) -> Image:
        """One channel of the texture."""
        if self.texture.channels != "rgb":
            return self
        gain, bias = (np.broadcast_to(np.asarray(part), 3) for part in (self.texture.gain, self.texture.bias))
        if which == 3:
            return replace(self, texture=replace(self.texture, channels="a", srgb=False, gain=1.0, bias=0.0))
        one = replace(self.texture, channels="rgb"[which], gain=float(gain[which]), bias=float(bias[which]))
        return replace(self, texture=one)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Texture coordinates: the name of a primvar (the first set if None), and a (3, 3) map, v upward."""

    name: str | None
    matrix: NDArray[np.float64]

    def mapped(self, matrix: NDArray[np.float64]) -> Coordinates:
        """The coordinates with a further map applied."""
        return replace(self, matrix=matrix @ self.matrix)


def _even(value: NDArray[np.float64]) -> Any:
    """A single number if all channels are equal."""
    return float(value.flat[0]) if np.ptp(value) == 0 else plain(value)


def plain(value: NDArray[np.float64]) -> Any:
    """A number, or a tuple of numbers."""
    return float(value) if value.ndim == 0 else tuple(float(part) for part in value)


@dataclass(frozen=True)
class Node:
    """A node to evaluate, and the requested output."""

    network: Any
    shader: Any
    output: str

    def value(self, name: str, default: Any = None) -> Any:
        """The value of an input; `default` if it is not given."""
        return self.network.value(self.shader, name, default)
