"""Materials of USD stages: UsdPreviewSurface, MaterialX, textures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image
from usd_stages import FLOOR, read, texts

from steadylight.images import write_exr
from steadylight.scenes.image_texture import linear_texels

BINDING = 'def Mesh "Floor" (prepend apiSchemas = ["MaterialBindingAPI"])'
UV = """
    rel material:binding = </M>
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
    texCoord2f[] primvars:map2 = [(0, 0), (2, 0), (2, 2), (0, 2)] (interpolation = "vertex")
    point3f[]"""
PREVIEW = 'uniform token info:id = "UsdPreviewSurface"\ntoken outputs:surface'
ST = """
def Shader "ST" { uniform token info:id = "UsdPrimvarReader_float2"
  string inputs:varname = "map2"
  float2 outputs:result }"""


def floor(shaders: str, output: str = "outputs:surface", source: str = "S.outputs:surface") -> str:
    """A floor with a material of these shaders."""
    bound = FLOOR.replace('def Mesh "Floor"', BINDING).replace("    point3f[]", UV)
    return f'def Material "M" {{ token {output}.connect = </M/{source}>\n{shaders} }}\n{bound}'


def surface(lines: str, kind: str = PREVIEW, more: str = "") -> str:
    return floor(f'def Shader "S" {{ {kind}\n{lines} }}\n{more}')


def bsdf(found):
    """The BSDF of the material, without the wrapper of opaque ones."""
    made = found.content["material M"]
    return made["bsdf"] if made["type"] == "twosided" else made


def test_a_matt_preview_surface_is_a_diffuse_one_under_a_boundary(tmp_path):
    made = bsdf(
        read(tmp_path, surface("color3f inputs:diffuseColor = (0.2, 0.4, 0.6)\nfloat inputs:roughness = 0.5"))
    )
    assert made["type"] == "roughplastic"
    assert made["diffuse_reflectance"]["value"] == pytest.approx([0.2, 0.4, 0.6])
    assert made["alpha"] == pytest.approx(0.25)
    assert made["int_ior"] == pytest.approx(1.5)


def test_metal_is_a_conductor(tmp_path):
    made = bsdf(read(tmp_path, surface("float inputs:metallic = 1\nfloat inputs:roughness = 0")))
    assert made["type"] == "conductor"


def test_a_specular_workflow_gives_metals_and_boundaries(tmp_path):
    metal = surface("int inputs:useSpecularWorkflow = 1\ncolor3f inputs:specularColor = (0.9, 0.6, 0.3)")
    assert bsdf(read(tmp_path, metal, name="m.usda"))["type"] == "roughconductor"
    paint = surface("int inputs:useSpecularWorkflow = 1\ncolor3f inputs:specularColor = (0.02, 0.02, 0.02)")
    made = bsdf(read(tmp_path, paint, name="p.usda"))
    f0 = ((made["int_ior"] - 1) / (made["int_ior"] + 1)) ** 2
    assert f0 == pytest.approx(0.02)


def test_a_transparent_preview_surface_is_a_clear_pane(tmp_path):
    made = read(tmp_path, surface("float inputs:opacity = 0\nfloat inputs:roughness = 0")).content[
        "material M"
    ]
    assert made["type"] == "thindielectric"
    assert "specular_transmittance" not in made


def test_one_sees_sharply_through_a_rough_preview_surface(tmp_path):
    scene = read(tmp_path, surface("float inputs:opacity = 0.25\nfloat inputs:roughness = 0.5"))
    made = scene.content["material M"]
    assert (made["type"], made["opacity"]) == ("mask", 0.25)
    assert any("its gloss, where it is transparent" in note.text for note in scene.notes)


def test_presence_and_thresholds_are_masks(tmp_path):
    presence = read(
        tmp_path, surface('float inputs:opacity = 0.3\ntoken inputs:opacityMode = "presence"'), name="a.usda"
    )
    assert presence.content["material M"]["opacity"] == pytest.approx(0.3)
    cut = read(
        tmp_path, surface("float inputs:opacity = 0.3\nfloat inputs:opacityThreshold = 0.5"), name="b.usda"
    )
    assert cut.content["material M"]["opacity"] == 0


def test_a_display_opacity_is_not_lost_without_a_note(tmp_path):
    sheet = 'def Plane "Sheet" { float[] primvars:displayOpacity = [0.5] }'
    assert "its displayOpacity" in texts(read(tmp_path, sheet))


def test_an_emissive_surface_is_an_emitter(tmp_path):
    found = read(tmp_path, surface("color3f inputs:emissiveColor = (5, 4, 3)"))
    assert found.content["Floor"]["emitter"]["radiance"]["value"] == [5, 4, 3]
    assert "from its front only" in texts(found)


TEXTURE = """
def Shader "T" { uniform token info:id = "UsdUVTexture"
  asset inputs:file = @wood.png@
  float2 inputs:st.connect = </M/ST.outputs:result>
  token inputs:wrapS = "mirror"
  LINES
  float3 outputs:rgb
  float outputs:g }"""


@pytest.fixture
def wood(tmp_path):
    """Red grows to the right, green is 0.5 (188 in sRGB) throughout."""
    pixels = np.zeros((2, 4, 3), np.uint8)
    pixels[..., 0] = [0, 80, 160, 255]
    pixels[..., 1] = 188
    Image.fromarray(pixels).save(tmp_path / "wood.png")
    return tmp_path


def textured(lines="", use="color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", st=ST):
    return surface(
        use + "\nfloat inputs:roughness = 1\nfloat inputs:ior = 1", more=TEXTURE.replace("LINES", lines) + st
    )


def image_of(found):
    return next(entry for entry in found.content.values() if entry["type"] == "image")


def test_a_texture_is_kept_as_its_file(wood):
    found = read(wood, textured())
    image = image_of(found)
    assert image["filename"] == str(wood / "wood.png")
    assert image["srgb"] is True
    assert image["wrap_mode"] == "mirror"
    assert found.files == {str(wood / "wood.png"): found.files[str(wood / "wood.png")]}


def test_of_images_that_do_not_say_those_of_one_channel_are_linear(wood):
    Image.new("L", (4, 4), 128).save(wood / "wood.png")
    rough = "float inputs:roughness.connect = </M/T.outputs:g>\nfloat inputs:metallic = 1"
    made = bsdf(read(wood, surface(rough, more=TEXTURE.replace("LINES", "") + ST)))
    assert made["alpha"] == pytest.approx((128 / 255) ** 2, abs=1e-3)


def test_the_texture_coordinates_that_a_material_names_are_used(wood):
    coordinates = read(wood, textured()).content["Floor"]["uv"]
    assert (coordinates.min(), coordinates.max()) == (-1, 2)  # of map2, whose v runs from 1 down to -1


def test_scale_bias_and_colour_space_of_a_texture_are_taken(wood):
    lines = (
        "float4 inputs:scale = (0.5, 2, 1, 1)\nfloat4 inputs:bias = (0.1, 0, 0, 0)\n"
        'token inputs:sourceColorSpace = "raw"'
    )
    image = image_of(read(wood, textured(lines)))
    assert image["gain"] == pytest.approx([0.5, 2, 1])
    assert image["bias"] == pytest.approx([0.1, 0, 0])
    assert "srgb" not in image


def test_a_channel_of_a_texture_is_a_number(wood):
    found = read(wood, textured(use="float inputs:metallic.connect = </M/T.outputs:g>"))
    # Constant, so that no texture is left: 188 is 0.5 in sRGB, which `auto` takes 8 bits for.
    assert bsdf(found)["type"] == "blendbsdf"
    assert bsdf(found)["weight"] == pytest.approx(0.5, abs=0.01)


def test_texture_coordinates_are_scaled_turned_and_moved(wood):
    moved = (
        ST
        + """
