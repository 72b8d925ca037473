"""Converts surface shaders to our materials: UsdPreviewSurface, OpenPBR, standard_surface, glTF, simple BSDFs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from steadylight.scenes.surface import Surface, Texture, Tint
from steadylight.scenes.usd.inputs import Inputs
from steadylight.scenes.usd.networks import node_of
from steadylight.scenes.usd.values import Image, NotPlain

_METALLIC: Final = 0.25
"""Reflectance at normal incidence from which a specular colour counts as a metal's; gems have 0.17."""
_DIELECTRIC: Final = 0.04
"""Reflectance at normal incidence of a dielectric of index 1.5."""


def _preview(inputs: Inputs, name: str) -> Surface:
    """UsdPreviewSurface."""
    base = inputs.colour("diffuseColor", (0.18, 0.18, 0.18))
    opacity = inputs.number("opacity", 1.0)
    threshold = inputs.constant("opacityThreshold", 0.0)
    surface = Surface(
        name,
        base_color=base,
        metallic=inputs.number("metallic", 0.0),
        roughness=inputs.number("roughness", 0.5),
        ior=max(inputs.constant("ior", 1.5), 1.0),
        coat=inputs.number("clearcoat", 0.0),
        coat_roughness=inputs.number("clearcoatRoughness", 0.01),
        emission=inputs.colour("emissiveColor", (0.0, 0.0, 0.0)),
        normal=inputs.normal("normal"),
    )
    inputs.mention("its displacement", {"displacement": 0.0})
    if inputs.constant("useSpecularWorkflow", 0.0) == 1.0:
        surface = _specular_workflow(inputs, replace(surface, metallic=0.0))
    if threshold > 0:
        if isinstance(opacity, Texture):
            return replace(surface, opacity=replace(opacity, threshold=threshold))
        return replace(surface, opacity=float(opacity >= threshold))
    if isinstance(opacity, float) and opacity < 1 and inputs.raw("opacityMode", "transparent") != "presence":
        if surface.is_clear:
            # Transparent surfaces keep their reflections: they are panes.
            return replace(surface, transmission=1 - opacity, transmission_color=(1.0, 1.0, 1.0))
        # Behind a rough one, things look just as sharp: only its highlights are wide.
        inputs.lost.append("its gloss, where it is transparent")
    return replace(surface, opacity=opacity)


def _specular_workflow(inputs: Inputs, surface: Surface) -> Surface:
    """The specular workflow: a reflectance at normal incidence instead of an index of refraction."""
    f0 = inputs.colour("specularColor", (0.0, 0.0, 0.0))
    if not isinstance(f0, tuple):
        inputs.lost.append("specularColor: a texture; that of a dielectric is used")
        return surface
    if max(f0) >= _METALLIC:
        return replace(surface, metallic=1.0, base_color=f0)
    r, g, b = (part / _DIELECTRIC for part in f0)
    return replace(surface, ior=1.5, specular_color=(r, g, b))


@dataclass(frozen=True)
class _Model:
    """Names of inputs in OpenPBR and Autodesk's standard surface, which are the same model.

    Inputs with the same name in both are not listed here.

    Attributes:
        weights: weights of base, subsurface and emission.
        numbers: names and defaults of the inputs that a `Surface` uses unchanged, by the surface's names.
        ior: index of refraction.
        thin: whether the surface is a sheet.
        normal: normal map.
        left_out: what is not rendered, by the names of its weights.
    """

    weights: tuple[str, str, str]
    numbers: Mapping[str, tuple[str, float]]
    ior: str
    thin: str
    normal: str
    left_out: Mapping[str, str]

    def surface(self, inputs: Inputs, name: str) -> Surface:
        """The surface of a shader."""
        base_weight, subsurface, emission = self.weights
        base = inputs.weighted(inputs.colour("base_color", (0.8, 0.8, 0.8)), inputs.number(base_weight, 1.0))
        base = _scattered(inputs, base, subsurface, "subsurface_color")
        for weight, what in self.left_out.items():
            inputs.mention(what, {weight: 0.0})
        shines = inputs.colour("emission_color", (1.0, 1.0, 1.0))
        surface = Surface(
            name,
            base_color=base,
            ior=max(inputs.constant(self.ior, 1.5), 1.0),
            specular_color=inputs.colour("specular_color", (1.0, 1.0, 1.0)),
            thin=inputs.flag(self.thin),
            emission=inputs.weighted(shines, inputs.number(emission, 0.0)),
            normal=inputs.normal(self.normal),
            **{field: inputs.number(*given) for field, given in self.numbers.items()},
        )
        return _body(inputs, surface, inputs.constant("transmission_depth", 0.0))


_OPEN_PBR: Final = _Model(
    weights=("base_weight", "subsurface_weight", "emission_luminance"),
    numbers={
        "metallic": ("base_metalness", 0.0),
        "roughness": ("specular_roughness", 0.3),
        "specular": ("specular_weight", 1.0),
        "transmission": ("transmission_weight", 0.0),
        "coat": ("coat_weight", 0.0),
        "coat_roughness": ("coat_roughness", 0.0),
        "opacity": ("geometry_opacity", 1.0),
    },
    ior="specular_ior",
    thin="geometry_thin_walled",
    normal="geometry_normal",
    left_out={
        "fuzz_weight": "its fuzz",
        "thin_film_weight": "its thin film",
        "specular_roughness_anisotropy": "its brushed (anisotropic) highlights",
    },
)
"""OpenPBR 1.1."""

