"""Tasks that a render farm performs one by one end in the same run as a render, and bad ones are named."""

from __future__ import annotations

import json
import shutil

import pytest
from fake_tasks import FakeRenderer, prepared, rendered, session
from typer.testing import CliRunner

from steadylight.animation import farm, tasks
from steadylight.animation.farm import FINISH, FarmRun, number_of, step_of
from steadylight.animation.notes import gather_notes
from steadylight.animation.run import Session
from steadylight.cli import app
from steadylight.engines import Task
from steadylight.errors import BackendError, InputError, RunError, SettingsError, StorageError, TaskFailed
from steadylight.storage import RunDirectory

OPTIONS = {"frames": 6, "cache_parts": 2}


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    """Workers and farms find the fake renderer."""
    renderer = FakeRenderer()
    monkeypatch.setattr(tasks, "find_renderer", lambda _: renderer)
    monkeypatch.setattr(farm, "find_renderer", lambda _: renderer)
    monkeypatch.setattr(farm, "check_versions", lambda *_: None)
    return renderer


@pytest.fixture
def run(tmp_path):
    """A run directory that was prepared and no more."""
    with session(tmp_path / "run", **OPTIONS):
        pass
    return tmp_path / "run"


def perform(run, *words):
    """What the command does; keys of the tasks that were done now."""
    opened = FarmRun.open(run)
    done = opened.perform(opened.choose(words), threads=1)
    return [each.task.key for each in done if not isinstance(each, Task)]


def steps(run):
    return list(dict.fromkeys(map(step_of, FarmRun.open(run).tasks)))


def all_of(run, step):
    numbers = [number_of(task) for task in FarmRun.open(run).tasks if step_of(task) == step]
    return [step if number is None else f"{step}:{number}" for number in numbers]


def test_performed_one_by_one_a_run_has_the_bytes_and_counts_of_a_render(run, tmp_path):
    for step in steps(run):
        for word in all_of(run, step):
            perform(run, word)
    statistics, faults = FarmRun.open(run).finish()
    request = prepared(output=tmp_path / "whole", cluster="in-process", **OPTIONS)
    with Session(request) as opened:
        for _ in opened:
            pass
        whole = opened.finish().statistics
    names = sorted(
        path.relative_to(run).as_posix()
        for folder in ("frames", "cache")
        for path in (run / folder).iterdir()
    )
    assert names
    for name in names:
        assert (run / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert faults == []
    for part in ("first_pass", "merge", "coverage", "second_pass"):
        for count in {"rays", "records", "records_in", "looked_up", "missed", "new_records"} & whole[
            part
        ].keys():
            assert statistics[part][count] == whole[part][count]
    assert statistics["tasks"] == whole["tasks"]
    assert {"animation.mp4", "report.html", "stats.json"} <= {path.name for path in run.iterdir()}


def test_a_run_that_was_prepared_with_aovs_has_their_tasks_on_a_farm(tmp_path):
    with session(tmp_path / "run", **OPTIONS, aovs=True):
        pass
    opened = FarmRun.open(tmp_path / "run")
    assert [task.key for task in opened.choose(["aovs:1-6"])] == [f"aovs-{n:05d}" for n in range(1, 7)]
    assert {"aovs"} < set(map(step_of, opened.tasks))


def test_a_task_whose_input_is_not_done_is_not_begun(run):
    with pytest.raises(
        InputError, match=r"merge-001 cannot start: task gather-\d+ is not done yet; perform gather"
    ):
        perform(run, "merge-001")
    assert list((run / "cache").iterdir()) == []


def test_a_damaged_input_is_named_and_the_task_that_made_it_can_be_performed_again(run):
    perform(run, *all_of(run, "prepare"), *all_of(run, "look"))
    path = next((run / "cache").iterdir())
    right = path.read_bytes()
    path.write_bytes(right + b" ")
    key = next(task.key for task in FarmRun.open(run).tasks if path.name in task.outputs[0])
    with pytest.raises(InputError, match=rf"cannot start: {path.name} is not valid .*; perform {key} first"):
        perform(run, *all_of(run, "gather"))
    assert perform(run, key) == [key]
    assert path.read_bytes() == right


def test_a_file_without_a_result_is_not_taken_for_the_tasks_own(run):
    """As left by a killed attempt, or copied from another frame."""
    for step in steps(run):
        perform(run, *all_of(run, step))
    frames = [run / f"frames/frame_0000{number}.exr" for number in (3, 4)]
    right = frames[0].read_bytes()
    shutil.copyfile(frames[1], frames[0])
    (run / "log/results/shade-00003.json").unlink()
    assert perform(run, "shade:3") == ["shade-00003"]
    assert frames[0].read_bytes() == right


def test_what_is_done_is_not_done_again(run):
    first = all_of(run, "prepare")[0]
    assert len(perform(run, first)) == 1
    assert perform(run, first) == []


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        (["shade:2"], ["shade-00002"]),
        (["shade:2-4"], ["shade-00002", "shade-00003", "shade-00004"]),
        (["shade:5,1-3:2"], ["shade-00001", "shade-00003", "shade-00005"]),
        (["merge-000", "merge:1"], ["merge-000", "merge-001"]),
        (["fill-1:0-1"], ["fill-1-000", "fill-1-001"]),
        (["audit-1-0001"], ["audit-1-0001"]),
        (["concatenate"], ["concatenate"]),
    ],
)
def test_tasks_are_named_by_key_or_by_step_and_numbers(run, words, keys):
    assert [task.key for task in FarmRun.open(run).choose(words)] == keys


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("paint", r"no such task .*; its steps are prepare, look, gather, merge, audit-1, .*, finish"),
        ("paint:3", r"no step 'paint' .*; its steps are prepare, look, gather"),
        ("shade:7", r"step shade has no task 7; it has 1, 2, 3, 4, 5, ... 6"),
        ("shade:4-2", r"'4-2' is neither a number nor a range such as 1-8"),
        ("shade:x", r"'x' is neither"),
        ("shade:1-99999999999", r"'1-99999999999' is neither"),
        ("concatenate:1", r"has no task 1; it has one, without a number"),
    ],
)
def test_a_task_that_is_not_there_is_an_error_that_says_which_are(run, word, said):
    with pytest.raises(SettingsError, match=said):
        FarmRun.open(run).choose([word])


