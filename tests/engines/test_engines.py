"""What every engine promises: order, attempts, results."""

from collections import Counter

import pytest
from arithmetic import (
    burn,
    fail,
    find_input_wrong,
    in_folder,
    note_overlap,
    report_process,
    return_what_is_not_plain,
    task,
    total,
)

from steadylight.engines import check_engine, make_engine
from steadylight.engines.dask_cluster import DaskCluster, threads_of_local_worker
from steadylight.engines.in_process import InProcess
from steadylight.errors import SceneError, SettingsError, TaskFailed
from steadylight.settings import ExecutionSettings


def performed(folder) -> list[str]:
    return (folder / "performed.log").read_text().split()


class TestEveryEngine:
    def test_a_diamond_is_performed_after_its_needs_and_each_task_once(self, engine, tmp_path):
        tasks = [
            task("sum-1", "half-1", "half-2"),
            task("half-1", "start", value=10),
            task("half-2", "start", value=20),
            task("start", value=1),
        ]
        attempts = list(engine.run(tasks, in_folder(total, tmp_path)))
        assert (tmp_path / "sum-1.txt").read_text() == "32"
        order = performed(tmp_path)
        assert sorted(order) == ["half-1", "half-2", "start", "sum-1"]
        assert (order[0], order[-1]) == ("start", "sum-1")
        assert [(attempt.outcome, attempt.attempt) for attempt in attempts] == [("done", 1)] * 4
        results = {attempt.task.key: attempt.result for attempt in attempts}
        assert results["half-2"] == {"value": 21, "pair": [1, 2]}

    def test_needs_that_are_not_in_the_list_count_as_done(self, engine, tmp_path):
        (tmp_path / "start.txt").write_text("5")
        attempts = list(engine.run([task("next-1", "start", value=1)], in_folder(total, tmp_path)))
        assert attempts[0].result["value"] == 6

    def test_nothing_to_do_is_done(self, engine, tmp_path):
        assert list(engine.run([], in_folder(total, tmp_path))) == []

    def test_two_hundred_small_tasks_in_a_chain_of_levels_all_complete(self, engine, tmp_path):
        tasks = [
            task(
                f"level{level}-{number:03d}", *([f"level{level - 1}-{number:03d}"] if level else []), value=1
            )
            for level in range(4)
            for number in range(50)
        ]
        attempts = list(engine.run(tasks, in_folder(total, tmp_path)))
        assert Counter(attempt.outcome for attempt in attempts) == {"done": 200}
        assert len(set(performed(tmp_path))) == len(performed(tmp_path)) == 200
        assert {(tmp_path / f"level3-{number:03d}.txt").read_text() for number in range(50)} == {"4"}

    def test_a_task_that_fails_is_tried_again(self, engine, tmp_path):
        tasks = [task("a-1", failures=2), task("b-1", "a-1")]
        attempts = list(engine.run(tasks, in_folder(fail, tmp_path)))
        tries = [(attempt.task.key, attempt.outcome, attempt.attempt) for attempt in attempts]
        assert tries == [("a-1", "failed", 1), ("a-1", "failed", 2), ("a-1", "done", 3), ("b-1", "done", 1)]
        assert attempts[0].result["error"] == "ZeroDivisionError: no light"
        assert "in fail" in attempts[0].result["details"]

    def test_a_task_that_keeps_failing_ends_the_run_and_finished_work_stays(self, engine, tmp_path):
        tasks = [task("good-1"), task("bad-1", "good-1", failures=9), task("after-1", "bad-1")]
        seen = []
        with pytest.raises(TaskFailed, match="task bad-1 failed: ZeroDivisionError: no light") as caught:
            seen.extend(engine.run(tasks, in_folder(fail, tmp_path)))
        assert caught.value.key == "bad-1"
        assert "Traceback" in caught.value.details
        assert "in fail" in caught.value.details
        assert (tmp_path / "good-1.txt").exists()
        assert not (tmp_path / "after-1.txt").exists()

    def test_every_attempt_is_told_before_the_error(self, engine, tmp_path):
        seen = []

        def listen() -> None:
            attempts = engine.run([task("bad-1", failures=9)], in_folder(fail, tmp_path))
            seen.extend((attempt.outcome, attempt.attempt) for attempt in attempts)

        with pytest.raises(TaskFailed):
            listen()
        assert seen == [("failed", 1), ("failed", 2), ("failed", 3)]

    def test_wrong_input_found_by_a_task_is_not_tried_again(self, engine):
        with pytest.raises(SceneError, match="line 3: unknown plugin a-1"):
            list(engine.run([task("a-1")], find_input_wrong))

    def test_a_result_that_is_not_plain_data_is_a_failure(self, engine):
        with pytest.raises(TaskFailed, match="not JSON serializable"):
            list(engine.run([task("a-1")], return_what_is_not_plain))

    def test_an_engine_that_failed_or_was_left_can_be_used_again(self, engine, tmp_path):
        for _ in engine.run([task(f"first-{number}") for number in range(20)], in_folder(total, tmp_path)):
            break
        attempts = list(engine.run([task("second-1", value=3)], in_folder(total, tmp_path)))
        assert attempts[-1].result["value"] == 3

    def test_a_worker_does_one_task_at_a_time(self, engine, tmp_path):
        tasks = [task(f"a-{number}") for number in range(12)]
        attempts = list(engine.run(tasks, in_folder(note_overlap, tmp_path)))
        assert [attempt.result["alone"] for attempt in attempts] == [True] * 12

    def test_attempts_tell_worker_and_seconds(self, engine):
        (attempt,) = engine.run([task("a-1")], report_process)
        attempts = list(engine.run([task("a-1")], burn))
        assert len(attempts) == 1, attempts
        busy = attempts[0]
        assert attempt.worker.endswith(f":{attempt.result['pid']}")
        assert 0.15 < busy.seconds_cpu < 30
        assert busy.seconds > 0.1

    def test_contradictory_plans_are_refused(self, engine):
        with pytest.raises(ValueError, match="same key"):
            list(engine.run([task("a-1"), task("a-1")], report_process))
        with pytest.raises(ValueError, match="cycle: a-1, b-1"):
            list(engine.run([task("c-1"), task("a-1", "b-1"), task("b-1", "a-1")], report_process))


