"""Radiance's scene files become one frozen octree, with the files that it refers to."""

from __future__ import annotations

import dataclasses
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest

from steadylight.errors import SceneError
from steadylight.scenes import load_scene
from steadylight.scenes.archive import read_archive, write_archive
from steadylight.scenes.radiance.programs import output_of

pytestmark = pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")

PLATE = "void plastic grey 0 0 5 .5 .5 .5 0 0\ngrey polygon plate 0 0 9 0 0 0 4 0 0 0 4 0\n"
SKY = "void glow light 0 0 4 1 1 1 0\nlight source sky 0 0 4 0 0 1 180\n"
SUN = "void light light 0 0 3 1 1 1\nlight source sun 0 0 4 0 0 1 .5\n"
PATTERN = "void brightfunc stripes 2 shade stripes.cal 0 0\nstripes plastic striped 0 0 5 .5 .5 .5 0 0\n"


load_octree = partial(load_scene, formats=("radiance",))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "plate.rad").write_text(PLATE)
    (tmp_path / "sky.rad").write_text(SKY)
    return tmp_path


def test_a_scene_with_its_sky_is_an_octree_and_knows_that_it_glows(folder):
    alone = load_octree(folder / "plate.rad")
    under = load_octree(folder / "plate.rad", sky=folder / "sky.rad")
    assert alone.format == "radiance"
    assert bytes(alone.content["octree"][:10]) == b"#?RADIANCE"
    assert not alone.content["sky"]
    assert under.content["sky"]
    assert alone.hash != under.hash
    assert under.hash == load_octree(folder / "plate.rad", sky=folder / "sky.rad").hash


def test_a_sun_alone_costs_no_bounce(folder):
    (folder / "sun.rad").write_text(SUN)
    assert not load_octree(folder / "plate.rad", sky=folder / "sun.rad").content["sky"]


def test_an_octree_is_read_and_a_frozen_one_counts_as_under_a_sky(folder):
    (folder / "plate.oct").write_bytes(output_of(folder, "oconv", "plate.rad"))
    scene = load_octree(folder / "plate.oct")
    assert not scene.content["sky"]
    assert scene.hash == load_octree(folder / "plate.rad").hash
    # Frozen: the files that it was made of may go.
    (folder / "plate.rad").unlink()
    (folder / "again.oct").write_bytes(scene.content["octree"].tobytes())
    again = load_octree(folder / "again.oct")
    assert again.content["octree"].size > 100
    assert again.content["sky"]


def test_commands_in_the_files_of_an_octree_are_never_run_by_radiance(folder):
    (folder / "trap.rad").write_text(PLATE)
    (folder / "trap.oct").write_bytes(output_of(folder, "oconv", "trap.rad"))
    (folder / "trap.rad").write_text(f"{PLATE}!touch x\n")
    with pytest.raises(SceneError, match=r"trap\.rad: line 3: `touch` is not run"):
        load_octree(folder / "trap.oct")
    (folder / "house.rad").write_text(f"{PLATE}void instance house 1 trap.oct 0 0\n")
    with pytest.raises(
        SceneError, match=r"trap\.rad: line 3: an octree was made from this .* freeze the octree"
    ):
        load_octree(folder / "house.rad")
    assert not (folder / "x").exists()
    (folder / "trap.rad").write_text(PLATE)
    assert set(load_octree(folder / "house.rad").content["files"]) == {"trap.oct", "trap.rad"}


