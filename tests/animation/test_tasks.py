"""What a worker does around its work: whose directory it is, and that nothing spoiled gets into it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from fake_tasks import SCENE, session

from steadylight.animation import tasks
from steadylight.animation.plan import merged_cache
from steadylight.cache.file import CacheFile, encode_cache
from steadylight.cache.records import Records
from steadylight.errors import RunError, StorageError
from steadylight.storage import RunDirectory


def one_record(**changed):
    """A cache with one record."""
    arrays = {name: np.ones((1, *shape), np.float32) for name, shape in Records.SHAPES.items()}
    return dataclasses.replace(Records(**arrays), **changed)


@pytest.fixture
def merge(tmp_path):
    """A run in which all selected frames are gathered, and its merge task."""
    root = tmp_path / "run"
    with session(root) as opened:
        task = next(task for task in opened.request.tasks if task.stage == "merge")
        for name in task.arguments["inputs"]:
            (root / name).write_bytes(encode_cache(CacheFile(one_record(), SCENE.hash, {})))
    return root, task


def perform(root, task):
    return tasks.perform(task, directory=str(root), threads=1)


def test_a_task_writes_its_output_and_its_result(merge):
    root, task = merge
    assert perform(root, task)["records_out"] == 1
    assert (root / merged_cache()).is_file()
    assert RunDirectory(root).read_result("merge")["records_in"] == len(task.arguments["inputs"])


def test_a_task_that_another_attempt_has_done_is_not_done_again(merge, monkeypatch):
    root, task = merge
    before = perform(root, task)
    monkeypatch.setattr(tasks, "merge_part", lambda *_: pytest.fail("it was done"))
    assert perform(root, task) | {"seconds": 0} == before | {"seconds": 0}


def test_a_worker_drops_its_work_if_another_run_took_the_directory_meanwhile(merge, monkeypatch):
    root, task = merge
    real = tasks.merge_part

    def slowly(*given):
        record = json.loads((root / "run.json").read_text())
        record["settings"]["seed"] += 1
        (root / "run.json").write_text(json.dumps(record))
        return real(*given)

    monkeypatch.setattr(tasks, "merge_part", slowly)
    with pytest.raises(StorageError, match="is of another run now"):
        perform(root, task)
    assert not (root / merged_cache()).exists()


@pytest.mark.parametrize("content", [None, '{"format": '])
def test_a_worker_that_cannot_read_the_run_may_try_again(merge, content):
    root, task = merge
    (root / "run.json").unlink()
    if content is not None:
        (root / "run.json").write_text(content)
    with pytest.raises(StorageError, match="run"):
        perform(root, task)


@pytest.mark.parametrize("field", ["irradiance", "curvature", "deviation", "radius"])
def test_records_that_are_not_finite_are_not_written(merge, monkeypatch, field):
    root, task = merge
    spoiled = one_record(**{field: np.full((1, *Records.SHAPES[field]), np.nan, np.float32)})
    monkeypatch.setattr(tasks, "merge_part", lambda *_: spoiled)
    with pytest.raises(RunError, match="not finite"):
        perform(root, task)
    assert not (root / merged_cache()).exists()
