"""Evaluates shader networks (UsdShade, MaterialX) that reduce to constants and textures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from steadylight.scenes.surface import Texture
from steadylight.scenes.usd.nodes import NODES
from steadylight.scenes.usd.stage import Assets
from steadylight.scenes.usd.values import Coordinates, Image, Node, NotPlain

_DEEPEST: Final = 60
_FLIP: Final = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
"""Converts texture coordinates with v upward to those with v downward, and back."""
_NODE: Final = re.compile(
    r"^ND_(.+?)_((?:color|vector)[234](?:FA)?|float|integer|boolean|string|filename|surfaceshader|bsdf|edf)"
)


class Network:
    """Evaluates inputs of shaders."""

    def __init__(self, assets: Assets, where: str) -> None:
        self.assets = assets
        self.where = where
        self.depth = 0

    def value(self, shader: Any, name: str, default: Any = None) -> Any:
        """The value of an input (see `values`); `default` if it is not given."""
        from pxr import UsdShade

        given = shader.GetInput(name)
        if not given:
            return default
        producers = UsdShade.Utils.GetValueProducingAttributes(given)
        if not producers:
            return default
        attribute = producers[0]
        if UsdShade.Output.IsOutput(attribute):
            return self.node(UsdShade.Shader(attribute.GetPrim()), str(attribute.GetBaseName()))
        value = attribute.Get()
        return default if value is None else _constant(value, str(attribute.GetColorSpace()))

    def node(self, shader: Any, output: str) -> Any:
        """The value that a node computes.

        Raises:
            NotPlain: the node or one of its inputs is not supported.
        """
        from pxr import UsdShade

        if not shader:
            raise NotPlain("a connection has no source")
        kind = node_of(shader)
        made = NODES.get(kind)
        if made is None:
            raise NotPlain(f"the node {shader.GetPrim().GetName()} ({kind or 'unknown'}) is not supported")
        self.depth += 1
        try:
            if self.depth > _DEEPEST:
                raise NotPlain("its nodes are connected in a cycle, or in too long a chain")
            return made(Node(self, UsdShade.Shader(shader.GetPrim()), output))
        finally:
            self.depth -= 1

    def image(self, shader: Any, asset_name: str, coordinates: Any, look_up: dict[str, Any]) -> Image:
        """An image file as a value."""
        from pxr import Sdf, UsdShade

        given = shader.GetInput(asset_name)
        producers = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
        asset = producers[0].Get() if producers else None
        if not isinstance(asset, Sdf.AssetPath) or not asset.path:
            raise NotPlain(f"the image {shader.GetPrim().GetName()} names no file")
        source = self.assets.source(asset, self.where)
        if source is None:
            raise NotPlain(f"{asset.path} is missing")
        if not isinstance(coordinates, Coordinates):
            raise NotPlain("texture coordinates are computed")
        space = str(producers[0].GetColorSpace())
        matrix = _FLIP @ coordinates.matrix @ _FLIP
        texture = Texture(source, to_uv=None if np.allclose(matrix, np.eye(3)) else matrix, **look_up)
        if "srgb" in space.lower() or "g22" in space.lower():
            texture = replace(texture, srgb=True)
        return Image(texture, coordinates.name)


def node_of(shader: Any) -> str:
    """Kind of a node, without MaterialX's type suffixes."""
    name = str(shader.GetShaderId() or shader.GetIdAttr().Get() or "")
    if not name.startswith("ND_"):
        return name
    found = _NODE.match(name)
    return found[1] if found else name.removeprefix("ND_")


def _constant(value: Any, space: str) -> Any:
    """A number or a tuple of numbers; strings and file names are unchanged."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        return float(value)
    try:
        parts = tuple(float(part) for part in value)
    except TypeError:
        return value
    if "srgb" in space.lower():
        return tuple(part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return parts


def names_of(values: Sequence[Any]) -> list[str]:
    """Names of the texture coordinates that values use, each once."""
    return list(dict.fromkeys(value.uv for value in values if isinstance(value, Image) and value.uv))
