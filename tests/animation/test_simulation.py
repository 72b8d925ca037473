"""The simulation of a run on many nodes: known answers, and a real run beside it."""

from __future__ import annotations

import dataclasses
import json
import random
import time

import pytest
from fake_tasks import CAN, SCENE, rendered
from sleeping import seconds_of, sleep
from typer.testing import CliRunner

from steadylight import cli
from steadylight.animation import simulation
from steadylight.animation.plan import make_tasks, windows_of
from steadylight.animation.request import prepare
from steadylight.animation.simulation import Conditions, Measured, read_measured, simulate, with_barriers
from steadylight.engines import Task
from steadylight.engines.dask_cluster import DaskCluster
from steadylight.errors import SettingsError
from steadylight.renderers.base import Survey
from variants import slow


def ideal(nodes, **more):
    """Machines where nothing but work and what is named costs time."""
    return Conditions(nodes, **({"overhead": 0.0, "submissions": float("inf")} | more))


def plain(count, *, cache=()):
    """Tasks of one second that need nothing."""
    arguments = {"frames": [1], "cache": list(cache), "inputs": []}
    return [Task(f"shade-{number:05d}", "shade", (), arguments=arguments) for number in range(count)]


def of_one_second(tasks, **sizes):
    return Measured({task.key: 1.0 for task in tasks}, {}, sizes)


def film(frames=100):
    request = prepare(SCENE, frames=frames, fps=200, first_pass="frames")
    return request.tasks


def timed(tasks, **seconds):
    return Measured({}, {stage: [seconds.get(stage, 1.0)] for stage in {task.stage for task in tasks}}, {})


def test_one_node_does_one_task_after_the_other():
    tasks = plain(10)
    outcome = simulate(tasks, of_one_second(tasks), ideal(1, start=5.0, overhead=0.5))
    assert outcome.makespan == pytest.approx(5 + 10 * 1.5)
    assert outcome.efficiency == pytest.approx(10 / 20)
    assert outcome.attempts == 10


def test_nodes_that_never_finish_a_task_are_an_error_instead_of_a_simulation_without_end():
    tasks = plain(1)
    with pytest.raises(SettingsError, match="--between-failures: nodes fail so often"):
        simulate(tasks, of_one_second(tasks), ideal(2, between_failures=1e-4))


def test_nodes_share_the_tasks_and_those_left_over_stand_idle():
    tasks = plain(10)
    outcome = simulate(tasks, of_one_second(tasks), ideal(4))
    assert outcome.makespan == pytest.approx(3)
    assert outcome.efficiency == pytest.approx(10 / 12)


def test_passes_follow_each_other():
    tasks = film(20)
    seconds = {"prepare": 1.0, "gather": 3.0, "merge": 5.0, "audit": 2.0, "fill": 7.0}
    seconds |= {"smooth": 6.0, "shade": 4.0}
    outcome = simulate(tasks, timed(tasks, **seconds), ideal(1000))
    assert outcome.makespan == pytest.approx(1 + 3 + 5 + 2 * (2 + 7) + 6 + 4)


def test_the_store_serves_one_node_after_the_other_and_each_node_once():
    tasks = plain(8, cache=["cache/merged.cache"])
    measured = of_one_second(tasks, **{"cache/merged.cache": 1000})
    outcome = simulate(tasks, measured, ideal(4, bandwidth=100.0))
    assert outcome.bytes_moved == 4000
    # The last node has the cache after 40 s; by then the others have done all but its one task.
    assert outcome.makespan == pytest.approx(41)


def test_a_failed_node_costs_time_and_no_task():
    tasks = plain(200)
    conditions = Conditions(nodes=5, between_failures=10.0, queue_wait=5.0)
    outcome = simulate(tasks, of_one_second(tasks), conditions)
    calm = simulate(tasks, of_one_second(tasks), Conditions(nodes=5))
    assert outcome.failures > 5
    assert outcome.attempts == 200 + outcome.failures
    assert outcome.makespan > 1.2 * calm.makespan
    assert outcome == simulate(tasks, of_one_second(tasks), conditions)


