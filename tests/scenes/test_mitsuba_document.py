"""A scene file's faults are told at once; its parameters, files and names are taken as people write them."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes import load_scene, xml_elements

TRIANGLE = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0.5
2 0 0.5
1 0 2
3 0 1 2
"""
BALL = '<shape type="sphere"/><emitter type="constant"/>'


@pytest.fixture(autouse=True)
def _backend():
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")


@pytest.fixture
def write(tmp_path):
    """Writes a scene of lines, and gives its path."""

    def scene(*lines, name="room.xml", head='<scene version="3.0.0">'):
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True, parents=True)
        file.write_text("\n".join([head, *lines, "</scene>"]), "utf-8")
        return file

    return scene


def faults(file, **options):
    """The lines of the error, without the folder."""
    with pytest.raises(SceneError) as caught:
        load_scene(file, **options)
    return [line.replace(f"{file.parent}/", "") for line in str(caught.value).splitlines()]


def test_all_faults_are_told_at_once_each_at_its_own_line(write):
    file = write(
        '<bsdf type="twosided" id="cloth"><bsdf type="retarder"/></bsdf>',
        '<shape type="sphere"><ref id="cloth"/>',
        '<float name="radius" value="wide"/></shape>',
        '<shape type="obj">',
        '<string name="filename" value="Möbel/lamp.obj"/><emitter type="area"/></shape>',
        '<shape type="sphere"><ref id="gone"/></shape>',
        '<shape type="sphere">',
        '<float name="radius" value="$size"/></shape>',
        '<shape type="disk"><bsdf type="dielectric">',
        '<float name="intIOR" value="-2"/></bsdf></shape>',
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>',
        '<shape type="spher" id="twice"/><shape type="disk" id="twice"/>',
    )
    assert faults(file) == [
        "room.xml: line 2, column 35: BSDF `retarder` is not supported: polarised light is not rendered; use null",
        'room.xml: line 4, column 2: could not parse floating point value "wide"',
        f"room.xml: line 6, column 2: `obj` needs Möbel/lamp.obj; no such file in {file.parent}",
        'room.xml: line 7, column 23: unresolved reference to "gone"',
        "room.xml: line 9, column 2: undefined parameter: $size; give it a value with -D size=...",
        "room.xml: line 10, column 21: `dielectric`: The interior and exterior indices of refraction must be positive!",
        f"room.xml: line 12, column 25: `envmap` needs sky.exr; no such file in {file.parent}",
        "room.xml: line 13, column 2: Mitsuba has no shape plugin `spher`; did you mean `sphere`?",
        'room.xml: line 13, column 34: duplicate id "twice"; it is given on line 13',
    ]


def test_faults_are_told_at_once_up_to_a_number_that_one_can_read(write):
    shapes = ['<emitter type="envmap"><string name="filename" value="gone.exr"/></emitter>'] * 60
    told = faults(write(*shapes))
    assert len(told) == 51
    assert told[-1] == "... and 10 more"


def test_a_property_without_a_meaning_is_left_out_with_a_note_at_its_line(write):
    file = write(
        '<sensor type="perspective"><film type="hdrfilm">',
        '<float name="gamma" value="2.2"/></film></sensor>',
        '<shape type="sphere">',
        '<float name="raduis" value="2"/></shape>',
        '<emitter type="constant"/>',
    )
    description = load_scene(file)
    assert description.content["shape_1"] == {"type": "sphere"}
    assert [(note.kind, note.where, note.text) for note in description.notes] == [
        ("left out", "room.xml: line 3, column 2", "`hdrfilm` has no property `gamma`"),
        (
            "left out",
            "room.xml: line 5, column 2",
            "`sphere` has no property `raduis`; did you mean `radius`?",
        ),
    ]


def test_a_property_that_others_have_is_not_suggested_in_its_own_place(write):
    file = write(
        '<bsdf type="conductor" id="chrome"><string name="distribution" value="ggx"/></bsdf>',
        '<shape type="sphere"><ref id="chrome"/></shape>',
        '<emitter type="constant"/>',
    )
    assert [note.text for note in load_scene(file).notes] == ["`conductor` has no property `distribution`"]


def test_names_of_older_files_are_read_in_files_of_today_as_well(write):
    moved = '<shape type="sphere"><transform name="toWorld"><translate x="3"/></transform></shape>'
    description = load_scene(write(moved, '<emitter type="constant"/>'))
    assert description.content["shape_1"]["to_world"][0, 3] == 3
    assert description.notes == ()


