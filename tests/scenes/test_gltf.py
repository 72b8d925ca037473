"""glTF files become descriptions that show the same: places, materials, lamps in photometric units, cameras."""

from __future__ import annotations

import io
import json
import math

import numpy as np
import pytest
from glb import Glb, rotation
from PIL import Image

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes import load_scene
from steadylight.scenes.gltf.lights import spot_angles
from steadylight.scenes.gltf.schema import Spot

CHALK = {
    "pbrMetallicRoughness": {"metallicFactor": 0},
    "extensions": {"KHR_materials_specular": {"specularFactor": 0}},
}
"""A material without gloss."""


def png(image):
    """The bytes of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(np.asarray(image, np.uint8)).save(file, "PNG")
    return file.getvalue()


def chalk(albedo):
    """A diffuse material."""
    return {**CHALK, "pbrMetallicRoughness": {"metallicFactor": 0, "baseColorFactor": [*albedo, 1]}}


def shapes(scene):
    """The meshes of a description, by name."""
    return {name: entry for name, entry in scene.content.items() if entry["type"] == "triangles"}


def only_mesh(scene):
    """The one mesh of a description."""
    (mesh,) = shapes(scene).values()
    return mesh


def bsdf_of(scene, mesh):
    """The BSDF of a mesh, without `twosided`."""
    bsdf = scene.content[mesh["bsdf"]["id"]]
    return bsdf["bsdf"] if bsdf["type"] == "twosided" else bsdf


def texts(scene, kind):
    """The notes of a kind."""
    return [f"{note.where}: {note.text}" for note in scene.notes if note.kind == kind]


@pytest.fixture(autouse=True, scope="module")
def _variant():
    """Whatever a test before left, or the scalar one."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")


@pytest.fixture
def lit():
    """A file with a lamp."""
    glb = Glb()
    glb.node(name="lamp", translation=[0, 3, 0], extensions=glb.light(type="point", intensity=683))
    return glb


# ---- places ------------------------------------------------------------------------------------


def test_y_up_becomes_z_up_through_all_parents(lit, tmp_path):
    mesh = lit.square(material=lit.add("materials", **CHALK))
    leaf = lit.node(top=False, mesh=mesh, name="Wand „blau“ 'a' \"b\".001", scale=[2, 1, 1])
    turned = lit.node(top=False, children=[leaf], rotation=rotation([0, 1, 0], math.pi / 2))
    lit.node(children=[turned], matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1])
    folder = tmp_path / "Räume 'alt'"
    folder.mkdir()
    scene = load_scene(lit.write(folder / "größe 1.glb"))
    assert scene.name == "größe 1"
    assert list(shapes(scene)) == ["Wand „blau“ 'a' \"b\"_001"]
    # In the file: x goes to -z by the turn, twice as far; then the place, (10, 20, 30). Then y up to z up.
    expected = [[10, -(30 + 2), 19], [10, -(30 - 2), 19], [10, -(30 - 2), 21], [10, -(30 + 2), 21]]
    np.testing.assert_allclose(only_mesh(scene)["vertices"], expected, atol=1e-5)
    assert scene.content["light lamp"]["position"] == [0, 0, 3]


def test_a_mirrored_mesh_keeps_its_outside(lit, tmp_path):
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    lit.node(mesh=lit.square(NORMAL=normals), scale=[-1, 1, 1])
    mesh = only_mesh(load_scene(lit.write(tmp_path / "a.glb")))
    corners = mesh["vertices"][mesh["faces"]]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(facing / np.linalg.norm(facing, axis=1)[:, None], [[0, -1, 0]] * 2, atol=1e-6)
    np.testing.assert_allclose(mesh["normals"], [[0, -1, 0]] * 4, atol=1e-6)


def test_centimetres_are_the_scale_of_a_parent(lit, tmp_path):
    leaf = lit.node(top=False, mesh=lit.square(size=50.0))
    lit.node(children=[leaf], scale=[0.01, 0.01, 0.01])
    mesh = only_mesh(load_scene(lit.write(tmp_path / "a.glb")))
    assert np.ptp(mesh["vertices"], axis=0).max() == pytest.approx(1.0)