_STANDARD_SURFACE: Final = _Model(
    weights=("base", "subsurface", "emission"),
    numbers={
        "metallic": ("metalness", 0.0),
        "roughness": ("specular_roughness", 0.2),
        "specular": ("specular", 1.0),
        "transmission": ("transmission", 0.0),
        "coat": ("coat", 0.0),
        "coat_roughness": ("coat_roughness", 0.1),
        "opacity": ("opacity", 1.0),
    },
    ior="specular_IOR",
    thin="thin_walled",
    normal="normal",
    left_out={
        "sheen": "its sheen",
        "thin_film_thickness": "its thin film",
        "specular_anisotropy": "its brushed (anisotropic) highlights",
    },
)
"""Autodesk's standard surface."""


def _body(inputs: Inputs, surface: Surface, depth: float) -> Surface:
    """The surface with its transmission colour: at the boundary, or after a distance in the body."""
    if surface.transmission == 0.0:
        return surface
    colour = inputs.colour("transmission_color", (1.0, 1.0, 1.0))
    if depth > 0 and isinstance(colour, tuple) and not surface.thin:
        return replace(
            surface, transmission_color=(1.0, 1.0, 1.0), attenuation_color=colour, attenuation_distance=depth
        )
    return replace(surface, transmission_color=colour)


def _scattered(inputs: Inputs, base: Tint, weight_name: str, colour_name: str) -> Tint:
    """Base colour including subsurface scattering, as if light left the surface where it entered."""
    weight = inputs.constant(weight_name, 0.0)
    if weight <= 0:
        return base
    inputs.lost.append("subsurface scattering: becomes diffuse reflection")
    colour = inputs.colour(colour_name, (0.8, 0.8, 0.8))
    if isinstance(base, tuple) and isinstance(colour, tuple):
        r, g, b = (np.array(base) * (1 - weight) + np.array(colour) * weight).tolist()
        return r, g, b
    return colour if weight > 0.5 else base


def _gltf(inputs: Inputs, name: str) -> Surface:
    """The surface of glTF as a MaterialX node."""
    inputs.mention("its sheen", {"sheen_roughness": 0.0})
    distance = inputs.constant("attenuation_distance", 0.0)
    mode, alpha = inputs.constant("alpha_mode", 0.0), inputs.number("alpha", 1.0)
    if mode == 0:
        alpha = 1.0
    elif mode == 1:
        cutoff = inputs.constant("alpha_cutoff", 0.5)
        alpha = replace(alpha, threshold=cutoff) if isinstance(alpha, Texture) else float(alpha >= cutoff)
    colour = inputs.colour("attenuation_color", (1.0, 1.0, 1.0))
    thickness = inputs.constant("thickness", 0.0)
    return Surface(
        name,
        base_color=inputs.colour("base_color", (1.0, 1.0, 1.0)),
        metallic=inputs.number("metallic", 1.0),
        roughness=inputs.number("roughness", 1.0),
        ior=max(inputs.constant("ior", 1.5), 1.0),
        specular=inputs.number("specular", 1.0),
        specular_color=inputs.colour("specular_color", (1.0, 1.0, 1.0)),
        transmission=inputs.number("transmission", 0.0),
        thin=thickness == 0,
        thickness=thickness,
        attenuation_color=colour if isinstance(colour, tuple) else (1.0, 1.0, 1.0),
        attenuation_distance=distance or math.inf,
        coat=inputs.number("clearcoat", 0.0),
        coat_roughness=inputs.number("clearcoat_roughness", 0.0),
        emission=inputs.weighted(
            inputs.colour("emissive", (0.0, 0.0, 0.0)), inputs.number("emissive_strength", 1.0)
        ),
        opacity=alpha,
        normal=inputs.normal("normal"),
    )


def _lobes(inputs: Inputs, name: str) -> Surface:
    """MaterialX's `surface` with a BSDF and an emission, as Blender writes materials that are not Principled."""
    surface = _lobe(inputs, "bsdf", name)
    light = _connected(inputs.shader, "edf")
    if light is not None:
        glow = replace(inputs, shader=light).colour("color", (1.0, 1.0, 1.0))
        surface = replace(surface or Surface(name, base_color=(0.0, 0.0, 0.0), specular=0.0), emission=glow)
    if surface is None:
        raise NotPlain("it has neither a BSDF nor emission")
    return replace(surface, opacity=inputs.number("opacity", 1.0))


def _connected(shader: Any, name: str) -> Any | None:
    """The node connected to an input; None if there is none."""
    from pxr import UsdShade

    given = shader.GetInput(name)
    producers = UsdShade.Utils.GetValueProducingAttributes(given) if given else []
    if not producers or not UsdShade.Output.IsOutput(producers[0]):
        return None
    return UsdShade.Shader(producers[0].GetPrim())


