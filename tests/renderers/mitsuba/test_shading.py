"""Frames against Mitsuba's path tracer, for every kind of emitter and material."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from small_scenes import (
    LAMP,
    described,
    lamp,
    paint,
    place,
    renderer,
    room,
    sample_again,
    shade_as_normal,
)

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.records.exchange import Exchange
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.renderers.mitsuba.sampling import samples_of
from steadylight.renderers.mitsuba.scene import build_scene
from variants import slow

TWOSIDED = {"type": "twosided", "bsdf": paint(0.5, 0.5, 0.5)}

SKY = np.concatenate([np.full((8, 32, 3), [0.3, 0.5, 0.9]), np.full((8, 32, 3), [0.2, 0.15, 0.1])])
SKY[3, 4:8] = [30, 28, 20]  # something bright above the horizon

EMITTERS: dict[str, dict[str, Any]] = {
    "area": lamp(),
    "point": {
        "type": "point",
        "position": [1.2, -0.8, 2.2],
        "intensity": {"type": "rgb", "value": [8.0, 7, 6]},
    },
    "spot": {
        "type": "spot",
        "to_world": place((1, 1, 1), (0.5, -0.5, 2.8), degrees=160),
        "intensity": {"type": "rgb", "value": [30.0, 27, 20]},
        "cutoff_angle": 40,
    },
    "constant": {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}},
    "envmap": {
        "type": "envmap",
        "data": SKY.astype(np.float32),
        "to_world": place(about=(1, 0, 0), degrees=90),
    },
    "sunsky": {"type": "sunsky", "sun_direction": [0.5, -0.6, 0.7], "turbidity": 3.0, "sun_aperture": 5.0},
    "directional": {
        "type": "directional",
        "direction": [-0.4, 0.5, -0.7],
        "irradiance": {"type": "rgb", "value": [5.0, 5, 4]},
    },
}


def both(
    content: dict[str, Any], *, bounces: int = 2, path_bounces: int | None = None, **more: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Our frame and the path tracer's, (48, 48, 3)."""
    description = described(content)
    ours = renderer(description, bounces=bounces, **more).shade(1, None)
    assert ours.image.shape == (48, 48, 3)
    theirs = renderer(description, bounces=path_bounces or bounces, spp=1024).path(1)
    return ours.image, theirs.image


def assert_alike(image: np.ndarray, reference: np.ndarray, *, mean: float = 0.02, part: float = 0.06) -> None:
    """Mean radiance of the image and of each sixteenth of it: interpolation may err a little, locally."""
    np.testing.assert_allclose(image.mean((0, 1)), reference.mean((0, 1)), rtol=mean)
    parts = [a.reshape(4, 12, 4, 12, 3).mean(axis=(1, 3, 4)) for a in (image, reference)]
    np.testing.assert_allclose(*parts, rtol=part, atol=0.01 * reference.mean())


@pytest.mark.parametrize(
    "kind", [each if each in ("area", "envmap", "directional") else slow(each) for each in EMITTERS]
)
def test_a_room_lit_by_one_kind_of_emitter_looks_as_path_traced(kind: str) -> None:
    # With the few paths of a draft, records are too noisy for these bounds beside a patch of sun.
    assert_alike(*both(room() | {"light": EMITTERS[kind]}, quality=0.5))


def test_many_kinds_of_emitters_together_look_as_path_traced() -> None:
    emitters = {f"light_{kind}": EMITTERS[kind] for kind in ("area", "point", "spot", "constant")}
    assert_alike(*both(room() | emitters))


RIPPLES = np.sin(np.linspace(0, 12 * np.pi, 64))[None, :, None] * np.ones((64, 1, 1))
LEANING = np.broadcast_to([0.65, 0.5, 0.95], (4, 4, 3))  # a normal of (0.3, 0, 0.9), about
SPOTS = (np.indices((4, 4)).sum(0) % 2 * 1.0)[..., None]


