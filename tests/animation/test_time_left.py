"""How long the rest of a run takes: from its own tasks, and where none of a stage is done, from what is usual."""

from __future__ import annotations

from collections import Counter

import pytest

from steadylight.animation.cache_tasks import Files, make_task
from steadylight.animation.time_left import KERNELS, TimeLeft, usual
from steadylight.settings import RenderSettings

STAGES = [
    "prepare",
    "look",
    "look",
    *["gather"] * 8,
    "merge",
    "audit",
    "audit",
    "fill",
    "smooth",
    *["shade"] * 20,
]
TASKS = [make_task(stage, f"{n:03d}", Files(), f"{stage}_{n}") for n, stage in enumerate(STAGES)]


def left_after(done: int) -> Counter[str]:
    return Counter(STAGES[done:])


FILM = {"width": 320, "height": 180, "frames": tuple(range(1, 21))}
SETTINGS = RenderSettings(**FILM)
USUAL = usual(SETTINGS)


def test_nothing_is_said_while_nothing_is_known_of_light_paths() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    assert estimate.seconds(left_after(0), 1) is None
    estimate.add("look", 1.0, "a")  # while another worker prepares
    assert estimate.seconds(left_after(0) - Counter({"look": 1}), 1) is None


def test_preparing_foretells_all_that_comes_after_it() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("prepare", 10.0 + KERNELS["prepare"], "a")
    rest = sum(USUAL[stage] for stage in left_after(1))  # each stage once
    assert estimate.seconds(left_after(1), 1) == pytest.approx(10.0 * rest)


def test_stages_of_light_paths_foretell_others_and_no_stage_else_does_beside_them() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("gather", 4.0)
    foretold = estimate.seconds(Counter({"shade": 20}), 1)
    estimate.add("look", 0.2)
    assert estimate.seconds(Counter({"shade": 20}), 1) == foretold
    estimate.add("gather", 8.0)
    assert (estimate.seconds(Counter({"shade": 20}), 1) or 0) > 1.2 * (foretold or 0)


def test_stages_without_a_task_take_what_is_usual_beside_those_that_are_known() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    for _ in range(8):
        estimate.add("gather", 10.0 * USUAL["gather"] / 8)
    rest = sum(USUAL[stage] for stage in left_after(11))
    assert estimate.seconds(left_after(11), 1) == pytest.approx(10.0 * rest)


def test_frames_of_more_samples_are_expected_to_take_longer() -> None:
    few, many = (TimeLeft(TASKS, RenderSettings(**FILM, spp=spp)) for spp in (16, 64))
    for estimate in (few, many):
        estimate.add("gather", 5.0)
    frames = Counter({"shade": 20})
    assert many.seconds(frames, 1) == pytest.approx(4 * (few.seconds(frames, 1) or 0))


def test_the_first_task_of_a_worker_counts_only_while_there_is_no_other() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("shade", 6.0, "a")
    frames = Counter({"shade": 10})
    assert estimate.seconds(frames, 1) == pytest.approx(10 * (6.0 - 1.0))
    estimate.add("shade", 2.0, "a")
    estimate.add("shade", 7.0, "b")
    assert estimate.seconds(frames, 1) == pytest.approx(10 * 2.0)


def test_workers_share_what_is_left_but_no_single_task() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("shade", 2.0)
    estimate.add("smooth", 3.0)
    assert estimate.seconds(Counter({"shade": 10, "smooth": 1}), 4) == pytest.approx(10 * 2.0 / 4 + 3.0)


def test_a_run_that_is_done_has_nothing_left() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("shade", 2.0)
    assert estimate.seconds(Counter(), 2) == 0.0


def test_a_first_frame_that_compiled_its_kernels_does_not_stand_for_the_others() -> None:
    estimate = TimeLeft(TASKS, SETTINGS)
    estimate.add("gather", 1.0)
    foretold = estimate.seconds(Counter({"shade": 20}), 1)
    estimate.add("shade", 60.0, "a")
    assert estimate.seconds(Counter({"shade": 20}), 1) == foretold


def test_workers_of_one_machine_share_the_cores_that_preparing_had() -> None:
    one, two = TimeLeft(TASKS, SETTINGS), TimeLeft(TASKS, SETTINGS)
    for estimate, other in ((one, "b here:2"), (two, "b there:2")):
        estimate.add("prepare", 10.0, "a here:1")
        estimate.add("merge", 1.0, other)
    frames = Counter({"shade": 20})
    assert one.seconds(frames, 2) == pytest.approx(2 * (two.seconds(frames, 2) or 0))
