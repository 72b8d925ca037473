"""How long the rest of a run takes: from its own tasks, and where none of a stage is done, from what is usual."""

from __future__ import annotations

from collections import Counter

import pytest

from steadylight.animation.cache_tasks import Files, make_task
from steadylight.animation.time_left import KERNELS, USUAL, TimeLeft

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


def test_nothing_is_said_while_nothing_is_known() -> None:
    estimate = TimeLeft(TASKS, spp=16)
    assert estimate.seconds(left_after(0), 1) is None
    estimate.add("prepare", 10.0, "a")  # does not grow with the film
    assert estimate.seconds(left_after(1), 1) is None


def test_stages_without_a_task_take_what_is_usual_beside_those_that_are_known() -> None:
    estimate = TimeLeft(TASKS, spp=16)
    for _ in range(2):
        estimate.add("look", 5.0)
    usual = sum(USUAL[stage] for stage in left_after(3))  # each stage once
    assert estimate.seconds(left_after(3), 1) == pytest.approx(10.0 * usual)


def test_frames_of_more_samples_are_expected_to_take_longer() -> None:
    few, many = TimeLeft(TASKS, spp=16), TimeLeft(TASKS, spp=64)
    for estimate in (few, many):
        estimate.add("look", 5.0)
    frames = Counter({"shade": 20})
    assert many.seconds(frames, 1) == pytest.approx(4 * (few.seconds(frames, 1) or 0))


def test_the_first_task_of_a_worker_counts_only_while_there_is_no_other() -> None:
    estimate = TimeLeft(TASKS, spp=16)
    estimate.add("shade", 6.0, "a")
    frames = Counter({"shade": 10})
    assert estimate.seconds(frames, 1) == pytest.approx(10 * (6.0 - KERNELS))
    estimate.add("shade", 2.0, "a")
    estimate.add("shade", 7.0, "b")
    assert estimate.seconds(frames, 1) == pytest.approx(10 * 2.0)


def test_workers_share_what_is_left_but_no_single_task() -> None:
    estimate = TimeLeft(TASKS, spp=16)
    estimate.add("shade", 2.0)
    estimate.add("smooth", 3.0)
    assert estimate.seconds(Counter({"shade": 10, "smooth": 1}), 4) == pytest.approx(10 * 2.0 / 4 + 3.0)


def test_a_run_that_is_done_has_nothing_left() -> None:
    estimate = TimeLeft(TASKS, spp=16)
    estimate.add("shade", 2.0)
    assert estimate.seconds(Counter(), 2) == 0.0
