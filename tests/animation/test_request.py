"""The request: what the user may write, what is filled in, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from steadylight.animation import request
from steadylight.animation.parsing import parse_frames, parse_size
from steadylight.animation.request import default_directory, prepare, scene_title
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, InputError, SceneError, SettingsError
from steadylight.renderers.base import Capabilities
from steadylight.scenes.description import SceneDescription

WALK = CameraPath(
    (Keyframe(0.0, (0, 0, 0), (1, 0, 0)), Keyframe(1.0, (1, 0, 0), (2, 1, 0)))
)  # 26 frames at 25 fps
STILL = CameraPath((Keyframe(0.0, (0, 0, 0), (1, 0, 0)),))


def scene(camera=WALK, **changes):
    values = {"name": "plain", "content": {}, "width": 8, "height": 6, "frames": 5, **changes}
    return SceneDescription(camera=camera, **values)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        (3, (1, 2, 3)),
        ("3", (1, 2, 3)),
        ("30-33", (30, 31, 32, 33)),
        ("7-7", (7,)),
        ("1-91:45", (1, 46, 91)),
        ("9,1, 5", (1, 5, 9)),
        ("1-3,2-4", (1, 2, 3, 4)),
        ([5, 2, 5], (2, 5)),
    ],
)
def test_frames_are_a_number_ranges_or_lists(text, numbers):
    assert parse_frames(text) == numbers


@pytest.mark.parametrize(
    "text",
    [0, "0", -1, "-3", "+", "", "a", "1-", "5-3", "1-9:0", "0-3", "1,,2", "1.5", [], [0], [1.5], True, 10**9],
)
def test_wrong_frames_say_what_is_right(text):
    with pytest.raises(SettingsError, match=r"--frames: .* is not valid: .*such as 24"):
        parse_frames(text)


@pytest.mark.parametrize(
    ("size", "pair"), [("512x288", (512, 288)), ("1X2", (1, 2)), (" 3 × 4 ", (3, 4)), ((5, 6), (5, 6))]
)
def test_size_is_width_by_height(size, pair):
    assert parse_size(size) == pair


@pytest.mark.parametrize("size", ["0x5", "5", "axb", "-1x5", "5x5x5", "70000x2", (5, 0), (1, 2, 3), (1.5, 2)])
def test_a_wrong_size_says_what_is_right(size):
    with pytest.raises(SettingsError, match=r"--size: .* is not valid; give width x height"):
        parse_size(size)


def test_what_is_left_out_comes_from_the_scene():
    asked = prepare(scene(fps=25.0))
    assert asked.settings.frames == (1, 2, 3, 4, 5)
    assert (asked.settings.width, asked.settings.height) == (8, 6)
    assert asked.settings.fps == 25.0
    assert asked.directory == Path("runs/plain-two-pass")


def test_another_rate_shows_the_same_stretch_of_the_path():
    assert prepare(scene(frames=26), fps=50.0).settings.frames == tuple(range(1, 52))


def test_a_camera_of_the_users_is_shown_whole():
    asked = prepare(scene(STILL), camera=WALK)
    assert len(asked.settings.frames) == 26
    assert asked.scene.camera == WALK


def test_a_camera_file_brings_its_rate(tmp_path):
    file = tmp_path / "walk.toml"
    file.write_text(
        "fps = 10\n[[keyframes]]\ntime = 0\norigin = [0, 0, 0]\ntarget = [1, 0, 0]\n"
        "[[keyframes]]\ntime = 2\norigin = [1, 0, 0]\ntarget = [2, 1, 0]\n"
    )
    assert prepare(scene(), camera=file).settings.frames == tuple(range(1, 22))
    assert prepare(scene(), camera=str(file), fps=5).settings.frames == tuple(range(1, 12))


def test_frames_beyond_the_end_of_the_path_say_how_many_there_are():
    with pytest.raises(CameraError, match="26 frames"):
        prepare(scene(), frames="20-30")


def test_a_still_camera_has_as_many_frames_as_wanted():
    assert len(prepare(scene(STILL), frames=100).settings.frames) == 100


def test_selected_frames_are_numbers_of_the_film_within_the_chosen_ones():
    asked = prepare(scene(), frames="10-18", first_pass="frames")
    assert asked.settings.selected_frames == 3
    assert asked.selected[0] == 10
    assert asked.selected[-1] == 18


def test_records_are_made_by_surfaces_unless_something_asks_for_frames():
    asked = prepare(scene(), frames="10-18")
    assert (asked.settings.first_pass, asked.settings.selected_frames, asked.selected) == ("surface", 1, ())
    for published in (
        {"selected_frames": 2},
        {"threshold": 5.0},
        {"base_rays": 64},
        {"coverage": "off"},
        {"first_pass": "frames"},
        {"mode": "single-pass"},
    ):
        assert prepare(scene(), **published).settings.first_pass == "frames"


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"coverage": "off"}, "--first-pass: surface needs --mode two-pass, --coverage full"),
        (
            {"selected_frames": 2},
            "--first-pass: surface cannot be combined with --selected-frames; give frames",
        ),
    ],
)
def test_surfaces_with_what_belongs_to_frames_are_an_error(other, message):
    with pytest.raises(SettingsError, match=message):
        prepare(scene(), first_pass="surface", **other)


def test_workers_choose_the_selected_frames_only_when_asked():
    assert prepare(scene(), workers=4).settings == prepare(scene(), workers=1).settings
    assert prepare(scene(), workers=4, selected_frames="workers").settings.selected_frames == 4
    assert prepare(scene(), selected_frames="2").settings.selected_frames == 2


@pytest.mark.parametrize("mode", ["single-pass", "path"])
def test_modes_without_a_shared_cache_select_no_frames(mode):
    asked = prepare(scene(), mode=mode)
    assert asked.selected == ()
    assert {task.stage for task in asked.tasks} == {"shade"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": -1}, "--spp: -1"),
        ({"mode": "three-pass"}, "--mode: 'three-pass'"),
        ({"fps": 0}, "--fps: 0"),
        ({"fps": float("nan")}, "--fps: nan"),
        ({"seed": -1}, "--seed: -1"),
        ({"workers": 0}, "--workers: 0"),
        ({"selected_frames": "some"}, "--selected-frames: 'some'"),
        ({"selected_frames": 0}, "--selected-frames: 0"),
        ({"threshold": 0}, "--threshold: 0"),
    ],
)
def test_a_wrong_setting_is_named_with_its_value(options, message):
    with pytest.raises(SettingsError, match=message):
        prepare(scene(), **options)


@pytest.mark.parametrize("options", [{"mode": "single-pass"}, {"mode": "path"}, {"coverage": "off"}])
def test_only_a_cache_that_is_shared_and_final_has_parts(options):
    with pytest.raises(SettingsError, match=r"--cache-parts: 4 needs --mode two-pass, --coverage full"):
        prepare(scene(), cache_parts=4, **options)


def test_an_option_that_there_is_not_is_a_type_error_as_of_any_function():
    with pytest.raises(TypeError, match="colour"):
        prepare(scene(), colour="red")


class Lamp:
    """A renderer that reads one format and can do little."""

    name = "lamp"
    capabilities = Capabilities(("wick",), ("two-pass", "single-pass"))


@pytest.fixture
def lamp(monkeypatch):
    monkeypatch.setattr(request, "find_renderer", lambda _: Lamp())


def test_a_scene_in_a_format_that_the_renderer_does_not_read_names_one_that_does(lamp):
    message = "renderer lamp does not read format `mitsuba`; use .*--renderer mitsuba"
    with pytest.raises(SceneError, match=message):
        prepare(scene(), renderer="lamp")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"mode": "path"},
            "--mode: path is not available with --renderer lamp; give two-pass or single-pass",
        ),
        ({"denoise": True}, "--denoise: not available with --renderer lamp"),
        ({"cache_parts": 2}, "--cache-parts: 2 needs --mode two-pass"),
    ],
)
def test_what_the_renderer_cannot_do_is_refused(lamp, options, message):
    with pytest.raises(SettingsError, match=message):
        prepare(scene(format="wick"), **options)


def test_a_renderer_without_an_audit_makes_a_run_without_coverage(lamp):
    asked = prepare(scene(format="wick"))
    assert asked.settings.coverage == "off"
    assert {task.stage for task in asked.tasks} == {"gather", "merge", "shade"}


def test_a_renderer_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(SettingsError, match=r"--renderer: there is no 'candle'; installed: .*mitsuba"):
        prepare(scene(), renderer="candle")


def test_a_sky_is_for_scenes_by_name():
    for given, words in (("gallery", r"sky\.rad: no such sky file"), (scene(), "--sky: .*scene files")):
        with pytest.raises(InputError, match=words):
            prepare(given, sky="sky.rad")


def test_an_unknown_scene_is_refused():
    with pytest.raises(SceneError, match="nowhere"):
        prepare("nowhere")


@pytest.mark.parametrize(
    ("given", "title"),
    [
        ("gallery", "gallery"),
        ("kitchen/scene.xml", "kitchen/scene"),
        ("/films/office/office.rad", "office"),
        ("/scene.xml", "scene"),
        ("scene.xml", "here/scene"),
    ],
)
def test_a_scene_file_is_titled_with_its_folder(given, title, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert scene_title(given) == title


def test_a_run_at_a_url_is_named_without_its_password():
    remote = dataclasses.replace(prepare(scene()), url="sftp://me:secret@host/run")
    assert remote.place == "sftp://me:***@host/run"
    assert "secret" not in repr(remote) + remote._repr_html_()


@pytest.mark.parametrize(
    ("name", "directory"),
    [("a b/c", "runs/a-b-c-path"), ("../../x", "runs/x-path"), (".hidden", "runs/hidden-path")],
)
def test_the_default_directory_is_a_plain_name_under_runs(name, directory):
    assert default_directory(name, "path") == Path(directory)
