"""What a worker does around its work: whose directory it is, and that nothing spoiled gets into it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fake_tasks import FakeRenderer, FakeScene, session

from steadylight.animation import tasks
from steadylight.checksum import with_checksum
from steadylight.errors import RunError, StorageError
from steadylight.images import read_exr_metadata
from steadylight.renderers.base import Frame
from steadylight.storage import RunDirectory

MERGED = "cache/merged.cache"


class Scene(FakeScene):
    """Does something else first if a test asks for it."""

    first = staticmethod(lambda: None)

    def merge(self, caches, part, output):
        self.first()
        return {
            name: number for name, number in super().merge(caches, part, output).items() if name != "seconds"
        }


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run that was begun, and its tasks by key; workers find the fake renderer."""
    renderer = FakeRenderer()
    monkeypatch.setattr(renderer, "open", lambda job, _threads: Scene(job), raising=False)
    monkeypatch.setattr(tasks, "find_renderer", lambda _: renderer)
    root = tmp_path / "run"
    with session(root) as opened:
        yield root, {task.key: task for task in opened.request.tasks}


def perform(root, task):
    return tasks.perform(task, directory=str(root), threads=1)


def test_a_task_writes_its_output_and_its_result(run):
    root, plan = run
    assert perform(root, plan["merge"])["records_out"] == 50
    assert (root / MERGED).is_file()
    assert RunDirectory(root).read_result("merge")["records_in"] == 60


def test_seconds_are_the_renderers_own_or_those_of_the_whole_call(run):
    root, plan = run
    assert perform(root, plan["gather-000"])["seconds"] == 0.1
    assert perform(root, plan["shade-00001"])["seconds"] == 0.25
    assert 0 < perform(root, plan["merge"])["seconds"] < 0.1


def test_the_bytes_of_a_frame_do_not_depend_on_the_name_of_the_scene(run):
    root, plan = run
    perform(root, plan["shade-00001"])
    assert read_exr_metadata(root / "frames/frame_00001.exr") == {"frame": "1", "mode": "two-pass"}


def test_every_stage_of_the_plan_is_performed(run):
    root, plan = run
    for task in plan.values():
        perform(root, task)
    assert all((root / name).is_file() for task in plan.values() for name in task.outputs)


def test_a_task_that_another_attempt_has_done_is_not_done_again(run, monkeypatch):
    root, plan = run
    before = perform(root, plan["merge"])
    monkeypatch.setattr(Scene, "first", lambda _: pytest.fail("it was done"))
    assert perform(root, plan["merge"]) == before


def test_a_worker_drops_its_work_if_another_run_took_the_directory_meanwhile(run, monkeypatch):
    root, plan = run

    def slowly(_):
        record = RunDirectory(root).read_record()
        record["settings"]["seed"] += 1
        (root / "run.json").write_text(json.dumps(with_checksum(record)))

    monkeypatch.setattr(Scene, "first", slowly)
    with pytest.raises(StorageError, match="now belongs to another run"):
        perform(root, plan["merge"])
    assert not (root / MERGED).exists()


@pytest.mark.parametrize("content", [None, '{"format": '])
def test_a_worker_that_cannot_read_the_run_may_try_again(run, content):
    root, plan = run
    (root / "run.json").unlink()
    if content is not None:
        (root / "run.json").write_text(content)
    with pytest.raises(StorageError, match="run"):
        perform(root, plan["merge"])


def test_what_does_not_read_back_is_not_kept(run, monkeypatch):
    root, plan = run
    monkeypatch.setattr(Scene, "_write", lambda _, stage, output: output.write_text("half of it") and {})
    with pytest.raises(StorageError, match="cut short"):
        perform(root, plan["gather-000"])
    assert not list(root.glob("cache/*"))


def test_a_frame_is_black_if_no_pixel_has_light(run, monkeypatch):
    root, plan = run
    picture = np.zeros((8, 16, 3), np.float32)
    monkeypatch.setattr(Scene, "shade", lambda *_: Frame(picture))
    assert perform(root, plan["shade-00001"])["black"] == 1
    picture[7, 15, 2] = 1e-6
    assert perform(root, plan["shade-00002"])["black"] == 0


def test_pixels_that_are_not_finite_are_not_written(run, monkeypatch):
    root, plan = run
    black = np.zeros((8, 16, 3), np.float32)
    black[0, 0, 0] = np.nan
    monkeypatch.setattr(Scene, "shade", lambda *_: Frame(black))
    with pytest.raises(RunError, match=r"frame 1 .*not finite"):
        perform(root, plan["shade-00001"])
    assert not list(root.glob("frames/*.exr"))
