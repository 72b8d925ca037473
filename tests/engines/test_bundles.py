"""Tasks that are sent together: how many, and that nobody can tell from what comes back."""

import os
import signal
import time
from collections import Counter
from itertools import pairwise

import pytest
from arithmetic import die, fail, in_folder, sleep, stall_once, task, total

from steadylight.engines import dispatcher
from steadylight.engines.dask_cluster import DaskCluster
from steadylight.engines.readiness import Readiness, bundle_size
from steadylight.sites import FaultSettings, SiteSettings


@pytest.fixture
def sizes(monkeypatch):
    """How many tasks were sent together, each time."""
    seen = []

    def submit(self, work, perform, bundle, *rest, **more):
        seen.append(len(bundle))
        return plain(self, work, perform, bundle, *rest, **more)

    plain = dispatcher.Client.submit
    monkeypatch.setattr(dispatcher.Client, "submit", submit)
    return seen


def performed(folder):
    return Counter((folder / "performed.log").read_text().split())


def summary(attempts):
    """How often each task was tried, and all that went wrong."""
    done = {attempt.task.key: attempt.attempt for attempt in attempts if attempt.outcome == "done"}
    wrong = [(each.task.key, each.outcome, each.attempt) for each in attempts if each.outcome != "done"]
    return done, wrong


class TestBundleSize:
    @pytest.mark.parametrize("workers", [2, 8, 100])
    @pytest.mark.parametrize("pace", [0.0, 0.01, 0.3, 1.9])
    def test_sizes_fall_to_one_and_sum_to_all(self, workers, pace):
        left, sizes = 1000, []
        while left:
            sizes.append(bundle_size(left, workers, pace))
            left -= sizes[-1]
        assert left == 0
        assert all(later <= earlier for earlier, later in pairwise(sizes))
        assert sizes[-1] == 1
        if pace > 0.01 * workers:
            # Nobody is sent two of the last ones, unless they are done before the others are sent theirs.
            assert set(sizes[-2 * workers :]) == {1}

    def test_a_bundle_is_long_enough_for_the_command_to_serve_all_workers_and_no_longer(self):
        assert bundle_size(10**6, 1, 0.5) == 4
        assert bundle_size(10**6, 100, 0.5) == 4
        assert bundle_size(10**6, 1000, 0.5) == 40
        assert bundle_size(10**6, 1000, 2.0) == 10
        assert bundle_size(10**6, 1000, 30.0) == 1

    def test_towards_the_end_a_bundle_lasts_while_the_command_serves_the_others(self):
        assert bundle_size(6000, 1000, 2.0) == 5
        assert bundle_size(1500, 1000, 2.0) == 2
        # A few workers are served at once.
        assert bundle_size(6, 2, 0.5) == bundle_size(2, 1, 0.5) == 1

    def test_tasks_of_which_nothing_is_known_go_one_by_one(self):
        assert bundle_size(10**6, 2, float("inf")) == 1

    def test_tasks_that_take_no_time_do_not_all_go_to_one_worker(self):
        assert bundle_size(10**6, 2, 0.0) == bundle_size(10**6, 2, 1e-9) == 64


class TestTakingSeveral:
    def test_they_are_of_one_stage_and_in_the_order_of_the_plan(self):
        readiness = Readiness([task(key) for key in ("a-1", "b-1", "a-2", "b-2", "a-3")], 3)
        asked = []
        taken = readiness.take_many(size=lambda *known: asked.append(known) or 2)
        assert [(each.key, attempt) for each, attempt in taken] == [("a-1", 1), ("a-2", 1)]
        assert asked == [("a", 3)]
        assert readiness.next.key == "b-1"
        assert readiness.open == 5

    def test_what_does_not_suit_is_left_out_and_keeps_its_place(self):
        readiness = Readiness([task(f"a-{number}") for number in range(5)], 3)
        taken = readiness.take_many(lambda each: each.key not in {"a-0", "a-2"}, lambda *_: 2)
        assert [each.key for each, _ in taken] == ["a-1", "a-3"]
        assert readiness.take_many(lambda _: False, lambda *_: 2) == []
        assert [readiness.take()[0].key for _ in range(3)] == ["a-0", "a-2", "a-4"]

    def test_the_number_that_is_ready_follows_what_becomes_of_tasks(self):
        tasks = [task("a-1"), task("a-2"), task("a-3", "a-1")]
        readiness = Readiness(tasks, 3)
        ready = []

        def size(_stage, count):
            ready.append(count)
            return 9

        (first, _), (second, _) = readiness.take_many(size=size)
        readiness.done(first)
        readiness.give_back(second)
        readiness.lost(readiness.take()[0], "gone")
        assert readiness.withdraw(second)
        assert readiness.take_many(size=size) == [(tasks[2], 1)]
        assert ready == [2, 1]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_worker_killed_within_a_bundle_costs_the_task_that_ran_one_attempt_and_the_others_none(
    tmp_path, sizes, workers
):
    fatal = {"a-017", "a-050", "a-051"}
    tasks = [task(f"a-{n:03d}", deaths=int(f"a-{n:03d}" in fatal)) for n in range(90)]
    with DaskCluster(workers) as engine:
        done, wrong = summary(list(engine.run(tasks, in_folder(die, tmp_path))))
    assert sorted(wrong) == [(key, "lost", 1) for key in sorted(fatal)]
    assert done == {each.key: 2 if each.key in fatal else 1 for each in tasks}
    assert performed(tmp_path) == Counter(each.key for each in tasks)
    assert max(sizes) > 5


