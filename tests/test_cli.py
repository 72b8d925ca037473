"""The command line: what it prints, its exit codes, and that nothing is left behind by bad input."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import steadylight
from steadylight import cli
from steadylight.animation import run as run_module
from steadylight.cache.file import CacheFile, encode_cache, encode_points
from steadylight.cache.records import Records
from steadylight.cli import rendering
from steadylight.errors import BackendError
from steadylight.images import write_exr
from steadylight.quality import quality_word
from steadylight.renderers.base import Backend
from steadylight.renderers.mitsuba.plugin import RENDERER
from steadylight.storage import RunDirectory

SMALL = ("render", "furnace", "--size", "16x8", "--frames", "4", "--cluster", "in-process", "--output", "out")


def fake_perform(task, *, directory, scene_hash, stop_at="", black=()):
    """Tasks without a renderer; `stop_at` is where the user presses Ctrl-C, `black` are frames without light."""
    if task.key == stop_at:
        raise KeyboardInterrupt
    run = RunDirectory(directory)
    path = run.root / task.outputs[0]
    if path.suffix == ".exr":
        write_exr(path, np.full((8, 16, 3), 0.1 * task.arguments["frames"][0], np.float32))
    elif path.suffix == ".points":
        path.write_bytes(
            encode_points(*np.zeros((2, 0, 3), np.float32), *np.zeros((3, 0), np.float32), scene_hash)
        )
    else:
        path.write_bytes(encode_cache(CacheFile(Records.empty(), scene_hash, {})))
    result = {"hits": 9, "misses": 1, "records": 2, "looked_up": 100, "missed": 0, "seconds": 0.1}
    if task.stage == "shade":
        result["black"] = int(task.arguments["frames"][0] in black)
    run.write_result(task.key, result)
    return result


@pytest.fixture
def steady(steady, monkeypatch, tmp_path):
    """Give a command in an empty folder, with tasks that take no time; see `conftest.steady`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RENDERER, "check", lambda *_, **__: Backend("llvm_ad_rgb", {}), raising=False)

    def give(*arguments, stop_at="", black=()):
        def worker_call(session, _engine):
            scene = session.request.scene
            return partial(
                fake_perform,
                directory=session.directory.root,
                scene_hash=scene.hash,
                stop_at=stop_at,
                black=black,
            )

        monkeypatch.setattr(run_module.Session, "_worker_call", worker_call)
        return steady(*arguments)

    return give


def test_render_ends_with_frames_video_and_report(steady):
    code, out, _ = steady(*SMALL)
    assert code == 0
    assert "Done: 4 frames" in out
    assert all(
        Path("out", name).is_file() for name in ("frames/frame_00004.exr", "animation.mp4", "report.html")
    )


def test_without_a_terminal_progress_is_plain_lines_for_each_pass(steady):
    _, out, _ = steady(*SMALL)
    assert "first pass: 4 tasks to do" in out
    assert "first pass: 4 of 4 tasks, 90% hits, 8 records" in out
    assert "coverage: 3 of 3 tasks, 300 paths audited, 0 misses, 2 records added" in out
    assert "second pass: 4 of 4 frames, 0 misses" in out
    assert "\x1b[" not in out


def test_a_film_without_a_shared_cache_has_one_pass_of_frames(steady):
    _, out, _ = steady(*SMALL, "--mode", "path")
    assert "frames: 4 of 4 frames, " in out
    assert "pass:" not in out
    assert "miss" not in out


def test_on_a_terminal_progress_is_a_bar_for_each_pass(steady, monkeypatch):
    from rich.console import Console

    monkeypatch.setattr(rendering, "out", Console(force_terminal=True, width=120))
    code, out, _ = steady(*SMALL)
    assert code == 0
    assert all(name in out for name in ("first pass", "coverage", "second pass", "90% hits", "4/4"))


