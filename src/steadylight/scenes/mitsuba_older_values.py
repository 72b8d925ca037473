"""Converts numbers, colours and transforms of older Mitsuba files to Mitsuba 3."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from scipy.constants import Boltzmann, Planck, speed_of_light

from steadylight.scenes.mitsuba_document import Document
from steadylight.scenes.xml_elements import Element

_HEX = re.compile(r"#[0-9a-fA-F]{6}")
_UV = ("uscale", "vscale", "uoffset", "voffset")


def colour(element: Element | None, default: float) -> list[float] | None:
    """The value of a property that is a constant colour, linear RGB; None if it is a texture, or cannot be read.

    Args:
        element: the property.
        default: value of each channel if there is no such property.
    """
    if element is None:
        return [default] * 3
    if element.tag not in {"rgb", "float", "spectrum"} or element.kind:
        return None
    try:
        values = [float(part) for part in split(element.attributes.get("value", ""))]
    except ValueError:
        return None
    return values * 3 if len(values) == 1 else values if len(values) == 3 else None


def number(text: str) -> float:
    """A number, or NaN; Mitsuba's parser reports what is wrong with the text."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def split(text: str) -> list[str]:
    """Split numbers as Mitsuba separates them."""
    return [part for part in re.split(r"[\s,;]+", text) if part]


def written(values: Sequence[float]) -> str:
    """Format numbers as an attribute."""
    return ", ".join(repr(float(value)) for value in values)


def modernise_value(document: Document, element: Element) -> None:
    """Convert a property, or the properties that textures of all kinds have, in place."""
    if element.tag == "blackbody":
        attributes = element.attributes
        _blackbody(document, element, attributes.get("temperature", ""), attributes.get("scale", "1"))
    elif element.kind == "blackbody":
        _blackbody(document, element, element.text("temperature"), element.text("scale", "1"))
    elif element.tag in {"rgb", "srgb", "spectrum"}:
        _colour(element)
    elif element.tag == "lookAt":
        element.tag = "lookat"
    elif element.tag == "texture" and any(element.child(name) is not None for name in _UV):
        _texture_coordinates(element)
    elif element.tag == "bsdf" and element.kind == "diffuse":
        alone = element.child("reflectance") is None
        reflectance = element.child("diffuse_reflectance")
        if reflectance is not None and alone:
            reflectance.attributes["name"] = "reflectance"


def _colour(element: Element) -> None:
    """Convert hexadecimal and sRGB colours, and spectra of three values, to `<rgb>`."""
    if element.kind or element.version >= (2,):
        return
    element.attributes.pop("intent", None)
    text = element.attributes.get("value", "").strip()
    numbers = split(text)
    if _HEX.fullmatch(text):
        numbers = [repr(int(text[at : at + 2], 16) / 255) for at in (1, 3, 5)]
    try:
        values = np.array([float(number) for number in numbers])
    except ValueError:
        return  # a spectrum with wavelengths; Mitsuba's parser reports anything else
    if element.tag == "srgb":
        values = np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)
    if element.tag == "spectrum" and values.size != 3:
        return
    if element.tag == "srgb" or values.size == 3:
        element.tag = "rgb"
        element.attributes["value"] = written(values.tolist())


def _blackbody(document: Document, element: Element, temperature: str, scale: str) -> None:
    """A black body's radiance as a spectrum of samples, W/(m² sr nm): Mitsuba 3 has it for spectral rendering only."""
    try:
        kelvin, factor = float(temperature.strip().rstrip("kK")), float(scale)
    except ValueError:
        kelvin = factor = float("nan")
    if not (kelvin > 0 and factor >= 0 and np.isfinite([kelvin, factor]).all()):
        document.fault(
            element.place, "a black body needs a temperature above 0, in K, and a scale of at least 0"
        )
        kelvin = factor = 1.0
    nanometres = np.arange(360.0, 831.0, 5.0)
    metres = nanometres * 1e-9
    with np.errstate(over="ignore"):
        planck = 2 * Planck * speed_of_light**2 / metres**5
        planck /= np.expm1(Planck * speed_of_light / (Boltzmann * kelvin * metres))
    pairs = zip(nanometres.tolist(), (factor * planck * 1e-9).tolist(), strict=True)
    element.tag, element.children = "spectrum", []
    kept = {"name": element.name} if element.name else {}
    element.attributes = kept | {"value": ", ".join(f"{at:g}:{value!r}" for at, value in pairs)}


def _texture_coordinates(element: Element) -> None:
    """Convert scale and offset of texture coordinates to one transform: uv · scale + offset."""
    scale = [element.text(name, "1") for name in _UV[:2]]
    offset = [element.text(name, "0") for name in _UV[2:]]
    place = next(child.place for child in element.children if child.name in _UV)
    element.drop(*_UV)
    steps = (("scale", scale), ("translate", offset))
    transform = Element("transform", {"name": "to_uv"}, place, version=element.version)
    transform.children = [
        Element(tag, {"x": values[0], "y": values[1]}, place, version=element.version)
        for tag, values in steps
    ]
    element.children.append(transform)
