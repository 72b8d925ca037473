"""Conversion of Mitsuba's materials and textures to Radiance's.

- A surface reflects on both sides, whether it is `twosided` or not.
- GGX and Beckmann become Ward's lobe of the same roughness: `metal` and `plastic` with the reflectance that Mitsuba's
  material has at 45 degrees. Radiance's rough `plastic` has no Fresnel term: at grazing angles it is darker.
- Solid glass (`dielectric`) refracts what the camera and ambient rays see through it, but lamps and the sun do not
  shine through it: Radiance sends no shadow rays through solid glass.
- A tinted `thindielectric` is tinted by its glass: at normal incidence, it transmits the same.
- Pictures are stored as RGBE: 8 bits of mantissa, without bias; the same texels, the same bilinear filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.renderers.radiance.appearance import (
    RGB,
    Table,
    reflectance,
    refractive_index,
    texels,
    write_rgbe,
)

KNOWN = {
    "diffuse": {"reflectance"},
    "plastic": {"diffuse_reflectance", "specular_reflectance", "int_ior", "ext_ior", "nonlinear"},
    "roughplastic": {
        "diffuse_reflectance",
        "specular_reflectance",
        "int_ior",
        "ext_ior",
        "nonlinear",
        "alpha",
        "distribution",
        "sample_visible",
    },
    "conductor": {"material", "eta", "k", "ext_eta", "specular_reflectance"},
    "roughconductor": {
        "material",
        "eta",
        "k",
        "ext_eta",
        "specular_reflectance",
        "alpha",
        "distribution",
        "sample_visible",
    },
    "dielectric": {"int_ior", "ext_ior"},
    "thindielectric": {"int_ior", "ext_ior", "specular_transmittance"},
    "glasspane": {"transmissivity", "ior"},
}
"""Supported materials, with their properties."""

SHARP = 0.05
"""Roughness up to which gloss is exported as smooth: only smooth gloss is traced (`quality.WORKING`)."""

_TEXTURES = {
    "diffuse": "reflectance",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
}
"""Property of each material that may be a picture."""


def primitive(
    modifier: str, kind: str, name: str, words: Sequence[str] = (), figures: Iterable[float] = ()
) -> str:
    """One primitive in Radiance's grammar."""
    values = [f"{float(figure):.9g}" for figure in figures]
    return f"{modifier} {kind} {name}\n{len(words)} {' '.join(words)}\n0\n{len(values)} {' '.join(values)}\n"


def material_of(entry: Table, content: Table) -> Table:
    """The material of a shape, with references and `twosided` resolved."""
    bsdf: Table = entry.get("bsdf", {"type": "diffuse"})
    while bsdf["type"] in ("ref", "twosided"):
        bsdf = content[bsdf["id"]] if bsdf["type"] == "ref" else next(v for v in bsdf.values() if table(v))
    return bsdf


def texture_of(bsdf: Table) -> Table:
    """The picture that gives a material's colour; empty if the colour is constant."""
    value = table(bsdf.get(_TEXTURES.get(bsdf["type"], "")))
    return value if value.get("type") == "bitmap" else {}