@pytest.mark.parametrize("formats", [("radiance",), ("mitsuba",)])
@pytest.mark.parametrize("name", ["{}/beyond.dat", "../beyond.dat", "inside/../../beyond.dat", "link.dat"])
def test_data_outside_the_folder_are_refused_and_with_leave_they_are_read(folder, formats, name):
    beyond = folder / "beyond.dat"
    beyond.write_text("1 0 1 2 1 1\n")
    (folder / "scene" / "inside").mkdir(parents=True)
    (folder / "scene" / "link.dat").symlink_to(beyond)
    file = folder / "scene" / "striped.rad"
    pattern = f"void brightdata stripes 4 noop {name.format(folder)} . Px\n0\n0\n"
    file.write_text(f"{pattern}stripes plastic grey 0 0 5 .5 .5 .5 0 0\n{PLATE.splitlines()[1]}\n")
    with pytest.raises(SceneError, match=r"striped\.rad: line 1: .*beyond\.dat lies outside|link\.dat lies"):
        load_scene(file, formats=formats)
    scene = load_scene(file, formats=formats, allow_outside=True)
    assert list(scene.files) == ([] if formats == ("mitsuba",) else [str(beyond)])


@pytest.mark.parametrize("formats", [("radiance",), ("mitsuba",)])
def test_an_octree_that_names_a_command_is_refused_and_runs_nothing(folder, formats):
    command = b"!touch x"
    octree = output_of(folder, "oconv", "sky.rad")
    (folder / "trap.oct").write_bytes(octree.replace(b"\0sky.rad\0", b"\0" + command + b"\0"))
    assert command in (folder / "trap.oct").read_bytes()
    with pytest.raises(SceneError, match=r"trap\.oct: was made from the output of a command"):
        load_scene(folder / "trap.oct", formats=formats)
    # An instance brings it in by its name.
    (folder / "house.rad").write_text(PLATE + "void instance house 1 trap.oct 0 0\n")
    with pytest.raises(SceneError, match=r"trap\.oct: was made from the output of a command"):
        load_scene(folder / "house.rad", sky=folder / "sky.rad", formats=formats)
    assert not (folder / "x").exists()


def test_files_that_it_refers_to_are_hashed_and_travel(folder):
    (folder / "stripes.cal").write_text("shade = .5;\n")
    (folder / "striped.rad").write_text(PATTERN + PLATE.replace("grey polygon", "striped polygon"))
    scene = load_octree(folder / "striped.rad")
    assert scene.content["files"] == {"stripes.cal": str(folder / "stripes.cal")}
    assert list(scene.files) == [str(folder / "stripes.cal")]
    write_archive(folder / "scene.zip", scene, with_files=True)
    moved = read_archive(folder / "scene.zip")
    assert moved.hash == scene.hash
    (folder / "stripes.cal").write_text("shade = .6;\n")
    assert load_octree(folder / "striped.rad").hash != scene.hash


def test_the_view_beside_a_scene_is_its_camera(folder):
    (folder / "plate.vf").write_text("rvu -vtv -vp 1 2 3 -vd 0 0 -1 -vu 0 1 0 -vh 50 -vv 40\n")
    (key,) = load_octree(folder / "plate.rad").camera.keyframes
    assert (key.origin, key.target, key.up, key.fov) == ((1, 2, 3), (1, 2, 2), (0, 1, 0), 50)
    (folder / "plate.vf").write_text("rvu -vp 1 2\n")
    with pytest.raises(SceneError, match=r"plate\.vf: line 1: `-vp` needs 3 numbers"):
        load_octree(folder / "plate.rad")


def test_without_a_view_the_whole_scene_is_seen_from_outside(folder):
    (key,) = load_octree(folder / "plate.rad").camera.keyframes
    assert np.linalg.norm(np.subtract(key.origin, key.target)) > 4
    assert dataclasses.astuple(key)[0] == 0.0


def test_faults_are_told_with_the_file(folder):
    with pytest.raises(SceneError, match=r"missing\.rad: no such scene file"):
        load_octree(folder / "missing.rad")
    (folder / "wrong.rad").write_text("void plastic grey 0 0 5 .5 .5\n")
    with pytest.raises(SceneError, match=r"wrong\.rad: line 1: plastic `grey`: the file ends within it"):
        load_octree(folder / "wrong.rad")
    with pytest.raises(SceneError, match=r"nosky\.rad: no such scene file"):
        load_octree(folder / "plate.rad", sky=folder / "nosky.rad")