def _lobe(inputs: Inputs, name: str, of: str) -> Surface | None:
    """One BSDF, or a mixture of two, as a surface."""
    node = _connected(inputs.shader, name)
    if node is None:
        return None
    own = replace(inputs, shader=node, other=None)
    kind = node_of(node).removesuffix("_bsdf")
    if kind == "mix":
        return _blend(own, _lobe(own, "bg", of), _lobe(own, "fg", of))
    if kind == "layer":
        return _over(_lobe(own, "top", of), _lobe(own, "base", of))
    made = _LOBES.get(kind)
    if made is None:
        raise NotPlain(f"the BSDF {kind} is not supported")
    return made(own, of)


def _matt(inputs: Inputs, of: str) -> Surface:
    return Surface(of, base_color=inputs.colour("color", (0.18, 0.18, 0.18)), specular=0.0)


def _matt_instead(inputs: Inputs, of: str) -> Surface:
    inputs.lost.append("diffuse transmission: becomes diffuse reflection")
    return _matt(inputs, of)


def _boundary(inputs: Inputs, of: str) -> Surface:
    """MaterialX's dielectric_bsdf."""
    through = str(inputs.raw("scatter_mode", "R")) != "R"
    tint = inputs.colour("tint", (1.0, 1.0, 1.0))
    surface = Surface(of, roughness=_roughness(inputs), ior=max(inputs.constant("ior", 1.5), 1.0), thin=False)
    if through:
        return replace(surface, transmission=1.0, transmission_color=tint)
    return replace(surface, base_color=(0.0, 0.0, 0.0), specular_color=tint)


def _conductor(inputs: Inputs, of: str) -> Surface:
    """MaterialX's conductor_bsdf: its complex index gives the reflectance at normal incidence."""
    eta, k = (inputs.colour(part, (1.0, 1.0, 1.0)) for part in ("ior", "extinction"))
    f0 = (0.8, 0.8, 0.8)
    if isinstance(eta, tuple) and isinstance(k, tuple):
        n, x = np.array(eta), np.array(k)
        r, g, b = (((n - 1) ** 2 + x**2) / ((n + 1) ** 2 + x**2)).tolist()
        f0 = (r, g, b)
    return Surface(of, base_color=f0, metallic=1.0, roughness=_roughness(inputs))


def _schlick(inputs: Inputs, of: str) -> Surface:
    colour = inputs.colour("color0", (1.0, 1.0, 1.0))
    return Surface(of, base_color=colour, metallic=1.0, roughness=_roughness(inputs))


def _roughness(inputs: Inputs) -> Any:
    """Roughness of a MaterialX BSDF, which is alpha: the square of ours."""
    value = inputs.number("roughness", 0.05)
    return replace(value, power=0.5) if isinstance(value, Texture) else math.sqrt(max(value, 0.0))


def _blend(inputs: Inputs, first: Surface | None, second: Surface | None) -> Surface | None:
    """A mixture of two surfaces, if a `Surface` can express it: with metal, or with glass; otherwise approximated."""
    if first is None or second is None:
        return first or second
    weight = inputs.number("mix", 0.5)
    for a, b, share in ((first, second, weight), (second, first, _rest(weight))):
        if b.transmission == 1.0 and a.transmission == a.metallic == 0.0:
            return replace(b, base_color=a.base_color, transmission=share)
        if b.metallic == 1.0 and a.metallic == a.transmission == 0.0 and a.specular == 0.0:
            inputs.lost.append("a mixture of metal and a matt colour: both get one reflectance")
            return replace(b, metallic=share, specular=0.0)
    if (
        isinstance(weight, float)
        and isinstance(first.base_color, tuple)
        and isinstance(second.base_color, tuple)
    ):
        r, g, b_ = (np.array(first.base_color) * (1 - weight) + np.array(second.base_color) * weight).tolist()
        return replace(first, base_color=(r, g, b_))
    inputs.lost.append("a mixture of two surfaces: the first is used")
    return first


def _rest(weight: Any) -> Any:
    return Image(weight, None).affine(-1.0, 1.0).texture if isinstance(weight, Texture) else 1.0 - weight


def _over(top: Surface | None, base: Surface | None) -> Surface | None:
    """A reflecting boundary over a base."""
    if top is None or base is None:
        return top or base
    return replace(top, base_color=base.base_color, metallic=base.metallic)


_LOBES: Final[Mapping[str, Callable[[Inputs, str], Surface]]] = {
    "oren_nayar_diffuse": _matt,
    "burley_diffuse": _matt,
    "translucent": _matt_instead,
    "subsurface": _matt_instead,
    "dielectric": _boundary,
    "conductor": _conductor,
    "generalized_schlick": _schlick,
}

SURFACES: Final[Mapping[str, Callable[[Inputs, str], Surface]]] = {
    "UsdPreviewSurface": _preview,
    "open_pbr_surface": _OPEN_PBR.surface,
    "standard_surface": _STANDARD_SURFACE.surface,
    "gltf_pbr": _gltf,
    "surface": _lobes,
}
