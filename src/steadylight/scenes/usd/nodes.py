"""Evaluates nodes of shader networks: those of UsdShade and MaterialX that yield constants and textures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.image_texture import is_grey
from steadylight.scenes.surface import VertexColour
from steadylight.scenes.usd.values import Coordinates, Image, Node, NotPlain, plain

_CHANNELS: Final = {"r": 0, "g": 1, "b": 2, "a": 3, "x": 0, "y": 1, "z": 2, "w": 3}
_WRAP: Final = {
    "repeat": "repeat",
    "mirror": "mirror",
    "clamp": "clamp",
    "black": "clamp",
    "periodic": "repeat",
    "constant": "clamp",
}


def _uv_texture(node: Node) -> Any:
    """UsdUVTexture."""
    coordinates = node.value("st", Coordinates(None, np.eye(3)))
    if isinstance(coordinates, tuple):
        raise NotPlain("texture coordinates are constant")
    wrap = [str(node.value(name, "repeat")) for name in ("wrapS", "wrapT")]
    image = node.network.image(node.shader, "file", coordinates, {"wrap": _WRAP.get(wrap[0], "repeat")})
    space = str(node.value("sourceColorSpace", "auto"))
    source = image.texture.source
    file = source if isinstance(source, str) else str(node.value("file").path)
    srgb = space == "sRGB"
    if space == "auto" and Path(file).suffix.lower() not in (".exr", ".hdr", ".tif", ".tiff"):
        srgb = not is_grey(image.texture.entry())
    image = replace(image, texture=replace(image.texture, srgb=srgb))
    scale, bias = node.value("scale", (1.0,) * 4), node.value("bias", (0.0,) * 4)
    if not (isinstance(scale, tuple) and isinstance(bias, tuple)):
        raise NotPlain("the scale of a texture is computed")
    if node.output == "a":
        return image.channel(3).affine(scale[3], bias[3])
    return _part(image.affine(scale[:3], bias[:3]), node.output)


def _part(value: Any, output: str) -> Any:
    """The channel that an output names; all channels for `rgb` and `out`."""
    which = _CHANNELS.get(output.removeprefix("out") if output.startswith("out") else output)
    if which is None:
        return value
    return value.channel(which) if isinstance(value, Image) else value[which]


def _primvar(node: Node) -> Any:
    """UsdPrimvarReader, geompropvalue: texture coordinates by name, or the colours of the mesh."""
    name = str(node.value("varname", node.value("geomprop", "st")))
    identifier = str(node.shader.GetIdAttr().Get())
    if identifier.endswith(("float2", "vector2")):
        return Coordinates(name, np.eye(3))
    if name in ("displayColor", "Color", "Col", "color", "vertex_color"):
        return VertexColour()
    raise NotPlain(f"primvar {name} is not read")


def _transform_2d(node: Node) -> Any:
    """UsdTransform2d: scale, then rotate, then translate."""
    given = node.value("in", Coordinates(None, np.eye(3)))
    turn = math.radians(_number(node.value("rotation", 0.0)))
    sx, sy = _pair(node.value("scale", (1.0, 1.0)))
    tx, ty = _pair(node.value("translation", (0.0, 0.0)))
    c, s = math.cos(turn), math.sin(turn)
    return _of_coordinates(given).mapped(np.array([[c * sx, -s * sy, tx], [s * sx, c * sy, ty], [0, 0, 1]]))


def _place_2d(node: Node) -> Any:
    """MaterialX's place2d: about a pivot, divide by the scale, rotate clockwise, subtract the offset."""
    given = _of_coordinates(node.value("texcoord", Coordinates(None, np.eye(3))))
    px, py = _pair(node.value("pivot", (0.0, 0.0)))
    sx, sy = _pair(node.value("scale", (1.0, 1.0)))
    ox, oy = _pair(node.value("offset", (0.0, 0.0)))
    turned = _clockwise(_number(node.value("rotate", 0.0)))
    scaled = np.diag([1 / (sx or 1.0), 1 / (sy or 1.0), 1.0])
    moved = _shift(-ox, -oy)
    order = _number(node.value("operationorder", 0.0))
    inner = scaled @ turned @ moved if order else moved @ turned @ scaled
    return given.mapped(_shift(px, py) @ inner @ _shift(-px, -py))