def bitmap(data: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "data": data.astype(np.float32), "raw": True}


PRINCIPLED = {"type": "principled", "base_color": paint(0.6, 0.5, 0.4)["reflectance"], "roughness": 0.4}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": paint(0.6, 0.3, 0.2),
    "roughplastic": {
        "type": "roughplastic",
        "alpha": 0.15,
        "diffuse_reflectance": paint(0.1, 0.3, 0.5)["reflectance"],
    },
    "plastic": {"type": "plastic", "diffuse_reflectance": paint(0.1, 0.3, 0.5)["reflectance"]},
    "principled": {
        "type": "principled",
        "base_color": paint(0.6, 0.4, 0.2)["reflectance"],
        "roughness": 0.3,
        "metallic": 0.2,
        "specular": 0.6,
        "clearcoat": 0.4,
    },
    "conductor": {"type": "conductor", "material": "Au"},
    "roughconductor": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "dielectric": {"type": "dielectric"},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    "thindielectric": {"type": "thindielectric"},
    "mask": {"type": "mask", "opacity": 0.4, "bsdf": paint(0.6, 0.3, 0.2)},
    "mask with holes": {"type": "mask", "opacity": bitmap(SPOTS), "bsdf": paint(0.6, 0.3, 0.2)},
    "twosided": {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.2}},
    "bumpmap": {
        "type": "twosided",
        "bsdf": {"type": "bumpmap", "bump": bitmap(RIPPLES), "scale": 0.02, "bsdf": paint(0.6, 0.3, 0.2)},
    },
    "normalmap": {
        "type": "twosided",
        "bsdf": {"type": "normalmap", "normalmap": bitmap(LEANING), "bsdf": paint(0.6, 0.3, 0.2)},
    },
    "blendbsdf": {
        "type": "blendbsdf",
        "weight": 0.4,
        "first": paint(0.6, 0.3, 0.2),
        "second": {"type": "roughconductor", "alpha": 0.2},
    },
    "null": {"type": "null"},
    "principled metal": {
        "type": "principled",
        "base_color": paint(0.9, 0.7, 0.5)["reflectance"],
        "metallic": 1.0,
        "roughness": 0.3,
    },
    "principled glass": {
        "type": "principled",
        "base_color": paint(0.9, 0.9, 0.95)["reflectance"],
        "spec_trans": 1.0,
        "roughness": 0.1,
        "eta": 1.5,
    },
    "principled veil": {"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": PRINCIPLED}},
    "pplastic": {
        "type": "pplastic",
        "alpha": 0.2,
        "diffuse_reflectance": paint(0.1, 0.3, 0.5)["reflectance"],
    },
    "paper": {"type": "principledthin", "base_color": paint(0.7, 0.6, 0.4)["reflectance"], "diff_trans": 1.2},
    "normalmap plastic": {
        "type": "twosided",
        "bsdf": {
            "type": "normalmap",
            "normalmap": bitmap(LEANING),
            "bsdf": {"type": "roughplastic", "alpha": 0.2},
        },
    },
    "normalmap principled": {
        "type": "twosided",
        "bsdf": {"type": "normalmap", "normalmap": bitmap(LEANING), "bsdf": PRINCIPLED},
    },
    "translucent": {
        "type": "principledthin",
        "base_color": paint(0.7, 0.6, 0.4)["reflectance"],
        "roughness": 0.5,
        "diff_trans": 1.2,
        "spec_trans": 0.2,
    },
}
GROUPS = {
    "paints": ("diffuse", "plastic", "roughplastic", "twosided", "bumpmap"),
    "metals": ("conductor", "roughconductor", "principled", "blendbsdf"),
    "glass": ("dielectric", "roughdielectric", "thindielectric", "null"),
    "leaves": ("mask", "mask with holes", "translucent"),
    "normal maps": ("normalmap", "normalmap plastic", "normalmap principled"),
    "many lobes": ("principled metal", "principled glass", "principled veil", "pplastic", "paper"),
}
SOLID = ("dielectric", "roughdielectric", "principled glass")
PLACES = [(x, 0.0, z) for z in (0.65, 1.85) for x in (-1.2, 0.0, 1.2)]