def test_quantized_strided_and_sparse_accessors(lit, tmp_path):
    glb = lit
    rows = np.zeros((4, 8), np.int16)
    rows[:, :3] = [[-32767, -32767, 0], [32767, -32767, 0], [32767, 32767, 0], [-32767, 32767, 0]]
    view = glb.view(rows.tobytes())
    glb.document["bufferViews"][view]["byteStride"] = 16
    sparse = {
        "count": 1,
        "indices": {"bufferView": glb.view(np.array([2], np.uint8).tobytes()), "componentType": 5121},
        "values": {"bufferView": glb.view(np.array([[0, 0, 32767]], np.int16).tobytes())},
    }
    positions = glb.add(
        "accessors",
        bufferView=view,
        componentType=5122,
        count=4,
        type="VEC3",
        normalized=True,
        sparse=sparse,
    )
    strip = glb.array([0, 1, 3, 2], "uint8")
    glb.node(
        mesh=glb.add(
            "meshes", primitives=[{"attributes": {"POSITION": positions}, "indices": strip, "mode": 5}]
        )
    )
    mesh = only_mesh(load_scene(glb.write(tmp_path / "a.glb")))
    np.testing.assert_allclose(mesh["vertices"], [[-1, 0, -1], [1, 0, -1], [0, -1, 0], [-1, 0, 1]], atol=1e-4)
    assert mesh["faces"].tolist() == [[0, 1, 3], [3, 1, 2]] or mesh["faces"].tolist() == [
        [0, 1, 3],
        [1, 3, 2][::1],
    ]


def test_draco_gives_the_same_triangles(lit, tmp_path):
    import DracoPy

    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.uint32)
    data = DracoPy.encode(corners, faces, quantization_bits=16, preserve_order=True)
    position = lit.add("accessors", componentType=5126, count=4, type="VEC3")
    draco = {"bufferView": lit.view(data), "attributes": {"POSITION": 0}}
    primitive = {"attributes": {"POSITION": position}, "extensions": {"KHR_draco_mesh_compression": draco}}
    lit.node(mesh=lit.add("meshes", primitives=[primitive]))
    lit.document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    mesh = only_mesh(load_scene(lit.write(tmp_path / "a.glb")))
    np.testing.assert_allclose(mesh["vertices"], corners[:, [0, 2, 1]] * [1, -1, 1], atol=1e-4)
    assert mesh["faces"].tolist() == faces.tolist()


def test_small_meshes_are_copied_and_large_ones_instanced(lit, tmp_path, monkeypatch):
    mesh = lit.square()
    for place in range(3):
        lit.node(mesh=mesh, translation=[place, 0, 0], name="tile")
    path = lit.write(tmp_path / "a.glb")
    assert len(shapes(load_scene(path))) == 3
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.WORTH_INSTANCING", 4)
    scene = load_scene(path)
    assert [entry["type"] for entry in scene.content.values()][1:5] == [
        "shapegroup",
        "instance",
        "instance",
        "instance",
    ]
    np.testing.assert_allclose(scene.content["tile (3)"]["to_world"][:3, 3], [2, 0, 0])
    # Three copies have six triangles, but the instances share two.
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.MOST_TRIANGLES", 2)
    assert "tile (3)" in load_scene(path).content
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.WORTH_INSTANCING", 5)
    with pytest.raises(SceneError, match="more than 2 triangles"):
        load_scene(path)
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.MOST_TRIANGLES", 1)
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.WORTH_INSTANCING", 4)
    with pytest.raises(SceneError, match="more than 1 triangles"):
        load_scene(path)


def test_instances_look_like_copies(tmp_path, monkeypatch):
    glb = Glb()
    mesh = glb.square(
        1.0, glb.add("materials", **chalk([0.5, 0.25, 1.0])), NORMAL=np.tile([0.0, 0, 1], (4, 1))
    )
    for place in (0, 4):
        glb.node(
            mesh=mesh, translation=[place, 0, 0], rotation=rotation([1, 0, 0], -math.pi / 2), scale=[2, 1, 1]
        )
    glb.node(translation=[4, 2, 0], extensions=glb.light(type="point", intensity=683))
    path = glb.write(tmp_path / "a.glb")
    copied = radiance_seen(load_scene(path), (4.5, 0.0, 1.0), (4.5, 0.0, 0.0))
    monkeypatch.setattr("steadylight.scenes.gltf.meshes.WORTH_INSTANCING", 1)
    scene = load_scene(path)
    assert [entry["type"] for entry in scene.content.values()].count("instance") == 2
    np.testing.assert_allclose(radiance_seen(scene, (4.5, 0.0, 1.0), (4.5, 0.0, 0.0)), copied, rtol=1e-4)
    assert copied.min() > 0


def test_entries_of_one_name_are_all_kept(tmp_path):
    glb = Glb()
    material = glb.add("materials", name="x")
    for name in ("material x", "light x", "x", "x"):
        glb.node(name=name, mesh=glb.square(material=material))
    glb.node(name="x", extensions=glb.light(type="point"))
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    assert list(scene.content) == ["material x", "material x (2)", "light x", "x", "x (2)", "light x (2)"]