def Shader "Move" { uniform token info:id = "UsdTransform2d"
  float2 inputs:in.connect = </M/ST.outputs:result>
  float2 inputs:scale = (2, 3)
  float inputs:rotation = 90
  float2 inputs:translation = (0.1, 0.2)
  float2 outputs:result }"""
    )
    body = textured(st=moved).replace("inputs:st.connect = </M/ST.", "inputs:st.connect = </M/Move.")
    matrix = image_of(read(wood, body))["to_uv"]
    s, t = 0.25, 0.5
    # USD, v upward: scaled to (2 s, 3 t), turned to (-3 t, 2 s), moved.
    expected = (-3 * t + 0.1, 1 - (2 * s + 0.2))
    assert (matrix @ [s, 1 - t, 0, 1])[:2] == pytest.approx(expected)


def test_a_normal_map_is_decoded_once(wood):
    lines = (
        "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)\n"
        'token inputs:sourceColorSpace = "raw"'
    )
    found = read(wood, textured(lines, use="normal3f inputs:normal.connect = </M/T.outputs:rgb>"))
    assert bsdf(found)["type"] == "normalmap"
    assert "gain" not in image_of(found)


def test_a_network_that_is_more_than_textures_is_noted(tmp_path):
    odd = 'def Shader "T" { uniform token info:id = "Noise"\ncolor3f outputs:rgb }'
    found = read(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", more=odd))
    assert "left out: material M: diffuseColor: the node T (Noise) is not supported" in texts(found)


def test_nodes_in_a_circle_are_noted(tmp_path):
    circle = "".join(
        f'def Shader "{a}" {{ uniform token info:id = "ND_dot_color3"\n'
        f"color3f inputs:in.connect = </M/{b}.outputs:out>\ncolor3f outputs:out }}\n"
        for a, b in (("A", "B"), ("B", "A"))
    )
    found = read(tmp_path, surface("color3f inputs:diffuseColor.connect = </M/A.outputs:out>", more=circle))
    assert "in a cycle" in texts(found)


def test_a_mesh_without_texture_coordinates_is_warned_of(wood):
    body = textured().replace("texCoord2f[] primvars:", "float2[] primvars:other_")
    assert "has no texture coordinates" in texts(read(wood, body))


OPEN_PBR = 'uniform token info:id = "ND_open_pbr_surface_surfaceshader"\ntoken outputs:surface'


def materialx(lines, kind=OPEN_PBR, more=""):
    return floor(f'def Shader "S" {{ {kind}\n{lines} }}\n{more}', "outputs:mtlx:surface")


def test_open_pbr_glass_is_a_solid_body_unless_thin(tmp_path):
    glass = "float inputs:transmission_weight = 1\nfloat inputs:specular_roughness = 0\nfloat inputs:specular_ior = 1.4"
    solid = read(tmp_path, materialx(glass), name="a.usda").content["material M"]
    assert (solid["type"], solid["int_ior"]) == ("dielectric", pytest.approx(1.4))
    thin = read(tmp_path, materialx(glass + "\nbool inputs:geometry_thin_walled = 1"), name="b.usda")
    assert thin.content["material M"]["type"] == "thindielectric"


def test_a_colour_after_a_depth_is_of_the_body(tmp_path):
    lines = (
        "color3f inputs:transmission_color = (0.25, 0.25, 0.25)\n"
        "float inputs:transmission_weight = 1\nfloat inputs:specular_roughness = 0"
    )
    made = read(tmp_path, materialx(lines)).content["material M"]
    assert made["specular_transmittance"]["value"] == pytest.approx([0.5] * 3)  # at each of two boundaries


def test_the_emission_of_open_pbr_is_luminance_times_colour(tmp_path):
    found = read(
        tmp_path,
        materialx("float inputs:emission_luminance = 4\ncolor3f inputs:emission_color = (1, 0.5, 0)"),
    )
    assert found.content["Floor"]["emitter"]["radiance"]["value"] == [4, 2, 0]


def test_what_open_pbr_has_beyond_ours_is_noted(tmp_path):
    notes = texts(
        read(tmp_path, materialx("float inputs:fuzz_weight = 1\nfloat inputs:thin_film_weight = 1"))
    )
    assert "its fuzz" in notes
    assert "its thin film" in notes


def test_standard_surface_is_read(tmp_path):
    kind = 'uniform token info:id = "ND_standard_surface_surfaceshader"\ntoken outputs:surface'
    made = bsdf(
        read(
            tmp_path,
            materialx(
                "float inputs:base = 0.5\ncolor3f inputs:base_color = (0.8, 0.8, 0.8)\nfloat inputs:specular = 0",
                kind,
            ),
        )
    )
    assert made == {"type": "diffuse", "reflectance": {"type": "rgb", "value": pytest.approx([0.4] * 3)}}


MATERIALX_IMAGE = """
def Shader "I" { uniform token info:id = "ND_image_color3"
  asset inputs:file = @wood.png@ ( colorSpace = "srgb_texture" )
  string inputs:uaddressmode = "clamp"
  color3f outputs:out }
