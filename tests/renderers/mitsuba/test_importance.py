"""Which secondary records take more paths than others, and how many."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array
from small_scenes import described, lamp, random_records, renderer, room

from steadylight.renderers.mitsuba.records import secondary
from steadylight.renderers.mitsuba.records.exchange import Exchange
from steadylight.renderers.mitsuba.records.importance import (
    MOST_MORE_EXCHANGE,
    NOISE,
    Effort,
    importance,
    shared_out,
)

COUNT = 200


def test_importance_and_the_light_of_all_bounces_solve_their_equations() -> None:
    rng = np.random.default_rng(1)
    passed_on = rng.random((COUNT, COUNT))
    passed_on *= 0.8 / passed_on.sum(axis=1, keepdims=True)
    light = rng.random(COUNT)
    counts, all_light = importance(csr_array(passed_on), light, 1000, 1e-12)
    unit = np.eye(COUNT)
    np.testing.assert_allclose(all_light, np.linalg.solve(unit - passed_on, light), rtol=1e-6)
    np.testing.assert_allclose(counts, np.linalg.solve(unit - passed_on.T, passed_on.sum(axis=0)), rtol=1e-6)
    # What importance is for: what all receive of all bounces, from the light of one.
    np.testing.assert_allclose(counts @ light, (all_light - light).sum(), rtol=1e-6)


def test_with_a_number_of_bounces_importance_is_that_of_so_many() -> None:
    passed_on = csr_array(np.full((4, 4), 0.2))
    counts, all_light = importance(passed_on, np.ones(4), 2, 0)
    np.testing.assert_allclose(counts, 0.8 + 0.8**2)
    np.testing.assert_allclose(all_light, 1 + 0.8 + 0.8**2)


def test_records_that_light_the_room_take_more_paths_until_its_noise_is_as_aimed_at() -> None:
    counts = np.ones(COUNT)
    counts[:5] = 100
    error = np.full(COUNT, 2 * NOISE / np.sqrt((counts**2).sum()))  # twice the noise that is aimed at
    times = shared_out(counts, error, MOST_MORE_EXCHANGE)
    assert np.sqrt((np.square(counts * error) / times).sum()) <= NOISE
    assert (times[:5] == times[0]).all()
    assert times[0] > 1
    assert (times[5:] == 1).all()


@pytest.mark.parametrize("noise", [0, 0.99 * NOISE])
def test_where_noise_is_low_no_record_takes_more_paths(noise: float) -> None:
    times = shared_out(np.ones(COUNT), np.full(COUNT, noise / np.sqrt(COUNT)), MOST_MORE_EXCHANGE)
    assert (times == 1).all()


def test_paths_are_bounded_where_no_number_of_them_would_suffice() -> None:
    counts = np.random.default_rng(2).lognormal(0, 2, COUNT)
    times = shared_out(counts, np.ones(COUNT), MOST_MORE_EXCHANGE)
    assert times.max() > 1
    assert (times - 1).sum() <= MOST_MORE_EXCHANGE * COUNT
    assert (np.log2(times) % 2 == 0).all()  # powers of four


def test_what_a_record_measured_by_chance_does_not_decide_between_two_of_the_same_importance() -> None:
    error = np.random.default_rng(3).random(COUNT)
    assert len(np.unique(shared_out(np.ones(COUNT), error, MOST_MORE_EXCHANGE))) == 1


@pytest.fixture(scope="module")
def measured() -> Any:
    """A gather in a room, records that it measured there, and bounds of their radius."""
    made = renderer(described(room() | {"lamp": lamp()}), bounces="auto")
    made.use(made.prepare())
    filler = made._shared_filler
    gather = dataclasses.replace(filler.gather, quality=made.view.quality.secondary)
    return gather, secondary._of_first_bounce(gather, random_records(4, 30), filler.bounds, 5), filler.bounds


def test_records_that_take_four_times_the_paths_have_half_the_error_and_others_stay(measured: Any) -> None:
    gather, made, bounds = measured
    times = np.ones(len(made), np.intp)
    times[3::4] = 4
    again = secondary._measured_again(gather, made, bounds, times)
    np.testing.assert_array_equal(again.position, made.position)
    for name in ("irradiance", "radius", "guide"):
        np.testing.assert_array_equal(getattr(again, name)[times == 1], getattr(made, name)[times == 1])
    lit = (times == 4) & (made.standard_error[:, 0] > 0)
    assert lit.any()
    ratio = again.standard_error[lit].sum() / made.standard_error[lit].sum()
    assert 0.35 < ratio < 0.65


def test_paths_of_an_exchange_are_averaged_by_record(measured: Any) -> None:
    gather, made, _ = measured
    times = Effort.even(len(made)).exchange
    times[7] = 4
    exchange = Exchange(gather, made, times)
    received = exchange.passed_on(np.ones((len(made), 3)))
    by_hand = np.concatenate(
        [np.array(end.throughput.x).reshape(-1, exchange._paths).mean(axis=1) for end in exchange._ends]
    )
    assert len(by_hand) == len(made) + 3
    np.testing.assert_allclose(received[7, 0], by_hand[7:11].mean(), rtol=1e-5)
    np.testing.assert_allclose(received[8:, 0], by_hand[11:], rtol=1e-5, atol=1e-7)
