"""Files of which a download brought only the name are told, with what to do, whoever reads them."""

from __future__ import annotations

import json

import pytest
from glb import triangle

from steadylight.errors import SceneError
from steadylight.scenes import load_scene

POINTER = b"""version https://git-lfs.github.com/spec/v1
oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393
size 12345
"""
CONTENTS = pytest.mark.parametrize(
    ("content", "words"),
    [(POINTER, "is a Git LFS pointer .*; run `git lfs pull`"), (b"", "is empty; download it again")],
    ids=["pointer", "empty"],
)
OBJ = "mtllib a.mtl\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
ROOM = """<scene version="3.0.0"><emitter type="constant"/>
<shape type="ply"><string name="filename" value="ball.ply"/>
<bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="wood.png"/></texture></bsdf></shape></scene>"""


@CONTENTS
def test_a_mitsuba_file_names_each_mesh_and_picture_at_its_line(tmp_path, content, words):
    scene = tmp_path / "room.xml"
    scene.write_text(ROOM)
    for name in ("ball.ply", "wood.png"):
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=f"line 2, .*ball.ply {words}(.|\n)*line 4, .*wood.png {words}"):
        load_scene(scene)


@CONTENTS
def test_a_model_names_its_picture(tmp_path, content, words):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl paint\nmap_Kd wood.png\n")
    (tmp_path / "wood.png").write_bytes(content)
    with pytest.raises(SceneError, match=f"wood.png {words}"):
        load_scene(tmp_path / "a.obj")


@CONTENTS
def test_a_gltf_file_names_its_buffer(tmp_path, content, words):
    (tmp_path / "a.gltf").write_text(json.dumps(triangle("a.bin")))
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(SceneError, match=f"a.bin` {words}"):
        load_scene(tmp_path / "a.gltf")


@pytest.mark.parametrize("name", ["a.xml", "a.glb", "a.obj", "a.ply", "a.usda", "a.ifc", "a.rad", "a.blend"])
def test_the_scene_itself_may_be_a_pointer(tmp_path, name):
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(SceneError, match=f"{name}: the scene is a Git LFS pointer"):
        load_scene(tmp_path / name)