def test_a_node_that_fails_idle_is_asked_for_again_then_and_no_task_starts_before_its_needs(monkeypatch):
    first, *rest = plain(4)
    tasks = [first, *(dataclasses.replace(task, needs=(first.key,)) for task in rest)]
    measured = Measured({task.key: 10.0 for task in rest} | {first.key: 50.0}, {}, {})
    # Waits and lives of the nodes: the second fails idle at 10 s and at 25 s, the third just before work comes.
    draws = {10.0: [0.0, 0.0, 0.0, 0.0, 5.0, 0.0], 1000.0: [1000.0, 10.0, 49.0, 15.0, 1000.0, 1000.0]}
    monkeypatch.setattr(random.Random, "expovariate", lambda _, rate: draws[round(1 / rate, 6)].pop(0))
    conditions = ideal(3, queue_wait=10.0, between_failures=1000.0)
    outcome = simulate(tasks, measured, conditions)
    # Two tasks from 50 s to 60 s; the third node is there again at 54 s.
    assert outcome.makespan == 64
    assert outcome.attempts == 4
    assert outcome.failures == 0
    assert not any(draws.values())


def test_a_node_that_fails_idle_costs_no_attempt():
    chain = []
    for task in plain(100):
        chain.append(dataclasses.replace(task, needs=tuple(each.key for each in chain[-1:])))
    conditions = ideal(20, between_failures=50.0, queue_wait=1.0)
    outcome = simulate(chain, of_one_second(chain), conditions)
    # One node works at a time, for a little more than 100 s, and 20 fail every 50 s.
    assert 100 <= outcome.makespan <= 100 + outcome.failures
    assert outcome.failures < 10
    assert outcome.attempts == 100 + outcome.failures


def test_the_command_makes_one_submission_after_the_other():
    tasks = plain(10)
    outcome = simulate(tasks, of_one_second(tasks), ideal(10, submissions=2.0))
    # The tenth is sent at 5 s; the nodes that were sent the first ones have no more to do.
    assert outcome.makespan == pytest.approx(6)


@pytest.mark.parametrize(
    ("count", "nodes", "one_by_one", "in_bundles"),
    # 100 submissions a second feed 200 nodes with tasks of 2 s.
    [slow(50_000, 1000, 502, 120), (10_000, 1000, 102, 37), (3_000, 100, 61, 61)],
)
def test_bundles_keep_a_thousand_nodes_busy_that_one_command_could_not_serve_one_by_one(
    monkeypatch, count, nodes, one_by_one, in_bundles
):
    tasks = plain(count)
    measured = Measured({}, {"shade": [2.0]}, {})
    bundled = simulate(tasks, measured, Conditions(nodes))
    monkeypatch.setattr(simulation, "bundle_size", lambda *_: 1)
    single = simulate(tasks, measured, Conditions(nodes))
    assert (single.makespan, bundled.makespan) == pytest.approx((one_by_one, in_bundles), abs=0.7)
    assert bundled.attempts == single.attempts == count


def test_a_node_that_fails_within_a_bundle_gives_the_rest_back_unbegun():
    tasks = plain(400)
    outcome = simulate(tasks, of_one_second(tasks), ideal(4, between_failures=20.0))
    assert outcome.failures > 5
    assert outcome.attempts == 400 + outcome.failures


