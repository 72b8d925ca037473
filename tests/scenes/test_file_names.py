"""Files whose names a scene gives in other capital letters, code points or slashes are found, whoever reads it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from glb import triangle
from PIL import Image

from steadylight.errors import SceneError
from steadylight.scenes import load_scene
from steadylight.scenes.file_names import named

OBJ = "mtllib A.MTL\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
ROOM = r"""<scene version="3.0.0"><emitter type="constant"/>
<shape type="sphere"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="Textures\WOOD.jpg"/></texture></bsdf></shape></scene>"""


@pytest.fixture
def wood(tmp_path):
    """A picture in a folder."""
    (tmp_path / "textures").mkdir()
    file = tmp_path / "textures/wood.JPG"
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(file)
    return file


@pytest.mark.parametrize(
    "name",
    ["textures/wood.JPG", r"Textures\Wood.jpg", "./TEXTURES/../textures/wood.jpg", "/TEXTURES/wood.jpg"],
)
def test_a_name_differs_in_capital_letters_and_slashes(wood, tmp_path, name):
    given = f"{tmp_path}{name}" if name.startswith("/") else name
    assert named(tmp_path, given).samefile(wood)


def test_an_umlaut_in_two_code_points_is_one_in_one(tmp_path):
    (tmp_path / "Mo\u0308bel.png").touch()
    assert named(tmp_path, "m\u00f6bel.png").name == "Mo\u0308bel.png"


def test_of_two_names_that_are_alike_none_is_chosen_unless_it_is_exact(tmp_path):
    for name in ("a.png", "A.png"):
        (tmp_path / name).touch()
    assert named(tmp_path, "A.png").name == "A.png"
    assert not named(tmp_path, "A.PNG").exists()


def test_a_mitsuba_file_finds_its_picture(wood, tmp_path):
    (tmp_path / "room.xml").write_text(ROOM)
    assert str(wood) in json.dumps(load_scene(tmp_path / "room.xml").content)


def test_a_model_finds_its_materials_and_their_picture(wood, tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl paint\nmap_Kd TEXTURES\\wood.jpg\n")
    assert str(wood) in repr(load_scene(tmp_path / "a.obj").content)


def test_a_gltf_file_finds_its_buffer(tmp_path):
    (tmp_path / "a.gltf").write_text(json.dumps(triangle("Data%5CA.bin")))
    (tmp_path / "data").mkdir()
    (tmp_path / "data/a.bin").write_bytes(np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32).tobytes())
    assert any(entry["type"] == "triangles" for entry in load_scene(tmp_path / "a.gltf").content.values())


def test_what_lies_outside_the_folder_stays_outside(wood, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "room.xml").write_text(ROOM.replace("Textures", r"..\Textures"))
    with pytest.raises(SceneError, match="outside the scene's folder"):
        load_scene(inner / "room.xml")
