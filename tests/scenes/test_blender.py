"""Blender's scenes: as .blend, through USD, and through glTF, against Blender itself."""

from __future__ import annotations

import json
import os
import stat
import subprocess
from pathlib import Path

import numpy as np
import pytest

import steadylight as sl
from steadylight.errors import BackendError, SceneError, SettingsError
from steadylight.images import read_exr
from steadylight.scenes import load_scene
from steadylight.scenes.blender import VARIABLE, blender_command

ROOT = Path(__file__).parents[2]
OWN = ROOT / ".venv-blender" / "bin" / "python"
"""An environment with the package bpy; see CONTRIBUTING.md."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@pytest.fixture(scope="module")
def blender():
    """The start of a command that runs a script in Blender's Python."""
    if blender_command() is None and OWN.is_file():
        os.environ[VARIABLE] = str(OWN)
    command = blender_command()
    if command is None:
        pytest.skip("needs Blender, or its package bpy in .venv-blender (see CONTRIBUTING.md)")
    yield command
    if os.environ.get(VARIABLE) == str(OWN):
        del os.environ[VARIABLE]


def run(command, script, *words):
    done = subprocess.run(
        [*command, str(script), "--", *map(str, words)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


@pytest.fixture(scope="module")
def room(blender, tmp_path_factory):
    """A folder with the scene of `blender_room.py` in three formats, and what Blender says of it."""
    folder = tmp_path_factory.mktemp("room")
    run(blender, Path(__file__).with_name("blender_room.py"), folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".blend", ".usdc", ".glb"])
def test_the_camera_is_where_blender_has_it_in_every_frame(room, suffix):
    facts = json.loads((room / "facts.json").read_text())
    scene = load_scene(room / f"room{suffix}")
    assert (scene.frames, scene.fps) == (25, facts["fps"])
    frames = (1, 7, 13, 20, 25)
    for frame, pose in zip(frames, scene.camera.frame_poses(frames, scene.fps), strict=True):
        expected = np.array(facts["poses"][frame - 1]) @ np.diag([-1, 1, -1, 1])
        np.testing.assert_allclose(pose.to_world, expected, atol=1e-4)
        if suffix != ".glb":  # Blender writes no zoom to glTF
            assert pose.fov == pytest.approx(facts["fov"][frame - 1], abs=1e-4)


def mean_of(image, box):
    """Mean colour within left, top, right, bottom, as shares of the picture."""
    height, width = image.shape[:2]
    left, top, right, bottom = box
    rows = slice(int(np.ceil(top * height)), int(bottom * height))
    return image[rows, int(np.ceil(left * width)) : int(right * width), :3].mean(axis=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "reference"), [(".blend", "cycles"), (".usdc", "cycles"), (".glb", "lamps")]
)
def test_patches_are_as_bright_as_in_cycles(room, tmp_path, suffix, reference):
    facts = json.loads((room / "facts.json").read_text())
    run = sl.render(
        room / f"room{suffix}",
        frames=1,
        size=tuple(facts["size"]),
        mode="path",
        bounces=2,
        spp=256,
        output=tmp_path / "run",
    )
    ours, theirs = read_exr(run.frames[0]), read_exr(room / f"{reference}.exr")
    for box in facts["patches"]:
        assert mean_of(ours, box) @ LUMINANCE == pytest.approx(mean_of(theirs, box) @ LUMINANCE, rel=0.05)
    if reference == "cycles":  # without the sky, there is nothing behind the pane
        assert mean_of(ours, facts["pane"]) @ LUMINANCE == pytest.approx(
            mean_of(theirs, facts["pane"]) @ LUMINANCE, rel=0.05
        )


@pytest.mark.slow
def test_instances_names_and_textures_of_blender_are_kept(room):
    for suffix in (".usdc", ".blend"):
        content = load_scene(room / f"room{suffix}").content
        copies = [entry for entry in content.values() if entry["type"] == "instance"]
        # Blender makes an instance of each object of the collection.
        assert sorted(round(float(entry["to_world"][1, 3]), 3) for entry in copies) == [
            -1.5,
            -1.5,
            -0.5,
            -0.5,
        ]
        assert {"material Boden, geölt", "light Area lamp"} <= set(content)
        image = next(entry for entry in content.values() if entry["type"] == "image")
        assert image["srgb"] is True