def test_a_worker_that_is_there_is_always_seen(monkeypatch):
    # The client keeps a summary of its own without workers, and may update it at any moment.
    monkeypatch.setattr(
        "distributed.client.Client.scheduler_info", lambda *_arguments, **_keywords: {"workers": {}}
    )
    with DaskCluster() as engine:
        attempts = list(engine.run([task("a-1")], burn))
    assert [attempt.outcome for attempt in attempts] == ["done"]


def test_the_first_in_the_plan_goes_first(tmp_path):
    tasks = [task("late-1", "early-2"), task("early-1"), task("early-2"), task("early-3")]
    with DaskCluster() as cluster:
        for engine in (InProcess(), cluster):
            folder = tmp_path / type(engine).__name__
            folder.mkdir()
            list(engine.run(tasks, in_folder(total, folder)))
    assert performed(tmp_path / "InProcess") == ["early-1", "early-2", "late-1", "early-3"]
    # The third was sent to wait before the second was done: the price of a short queue at the worker.
    assert set(performed(tmp_path / "DaskCluster")) == {"early-1", "early-2", "late-1", "early-3"}


@pytest.mark.parametrize(
    ("cores", "workers", "threads"), [(8, 1, 8), (8, 4, 8), (8, 16, 2), (2, 2, 2), (1, 3, 1), (2, 16, 1)]
)
def test_local_workers_may_use_the_cores_of_others_that_wait(cores, workers, threads):
    assert threads_of_local_worker(cores, workers) == threads


class TestMakeEngine:
    def test_in_process_and_local_are_made_as_named(self):
        with make_engine(ExecutionSettings(cluster="in-process")) as engine:
            assert isinstance(engine, InProcess)
            assert engine.threads_per_worker >= 1
        with make_engine(ExecutionSettings(cluster="local", workers=2)) as engine:
            assert isinstance(engine, DaskCluster)
            assert engine.workers == 2
            assert engine.threads_per_worker >= 1
            assert engine.dashboard_link.startswith("http://127.0.0.1:")

    @pytest.mark.parametrize("cluster", ["globus", "cloud", "http://host:1"])
    def test_other_clusters_are_refused_with_those_that_work(self, cluster):
        with pytest.raises(SettingsError, match=rf"--cluster {cluster}: not supported; give `local`"):
            check_engine(ExecutionSettings(cluster=cluster))

    def test_an_address_where_nothing_listens_is_an_error_of_the_setting(self, monkeypatch):
        monkeypatch.setattr("steadylight.engines.dask_cluster._SECONDS_TO_CONNECT", 0.5)
        with pytest.raises(SettingsError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler responds there"):
            make_engine(ExecutionSettings(cluster="tcp://127.0.0.1:9"))
        with pytest.raises(SettingsError, match="no Dask scheduler responds there"):
            make_engine(ExecutionSettings(cluster="tcp://nonsense"))