def Shader "X" { uniform token info:id = "ND_multiply_color3"
  color3f inputs:in1.connect = </M/I.outputs:out>
  color3f inputs:in2 = (0.5, 0.25, 1)
  color3f outputs:out }
def Shader "Y" { uniform token info:id = "ND_mix_color3"
  color3f inputs:fg.connect = </M/X.outputs:out>
  color3f inputs:bg = (1, 1, 1)
  float inputs:mix = 0.5
  color3f outputs:out }"""


def test_arithmetic_of_a_texture_becomes_its_gain_and_bias(wood):
    lines = "color3f inputs:base_color.connect = </M/Y.outputs:out>\nfloat inputs:specular_weight = 0"
    image = image_of(read(wood, materialx(lines, more=MATERIALX_IMAGE)))
    assert image["srgb"] is True
    assert image["wrap_mode"] == "clamp"
    assert image["gain"] == pytest.approx([0.25, 0.125, 0.5])
    assert image["bias"] == pytest.approx(0.5)


BLENDER = """
def Shader "G" { uniform token info:id = "ND_dielectric_bsdf"
  float inputs:ior = 1.5
  float2 inputs:roughness = (0, 0)
  string inputs:scatter_mode = "RT"
  token outputs:out }
def Shader "D" { uniform token info:id = "ND_oren_nayar_diffuse_bsdf"
  color3f inputs:color = (0.3, 0.3, 0.3)
  token outputs:out }