def test_black_frames_are_told_of_at_once_and_all_of_them_at_the_end(steady):
    code, out, _ = steady(*SMALL, black=(2, 3))
    assert code == 0
    during, end = out.split("Done:")
    assert during.count("Warning: frame 2 is black: no light reaches what the camera sees.") == 1
    assert during.count("black") == 1
    assert "frames 2-3 are black: no light reaches what the camera sees." in end
    assert json.loads(Path("out/stats.json").read_text())["second_pass"]["black_frames"] == [2, 3]


def test_a_film_that_is_lit_says_nothing_of_black_frames(steady):
    _, out, _ = steady(*SMALL)
    assert "black" not in out
    assert json.loads(Path("out/stats.json").read_text())["second_pass"]["black_frames"] == []


def test_ctrl_c_says_how_to_go_on_and_the_same_command_does(steady):
    code, _, err = steady(*SMALL, stop_at="shade-00003")
    assert code == 130
    assert "9 of 11 tasks are done" in err
    assert "steadylight render furnace --size 16x8" in err
    code, out, _ = steady(*SMALL)
    assert code == 0
    assert "Resuming out: 9 of 11 tasks done, 2 left" in out


def test_invalid_files_are_named_when_a_run_goes_on(steady):
    steady(*SMALL)
    Path("out/frames/frame_00002.exr").write_bytes(b"half a frame")
    _, out, _ = steady(*SMALL)
    assert "frame_00002.exr is not valid" in out
    assert "10 of 11 tasks done, 1 left" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("furnace", "--frames", "0"), "--frames: '0' is not valid"),
        (("furnace", "--frames", "9-3"), "--frames"),
        (("furnace", "--frames", "400"), "frames"),
        (("furnace", "--size", "0x5"), "give width x height in pixels, each from 1 to 16384"),
        (("furnace", "--spp", "-1"), "--spp: -1 is not valid"),
        (("furnace", "--spp", "many"), "--spp"),
        (("furnace", "--mode", "three-pass"), "--mode"),
        (("furnace", "--selected-frames", "none"), "auto, workers or a positive"),
        (
            ("furnace", "--cache-parts", "some"),
            "--cache-parts: 'some' is not valid; give auto or a positive",
        ),
        (("furnace", "--cache-parts", "0"), "--cache-parts: 0 is not valid"),
        (
            ("furnace", "--cache-parts", "4", "--coverage", "off"),
            "--cache-parts: 4 needs --mode two-pass",
        ),
        (("furnace", "--cluster", "abacus"), "abacus"),
        (("furnace", "--renderer", "candle"), "--renderer: there is no 'candle'; installed: mitsuba"),
        (("furnace", "--sky", "sky.rad"), "sky.rad: no such sky file"),
        (("furnace", "--sensor", "2"), "--sensor: 2: only for .xml, .gltf, .glb"),
        (("furnace", "-D", "spp=4", "-D", "a=b"), "-D: {'spp': '4', 'a': 'b'}: only for .xml scenes"),
        (("furnace", "-D", "spp"), "-D: ['spp'] is not valid"),
        (("furnace", "--colour", "red"), "--colour"),
        (("furnace", "--camera", "missing.toml"), "missing.toml: no such camera file"),
        (("furnase",), "did you mean `furnace`"),
        (("missing.xml",), "missing.xml"),
        (("furnace", "--frames", "+-4"), "--frames: '+-4' is not valid"),
        (("furnace", "--frames", "9" * 5000), "--frames"),
        (("furnace", "--size", "9" * 5000 + "x4"), "--size"),
        (("furnace", "--fps", "1e4"), "--fps: 10000.0 is not valid"),
        (("furnace", "--watch", "--prepare-only"), "--watch: has no effect with --prepare-only"),
        ((), "argument"),
    ],
)
def test_bad_input_says_what_is_right_exits_with_2_and_leaves_nothing(steady, arguments, words):
    code, _, err = steady("render", *arguments)
    assert code == 2
    assert words.lower() in err.lower()
    assert "Traceback" not in err
    assert not list(Path().iterdir())


