"""The plan: which tasks there are, what they need, and that the machine has no say in it."""

from __future__ import annotations

import pickle

import pytest

from steadylight.animation.plan import (
    FRAMES_PER_WINDOW,
    STAGES,
    estimate_cost,
    make_tasks,
    part_count,
    selected_count,
    windows_of,
)
from steadylight.cache.octree import Cube
from steadylight.cache.partition import Partition
from steadylight.errors import SettingsError
from steadylight.settings import RenderSettings


def settings(**changes):
    return RenderSettings(**{"frames": range(1, 21), "width": 8, "height": 6, **changes})


def by_key(tasks):
    return {task.key: task for task in tasks}


def test_two_pass_gathers_merges_audits_twice_and_shades():
    tasks = make_tasks(settings(), [2, 12])
    keys = [task.key for task in tasks]
    assert keys[:3] == ["gather-00002", "gather-00012", "merge"]
    assert keys[3:7] == ["audit-1-0001", "audit-1-0002", "audit-1-0003", "cover-1"]
    assert keys[7:11] == ["audit-2-0001", "audit-2-0002", "audit-2-0003", "cover-2"]
    assert keys[11:] == ["finish"] + [f"shade-{n:05d}" for n in range(1, 21)]


def test_every_task_comes_after_what_it_needs():
    done = set()
    for task in make_tasks(settings(), [2, 12]):
        assert done.issuperset(task.needs)
        done.add(task.key)


def test_what_a_task_reads_is_an_output_of_what_it_needs():
    tasks = by_key(make_tasks(settings(), [2, 12]))
    for task in tasks.values():
        made, needs = set(), list(task.needs)
        while needs:
            need = tasks[needs.pop()]
            made.update(need.outputs)
            needs += need.needs
        assert made.issuperset(task.arguments["inputs"])
        assert made.issuperset(task.arguments["cache"])


def test_outputs_have_the_names_of_the_run_directory():
    tasks = by_key(make_tasks(settings(), [12]))
    assert tasks["gather-00012"].outputs == (
        "cache/gather_00012.safetensors",
        "log/results/gather-00012.json",
    )
    assert tasks["merge"].outputs == ("cache/merged.safetensors", "log/results/merge.json")
    assert tasks["audit-1-0003"].outputs[0] == "cache/audit_1_0003.points"
    assert tasks["cover-2"].outputs[0] == "cache/covered_2.safetensors"
    assert tasks["shade-00012"].outputs == ("frames/frame_00012.exr", "log/results/shade-00012.json")


def test_no_two_tasks_write_the_same_file():
    outputs = [output for task in make_tasks(settings(), [2, 12]) for output in task.outputs]
    assert len(outputs) == len(set(outputs))


def test_the_second_pass_reads_the_last_cache_of_the_audit_smoothed():
    tasks = by_key(make_tasks(settings(), [12]))
    assert tasks["audit-1-0001"].arguments["cache"] == ["cache/merged.safetensors"]
    assert tasks["audit-2-0001"].arguments["cache"] == ["cache/covered_1.safetensors"]
    assert tasks["finish"].arguments["cache"] == ["cache/covered_2.safetensors"]
    assert tasks["shade-00001"].arguments["cache"] == ["cache/finished.safetensors"]


def test_without_coverage_the_second_pass_follows_the_merge():
    tasks = by_key(make_tasks(settings(coverage="off"), [12]))
    assert {task.stage for task in tasks.values()} == {"gather", "merge", "shade"}
    assert tasks["shade-00001"].needs == ("merge",)
    assert tasks["shade-00001"].arguments["cache"] == ["cache/merged.safetensors"]


@pytest.mark.parametrize("mode", ["single-pass", "path"])
def test_modes_without_a_shared_cache_only_shade(mode):
    tasks = make_tasks(settings(mode=mode), [])
    assert [task.stage for task in tasks] == ["shade"] * 20
    assert all(not task.needs and task.arguments["cache"] == [] for task in tasks)


def test_audits_cover_every_frame_once_in_windows_of_fixed_size():
    frames = (3, 6, *range(10, 27))
    windows = [
        task.arguments["frames"]
        for task in make_tasks(settings(frames=frames), [3])
        if task.stage == "audit" and task.arguments["round"] == 1
    ]
    assert [n for window in windows for n in window] == list(frames)
    assert {len(window) for window in windows[:-1]} == {FRAMES_PER_WINDOW}


def test_frames_keep_their_own_numbers():
    tasks = make_tasks(settings(frames=(30, 75), mode="path"), [])
    assert [task.outputs[0] for task in tasks] == ["frames/frame_00030.exr", "frames/frame_00075.exr"]


def test_tasks_are_plain_data_and_the_same_every_time():
    tasks = make_tasks(settings(), [2, 12])
    assert pickle.loads(pickle.dumps(tasks)) == tasks == make_tasks(settings(), [2, 12])
    assert {task.stage for task in tasks} == set(STAGES) - {"join"}


