"""Mitsuba's XML files become plain descriptions that look the same; faults are named with their place."""

from __future__ import annotations

import hashlib
import pickle
import struct
from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.errors import SceneError, SettingsError
from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
from steadylight.scenes import load_scene

if TYPE_CHECKING:
    from pathlib import Path

    from steadylight.scenes.description import SceneDescription

MANY = """<scene version="3.0.0">
  <integrator type="not_a_plugin_of_ours"/>
  <sensor type="thinlens">
    <float name="fov" value="40"/><string name="fov_axis" value="y"/>
    <float name="aperture_radius" value="0.05"/><float name="focus_distance" value="5"/>
    <transform name="to_world"><lookat origin="0,-5,3" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="32"/>
      <rfilter type="tent"/></film>
    <sampler type="independent"/>
  </sensor>
  <shape type="rectangle" id="floor"><ref id="two.sided"/>
    <transform name="to_world"><scale value="4"/></transform></shape>
  <texture type="checkerboard" id="checks"><rgb name="color0" value="0.8,0.1,0.1"/>
    <transform name="to_uv"><scale x="3" y="2"/></transform></texture>
  <bsdf type="twosided" id="two.sided"><bsdf type="diffuse">
    <ref name="reflectance" id="checks"/></bsdf></bsdf>
  <bsdf type="roughconductor" id="gold"><string name="material" value="Au"/>
    <float name="alpha" value="0.3"/></bsdf>
  <bsdf type="diffuse" id="red"><spectrum name="reflectance" value="400:0.1,500:0.2,700:0.9"/></bsdf>
  <bsdf type="mask" id="veil"><float name="opacity" value="0.5"/><ref id="two.sided"/></bsdf>
  <shape type="sphere"><point name="center" x="-1" y="0" z="1"/><float name="radius" value="0.8"/>
    <ref id="gold"/></shape>
  <shape type="ply"><string name="filename" value="meshes/triangle.ply"/><ref id="veil"/></shape>
  <shape type="shapegroup" id="group"><shape type="sphere"><float name="radius" value="0.3"/>
    <ref id="red"/></shape></shape>
  <shape type="instance"><ref id="group"/>
    <transform name="to_world"><translate x="2" z="0.4"/></transform></shape>
  <emitter type="constant"><spectrum name="radiance" value="0.5"/></emitter>
  <emitter type="point"><point name="position" value="1,-2,3"/><rgb name="intensity" value="3,2,1"/></emitter>
</scene>
"""

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

OLD = """<scene version="0.5.0">
  <sensor type="perspective"><float name="fov" value="60"/>
    <transform name="toWorld"><scale x="-1"/><lookat origin="0,-4,1" target="0,0,1" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film></sensor>
  <shape type="sphere"><transform name="toWorld"><translate x="1" z="1"/></transform></shape>
  <emitter type="point"><point name="position" x="0" y="-4" z="5"/>
    <rgb name="intensity" value="90"/></emitter>
</scene>
"""


@pytest.fixture(autouse=True)
def _backend():
    variant = resolve_variant("llvm")
    import mitsuba as mi

    mi.set_variant(variant)


def scene_file(folder: Path, text: str, name: str = "room.xml") -> Path:
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "meshes" / "triangle.ply").write_text(TRIANGLE)
    file = folder / name
    file.write_text(text)
    return file


def body(*lines: str) -> str:
    return "\n".join(['<scene version="3.0.0">', *lines, "</scene>"])


def read(folder: Path, *lines: str) -> SceneDescription:
    return load_scene(scene_file(folder, body(*lines)))


@pytest.mark.parametrize("text", [MANY, OLD], ids=["many", "old"])
def test_a_scene_looks_as_mitsuba_itself_loads_it(tmp_path, text):
    import mitsuba as mi

    file = scene_file(tmp_path, text)
    description = pickle.loads(pickle.dumps(load_scene(file)))
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    theirs = mi.load_string(
        text.replace("not_a_plugin_of_ours", "path").replace("meshes/", f"{tmp_path}/meshes/"), optimize=False
    )
    ours = build_scene(description)
    sensor = build_sensor(description, description.camera.pose(0), description.width, description.height)
    expected = np.array(mi.render(theirs, integrator=integrator, spp=16, seed=2))[..., :3]
    image = np.array(mi.render(ours, sensor=sensor, integrator=integrator, spp=16, seed=2))
    # The same samples, but for the rounding of the field of view: single pixels at edges may differ.
    assert expected.mean() > 0.01
    assert np.median(np.abs(image - expected)) < 1e-5
    assert np.abs(image - expected).mean() < 0.01 * expected.mean()


def test_everything_arrives_as_plain_values_in_an_order_that_can_be_built(tmp_path):
    description = load_scene(scene_file(tmp_path, MANY))
    content = description.content
    assert list(content)[:3] == ["checks", "two_sided", "floor"]
    assert content["floor"]["bsdf"] == {"type": "ref", "id": "two_sided"}
    np.testing.assert_allclose(content["checks"]["to_uv"], np.diag([3.0, 2, 1, 1]))
    assert content["checks"]["color0"] == {"type": "rgb", "value": [0.8, 0.1, 0.1]}
    assert content["red"]["reflectance"] == {
        "type": "spectrum",
        "value": [[400, 0.1], [500, 0.2], [700, 0.9]],
    }
    assert content["emitter_1"]["radiance"] == {"type": "spectrum", "value": 0.5}
    assert content["emitter_2"]["position"] == [1, -2, 3]
    assert not any("integrator" in key or "sensor" in key for key in content)


