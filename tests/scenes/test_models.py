"""Plain meshes (OBJ, PLY, STL): their materials, units and axes, and faults in them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from steadylight.errors import SceneError
from steadylight.scenes import load_scene

OBJ = """
mtllib paint.mtl
v 0 0 0
v 4 0 0
v 4 3 0
v 0 3 0
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
usemtl red paint
f 1/1/1 2/2/1 3/3/1
usemtl lamp
f 1 3 4
"""
MTL = """
newmtl red paint
Kd 0.8 0.1 0.1
newmtl lamp
Kd 0 0 0
Ke 3 4 5
"""


@pytest.fixture
def scene_of(tmp_path):
    """Reads an OBJ file with its materials."""

    def read(mtl=MTL, obj=OBJ, **options):
        (tmp_path / "room.obj").write_text(obj)
        (tmp_path / "paint.mtl").write_text(mtl)
        return load_scene(tmp_path / "room.obj", **options)

    return read


def mesh_of(scene, name):
    return next(e for k, e in scene.content.items() if e["type"] == "triangles" and k.startswith(name))


def material_of(scene, name):
    return scene.content[mesh_of(scene, name)["bsdf"]["id"]]


def test_materials_of_a_library_are_taken_over(scene_of):
    scene = scene_of()
    red = material_of(scene, "red paint")
    assert red["bsdf"] == {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    assert mesh_of(scene, "lamp")["emitter"]["radiance"]["value"] == [3, 4, 5]
    assert scene.hash == scene_of().hash


def test_obj_stands_on_xz_and_is_turned_upright_with_its_normals(scene_of):
    mesh = mesh_of(scene_of(), "red")
    assert mesh["vertices"].max(axis=0).tolist() == [4, 0, 3]
    assert mesh["normals"] == pytest.approx(np.array([[0, -1, 0]] * 3))
    assert mesh_of(scene_of(up="z"), "red")["vertices"].max(axis=0).tolist() == [4, 3, 0]


@pytest.mark.parametrize(
    ("size", "unit", "metres"),
    [(6, None, 6), (600, None, 6), (6000, None, 6), (236.22, "in", 6), (6000, "cm", 60), (20, "ft", 6.096)],
)
def test_units_are_as_said_or_follow_from_the_size_and_are_reported(tmp_path, size, unit, metres):
    trimesh.creation.box((size, size / 2, size / 3)).export(tmp_path / "box.stl")
    scene = load_scene(tmp_path / "box.stl", unit=unit)
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert np.ptp(mesh["vertices"][:, 0]) == pytest.approx(metres, rel=1e-4)
    (note,) = (note for note in scene.notes if "measures" in note.text)
    assert f"{metres:.3g} x" in note.text
    assert ("lengths in" in note.text and "guessed; set it with --unit" in note.text) == (unit is None)


def test_the_camera_sees_the_whole_scene_from_outside(tmp_path):
    trimesh.creation.box((6, 4, 3)).export(tmp_path / "box.ply")
    key = load_scene(tmp_path / "box.ply").camera.keyframes[0]
    assert np.linalg.norm(key.origin) > 6
    assert key.target == pytest.approx((0, 0, 0))


def test_vertex_colours_of_ply_become_linear(tmp_path):
    box = trimesh.creation.box((2, 2, 2))
    box.visual.vertex_colors = np.tile([188, 0, 255, 255], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "box.ply")
    scene = load_scene(tmp_path / "box.ply")
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert mesh["colors"][0] == pytest.approx([0.503, 0, 1], abs=0.002)


def test_pictures_are_hashed_and_multiplied_by_the_colour(scene_of, tmp_path):
    Image.new("RGB", (4, 4), (255, 128, 0)).save(tmp_path / "boden 1.png")
    scene = scene_of(MTL.replace("Kd 0.8 0.1 0.1", "Kd 0.5 0.5 0.5\nmap_Kd -s 1 1 1 boden 1.png"))
    (texture,) = (entry for entry in scene.content.values() if entry["type"] == "image")
    assert texture["gain"] == [0.5, 0.5, 0.5]
    assert list(scene.files) == [str(tmp_path / "boden 1.png")]


def test_gloss_glass_and_opacity_are_understood(scene_of):
    def bsdf(lines):
        return material_of(scene_of(MTL.replace("Kd 0.8 0.1 0.1", lines)), "red")

    glossy = bsdf("Kd .5 .5 .5\nKs .2 .2 .2\nNs 198\nillum 2")["bsdf"]
    assert glossy["type"] == "roughplastic"
    assert glossy["alpha"] == pytest.approx(0.1)
    assert bsdf("Kd 1 1 1\nd 0\nNi 1.5\nillum 4")["type"] == "thindielectric"
    assert bsdf("Kd 1 1 1\nTr 0.25")["opacity"] == 0.75
    smoked = bsdf("Kd .1 .2 .3\nd .25\nTf .5 1 1\nillum 4")
    assert (smoked["type"], smoked["weight"]) == ("blendbsdf", 0.75)
    assert smoked["first"]["diffuse_reflectance"]["value"] == [0.1, 0.2, 0.3]
    assert smoked["second"]["specular_transmittance"]["value"] == [0.5, 1.0, 1.0]


def test_statements_without_a_meaning_here_are_reported(scene_of):
    notes = scene_of(
        MTL.replace("Kd 0.8 0.1 0.1", "Kd .5 .5 .5\nKa 1 1 1\nmap_Pr x.png\nnorm y.png\naniso .5")
    ).notes
    assert [note.text for note in notes if note.kind == "left out"] == [
        "`aniso`",
        "roughness map",
        "normal map",
    ]


def test_what_has_no_material_is_grey_and_that_is_said(scene_of):
    scene = scene_of(obj=OBJ.replace("mtllib paint.mtl", "").replace("usemtl", "#"))
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert scene.content[mesh["bsdf"]["id"]]["bsdf"]["reflectance"]["value"] == [0.5, 0.5, 0.5]
    assert any("surfaces without a material get reflectance 0.5" in note.text for note in scene.notes)
    missing = scene_of(obj=OBJ.replace("paint.mtl", "gone.mtl"))
    assert any(note.where == "gone.mtl" for note in missing.notes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("Kd 0.8", "Kd red"), "is not a number"),
        (("Kd 0.8", "map_Kd gone.png\nKd 0.8"), "no such file"),
        (("Kd 0.8", "map_Kd ../../x.png\nKd 0.8"), "outside"),
        (("newmtl red paint", ""), "before the first `newmtl NAME`"),
    ],
)
def test_faults_in_a_library_name_material_and_remedy(scene_of, change, words):
    with pytest.raises(SceneError, match=words):
        scene_of(MTL.replace(*change))


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.stl"])
@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00" * 100,
        b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n1",
        b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n",
        b"v 0 0 0\nf 1 2 3\n",
        b"solid x\nfacet\n",
    ],
    ids=["empty", "zeros", "huge", "not a number", "no vertex", "cut off"],
)
def test_damaged_files_are_refused_with_their_name(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneError, match=name):
        load_scene(tmp_path / name)


def test_a_library_outside_the_folder_is_refused(scene_of):
    with pytest.raises(SceneError, match="outside"):
        scene_of(obj=OBJ.replace("paint.mtl", "../../etc/x.mtl"))