def test_gpu_instances_are_places(lit, tmp_path):
    attributes = {"TRANSLATION": lit.array([[0.0, 0, 0], [0, 5, 0]])}
    lit.node(mesh=lit.square(), extensions={"EXT_mesh_gpu_instancing": {"attributes": attributes}})
    first, second = shapes(load_scene(lit.write(tmp_path / "a.glb"))).values()
    np.testing.assert_allclose(second["vertices"] - first["vertices"], [[0, 0, 5]] * 4)


def test_a_skin_and_morph_targets_stand_as_in_the_file(lit, tmp_path):
    mesh = lit.square(JOINTS_0=np.zeros((4, 4)), WEIGHTS_0=np.tile([1.0, 0, 0, 0], (4, 1)))
    joints = np.zeros((4, 4), np.uint8)
    primitive = lit.document["meshes"][mesh]["primitives"][0]
    primitive["attributes"]["JOINTS_0"] = lit.array(joints, "uint8")
    primitive["targets"] = [{"POSITION": lit.array(np.tile([0.0, 0, 4], (4, 1)))}]
    bone = lit.node(translation=[0, 7, 0])
    bind = np.eye(4)
    bind[3, 1] = -1.0  # columns first: the bone was at a height of 1 when it was bound
    skin = lit.add("skins", joints=[bone], inverseBindMatrices=lit.array(bind.reshape(1, 16)))
    lit.node(mesh=mesh, skin=skin, weights=[0.5], translation=[99, 0, 0])
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(only_mesh(scene)["vertices"].mean(axis=0), [0, -2, 6], atol=1e-5)


# ---- materials ---------------------------------------------------------------------------------


def test_the_default_material_is_a_rough_white_metal_as_the_specification_says(lit, tmp_path):
    lit.node(mesh=lit.square())
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert bsdf_of(scene, only_mesh(scene))["type"] == "roughconductor"