def test_other_settings_on_the_same_directory_exit_with_2(steady):
    steady(*SMALL)
    code, _, err = steady(*SMALL, "--spp", "4")
    assert code == 2
    assert "--spp: was 16, is now 4" in err


def test_a_run_directory_may_have_brackets_and_colons_in_its_name(steady):
    code, out, err = steady(*SMALL[:-1], "with [/b] or :100:")
    assert code == 0, err
    assert "Rendering into with [/b] or :100:" in out
    code, out, _ = steady("compare", "with [/b] or :100:", "with [/b] or :100:")
    assert code == 0
    assert "[/b]" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--html", "--region", "0.0,0.0,0.5,0.5"), "--region has no effect with --html"),
        (("--html", "--json"), "--json has no effect with --html"),
        (("--html", "--reference-b", "a"), "--reference-b has no effect with --html"),
        (("--html", "--plot", "a.png"), "--plot has no effect with --html"),
        (("--output", "a.html"), "--output has no effect without --html"),
    ],
)
def test_compare_refuses_options_that_it_would_not_heed(steady, words, said):
    code, _, err = steady("compare", "a", "b", *words)
    assert code == 2
    assert said in " ".join(err.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--times", "run"), "--times: only with --simulate"),
        (("--nodes", "3"), "--nodes: only with --simulate"),
        (("--simulate", "--queue-wait", "inf"), "--queue-wait"),
        (("--simulate", "--start", "nan"), "--start"),
    ],
)
def test_a_simulation_takes_only_what_it_can_use(steady, words, said):
    code, _, err = steady("plan", "furnace", *words)
    assert code == 2
    assert said in err


def test_without_output_each_input_has_a_directory_of_its_own_and_the_same_command_finds_it(steady):
    words = SMALL[:-2]
    for more, directory in (((), ""), (("--spp", "4"), "-2"), (("--size", "8x6", "--frames", "1"), "-3")):
        code, out, _ = steady(*words, *more, "--workers", "2", stop_at="gather-000")
        assert code == 130
        assert f"Rendering into runs/furnace-two-pass{directory}: " in out
    code, out, _ = steady(*words, "--spp", "4")
    assert code == 0
    assert "Resuming runs/furnace-two-pass-2: " in out
    assert Path("runs/furnace-two-pass-2/animation.mp4").exists()
    title = Path("runs/furnace-two-pass-2/report.html").read_text(encoding="utf-8")
    assert "<h1>furnace</h1>" in title


def test_a_default_directory_that_cannot_be_read_is_not_passed_over(steady):
    steady(*SMALL[:-2])
    Path("runs/furnace-two-pass/run.json").write_text("{}")
    code, _, err = steady(*SMALL[:-2])
    assert code == 2
    assert "run.json" in err


def test_a_machine_without_a_backend_gets_a_sentence_and_exit_code_1(steady, monkeypatch):
    def refuse(*_, **__):
        raise BackendError("no usable LLVM library was found: install LLVM 16 or newer")

    monkeypatch.setattr(RENDERER, "check", refuse)
    code, _, err = steady(*SMALL)
    assert code == 1
    assert err.strip() == "Error: no usable LLVM library was found: install LLVM 16 or newer"
    assert not Path("out").exists()


def test_a_failing_task_exits_with_1_and_says_where_to_look(steady, monkeypatch):
    def fail(*_, **__):
        raise ValueError("no light today")

    monkeypatch.setitem(globals(), "fake_perform", fail)
    code, out, err = steady(*SMALL)
    assert code == 1
    assert "no light today" in out + err
    assert "Traceback" not in err
    code, _, err = steady("--debug", *SMALL)
    assert code == 1
    assert "Traceback" in err


