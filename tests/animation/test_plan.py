"""The plan: which tasks there are, what they need, and that the machine has no say in it."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest

from steadylight.animation.cost import estimate_cost
from steadylight.animation.plan import (
    FRAMES_PER_WINDOW,
    STAGES,
    make_tasks,
    part_count,
    selected_count,
    windows_of,
)
from steadylight.errors import SettingsError
from steadylight.renderers.base import Capabilities, Survey
from steadylight.settings import RenderSettings


def settings(**changes):
    return RenderSettings(**{"frames": range(1, 21), "width": 8, "height": 6, **changes})


CAN = Capabilities(("mitsuba",), ("two-pass", "single-pass", "path"), 2, parts=True, smoothing=True)
"""A renderer that can do everything."""


def tasks_of(selected=(2, 12), can=CAN, survey=None, **changes):
    return make_tasks(settings(**changes), selected, can, survey)


def by_key(tasks):
    return {task.key: task for task in tasks}


def test_two_pass_gathers_merges_audits_twice_and_shades():
    tasks = tasks_of([2, 12])
    keys = [task.key for task in tasks]
    assert keys[:3] == ["gather-00002", "gather-00012", "merge"]
    assert keys[3:7] == ["audit-1-0001", "audit-1-0002", "audit-1-0003", "fill-1"]
    assert keys[7:11] == ["audit-2-0001", "audit-2-0002", "audit-2-0003", "fill-2"]
    assert keys[11:] == ["smooth"] + [f"shade-{n:05d}" for n in range(1, 21)]


SURFACES = replace(CAN, surfaces=True, prepares=True)


def test_a_first_pass_by_surfaces_looks_along_all_frames_and_audits_once():
    tasks = by_key(tasks_of((), can=SURFACES, first_pass="surface"))
    windows = [f"{n:04d}" for n in (1, 2, 3)]
    keys = ["prepare", *(f"look-{n}" for n in windows), "gather-000", "merge"]
    keys += [*(f"audit-1-{n}" for n in windows), "fill-1", "smooth"]
    assert list(tasks) == [*keys, *(f"shade-{n:05d}" for n in range(1, 21))]
    looked = [f"cache/look_{n}.misses" for n in windows]
    missed = [f"cache/audit_1_{n}.misses" for n in windows]
    assert tasks["gather-000"].arguments["inputs"] == looked
    assert tasks["gather-000"].arguments["prepared"] == ["cache/prepared.prepared"]
    assert tasks["gather-000"].needs == ("prepare", *(f"look-{n}" for n in windows))
    assert tasks["smooth"].arguments["inputs"] == missed
    assert tasks["fill-1"].needs == ("prepare", "merge", *(f"audit-1-{n}" for n in windows))
    # What gloss shows faintly is answered from there.
    assert tasks["shade-00001"].arguments["prepared"] == ["cache/prepared.prepared"]
    assert tasks["shade-00001"].needs == ("prepare", "smooth")


def test_boxes_follow_from_the_pixels_of_the_film():
    tasks = by_key(tasks_of((), can=SURFACES, first_pass="surface", width=180, height=120))
    gathers = [task for task in tasks.values() if task.stage == "gather"]
    assert [task.arguments["box"] for task in gathers] == [[0, 2], [1, 2]]
    assert tasks["merge"].needs == ("gather-000", "gather-001")


def test_boxes_of_a_part_of_the_cache_read_the_windows_which_see_it():
    tasks = in_parts(can=SURFACES, first_pass="surface")
    boxes = [tasks[f"gather-{number:03d}"] for number in range(8, 12)]
    assert [task.arguments["box"] for task in boxes] == [[0, 4], [1, 4], [2, 4], [3, 4]]
    for task in boxes:
        assert task.arguments["part"] == 2
        assert task.arguments["inputs"] == ["cache/look_0002.misses", "cache/look_0003.misses"]
    assert tasks["merge-000"].needs == tuple(f"gather-{number:03d}" for number in range(8))
    assert tasks["smooth-000"].arguments["windows"] == [0]
    for task in tasks.values():
        made = {tasks[need].outputs[0] for need in task.needs}
        assert made == {name for kind in ("cache", "inputs", "prepared") for name in task.arguments[kind]}


def test_every_task_comes_after_what_it_needs():
    done = set()
    for task in tasks_of([2, 12]):
        assert done.issuperset(task.needs)
        done.add(task.key)


def test_what_a_task_reads_is_an_output_of_what_it_needs():
    tasks = by_key(tasks_of([2, 12]))
    for task in tasks.values():
        made, needs = set(), list(task.needs)
        while needs:
            need = tasks[needs.pop()]
            made.update(need.outputs)
            needs += need.needs
        assert made.issuperset(task.arguments["inputs"])
        assert made.issuperset(task.arguments["cache"])


def test_outputs_have_the_names_of_the_run_directory():
    tasks = by_key(tasks_of([12]))
    assert tasks["gather-00012"].outputs == (
        "cache/gather_00012.cache",
        "log/results/gather-00012.json",
    )
    assert tasks["merge"].outputs == ("cache/merged.cache", "log/results/merge.json")
    assert tasks["audit-1-0003"].outputs[0] == "cache/audit_1_0003.misses"
    assert tasks["fill-2"].outputs[0] == "cache/filled_2.cache"
    assert tasks["shade-00012"].outputs == ("frames/frame_00012.exr", "log/results/shade-00012.json")


def test_no_two_tasks_write_the_same_file():
    outputs = [output for task in tasks_of([2, 12]) for output in task.outputs]
    assert len(outputs) == len(set(outputs))


def test_the_second_pass_reads_the_last_cache_of_the_audit_smoothed():
    tasks = by_key(tasks_of([12]))
    assert tasks["audit-1-0001"].arguments["cache"] == ["cache/merged.cache"]
    assert tasks["audit-2-0001"].arguments["cache"] == ["cache/filled_1.cache"]
    assert tasks["smooth"].arguments["cache"] == ["cache/filled_2.cache"]
    assert tasks["shade-00001"].arguments["cache"] == ["cache/smoothed.cache"]


def test_without_coverage_the_second_pass_follows_the_merge():
    tasks = by_key(tasks_of([12], coverage="off"))
    assert {task.stage for task in tasks.values()} == {"gather", "merge", "shade"}
    assert tasks["shade-00001"].needs == ("merge",)
    assert tasks["shade-00001"].arguments["cache"] == ["cache/merged.cache"]


@pytest.mark.parametrize("mode", ["single-pass", "path"])
def test_modes_without_a_shared_cache_only_shade(mode):
    tasks = tasks_of([], mode=mode)
    assert [task.stage for task in tasks] == ["shade"] * 20
    assert all(not task.needs and task.arguments["cache"] == [] for task in tasks)


def test_audits_cover_every_frame_once_in_windows_of_fixed_size():
    frames = (3, 6, *range(10, 27))
    windows = [
        task.arguments["frames"]
        for task in tasks_of([3], frames=frames)
        if task.stage == "audit" and task.arguments["round"] == 1
    ]
    assert [n for window in windows for n in window] == list(frames)
    assert {len(window) for window in windows[:-1]} == {FRAMES_PER_WINDOW}


def test_frames_keep_their_own_numbers():
    tasks = tasks_of([], frames=(30, 75), mode="path")
    assert [task.outputs[0] for task in tasks] == ["frames/frame_00030.exr", "frames/frame_00075.exr"]


def test_tasks_are_plain_data_and_the_same_every_time():
    tasks = tasks_of([2, 12])
    assert pickle.loads(pickle.dumps(tasks)) == tasks == tasks_of([2, 12])
    assert {task.stage for task in tasks} == set(STAGES) - {"prepare", "look", "concatenate", "aovs"}


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
    with pytest.raises(SettingsError, match=r"--selected-frames: .*auto, workers or a positive"):
        selected_count(10, choice, 1)


def test_cost_counts_samples_of_all_frames():
    cost = estimate_cost(settings(spp=4), [1, 5], CAN)
    assert cost.camera_samples == 20 * 8 * 6 * 4
    assert cost.first_pass_rays == 2 * 128
    assert cost.audited_frames == 2 * 20


def test_cost_of_path_tracing_has_no_cache_in_it():
    cost = estimate_cost(settings(mode="path"), [], CAN)
    assert (cost.first_pass_rays, cost.audited_frames) == (0, 0)


def stages_of(tasks):
    return [stage for stage in STAGES if stage in {task.stage for task in tasks}]


def test_a_renderer_without_an_audit_has_none_but_may_smooth():
    plain = replace(CAN, audit_rounds=0, smoothing=False)
    assert stages_of(tasks_of(can=plain)) == ["gather", "merge", "shade"]
    tasks = by_key(tasks_of(can=replace(plain, smoothing=True)))
    assert stages_of(tasks.values()) == ["gather", "merge", "smooth", "shade"]
    assert tasks["shade-00001"].needs == ("smooth",)


def test_a_renderer_has_as_many_rounds_of_the_audit_as_it_says_and_its_own_suffixes():
    can = replace(CAN, audit_rounds=5, smoothing=False, cache_suffix=".amb", misses_suffix=".new")
    tasks = by_key(tasks_of(can=can))
    assert [key for key in tasks if key.startswith("fill")] == [f"fill-{n}" for n in range(1, 6)]
    assert tasks["audit-5-0001"].outputs[0] == "cache/audit_5_0001.new"
    assert tasks["shade-00001"].arguments["cache"] == ["cache/filled_5.amb"]


def corridor_of_parts():
    """A corridor in four parts along which the camera of 20 frames walks; nobody sees far."""
    return Survey(((0, 1), (1, 2, 3), (2, 3)), ((1,), (0, 2), (1, 3), (2,)))


def in_parts(**changes):
    return by_key(tasks_of([1, 10, 20], survey=corridor_of_parts(), **changes))


def test_a_cache_in_parts_is_merged_filled_and_smoothed_by_part():
    tasks = in_parts()
    stages = [task.stage for task in tasks.values()]
    counts = {"gather": 3, "merge": 4, "audit": 6, "fill": 8, "smooth": 4, "shade": 20, "concatenate": 1}
    assert {stage: stages.count(stage) for stage in STAGES if stage in stages} == counts
    assert tasks["merge-001"].outputs[0] == "cache/merged_001.cache"
    assert tasks["fill-2-003"].outputs[0] == "cache/filled_2_003.cache"
    assert tasks["smooth-000"].outputs[0] == "cache/smoothed_000.cache"
    assert tasks["concatenate"].outputs[0] == "cache/merged.cache"
    assert not [key for key, task in tasks.items() if "concatenate" in task.needs]


def test_every_task_of_a_cache_in_parts_reads_what_it_needs_and_no_more():
    tasks = in_parts()
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
    tasks = in_parts()
    assert tasks["audit-1-0001"].arguments["cache"] == [f"cache/merged_{n:03d}.cache" for n in (0, 1)]
    assert tasks["shade-00020"].needs == ("smooth-002", "smooth-003")
    assert tasks["fill-2-002"].needs == ("fill-1-002", "audit-2-0002", "audit-2-0003")
    assert tasks["fill-2-002"].arguments["windows"] == [1, 2]
    assert tasks["merge-000"].needs == ("gather-00001", "gather-00010")  # one sees a neighbour only
    assert tasks["smooth-000"].arguments["cache"][0] == "cache/filled_2_000.cache"
    assert set(tasks["smooth-000"].needs) == {"fill-2-000", "fill-2-001"}


def test_one_part_has_the_plan_of_the_whole_cache():
    windows = len(windows_of(settings().frames))
    assert tasks_of(survey=Survey.undivided(windows)) == tasks_of()


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
    assert part_count(frames, choice, shared=True) == parts


def test_only_a_cache_that_is_shared_and_final_has_parts():
    assert part_count(5000, "auto", shared=False) == part_count(5000, 1, shared=False) == 1
    with pytest.raises(SettingsError, match=r"--cache-parts: 4 needs --mode two-pass, --coverage full"):
        part_count(5000, 4, shared=False)


def test_aovs_are_tasks_of_their_own_that_wait_for_nothing_and_change_no_other():
    plain = tasks_of(mode="two-pass")
    seen = make_tasks(settings(mode="two-pass"), (2, 12), CAN, aovs=True)
    added = [task for task in seen if task.stage == "aovs"]
    assert [task for task in seen if task.stage != "aovs"] == list(plain)
    assert [task.outputs[0] for task in added] == [f"aovs/frame_{n:05d}.exr" for n in settings().frames]
    assert not any(task.needs for task in added)