def test_all_textures_of_a_material_are_used(lit, tmp_path):
    rng = np.random.default_rng(1)
    texture = lit.image(png(rng.integers(0, 255, (8, 8, 4))))
    use = {"index": texture}
    moved = use | {
        "extensions": {
            "KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 3], "rotation": math.pi / 2}
        }
    }
    material = lit.add(
        "materials",
        name="all",
        pbrMetallicRoughness={
            "baseColorTexture": moved,
            "metallicRoughnessTexture": use,
            "baseColorFactor": [1, 0.5, 1, 1],
        },
        normalTexture=use | {"scale": 0.5},
        occlusionTexture=use,
        alphaMode="MASK",
        alphaCutoff=0.4,
    )
    lit.node(mesh=lit.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    mask = scene.content[only_mesh(scene)["bsdf"]["id"]]
    assert mask["type"] == "mask"
    assert scene.content[mask["opacity"]["id"]]["threshold"] == 0.4
    bump = mask["bsdf"]["bsdf"]
    assert (bump["type"], bump["bsdf"]["type"]) == ("normalmap", "blendbsdf")
    colour = scene.content[bump["bsdf"]["first"]["diffuse_reflectance"]["id"]]
    assert (colour["gain"], colour["srgb"]) == ([1.0, 0.5, 1.0], True)
    # (u, v) = (1, 0) is scaled to 2, turned counter-clockwise on an image whose v goes down, and moved.
    np.testing.assert_allclose(colour["to_uv"] @ [1, 0, 0, 1], [0.5, -2, 0, 1], atol=1e-12)
    np.testing.assert_allclose(colour["to_uv"] @ [0, 1, 0, 1], [3.5, 0, 0, 1], atol=1e-12)
    assert any("occlusion" in text for text in texts(scene, "left out"))


def test_extensions_of_materials(lit, tmp_path):
    def look(extensions, **more):
        glb = Glb()
        glb.node(extensions=glb.light(type="point"))
        basic = {"metallicFactor": 0, "roughnessFactor": 0}
        glb.node(
            mesh=glb.square(
                material=glb.add("materials", pbrMetallicRoughness=basic, extensions=extensions, **more)
            )
        )
        scene = load_scene(glb.write(tmp_path / "look.glb"))
        return bsdf_of(scene, only_mesh(scene)), scene

    assert look({"KHR_materials_ior": {"ior": 1.2}})[0]["int_ior"] == pytest.approx(1.2)
    pane = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    assert look(pane)[0]["type"] == "thindielectric"
    body = pane | {
        "KHR_materials_volume": {
            "thicknessFactor": 0.1,
            "attenuationDistance": 0.1,
            "attenuationColor": [0.25, 1, 1],
        }
    }
    bsdf, scene = look(body)
    assert bsdf["type"] == "dielectric"
    assert bsdf["specular_transmittance"]["value"] == pytest.approx([0.5, 1, 1])
    assert look({"KHR_materials_clearcoat": {"clearcoatFactor": 1}})[0]["type"] == "plastic"
    unlit, scene = look({"KHR_materials_unlit": {}})
    assert unlit["type"] == "diffuse"
    assert any("unlit" in text for text in texts(scene, "approximated"))
    _, scene = look({"KHR_materials_sheen": {"sheenRoughnessFactor": 0.5}})
    assert any("sheen" in text for text in texts(scene, "left out"))
    glossy = {
        "KHR_materials_pbrSpecularGlossiness": {
            "diffuseFactor": [0.1, 0.2, 0.3, 1],
            "glossinessFactor": 0.5,
            "specularFactor": [0.04] * 3,
        }
    }
    bsdf, scene = look(glossy)
    assert (bsdf["alpha"], bsdf["diffuse_reflectance"]["value"]) == (0.25, [0.1, 0.2, 0.3])
    assert any("a dielectric of the same diffuse colour" in text for text in texts(scene, "approximated"))
    glossy["KHR_materials_pbrSpecularGlossiness"]["specularFactor"] = [0.9, 0.6, 0.3]
    bsdf, scene = look(glossy)
    assert bsdf["type"] == "roughconductor"
    assert any("a metal of the same specular colour" in text for text in texts(scene, "approximated"))


def test_colours_of_vertices(lit, tmp_path):
    chalky = lit.add("materials", **chalk([0.5, 1, 1]))
    mixed = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
    lit.node(mesh=lit.square(material=chalky, COLOR_0=mixed), name="mixed")
    lit.node(mesh=lit.square(material=chalky, COLOR_0=np.full((4, 3), 0.25)), name="plain")
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    varied, plain = shapes(scene).values()
    np.testing.assert_allclose(varied["colors"], mixed * [0.5, 1, 1])
    assert bsdf_of(scene, varied)["reflectance"] == {"type": "mesh_attribute", "name": "vertex_color"}
    assert bsdf_of(scene, plain)["reflectance"]["value"] == [0.125, 0.25, 0.25]
    assert "colors" not in plain


# ---- light -------------------------------------------------------------------------------------


def radiance_seen(scene, origin, target, up=(0.0, 1.0, 0.0)):
    """Radiance of direct light towards a camera at a point, RGB."""
    import mitsuba as mi

    from steadylight.camera import Keyframe
    from steadylight.renderers.mitsuba.scene import build_scene, build_sensor

    pose = Keyframe(0.0, origin, target, up, 0.01)
    from steadylight.camera import CameraPath

    built = build_scene(scene, {"type": "path", "max_depth": 2})
    sensor = build_sensor(scene, CameraPath((pose,)).pose(0.0), 4, 4, {"type": "box"})
    return np.array(mi.render(built, sensor=sensor, spp=4)).mean(axis=(0, 1))


def floor_with(glb, albedo=(0.5, 0.25, 1.0)):
    """A large floor at a height of 0, which faces up."""
    material = glb.add("materials", **chalk(albedo))
    glb.node(mesh=glb.square(100.0, material), rotation=rotation([1, 0, 0], -math.pi / 2), name="floor")


def test_a_lamp_of_candela_gives_the_radiance_of_the_closed_form(tmp_path):
    glb = Glb()
    floor_with(glb)
    glb.node(translation=[0, 2, 0], extensions=glb.light(type="point", intensity=683 * 4, color=[1, 0.5, 1]))
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    below = radiance_seen(scene, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(below, np.array([0.5, 0.25, 1]) / np.pi * [4, 2, 4] / 4, rtol=1e-4)
    aside = radiance_seen(scene, (2.0, 0.0, 1.0), (2.0, 0.0, 0.0))
    np.testing.assert_allclose(aside, below / 2 / np.sqrt(2), rtol=1e-4)


def test_a_sun_of_lux_gives_the_radiance_of_the_closed_form(tmp_path):
    glb = Glb()
    floor_with(glb)
    tilted = rotation([1, 0, 0], -math.pi / 3)  # from -z, 60 degrees down
    glb.node(rotation=tilted, extensions=glb.light(type="directional", intensity=683 * 2))
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    seen = radiance_seen(scene, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(seen, np.array([0.5, 0.25, 1]) / np.pi * 2 * np.sin(np.pi / 3), rtol=1e-4)


def test_a_spot_has_its_candela_on_the_axis_and_ends_at_its_cone(tmp_path):
    glb = Glb()
    floor_with(glb, (1.0, 1.0, 1.0))
    spot = glb.light(type="spot", intensity=683, spot={"innerConeAngle": 0.3, "outerConeAngle": 0.5})
    glb.node(translation=[0, 1, 0], rotation=rotation([1, 0, 0], -math.pi / 2), extensions=spot)
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(radiance_seen(scene, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0)), 1 / np.pi, rtol=1e-4)
    outside = math.tan(0.51)
    assert radiance_seen(scene, (outside, 0.0, 1.0), (outside, 0.0, 0.0)).max() == 0


@pytest.mark.parametrize(("inner", "outer"), [(0.0, 0.7), (0.3, 0.5), (0.49, 0.5), (0.0, 1.5)])
def test_the_cone_of_a_spot_has_the_flux_of_the_file(inner, outer):
    beam, cutoff = np.radians(spot_angles(Spot(inner_cone_angle=inner, outer_cone_angle=outer)))
    theta = np.linspace(0, outer, 20001)
    ramp = np.clip((np.cos(theta) - np.cos(outer)) / (np.cos(inner) - np.cos(outer)), 0, 1) ** 2
    ours = np.clip((cutoff - theta) / (cutoff - beam), 0, 1)
    assert cutoff <= outer + 1e-9
    assert np.trapezoid(ours * np.sin(theta), theta) == pytest.approx(
        np.trapezoid(ramp * np.sin(theta), theta), rel=2e-3
    )


def test_emission_is_radiance_and_in_nits_beside_lamps_unless_blender_wrote_the_file(tmp_path):
    def emission(generator, *, lamp):
        glb = Glb(asset={"version": "2.0", "generator": generator})
        if lamp:
            glb.node(extensions=glb.light(type="point"))
        strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 1366}}
        material = glb.add("materials", emissiveFactor=[1, 0.5, 0], extensions=strength)
        glb.node(mesh=glb.square(material=material))
        return only_mesh(load_scene(glb.write(tmp_path / "a.glb")))["emitter"]["radiance"]["value"]

    assert emission("me", lamp=False) == [1366, 683, 0]
    assert emission("me", lamp=True) == [2, 1, 0]
    assert emission("Khronos glTF Blender I/O v4", lamp=True) == [1366, 683, 0]