def _shift(x: float, y: float) -> NDArray[np.float64]:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _clockwise(degrees: float) -> NDArray[np.float64]:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _rotate(node: Node) -> Any:
    """MaterialX's rotate2d, and rotate3d about z."""
    axis = node.value("axis", (0.0, 0.0, 1.0))
    amount = _number(node.value("amount", 0.0))
    if not (isinstance(axis, tuple) and (amount == 0 or (axis[0] == axis[1] == 0))):
        raise NotPlain("texture coordinates are turned in space")
    turn = _clockwise(amount if axis[2] >= 0 else -amount)
    return _of_coordinates(node.value("in", (0.0, 0.0))).mapped(turn)


def _materialx_image(node: Node) -> Any:
    """MaterialX's image and tiledimage."""
    given = _of_coordinates(node.value("texcoord", Coordinates(None, np.eye(3))))
    tiling, offset = (
        _pair(node.value(name, (value,) * 2)) for name, value in (("uvtiling", 1.0), ("uvoffset", 0.0))
    )
    coordinates = given.mapped(_shift(-offset[0], -offset[1]) @ np.diag([*tiling, 1.0]))
    look_up = {
        "wrap": _WRAP.get(str(node.value("uaddressmode", "periodic")), "repeat"),
        "nearest": node.value("filtertype", "linear") == "closest",
    }
    image = node.network.image(node.shader, "file", coordinates, look_up)
    kind = str(node.shader.GetIdAttr().Get())
    image = image.channel(0) if kind.endswith("float") else image
    return _part(image, node.output)


def _texture_coordinates(_: Node) -> Any:
    return Coordinates(None, np.eye(3))


def _passed(name: str) -> Callable[[Node], Any]:
    """A node that passes an input through unchanged."""

    def made(node: Node) -> Any:
        value = node.value(name)
        if value is None:
            raise NotPlain(f"the node {node.shader.GetPrim().GetName()} has no input")
        return _part(value, node.output)

    return made


def _converted(node: Node) -> Any:
    """MaterialX's convert: between colours, vectors and numbers."""
    value = node.value("in", 0.0)
    kind = str(node.shader.GetIdAttr().Get()).rsplit("_", 1)[-1]
    if isinstance(value, tuple) and kind == "float":
        return value[0]
    if isinstance(value, float) and kind[-1] in "234":
        return (value,) * int(kind[-1])
    return value


def _arithmetic(operation: str) -> Callable[[Node], Any]:
    """add, subtract, multiply, divide: numbers with numbers, textures and coordinates with numbers."""

    def made(node: Node) -> Any:
        neutral = 1.0 if operation in ("multiply", "divide") else 0.0
        a, b = node.value("in1", neutral), node.value("in2", neutral)
        if not isinstance(a, float | tuple) and not isinstance(b, float | tuple):
            raise NotPlain(f"a texture is combined with another one ({operation})")
        if isinstance(a, float | tuple) and isinstance(b, float | tuple):
            return _combined(operation, a, b)
        if isinstance(a, Coordinates):
            return a.mapped(_on_coordinates(operation, _pair(b)))
        if isinstance(b, Coordinates) and operation in ("add", "multiply"):
            return b.mapped(_on_coordinates(operation, _pair(a)))
        if isinstance(a, Image):
            return a.affine(*_as_affine(operation, b))
        if isinstance(b, Image) and operation != "divide":
            if operation == "subtract":
                return b.affine(-1.0, _three(a))
            return b.affine(*_as_affine(operation, a))
        raise NotPlain(f"the node {node.shader.GetPrim().GetName()} computes more than a gain and a bias")

    return made


def _three(value: Any) -> Any:
    """The first three of four channels; other values are unchanged."""
    return value[:3] if isinstance(value, tuple) else value


def _as_affine(operation: str, value: Any) -> tuple[Any, Any]:
    """Gain and bias equivalent to an operation with a texture on its left."""
    number = np.asarray(_three(value), dtype=np.float64)
    match operation:
        case "add":
            return 1.0, number
        case "subtract":
            return 1.0, -number
        case "multiply":
            return number, 0.0
    return 1.0 / np.where(number == 0, 1.0, number), 0.0


def _combined(operation: str, a: Any, b: Any) -> Any:
    """The result of an operation on two constants."""
    x, y = (np.asarray(part, dtype=np.float64) for part in (a, b))
    try:
        found = {
            "add": lambda: x + y,
            "subtract": lambda: x - y,
            "multiply": lambda: x * y,
            "divide": lambda: x / np.where(y == 0, 1.0, y),
        }[operation]()
    except ValueError:
        raise NotPlain("values of different sizes are combined") from None
    return plain(np.asarray(found))