def test_an_error_nobody_thought_of_is_a_sentence_too(steady, monkeypatch):
    monkeypatch.setattr(rendering, "_request", lambda *_: 1 / 0)
    code, _, err = steady(*SMALL)
    assert code == 1
    assert "unexpected error, please report it: ZeroDivisionError" in err
    assert "Traceback" not in err


def test_plan_shows_tasks_and_cost_and_writes_nothing(steady):
    words = ("plan", "furnace", "--size", "16x8", "--frames", "1-7:2", "--output", "out")
    code, out, _ = steady(*words)
    assert code == 0
    assert "4: 1, 3, 5, 7" in out
    assert "1 prepare, 1 look, 1 gather, 1 merge, 1 audit, 1 fill, 1 smooth, 4 shade" in out
    code, out, _ = steady(*words, "--first-pass", "frames")
    assert "selected frames" in out
    assert "1 prepare, 2 gather, 1 merge, 2 audit, 2 fill, 1 smooth, 4 shade" in out
    assert not list(Path().iterdir())


def test_the_cost_is_said_at_the_start_and_in_the_plan(steady):
    _, out, _ = steady("plan", "gallery")
    assert re.search(r"time +about \d+ h \d\d min on \d+ cores?, within a factor of three", out)  # by a probe
    assert re.search(r"memory +about 2\.7 GB of memory for each worker", out)
    assert re.search(r"disk +about 6\.9 GB of disk space for the frames", out)
    _, out, _ = steady(*SMALL)
    assert re.search(
        r"Rough cost: about .* s on .*; about 0\.5 GB of memory .*; about 0\.0 MB of disk space", out
    )
    _, out, _ = steady(*SMALL)
    assert "Rough cost" not in out  # nothing is left


class TestALongRun:
    """The default film of a scene may take a day: a person is asked, a script is not."""

    FILM = ("render", "furnace", "--cluster", "in-process", "--output", "out")

    @pytest.fixture(autouse=True)
    def any_run_is_long(self, monkeypatch):
        monkeypatch.setattr(rendering, "_LONG_RUN", 0.0)

    @pytest.fixture
    def at_a_terminal(self, monkeypatch):
        monkeypatch.setattr(rendering, "work_on", lambda session: pytest.fail("it was started"))
        monkeypatch.setattr(rendering.sys, "stdin", io.StringIO("n\n"))

    def test_is_confirmed_at_a_terminal(self, steady, at_a_terminal, monkeypatch):
        monkeypatch.setattr(rendering, "_at_a_terminal", lambda: True)
        code, out, err = steady(*self.FILM)
        assert code == 130
        assert "8 frames at 64x64: about" in out
        assert "--frames 12 --size 512x384" in out
        assert "Stopped. Nothing was written." in err
        assert not Path("out").exists()

    @pytest.mark.parametrize("more", [("--frames", "8"), ("--size", "64x64")])
    def test_is_not_confirmed_where_its_length_or_size_was_given(self, steady, monkeypatch, more):
        monkeypatch.setattr(rendering, "_at_a_terminal", lambda: True)
        monkeypatch.setattr(rendering, "work_on", lambda session: (_ for _ in ()).throw(KeyboardInterrupt))
        _, out, _ = steady(*self.FILM, *more)
        assert "Render all of it?" not in out

    def test_of_a_minute_is_not_confirmed(self, steady, monkeypatch):
        monkeypatch.setattr(rendering, "_LONG_RUN", 60.0)
        monkeypatch.setattr(rendering, "_at_a_terminal", lambda: True)
        monkeypatch.setattr(rendering, "work_on", lambda session: (_ for _ in ()).throw(KeyboardInterrupt))
        _, out, _ = steady(*self.FILM)
        assert "Render all of it?" not in out

    def test_is_not_confirmed_in_a_script(self, steady, monkeypatch):
        monkeypatch.setattr(rendering, "work_on", lambda session: (_ for _ in ()).throw(KeyboardInterrupt))
        _, out, _ = steady(*self.FILM)
        assert "Render all of it?" not in out