def test_hidden_nodes_and_all_below_them_are_not_shown_but_a_camera_there_can_be_used(tmp_path):
    glb = Glb()
    hidden = {"KHR_node_visibility": {"visible": False}}
    lamp = glb.node(top=False, name="lamp", extensions=glb.light(type="point"))
    wall = glb.node(top=False, name="wall", mesh=glb.square())
    eye = glb.node(
        top=False, name="eye", camera=glb.add("cameras", type="perspective", perspective={"yfov": 1})
    )
    glb.node(children=[lamp, wall, eye], extensions=hidden)
    glb.node(name="floor", mesh=glb.square())
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    assert list(shapes(scene)) == ["floor"]
    assert not any(entry["type"] == "point" for entry in scene.content.values())
    assert scene.camera.keyframes[0].fov == pytest.approx(88.3, abs=0.1)


def test_only_triangles_with_bright_texels_shine(tmp_path):
    glb = Glb()
    image = np.zeros((16, 16, 3))
    image[2:4, 2:4] = 255  # in the upper left
    texture = glb.image(png(image))
    material = glb.add("materials", emissiveFactor=[1, 1, 1], emissiveTexture={"index": texture})
    tiles = [[(0, 0), (0.4, 0), (0.4, 0.4), (0, 0.4)], [(0.6, 0.6), (1, 0.6), (1, 1), (0.6, 1)]]
    for uv in tiles:
        glb.node(mesh=glb.square(material=material, TEXCOORD_0=np.array(uv)))
    first, second = shapes(load_scene(glb.write(tmp_path / "a.glb"))).values()
    assert "emitter" in first
    assert "emitter" not in second