def _on_coordinates(operation: str, pair: tuple[float, float]) -> NDArray[np.float64]:
    x, y = pair
    match operation:
        case "add":
            return _shift(x, y)
        case "subtract":
            return _shift(-x, -y)
        case "multiply":
            return np.diag([x, y, 1.0])
    return np.diag([1 / (x or 1.0), 1 / (y or 1.0), 1.0])


def _mix(node: Node) -> Any:
    """A mixture, bg (1 - mix) + fg mix, of which at most one input is a texture."""
    bg, fg = node.value("bg", 0.0), node.value("fg", 0.0)
    weight = node.value("mix", 0.0)
    if isinstance(weight, float) and weight in (0.0, 1.0):
        return fg if weight else bg
    if isinstance(weight, Image) and isinstance(bg, float | tuple) and isinstance(fg, float | tuple):
        low, high = np.asarray(_three(bg)), np.asarray(_three(fg))
        return weight.affine(high - low, low)
    if not isinstance(weight, float):
        raise NotPlain("textures are mixed by a texture")
    if isinstance(bg, float | tuple) and isinstance(fg, float | tuple):
        return plain(np.asarray(bg) * (1 - weight) + np.asarray(fg) * weight)
    if isinstance(fg, Image) and isinstance(bg, float | tuple):
        return fg.affine(weight, np.asarray(_three(bg)) * (1 - weight))
    if isinstance(bg, Image) and isinstance(fg, float | tuple):
        return bg.affine(1 - weight, np.asarray(_three(fg)) * weight)
    raise NotPlain("two textures are mixed")


def _inverted(node: Node) -> Any:
    amount, value = node.value("amount", 1.0), node.value("in", 0.0)
    if isinstance(value, Image):
        return value.affine(-1.0, _three(amount))
    if isinstance(value, float | tuple):
        return _combined("subtract", amount, value)
    raise NotPlain("the inverted value is not a texture")


def _extracted(node: Node) -> Any:
    value = node.value("in", (0.0, 0.0, 0.0))
    which = int(_number(node.value("index", 0.0)))
    if isinstance(value, Image):
        return value.channel(which)
    if isinstance(value, tuple) and 0 <= which < len(value):
        return value[which]
    raise NotPlain("a channel is taken of a value that is not a colour")


def _normal_map(node: Node) -> Any:
    """MaterialX's normalmap: values between -1 and 1, as in UsdPreviewSurface."""
    value, scale = node.value("in"), node.value("scale", 1.0)
    if not isinstance(value, Image):
        raise NotPlain("a normal map is not a texture")
    strength = _number(scale if isinstance(scale, float) else _pair(scale)[0])
    gain = np.array([strength, strength, 1.0])
    return value.affine(2 * gain, -gain)


def _number(value: Any) -> float:
    if isinstance(value, float):
        return value
    raise NotPlain("a parameter of a node is computed")


def _pair(value: Any) -> tuple[float, float]:
    if isinstance(value, float):
        return value, value
    if isinstance(value, tuple) and len(value) >= 2:
        return float(value[0]), float(value[1])
    raise NotPlain("a parameter of a node is computed")


def _of_coordinates(value: Any) -> Coordinates:
    if isinstance(value, Coordinates):
        return value
    raise NotPlain("texture coordinates are computed")


NODES: Final[dict[str, Callable[[Node], Any]]] = {
    "UsdUVTexture": _uv_texture,
    "UsdUVTexture_23": _uv_texture,
    "UsdTransform2d": _transform_2d,
    **{
        f"UsdPrimvarReader_{kind}": _primvar
        for kind in ("float2", "float3", "float4", "vector", "point", "normal")
    },
    "UsdPrimvarReader": _primvar,
    "geompropvalue": _primvar,
    "geomcolor": lambda _: VertexColour(),
    "texcoord": _texture_coordinates,
    "image": _materialx_image,
    "tiledimage": _materialx_image,
    "place2d": _place_2d,
    "rotate2d": _rotate,
    "rotate3d": _rotate,
    "constant": _passed("value"),
    "dot": _passed("in"),
    "separate2": _passed("in"),
    "separate3": _passed("in"),
    "separate4": _passed("in"),
    "saturate": _passed("in"),
    "clamp": _passed("in"),
    "convert": _converted,
    "add": _arithmetic("add"),
    "subtract": _arithmetic("subtract"),
    "multiply": _arithmetic("multiply"),
    "divide": _arithmetic("divide"),
    "mix": _mix,
    "invert": _inverted,
    "extract": _extracted,
    "normalmap": _normal_map,
}