def test_every_option_is_on_the_command_line_with_the_default_of_the_python_functions():
    import inspect

    for command in (rendering.render, rendering.plan):
        parameters = inspect.signature(command).parameters
        for name, parameter in inspect.signature(steadylight.plan).parameters.items():
            word = quality_word(parameter.default) if name == "quality" else parameter.default
            assert parameters[name].default == ([] if word == {} else word)


def test_scenes_lists_every_bundled_scene_with_frames_and_size(steady):
    code, out, _ = steady("scenes")
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == list(steadylight.scenes.BUNDLED)
    assert "91 frames   1024x768" in out


def test_version_is_that_of_the_package(steady):
    assert steady("--version") == (0, f"steadylight {steadylight.__version__}\n", "")


def test_compare_prints_a_table_and_draws_a_picture(steady):
    steady(*SMALL)
    steady(*SMALL[:-1], "other", "--mode", "path")
    code, out, _ = steady("compare", "out", "other", "--region", "0.0,0.0,0.5,1.0")
    assert code == 0
    assert out.index("brightness_ratio") < out.index("rel_rmse")
    assert "brightness: the second run is as bright as the first run" in out
    assert "noise: the first run has about 0.0% of its own (estimated)" in out
    assert "overshoot" in out
    assert Path("compare-out-other.png").read_bytes().startswith(b"\x89PNG")


def test_compare_as_json_is_json(steady):
    steady(*SMALL)
    code, out, _ = steady("compare", "out", "out", "--reference", "out", "--json", "--plot", "p.png")
    assert code == 0
    assert json.loads(out)["a"]["mean"]["rel_rmse"] == 0
    assert Path("p.png").exists()


def test_report_is_written_again(steady):
    steady(*SMALL)
    Path("out/report.html").unlink()
    code, out, _ = steady("report", "out")
    assert code == 0
    assert Path(out.strip()).is_file()


@pytest.mark.parametrize("command", [("report", "x"), ("compare", "x", "y"), ("cache", "info", "x")])
def test_commands_on_what_is_not_there_exit_with_2(steady, command):
    code, _, err = steady(*command)
    assert code == 2
    assert "x" in err


def cache(path, positions, scene="a" * 64):
    arrays = {name: np.ones((len(positions), *shape), np.float32) for name, shape in Records.SHAPES.items()}
    arrays["position"] = np.array(positions, np.float32).reshape(-1, 3)
    arrays["normal"] = np.tile(np.float32([0, 0, 1]), (len(positions), 1))
    Path(path).write_bytes(encode_cache(CacheFile(Records(**arrays), scene, {})))


def test_cache_info_tells_records_and_bounds(steady):
    cache("a.safetensors", [(0, 0, 0), (3, 4, 5)])
    code, out, _ = steady("cache", "info", "a.safetensors")
    assert code == 0
    assert "records          2" in out
    assert "(0, 0, 0) to (3, 4, 5) m" in out
    assert "mean irradiance  (1, 1, 1) W/m²" in out


def test_a_file_that_is_no_cache_by_its_name_is_refused_with_the_names_that_are(steady):
    for arguments in (("info", "a.txt"), ("diff", "a.txt", "b.txt"), ("merge", "a.txt", "-o", "m")):
        code, _, err = steady("cache", *arguments)
        assert code == 2
        assert "a.txt: does not have the extension of a cache file" in err
        assert ".safetensors (mitsuba)" in err


def test_caches_of_two_renderers_neither_merge_nor_compare(steady):
    for arguments in (("diff", "a.safetensors", "b.amb"), ("merge", "a.safetensors", "b.amb", "-o", "m")):
        code, _, err = steady("cache", *arguments)
        assert code == 2
        assert "b.amb: belongs to a different renderer than a.safetensors" in err


