"""The run: what it leaves on disk, how it goes on, and what it refuses. The renderer here is a fake."""

from __future__ import annotations

import dataclasses
import inspect
import json
from importlib import import_module

import numpy as np
import pytest
from fake_tasks import SCENE, FakeRenderer, names, prepared, rendered, session

import steadylight
from steadylight.animation import provenance
from steadylight.animation.provenance import read_run
from steadylight.animation.request import prepare
from steadylight.checksum import with_checksum, without_checksum
from steadylight.errors import RunError, SceneError, SettingsError, StorageError, TaskFailed
from steadylight.images import read_exr
from steadylight.scenes.archive import read_archive
from steadylight.storage import RunDirectory


def test_a_run_leaves_everything_in_its_directory(tmp_path):
    run = rendered(tmp_path / "out", frames=3)
    files = names(tmp_path / "out")
    assert {"run.json", "scene.zip", "stats.json", "animation.mp4", "report.html"} <= files
    assert {"cache/merged.cache", "cache/filled_1.cache", "log/tasks.jsonl"} <= files
    assert [path.name for path in run.frames] == [f"frame_0000{n}.exr" for n in (1, 2, 3)]
    assert not [name for name in files if ".partial" in name]
    assert read_exr(run.frames[1])[0, 0, 0] == np.float32(0.2)


def test_statistics_add_up_what_the_tasks_reported(tmp_path):
    statistics = rendered(tmp_path / "out", frames=4, selected_frames=2).statistics
    assert with_checksum(statistics) == json.loads((tmp_path / "out/stats.json").read_text())
    assert statistics["selected_frames"] == [1, 4]
    assert statistics["frames"] == 4
    assert statistics["first_pass"].items() >= {"rays": 512, "hits": 400, "misses": 40, "records": 40}.items()
    assert statistics["merge"].items() >= {"records_in": 60, "records_out": 50}.items()
    assert (
        statistics["coverage"].items() >= {"rounds": 2, "looked_up": 2000, "missed": 6, "records": 8}.items()
    )
    assert statistics["second_pass"].items() >= {"missed": 4, "new_records": 8}.items()
    assert statistics["second_pass"]["firefly_loss"] == 0.25  # the mean of the frames
    assert statistics["second_pass"]["frame_seconds"] == [0.25] * 4
    assert statistics["tasks"] == {
        "done": 13,
        "attempts": 13,
        "failed": 0,
        "lost": 0,
        "causes": {},
        "hosts_avoided": [],
    }
    assert statistics["makespan_s"] > 0


def test_statistics_leave_out_what_the_mode_does_not_have(tmp_path):
    without_audit = rendered(tmp_path / "off", frames=2, coverage="off").statistics
    assert "coverage" not in without_audit
    single = rendered(tmp_path / "single", frames=2, mode="single-pass").statistics
    assert not {"first_pass", "merge", "coverage"} & single.keys()
    assert single["selected_frames"] == []


def test_run_json_records_all_that_decides_the_bytes(tmp_path):
    rendered(tmp_path / "out", frames="2-4", seed=7)
    content = json.loads((tmp_path / "out/run.json").read_text())
    assert content["settings"]["seed"] == 7
    assert content["scene"] == {
        "name": "plain",
        "hash": SCENE.hash,
        "source": "plain (described in Python)",
        "title": "plain",
        "notes": [],
    }
    assert content["variant"] == "llvm_ad_rgb"
    assert len(content["camera"]["keyframes"]) == 2
    assert content["settings"]["renderer"] == "mitsuba"
    assert content["constants"] == {"accuracy": 0.1}
    assert {"steadylight", "lamp", "numpy", "python"} == content["versions"].keys()
    assert {"cpu", "isa"} <= content["host"].keys()
    record = read_run(RunDirectory(tmp_path / "out"))
    assert record.settings.frames == (2, 3, 4)
    assert record.camera == SCENE.camera