PARAMETRISED = (
    '<default name="size" value="2"/><default name="size_of_film" value="$size"/>',
    '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="1$size_of_film"/>',
    '<integer name="height" value="10"/></film></sensor>',
    '<shape type="sphere" id="a\\$b"><float name="radius" value="$size"/></shape>',
    '<emitter type="constant"/>',
)


def test_parameters_take_the_place_of_defaults_and_the_hash_knows_what_they_give(write):
    file = write(*PARAMETRISED)
    plain, same, other = (load_scene(file, parameters=given) for given in ({}, {"size": "2"}, ["size=3"]))
    assert plain.content["a$b"]["radius"] == 2
    assert (plain.width, same.width, other.width) == (12, 12, 13)
    assert other.content["a$b"]["radius"] == 3
    assert plain.hash == same.hash != other.hash


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["colour=red"], r"-D colour: no such parameter in .*room\.xml; it has size, size_of_film"),
        (["size"], r"-D: \['size'\] is not valid; .*give name=value"),
        (["=3"], "give name=value"),
    ],
)
def test_a_parameter_that_is_not_there_is_refused_with_those_that_are(write, given, words):
    with pytest.raises(SettingsError, match=words):
        load_scene(write(*PARAMETRISED), parameters=given)


def test_files_outside_the_folder_are_read_only_if_allowed(write, tmp_path):
    (tmp_path / "triangle.ply").write_text(TRIANGLE)
    mesh = '<shape type="ply"><string name="filename" value="../triangle.ply"/></shape><emitter type="constant"/>'
    file = write(mesh, name="house/room.xml")
    assert faults(file) == [
        (
            "room.xml: line 2, column 20: ../triangle.ply is outside the scene's folder; add --allow-outside if you "
            "trust this scene"
        )
    ]
    (tmp_path / "house" / "linked.ply").symlink_to(tmp_path / "triangle.ply")
    assert "is outside" in faults(write(mesh.replace("../triangle", "linked"), name="house/link.xml"))[0]
    write(BALL, name="whole.xml")
    assert "is outside" in faults(write('<include filename="../whole.xml"/>', name="house/part.xml"))[0]
    mesh_file = str(tmp_path / "house" / ".." / "triangle.ply")
    assert list(load_scene(file, allow_outside=True).files) == [mesh_file]


def test_shapes_whose_file_is_missing_are_left_out_with_a_note(write):
    gone = '<shape type="ply"><string name="filename" value="gone.ply"/><ref id="white"/></shape>'
    file = write('<bsdf type="diffuse" id="white"/>', gone, BALL)
    description = load_scene(file)
    assert [key for key in description.content if key.startswith("shape")] == ["shape_1"]
    assert [note.text for note in description.notes] == ["`ply`: its file gone.ply is missing"]


def test_what_needs_a_missing_mesh_is_left_out_with_it_and_the_rest_stays(write):
    file = write(
        '<shape type="shapegroup" id="tree">',
        '<shape type="ply" id="leaf"><string name="filename" value="gone.ply"/></shape></shape>',
        '<shape type="instance" id="here"><ref id="tree"/></shape>',
        '<shape type="shapegroup" id="hedge"><ref id="leaf"/><shape type="sphere"/></shape>',
        '<shape type="instance" id="there"><ref id="hedge"/></shape>',
        '<shape type="obj" id="chair"><string name="filename" value="chair.obj"/>',
        '<bsdf type="diffuse" id="wood"><rgb name="reflectance" value="0.5"/></bsdf>',
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">',
        '<string name="filename" value="gone.png"/></texture></bsdf></shape>',
        '<shape type="sphere" id="ball"><ref id="wood"/></shape><emitter type="constant"/>',
    )
    description = load_scene(file)
    assert {"hedge", "there", "ball", "wood"} <= set(description.content)
    assert not {"tree", "here", "leaf", "chair"} & set(description.content)
    assert sorted(note.text for note in description.notes if note.kind == "left out") == [
        "`instance`: all of its shapes are left out",
        "`obj`: its file chair.obj is missing",
        "`ply`: its file gone.ply is missing",
        "`shapegroup`: all of its shapes are left out",
    ]


