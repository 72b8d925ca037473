"""The command `walk`, and what `plan` says of a camera path."""

from __future__ import annotations

import pytest

from small_film import CAMERA
from steadylight.camera import load_camera


def test_a_walk_is_written_and_can_be_rendered(said, folder):
    words = (
        "walk",
        "room.xml",
        "--output",
        "way.toml",
        "--through",
        "-0.5,-0.6,-1",
        "0.3,-0.6,-1",
        "--eye",
        "0.8",
        "--fps",
        "5",
    )
    code, answer = said(*words, "--clearance", "0.1", "--speed", "0.3")
    assert code == 0, answer
    assert "way.toml: 0.8 m in " in answer
    assert "Camera path: clear of all surfaces" in answer
    path, fps = load_camera(folder / "way.toml")
    assert fps == 5
    assert path.keyframes[0].origin[2] == pytest.approx(-0.2, abs=0.01)
    assert path.keyframes[0].fov == pytest.approx(60, abs=1e-3)
    code, answer = said("plan", "room.xml", "--camera", "way.toml")
    assert code == 0, answer
    assert "Camera path: clear of all surfaces" in answer
    assert said(*words)[1].startswith("Error: --output: way.toml: exists already")


def test_a_path_through_a_wall_is_warned_of(said, folder):
    (folder / "out.toml").write_text(CAMERA.replace("[0.4, -0.7, 0.1]", "[0.4, -1.7, 0.1]"))
    code, answer = said("plan", "room.xml", "--camera", "out.toml")
    assert code == 0, answer
    assert "Warning: camera path: frames 1-2: the camera passes through a surface" in answer


def test_an_orbit_needs_no_file_and_files_may_count_from_0(said, folder):
    code, answer = said("plan", "room.xml", "--orbit", "scene", "--frames", "3", "--size", "32x24")
    assert code == 0, answer
    (folder / "a.csv").write_text("frame,x,y,z,dx,dy,dz\n0,0,-0.9,0.2,0,1,0\n5,0.2,-0.8,0.2,0,1,0\n")
    code, answer = said("plan", "room.xml", "--camera", "a.csv")
    assert code == 2
    assert "a.csv: line 2: `frame` is 0: this file counts its frames from 0" in answer
    code, answer = said("plan", "room.xml", "--camera", "a.csv", "--first-frame", "0")
    assert code == 0, answer
    assert "frames 6: 1, 2, 3, 4, 5, 6" in answer


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--through", "1,2,0"), "--through: a walk needs at least two points"),
        ((), "walk: give either --through with at least two points, or --rooms"),
        (("--through", "1,2,0 3,4"), "--through: '3,4' is not a point; give x,y,z in metres"),
        (("--through", "1,2,0 3,4,x"), "`--through` is 'x', not a number"),
        (("--thorugh", "1,2,0"), "--thorugh: no such option"),
        (("--rooms", "--start", "1"), "--start: '1' is not a point"),
        (("--rooms", "--upright", "w"), "--upright: 'w' is not valid; give x, y, z, -x, -y, -z"),
        (("--rooms", "--output", "walk.json"), "--output: walk.json: a walk is a keyframe file"),
        (("--rooms", "--eye", "0"), "--eye: 0.0 is not valid; input should be greater than 0.3"),
        (("--rooms", "--fps", "inf"), "--fps: inf is not valid; input should be a finite number"),
        (("--through", "0,0,9", "0,0,10"), "point 1 (0,0,9): there is no place to stand within 0.75 m"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_is_written(said, folder, words, message):
    (folder / "walk.toml").unlink()
    code, answer = said("walk", "room.xml", *words)
    assert code == 2, answer
    assert message in answer
    assert not list(folder.glob("walk*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--orbit", "radius=2", "--camera", "walk.toml"), "--orbit: not together with --camera"),
        (("--orbit", "radios=2"), "--orbit: `radios=2` is not valid; did you mean `radius`?"),
        (("--first-frame", "0"), "--first-frame: only for a camera file; give --camera too"),
    ],
)
def test_camera_options_that_cannot_be(said, words, message):
    code, answer = said("plan", "room.xml", *words)
    assert code == 2, answer
    assert message in answer