def test_the_sensor_becomes_the_default_camera_with_a_horizontal_field_of_view(tmp_path):
    description = load_scene(scene_file(tmp_path, MANY))
    (key,) = description.camera.keyframes
    assert key.origin == pytest.approx((0, -5, 3))
    np.testing.assert_allclose(key.view, np.array([0, 5, -3]) / np.sqrt(34), atol=1e-6)
    assert key.fov == pytest.approx(np.degrees(2 * np.arctan(1.5 * np.tan(np.radians(20)))), abs=1e-4)
    assert (description.width, description.height) == (48, 32)
    assert description.film == {"type": "tent"}
    assert description.sensor == {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 5.0}
    assert description.name == "room"


def test_a_mirrored_view_stays_mirrored(tmp_path):
    assert load_scene(scene_file(tmp_path, OLD)).sensor["scale"] == pytest.approx([-1, 1, 1])


def test_an_orthographic_sensor_keeps_its_size(tmp_path):
    sensor = (
        '<sensor type="orthographic"><transform name="to_world"><scale x="2" y="3"/></transform></sensor>'
    )
    description = read(tmp_path, '<shape type="sphere"/>', sensor)
    assert description.sensor == {"type": "orthographic", "scale": pytest.approx([2, 3, 1])}


def test_without_a_sensor_the_whole_scene_is_seen_from_outside(tmp_path):
    description = read(
        tmp_path,
        '<shape type="sphere"><point name="center" value="9,0,0"/></shape>',
        '<emitter type="constant"/>',
    )
    pose = description.camera.pose(0)
    away = np.linalg.norm(pose.origin - [9, 0, 0])
    assert away > 2
    np.testing.assert_allclose(pose.direction, ([9, 0, 0] - pose.origin) / away, atol=1e-6)
    assert pose.to_world[2, 1] > 0.5  # z is up in the image


def test_files_are_absolute_and_hashed_and_the_hash_knows_their_bytes_only(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    here, there = (load_scene(scene_file(tmp_path / name, MANY)) for name in "ab")
    mesh = str(tmp_path / "a" / "meshes" / "triangle.ply")
    assert here.files == {mesh: hashlib.sha256(TRIANGLE.encode()).hexdigest()}
    assert here.content["shape_2"]["filename"] == mesh
    assert here.hash == there.hash
    file = scene_file(tmp_path / "b", MANY)
    (tmp_path / "b" / "meshes" / "triangle.ply").write_text(TRIANGLE.replace("1 0 2", "1 0 3"))
    assert load_scene(file).hash != here.hash


def test_included_files_and_parameters_are_resolved(tmp_path):
    (tmp_path / "ball.xml").write_text(
        body('<shape type="sphere" id="ball"><float name="radius" value="$r"/></shape>')
    )
    description = read(tmp_path, '<default name="r" value="0.25"/>', '<include filename="ball.xml"/>')
    assert description.content["ball"]["radius"] == 0.25


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (['<shape type="sphere">'], "line 3, column 3: not valid XML"),
        (
            ['<shape type="spher"/>'],
            "line 2, column 2: Mitsuba has no shape plugin `spher`; did you mean `sphere`?",
        ),
        (
            ['<shape type="sphere"><ref id="gone"/></shape>'],
            'line 2, column 23: unresolved reference to "gone"',
        ),
        (
            ['<shape type="sphere"><float name="radius" value="x"/></shape>'],
            "line 2, column 23: could not parse",
        ),
        (['<include filename="gone.xml"/>'], 'included file "gone.xml" not found'),
        (
            ['<shape type="ply"><string name="filename" value="gone.ply"/><emitter type="area"/></shape>'],
            "line 2, column 20: `ply` needs gone.ply; no such file",
        ),
        (
            ['<shape type="ply"><string name="filename" value="room.xml"/></shape>'],
            "room.xml: is not a valid PLY file: it does not begin with a PLY header",
        ),
        (
            [
                '<bsdf type="diffuse"><texture name="reflectance" type="bitmap">',
                '<string name="filename" value="gone.png"/></texture></bsdf>',
            ],
            "line 3, column 2: `bitmap` needs gone.png",
        ),
        (
            ['<shape type="sphere">', '<medium name="interior" type="homogeneous"/></shape>'],
            r"line 3, column 2: medium `homogeneous` is not supported: participating media",
        ),
        (['<bsdf type="retarder"/>'], "line 2, column 2: BSDF `retarder` is not supported: polarised light"),
        (
            ['<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'],
            "line 2, column 2: integrator option `hide_emitters` is not supported: emitters in view of the camera",
        ),
        (
            [
                '<sensor type="perspective"><film type="hdrfilm">',
                '<integer name="crop_width" value="20"/></film></sensor>',
            ],
            "line 2, column 2: film option `crop` is not supported: frames show the whole image; remove crop_",
        ),
        (
            ['<sensor type="distant"/>'],
            "line 2, column 2: sensor `distant` is not supported: renders no image",
        ),
        (
            [
                '<sensor type="perspective"><transform name="to_world">',
                '<matrix value="1 1 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform></sensor>',
            ],
            "line 2, column 2",
        ),
    ],
)
def test_a_fault_is_named_with_file_line_and_column(tmp_path, lines, words):
    with pytest.raises(SceneError) as caught:
        read(tmp_path, *lines)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "room.xml"))
    assert words in message
    assert ".cpp" not in message