def things(kinds: tuple[str, ...]) -> dict[str, Any]:
    """A leaning panel or, of solid glass, a sphere of each material, a metre wide.

    Flat, since at this resolution a record reaches over a good part of a ball, and what a light path does is to be
    tested here, not interpolation.
    """
    made = {}
    for kind, at in zip(kinds, PLACES, strict=False):
        sphere = {"type": "sphere", "center": list(at), "radius": 0.5}
        panel = {"type": "rectangle", "to_world": place((0.55, 0.55, 1), at, degrees=60)}
        made[f"thing {kind}"] = {**(sphere if kind in SOLID else panel), "bsdf": MATERIALS[kind]}
    return made


def shows(made: Renderer, name: str) -> np.ndarray:
    """(48, 48) which pixels show nothing but one thing, its outline left out."""
    scene, sensor = made.view.scene, made.view.camera.sensor
    shape = next(shape for shape in scene.shapes() if shape.id() == name)
    y, x = np.mgrid[0:48, 0:48].reshape(2, -1).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, (mi.Point2f(x, y) + 0.5) / 48, 0.5)
    hit = scene.ray_intersect(ray).shape == mi.ShapePtr(shape)
    around = sliding_window_view(np.pad(np.array(hit).reshape(48, 48), 1), (3, 3))
    return around.all(axis=(2, 3))


@pytest.mark.parametrize("group", [each if each == "paints" else slow(each) for each in GROUPS])
def test_things_of_every_material_look_as_path_traced(group: str) -> None:
    # Mirrors, glass and gloss seen by the camera do not count as bounces with us, as they do in the path
    # tracer. With so many bounces neither drops anything that could be seen: a wall returns half of the light,
    # and half of that leaves through the front. Glass in the way of a gather does count, twice for each thing.
    content = {**room(), **things(GROUPS[group]), "light": lamp()}
    del content["thing"]
    bounces = 8 if group in ("glass", "many lobes") else 4
    image, reference = both(content, bounces=bounces, path_bounces=12, quality="normal")
    # Beneath balls of glass lie spots of light smaller than the radius of a record: spread, but of the same sum.
    assert_alike(image, reference, part=0.1 if group == "glass" else 0.06)
    assert image.min() >= 0
    made = renderer(described(content))
    wrong = {}
    for kind in GROUPS[group]:
        pixels = shows(made, f"thing {kind}")
        assert pixels.sum() > 30, kind
        # At least thirty pixels of 256 paths: the reference is sure to 1 %. Interpolation may err by 3 % there, and
        # plastics by 2 % more: their base is taken to reflect alike in all directions.
        error = image[pixels].mean(axis=0) / reference[pixels].mean(axis=0) - 1
        if np.abs(error).max() > (0.06 if "plastic" in kind else 0.04):
            wrong[kind] = error
    assert not wrong


def test_normal_maps_pass_on_no_more_light_than_they_receive() -> None:
    # Where a map turns the whole lobe under the surface, no direction can be drawn.
    content = {**room(), **things(GROUPS["normal maps"]), "light": lamp()}
    del content["thing"]
    made = renderer(described(content), bounces=4, quality="normal")
    made.use(made.prepare())
    filler = made._shared_filler
    known = filler.gather.context.secondary.cache.records
    gather = dataclasses.replace(filler.gather, quality=made.view.quality.secondary)
    exchange = Exchange(gather, known, np.full(len(known), 4))
    passed_on = np.abs(np.concatenate([np.array(end.throughput) for end in exchange._ends], axis=1))
    assert passed_on.max() < 10
    assert exchange.passed_on(np.ones((len(known), 3))).mean(axis=1).max() < 1


