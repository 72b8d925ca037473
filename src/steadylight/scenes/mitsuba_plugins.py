"""The table of Mitsuba's plugins that a scene may use; the checks read it, and docs/scenes.md shows it.

Plugins that are not in the table (third-party ones) are used as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

Standing = Literal["supported", "converted", "approximated", "ignored", "refused"]


@dataclass(frozen=True)
class Plugin:
    """A row of the table.

    Attributes:
        kind: kind of plugin.
        name: name in a scene file; for an option of a plugin, `plugin: option`.
        standing: `supported` means that the light is correct: unless approximated, two-pass frames have the mean of the
            path tracer. `converted` means the same for plugins of older versions, which are replaced.
        how: what is approximated or left out, or why it is refused and what to use instead.
    """

    kind: str
    name: str
    standing: Standing = "supported"
    how: str = ""


_BASE = "beside another material, light enters the base as it enters that one"
_POLARISED = "polarised light is not rendered; use {}"
_STILL = "renders no image; use perspective, thinlens or orthographic"
_MEDIUM = "participating media are not rendered; remove it, or render with Mitsuba's volpath"
_LOBE = "the cache serves a Lambertian part; rays collect the rest, with some noise"

PLUGINS: Final = (
    Plugin("BSDF", "diffuse"),
    Plugin("BSDF", "plastic", "approximated", _BASE),
    Plugin("BSDF", "roughplastic", "approximated", _BASE),
    Plugin("BSDF", "pplastic", "approximated", f"{_BASE}; without polarisation"),
    Plugin("BSDF", "principled", how=_LOBE),
    Plugin("BSDF", "principledthin", how=f"{_LOBE}; light that it transmits is collected by rays"),
    Plugin("BSDF", "conductor"),
    Plugin("BSDF", "roughconductor"),
    Plugin("BSDF", "dielectric", how="caustics are blurred by the radius of the records"),
    Plugin("BSDF", "thindielectric"),
    Plugin(
        "BSDF", "glasspane", how="our own, for Radiance's glass: a pane that absorbs more at grazing angles"
    ),
    Plugin("BSDF", "roughdielectric"),
    Plugin("BSDF", "hair"),
    Plugin("BSDF", "measured"),
    Plugin("BSDF", "null"),
    Plugin("BSDF", "twosided"),
    Plugin("BSDF", "mask"),
    Plugin(
        "BSDF",
        "blendbsdf",
        how="with a mirror or clear glass, Mitsuba's own weights of the mixture are used, in both modes",
    ),
    Plugin(
        "BSDF",
        "bumpmap",
        "approximated",
        "records are of the smooth surface; their gradients tell what the turned normal receives",
    ),
    Plugin("BSDF", "normalmap", "approximated", "as bumpmap"),
    Plugin("BSDF", "measured_polarized", "refused", _POLARISED.format("measured")),
    Plugin("BSDF", "polarizer", "refused", _POLARISED.format("null, or a mask")),
    Plugin("BSDF", "retarder", "refused", _POLARISED.format("null")),
    Plugin("BSDF", "circular", "refused", _POLARISED.format("null, or a mask")),
    Plugin("emitter", "area"),
    Plugin("emitter", "point"),
    Plugin("emitter", "spot"),
    Plugin("emitter", "projector"),
    Plugin("emitter", "directional"),
    Plugin(
        "emitter",
        "directionalarea",
        "refused",
        "only paths traced from the light could find it; use spot, or area",
    ),
    Plugin("emitter", "constant"),
    Plugin("emitter", "envmap"),
    Plugin("emitter", "sunsky"),
    Plugin(
        "emitter",
        "timed_sunsky",
        "refused",
        "frames cannot span days; use sunsky with a date and an hour",
    ),
    Plugin("shape", "obj"),
    Plugin("shape", "ply"),
    Plugin("shape", "serialized"),
    Plugin("shape", "blender", "refused", "is an interface for exporters; export to ply or obj"),
    Plugin("shape", "cube"),
    Plugin("shape", "rectangle"),
    Plugin("shape", "sphere"),
    Plugin("shape", "disk"),
    Plugin("shape", "cylinder"),
    Plugin("shape", "linearcurve"),
    Plugin("shape", "bsplinecurve"),
    Plugin("shape", "sdfgrid"),
    Plugin("shape", "shapegroup"),
    Plugin("shape", "instance"),
    Plugin(
        "shape",
        "merge",
        "refused",
        "changes the order of shapes from run to run; put its shapes into the scene",
    ),
    Plugin("shape", "ellipsoids", "refused", "has no surface to light; use sphere with to_world"),
    Plugin("shape", "ellipsoidsmesh", "refused", "has no surface to light; use sphere with to_world"),
    Plugin("texture", "bitmap"),
    Plugin("texture", "checkerboard"),
    Plugin(
        "texture",
        "mesh_attribute",
        how="black where Mitsuba cannot interpolate, in triangles a thousand times as long as wide",
    ),
    Plugin("texture", "volume"),
    Plugin("sensor", "perspective"),
    Plugin("sensor", "thinlens"),
    Plugin("sensor", "orthographic"),
    Plugin("sensor", "radiancemeter", "refused", _STILL),
    Plugin("sensor", "irradiancemeter", "refused", _STILL),
    Plugin("sensor", "distant", "refused", _STILL),
    Plugin("sensor", "batch", "refused", "shows several views in one image; render each with --sensor"),
    Plugin("film", "hdrfilm", how="frames are OpenEXR, RGB, whatever its formats say"),
    Plugin("film", "specfilm", "refused", "frames are RGB; use hdrfilm"),
    Plugin(
        "film",
        "hdrfilm: crop",
        "refused",
        "frames show the whole image; remove crop_offset_x, crop_offset_y, crop_width and crop_height, and crop the "
        "frames",
    ),
    Plugin("filter", "box"),
    Plugin("filter", "tent"),
    Plugin("filter", "gaussian"),
    Plugin("filter", "mitchell"),
    Plugin("filter", "catmullrom"),
    Plugin("filter", "lanczos"),
    Plugin("integrator", "any", "ignored", "--mode and --bounces choose how to render"),
    Plugin(
        "integrator",
        "any: hide_emitters",
        "refused",
        "emitters in view of the camera are always shown; remove it, or set it to false",
    ),
    Plugin("sampler", "any", "ignored", "steadylight has its own sampler; --spp sets the number of samples"),
    Plugin("medium", "homogeneous", "refused", _MEDIUM),
    Plugin("medium", "heterogeneous", "refused", _MEDIUM),
)
"""All plugins of Mitsuba 3.9 except spectra, volumes and phase functions, and those that our readers produce."""

_ROWS: Final = {row.name: row for row in PLUGINS}


def refusal(name: str) -> str | None:
    """Why a plugin, or `plugin: option`, is refused, and what to use instead; None if it is not refused."""
    row = _ROWS.get(name)
    if row is None or row.standing != "refused":
        return None
    _, _, option = name.partition(": ")
    what = f"{row.kind} option `{option}`" if option else f"{row.kind} `{name}`"
    return f"{what} is not supported: {row.how}"


def is_known(name: str) -> bool:
    """Whether a plugin comes with Mitsuba."""
    return name in _ROWS


def supported(kind: str) -> tuple[str, ...]:
    """Names of the plugins of a kind that are supported, perhaps only approximately."""
    rows = (row for row in PLUGINS if row.kind == kind and row.standing in ("supported", "approximated"))
    return tuple(row.name for row in rows)


def refusals(content: Mapping[str, Any], at: str = "") -> Iterator[str]:
    """Messages on the objects in a scene's plain content that are refused, each with its place.

    Args:
        content: content of a scene description, or a part of it.
        at: place of that part.
    """
    kind = content.get("type")
    reason = refusal(kind) if isinstance(kind, str) else None
    if reason is not None:
        yield f"`{at}`: {reason}" if at else reason
        return
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from refusals(value, f"{at}.{key}" if at else key)
