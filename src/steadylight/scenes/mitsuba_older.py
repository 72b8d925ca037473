"""Converts scene files of older Mitsuba versions (0.5, 0.6, 2) to Mitsuba 3.

`PLUGINS` below says what becomes of plugins that Mitsuba 3 does not have; docs/scenes.md shows it.
Properties are renamed by `mitsuba_document`, for all versions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from steadylight.scenes.mitsuba_document import OBJECTS, Document
from steadylight.scenes.mitsuba_older_bsdfs import BSDFS
from steadylight.scenes.mitsuba_older_textures import TEXTURES, scale_texture
from steadylight.scenes.mitsuba_older_values import modernise_value, number
from steadylight.scenes.mitsuba_plugins import Plugin, refusal
from steadylight.scenes.xml_elements import Element

_GROUND_ALBEDO = "0.2"
"""Default of Mitsuba 0.6; that of Mitsuba 3 is 0.3."""
_SUN_APERTURE = 0.5358
"""Degrees; the same in both versions."""
_UPRIGHT = "1 0 0 0  0 0 1 0  0 -1 0 0  0 0 0 1"
"""From a frame with z up to one with y up; the direction of the sun is given separately."""
_NORTH = "0 -1 0 0  0 0 1 0  1 0 0 0  0 0 0 1"
"""The same, for a sun by place and time: Mitsuba 3 measures its azimuth from x, Mitsuba 0.6 from -z."""
_ONLY_3 = {"sun_aperture", "complex_sun"}

PLUGINS: Final = (
    Plugin(
        "BSDF", "phong", "approximated", "blendbsdf of diffuse and roughconductor of the same reflectances"
    ),
    Plugin("BSDF", "ward", "approximated", "as phong, with the same roughness along u and v"),
    Plugin("BSDF", "roughdiffuse", "approximated", "diffuse of the same reflectance"),
    Plugin("BSDF", "mixturebsdf", "converted", "blendbsdf, nested for more than two"),
    Plugin("BSDF", "bump", "converted", "bumpmap"),
    Plugin("BSDF", "coating", "converted", "plastic, where it coats a constant diffuse; otherwise refused"),
    Plugin("BSDF", "roughcoating", "approximated", "roughplastic, where it coats diffuse; otherwise refused"),
    Plugin("BSDF", "difftrans", "refused", "use principledthin with diff_trans"),
    Plugin("BSDF", "hk", "refused", "scattering layers are not rendered; use plastic or diffuse"),
    Plugin("BSDF", "irawan", "refused", "woven cloth is not rendered; use diffuse with a texture"),
    Plugin("emitter", "sky", "converted", "sunsky without sun"),
    Plugin(
        "emitter",
        "sun",
        "approximated",
        "sunsky without sky; Hosek's sun (2013) instead of Preetham's (1999)",
    ),
    Plugin("emitter", "sunsky", "approximated", "y is up; Hosek's sun (2013) instead of Preetham's (1999)"),
    Plugin("emitter", "collimated", "refused", "only paths traced from the light could find it; use spot"),
    Plugin("shape", "hair", "refused", "its file format cannot be read; export as bsplinecurve"),
    Plugin("shape", "heightfield", "refused", "export as ply or obj"),
    Plugin("shape", "deformable", "refused", "objects do not move; export one moment as ply or obj"),
    Plugin("texture", "vertexcolors", "converted", "mesh_attribute"),
    Plugin(
        "texture", "scale", "converted", "bumpmap's scale, or a picture, checkerboard or colour, multiplied"
    ),
    Plugin("texture", "gridtexture", "refused", "use checkerboard or bitmap"),
    Plugin("texture", "wireframe", "refused", "use bitmap"),
    Plugin("texture", "curvature", "refused", "use bitmap"),
    Plugin("sensor", "perspective_rdist", "refused", "use perspective, and distort the frames"),
    Plugin("sensor", "telecentric", "refused", "use orthographic"),
    Plugin("sensor", "spherical", "refused", "use perspective"),
    Plugin("film", "ldrfilm", "converted", "hdrfilm: frames are OpenEXR"),
    Plugin("film", "tiledhdrfilm", "converted", "hdrfilm"),
    Plugin("film", "mfilm", "converted", "hdrfilm: frames are OpenEXR"),
    Plugin("medium", "any", "refused", "participating media are not rendered; remove it"),
    Plugin("subsurface", "any", "refused", "subsurface scattering is not rendered; remove it"),
    Plugin(
        "animation", "any", "refused", "objects and sensors do not move; give a camera path with --camera"
    ),
)

_REFUSED: Final = {(row.kind.lower(), row.name): row.how for row in PLUGINS if row.standing == "refused"}
_SHOWN: Final = {"bsdf": "BSDF"}


def modernise(document: Document) -> None:
    """Convert a document in place; its notes and faults say what was changed."""
    for element in list(document.root.walk()):
        if element.version < (2,):
            element.attributes.update({"type": element.kind.lower()} if element.kind else {})
        reason = _refusal(element)
        if reason is not None:
            document.fault(element.place, reason)
            continue
        modernise_value(document, element)
        convert = _CONVERTED.get((element.tag, element.kind))
        if convert is not None:
            convert(document, element)
    # Inner elements are converted before outer ones, so that each conversion sees Mitsuba 3's names.
    for element in reversed(list(document.root.walk())):
        convert = BSDFS.get((element.tag, element.kind))
        if convert is not None:
            convert(document, element)
    for element in document.root.walk():
        if (element.tag, element.kind) == ("texture", "scale"):
            scale_texture(document, element)


def _refusal(element: Element) -> str | None:
    """Why an element is refused; None if it is supported."""
    reason = refusal(element.kind) if element.tag in OBJECTS else None
    if reason is None and element.tag == "integrator" and element.text("hide_emitters").lower() == "true":
        reason = refusal("any: hide_emitters")
    how = _REFUSED.get((element.tag, element.kind)) or _REFUSED.get((element.tag, "any"))
    if reason is None and how is not None:
        what = (
            f"{_SHOWN.get(element.tag, element.tag)} `{element.kind}`" if element.kind else f"<{element.tag}>"
        )
        reason = f"{what} is not supported: {how}"
    return reason


def _sun_or_sky(document: Document, element: Element) -> None:
    """Convert `sky`, `sun` and `sunsky` of Mitsuba 0.6, where y is up, to `sunsky`."""
    kind = element.kind
    if element.version >= (2,) or any(child.name in _ONLY_3 for child in element.children):
        return
    scale = element.text("scale", "1")
    sky = element.text("sky_scale", scale) if kind == "sunsky" else scale
    sun = element.text("sun_scale", scale) if kind == "sunsky" else scale
    radius = number(element.text("sun_radius_scale", "1"))
    element.drop("scale", "sky_scale", "sun_scale", "sun_radius_scale")
    element.attributes["type"] = "sunsky"
    element.put("float", "sky_scale", "0" if kind == "sun" else sky)
    element.put("float", "sun_scale", "0" if kind == "sky" else sun)
    if radius:
        element.put("float", "sun_aperture", repr(_SUN_APERTURE * radius))
    elif kind != "sky":
        document.note("approximated", element, "the sun has its natural size instead of being a point")
    if element.child("albedo") is None:
        element.put("spectrum", "albedo", _GROUND_ALBEDO)
    if number(element.text("stretch", "1")) != 1:
        document.note("left out", element, "stretch: the sky ends at the horizon")
    element.drop("stretch", "resolution", "extend")
    placed = element.child("to_world")
    if placed is None:
        placed = Element("transform", {"name": "to_world"}, element.place, version=element.version)
        element.children.append(placed)
    turn = _NORTH if element.child("sun_direction") is None else _UPRIGHT
    placed.children.insert(0, Element("matrix", {"value": turn}, element.place, version=element.version))
    if kind != "sky":
        document.note("approximated", element, "the sun is Hosek's (2013) instead of Preetham's (1999)")
    if kind != "sunsky":
        document.note("converted", element, f"`{kind}` became sunsky")


def _film(document: Document, element: Element) -> None:
    """Convert any film to `hdrfilm` without formats: it refuses some, such as PNG, and frames need none."""
    if element.kind != "hdrfilm":
        document.note("converted", element, f"`{element.kind}` became hdrfilm: frames are OpenEXR")
        element.attributes["type"] = "hdrfilm"
    element.drop("file_format", "pixel_format", "component_format")


def _envmap(document: Document, element: Element) -> None:
    scale = element.child("intensity_scale")
    if scale is not None:
        scale.attributes["name"] = "scale"
    if element.child("gamma") is not None:
        document.note(
            "left out", element.child("gamma") or element, "gamma: the image is read as its file says"
        )
        element.drop("gamma")


_CONVERTED: Final[dict[tuple[str, str], Callable[[Document, Element], None]]] = {
    **{("emitter", kind): _sun_or_sky for kind in ("sky", "sun", "sunsky")},
    **{("film", kind): _film for kind in ("hdrfilm", "ldrfilm", "tiledhdrfilm", "mfilm")},
    ("emitter", "envmap"): _envmap,
    **TEXTURES,
}