@pytest.mark.parametrize(
    "light",
    ['<emitter type="area"/>', '<ref id="bulb"/>'],
    ids=["its own", "referred to"],
)
def test_a_missing_mesh_that_gives_light_is_an_error(write, light):
    gone = f'<shape type="ply"><string name="filename" value="gone.ply"/>{light}</shape>'
    assert faults(write('<emitter type="area" id="bulb"/>', gone, BALL)) == [
        f"room.xml: line 3, column 20: `ply` needs gone.ply; no such file in {write(BALL).parent}"
    ]


def test_names_with_spaces_umlauts_and_quotes_are_found(write, tmp_path):
    name = "Mein 'Büro' & \"Flur\".ply"
    (tmp_path / name).write_text(TRIANGLE)
    escaped = name.replace("&", "&amp;").replace('"', "&quot;")
    description = load_scene(
        write(
            f'<shape type="ply" id="Tür &lt;1&gt;"><string name="filename" value="{escaped}"/></shape>', BALL
        )
    )
    assert list(description.files) == [str(tmp_path / name)]
    assert "Tür <1>" in description.content


def test_a_file_is_read_in_the_encoding_that_it_declares(tmp_path):
    text = f'<scene version="3.0.0"><shape type="sphere" id="Kugel für alle"/>{BALL}</scene>'
    for encoding in ("iso-8859-1", "windows-1252", "utf-16"):
        file = tmp_path / f"{encoding}.xml"
        file.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{text}'.encode(encoding))
        assert "Kugel für alle" in load_scene(file).content
    file.write_bytes(text.encode("latin-1"))
    assert (
        "line 1, column 56: not valid XML: an invalid character; a file that is not UTF-8"
        in (faults(file)[0])
    )


def test_folders_to_search_and_aliases_are_followed(write, tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "triangle.ply").write_text(TRIANGLE)
    description = load_scene(
        write(
            '<path value="meshes"/><bsdf type="diffuse" id="white"/><alias id="white" as="wall"/>',
            '<shape type="ply"><string name="filename" value="triangle.ply"/><ref id="wall"/></shape>',
            '<emitter type="constant"/>',
        )
    )
    assert description.content["shape_1"]["bsdf"] == {"type": "ref", "id": "white"}


def test_a_spectrum_from_a_file_is_found_beside_the_file_that_names_it(write, tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "red.spd").write_text("400 0.1\n700 0.8\n")
    part = '<bsdf type="diffuse" id="red"><spectrum name="reflectance" filename="red.spd"/></bsdf>'
    write(part, name="parts/colours.xml")
    content = load_scene(write('<include filename="parts/colours.xml"/>', BALL)).content
    np.testing.assert_allclose(content["red"]["reflectance"]["value"], [[400, 0.1], [700, 0.8]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<bsdf type="twosided">' * 200_000, "elements are nested more than 100 levels deep"),
        ('<include filename="room.xml"/></scene>', "files include each other more than 15 levels deep"),
        (
            "".join(f'<bsdf type="mask" id="b{n}"><ref id="b{n + 1}"/></bsdf>' for n in range(2_000))
            + '<bsdf type="diffuse" id="b2000"/></scene>',
            "references are chained more than 100 deep",
        ),
        (
            '<bsdf type="mask" id="a"><ref id="b"/></bsdf><bsdf type="mask" id="b"><ref id="a"/></bsdf></scene>',
            '"b" refers to itself',
        ),
    ],
    ids=["levels", "includes", "references", "circle"],
)
def test_what_would_exhaust_the_stack_is_refused(tmp_path, text, words):
    file = tmp_path / "room.xml"
    file.write_text(f'<scene version="3.0.0">{text}')
    assert words in faults(file)[0]


def test_what_would_exhaust_the_memory_is_refused(tmp_path, monkeypatch):
    file = tmp_path / "room.xml"
    file.write_text(
        '<!DOCTYPE s [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><scene version="3.0.0"><shape type="&b;"/></scene>'
    )
    assert "a scene file may not declare entities" in faults(file)[0]
    monkeypatch.setattr("steadylight.scenes.mitsuba_document.MAX_ELEMENTS", 10)
    file.write_text(f'<scene version="3.0.0">{"<bsdf/>" * 10}</scene>')
    assert "room.xml: line 1, column 88: the scene has more than" in faults(file)[0]
    monkeypatch.setattr(xml_elements, "MAX_BYTES", 64)
    assert "is larger than 0 MiB" in faults(file)[0]