def test_a_mirror_shows_indirect_light_that_no_bounce_is_left_for_in_a_path() -> None:
    content = room({"type": "conductor"}) | {"light": lamp()}
    image, path = both(content, bounces=1)
    middle = (slice(20, 32), slice(20, 28))
    # What is seen in the mirror has as many bounces as what is seen directly; Mitsuba's path has one less.
    deeper = renderer(described(content), bounces=2, spp=256).path(1).image
    assert deeper[middle].mean() > 1.03 * path[middle].mean()
    np.testing.assert_allclose(image[middle].mean(), deeper[middle].mean(), rtol=0.02)


def test_without_bounces_only_direct_light_is_seen() -> None:
    image, reference = both(room() | {"light": lamp()}, bounces=0)
    assert_alike(image, reference, mean=0.01)


def test_no_light_is_lost_where_hardly_any_comes_through() -> None:
    wall = {
        "type": "rectangle",
        "to_world": place((9, 9, 1), (0, 3, 0), degrees=90),
        "bsdf": paint(0.5, 0.5, 0.5),
    }
    content = {"wall": wall, "light": {**EMITTERS["point"], "position": [0.0, 2.0, 1.5]}}
    # Grey glass that reflects nothing, three times: 1e-4 of the light is left, far below what is negligible.
    grey = {
        "type": "thindielectric",
        "int_ior": 1.0001,
        "specular_transmittance": 0.0464,
        "specular_reflectance": 0.0,
    }
    panes = {
        f"pane_{n}": {
            "type": "rectangle",
            "to_world": place((9, 9, 1), (0, n / 2, 0), degrees=90),
            "bsdf": grey,
        }
        for n in range(3)
    }
    clear = renderer(described(content), bounces=0).shade(1, None).image
    dim = renderer(described(content | panes), bounces=0, spp=1024).shade(1, None).image
    assert dim.mean() == pytest.approx(0.0464**3 * clear.mean(), rel=0.03)


def test_emitters_are_seen_as_they_are() -> None:
    panel = {"type": "rectangle", "to_world": place((9, 9, 1), (0, 3, 0), degrees=90), "emitter": LAMP}
    panel["bsdf"] = paint(0, 0, 0)
    frame = renderer(described({"panel": panel}), spp=4).shade(1, None)
    np.testing.assert_allclose(frame.image, np.broadcast_to([9, 8, 7], (48, 48, 3)), rtol=1e-5)
    assert frame.missed == 0


def test_a_lamp_whose_plane_is_rounded_leaves_no_pixel_without_a_value() -> None:
    # Points of a lamp see the rest of it at a grazing angle of rounding: densities beyond 1e19.
    turned = {**lamp(), "to_world": place((0.7, 0.5, 1), (0, 0.8, 2.95), degrees=180)}
    image = renderer(described(room() | {"light": turned}), bounces=0).shade(1, None).image
    assert np.isfinite(image).all()


def test_traits_tell_which_lobes_a_scene_has() -> None:
    def of(bsdf: dict[str, Any]) -> BSDFTraits:
        return BSDFTraits(
            build_scene(described({"thing": {"type": "sphere", "bsdf": bsdf}, "light": lamp()}))
        )

    assert of(MATERIALS["diffuse"]).only_diffuse
    for kind in ("roughplastic", "dielectric", "blendbsdf", "translucent"):
        assert not of(MATERIALS[kind]).only_diffuse, kind
    assert of(MATERIALS["principled"])._inseparable is not None
    assert of(MATERIALS["roughplastic"])._inseparable is None
    for kind, bsdf in MATERIALS.items():
        traits = of(bsdf)
        assert (traits.layered is not None) == (kind in ("plastic", "roughplastic", "twosided")), kind
        assert (traits.dielectric is not None) == (kind in ("dielectric", "thindielectric")), kind
        assert traits.random_transparency == (
            kind in ("mask", "mask with holes", "principled veil", "null")
        ), kind
        assert (traits._inseparable is not None) == any(
            word in kind for word in ("principled", "translucent", "paper")
        ), kind
        assert (traits.uneven is not None) == ("map" in kind), kind
    glass, water = ({"type": "dielectric", "int_ior": ior} for ior in (1.5, 1.33))
    for weight in (0.5, bitmap(SPOTS)):
        mixture = {"type": "blendbsdf", "weight": weight, "glass": glass, "water": water}
        assert of(mixture).dielectric is None
    for kind in ("dielectric", "conductor"):
        assert of({"type": "mask", "opacity": 0.4, "bsdf": MATERIALS[kind]}).dielectric is None, kind
    assert mi.variant() == "llvm_ad_rgb"


