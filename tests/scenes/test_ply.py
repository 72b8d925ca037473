"""PLY files as other programs write them: polygons of any size, coordinates of corners, pictures; and damaged ones."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from steadylight.errors import SceneError
from steadylight.scenes import load_scene
from steadylight.scenes.ply import _Element, _Property, _Source, read_ply

# A notched wall (six corners, of which one is concave), a quadrilateral and a triangle.
POINTS = [(0, 0, 0), (4, 0, 0), (4, 3, 0), (2, 3, 0), (2, 1, 0), (0, 1, 0), (0, 0, 2), (4, 0, 2), (2, 0, 4)]
FACES = [(0, 1, 2, 3, 4, 5), (1, 0, 6, 7), (7, 6, 8)]
AREAS = [4 + 2 * 2, 8, 4]


def ply(tmp_path, form, faces=FACES, coordinates=None, *, vertex="", comment="", points=POINTS):
    """Writes a file; `vertex` names further numbers of a vertex, which are in its points."""
    vertex = ["x", "y", "z", *vertex.split()]
    head = ["ply", f"format {form} 1.0", *([comment] if comment else []), f"element vertex {len(points)}"]
    head += [f"property float {name}" for name in vertex]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    head += ["property list uchar float texcoord"] if coordinates else []
    head += ["property int number", "end_header", ""]
    words = [[("f4", value) for value in point] for point in points]
    for number, face in enumerate(faces):
        row = [("u1", len(face)), *(("i4", corner) for corner in face)]
        if coordinates:
            row += [("u1", len(coordinates[number])), *(("f4", value) for value in coordinates[number])]
        words.append([*row, ("i4", number)])
    if form == "ascii":
        body = "".join(" ".join(f"{value:g}" for _, value in row) + "\n" for row in words).encode()
    else:
        order = "<" if "little" in form else ">"
        body = b"".join(np.array([value], order + kind).tobytes() for row in words for kind, value in row)
    (tmp_path / "wall.ply").write_bytes("\n".join(head).encode() + body)
    return tmp_path / "wall.ply"


def area(vertices, faces):
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_polygons_of_any_size_are_split_into_triangles_of_the_same_area(tmp_path, form):
    mesh = read_ply(ply(tmp_path, form))
    assert len(mesh.faces) == 4 + 2 + 1
    found = area(mesh.vertices, mesh.faces)
    assert [found[:4].sum(), found[4:6].sum(), found[6]] == pytest.approx(AREAS)
    assert not mesh.plain


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [FACES, FACES[1:2], FACES[2:]], ids=["uneven", "quads", "triangles"])
def test_each_corner_keeps_its_coordinates(tmp_path, form, faces):
    coordinates = [
        [10 * face + corner + part / 2 for corner in corners for part in (0, 1)]
        for face, corners in enumerate(faces)
    ]
    mesh = read_ply(ply(tmp_path, form, faces, coordinates))
    owner = np.repeat(np.arange(len(faces)), [len(face) - 2 for face in faces])
    for triangle, face, uv in zip(mesh.faces, owner, mesh.corner_uv, strict=True):
        expected = [10 * face + corner for corner in triangle]
        assert uv[:, 0].tolist() == expected
        assert uv[:, 1].tolist() == [value + 0.5 for value in expected]


@pytest.mark.parametrize("number", [0.0, np.nan])
def test_a_normal_without_a_direction_becomes_that_of_the_faces_around(tmp_path, number):
    """Mitsuba reads such a file, and shades with normals that are no numbers."""
    lost = (number,) * 3
    corners = [((0, 0, 0), lost), ((2, 0, 0), (0.6, 0, 0.8)), ((0, 1, 0), lost), ((0, 0, 1), lost)]
    points = [(*place, *normal) for place, normal in corners] + [(9, 9, 9, *lost)]
    mesh = read_ply(
        ply(tmp_path, "binary_little_endian", [(0, 1, 2), (0, 2, 3)], vertex="nx ny nz", points=points)
    )
    between = np.array([1, 0, 2]) / np.sqrt(5)  # an area of 1 faces z, one of 1 / 2 faces x
    expected = [between, (0.6, 0, 0.8), between, (1, 0, 0), (0, 0, 1)]
    assert mesh.normals == pytest.approx(np.array(expected))
    assert mesh.mended
    assert not mesh.plain


def test_lists_of_one_length_are_read_alike_row_by_row_and_at_once():
    rows = np.zeros(5, np.dtype([("a", ">f4"), ("n", "u1"), ("list", ">i2", 4), ("b", "u1")]))
    rows["a"], rows["n"], rows["b"] = np.arange(5) / 4, 4, np.arange(5)
    rows["list"] = np.arange(20).reshape(5, 4)
    table = _Element(
        "face", 5, [_Property("a", "", "f4"), _Property("list", "u1", "i2"), _Property("b", "", "u1")]
    )
    for columns in (_Source(rows.tobytes(), ">")._even(table), _Source(rows.tobytes(), ">")._uneven(table)):
        assert [column.values.tolist() for column in columns] == [
            (np.arange(5) / 4).tolist(),
            list(range(20)),
            list(range(5)),
        ]
        assert columns[1].counts.tolist() == [4] * 5


@pytest.mark.parametrize(
    "options",
    [
        "",
        '<boolean name="face_normals" value="true"/>',
        '<transform name="to_world"><scale x="-1" y="2"/><translate z="3"/></transform>',
        '<boolean name="flip_tex_coords" value="true"/><boolean name="flip_normals" value="true"/>',
    ],
    ids=["plain", "faceted", "moved", "flipped"],
)
@pytest.mark.parametrize("corners", [False, True], ids=["vertices", "corners"])
def test_a_polygon_in_a_mitsuba_scene_is_what_mitsuba_makes_of_its_triangles(tmp_path, options, corners):
    uv = {point: (point[0] / 4, point[1] / 3) for point in POINTS}
    coordinates = [[value for corner in face for value in uv[POINTS[corner]]] for face in FACES]
    points = POINTS if corners else [(*point, *uv[point]) for point in POINTS]
    names = "" if corners else "u v"
    file = ply(
        tmp_path, "binary_little_endian", FACES, coordinates if corners else None, vertex=names, points=points
    )
    triangles = read_ply(file).faces.tolist()
    shape = f'<shape type="ply" id="wall"><string name="filename" value="wall.ply"/>{options}'
    text = f'<scene version="3.0.0">{shape}<bsdf type="diffuse"/></shape><emitter type="constant"/></scene>'
    (tmp_path / "room.xml").write_text(text)
    scene = load_scene(tmp_path / "room.xml")
    entry = scene.content["wall"]
    assert [note.kind for note in scene.notes] == ["converted"]
    assert entry["type"] == "triangles"
    assert entry["bsdf"]["type"] == "diffuse"
    ply(tmp_path, "ascii", triangles, vertex="u v", points=[(*point, *uv[point]) for point in POINTS])
    (shape,) = mi.load_file(str(tmp_path / "room.xml")).shapes()
    expected = mi.traverse(shape)
    faces = np.array(expected["faces"]).reshape(-1, 3)
    for name, key, width in (("vertices", "positions", 3), ("normals", "normals", 3), ("uv", "texcoords", 2)):
        of_mitsuba = np.array(expected[f"vertex_{key}"]).reshape(-1, width)
        if not len(of_mitsuba):
            assert name not in entry
            continue
        assert entry[name][entry["faces"]] == pytest.approx(of_mitsuba[faces], abs=1e-6)


def test_a_polygon_file_is_a_scene_with_its_picture(tmp_path):
    Image.new("RGB", (2, 2), (200, 10, 10)).save(tmp_path / "bricks.png")
    coordinates = [[0.5] * 2 * len(face) for face in FACES]
    file = ply(tmp_path, "binary_little_endian", FACES, coordinates, comment="comment TextureFile bricks.png")
    scene = load_scene(file)
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert area(mesh["vertices"], mesh["faces"]).sum() == pytest.approx(sum(AREAS))
    assert mesh["uv"].shape == (len(mesh["vertices"]), 2)
    assert list(scene.files) == [str(tmp_path / "bricks.png")]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.png", "needs gone.png; no such file"),
        ("../../gone.png", "lies outside"),
        ("a" * 400, "is not a valid file name"),
        ("a\0b", "is not a valid file name"),
    ],
)
def test_a_picture_that_cannot_be_shown_is_left_out_with_a_note(tmp_path, name, words):
    coordinates = [[0.5] * 2 * len(face) for face in FACES]
    scene = load_scene(ply(tmp_path, "ascii", coordinates=coordinates, comment=f"comment TextureFile {name}"))
    assert any(words in note.text for note in scene.notes)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_mesh_without_coordinates_keeps_its_colours_whatever_picture_it_names(tmp_path, form):
    Image.new("RGB", (2, 2)).save(tmp_path / "bricks.png")
    points = [(*point, 100, 50, 0) for point in POINTS]
    file = ply(
        tmp_path, form, vertex="red green blue", points=points, comment="comment TextureFile bricks.png"
    )
    file.write_bytes(file.read_bytes().replace(b"float red", b"uchar red"))
    if form != "ascii":
        head, _, _ = file.read_bytes().partition(b"end_header\n")
        head = head.replace(b"float green", b"uchar green").replace(b"float blue", b"uchar blue")
        rows = np.zeros(len(POINTS), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
        rows["xyz"], rows["rgb"] = POINTS, (100, 50, 0)
        faces = b"".join(
            np.uint8(len(face)).tobytes() + np.array([*face, 0], "<i4").tobytes() for face in FACES
        )
        file.write_bytes(head + b"end_header\n" + rows.tobytes() + faces)
    else:
        text = file.read_text().replace("float green", "uchar green").replace("float blue", "uchar blue")
        file.write_text(text)
    scene = load_scene(file)
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert mesh["colors"][0] == pytest.approx([0.127, 0.032, 0], abs=1e-3)
    assert any("has no texture coordinates" in note.text for note in scene.notes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-20], "ends before"),
        (lambda data: data.replace(b"element face 3", b"element face 4000000000"), "ends before"),
        (
            lambda data: data.replace(b"uchar int vertex", b"char int vertex").replace(
                b"\x06\0", b"\xff\0", 1
            ),
            "ends before",
        ),
        (lambda data: data.replace(b"property list uchar int", b"property list float9 int"), "float9"),
        (lambda data: data.replace(b"format binary", b"format bnary"), "bnary"),
        (lambda data: data.replace(b"vertex_indices", b"corners"), "vertex_indices"),
        (lambda data: data.replace(b"property float z", b"property float q"), "x, y and z"),
    ],
    ids=[
        "cut off",
        "too many",
        "negative length",
        "unknown type",
        "unknown format",
        "no corners",
        "no height",
    ],
)
def test_damaged_files_are_refused(tmp_path, change, words):
    file = ply(tmp_path, "binary_little_endian")
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(SceneError, match=rf"wall\.ply: is not a valid PLY file: .*{words}"):
        read_ply(file)