def test_what_shines_to_both_sides_is_two_sheets_unless_it_is_closed(tmp_path):
    glb = Glb()
    material = glb.add("materials", emissiveFactor=[1, 1, 1], doubleSided=True)
    glb.node(mesh=glb.square(material=material))
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    front, back = shapes(scene).values()
    np.testing.assert_allclose(front["vertices"][:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(back["vertices"][:, 1], 2e-4, atol=1e-6)
    assert back["faces"].tolist() == front["faces"][:, ::-1].tolist()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    closed = Glb()
    primitive = {
        "attributes": {"POSITION": closed.array(corners)},
        "indices": closed.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "uint16"),
        "material": closed.add("materials", emissiveFactor=[1, 1, 1], doubleSided=True),
    }
    closed.node(mesh=closed.add("meshes", primitives=[primitive]))
    assert len(shapes(load_scene(closed.write(tmp_path / "b.glb")))) == 1


@pytest.mark.parametrize(("channel", "leans"), [(0, [1, 0]), (1, [0, 1])], ids=["red: right", "green: up"])
def test_a_normal_map_leans_to_the_right_and_up_in_its_image(channel, leans, tmp_path):
    glb = Glb()
    texel = np.array([127.5, 127.5, 127.5 * (1 + 0.8)])
    texel[channel] += 127.5 * 0.6
    texture = glb.image(png(np.broadcast_to(np.round(texel), (2, 2, 3))))
    material = glb.add("materials", **chalk([1, 1, 1]), normalTexture={"index": texture})
    # The image stands upright on a wall that faces +z: v goes down.
    wall = glb.square(10.0, material, TEXCOORD_0=np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]]))
    glb.node(mesh=wall)
    sun = np.array([0.4, 0.3, np.sqrt(0.75)])  # towards it
    x, y = np.cross([0, 1.0, 0], sun), None
    x /= np.linalg.norm(x)
    y = np.cross(sun, x)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([x, y, sun], axis=1)
    glb.node(matrix=frame.T.ravel().tolist(), extensions=glb.light(type="directional", intensity=683 * np.pi))
    scene = load_scene(glb.write(tmp_path / "a.glb"))
    seen = radiance_seen(scene, (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0))
    normal = np.array([0.6 * leans[0], 0.6 * leans[1], 0.8])
    np.testing.assert_allclose(seen, normal @ sun, rtol=0.01)


# ---- cameras -----------------------------------------------------------------------------------


def camera(glb, **lens):
    """Append a camera."""
    return glb.add(
        "cameras", type="perspective", perspective={"yfov": 0.8, "aspectRatio": 2.0, "znear": 0.2, **lens}
    )


def test_a_still_camera_has_the_view_and_the_size_of_the_file(lit, tmp_path):
    lit.node(mesh=lit.square())
    lit.node(camera=camera(lit), translation=[1, 2, 3], rotation=rotation([0, 1, 0], math.pi / 2), name="eye")
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    pose = scene.camera.pose(0.0)
    np.testing.assert_allclose(pose.origin, [1, -3, 2], atol=1e-6)
    np.testing.assert_allclose(pose.direction, [-1, 0, 0], atol=1e-6)  # -z, turned about y to -x
    np.testing.assert_allclose(pose.to_world[:3, 1], [0, 0, 1], atol=1e-6)
    assert pose.fov == pytest.approx(math.degrees(2 * math.atan(2 * math.tan(0.4))))
    assert (scene.width, scene.height, scene.frames) == (1280, 640, 1)
    assert scene.sensor == {"type": "perspective", "near_clip": 0.2}


def test_cameras_are_chosen_by_name_and_number(lit, tmp_path):
    lit.node(mesh=lit.square())
    for height, name in enumerate(("Küche", "Bad 2")):
        lit.node(camera=camera(lit), translation=[0, height, 5], name=name)
    path = lit.write(tmp_path / "a.glb")
    assert load_scene(path, sensor="Bad 2").camera.pose(0).origin[2] == 1
    assert load_scene(path, sensor=2).camera.pose(0).origin[2] == 1
    scene = load_scene(path)
    assert scene.camera.pose(0).origin[2] == 0
    assert texts(scene, "warning") == [
        "cameras: of 1 (Küche), 2 (Bad 2) the first is used; choose with --sensor"
    ]
    with pytest.raises(SettingsError, match=r"'Flur' is not a camera of .*; it has 1 \(Küche\), 2 \(Bad 2\)"):
        load_scene(path, sensor="Flur")


def test_an_orthographic_camera_shows_its_size(lit, tmp_path):
    lit.node(mesh=lit.square())
    number = lit.add(
        "cameras", type="orthographic", orthographic={"xmag": 3, "ymag": 1.5, "znear": 0, "zfar": 9}
    )
    lit.node(camera=number, translation=[0, 0, 5])
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert scene.sensor == {"type": "orthographic", "scale": [3, 3, 1]}
    assert (scene.width, scene.height) == (1280, 640)