def test_traits_know_what_shape_groups_are_made_of() -> None:
    ball = {"type": "sphere", "bsdf": MATERIALS["roughconductor"]}
    content = {
        "group": {"type": "shapegroup", "ball": ball},
        "instance": {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}},
        "light": lamp(),
    }
    traits = BSDFTraits(build_scene(described(content)))
    assert traits.glossy
    assert not traits.only_diffuse


def test_slivers_whose_colour_mitsuba_cannot_interpolate_leave_no_pixel_without_a_value(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(1)
    corner = rng.uniform(-1, 1, (2000, 3))
    along, aside = rng.standard_normal((2, 2000, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    vertices = np.stack([corner, corner + 0.5 * along, corner + 0.25 * along + 1e-4 * aside], axis=1)
    mesh = mi.Mesh("slivers", 6000, 2000)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = np.arange(6000, dtype=np.uint32)
    parameters.update()
    mesh.add_attribute("vertex_color", 3, np.full(18000, 0.5, np.float32))
    mesh.write_ply(str(tmp_path / "slivers.ply"))
    coloured = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    slivers = {
        "type": "ply",
        "filename": str(tmp_path / "slivers.ply"),
        "bsdf": {"type": "twosided", "bsdf": coloured},
    }
    content = {
        "group": {"type": "shapegroup", "slivers": slivers},
        "instance": {
            "type": "instance",
            "shapegroup": {"type": "ref", "id": "group"},
            "to_world": place(at=(0, 0, 1.2)),
        },
        **room(),
        "light": lamp(),
    }
    del content["thing"]
    made = renderer(described(content), spp=16)
    assert not np.isfinite(made.path(1).image).all()
    records = made.first_pass(1).records
    # Nothing need be overhead: then the free height is infinite.
    assert all(np.isfinite(getattr(records, name)).all() for name in set(records.SHAPES) - {"headroom"})
    assert np.isfinite(made.shade(1, made.load(records).with_fallback()).image).all()


@pytest.mark.parametrize("seen", [1, -1], ids=["in front", "behind"])
@pytest.mark.parametrize(
    ("view", "turned"),
    [((0, 0, 1), False), ((0.9, 0, 0.44), False), ((-0.99, 0, 0.1), True)],
    ids=["at a right angle", "at an angle", "at a glance, where the interpolated normal faces away"],
)
def test_the_diffuse_lobe_faces_the_viewer_and_no_cache_serves_one_that_does_not(
    view: tuple[float, ...], turned: bool, seen: int
) -> None:
    corners = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = mi.Mesh("leaning", 4, 2, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.ravel()
    parameters["vertex_normals"] = np.tile(np.float32([0.26, 0, 0.97]), 4)
    parameters["faces"] = np.uint32([0, 1, 2, 0, 2, 3])
    parameters.update()
    scene = mi.load_dict(
        {"type": "scene", "panel": mesh, "lining": {"type": "sphere", "radius": 9, "bsdf": TWOSIDED}}
    )
    towards = seen * mi.Vector3f(view)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0) + towards, -towards))
    bsdf = mi.load_dict(TWOSIDED)
    numbers = samples_of(mi.UInt32(1), mi.UInt32(0), mi.UInt32(0)).at(mi.UInt32(0), mi.UInt32(0))
    lobe = BSDFTraits(scene).diffuse_lobe(si, mi.BSDFPtr(bsdf), numbers, mi.Bool(True))
    facing = -seen if turned else seen
    np.testing.assert_allclose(np.ravel(lobe.normal), facing * np.float32((0.26, 0, 0.97)), atol=0.01)
    assert [bool(mask[0]) for mask in (lobe.turned, lobe.active)] == [turned, not turned]


def test_an_orthographic_view_looks_as_path_traced() -> None:
    description = described(
        room() | {"light": lamp()}, sensor={"type": "orthographic", "scale": [1.8, 1.8, 1.0]}
    )
    image = renderer(description, bounces=4).shade(1, None).image
    assert_alike(image, renderer(description, bounces=4, spp=512).path(1).image)


def plain(made: Renderer) -> None:
    """Paths of normal quality, and no pixel gets more samples."""
    shade_as_normal(made)
    sample_again(made, "direct", threshold=np.inf)


def seen_often(made: Renderer, cache: DeviceCache) -> np.ndarray:
    """(8, 48, 48, 3) the same frame with other random numbers each time."""
    images = []
    for seed in range(8):
        made._settings = made._settings.model_copy(update={"seed": seed})
        images.append(made.shade(1, cache).image)
    return np.array(images)


def assert_as_bright_with_less_noise(images: np.ndarray, others: np.ndarray, quieter: float) -> None:
    """In the middle of the pictures: the same mean, and a variance by so much smaller."""
    middle = np.s_[:, 14:34, 14:34]
    np.testing.assert_allclose(images[middle].mean(), others[middle].mean(), rtol=0.02)
    assert images[middle].var(axis=0).mean() < others[middle].var(axis=0).mean() / quieter


@pytest.mark.parametrize(("alpha", "quieter"), [slow(0.05, 2.0), (0.3, 1.0)])
def test_a_glossy_surface_is_left_in_several_directions_which_changes_nothing_but_the_noise(
    alpha: float, quieter: float
) -> None:
    content = room({"type": "roughconductor", "material": "Au", "alpha": alpha}) | {"lamp": lamp()}
    made = renderer(described(content), spp=16)
    cache = made.load(made.first_pass(1).records).with_fallback()

    plain(made)
    several = seen_often(made, cache)
    made.view.limits.glossy_branches = 1
    one = seen_often(made, cache)
    assert_as_bright_with_less_noise(several, one, quieter)
    np.testing.assert_allclose(several.mean((1, 2, 3)), one.mean((1, 2, 3)), rtol=0.03)


@pytest.mark.parametrize("glass", [None, slow({"type": "thindielectric"})], ids=["open", "glazed"])
def test_sky_in_a_rough_layer_is_looked_for_in_several_directions_which_changes_nothing_but_the_noise(
    glass: dict[str, Any] | None,
) -> None:
    varnish = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.05}
    content = room(varnish) | {"sky": EMITTERS["constant"]}
    if glass is not None:
        content["pane"] = {"type": "rectangle", "to_world": place((2, 1, 1), (0, -1, 3)), "bsdf": glass}
    made = renderer(described(content), spp=16)
    cache = made.load(made.first_pass(1).records).with_fallback()
    plain(made)
    several = seen_often(made, cache)
    made.view.limits.sky_directions = 1
    # At the rims of the sky, five directions have a fifth of the variance; the room is met by one of them alone.
    assert_as_bright_with_less_noise(several, seen_often(made, cache), 1.4)


