"""Converts textures of Mitsuba 0.5 and 0.6 to Mitsuba 3."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Final

from steadylight.scenes.mitsuba_document import Document
from steadylight.scenes.mitsuba_older_values import colour, number, written
from steadylight.scenes.xml_elements import Element

_SCALED: Final = "texture `scale` is supported only in bumpmap, and around a picture, checkerboard or colour"
_HDR: Final = (".hdr", ".rgbe", ".pfm")
"""Pictures that only Mitsuba decodes, by file extension."""


def _bitmap(document: Document, element: Element) -> None:
    """Convert filter, wrapping and gamma of a picture."""
    filtering = element.text("filter_type")
    if filtering.lower() in {"trilinear", "ewa"}:
        document.note(
            "approximated", element.child("filter_type") or element, f"filter {filtering} became bilinear"
        )
        element.put("string", "filter_type", "bilinear")
    modes = [element.text(f"wrap_mode_{axis}", element.text("wrap_mode", "repeat")) for axis in "uv"]
    chosen = "clamp" if modes[0] in {"zero", "one"} else modes[0]
    if modes != [chosen, chosen]:
        document.note(
            "approximated", element, f"its wrap modes ({', '.join(modes)} along u, v) became {chosen}"
        )
    if chosen != "repeat" or element.child("wrap_mode") is not None:
        element.put("string", "wrap_mode", chosen)
    element.drop("wrap_mode_u", "wrap_mode_v")
    if element.child("gamma") is not None:
        _gamma(document, element)


def _gamma(document: Document, element: Element) -> None:
    """Convert `gamma` of a picture to Mitsuba 3's `raw`: stored values are taken as linear, or as sRGB."""
    gamma = element.child("gamma")
    assert gamma is not None
    value = number(element.text("gamma"))
    element.drop("gamma")
    if value == 1 and element.child("raw") is None:
        element.put("boolean", "raw", "true")
    elif value not in {-1, 0, 1}:
        document.note(
            "approximated", gamma, f"gamma {value:g}: the image is read as its file says, usually as sRGB"
        )


def _vertex_colours(document: Document, element: Element) -> None:
    document.note("converted", element, "`vertexcolors` became mesh_attribute")
    element.attributes["type"] = "mesh_attribute"
    element.put("string", "name", "vertex_color")


def scale_texture(document: Document, element: Element) -> None:
    """Replace a `scale` texture by the texture or colour within it, whose values are multiplied.

    Mitsuba 3 has no such texture. The values of a checkerboard and of a colour are multiplied in the file, those of a
    picture when it is decoded: see `Element.gain`.
    """
    inner, gain = _innermost(document, element)
    found = None if inner is None else _multiplied(deepcopy(inner), gain)
    if found is None:
        document.fault(element.place, _SCALED)
        return
    own = {key: element.attributes[key] for key in ("name", "id") if key in element.attributes}
    kept = {key: value for key, value in found.attributes.items() if key not in {"name", "id"}}
    element.tag, element.attributes, element.gain = found.tag, kept | own, found.gain
    element.children = found.children


def _innermost(document: Document, element: Element) -> tuple[Element | None, list[float]]:
    """What `scale` textures within each other contain, and the product of their scales; None if it cannot be told."""
    gain, seen = [1.0] * 3, set[Element]()
    inner: Element | None = element
    while inner is not None and inner not in seen:  # the document reports textures that contain themselves
        seen.add(inner)
        if inner.tag == "ref":
            inner = document.objects.get(inner.attributes.get("id", ""))
        elif (inner.tag, inner.kind) == ("texture", "scale"):
            scale = colour(inner.child("scale"), 1.0)
            within = [child for child in inner.children if child.name != "scale"]
            if scale is None or len(within) != 1:
                return None, gain
            gain, inner = _product(gain, scale), within[0]
        else:
            return inner, gain
    return None, gain


def _multiplied(element: Element, gain: list[float]) -> Element | None:
    """Multiply the values of a texture or colour in place; None if that is not supported."""
    kind = (element.tag, element.kind)
    if kind == ("texture", "bitmap"):
        element.gain = gain
        return None if element.text("filename").lower().endswith(_HDR) else element
    if kind == ("texture", "checkerboard"):
        for name, default in (("color0", 0.4), ("color1", 0.2)):
            values = colour(element.child(name), default)
            if values is None:
                return None
            element.put("rgb", name, written(_product(values, gain)))
        return element
    values = colour(element, 0.0)
    if values is None:
        return None
    return Element("rgb", {"value": written(_product(values, gain))}, element.place, version=element.version)


def _product(one: list[float], other: list[float]) -> list[float]:
    return [a * b for a, b in zip(one, other, strict=True)]


TEXTURES: Final[dict[tuple[str, str], Callable[[Document, Element], None]]] = {
    ("texture", "bitmap"): _bitmap,
    ("texture", "vertexcolors"): _vertex_colours,
}