@pytest.mark.parametrize(
    ("frames", "choice", "workers", "count"),
    [
        (91, "auto", 1, 10),
        (91, "auto", 64, 10),
        (100, "auto", 1, 10),
        (1, "auto", 1, 1),
        (91, "workers", 4, 4),
        (3, "workers", 64, 3),
        (91, 7, 1, 7),
        (5, 7, 1, 5),
    ],
)
def test_number_of_selected_frames(frames, choice, workers, count):
    assert selected_count(frames, choice, workers) == count


@pytest.mark.parametrize("choice", [0, -1, True, 1.5, "many"])
def test_a_wrong_number_of_selected_frames_says_what_is_right(choice):
    with pytest.raises(SettingsError, match=r"--selected-frames: .*auto, workers or a number"):
        selected_count(10, choice, 1)


def test_cost_counts_samples_of_all_frames():
    cost = estimate_cost(settings(spp=4), [1, 5])
    assert cost.camera_samples == 20 * 8 * 6 * 4
    assert cost.first_pass_rays == 2 * 128
    assert cost.audit_rays == 20 * 8 * 6 * (1 + 4)
    cache = settings().cache
    strata = cache.polar_strata * cache.azimuth_strata
    assert cost.paths_per_record == (strata + cache.paths[0], strata + cache.paths[-1])


def test_cost_of_path_tracing_has_no_cache_in_it():
    cost = estimate_cost(settings(mode="path"), [])
    assert (cost.first_pass_rays, cost.audit_rays, cost.paths_per_record) == (0, 0, None)


def corridor_of_parts():
    """A partition of a corridor of 40 m along which the camera of 20 frames walks; nobody sees far."""
    splits = ((0, 20.0), (0, 10.0), (0, 30.0))
    return Partition(splits, 0.5, Cube((-2.0, -2.0, -2.0), 44.0), ((0, 1), (1, 2, 3), (2, 3)))


def in_parts(**changes):
    partition = corridor_of_parts()
    return partition, by_key(make_tasks(settings(**changes), [1, 10, 20], partition))


def test_a_cache_in_parts_is_merged_covered_and_finished_by_part():
    _, tasks = in_parts()
    stages = [task.stage for task in tasks.values()]
    counts = {"gather": 3, "merge": 4, "audit": 6, "cover": 8, "finish": 4, "shade": 20, "join": 1}
    assert {stage: stages.count(stage) for stage in STAGES} == counts
    assert tasks["merge-001"].outputs[0] == "cache/merged_001.safetensors"
    assert tasks["cover-2-003"].outputs[0] == "cache/covered_2_003.safetensors"
    assert tasks["finish-000"].outputs[0] == "cache/finished_000.safetensors"
    assert tasks["join"].outputs[0] == "cache/merged.safetensors"
    assert not [key for key, task in tasks.items() if "join" in task.needs]


def test_every_task_of_a_cache_in_parts_reads_what_it_needs_and_no_more():
    _, tasks = in_parts()
    for task in tasks.values():
        made = {tasks[need].outputs[0] for need in task.needs}
        assert made == {*task.arguments["cache"], *task.arguments["inputs"]}
    outputs = [output for task in tasks.values() for output in task.outputs]
    assert len(outputs) == len(set(outputs))
    done = set()
    for task in tasks.values():
        assert done.issuperset(task.needs)
        done.add(task.key)


def test_a_window_reads_the_parts_that_it_sees_and_a_part_hears_the_windows_that_see_it():
    partition, tasks = in_parts()
    assert tasks["audit-1-0001"].arguments["cache"] == [f"cache/merged_{n:03d}.safetensors" for n in (0, 1)]
    assert tasks["shade-00020"].needs == ("finish-002", "finish-003")
    assert tasks["cover-2-002"].needs == ("cover-1-002", "audit-2-0002", "audit-2-0003")
    assert tasks["cover-2-002"].arguments["windows"] == [1, 2]
    assert tasks["merge-000"].needs == ("gather-00001", "gather-00010")  # one sees a neighbour only
    assert tasks["finish-000"].arguments["cache"][0] == "cache/covered_2_000.safetensors"
    assert set(tasks["finish-000"].needs) == {f"cover-2-{n:03d}" for n in partition.around([0])}


def test_one_part_has_the_plan_of_the_whole_cache():
    frames = settings()
    whole = Partition.whole(len(windows_of(frames.frames)))
    assert make_tasks(frames, [2, 12], whole) == make_tasks(frames, [2, 12])


@pytest.mark.parametrize(
    ("frames", "choice", "parts"),
    [
        (91, "auto", 1),
        (399, "auto", 1),
        (400, "auto", 16),
        (1441, "auto", 64),
        (99999, "auto", 64),
        (9, 3, 3),
    ],
)
def test_number_of_parts(frames, choice, parts):
    assert part_count(frames, choice, "two-pass", "full") == parts


@pytest.mark.parametrize(
    ("mode", "coverage"), [("single-pass", "full"), ("path", "full"), ("two-pass", "off")]
)
def test_only_a_shared_cache_with_coverage_has_parts(mode, coverage):
    assert part_count(5000, "auto", mode, coverage) == part_count(5000, 1, mode, coverage) == 1
    with pytest.raises(SettingsError, match=r"--cache-parts: 4 .*--mode two-pass with --coverage full"):
        part_count(5000, 4, mode, coverage)