def test_a_camera_that_moves_has_the_poses_of_the_closed_form_at_all_frames(lit, tmp_path):
    # A camera 2 m before a turntable's axis, which turns evenly, on a cart that follows a cubic spline.
    lit.node(mesh=lit.square())
    eye = lit.node(top=False, camera=camera(lit), translation=[0, 1.6, 2], name="eye")
    table = lit.node(top=False, children=[eye])
    cart = lit.node(children=[table])
    angles = np.linspace(0, math.pi, 5)
    lit.animate(
        {"node": table, "path": "rotation"},
        np.linspace(0, 2, 5),
        [rotation([0, 1, 0], angle) for angle in angles],
    )
    spline = [[[0, 0, 0], [0, 0, 0], [3, 0, 0]], [[0, 0, 0], [4, 0, 0], [0, 0, 0]]]
    lit.animate({"node": cart, "path": "translation"}, [0, 2], spline, "CUBICSPLINE")
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert (scene.frames, scene.fps) == (51, 25)
    for frame, pose in enumerate(scene.camera.frame_poses(range(1, 52), 25)):
        t = frame / 25
        u, angle = t / 2, math.pi * t / 2
        along = u * u * (3 - 2 * u) * 4 + 2 * u * (1 - u) ** 2 * 3
        x, z = along + 2 * math.sin(angle), 2 * math.cos(angle)
        np.testing.assert_allclose(pose.origin, [x, -z, 1.6], atol=1e-4)
        np.testing.assert_allclose(pose.direction, [-math.sin(angle), math.cos(angle), 0], atol=1e-4)
        np.testing.assert_allclose(pose.to_world[:3, 1], [0, 0, 1], atol=1e-4)


def test_steps_hold_and_jump(lit, tmp_path):
    lit.node(mesh=lit.square())
    eye = lit.node(camera=camera(lit))
    lit.animate(
        {"node": eye, "path": "translation"}, [1, 1.2, 1.4], [[0, 0, 1], [0, 0, 2], [0, 0, 3]], "STEP"
    )
    poses = load_scene(lit.write(tmp_path / "a.glb")).camera.frame_poses(range(1, 12), 25)
    np.testing.assert_allclose([-pose.origin[1] for pose in poses], [1] * 5 + [2] * 5 + [3], atol=1e-9)


def test_zoom_is_a_pointer_and_the_rate_is_that_of_the_keys(lit, tmp_path):
    lit.node(mesh=lit.square())
    number = camera(lit)
    lit.node(camera=number, translation=[0, 0, 5])
    pointer = {
        "path": "pointer",
        "extensions": {"KHR_animation_pointer": {"pointer": f"/cameras/{number}/perspective/yfov"}},
    }
    times = np.arange(1, 49) / 24
    lit.animate(pointer, times, 0.5 + 0.1 * times)
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert (scene.frames, scene.fps) == (48, 24)
    for frame, pose in enumerate(scene.camera.frame_poses(range(1, 49), 24), 1):
        yfov = 0.5 + 0.1 * frame / 24
        assert math.radians(pose.fov) == pytest.approx(2 * math.atan(2 * math.tan(yfov / 2)), abs=1e-5)


def test_what_moves_besides_the_camera_is_said_to_stand_still(lit, tmp_path):
    door = lit.node(mesh=lit.square(), name="Tür")
    lit.animate({"node": door, "path": "translation"}, [0, 1], [[0, 0, 0], [0, 1, 0]])
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert any("Tür stay as in the file" in text for text in texts(scene, "left out"))
    assert scene.frames == 1


def test_without_a_camera_the_whole_scene_is_seen_from_outside(lit, tmp_path):
    lit.node(mesh=lit.square())
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    pose = scene.camera.pose(0.0)
    assert np.dot(pose.direction, -pose.origin) > 0
    assert any(note.where == "camera" for note in scene.notes)


# ---- files -------------------------------------------------------------------------------------


def split(glb, folder, *, image=None):
    """A .gltf with its buffer beside it."""
    document = glb.document | {"buffers": [{"uri": "raw%20data.bin", "byteLength": len(glb.binary)}]}
    (folder / "raw data.bin").write_bytes(glb.binary)
    if image is not None:
        document["images"] = [{"uri": image}]
    path = folder / "scene.gltf"
    path.write_text(json.dumps(document), "utf-8")
    return path