@pytest.mark.parametrize(
    ("kind", "more", "quieter"),
    [
        ("plastic", {}, 1.5),
        slow("roughplastic", {"alpha": 0.02}, 1.3),
        slow("roughplastic", {"alpha": 0.4}, 0.9),
        # All light is the layer's, which otherwise is left in four directions.
        slow("roughplastic", {"alpha": 0.4, "diffuse_reflectance": 0.0}, 0.2),
    ],
)
@pytest.mark.parametrize("beside", [pytest.param(False, id="lamp above"), slow(True, id="lamp beside")])
def test_a_specular_layer_sampled_apart_from_its_base_changes_nothing_but_the_noise(
    kind: str, more: dict[str, Any], quieter: float, beside: bool
) -> None:
    # A sample of a lamp close by stands for so much that a ray from the base is sent, too.
    close = {"type": "sphere", "center": [0.278, -0.88, 1.185], "radius": 0.03, "emitter": LAMP}
    content = room({"type": kind, **more}) | {"lamp": close if beside else lamp()}
    made = renderer(described(content), spp=16)
    cache = made.load(made.first_pass(1).records).with_fallback()
    plain(made)
    apart = seen_often(made, cache)
    made.view.bsdfs.layered = None
    # Beside the lamp, few bright samples make most of the variance, of which eight pictures tell little.
    assert_as_bright_with_less_noise(apart, seen_often(made, cache), min(quieter, 0.9) if beside else quieter)