def test_cache_merge_joins_and_does_not_replace_unasked(steady):
    cache("a.safetensors", [(0, 0, 0)])
    cache("b.safetensors", [(30, 0, 0)])
    code, out, _ = steady("cache", "merge", "a.safetensors", "b.safetensors", "--output", "c.safetensors")
    assert (code, out) == (0, "c.safetensors: 2 records, merged from 2\n")
    code, _, err = steady("cache", "merge", "a.safetensors", "--output", "c.safetensors")
    assert code == 2
    assert "--force" in err
    assert steady("cache", "merge", "a.safetensors", "--output", "c.safetensors", "--force")[0] == 0


def test_cache_merge_refuses_caches_of_other_scenes(steady):
    cache("a.safetensors", [(0, 0, 0)])
    cache("b.safetensors", [(0, 0, 0)], scene="b" * 64)
    code, _, err = steady("cache", "merge", "a.safetensors", "b.safetensors", "-o", "c.safetensors")
    assert code == 2
    assert "b.safetensors: made for another scene" in err
    assert not Path("c.safetensors").exists()


def test_cache_diff_is_0_for_the_same_records_in_any_order(steady):
    cache("a.safetensors", [(0, 0, 0), (3, 4, 5)])
    cache("b.safetensors", [(3, 4, 5), (0, 0, 0)])
    cache("c.safetensors", [(3, 4, 5), (0, 0, 0.5)])
    cache("d.safetensors", [(3, 4, 5)])
    assert steady("cache", "diff", "a.safetensors", "b.safetensors")[0] == 0
    code, out, _ = steady("cache", "diff", "a.safetensors", "c.safetensors")
    assert code == 1
    assert re.search(r"largest difference of position +0\.5\n", out)
    assert steady("cache", "diff", "a.safetensors", "d.safetensors")[0] == 1


LIGHT = {"mitsuba", "drjit", "dask", "distributed", "scipy", "matplotlib", "trimesh", "av", "bokeh"}
"""Libraries that take long to load, beside NumPy."""


@pytest.mark.parametrize(
    ("words", "absent"),
    [
        (("render", "--help"), LIGHT | {"numpy"}),
        (("--version",), LIGHT | {"numpy"}),
        (("scenes",), LIGHT | {"numpy"}),
        (("cache", "info", "a.safetensors"), LIGHT),
        ((*SMALL, "--spp", "4"), LIGHT - {"scipy"}),
    ],
)
def test_short_commands_load_no_heavy_library(steady, tmp_path, words, absent):
    if words[0] == "cache":
        cache("a.safetensors", [(0, 0, 0)])
    if words[0] == "render" and "--help" not in words:
        steady(*SMALL)
    script = (
        "import sys; from steadylight.cli import app; from steadylight.errors import SteadylightError\n"
        f"try: app({list(words)})\n"
        "except (SystemExit, SteadylightError) as end: print(end)\n"
        f"print('loaded:', sorted({absent} & set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert "loaded: []" in said.stdout
    assert words[0] != "render" or "--help" in words or "--spp: was 16, is now 4" in said.stdout


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("can't start new thread"), OSError(errno.ENOMEM, "Cannot allocate memory")],
)
def test_a_command_without_enough_memory_says_so(error, monkeypatch, capsys):
    def run_out():
        raise error

    monkeypatch.setattr(cli, "app", run_out)
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr().err
    assert end.value.code == 1
    assert "not enough memory for the command itself" in said
    assert "unexpected" not in said


@pytest.mark.parametrize(
    ("error", "where"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "what this command prints, or a temporary file"),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "/tmp/a"), "/tmp/a"),
    ],
)
def test_a_full_disk_elsewhere_than_in_the_output_is_no_unexpected_error(error, where, monkeypatch, capsys):
    def fill_up():
        raise error

    monkeypatch.setattr(cli, "app", fill_up)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert f"Error: {where}: no space left on device; make room" in capsys.readouterr().err
