"""OBJ files that Mitsuba and trimesh would read wrongly or not at all."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from steadylight.scenes import load_scene
from steadylight.scenes.obj import simplified

POINTS = "".join(f"v {x} {y} 0\n" for x, y in [(0, 0), (4, 0), (4, 3), (2, 3), (2, 1), (0, 1)])
NOTCHED = f"{POINTS}f 1 2 3 4 5 6\n"
AREA = 8
"""Of the notched wall; a fan covers 11 and turns 3 of it round."""


def area(entry):
    a, b, c = (np.asarray(entry["vertices"])[np.asarray(entry["faces"])[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def meshes_of(scene):
    return [entry for entry in scene.content.values() if entry["type"] == "triangles"]


def room(tmp_path, text, options=""):
    (tmp_path / "wall.obj").write_text(text)
    shape = f'<shape type="obj" id="wall"><string name="filename" value="wall.obj"/>{options}</shape>'
    (tmp_path / "room.xml").write_text(f'<scene version="3.0.0">{shape}<emitter type="constant"/></scene>')
    return load_scene(tmp_path / "room.xml")


def test_a_concave_polygon_covers_what_lies_inside_it_alone(tmp_path):
    scene = room(tmp_path, NOTCHED)
    assert area(scene.content["wall"]) == pytest.approx(AREA)
    assert [note.kind for note in scene.notes] == ["converted"]
    (mesh,) = meshes_of(load_scene(tmp_path / "wall.obj"))
    assert area(mesh) == pytest.approx(AREA)


@pytest.mark.parametrize(
    "text",
    [
        f"{POINTS}f 1 2 3 4\nf 1 2 3\n",
        f"{POINTS}vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\n",
        "",
        "v 0 0 x\nf 1 2 3 4 5\n",
        f"{POINTS}f 1 2 3 9 10\n",
        f"{POINTS}f 1 2 3 a b\n",
    ],
    ids=["convex", "with coordinates", "empty", "no number", "no vertex", "no index"],
)
def test_what_needs_no_change_or_is_damaged_stays_as_it_is(text):
    assert simplified(text.encode()) is None


def test_a_polygon_keeps_coordinates_and_normals_of_its_corners(tmp_path):
    coordinates = "".join(f"vt {corner / 10} 0.5\n" for corner in range(6)) + "vn 0 1 0\n"
    faces = "f " + " ".join(f"{corner}/{corner}/1" for corner in range(1, 7)) + "\n"
    entry = room(tmp_path, POINTS + coordinates + faces).content["wall"]
    assert area(entry) == pytest.approx(AREA)
    points = np.array([line.split()[1:] for line in POINTS.splitlines()], float).tolist()
    for vertex, uv in zip(entry["vertices"], entry["uv"], strict=True):
        assert uv == pytest.approx([points.index(vertex.tolist()) / 10, 0.5])
    assert entry["normals"] == pytest.approx(np.tile([0, 1, 0], (6, 1)))


def test_indices_may_count_backwards_from_the_line_they_stand_in(tmp_path):
    text = "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 6 2 0\nf -3 -2 -1\n"
    entry = room(tmp_path, text).content["wall"]
    assert area(entry) == pytest.approx(0.5 + 1)


def test_a_line_may_be_long_or_go_on_in_the_next(tmp_path):
    turn = np.arange(400) / 400 * 2 * np.pi
    circle = "".join(f"v {x:.6f} {y:.6f} 0\n" for x, y in zip(np.cos(turn), np.sin(turn), strict=True))
    corners = [str(corner) for corner in range(1, 401)]
    for between in (" ", " \\\n"):
        entry = room(tmp_path, f"{circle}f {between.join(corners)}\n").content["wall"]
        assert area(entry) == pytest.approx(np.pi, rel=1e-3)


@pytest.mark.parametrize(
    "number", ["nan", "-nan(ind)", "inf", "0", "-0.000000", "+.0", "0e0", "0.000000e+000"]
)
def test_a_normal_without_a_direction_becomes_that_of_its_face(tmp_path, number):
    text = f"{POINTS}vn 0 0 1\nvn {number} {number} {number}\nf 1//1 2//1 3//2\n"
    entry = room(tmp_path, text).content["wall"]
    assert entry["normals"] == pytest.approx(np.tile([0, 0, 1], (3, 1)))


def test_a_rewritten_shape_is_moved_and_turned_as_mitsuba_does(tmp_path):
    options = '<transform name="to_world"><scale x="-1" y="2"/><translate z="3"/></transform>'
    text = POINTS + "vt 0 0.25\nvn 0 0 1\n"
    polygon = room(tmp_path, text + "f 1/1/1 2/1/1 3/1/1 -3/1/1\n", options).content["wall"]
    room(tmp_path, text + "f 1/1/1 2/1/1 3/1/1 4/1/1\n", options)
    (shape,) = mi.load_file(str(tmp_path / "room.xml")).shapes()
    expected = mi.traverse(shape)
    for name, key in (
        ("vertices", "vertex_positions"),
        ("normals", "vertex_normals"),
        ("uv", "vertex_texcoords"),
    ):
        assert polygon[name].ravel() == pytest.approx(np.array(expected[key]))