@pytest.mark.slow
def test_the_same_blend_file_gives_the_same_description(room):
    assert load_scene(room / "room.blend").hash == load_scene(room / "room.blend").hash


ODD = """
import math, sys
import bpy
folder = sys.argv[-1]
bpy.ops.wm.read_factory_settings(use_empty=True)
def lamp(kind, name, **properties):
    light = bpy.data.lights.new(name, kind)
    for key, value in properties.items():
        setattr(light, key, value)
    made = bpy.data.objects.new(name, light)
    bpy.context.collection.objects.link(made)
    return made
lamp("AREA", "Ellipse", shape="ELLIPSE", size=2, size_y=1)
lamp("AREA", "Narrow", spread=1.0)
lamp("SUN", "Strong sun", energy=3, angle=0.02)
lamp("POINT", "Warm", energy=math.pi * 40, shadow_soft_size=0.5, use_temperature=True, temperature=3000)
lamp("POINT", "Not rendered").hide_render = True
off = lamp("POINT", "Hidden in the viewport only", energy=4)
off.hide_set(True)
moving = lamp("POINT", "Moving")
moving.keyframe_insert("location", frame=1)
moving.location = (1, 0, 0)
moving.keyframe_insert("location", frame=10)
bpy.ops.mesh.primitive_cube_add()
cube = bpy.context.object
cube.name = "Smooth"
cube.modifiers.new("s", "SUBSURF").render_levels = 2
image = bpy.data.images.new("packed", 4, 4)
image.pixels = [0.5] * 64
image.pack()
surface = bpy.data.materials.new("Packed")
surface.use_nodes = True
nodes = surface.node_tree
texture = nodes.nodes.new("ShaderNodeTexImage")
texture.image = image
nodes.links.new(texture.outputs["Color"], nodes.nodes["Principled BSDF"].inputs["Base Color"])
cube.data.materials.append(surface)
world = bpy.data.worlds.new("w")
bpy.context.scene.world = world
world.use_nodes = True
background = world.node_tree.nodes["Background"]
background.inputs["Color"].default_value = (0.2, 0.4, 0.8, 1)
background.inputs["Strength"].default_value = 0.5
for name, kind in (("Flat", "ORTHO"), ("Shifted", "PERSP"), ("Round", "PANO")):
    lens = bpy.data.cameras.new(name)
    lens.type = kind
    lens.ortho_scale = 7
    lens.shift_x, lens.shift_y = (0.1, 0.2) if name == "Shifted" else (0, 0)
    bpy.context.collection.objects.link(bpy.data.objects.new(name, lens))
bpy.context.scene.camera = bpy.data.objects["Shifted"]
bpy.context.scene.frame_end = 10
bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 200, 100
bpy.context.scene.render.resolution_percentage = 50
bpy.ops.wm.save_as_mainfile(filepath=folder + "/odd.blend")
"""


@pytest.fixture(scope="module")
def odd(blender, tmp_path_factory):
    folder = tmp_path_factory.mktemp("odd")
    (folder / "odd.py").write_text(ODD)
    run(blender, folder / "odd.py", folder)
    return folder / "odd.blend"


@pytest.fixture(scope="module")
def odd_scene(odd):
    return load_scene(odd)


@pytest.mark.slow
def test_nothing_of_a_blend_file_is_lost_without_a_note(odd_scene):
    notes = "\n".join(f"{note.kind}: {note.where}: {note.text}" for note in odd_scene.notes)
    for line in (
        "approximated: Ellipse: an ellipse",
        "left out: Narrow: its spread of 57°",
        "left out: Round: a panoramic camera",
        "left out: Moving: its motion",
        "approximated: Strong sun: a source 1.15° wide",
    ):
        assert line in notes