def test_buffers_and_images_beside_the_scene_are_read_and_hashed(lit, tmp_path):
    texture = lit.add("textures", source=0)
    material = lit.add(
        "materials", pbrMetallicRoughness={"baseColorTexture": {"index": texture}, "metallicFactor": 0}
    )
    lit.node(mesh=lit.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    (tmp_path / "Öl.png").write_bytes(png(np.full((2, 2, 3), 9)))
    path = split(lit, tmp_path, image="%C3%96l.png")
    scene = load_scene(path)
    assert list(scene.files) == [str(tmp_path / "Öl.png")]
    (tmp_path / "Öl.png").write_bytes(png(np.full((2, 2, 3), 10)))
    assert load_scene(path).hash != scene.hash


@pytest.mark.parametrize(
    "uri", ["../secret.png", "/etc/passwd", "http://example.org/a.png", "missing.png", "%2e%2e/secret.png"]
)
def test_files_elsewhere_are_refused(uri, lit, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "secret.png").write_bytes(png(np.zeros((2, 2, 3))))
    texture = lit.add("textures", source=0)
    material = lit.add("materials", pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    lit.node(mesh=lit.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    with pytest.raises(SceneError, match=r"images\[0\]: "):
        load_scene(split(lit, folder, image=uri))


def test_files_elsewhere_are_read_if_that_is_allowed(lit, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "shared.png").write_bytes(png(np.zeros((2, 2, 3))))
    texture = lit.add("textures", source=0)
    material = lit.add("materials", pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    lit.node(mesh=lit.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    path = split(lit, folder, image="../shared.png")
    with pytest.raises(SceneError, match="--allow-outside"):
        load_scene(path)
    assert list(load_scene(path, allow_outside=True).files) == [str(tmp_path / "shared.png")]


def test_factors_that_are_rounded_up_are_taken_for_1(lit, tmp_path):
    basic = {"baseColorFactor": [1.0000001, 1.2, 0.5, 1], "metallicFactor": -1e-9}
    lit.node(mesh=lit.square(material=lit.add("materials", pbrMetallicRoughness=basic)))
    scene = load_scene(lit.write(tmp_path / "a.glb"))
    assert bsdf_of(scene, only_mesh(scene))["diffuse_reflectance"]["value"] == [1, 1, 0.5]


def test_a_required_extension_that_is_not_read_is_refused(lit, tmp_path):
    lit.node(mesh=lit.square())
    lit.document["extensionsRequired"] = ["EXT_meshopt_compression"]
    with pytest.raises(SceneError, match="requires EXT_meshopt_compression"):
        load_scene(lit.write(tmp_path / "a.glb"))


def test_a_description_of_a_gltf_file_goes_through_the_archive(lit, tmp_path):
    from steadylight.scenes.archive import read_archive, write_archive

    texture = lit.image(png(np.random.default_rng(0).integers(0, 255, (8, 8, 3))))
    material = lit.add(
        "materials", pbrMetallicRoughness={"baseColorTexture": {"index": texture}, "metallicFactor": 0}
    )
    lit.node(mesh=lit.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    path = lit.write(tmp_path / "a.glb")
    scene = load_scene(path)
    write_archive(tmp_path / "scene.zip", scene, with_files=True)
    assert read_archive(tmp_path / "scene.zip").hash == scene.hash == load_scene(path).hash


# ---- what the user reads -----------------------------------------------------------------------


def test_a_scene_without_light_is_refused_with_the_options_that_give_light(tmp_path):
    from steadylight.renderers.mitsuba.scene import check_scene

    glb = Glb()
    glb.node(mesh=glb.square())
    path = glb.write(tmp_path / "dark.glb")
    with pytest.raises(SceneError, match=r"dark\.glb: has no emitter, .* --sun .* --envmap") as caught:
        check_scene(load_scene(path))
    assert "--place" in str(caught.value)
    check_scene(load_scene(path, sun="180,40"))


def test_notes_are_kept_in_the_record_of_the_run(lit, tmp_path):
    from steadylight.animation.provenance import describe_run
    from steadylight.animation.request import prepare
    from steadylight.renderers.base import Backend

    lit.node(mesh=lit.square(), name="floor")
    request = prepare(lit.write(tmp_path / "a.glb"), size="8x8")
    record = describe_run(
        request.job("llvm_ad_rgb"), request.source, Backend("llvm_ad_rgb", {}), request.title
    )
    assert {"kind": "converted", "where": "lamps", "text": "candela and lux divided by 683 lm/W"} in record[
        "scene"
    ]["notes"]


def test_a_summary_shows_what_matters_most_first_and_not_everything():
    from steadylight.display import out, show_notes
    from steadylight.scenes.description import Note

    notes = [
        Note("converted", "axes", "turned"),
        *(Note("left out", f"mesh {i}", "points") for i in range(5)),
    ]
    notes += [Note("approximated", "wood", f"reason {i}") for i in range(9)]
    with out.capture() as said:
        show_notes(notes)
    lines = [line.split() for line in said.get().splitlines()]
    assert [line[0] for line in lines] == ["left", *["approximated"] * 7, "converted"]
    assert "mesh 0, mesh 1 and 3 more: points" in said.get()
    assert "... and 3 more" in said.get()


def test_files_from_blender_are_said_to_lack_area_lights(lit, tmp_path):
    lit.document["asset"]["generator"] = "Khronos glTF Blender I/O v5.0.21"
    lit.node(mesh=lit.square())
    lit.node(name="Area lamp", translation=[0, 1, 0])
    (text,) = (
        text for text in texts(load_scene(lit.write(tmp_path / "a.glb")), "left out") if "Blender" in text
    )
    assert text.endswith("in its USD files; without content: Area lamp")