def rooms():
    """The tasks of an animation that walks through four rooms, which do not see each other."""
    request = prepare(SCENE, frames=100, fps=200, cache_parts=4, first_pass="frames")
    windows = windows_of(request.settings.frames)
    seen = tuple((4 * number // len(windows),) for number in range(len(windows)))
    survey = Survey(seen, ((1,), (0, 2), (1, 3), (2,)))
    return make_tasks(request.settings, request.selected, CAN, survey)


def test_without_barriers_nodes_stand_idle_less():
    tasks = rooms()
    conditions = Conditions(nodes=3)  # one of them does nothing while a fourth part is merged
    measured = timed(tasks, gather=9.0, merge=20.0, fill=20.0)
    barrier, free = (simulate(plan, measured, conditions) for plan in (with_barriers(tasks), tasks))
    assert free.makespan < 0.95 * barrier.makespan
    assert free.efficiency > barrier.efficiency


def test_with_barriers_every_stage_and_round_waits_for_all_of_the_one_before():
    tasks = rooms()
    plan = {task.key: task for task in with_barriers(tasks)}
    assert plan.keys() == {task.key for task in tasks}
    assert plan["gather-00001"].needs == ("prepare",)
    assert set(plan["audit-1-0001"].needs) == {f"merge-{part:03d}" for part in range(4)}
    assert {need[:8] for need in plan["audit-2-0001"].needs} == {"fill-1-0"}
    assert set(plan["shade-00100"].needs) == {f"smooth-{part:03d}" for part in range(4)}
    assert [task.arguments for task in tasks] == [task.arguments for task in plan.values()]


def test_times_come_from_a_run_and_a_run_without_them_is_refused(tmp_path):
    rendered(tmp_path / "run", frames=4, first_pass="frames")
    tasks = film()
    measured = read_measured(tmp_path / "run", {task.stage for task in tasks})
    assert measured.sizes["scene"] > 0
    assert measured.sizes["cache/merged.cache"] > 0
    assert all(measured.of(task) >= 0 for task in tasks)
    rendered(tmp_path / "path", frames=2, mode="path")
    with pytest.raises(SettingsError, match="has no task times for prepare, gather, merge, audit, fill"):
        read_measured(tmp_path / "path", {task.stage for task in tasks})
    with pytest.raises(SettingsError, match="not a run directory"):
        read_measured(tmp_path / "none", {"shade"})


def test_the_first_task_of_a_stage_on_a_worker_is_the_start_of_a_node_and_no_time_of_its_stage(tmp_path):
    rendered(tmp_path / "run", frames=4)
    journal = [
        ("gather-00001", "gather", "a", 90.0),
        ("gather-00002", "gather", "b", 80.0),
        ("gather-00003", "gather", "a", 5.0),
        ("merge", "merge", "c", 7.0),  # all that is known of its stage
        ("shade-00001", "shade", "a", 20.0),
        ("shade-00002", "shade", "a", 2.0),
    ]
    keys = ("task", "stage", "worker", "seconds")
    lines = [{"outcome": "done", "time": 1e9, **dict(zip(keys, line, strict=True))} for line in journal]
    (tmp_path / "run/log/tasks.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    measured = read_measured(tmp_path / "run", {"gather", "merge", "shade"})
    assert measured.by_stage == {"gather": [5.0], "merge": [7.0], "shade": [2.0]}
    assert measured.seconds == {"gather-00003": 5.0, "merge": 7.0, "shade-00002": 2.0}


def test_the_command_shows_both_plans(tmp_path):
    rendered(tmp_path / "run", frames=4)
    arguments = ["plan", "furnace", "--simulate", "--times", str(tmp_path / "run"), "--nodes", "1000"]
    said = CliRunner().invoke(cli.app, arguments)
    assert said.exit_code == 0, said.output
    assert "simulated on 1,000 nodes" in said.output
    assert "with barriers between passes" in said.output
    assert "without barriers" in said.output


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 4])
def test_a_real_run_takes_as_long_as_the_simulated_one(workers):
    tasks = film(60)
    measured = Measured({task.key: seconds_of(task) for task in tasks}, {}, {})
    expected = simulate(tasks, measured, Conditions(nodes=workers)).makespan
    with DaskCluster(workers=workers) as engine:
        list(engine.run([Task(f"warm-{n}", "warm", ()) for n in range(2 * workers)], sleep))
        start = time.perf_counter()
        done = sum(attempt.outcome == "done" for attempt in engine.run(tasks, sleep))
        seconds = time.perf_counter() - start
    assert done == len(tasks)
    # Machines that do something else besides are slower, but tasks that wait are never faster.
    assert 0.9 * expected < seconds < 2 * expected
