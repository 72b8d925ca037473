"""USD files: units and axes, names, references, packages, cameras, and errors."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from usd_stages import FLOOR, light, read, texts, usda

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes import load_scene
from steadylight.scenes.usd.isolation import read_stage
from steadylight.scenes.usd.reading import describe
from steadylight.scenes.usd.request import Request

CUBE = 'def Cube "C" { double3 xformOp:translate = (1, 2, 3)\nuniform token[] xformOpOrder = ["xformOp:translate"] }'


@pytest.mark.parametrize(("metres", "size"), [(1.0, 2.0), (0.01, 0.02), (0.0254, 0.0508)])
def test_lengths_become_metres(tmp_path, metres, size):
    cube = read(tmp_path, CUBE, metres=metres).content["C"]["vertices"]
    np.testing.assert_allclose(np.ptp(cube, axis=0), size, rtol=1e-6)


def test_y_up_becomes_z_up(tmp_path):
    cube = read(tmp_path, CUBE, up="Y").content["C"]["vertices"]
    np.testing.assert_allclose(cube.mean(axis=0), (1, -3, 2), atol=1e-6)


def test_a_file_that_says_no_unit_is_in_centimetres_with_a_warning(tmp_path):
    path = tmp_path / "bare.usda"
    path.write_text("#usda 1.0\n" + usda(CUBE).split(")\n", 1)[1])
    found = describe(Request(path))
    assert np.ptp(found.content["C"]["vertices"], axis=0) == pytest.approx(0.02)
    assert "warning: metersPerUnit" in texts(found)


CAMERA = """
def Xform "Dolly" { double3 xformOp:translate.timeSamples = { 101: (0, -5, 1.5), 105: (4, -5, 1.5) }
  uniform token[] xformOpOrder = ["xformOp:translate"]
  def Camera "Eye" {
    float xformOp:rotateX = 90
    uniform token[] xformOpOrder = ["xformOp:rotateX"]
    float horizontalAperture = 36
    float verticalAperture = 24
    float focalLength.timeSamples = { 101: 18, 105: 36 } } }
