"""Radiance's materials as Mitsuba's.

- Ward's lobe has the roughness that Mitsuba calls `alpha`, with the Beckmann distribution. Its strength at grazing
  angles differs: Mitsuba's follows Fresnel.
- `plastic` becomes a dielectric layer, whose refractive index gives the specularity at normal incidence, over a diffuse
  base of the same colour: in both programs, the base gets the light that the layer lets in.
- `glass` is `renderers/mitsuba/bsdf/glass.py`, with Radiance's own formula.
- `trans` scatters equally in both directions; what it transmits straight is a pane mixed in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.radiance.grammar import Primitive
from steadylight.scenes.radiance.surfaces import fault

RGB = tuple[float, float, float]
BSDF = dict[str, Any]

SMOOTH: Final = 0.02
"""Roughness below which gloss counts as a mirror: a lobe two degrees wide."""

FAINT: Final = 1e-3
"""Specularity up to which gloss is left out."""

GLASS: Final = 1.52
"""Refractive index of `glass` without one of its own."""

_COUNTS = {
    "plastic": (5,),
    "metal": (5,),
    "trans": (7,),
    "plastic2": (6,),
    "metal2": (6,),
    "trans2": (8,),
    "ashik2": (8,),
    "glass": (3, 4),
    "dielectric": (5,),
    "interface": (8,),
    "mirror": (3,),
    "light": (3,),
    "illum": (3,),
    "glow": (4,),
    "spotlight": (7,),
}
_FUNCTIONS = {"plasfunc": 4, "plasdata": 4, "metfunc": 4, "metdata": 4, "transfunc": 6, "transdata": 6}
_REFUSED = {
    "antimatter": "cut the shape out in the modelling program",
    "mist": "participating media are not rendered; remove it",
    "prism1": "use dielectric, or trans",
    "prism2": "use dielectric, or trans",
    "BRTDfunc": "use plastic, metal or trans",
    "BSDF": "use trans, or glass",
    "aBSDF": "use trans, or glass",
    "WGMDfunc": "use plastic, metal or trans",
}
LIGHTS: Final = ("light", "illum", "glow", "spotlight")
MATERIALS: Final = (*_COUNTS, *_FUNCTIONS, *_REFUSED)
"""Kinds of materials."""


@dataclass(frozen=True)
class Material:
    """A converted material.

    Attributes:
        bsdf: Mitsuba's BSDF.
        radiance: radiance emitted from the front, W/(m² sr), RGB; None if it does not emit.
        kind: kind of Radiance material.
    """

    bsdf: BSDF
    radiance: RGB | None = None
    kind: str = "plastic"


class Gloss(NamedTuple):
    """Specularity at normal incidence, and roughness."""

    specular: float
    roughness: float


Tell = Callable[[Literal["converted", "approximated", "left out", "warning"], str, str], None]


def material_of(given: Primitive, tell: Tell) -> Material:
    """Convert a material.

    Args:
        given: primitive of the material.
        tell: receives kind, element and text of a note.

    Raises:
        SceneError: its arguments are wrong, or it cannot be converted.
    """
    _check(given)
    kind, numbers = given.kind, given.numbers
    if kind in LIGHTS:
        red, green, blue = numbers[:3]
        return Material(_diffuse((0.0, 0.0, 0.0)), (red, green, blue), kind)
    if kind in _CLEAR:
        return Material(_CLEAR[kind](given, tell), kind=kind)
    if kind == "ashik2":
        return Material(_ashikhmin(given, tell), kind=kind)
    gloss = _gloss(given, tell)
    colour = _colour(numbers[:3], given, tell)
    if kind.startswith("trans"):
        return Material(_trans(given, colour, gloss, tell), kind="trans")
    make = _metal if kind.startswith("met") else _plastic
    return Material(make(given, colour, gloss, tell), kind=kind)


def _check(given: Primitive) -> None:
    """Check that a material can be converted, and has the numbers that it needs.

    Raises:
        SceneError: it cannot, or has not.
    """
    kind, numbers = given.kind, given.numbers
    if kind in _REFUSED:
        raise fault(
            given,
            f"cannot be rendered by the Mitsuba renderer: {_REFUSED[kind]}; or give --renderer radiance",
        )
    wanted = _COUNTS.get(kind)
    if wanted is not None and len(numbers) not in wanted:
        raise fault(given, f"has {len(numbers)} numbers where {' or '.join(map(str, wanted))} are expected")
    if kind in _FUNCTIONS and len(numbers) < _FUNCTIONS[kind]:
        raise fault(given, f"has {len(numbers)} numbers where at least {_FUNCTIONS[kind]} are expected")
    if min(numbers[:3] if kind in LIGHTS else numbers, default=0) < 0 and kind not in (
        "dielectric",
        "interface",
    ):
        raise fault(given, "has a negative number")


def _gloss(given: Primitive, tell: Tell) -> Gloss:
    """Specularity and roughness."""
    kind, numbers = given.kind, given.numbers
    if kind in _FUNCTIONS:
        what = "a diffusely translucent surface" if kind.startswith("trans") else "a diffuse surface"
        tell("approximated", given.name, f"`{kind}` becomes {what} of its colour: its function is left out")
        return Gloss(0.0, 0.0)
    if not kind.endswith("2"):
        return Gloss(numbers[3], numbers[4])
    tell("approximated", given.name, "its two roughnesses become their mean: gloss is isotropic")
    return Gloss(numbers[3], float(np.sqrt(numbers[4] * numbers[5])))


def rgb(colour: tuple[float, ...] | NDArray[np.float64]) -> BSDF:
    """A colour as a Mitsuba entry."""
    return {"type": "rgb", "value": [float(channel) for channel in colour]}


def refractive_index(specularity: float) -> float:
    """Refractive index of a dielectric with this specularity at normal incidence."""
    root = float(np.sqrt(specularity))
    return (1 + root) / (1 - root)


def _colour(numbers: tuple[float, ...], given: Primitive, tell: Tell) -> RGB:
    """A reflectance, at most 1."""
    if max(numbers) > 1:
        tell(
            "warning", given.name, f"{given.kind} reflects more than it receives: its colour is clipped to 1"
        )
    red, green, blue = (min(number, 1.0) for number in numbers)
    return red, green, blue


def _twosided(bsdf: BSDF) -> BSDF:
    return {"type": "twosided", "bsdf": bsdf}


def _diffuse(colour: RGB) -> BSDF:
    return {"type": "diffuse", "reflectance": rgb(colour)}


def _plastic(given: Primitive, colour: RGB, gloss: Gloss, tell: Tell) -> BSDF:
    specular, roughness = gloss
    if specular >= 1:
        raise fault(
            given, f"has specularity {specular:g}; that of plastic must be below 1 (and is usually below 0.1)"
        )
    if specular < FAINT:
        return _twosided(_diffuse(colour))
    layer = {
        "diffuse_reflectance": rgb(colour),
        "int_ior": refractive_index(specular),
        "ext_ior": 1.0,
        "nonlinear": False,
    }
    if roughness < SMOOTH:
        tell("converted", given.name, f"specularity {specular:g} becomes a smooth dielectric layer")
        return _twosided({"type": "plastic", **layer})
    tell(
        "approximated",
        given.name,
        f"Ward's gloss of roughness {roughness:g} becomes a rough dielectric layer",
    )
    return _twosided({"type": "roughplastic", "alpha": roughness, "distribution": "beckmann", **layer})


def _metal(given: Primitive, colour: RGB, gloss: Gloss, tell: Tell) -> BSDF:
    specular, roughness = gloss
    if specular < FAINT:
        return _twosided(_diffuse(colour))
    mirror: BSDF = {"type": "conductor"}
    if roughness >= SMOOTH:
        mirror = {"type": "roughconductor", "alpha": roughness, "distribution": "beckmann"}
        tell("approximated", given.name, f"Ward's gloss of roughness {roughness:g} becomes a rough conductor")
    mirror |= {"material": "none", "specular_reflectance": rgb(colour)}
    if specular >= 1 - FAINT:
        return _twosided(mirror)
    tell(
        "converted",
        given.name,
        f"metal of specularity {specular:g} becomes a mixture of mirror and diffuse surface",
    )
    return _twosided(_mixed(specular, _diffuse(colour), mirror))


def _mixed(weight: float, first: BSDF, second: BSDF) -> BSDF:
    """A blend of two BSDFs; `weight` is that of the second."""
    return {"type": "blendbsdf", "weight": float(weight), "first": first, "second": second}


def _trans(given: Primitive, colour: RGB, shine: Gloss, tell: Tell) -> BSDF:
    gloss, roughness = shine
    transmitted, straight = given.numbers[-2:] if given.kind in _COUNTS else given.numbers[4:6]
    for name, value in (
        ("specularity", gloss),
        ("transmissivity", transmitted),
        ("transmitted specularity", straight),
    ):
        if value > 1:
            raise fault(given, f"has {name} {value:g}; it must be between 0 and 1")
    scattered = 1 - transmitted * straight
    bsdf = _scattering(colour, transmitted * (1 - straight) / scattered if scattered > 0 else 0.0)
    if scattered < 1 - FAINT:
        if roughness >= SMOOTH:
            tell("approximated", given.name, "light transmitted into a cone goes straight through instead")
        pane = {
            "type": "thindielectric",
            "int_ior": 1.0001,
            "ext_ior": 1.0,
            "specular_transmittance": rgb(colour),
        }
        bsdf = _mixed(1 - scattered, bsdf, pane) if scattered > FAINT else pane
    if gloss >= FAINT:
        mirror: BSDF = {"type": "conductor", "material": "none"}
        if roughness >= SMOOTH:
            mirror = {
                "type": "roughconductor",
                "material": "none",
                "alpha": roughness,
                "distribution": "beckmann",
            }
            tell(
                "approximated",
                given.name,
                f"Ward's gloss of roughness {roughness:g} becomes a rough conductor",
            )
        bsdf = _mixed(gloss, bsdf, _twosided(mirror))
    return bsdf


def _scattering(colour: RGB, transmitted: float) -> BSDF:
    """A surface that scatters a part of the light that it does not absorb to the far side."""
    if transmitted < FAINT:
        return _twosided(_diffuse(colour))
    return {
        "type": "principledthin",
        "base_color": rgb(colour),
        "diff_trans": 2 * transmitted,
        "spec_trans": 0.0,
        "eta": 1.0,
        "roughness": 0.5,  # its diffuse lobe is then Lambert's within 1 %
    }


def _ashikhmin(given: Primitive, tell: Tell) -> BSDF:
    numbers = given.numbers
    colour = _colour(numbers[:3], given, tell)
    specular = float(np.mean(numbers[3:6]))
    power = max(float(np.sqrt(numbers[6] * numbers[7])), 0.1)
    roughness = float(np.sqrt(2 / (power + 2)))
    text = f"Ashikhmin's gloss becomes a rough dielectric layer of roughness {roughness:.2g}"
    tell("approximated", given.name, text)
    return _plastic(given, colour, Gloss(min(specular, 0.99), roughness), lambda *_: None)


def _mirror(given: Primitive, tell: Tell) -> BSDF:
    if given.words:
        text = f"its substitute material ({given.words[0]}): it is always a mirror"
        tell("left out", given.name, text)
    colour = _colour(given.numbers, given, tell)
    return _twosided({"type": "conductor", "material": "none", "specular_reflectance": rgb(colour)})


def _glass(given: Primitive, tell: Tell) -> BSDF:
    """An absorbing pane: our own plugin, because Mitsuba's panes absorb the same at all angles."""
    index = _index(given, given.numbers[3] if len(given.numbers) == 4 else GLASS)
    transmissivity = _colour(given.numbers[:3], given, tell)
    return {"type": "glasspane", "transmissivity": rgb(transmissivity), "ior": float(index)}


def _dielectric(given: Primitive, tell: Tell) -> BSDF:
    numbers = given.numbers
    two = given.kind == "interface"
    colours = [*numbers[:3], *(numbers[4:7] if two else ())]
    if min(colours) < 0:
        raise fault(given, "has a negative number")
    if min(colours) < 1 - FAINT:
        tell("left out", given.name, "absorption inside it: solid glass is clear")
    outside = _index(given, numbers[7]) if two else 1.0
    return {"type": "dielectric", "int_ior": _index(given, numbers[3]), "ext_ior": outside}


def _index(given: Primitive, index: float) -> float:
    if index < 1:
        raise fault(given, f"has refractive index {index:g}; it must be at least 1")
    return index


_CLEAR: dict[str, Callable[[Primitive, Tell], BSDF]] = {
    "mirror": _mirror,
    "glass": _glass,
    "dielectric": _dielectric,
    "interface": _dielectric,
}