@pytest.mark.slow
def test_blenders_watts_become_radiance(odd_scene):
    content = odd_scene.content
    red, green, blue = content["light Warm"]["emitter"]["radiance"]["value"]
    # W / (4 π² r²), in the colour of 3000 K as Cycles has it.
    assert (red, green, blue) == pytest.approx(
        np.array([1.771, 0.844, 0.272]) * 40 / (4 * np.pi * 0.25), rel=2e-3
    )
    assert content["light Strong sun"]["irradiance"]["value"] == pytest.approx([3] * 3)
    assert content["world"]["radiance"]["value"] == pytest.approx([0.1, 0.2, 0.4])
    assert "light Not rendered" not in content
    assert "light Hidden in the viewport only" in content


@pytest.mark.slow
def test_modifiers_are_applied_and_packed_images_are_there(odd_scene):
    smooth = next(entry for name, entry in odd_scene.content.items() if name.startswith("root/Smooth"))
    assert len(smooth["faces"]) == 6 * 4**2 * 2
    image = next(entry for entry in odd_scene.content.values() if entry["type"] == "image")
    assert bytes(image["encoded"][1:4]) == b"PNG"


@pytest.mark.slow
def test_cameras_of_a_blend_file_are_chosen_by_name(odd, odd_scene):
    assert (odd_scene.width, odd_scene.height) == (100, 50)
    assert odd_scene.sensor["principal_point_offset_x"] == pytest.approx(0.1)
    assert odd_scene.sensor["principal_point_offset_y"] == pytest.approx(-0.4)  # of the height, downward
    flat = load_scene(odd, sensor="Flat")
    assert flat.sensor["scale"][0] == pytest.approx(3.5)
    with pytest.raises(SettingsError, match=r"'Round' is not a camera .* it has 1 \(Flat\), 2 \(Shifted\)"):
        load_scene(odd, sensor="Round")


@pytest.mark.slow
def test_images_outside_the_folder_need_a_flag(room, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "textures").symlink_to(room / "textures")
    moved = tmp_path / "scene" / "room.blend"
    moved.write_bytes((room / "room.blend").read_bytes())
    with pytest.raises(SceneError, match=r"files are missing: .*Fliesen hell\.png"):
        load_scene(moved)
    (tmp_path / "scene" / "textures").symlink_to(room / "textures")
    with pytest.raises(SceneError, match=r"refers to .*, outside the scene's folder; .* --allow-outside"):
        load_scene(moved)
    assert load_scene(moved, allow_outside=True).frames == 25


@pytest.fixture
def blend(tmp_path):
    """What begins as a .blend file."""
    path = tmp_path / "room.blend"
    path.write_bytes(b"BLENDER-v500" + bytes(100))
    return path


def program(folder, text):
    made = folder / "blender"
    made.write_text(f"#!/bin/sh\n{text}\n")
    made.chmod(made.stat().st_mode | stat.S_IXUSR)
    return str(made)


def test_without_blender_the_message_says_what_to_do(blend, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(
        BackendError, match=f"room.blend: is read through Blender, which was not found; .*{VARIABLE}"
    ):
        load_scene(blend)


def test_a_blender_that_is_not_there_is_named(blend, monkeypatch):
    monkeypatch.setenv(VARIABLE, "/nowhere/blender")
    with pytest.raises(BackendError, match="/nowhere/blender: cannot be started: No such file"):
        load_scene(blend)


def test_what_blender_cannot_read_gives_its_own_reason(blend, tmp_path, monkeypatch):
    monkeypatch.setenv(
        VARIABLE, program(tmp_path, "echo Read blend; echo Error: file is newer than this Blender; exit 1")
    )
    with pytest.raises(SceneError, match=r"room\.blend: Blender cannot export it: Error: file is newer"):
        load_scene(blend)


def test_what_is_no_blend_file_is_never_given_to_blender(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, program(tmp_path, f"touch {tmp_path}/called"))
    (tmp_path / "room.blend").write_text("hello")
    with pytest.raises(SceneError, match=r"is not a \.blend file"):
        load_scene(tmp_path / "room.blend")
    assert not (tmp_path / "called").exists()
