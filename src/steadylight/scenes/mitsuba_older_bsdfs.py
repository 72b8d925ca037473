"""Converts BSDFs of Mitsuba 0.5 and 0.6 to Mitsuba 3: exactly where possible, otherwise to the nearest one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from steadylight.scenes.mitsuba_document import Document
from steadylight.scenes.mitsuba_older_values import colour, split, written
from steadylight.scenes.xml_elements import Element

_TEXTURED = {"texture", "ref"}


def _number(element: Element, name: str, default: float) -> float | None:
    """The value of a property that is a constant number; None for a texture or a word."""
    child = element.child(name)
    values = colour(child, default)
    return None if values is None else float(np.mean(values))


def _nested(element: Element) -> list[Element]:
    """The BSDFs inside a BSDF."""
    return [
        child for child in element.children if child.tag == "bsdf" or (child.tag == "ref" and not child.name)
    ]


def _blend(outer: Element, kind: str, weight: Element, first: Element, second: Element) -> None:
    """Make an element a blend: (1 - weight) · first + weight · second."""
    outer.attributes["type"] = kind
    weight.attributes["name"] = "weight"
    for nested in (first, second):
        nested.attributes.pop("name", None)
    outer.children = [weight, first, second]


def _weight(outer: Element, value: float) -> Element:
    return Element("float", {"value": repr(value)}, outer.place, version=outer.version)


def _glossy(document: Document, element: Element) -> None:
    """Convert `phong` and `ward` to a blend of a diffuse and a rough mirror that reflect as much as the two lobes.

    With constant colours, both reflect the same fraction of uniform incident light. Towards the horizon, a phong lobe
    loses more. A textured reflectance of the lobe becomes the weight; the diffuse part is then darker by that weight.
    """
    kind = element.kind
    diffuse, specular = (element.child(f"{part}_reflectance") for part in ("diffuse", "specular"))
    kd, ks = colour(diffuse, 0.5), colour(specular, 0.2)
    base, lobe = element.within("bsdf", "diffuse"), element.within("bsdf", "roughconductor")
    lobe.put("string", "material", "none")
    share = _roughness(document, element, lobe)
    if share is None:
        return
    if ks is None:
        assert specular is not None
        weight = specular
    else:
        strongest = max(ks) + max(kd) if kd is not None else 1.0
        if strongest > 1:  # as `ensureEnergyConservation` of Mitsuba 0.6, but for all channels alike
            kd, ks = kd and [value / strongest for value in kd], [value / strongest for value in ks]
        ks = [share * value for value in ks]
        share = max(ks) / (max(ks) + max(kd)) if kd is not None and max(ks) + max(kd) > 0 else max(ks)
        if kd is not None:
            kd = [min(value / (1 - share), 1.0) if share < 1 else 0.0 for value in kd]
        lobe.put("rgb", "specular_reflectance", written([value / share if share else 0.0 for value in ks]))
        weight = _weight(element, share)
    if kd is not None:
        base.put("rgb", "reflectance", written(kd))
    else:
        assert diffuse is not None
        base.children.append(diffuse)
        diffuse.attributes["name"] = "reflectance"
    exact = kd is not None and ks is not None
    rest = "" if exact else "; the diffuse part is darker by what the lobe reflects"
    text = f"`{kind}` became blendbsdf of diffuse and roughconductor{rest}"
    document.note("approximated", element, text)
    _blend(element, "blendbsdf", weight, base, lobe)


def _roughness(document: Document, element: Element, lobe: Element) -> float | None:
    """Set the width of the lobe, as that of a Beckmann distribution.

    Returns:
        Fraction of uniform incident light that the lobe reflects; None, after adding a fault, without a valid width.
    """
    if element.kind == "phong":
        exponent = _number(element, "exponent", 30.0)
        if exponent is None or not exponent >= 0:
            place = (element.child("exponent") or element).place
            document.fault(place, "`phong`: the exponent must be a number of at least 0")
            return None
        lobe.put("float", "alpha", repr(float(np.clip(np.sqrt(2 / (exponent + 2)), 1e-4, 1))))
        return _phong_reflectance(exponent)
    for axis in "uv":
        alpha = element.child(f"alpha_{axis}") or element.child("alpha")
        if alpha is None:
            lobe.put("float", f"alpha_{axis}", "0.1")
        else:
            attributes = alpha.attributes | {"name": f"alpha_{axis}"}
            lobe.children.append(
                Element(alpha.tag, attributes, alpha.place, alpha.children, version=alpha.version)
            )
    return 1.0


def _phong_reflectance(exponent: float) -> float:
    """Fraction of uniform light that the lobe (n + 2) / 2 pi cos^n a reflects above the horizon."""
    steps = (np.arange(48) + 0.5) / 48
    incoming, around = np.sqrt(steps)[:, None, None], 2 * np.pi * steps[:, None]
    a = steps ** (1 / (exponent + 1))  # distributed as cos^n about the mirrored direction
    outgoing = incoming * a + np.sqrt(1 - incoming**2) * np.sqrt(1 - a**2) * np.cos(around)
    return float((exponent + 2) / (exponent + 1) * np.maximum(outgoing, 0).mean())


def _mixture(document: Document, element: Element) -> None:
    """Convert `mixturebsdf` to nested blends, with black for the rest if the weights sum to less than 1."""
    parts = _nested(element)
    place = (element.child("weights") or element).place
    try:
        weights = [float(part) for part in split(element.text("weights"))]
    except ValueError:
        weights = []
    if not weights or len(weights) != len(parts) or min(weights) < 0 or not 0 < sum(weights) < np.inf:
        document.fault(
            place, f"`mixturebsdf`: give a weight of at least 0 for each of its {len(parts)} BSDFs"
        )
        return
    if sum(weights) < 1 - 1e-4:
        black = element.within("bsdf", "diffuse")
        black.put("rgb", "reflectance", "0")
        parts.append(black)
        weights.append(1 - sum(weights))
    document.note("converted", element, "`mixturebsdf` became blendbsdf")
    element.drop("weights")
    outer = element
    while len(parts) > 2:
        rest = element.within("bsdf", "blendbsdf")
        _blend(outer, "blendbsdf", _weight(element, 1 - weights[0] / sum(weights)), parts[0], rest)
        outer, parts, weights = rest, parts[1:], weights[1:]
    if len(parts) == 1:
        black = element.within("bsdf", "diffuse")
        parts, weights = [*parts, black], [*weights, 0.0]
    share = weights[1] / sum(weights) if sum(weights) else 0.0
    _blend(outer, "blendbsdf", _weight(element, share), parts[0], parts[1])


def _rough_diffuse(document: Document, element: Element) -> None:
    document.note("approximated", element, "`roughdiffuse` became diffuse")
    element.attributes["type"] = "diffuse"
    element.drop("alpha", "use_fast_approx")
    reflectance = element.child("diffuse_reflectance")
    if reflectance is not None:
        reflectance.attributes["name"] = "reflectance"


def _coating(document: Document, element: Element) -> None:
    """Convert a coat over `diffuse` to `plastic`.

    Mitsuba 0.6 leaves out light that the coat reflects back to the base; `plastic` includes it. The base's reflectance
    therefore becomes r / (1 + F r), with F the coat's diffuse reflectance from inside, which gives the same light.
    """
    kind, nested = element.kind, _nested(element)
    base = nested[0] if len(nested) == 1 else None
    if base is not None and base.tag == "ref":
        base = document.objects.get(base.attributes.get("id", ""))
    if base is None or base.kind != "diffuse":
        document.fault(element.place, f"bsdf `{kind}` is supported only over diffuse; use plastic")
        return
    reflectance = base.child("reflectance")
    inside, outside = _number(element, "int_ior", 1.5046), _number(element, "ext_ior", 1.000277)
    values = colour(reflectance, 0.5)
    exact = (
        values is not None and kind == "coating" and inside and outside and element.child("sigma_a") is None
    )
    element.children = [child for child in element.children if child not in nested]
    for name, ior in (("int_ior", "1.5046"), ("ext_ior", "1.000277")):
        if element.child(name) is None:
            element.put("float", name, ior)
    if values is not None and inside and outside:
        back = _diffuse_reflectance(inside / outside)
        element.put("rgb", "diffuse_reflectance", written([value / (1 + back * value) for value in values]))
    elif reflectance is not None:
        copied = Element(
            reflectance.tag, dict(reflectance.attributes), reflectance.place, reflectance.children
        )
        copied.attributes.pop("id", None)
        copied.attributes["name"] = "diffuse_reflectance"
        element.children.append(copied)
    element.drop("thickness", "sigma_a")
    element.put("boolean", "nonlinear", "true")
    element.attributes["type"] = "roughplastic" if kind == "roughcoating" else "plastic"
    text = f"`{kind}` over diffuse became {element.kind}"
    document.note("converted" if exact else "approximated", element, text)


def _diffuse_reflectance(eta: float) -> float:
    """Fraction of diffuse light that a smooth boundary reflects back into the denser side."""
    cosine = (np.arange(512) + 0.5) / 512
    transmitted = np.sqrt(np.maximum(1 - (1 - cosine**2) / eta**2, 0))
    parallel = (eta * cosine - transmitted) / (eta * cosine + transmitted)
    across = (cosine - eta * transmitted) / (cosine + eta * transmitted)
    from_outside = float(np.mean((parallel**2 + across**2) * cosine))
    return 1 - (1 - from_outside) / eta**2


def _facets(document: Document, element: Element) -> None:
    """Replace microfacet distributions that Mitsuba 3 does not have."""
    distribution = element.child("distribution")
    if distribution is not None and element.text("distribution").lower() in {"phong", "as"}:
        document.note("approximated", distribution, "the distribution became beckmann of the same roughness")
        element.put("string", "distribution", "beckmann")


def _metal(document: Document, element: Element) -> None:
    """Convert `extEta` of conductors: divide the refractive index of the metal by that of the outside."""
    outside = element.child("ext_eta")
    if outside is not None:
        factor = {"air": 1.000277, "vacuum": 1.0}.get(outside.attributes.get("value", "").lower())
        factor = factor or _number(element, "ext_eta", 1.0)
        element.drop("ext_eta")
        named = element.child("eta") is None or colour(element.child("eta"), 0) is None
        if factor is None or factor <= 0 or (abs(factor - 1) > 1e-3 and named):
            text = "ext_eta: give eta and k as colours, divided by it, instead"
            document.fault(outside.place, f"`{element.kind}`: {text}")
        elif abs(factor - 1) > 1e-3:
            for name in ("eta", "k"):
                values = colour(element.child(name), 0.0)
                element.put("rgb", name, written([value / factor for value in values or [0.0] * 3]))
    _facets(document, element)


def _bump(document: Document, element: Element) -> None:
    """Convert `bumpmap`: a `scale` texture around its texture becomes a separate property."""
    element.attributes["type"] = "bumpmap"
    for child in element.children:
        if child.tag == "texture" and child.kind == "scale":
            inner = next((each for each in child.children if each.tag in _TEXTURED), None)
            scale = _number(child, "scale", 1.0)
            if inner is None or scale is None:
                document.fault(child.place, "texture `scale` is supported only with a number and one texture")
                return
            inner.attributes.pop("name", None)
            element.children = [inner if each is child else each for each in element.children]
            element.put("float", "scale", repr(scale))
            return


def _normals(_document: Document, element: Element) -> None:
    """Convert `normalmap`: give its texture a name, and read its values as stored."""
    if element.version >= (2,) or element.child("normalmap") is not None:
        return
    for child in element.children:
        if child.tag in _TEXTURED and (child.tag != "ref" or child.name):
            child.attributes["name"] = "normalmap"
            if child.kind == "bitmap" and child.child("raw") is None:
                child.put("boolean", "raw", "true")
            return


BSDFS: Final[dict[tuple[str, str], Callable[[Document, Element], None]]] = {
    ("bsdf", "phong"): _glossy,
    ("bsdf", "ward"): _glossy,
    ("bsdf", "mixturebsdf"): _mixture,
    ("bsdf", "roughdiffuse"): _rough_diffuse,
    ("bsdf", "coating"): _coating,
    ("bsdf", "roughcoating"): _coating,
    ("bsdf", "conductor"): _metal,
    ("bsdf", "roughconductor"): _metal,
    ("bsdf", "roughplastic"): _facets,
    ("bsdf", "roughdielectric"): _facets,
    ("bsdf", "bump"): _bump,
    ("bsdf", "bumpmap"): _bump,
    ("bsdf", "normalmap"): _normals,
}
"""Conversions by tag and plugin."""