def test_a_package_that_only_an_option_brings_is_told_by_the_option(tmp_path):
    denoised = FakeRenderer(versions={"lamp": "1.0", "filter": "2.5"})
    rendered(tmp_path / "out", frames=2, denoise=True, renderer=denoised)
    with (
        pytest.raises(SettingsError, match="--denoise: was True, is now False") as told,
        session(tmp_path / "out", frames=2),
    ):
        pass
    assert "filter" not in str(told.value)
    denoised.versions = {"lamp": "1.0", "filter": "2.6"}
    with (
        pytest.raises(SettingsError, match=r"filter: was version 2\.5, is now 2\.6"),
        session(tmp_path / "out", frames=2, denoise=True, renderer=denoised),
    ):
        pass


def test_a_run_of_before_there_was_an_option_goes_on_as_if_it_had_been_left_out(tmp_path):
    rendered(tmp_path / "out", frames=2)
    content = json.loads((tmp_path / "out/run.json").read_text())
    del content["settings"]["denoise"], content["settings"]["radii"], content["sha256"]
    (tmp_path / "out/run.json").write_text(json.dumps(content | {"format": 2}))
    with session(tmp_path / "out", frames=2) as again:
        assert again.resumed
    for changed, message in (
        ({"denoise": True}, "--denoise: was False, is now True"),
        ({"radii": "split-sphere"}, "--radii: was occlusion-hessian, is now split-sphere"),
    ):
        with pytest.raises(SettingsError, match=message), session(tmp_path / "out", frames=2, **changed):
            pass


def test_a_quality_that_stands_for_something_else_now_is_refused(tmp_path):
    rendered(tmp_path / "out", frames=2)
    other = FakeRenderer(constants={"accuracy": 0.5})
    with (
        pytest.raises(SettingsError, match=r"--quality normal: was .*0\.1.*, is now .*0\.5"),
        session(tmp_path / "out", frames=2, renderer=other),
    ):
        pass


def test_workers_find_the_scene_with_the_path_of_this_run(tmp_path):
    with session(tmp_path / "out", frames=2):
        scene = read_archive(tmp_path / "out/scene.zip")
    assert scene.hash == SCENE.hash
    assert scene.camera == SCENE.camera


def test_an_interrupted_run_goes_on_with_what_is_left(tmp_path):
    with session(tmp_path / "out", frames=4) as first:
        done = [attempt.task.key for attempt, _ in zip(first, range(3), strict=False)]
    with session(tmp_path / "out", frames=4) as second:
        assert second.resumed
        assert not {task.key for task in second.waiting} & set(done)
        assert not second.faults
        for _ in second:
            pass
        statistics = second.finish().statistics
    assert statistics["tasks"]["attempts"] == statistics["tasks"]["done"] == 11
    assert [entry["outcome"] for entry in statistics["sessions"]] == ["stopped", "done"]
    total = sum(entry["seconds"] for entry in statistics["sessions"])
    assert statistics["makespan_s"] == pytest.approx(total)


def test_a_finished_run_has_nothing_left_and_adds_no_session(tmp_path):
    before = rendered(tmp_path / "out", frames=2).statistics
    assert rendered(tmp_path / "out", frames=2).statistics == before