VIEWS = (
    '<shape type="sphere"/><emitter type="constant"/>',
    '<sensor type="perspective" id="door"><float name="fov" value="40"/></sensor>',
    '<sensor type="orthographic" id="above"><film type="hdrfilm"><integer name="width" value="20"/>',
    '<integer name="height" value="20"/></film></sensor>',
)


def test_a_face_that_names_no_vertex_is_a_fault_and_does_not_crash_mitsuba(tmp_path):
    head = TRIANGLE.replace("ascii", "binary_little_endian").split("0 0 0.5")[0].encode()
    head = head.replace(b"element face", b"comment von M\xfcller\nelement face")
    (tmp_path / "binary.ply").write_bytes(head + struct.pack("<9fB3i", *range(9), 3, 0, 1, 1 << 30))
    (tmp_path / "text.ply").write_text(TRIANGLE.replace("3 0 1 2", "3 0 1 3"))
    meshes = [
        f'<shape type="ply"><string name="filename" value="{name}.ply"/></shape>'
        for name in ("binary", "text")
    ]
    with pytest.raises(SceneError) as error:
        read(tmp_path, *meshes)
    first, second = str(error.value).splitlines()
    assert "line 2, column 20" in first
    assert first.endswith(
        "binary.ply: is not a valid PLY file: a face refers to vertex 1073741824, but there are 3 vertices"
    )
    assert second.endswith(
        "text.ply: is not a valid PLY file: a face refers to vertex 3, but there are 3 vertices"
    )


def test_a_sensor_is_chosen_by_id_or_number(tmp_path):
    file = scene_file(tmp_path, body(*VIEWS))
    for sensor in ("above", "2"):
        description = load_scene(file, sensor=sensor)
        assert (description.sensor["type"], description.width) == ("orthographic", 20)
        assert not description.notes
    assert load_scene(file, sensor="door").camera.pose(0).fov == pytest.approx(40)


def test_the_first_of_several_sensors_is_used_with_a_warning_that_names_all(tmp_path):
    scene = read(tmp_path, *VIEWS)
    assert scene.sensor["type"] == "perspective"
    (note,) = scene.notes
    assert (note.kind, note.text) == (
        "warning",
        "of 1 (door), 2 (above) the first is used; choose with --sensor",
    )


@pytest.mark.parametrize("sensor", ["3", "0", "window"])
def test_a_sensor_that_is_not_there_is_refused_with_those_that_are(tmp_path, sensor):
    with pytest.raises(
        SettingsError, match=f"--sensor: '{sensor}' is not a sensor.*1 \\(door\\), 2 \\(above\\)"
    ):
        load_scene(scene_file(tmp_path, body(*VIEWS)), sensor=sensor)


def test_a_file_may_have_a_sensor_of_another_kind_beside_the_one_that_is_used(tmp_path):
    film = '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/></film>'
    lines = [*VIEWS[:2], f'<sensor type="radiancemeter" id="meter">{film}</sensor>']
    assert load_scene(scene_file(tmp_path, body(*lines)), sensor="door").sensor["type"] == "perspective"


def test_a_crop_of_the_whole_picture_is_none(tmp_path):
    whole = '<integer name="width" value="20"/><integer name="crop_width" value="20"/>'
    assert (
        read(tmp_path, f'<sensor type="perspective"><film type="hdrfilm">{whole}</film></sensor>').width == 20
    )


def test_a_fault_in_an_included_file_is_put_down_to_that_file(tmp_path):
    (tmp_path / "part.xml").write_text(body('<shape type="cubee"/>'))
    with pytest.raises(SceneError, match=r"part\.xml: line 2, column 2: .* did you mean `cube`"):
        read(tmp_path, '<include filename="part.xml"/>')


@pytest.mark.parametrize("text", ["", "hello", "<scene/>", '<bsdf version="3.0.0" type="diffuse"/>'])
def test_what_is_no_scene_is_refused(tmp_path, text):
    with pytest.raises(SceneError, match=r"room\.xml"):
        load_scene(scene_file(tmp_path, text))


def test_a_missing_scene_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"gone\.xml: no such scene file"):
        load_scene(tmp_path / "gone.xml")
    (tmp_path / "folder.xml").mkdir()
    with pytest.raises(SceneError, match=r"folder\.xml: cannot be read"):
        load_scene(tmp_path / "folder.xml")