def test_a_run_is_finished_when_all_tasks_are_done_and_not_before(run):
    for step in ("prepare", "look", "gather"):
        perform(run, *all_of(run, step))
    with pytest.raises(
        RunError, match=r"\d+ of \d+ tasks are not done: merge-000, .* and \d+ more; perform them, then"
    ):
        FarmRun.open(run).finish()
    assert not (run / "animation.mp4").exists()


def test_a_failed_task_says_why_leaves_a_note_and_may_be_performed_again(run, monkeypatch, fake):
    scene = fake.open
    monkeypatch.setattr(
        fake, "open", lambda *_: (_ for _ in ()).throw(RuntimeError("no light")), raising=False
    )
    tasks._place.cache_clear()
    first = all_of(run, "prepare")[0]
    with pytest.raises(TaskFailed, match="no light"):
        perform(run, first)
    monkeypatch.setattr(fake, "open", scene, raising=False)
    tasks._place.cache_clear()
    perform(run, first)
    with RunDirectory(run) as directory:
        directory.take()
        assert gather_notes(directory) == []
        lines = directory.read_journal()
    assert [line["outcome"] for line in lines] == ["failed", "done"]


def test_a_render_takes_over_where_a_farm_stopped_and_knows_its_attempts(run):
    done = perform(run, *all_of(run, "prepare"))
    with session(run, **OPTIONS) as opened:
        assert not {task.key for task in opened.waiting} & set(done)
    statistics = rendered(run, **OPTIONS).statistics
    assert statistics["tasks"]["attempts"] == statistics["tasks"]["done"]
    assert len(statistics["sessions"]) == 2
    assert list((run / "log/performed").iterdir()) == []


def test_farm_and_render_do_not_work_on_a_run_at_the_same_time(run):
    with RunDirectory(run) as one, RunDirectory(run) as other:
        one.take(shared=True)
        other.take(shared=True)  # two tasks of a farm may
        with pytest.raises(SettingsError, match="another steadylight command is using this run directory"):
            rendered(run, **OPTIONS)
    with RunDirectory(run) as one:
        one.take()
        with pytest.raises(SettingsError, match="another steadylight command is using this run directory"):
            perform(run, all_of(run, "prepare")[0])


def test_a_damaged_note_is_named_and_set_aside(run):
    perform(run, *all_of(run, "prepare"))
    path = next((run / "log/performed").iterdir())
    path.write_bytes(path.read_bytes().replace(b"done", b"dome"))
    with RunDirectory(run) as directory:
        directory.take()
        (fault,) = gather_notes(directory)
    assert path.name in fault
    assert "it was renamed to" in fault
    assert path.with_suffix(".damaged").exists()


def test_notes_that_reached_the_journal_before_a_kill_are_not_counted_twice(run):
    perform(run, all_of(run, "prepare")[0])
    kept = {path: path.read_bytes() for path in (run / "log/performed").iterdir()}
    for _ in range(2):
        with RunDirectory(run) as directory:
            directory.take()
            gather_notes(directory)
            assert len(directory.read_journal()) == 1
        for path, content in kept.items():
            path.write_bytes(content)


@pytest.mark.parametrize("folder", ["performed", "sessions"])
def test_files_behind_a_link_in_place_of_a_folder_are_left_alone(run, tmp_path, folder):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "0001.json").write_text("precious")
    (run / "log" / folder).symlink_to(theirs)
    with pytest.raises(StorageError, match=f"{folder}: is a symbolic link; remove it"):
        rendered(run, **OPTIONS)
    assert [path.name for path in theirs.iterdir()] == ["0001.json"]


def test_another_version_of_what_makes_the_bytes_is_refused(run, monkeypatch):
    monkeypatch.undo()
    record = json.loads((run / "run.json").read_text())
    versions = record["versions"] | {"steadylight": "0.0.1"}
    with pytest.raises(BackendError, match=r"steadylight: is .* on this machine, 0\.0\.1 in the run"):
        farm.check_versions(run, versions)


def test_the_command_says_what_it_did_and_finishes(run):
    def call(*words):
        done = CliRunner().invoke(app, ["perform", str(run), *words, "--threads", "1"])
        assert done.exit_code == 0, done.output
        return done.output

    first, *others = [task.key for task in FarmRun.open(run).tasks]
    assert f"{first}: done in " in call(first)
    said = call(first, *others, FINISH)
    assert f"{first}: is already done" in said
    assert "finish: 6 frames, " in said
    assert (run / "animation.mp4").exists()


def test_a_job_is_written_where_it_is_asked_for(run, tmp_path):
    words = ["export", str(run), "--format", "openjd", "--output", str(tmp_path / "job.json")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "job.json").read_text())["specificationVersion"] == "jobtemplate-2023-09"


def test_a_run_at_a_url_is_refused(run):
    with pytest.raises(SettingsError, match="needs a run directory in a folder that all its machines see"):
        FarmRun.open("s3://bucket/run")