"""
HEADER = "startTimeCode = 101\n endTimeCode = 105\n timeCodesPerSecond = 30"


def test_a_camera_has_a_pose_and_a_zoom_for_each_time_code(tmp_path):
    found = read(tmp_path, CAMERA, more=HEADER)
    assert (found.frames, found.fps, found.width, found.height) == (5, 30, 1280, 853)
    poses = found.camera.frame_poses(range(1, 6), 30)
    for i, pose in enumerate(poses):
        expected = [[-1, 0, 0, i], [0, 0, 1, -5], [0, 1, 0, 1.5], [0, 0, 0, 1]]
        np.testing.assert_allclose(pose.to_world, expected, atol=1e-6)
        assert pose.fov == pytest.approx(2 * np.degrees(np.arctan(18 / (18 + 4.5 * i))))


def test_a_stage_of_more_time_codes_than_an_animation_has_frames_is_refused(tmp_path):
    assert read(tmp_path, CAMERA, more="startTimeCode = 1\n endTimeCode = 99999").frames == 99_999
    with pytest.raises(SceneError, match="at most 99,999 frames are supported"):
        read(tmp_path, CAMERA, more="startTimeCode = 1\n endTimeCode = 100000")


def test_a_camera_is_in_metres_and_upright_whatever_the_stage_is(tmp_path):
    turned = 'def Xform "World" { float xformOp:rotateX = -90\nuniform token[] xformOpOrder = ["xformOp:rotateX"]\n'
    found = read(
        tmp_path,
        turned + CAMERA.replace("5, 1.5", "500, 150").replace("4, -500", "400, -500") + "}",
        up="Y",
        metres=0.01,
        more=HEADER,
    )
    np.testing.assert_allclose(found.camera.frame_poses([5], 30)[0].origin, (4, -5, 1.5), atol=1e-6)


def test_one_of_several_cameras_is_chosen_by_name_path_or_number(tmp_path):
    body = (
        CAMERA + 'def Camera "Zweite" { double3 xformOp:translate = (9, 9, 9)\n'
        'uniform token[] xformOpOrder = ["xformOp:translate"] }'
    )
    for wanted in ("Zweite", "/Zweite", "2"):
        assert read(tmp_path, body, wanted).camera.keyframes[0].origin == (9, 9, 9)
    assert "choose with --sensor" in texts(read(tmp_path, body))
    with pytest.raises(
        SettingsError, match=r"'Dritte' is not a camera .* it has 1 \(/Dolly/Eye\), 2 \(/Zweite\)"
    ):
        read(tmp_path, body, "Dritte")


def test_render_settings_name_camera_and_size(tmp_path):
    body = (
        CAMERA
        + 'def Camera "Other" {}\ndef Scope "Render" { def RenderSettings "S" {\nrel camera = </Other>\n'
        "uniform int2 resolution = (320, 200) } }"
    )
    found = read(tmp_path, body, more='renderSettingsPrimPath = "/Render/S"')
    assert (found.width, found.height, found.frames) == (320, 200, 1)


def test_focus_shift_and_orthographic_cameras_become_sensors(tmp_path):
    lens = (
        'def Camera "C" {\nfloat focalLength = 0.5\nfloat horizontalAperture = 0.36\n'
        "float fStop = 2\nfloat focusDistance = 3 }"
    )
    sensor = read(tmp_path, lens, name="lens.usda").sensor
    assert sensor == {
        "type": "thinlens",
        "aperture_radius": pytest.approx(0.0125),
        "focus_distance": pytest.approx(3),
    }
    flat = (
        'def Camera "C" {\ntoken projection = "orthographic"\nfloat horizontalAperture = 40\n'
        "float verticalAperture = 40 }"
    )
    sensor = read(tmp_path, flat, name="flat.usda").sensor
    assert sensor["type"] == "orthographic"
    assert sensor["scale"][0] == pytest.approx(2)


def test_names_with_spaces_umlauts_and_quotes_are_kept(tmp_path):
    folder = tmp_path / 'Büro "Süd" 1'
    folder.mkdir()
    body = FLOOR.replace('"Floor"', '"Fußboden_groß"') + light("RectLight", at=(0, 0, 2)).replace(
        '"L"', '"Büro_Lampe"'
    )
    path = folder / "Entwurf Nr. 2 – O'Neill.usda"
    path.write_text(usda(body), encoding="utf-8")
    found = describe(Request(path))
    assert found.name == "Entwurf Nr. 2 – O'Neill"
    assert {"Fußboden_groß", "light /Büro_Lampe"} <= set(found.content)


def test_the_name_that_blender_gave_is_used(tmp_path):
    body = (
        'def Xform "Lampe__1_" { custom string userProperties:blender:object_name = \'Lampe "1"\'\n'
        + light("RectLight", at=(0, 0, 1))
        + "}"
    )
    assert 'light Lampe "1"' in read(tmp_path, body).content


def test_references_and_payloads_within_the_folder_are_read(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "chair.usda").write_text(usda('def Xform "Chair" { def Cube "Seat" {} }'))
    body = 'def "A" (references = @./parts/chair.usda@</Chair>) {}\ndef "B" (payload = @parts/chair.usda@</Chair>) {}'
    assert {"A/Seat", "B/Seat"} <= set(read(tmp_path, body).content)


@pytest.mark.parametrize("way", ["../chair.usda", "{absolute}", "link.usda"])
def test_files_outside_the_folder_need_a_flag(tmp_path, way):
    chair = tmp_path / "chair.usda"
    chair.write_text(usda('def Xform "Chair" { def Cube "Seat" {} }'))
    inner = tmp_path / "scene"
    inner.mkdir()
    (inner / "link.usda").symlink_to(chair)
    body = f'def "A" (references = @{way.format(absolute=chair)}@</Chair>) {{}}'
    with pytest.raises(SceneError, match=r"outside the scene.s folder; .* --allow-outside"):
        read(inner, body)
    assert "A/Seat" in read(inner, body, outside=True, name="again.usda").content


def test_value_clips_outside_the_folder_need_a_flag(tmp_path):
    clip = '#usda 1.0\ndef Cube "A" {\n double size.timeSamples = { 0: 3 }\n}\n'
    (tmp_path / "clip.usda").write_text(clip)
    (tmp_path / "manifest.usda").write_text('#usda 1.0\ndef Cube "A" {\n double size\n}\n')
    inner = tmp_path / "scene"
    inner.mkdir()
    body = """def Cube "A" (
      clips = { dictionary default = {
      asset[] assetPaths = [@../clip.usda@]
      asset manifestAssetPath = @../manifest.usda@
      string primPath = "/A"
      double2[] active = [(0, 0)]
      double2[] times = [(0, 0)] } }) {}"""
    with pytest.raises(SceneError, match=r"refers to .*(clip|manifest)\.usda, outside the scene.s folder"):
        read(inner, body)
    scene = read(inner, body, outside=True, name="again.usda")
    assert np.ptp(scene.content["A"]["vertices"]) == pytest.approx(3.0)


def test_textures_outside_the_folder_need_a_flag(tmp_path):
    (tmp_path / "wood.png").write_bytes(b"x")
    (tmp_path / "scene").mkdir()
    with pytest.raises(SceneError, match=r"refers to .*wood.png, outside"):
        read(tmp_path / "scene", light("RectLight", texture__file="@../wood.png@"))


def test_all_missing_files_are_named_at_once(tmp_path):
    body = 'def "A" (references = @chair.usda@</Chair>) {}\ndef "B" (references = [@a/b.usdc@, @c.usdz@]) {}'
    with pytest.raises(SceneError) as error:
        read(tmp_path, body)
    assert all(name in str(error.value) for name in ("chair.usda", "a/b.usdc", "c.usdz"))


def test_a_reference_into_nothing_is_a_warning(tmp_path):
    assert "Unresolved reference" in texts(read(tmp_path, 'def "A" (references = </Nothing>) {}'))


def test_a_package_is_read_in_place(tmp_path):
    from PIL import Image
    from pxr import UsdUtils

    Image.new("RGB", (4, 2), (255, 0, 0)).save(tmp_path / "red.png")
    (tmp_path / "scene.usda").write_text(
        usda(FLOOR + light("RectLight", at=(0, 0, 2), texture__file="@red.png@"))
    )
    package = tmp_path / "all.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "scene.usda"), str(package))
    (tmp_path / "alone").mkdir()
    moved = package.rename(tmp_path / "alone" / "all.usdz")
    found = describe(Request(moved))
    image = next(entry for entry in found.content.values() if entry["type"] == "image")
    assert bytes(image["encoded"][1:4]) == b"PNG"
    assert list(moved.parent.iterdir()) == [moved]


@pytest.mark.parametrize("suffix", [".usd", ".usdc"])
def test_binary_files_say_the_same_as_text(tmp_path, suffix):
    from pxr import Usd

    text = tmp_path / "scene.usda"
    text.write_text(usda(FLOOR + CUBE + light("RectLight", at=(0, 0, 2)) + CAMERA, more=HEADER))
    Usd.Stage.Open(str(text)).Export(str(tmp_path / f"scene{suffix}"))
    assert describe(Request(tmp_path / f"scene{suffix}")).hash == describe(Request(text)).hash


def test_the_same_file_gives_the_same_description_in_another_process(tmp_path):
    path = tmp_path / "scene.usda"
    path.write_text(usda(FLOOR + CUBE + light("DomeLight")))
    assert read_stage(Request(path)).hash == describe(Request(path)).hash


def damaged(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("half.usda", usda(CUBE).encode()[:-20]),
        ("empty.usdc", b""),
        ("wrong.usdc", b"PXR-USDC" + b"\xff" * 200),
        ("wrong.usdz", b"PK\x03\x04" + b"\x00" * 50),
        ("text.usd", b"hello"),
    ],
)
def test_a_damaged_file_gives_one_message(tmp_path, name, content):
    path = damaged(tmp_path, name, content)
    with pytest.raises(SceneError) as error:
        describe(Request(path))
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_what_the_library_prints_stays_out_of_sight(tmp_path, capfd):
    with pytest.raises(SceneError, match=r"half\.usda"):
        load_scene(damaged(tmp_path, "half.usda", usda(CUBE).encode()[:-20]))
    assert capfd.readouterr() == ("", "")


def test_a_package_that_holds_no_stage_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as package:
        package.writestr("readme.txt", "nothing")
    with pytest.raises(SceneError, match=r"a\.usdz"):
        describe(Request(tmp_path / "a.usdz"))


def test_a_library_that_crashes_takes_nothing_with_it(tmp_path, monkeypatch):
    # As damaged files have made it do: the other process dies of a signal.
    (tmp_path / "pxr.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    (tmp_path / "scene.usda").write_text(usda(CUBE))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SceneError, match=r"scene.usda: USD cannot read it \(its library crashed: SIGSEGV\)"):
        load_scene(tmp_path / "scene.usda")


def test_a_library_that_never_ends_is_stopped(tmp_path, monkeypatch):
    (tmp_path / "pxr.py").write_text("import time\ntime.sleep(100)\n")
    (tmp_path / "scene.usda").write_text(usda(CUBE))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SceneError, match=r"did not finish reading it within 0\.5 s"):
        read_stage(Request(tmp_path / "scene.usda"), time_limit=0.5)