def test_a_frame_cut_short_is_named_and_rendered_again(tmp_path):
    run = rendered(tmp_path / "out", frames=3)
    whole = run.frames[1].read_bytes()
    run.frames[1].write_bytes(whole[: len(whole) // 2])
    with session(tmp_path / "out", frames=3) as again:
        assert [task.key for task in again.waiting] == ["shade-00002"]
        assert "frame_00002.exr" in again.faults[0]
        for _ in again:
            pass
        again.finish()
    assert run.frames[1].read_bytes() == whole


def test_a_cache_of_another_scene_is_named_and_made_again(tmp_path):
    rendered(tmp_path / "a", frames=2)
    other = dataclasses.replace(SCENE, content={"light": {"type": "constant"}})
    rendered(tmp_path / "b", frames=2, scene=other)
    stray = (tmp_path / "b/cache/merged.cache").read_bytes()
    (tmp_path / "a/cache/merged.cache").write_bytes(stray)
    with session(tmp_path / "a", frames=2) as again:
        assert [task.key for task in again.waiting] == ["merge"]
        assert "another scene" in again.faults[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spp": 8}, "--spp: was 16, is now 8"),
        ({"frames": 3}, "--frames: was 1, 2, is now 1, 2, 3"),
        ({"size": "8x8"}, "--size: was 16x8, is now 8x8"),
        ({"mode": "path"}, "--mode: was two-pass, is now path"),
        ({"quality": "draft"}, "--quality: was normal, is now draft"),
        ({"renderer": FakeRenderer(variant="cuda_ad_rgb")}, "--variant: was llvm_ad_rgb, is now cuda_ad_rgb"),
        ({"scene": dataclasses.replace(SCENE, name="other", content={"a": 1})}, "was plain, is now other"),
        ({"scene": dataclasses.replace(SCENE, content={"a": 1})}, "plain has changed"),
        ({"camera": dataclasses.replace(SCENE.camera, keyframes=SCENE.camera.keyframes[:1])}, "--camera"),
    ],
)
def test_other_settings_on_the_same_directory_are_refused_by_name(tmp_path, change, message):
    rendered(tmp_path / "out", frames=2)
    before = {name: (tmp_path / "out" / name).read_bytes() for name in names(tmp_path / "out")}
    options = {"frames": 2, **change}
    with pytest.raises(SettingsError, match=message), session(tmp_path / "out", **options):
        pass
    assert {name: (tmp_path / "out" / name).read_bytes() for name in names(tmp_path / "out")} == before


def test_another_version_of_the_renderer_is_refused(tmp_path):
    rendered(tmp_path / "out", frames=2)
    newer = FakeRenderer(versions={"lamp": "9.9.9"})
    with (
        pytest.raises(SettingsError, match=r"lamp: was version 1\.0, is now 9\.9\.9"),
        session(tmp_path / "out", frames=2, renderer=newer),
    ):
        pass


def test_another_version_of_an_incidental_package_is_not(tmp_path, monkeypatch):
    rendered(tmp_path / "out", frames=2)
    real = provenance.version
    monkeypatch.setattr(provenance, "version", lambda name: "9.9.9" if name == "numpy" else real(name))
    with session(tmp_path / "out", frames=2) as again:
        assert again.resumed


def test_the_scene_is_built_to_check_it_when_a_run_starts_and_not_when_it_goes_on(tmp_path):
    renderer = FakeRenderer()
    rendered(tmp_path / "out", frames=2, renderer=renderer)
    assert renderer.built == [True]
    rendered(tmp_path / "out", frames=2, renderer=renderer)
    assert renderer.built == [True, False]


def test_host_and_working_directory_do_not_keep_a_run_from_going_on(tmp_path, monkeypatch):
    rendered(tmp_path / "out", frames=2)
    monkeypatch.setattr(provenance, "describe_host", lambda: {"cpu": "another", "isa": []})
    monkeypatch.chdir(tmp_path)
    with session("out", frames=2) as again:
        assert again.resumed
        assert not again.waiting


def test_the_number_of_workers_at_the_start_is_kept_when_it_chose_the_frames(tmp_path):
    rendered(tmp_path / "out", frames=9, workers=3, selected_frames="workers")
    with session(tmp_path / "out", frames=9, workers=1, selected_frames="workers") as again:
        assert again.request.settings.selected_frames == 3


def test_the_parts_of_the_cache_are_kept_with_the_run_and_surveyed_once(tmp_path):
    with session(tmp_path / "out", frames=9, cache_parts=3) as first:
        content = json.loads((tmp_path / "out/run.json").read_text())
        assert content["survey"] == {
            "windows": [[0, 1], [0, 1]],
            "neighbours": [[1], [0, 2], [1]],
            "details": {"planes": 2},
        }
        assert read_run(RunDirectory(tmp_path / "out")).survey == first.request.survey
        next(iter(first))
    again = FakeRenderer()
    statistics = rendered(tmp_path / "out", frames=9, cache_parts=3, renderer=again).statistics
    assert again.surveys == []
    assert json.loads((tmp_path / "out/run.json").read_text()) == content
    files = names(tmp_path / "out/cache")
    assert {"merged.cache", "merged_002.cache", "filled_1_000.cache"} <= files
    assert statistics["coverage"]["rounds"] == 1
    assert statistics["coverage"]["records"] == 3 * 4  # of each part
    assert statistics["merge"]["records_out"] == 3 * 50
    with pytest.raises(SettingsError, match="--cache-parts: was 3, is now 2"):
        rendered(tmp_path / "out", frames=9, cache_parts=2)


def test_a_plan_in_the_folder_of_another_animation_is_surveyed_anew(tmp_path):
    rendered(tmp_path / "out", frames=9, cache_parts=3)
    renderer = FakeRenderer()
    for options in ({"seed": 1}, {"cache_parts": 2}, {"frames": 8}, {}):
        given = {"frames": 9, "cache_parts": 3, **options}
        request = prepared(output=tmp_path / "out", renderer=renderer, **given)
        assert request.survey.parts == given["cache_parts"]
    assert len(renderer.surveys) == 3


def test_a_run_in_parts_without_its_survey_is_refused(tmp_path):
    rendered(tmp_path / "out", frames=2, cache_parts=3)
    content = without_checksum(json.loads((tmp_path / "out/run.json").read_text()))
    for wrong in (None, {"windows": []}, {**content["survey"], "windows": [["a"]]}):
        (tmp_path / "out/run.json").write_text(json.dumps(with_checksum({**content, "survey": wrong})))
        with (
            pytest.raises(SettingsError, match="is not a run of this version"),
            session(tmp_path / "out", frames=2, cache_parts=3),
        ):
            pass


def test_a_survey_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    def refuse(*_):
        raise SceneError("no emitter")

    monkeypatch.setattr(FakeRenderer, "survey", refuse)
    with pytest.raises(SceneError), session(tmp_path / "out", frames=2, cache_parts=2):
        pass
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("words")
    with pytest.raises(SettingsError, match=r"thesis\.tex"), session(tmp_path, frames=2):
        pass
    assert names(tmp_path) == {"thesis.tex"}


def test_a_damaged_run_file_is_refused(tmp_path):
    rendered(tmp_path / "out", frames=2)
    (tmp_path / "out/run.json").write_text('{"format": 2}')
    with pytest.raises(SettingsError, match=r"run\.json"), session(tmp_path / "out", frames=2):
        pass
    (tmp_path / "out/run.json").write_text(json.dumps(with_checksum({"format": 99})))
    with pytest.raises(SettingsError, match="format 99"), session(tmp_path / "out", frames=2):
        pass


def test_a_scene_that_cannot_be_rendered_leaves_nothing_behind(tmp_path):
    refusing = FakeRenderer(fault=SceneError("no emitter"))
    with pytest.raises(SceneError), session(tmp_path / "out", frames=2, renderer=refusing):
        pass
    assert not (tmp_path / "out").exists()


def test_a_start_on_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(_):
        raise StorageError("no space is left")

    opened = session(tmp_path / "out", frames=2)
    monkeypatch.setattr(opened, "_write_scene", lambda: full(None))
    with pytest.raises(StorageError), opened:
        pass
    assert not (tmp_path / "out").exists()


def test_a_task_that_keeps_failing_ends_the_run_and_keeps_what_is_done(tmp_path):
    with (
        pytest.raises(TaskFailed, match="shade-00002"),
        session(tmp_path / "out", frames=3, failing=("shade-00002",)) as opened,
    ):
        for _ in opened:
            pass
    assert (tmp_path / "out/cache/merged.cache").exists()
    statistics = rendered(tmp_path / "out", frames=3).statistics
    assert statistics["tasks"]["failed"] == 3
    assert statistics["sessions"][0]["outcome"] == "failed"


def test_a_run_with_tasks_left_is_not_finished(tmp_path):
    with session(tmp_path / "out", frames=2) as opened, pytest.raises(RunError, match="not done"):
        opened.finish()


def test_two_commands_do_not_work_in_one_directory(tmp_path):
    with (
        session(tmp_path / "out", frames=2),
        pytest.raises(SettingsError, match="another steadylight"),
        session(tmp_path / "out", frames=2),
    ):
        pass


def test_render_takes_what_plan_takes():
    parameters = inspect.signature(steadylight.render).parameters
    assert parameters == inspect.signature(prepare).parameters
    assert import_module("steadylight").plan is prepare
