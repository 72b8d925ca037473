"""Physically based materials become BSDFs whose lobes stay apart; textures are decoded as they say."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from PIL import Image

from steadylight.errors import SceneError
from steadylight.scenes.image_texture import expanded, linear_texels, size_of, texels
from steadylight.scenes.pbr import Materials, unique
from steadylight.scenes.surface import Surface, Texture, VertexColour


def encoded(image, kind="PNG"):
    """The bytes of an image file."""
    file = io.BytesIO()
    Image.fromarray(np.asarray(image, np.uint8)).save(file, kind)
    return np.frombuffer(file.getvalue(), np.uint8)


def bsdf_of(surface, *, bare=True):
    """The BSDF of a surface, without `twosided`, and the materials it is among."""
    materials = Materials()
    finish = materials.finish(surface)
    bsdf = materials.entries[finish.bsdf["id"]]
    return (bsdf["bsdf"] if bare and bsdf["type"] == "twosided" else bsdf), materials


RAMP = np.tile(np.linspace(0, 255, 64), (4, 1))[..., None].astype(np.uint8)
ORM = np.concatenate([RAMP, RAMP[:, ::-1], RAMP], axis=2)


def test_a_dielectric_is_a_rough_layer_whose_alpha_is_the_square_of_the_roughness():
    bsdf, _ = bsdf_of(Surface("wall", base_color=(0.2, 0.4, 0.6), roughness=0.5))
    assert bsdf["type"] == "roughplastic"
    assert bsdf["alpha"] == pytest.approx(0.25)
    assert bsdf["int_ior"] == pytest.approx(1.5)
    assert bsdf["diffuse_reflectance"]["value"] == [0.2, 0.4, 0.6]


def test_a_smooth_dielectric_is_plastic_and_one_without_reflection_is_diffuse():
    assert bsdf_of(Surface("gloss", roughness=0.0))[0]["type"] == "plastic"
    assert bsdf_of(Surface("chalk", specular=0.0))[0]["type"] == "diffuse"


def test_half_the_specular_weight_halves_the_reflectance_at_normal_incidence():
    bsdf, _ = bsdf_of(Surface("weak", specular=0.5))
    ior = bsdf["int_ior"]
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(0.02)


def test_a_metal_has_its_colour_at_normal_incidence():
    bsdf, _ = bsdf_of(Surface("gold", base_color=(1.0, 0.77, 0.34), metallic=1.0, roughness=0.3))
    assert bsdf["type"] == "roughconductor"
    k = np.array(bsdf["k"]["value"])
    np.testing.assert_allclose(k**2 / (4 + k**2), [0.9999, 0.77, 0.34], rtol=1e-6)


def test_a_texture_of_metal_mixes_two_materials_and_keeps_the_roughness_of_the_metal():
    orm = encoded(ORM)
    bsdf, materials = bsdf_of(
        Surface("worn", metallic=Texture(orm, "b"), roughness=Texture(orm, "g")), bare=True
    )
    assert (bsdf["type"], bsdf["first"]["type"], bsdf["second"]["type"]) == (
        "blendbsdf",
        "roughplastic",
        "roughconductor",
    )
    np.testing.assert_allclose(
        linear_texels(materials.entries[bsdf["weight"]["id"]])[..., 0], ORM[..., 2] / 255, atol=1e-6
    )
    np.testing.assert_allclose(
        linear_texels(materials.entries[bsdf["second"]["alpha"]["id"]])[..., 0],
        (ORM[..., 1] / 255.0) ** 2,
        atol=1e-3,
    )
    assert [note.kind for note in materials.notes] == ["approximated"]
    assert "0.50 is used wherever it is not metal" in materials.notes[0].text


def test_textures_without_variation_become_numbers():
    flat = encoded(np.broadcast_to(np.array([0, 128, 0], np.uint8), (4, 4, 3)))
    bsdf, materials = bsdf_of(Surface("flat", metallic=Texture(flat, "b"), roughness=Texture(flat, "g")))
    assert bsdf["type"] == "roughplastic"
    assert bsdf["alpha"] == pytest.approx((128 / 255) ** 2, abs=1e-3)
    assert not materials.notes


def test_glass_is_a_pane_if_thin_and_a_body_if_not():
    thin, _ = bsdf_of(Surface("pane", (1.0, 1.0, 1.0), transmission=1.0, roughness=0.0))
    thick, _ = bsdf_of(
        Surface("ball", (0.64, 1.0, 1.0), transmission=1.0, roughness=0.0, thin=False, ior=1.33)
    )
    frosted, _ = bsdf_of(Surface("frost", transmission=1.0, roughness=0.5, thin=False))
    assert thin["type"] == "thindielectric"
    assert thick["type"] == "dielectric"
    assert thick["int_ior"] == 1.33
    # Light crosses two boundaries, and bears the colour once.
    assert thick["specular_transmittance"]["value"] == pytest.approx([0.8, 1.0, 1.0])
    assert (frosted["type"], frosted["alpha"]) == ("roughdielectric", 0.25)


def test_a_body_of_glass_attenuates_as_much_as_its_thickness():
    surface = Surface(
        "bottle",
        (1.0, 1.0, 1.0),
        transmission=1.0,
        roughness=0.0,
        thin=False,
        attenuation_color=(0.25, 0.5, 1.0),
        attenuation_distance=0.01,
        thickness=0.02,
    )
    bsdf, materials = bsdf_of(surface)
    assert bsdf["specular_transmittance"]["value"] == pytest.approx([0.25, 0.5, 1.0])
    assert materials.notes[0].kind == "approximated"


def test_a_coat_over_a_dielectric_is_what_reflects_and_over_metal_it_is_principled():
    coated, _ = bsdf_of(Surface("lacquer", roughness=0.8, coat=1.0, coat_roughness=0.0))
    half, _ = bsdf_of(Surface("thin lacquer", roughness=0.8, coat=0.5, coat_roughness=0.0))
    car, materials = bsdf_of(Surface("car", metallic=1.0, coat=1.0))
    assert coated["type"] == "plastic"
    assert (half["type"], half["weight"], half["first"]["type"]) == ("blendbsdf", 0.5, "roughplastic")
    assert car["type"] == "principled"
    assert "noise" in materials.notes[0].text


def test_opacity_is_a_mask_outside_and_a_threshold_cuts_it_out():
    leaf = np.zeros((2, 2, 4), np.uint8)
    leaf[0, :, 3] = 140
    opacity = Texture(encoded(leaf), "a", threshold=0.5)
    bsdf, materials = bsdf_of(Surface("leaf", opacity=opacity), bare=False)
    assert (bsdf["type"], bsdf["bsdf"]["type"]) == ("mask", "twosided")
    np.testing.assert_array_equal(
        linear_texels(materials.entries[bsdf["opacity"]["id"]])[..., 0], [[1, 1], [0, 0]]
    )


def test_a_normal_map_is_inside_twosided_and_left_out_on_glass():
    bump = Texture(encoded(np.full((2, 2, 3), 128)))
    bsdf, _ = bsdf_of(Surface("brick", normal=bump))
    assert (bsdf["type"], bsdf["bsdf"]["type"]) == ("normalmap", "roughplastic")
    glass, materials = bsdf_of(Surface("pane", transmission=1.0, roughness=0.0, normal=bump))
    assert glass["type"] == "thindielectric"
    assert materials.notes[0].kind == "left out"


def test_what_shines_has_an_area_emitter():
    materials = Materials()
    assert materials.finish(Surface("dark")).emitter is None
    lamp = materials.finish(Surface("lamp", emission=(3.0, 2.0, 1.0)))
    assert lamp.emitter == {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}


def test_names_are_unique_and_without_dots():
    materials = Materials()
    names = [materials.finish(Surface(name)).bsdf["id"] for name in ("a.b", "a.b", "Türe „rot“")]
    assert names == ["material a_b", "material a_b (2)", "material Türe „rot“"]


def test_many_parts_of_one_name_are_numbered():
    taken = {}
    for _ in range(1000):
        taken[unique("part", taken)] = None
    assert list(taken) == ["part", *(f"part ({number})" for number in range(2, 1001))]


def test_one_image_is_one_entry_for_each_use():
    orm = encoded(ORM)
    materials = Materials()
    first, again, other = (materials.texture(Texture(orm, channels)) for channels in ("g", "g", "b"))
    assert first == again
    assert first != other


def test_texels_stay_bytes_unless_something_is_done_to_them():
    image = encoded(ORM)
    plain = texels(Texture(image, srgb=True).entry())
    assert plain.dtype == np.uint8
    np.testing.assert_array_equal(plain, ORM)
    dimmed = texels(Texture(image, srgb=True, gain=(0.5, 0.5, 0.5)).entry())
    assert dimmed.dtype == np.float16
    value = ((128 / 255 + 0.055) / 1.055) ** 2.4 / 2
    np.testing.assert_allclose(dimmed[ORM[0, 32, 0] == ORM], value, rtol=2e-2)
    assert texels(Texture(image, gain=1e6).entry()).dtype == np.float32


def test_sixteen_bits_and_alpha_of_images_without_it():
    file = io.BytesIO()
    Image.fromarray(np.array([[0, 32768, 65535]], np.uint16)).save(file, "PNG")
    deep = np.frombuffer(file.getvalue(), np.uint8)
    np.testing.assert_allclose(linear_texels(Texture(deep, "r").entry())[0, :, 0], [0, 0.50001, 1], atol=1e-3)
    assert (linear_texels(Texture(encoded(ORM), "a").entry()) == 1).all()
    assert size_of(Texture(deep).entry()) == (3, 1)


@pytest.mark.parametrize("cut", [0, 3, 40, 100])
def test_a_damaged_image_is_one_clear_error(cut):
    rng = np.random.default_rng(0)
    whole = encoded(rng.integers(0, 255, (32, 32, 3)))
    with pytest.raises(SceneError, match="image"):
        texels(Texture(whole[:cut]).entry())


def test_content_can_be_expanded_to_plain_bitmaps():
    materials = Materials()
    finish = materials.finish(Surface("wall", base_color=Texture(encoded(ORM), srgb=True, wrap="clamp")))
    content = expanded(materials.entries | {"wall": {"type": "sphere", "bsdf": finish.bsdf}})
    assert list(content) == ["material wall", "wall"]
    bitmap = content["material wall"]["bsdf"]["diffuse_reflectance"]
    assert (bitmap["type"], bitmap["raw"], bitmap["wrap_mode"]) == ("bitmap", True, "clamp")
    assert bitmap["data"].shape == (4, 64, 3)


KINDS = {
    "plastic": Surface("a", roughness=0.0),
    "texture": Surface("b", base_color=Texture(encoded(ORM), srgb=True, to_uv=np.diag([2.0, 2.0, 1.0]))),
    "vertex colours": Surface("c", base_color=VertexColour()),
    "mixture": Surface("d", metallic=Texture(encoded(ORM), "b"), roughness=Texture(encoded(ORM), "g")),
    "metal texture": Surface("e", base_color=Texture(encoded(ORM)), metallic=1.0, roughness=0.0),
    "pane": Surface("f", transmission=1.0, roughness=0.0),
    "frosted pane": Surface("g", transmission=1.0, roughness=0.4),
    "body": Surface("h", transmission=0.5, roughness=Texture(encoded(ORM), "g"), thin=False),
    "coat": Surface("i", coat=Texture(encoded(ORM), "r"), coat_roughness=0.3),
    "coated metal": Surface("j", metallic=1.0, coat=1.0),
    "mask": Surface("k", opacity=0.5, normal=Texture(encoded(ORM))),
    "tinted gloss": Surface("l", specular_color=(1.0, 0.5, 0.5), specular=Texture(encoded(ORM), "a")),
    "lamp": Surface("m", emission=Texture(encoded(ORM), srgb=True, gain=(20.0, 20.0, 10.0))),
}


@pytest.mark.parametrize("kind", KINDS)
def test_mitsuba_takes_every_kind_of_surface(kind):
    import mitsuba as mi

    from steadylight.camera import CameraPath, Keyframe
    from steadylight.renderers.mitsuba.scene import check_scene
    from steadylight.scenes.description import SceneDescription

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    materials = Materials()
    finish = materials.finish(KINDS[kind])
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = {
        "type": "triangles",
        "vertices": square,
        "faces": np.array([[0, 1, 2]], np.uint32),
        "uv": square[:, :2],
        "colors": np.ones((3, 3), np.float32),
        "bsdf": finish.bsdf,
    }
    mesh |= {} if finish.emitter is None else {"emitter": finish.emitter}
    content = {**materials.entries, "mesh": mesh, "sky": {"type": "constant"}}
    check_scene(
        SceneDescription("test", content, CameraPath((Keyframe(0.0, (0.0, 0.0, 5.0), (0.0, 1.0, 0.0)),)))
    )
    assert math.isfinite(KINDS[kind].ior)