@pytest.mark.parametrize("glass", ["dielectric", slow("thindielectric")])
@pytest.mark.parametrize(("layers", "quieter"), [slow(1, 2.0), (2, 2.0), slow(5, 1.2)])
def test_clear_glass_left_both_ways_changes_nothing_but_the_noise(
    glass: str, layers: int, quieter: float
) -> None:
    # Plates between the camera and the room; they mirror a lit wall behind the camera, with a lamp on it.
    white = {"type": "twosided", "bsdf": paint(0.9, 0.9, 0.9)}
    content = room() | {
        "lamp": lamp(),
        "wall": {"type": "rectangle", "to_world": place((9, 9, 1), (0, -7, 0), degrees=-90), "bsdf": white},
        "lit": {"type": "sphere", "center": [0.2, -6.5, 1.5], "radius": 0.1, "emitter": LAMP},
    }
    for number in range(layers):
        shape = "cube" if glass == "dielectric" else "rectangle"
        content[f"plate{number}"] = {
            "type": shape,
            "to_world": place((0.9, 0.9, 0.01), (0, -2 + 0.1 * number, 1.4), degrees=90),
            "bsdf": {"type": glass},
        }
    made = renderer(described(content), spp=16)
    cache = made.load(made.first_pass(1).records).with_fallback()
    plain(made)
    both_ways = seen_often(made, cache)
    made.view.bsdfs.dielectric = None
    by_chance = seen_often(made, cache)
    assert_as_bright_with_less_noise(both_ways, by_chance, quieter)
    np.testing.assert_allclose(both_ways.mean((1, 2, 3)), by_chance.mean((1, 2, 3)), rtol=0.02)


def test_a_kernel_ends_though_a_ray_on_an_edge_meets_another_surface_when_it_is_traced_again() -> None:
    # A glossy surface is left several times, each time from the camera anew. In this frame one of these rays grazes the
    # edge of a glossy surface and meets it once only; a count of surfaces would never come to its end.
    render = """
from steadylight.renderers.mitsuba.backend import use_variant
use_variant("llvm_ad_rgb")
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.scenes import load_scene
from steadylight.settings import RenderSettings
scene = load_scene("corridor")
settings = RenderSettings(frames=(20,), width=512, height=288, spp=16, bounces=0, seed=103)
poses = dict(zip(settings.frames, scene.camera.frame_poses(settings.frames, scene.fps), strict=True))
print(Renderer(scene, poses, settings).shade(20, None).image.mean())
"""
    done = subprocess.run(
        [sys.executable, "-c", render], capture_output=True, text=True, check=True, timeout=300
    )
    assert 0.1 < float(done.stdout) < 1