def Shader "E" { uniform token info:id = "ND_uniform_edf"
  color3f inputs:color = (3, 2, 1)
  token outputs:out }
def Shader "Mix" { uniform token info:id = "ND_mix_bsdf"
  token inputs:bg.connect = </M/G.outputs:out>
  token inputs:fg.connect = </M/D.outputs:out>
  float inputs:mix = 0.25
  token outputs:out }"""
LOBES = 'uniform token info:id = "ND_surface"\ntoken outputs:surface'


def test_a_glass_shader_of_blender_is_glass(tmp_path):
    found = read(tmp_path, materialx("token inputs:bsdf.connect = </M/G.outputs:out>", LOBES, BLENDER))
    assert found.content["material M"]["type"] == "dielectric"


def test_a_mixture_of_glass_and_a_matt_colour_is_a_blend(tmp_path):
    made = read(
        tmp_path, materialx("token inputs:bsdf.connect = </M/Mix.outputs:out>", LOBES, BLENDER)
    ).content["material M"]
    assert made["type"] == "blendbsdf"
    assert made["weight"] == pytest.approx(0.75)  # of glass


def test_an_emission_shader_of_blender_is_an_emitter(tmp_path):
    found = read(tmp_path, materialx("token inputs:edf.connect = </M/E.outputs:out>", LOBES, BLENDER))
    assert found.content["Floor"]["emitter"]["radiance"]["value"] == [3, 2, 1]


def test_the_roughness_of_a_bsdf_is_alpha(tmp_path):
    rough = BLENDER.replace("(0, 0)", "(0.25, 0.25)")
    made = read(tmp_path, materialx("token inputs:bsdf.connect = </M/G.outputs:out>", LOBES, rough)).content[
        "material M"
    ]
    assert made["type"] == "roughdielectric"
    assert math.isclose(made["alpha"], 0.25, rel_tol=1e-6)


def test_a_texture_may_be_an_exr_image(tmp_path):
    write_exr(tmp_path / "wood.exr", np.full((2, 4, 3), (0.2, 3.0, 0.4), np.float32))
    image = image_of(read(tmp_path, textured().replace("wood.png", "wood.exr")))
    assert "srgb" not in image
    np.testing.assert_allclose(linear_texels(image)[0, 0], (0.2, 3.0, 0.4), rtol=1e-3)
