"""Records that reach to where others measured another light lose radius, and others do not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from steadylight.cache.disagreement import agreeing_radius, left_to_the_strongest
from steadylight.cache.lookup import pair_weights
from steadylight.cache.records import Records
from steadylight.cache.smoothing import Smoothing

NONE = np.zeros(2, np.float32)
SMOOTHING = Smoothing()


def agreeing(records: Records, smallest: np.ndarray = NONE) -> np.ndarray:
    return agreeing_radius(records, smallest, SMOOTHING)


@pytest.fixture
def two(records_of: Any) -> Records:
    """Records of 2 m radius on a floor, 1 m apart, that measured irradiance 1 and 3 without noise."""
    made = records_of(1, 2)
    flat = {name: np.zeros_like(getattr(made, name)) for name in ("translation", "rotation", "curvature")}
    return dataclasses.replace(
        made,
        position=np.float32([[0, 0, 0], [1, 0, 0]]),
        normal=np.float32([[0, 0, 1]] * 2),
        irradiance=np.float32([1, 3])[:, None, None] * np.ones((2, 1, 3), np.float32),
        radius=np.full(2, 2, np.float32),
        standard_error=np.zeros((2, 1), np.float32),
        headroom=np.full(2, np.inf, np.float32),
        barriers=np.zeros((2, 2, 3), np.float32),
        **flat,
    )


def test_a_record_ends_where_what_it_leaves_out_would_grow_beyond_the_tolerance(two: Records) -> None:
    # Each is wrong by 2 where the other stands, which tolerates a part of what it measured.
    expected = np.sqrt(SMOOTHING.tolerance * np.array([3, 1]) / 2)
    np.testing.assert_allclose(agreeing(two), expected, rtol=1e-6)


def test_records_agree_if_their_gradients_tell_the_difference(two: Records) -> None:
    translation = np.zeros_like(two.translation)
    translation[..., 0] = 2.0
    leaning = dataclasses.replace(two, translation=translation)
    np.testing.assert_array_equal(agreeing(leaning), two.radius)
    away = dataclasses.replace(two, translation=-translation)
    assert (agreeing(away) < agreeing(two)).all()


def test_records_agree_if_noise_may_be_the_difference(two: Records) -> None:
    error = 2 / SMOOTHING.errors / np.sqrt(2)
    noisy = dataclasses.replace(two, standard_error=np.full((2, 1), error, np.float32))
    np.testing.assert_array_equal(agreeing(noisy), two.radius)
    quieter = dataclasses.replace(two, standard_error=np.full((2, 1), 0.5 * error, np.float32))
    assert (agreeing(quieter) < two.radius).all()


def test_no_radius_becomes_shorter_than_the_smallest_or_longer_than_it_was(two: Records) -> None:
    np.testing.assert_array_equal(agreeing(two, np.float32([0.5, 0.1])), np.float32([0.5, 0.1**0.5 / 2**0.5]))
    np.testing.assert_array_equal(agreeing(two, np.float32([3, 3])), two.radius)


@pytest.mark.parametrize(
    "change",
    [
        {"position": np.float32([[0, 0, 0], [2.1, 0, 0]])},
        {"normal": np.float32([[0, 0, 1], [1, 0, 0]])},
        {"headroom": np.float32([0.1, 0.1]), "position": np.float32([[0, 0, 0], [1, 0, 0.3]])},
    ],
    ids=["too far", "another wall", "over what covers it"],
)
def test_records_that_do_not_answer_at_each_others_place_are_not_compared(
    two: Records, change: dict[str, Any]
) -> None:
    apart = dataclasses.replace(two, **change)
    np.testing.assert_array_equal(agreeing(apart), two.radius)


def test_no_records_have_no_radii() -> None:
    assert len(agreeing(Records.empty(), np.zeros(0, np.float32))) == 0


def test_what_counted_most_at_a_point_tells_how_much_is_left_there(
    records_of: Any, queries_about: Any
) -> None:
    records = records_of(2, 40)
    position, normal = queries_about(3, records, 5)
    radius = records.radius * np.random.default_rng(4).random(40, np.float32)
    weight = pair_weights(position[:, None], normal[:, None], records)
    strongest = (weight / records.radius**2).argmax(axis=1)
    expected = np.where((weight > 0).any(axis=1), radius[strongest], np.inf)
    np.testing.assert_array_equal(left_to_the_strongest(position, normal, records, radius), expected)
    assert 0 < np.isfinite(expected).sum() < len(expected)
    assert np.isinf(left_to_the_strongest(position, normal, Records.empty(), radius[:0])).all()
