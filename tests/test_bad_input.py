"""Whatever is wrong with the input: a message that helps, exit code 2, and nothing left behind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import pytest

from small_film import CAMERA, SCENE, command, render, write_film
from steadylight.cache.file import VERSION, CacheFile, encode_cache, read_cache


@pytest.fixture
def refused(steady, folder):
    """Give a command that must be refused; returns the message, in one line."""

    def give(*arguments):
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        code, _, message = steady(*arguments)
        assert code == 2, message
        after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        assert after == before
        assert {path for path in folder.rglob("*") if path.is_dir()} == {path.parent for path in after} - {
            folder
        }
        return " ".join(message.split())

    return give


class TestScenes:
    def test_missing(self, refused):
        assert "rooms.xml: no such scene file" in refused("render", "rooms.xml")

    def test_a_misspelt_bundled_name(self, refused):
        assert "furnase: no such scene; did you mean `furnace`?" in refused("render", "furnase")

    def test_a_folder(self, refused, folder):
        (folder / "a.xml").mkdir()
        (folder / "a.xml/keep").touch()
        assert "a.xml: cannot be read: Is a directory" in refused("render", "a.xml")

    @pytest.mark.parametrize(
        ("right", "wrong", "message"),
        [
            ("</transform>", "", r"line \d+, column \d+: not valid XML: .*close inner elements"),
            (SCENE, "", r"line 1, column 1: not valid XML: the file is empty, or ends before"),
            (
                '"sphere"',
                '"shpere"',
                r"line 9, column 4: .*no shape plugin `shpere`; did you mean `sphere`\?",
            ),
            ('"diffuse"', '"zzz"', r"line 7, column 4: .*no bsdf plugin `zzz`; see Mitsuba's documentation"),
            ('<ref id="clay"', '<ref id="slay"', r"line 8, column \d+: unresolved reference to \"slay\""),
            ('value="8"', 'value="eight"', r"line 16, column \d+: could not parse .*\"eight\""),
        ],
    )
    def test_a_fault_in_the_file_is_named_with_its_place(self, refused, folder, right, wrong, message):
        assert right in SCENE
        (folder / "wrong.xml").write_text(SCENE.replace(right, wrong, 1))
        said = refused("render", "wrong.xml", "--output", "out")
        assert re.search(r"/wrong\.xml: " + message, said), said


class TestCameras:
    @pytest.mark.parametrize(
        ("right", "wrong", "message"),
        [
            ("target = [-0.2, 1, -0.1]", "", "keyframe 2: `target` missing"),
            ("time = 1\n", "", "keyframe 2: `time` (seconds) or `frame` (counted from 1) missing"),
            (
                "origin = [0.4",
                "orgin = [0.4",
                "keyframe 2: `orgin` is not a valid key; did you mean `origin`?",
            ),
            (CAMERA[CAMERA.rindex("[[") :], "", "has 1 keyframe; a camera path needs at least two"),
            ("[0.4, -0.7", "[nan, -0.7", "keyframe 2: `origin` is nan; it must be a finite number"),
            (
                "time = 1",
                "time = 1\nup = [-0.6, 1.7, -0.2]",
                "keyframe 2: `up` [-0.6, 1.7, -0.2] is zero, or parallel to the view from `origin` to",
            ),
            ("fps = 3", "fps = 0", "`fps` is 0; it must be greater than 0"),
            ("fps = 3", "fps = ", "is not valid TOML: Invalid value (at line 2, column 7)"),
        ],
    )
    def test_a_fault_in_the_file_is_named_with_its_place(self, refused, folder, right, wrong, message):
        assert right in CAMERA
        (folder / "wrong.toml").write_text(CAMERA.replace(right, wrong, 1))
        said = refused("render", "room.xml", "--camera", "wrong.toml")
        assert f"Error: wrong.toml: {message}" in said

    def test_missing(self, refused):
        assert "a.toml: no such camera file" in refused("render", "room.xml", "--camera", "a.toml")


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--frames", "0", "an animation has at least one frame; give a number such as 24"),
        ("--frames", "9", "--frames: frame 5 is beyond the end of the camera path"),
        ("--size", "0x5", "give width x height in pixels, each from 1 to 16384, such as 1024x768"),
        ("--spp", "-1", "--spp: -1 is not valid; input should be greater than 0"),
        ("--fps", "nan", "--fps: nan is not valid; input should be a finite number"),
        ("--cluster", "abacus", "--cluster abacus: not supported; give `local`, `in-process`"),
    ],
)
def test_a_wrong_setting_is_named_with_what_is_right(refused, option, value, message):
    said = refused("render", "room.xml", "--camera", "walk.toml", option, value, "--output", "out")
    assert message.removeprefix("--frames: ") in said


def test_a_denoiser_that_is_not_installed_is_asked_for(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    given = ("render", "room.xml", "--camera", "walk.toml", "--denoise", "--output", "out")
    for cluster in ("in-process", "local"):
        assert f"`{sys.executable} -m pip install pyoidn`" in refused(*given, "--cluster", cluster)


def test_a_process_of_its_own_says_the_same(folder):
    before = sorted(folder.iterdir())
    given = [sys.executable, "-m", "steadylight", "render", "rooms.xml"]
    done = subprocess.run(given, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 2
    assert done.stderr == f"Error: {folder}/rooms.xml: no such scene file\n"
    assert sorted(folder.iterdir()) == before


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """A run of the room, and a cache file of another scene."""
    films = tmp_path_factory.mktemp("films")
    write_film(films)
    render(films, "room", "--frames", "1", "--cluster", "in-process")
    cache = read_cache(films / "room/cache/merged.safetensors")
    (films / "foreign.safetensors").write_bytes(encode_cache(CacheFile(cache.records, "f" * 64, {})))
    return films


class TestFilesOfARun:
    @pytest.fixture
    def here(self, films, folder):
        shutil.copytree(films, folder, dirs_exist_ok=True)
        return folder

    def again(self, *more, output="room", scene="room.xml"):
        """The arguments that the run in `room` was started with, and more."""
        given = command(output, "--frames", "1", scene=scene)
        return (*given[3:], *more)

    def test_another_scene_in_the_same_directory(self, refused, here):
        (here / "hall.xml").write_text(SCENE.replace('value="8"', 'value="9"'))
        said = refused(*self.again(scene="hall.xml"))
        assert "room: was started with different input: scene: was room, is now hall" in said
        assert "choose another directory with --output" in said

    def test_other_settings_in_the_same_directory(self, refused, here):
        said = refused(*self.again("--seed", "5", "--spp", "4"))
        assert "--spp: was 2, is now 4" in said
        assert "--seed: was 0, is now 5" in said

    def test_a_scene_file_that_has_changed(self, refused, here):
        (here / "room.xml").write_text(SCENE.replace('value="8"', 'value="9"'))
        assert "scene: room has changed" in refused(*self.again())

    def test_a_directory_of_something_else(self, refused, here):
        said = refused(*self.again(output="."))
        assert "not a run directory" in said
        assert "choose a new or empty folder" in said

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda content: content[:700], "truncated"),
            (lambda content: b"", "truncated"),
            (lambda content: content[:-9] + bytes(9), "damaged"),
            (
                lambda content: content.replace(
                    b'\\"version\\": %d}' % VERSION, b'\\"version\\": %d}' % (VERSION + 1)
                ),
                f"version {VERSION + 1}, this steadylight reads version {VERSION}",
            ),
        ],
    )
    def test_a_damaged_cache_file(self, refused, here, damage, message):
        good = here / "room/cache/merged.safetensors"
        (here / "bad.safetensors").write_bytes(damage(good.read_bytes()))
        for verb in (("info",), ("merge", "-o", "m.safetensors", good), ("diff", good)):
            said = refused("cache", *verb, "bad.safetensors")
            assert said.startswith("Error: bad.safetensors: ")
            assert message in said

    def test_caches_of_two_scenes_do_not_merge(self, refused, here):
        files = ("room/cache/merged.safetensors", "foreign.safetensors")
        said = refused("cache", "merge", "-o", "m.safetensors", *files)
        assert f"{files[1]}: made for another scene" in said
        assert "merge caches of one scene only" in said

    def test_caches_of_two_scenes_differ(self, steady, here):
        code, said, _ = steady("cache", "diff", "room/cache/merged.safetensors", "foreign.safetensors")
        assert code == 1
        assert "caches differ" in said


class TestFullDisk:
    @pytest.fixture
    def disk(self, tmp_path):
        """A real small disk; returns its folder, and a function that gives it another size."""
        if os.geteuid() != 0 or not shutil.which("mount"):
            pytest.skip("mounting a small disk needs root")
        disk = tmp_path / "disk"
        disk.mkdir()
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", disk],
            capture_output=True,
            text=True,
            check=False,
        )
        if mounted.returncode:
            pytest.skip(f"mounting a small disk is not permitted: {mounted.stderr.strip()}")
        yield disk
        subprocess.run(["umount", "--lazy", disk], check=True)

    def test_a_full_disk_ends_with_2_and_the_same_command_goes_on_when_there_is_room(self, disk, tmp_path):
        write_film(tmp_path)
        given = command(disk / "run", "--frames", "2", "--cluster", "in-process")
        for size, left in (
            ("4k", set()),
            ("100k", {"frames", "cache", "log", "run.json", "scene.zip", "display.json"}),
        ):
            subprocess.run(["mount", "-o", f"remount,size={size}", disk], check=True)
            done = subprocess.run(
                given, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
            )
            assert done.returncode == 2, done.stdout + done.stderr
            assert f"Error: {disk}/run/" in done.stderr
            assert "no space left on device: make room and run the same command again" in done.stderr
            assert "Traceback" not in done.stderr
            assert {path.name for path in disk.glob("run/*")} == left
            assert not list(disk.rglob(".partial-*"))
        subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
        said = render(tmp_path, disk / "run", "--frames", "2", "--cluster", "in-process")
        assert "Resuming" in said
        assert len(list(disk.glob("run/frames/*.exr"))) == 2


NO_TEXT = os.fsdecode(b"caf\xe9")
"""A file name that is not UTF-8."""


class TestNamesAndPlaces:
    """Names and places that no file can have are the user's to change, not an unexpected error."""

    FURNACE = ("furnace", "--frames", "1", "--size", "16x8", "--cluster", "in-process")

    @pytest.mark.parametrize(
        ("output", "words"),
        [
            (NO_TEXT, "is not valid UTF-8; choose another name"),
            ("a" * 300, "file name too long; choose another output"),
            ("/proc/steadylight", "/proc/steadylight: cannot be written: no such file or directory; choose"),
        ],
    )
    def test_an_output_that_cannot_be_made(self, refused, output, words):
        assert words in refused("render", *self.FURNACE, "--output", output)

    @pytest.mark.parametrize("name", [f"{NO_TEXT}.xml", f"{NO_TEXT}/room.xml"])
    def test_a_scene_file_whose_name_is_not_text(self, refused, folder, name):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(SCENE)
        assert "is not valid UTF-8, which the libraries that read scenes require; rename it" in refused(
            "render", name
        )

    def test_frames_in_a_folder_whose_name_is_not_text(self, refused, folder):
        (folder / NO_TEXT).mkdir()
        (folder / NO_TEXT / "frame_1.exr").touch()
        assert "its name is not valid UTF-8, which reading EXR files requires; rename it" in refused(
            "compare", NO_TEXT, NO_TEXT
        )

    def test_a_cache_over_a_folder(self, refused, folder, films):
        cache = films / "room/cache/merged.safetensors"
        (folder / "taken").mkdir()
        (folder / "taken/file").touch()
        assert "taken: cannot be written: a folder has this name" in refused(
            "cache", "merge", cache, "--output", "taken", "--force"
        )

    def test_plan_refuses_what_render_would_refuse(self, refused, folder, films):
        shutil.copytree(films, folder, dirs_exist_ok=True)
        given = command("room", "--frames", "1", "--spp", "4")[4:]
        assert "--spp: was 2, is now 4" in refused("plan", *given)
        (folder / "film.txt").write_text("someone's")
        given = command(".", "--frames", "1")[4:]
        assert "not a run directory: it contains film.txt" in refused("plan", *given)
        (folder / "dark.xml").write_text(SCENE.replace("area", "unknown"))
        assert "unknown" in refused("plan", "dark.xml", "--output", "new")

    def test_a_simulation_without_times_asks_for_a_run_that_has_them(self, refused, folder, films):
        shutil.copytree(films, folder, dirs_exist_ok=True)
        given = ("plan", *command("new", "--frames", "1")[4:], "--simulate")
        assert "new has no task times, since it was not rendered yet; give --times RUN" in refused(*given)
        said = refused(*given, "--mode", "single-pass", "--times", "room")
        assert "room: was rendered with --mode two-pass; give a run with --mode single-pass" in said