def test_a_task_that_fails_within_a_bundle_does_not_stop_the_rest(tmp_path, sizes):
    tasks = [task(f"a-{n:03d}", failures=2 if n == 17 else 0) for n in range(60)]
    with DaskCluster() as engine:
        attempts = list(engine.run(tasks, in_folder(fail, tmp_path)))
    done, wrong = summary(attempts)
    assert wrong == [("a-017", "failed", 1), ("a-017", "failed", 2)]
    assert done == {each.key: 3 if each.key == "a-017" else 1 for each in tasks}
    assert max(sizes) > 5
    # What was sent with it comes before it is tried again.
    assert [attempt.task.key for attempt in attempts].index("a-018") == 18


def test_a_task_that_hangs_within_a_bundle_is_noticed_and_the_rest_goes_to_another_worker(tmp_path, sizes):
    site = SiteSettings(faults=FaultSettings(stalled_after=4))
    tasks = [task(f"a-{n:03d}", stalls=n == 17) for n in range(60)]
    with DaskCluster(site=site) as engine:
        attempts = list(engine.run(tasks, in_folder(stall_once, tmp_path)))
    done, wrong = summary(attempts)
    assert wrong == [("a-017", "lost", 1)]
    assert [attempt.cause for attempt in attempts if attempt.outcome == "lost"] == ["hung"]
    assert done == {each.key: 2 if each.key == "a-017" else 1 for each in tasks}
    assert performed(tmp_path) == Counter(each.key for each in tasks)
    assert max(sizes) > 5


def test_the_files_are_the_same_whether_tasks_go_one_by_one_or_together(tmp_path, sizes, monkeypatch):
    tasks = [
        *(task(f"a-{n:03d}", value=n) for n in range(60)),
        *(task(f"b-{n:03d}", f"a-{n:03d}", f"a-{59 - n:03d}", value=n) for n in range(60)),
        task("c-1", *(f"b-{n:03d}" for n in range(60))),
    ]
    found = []
    for way in ("together", "one by one"):
        if way == "one by one":
            monkeypatch.setattr(dispatcher, "bundle_size", lambda *_: 1)
        (tmp_path / way).mkdir()
        sizes.clear()
        with DaskCluster(workers=2) as engine:
            list(engine.run(tasks, in_folder(total, tmp_path / way)))
        found.append({path.name: path.read_bytes() for path in (tmp_path / way).glob("*.txt")})
        assert sum(sizes) == 121
        assert (max(sizes) > 1) == (way == "together")
    assert found[0] == found[1]
    assert len(found[0]) == 121


@pytest.mark.parametrize("cluster", [1], indirect=True)
class TestForeignWorkers:
    def test_a_run_that_is_left_leaves_a_worker_with_the_task_that_it_is_at(self, cluster, tmp_path, sizes):
        tasks = [task(f"a-{n:03d}", seconds=0.1) for n in range(200)]
        with DaskCluster(cluster=cluster.address) as engine:
            for count, _ in enumerate(engine.run(tasks, in_folder(sleep, tmp_path))):
                if count == 5:
                    break
            assert max(sizes) > 10
            time.sleep(0.5)
            before = performed(tmp_path).total()
            time.sleep(1.0)
            assert performed(tmp_path).total() == before < 12

    def test_one_that_was_given_up_within_a_bundle_and_wakes_does_not_go_on_with_it(
        self, cluster, tmp_path, sizes
    ):
        cluster.start_worker(1)
        site = SiteSettings(faults=FaultSettings(stalled_after=4))
        tasks = [task(f"a-{n:03d}", seconds=0.05, stalls=n == 60) for n in range(200)]
        attempts = []
        with DaskCluster(cluster=cluster.address, site=site) as engine:
            while engine.workers != 2:
                time.sleep(0.05)
            for attempt in engine.run(tasks, in_folder(stall_once, tmp_path)):
                attempts.append(attempt)
                if attempt.cause == "hung":
                    os.kill(int((tmp_path / "stalled").read_text()), signal.SIGCONT)
        done, wrong = summary(attempts)
        assert wrong == [("a-060", "lost", 1)]
        assert done.keys() == {each.key for each in tasks}
        assert max(sizes) > 5
        # It may have finished the one at which it woke up beside another worker, and no more.
        assert performed(tmp_path).total() <= 201