class Materials:
    """Writes materials, and the pictures that they use into a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def material(self, name: str, bsdf: Table) -> list[str]:
        """The primitives of a material, under the given name.

        Raises:
            SceneError: Radiance has no counterpart.
        """
        kind = bsdf["type"]
        if kind not in KNOWN:
            raise SceneError(f"{name}: material `{kind}` is not supported by the export to Radiance")
        self._check(name, bsdf)
        alpha = 0.0 if kind in ("plastic", "conductor") else bsdf.get("alpha", 0.1)
        alpha = alpha if alpha > SHARP else 0.0
        if kind == "diffuse":
            pattern, colour, lines = self._colour(name, bsdf.get("reflectance", 0.5))
            return [*lines, primitive(pattern, "plastic", name, figures=(*colour, 0, 0))]
        if kind in ("plastic", "roughplastic"):
            pattern, colour, lines = self._colour(name, bsdf.get("diffuse_reflectance", 0.5))
            white = {k: v for k, v in bsdf.items() if k != "diffuse_reflectance"}
            gloss = float(reflectance(white | {"diffuse_reflectance": 0.0}).mean())
            under = float(reflectance(white | {"diffuse_reflectance": 1.0}).mean()) - gloss
            figures = (*(under * colour / (1 - gloss)), gloss, alpha)
            return [*lines, primitive(pattern, "plastic", name, figures=figures)]
        if kind in ("conductor", "roughconductor"):
            return [primitive("void", "metal", name, figures=(*reflectance(bsdf), 1, alpha))]
        if kind == "dielectric":
            return [primitive("void", "dielectric", name, figures=(1, 1, 1, refractive_index(bsdf), 0))]
        if kind == "glasspane":
            passed, index = rgb(name, bsdf.get("transmissivity", 1.0)), float(bsdf.get("ior", 1.52))
        else:
            passed, index = rgb(name, bsdf.get("specular_transmittance", 1.0)), refractive_index(bsdf)
        return [primitive("void", "glass", name, figures=(*passed, index))]

    def _check(self, name: str, bsdf: Table) -> None:
        """Reject properties that the primitives cannot represent."""
        kind = bsdf["type"]
        for key, value in bsdf.items():
            if key in ("type", "id"):
                continue
            if key not in KNOWN[kind]:
                raise SceneError(
                    f"{name}: property `{key}` of `{kind}` is not supported by the export to Radiance"
                )
            textured = table(value).get("type") not in (None, "rgb", "uniform", "spectrum")
            if textured and key != _TEXTURES.get(kind):
                raise SceneError(
                    f"{name}: a texture as `{key}` of `{kind}` is not supported by the export to Radiance"
                )

    def _colour(self, name: str, value: Any) -> tuple[str, RGB, list[str]]:
        """A reflectance as a pattern (`void` if it is constant) and a factor, and the pattern's primitives."""
        kind = table(value).get("type", "rgb")
        if kind in ("rgb", "uniform", "spectrum"):
            return "void", rgb(name, value), []
        if kind != "bitmap" or value.get("wrap_mode", "repeat") != "repeat":
            what = f"texture `{kind}`" if kind != "bitmap" else f"wrap_mode `{value['wrap_mode']}`"
            raise SceneError(f"{name}: {what} is not supported by the export to Radiance")
        return f"{name}.picture", np.ones(3), [self.picture(name, texels(value), "texture")]

    def picture(self, name: str, image: NDArray[np.floating[Any]], coordinates: str) -> str:
        """Write a repeating picture, (H, W, 3); returns the pattern that refers to it."""
        padded = np.pad(np.asarray(image, np.float64), ((1, 1), (1, 1), (0, 0)), mode="wrap")
        write_rgbe(self.folder / f"{name}.hdr", padded)
        height, width = padded.shape[:2]
        sides = max(1.0, width / height), max(1.0, height / width)
        words = ("red", "green", "blue", f"{name}.hdr", "scene.cal", f"{coordinates}_u", f"{coordinates}_v")
        return primitive("void", "colorpict", f"{name}.picture", words, (width - 2, height - 2, *sides))


def rgb(name: str, value: Any) -> RGB:
    """A constant colour, (3,).

    Raises:
        SceneError: it is a spectrum or a texture.
    """
    if isinstance(value, Mapping):
        value = value.get("value", value.get("type"))
    try:
        return np.broadcast_to(np.asarray(value, np.float64), 3)
    except (TypeError, ValueError):
        raise SceneError(f"{name}: colour `{value}` is not supported by the export to Radiance") from None


def table(value: Any) -> Table:
    """A value if it is a table, else an empty one."""
    return value if isinstance(value, Mapping) else {}
