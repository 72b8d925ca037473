from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.compatibility import (
    NORMAL_TOLERANCE,
    compatible,
    compatible_neighbours,
    first_come,
    pairs_within,
)
from steadylight.cache.lookup import pair_weights
from steadylight.cache.records import Records

UP = np.float32([0, 0, 1])


def leaning(degrees: float) -> np.ndarray:
    return np.float32([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])


@pytest.mark.parametrize("part", [1.0, 0.125])
def test_normals_are_compatible_up_to_the_tolerance_or_a_part_of_it(part: float) -> None:
    border = np.degrees(np.arccos(1 - part * NORMAL_TOLERANCE))
    inside, outside = leaning(0.99 * border), leaning(1.01 * border)
    np.testing.assert_array_equal(
        compatible(np.stack([inside, outside, -UP]), UP, part), [True, False, False]
    )


def test_a_record_answers_at_its_own_place_exactly_for_compatible_normals(records_of: Any) -> None:
    records = records_of(1, 400)
    other = np.roll(records.normal, 1, axis=0)
    answers = pair_weights(records.position, other, records) > 0
    np.testing.assert_array_equal(answers, compatible(records.normal, other))
    assert 0 < answers.mean() < 1


def test_neighbours_are_the_nearest_that_face_alike_and_are_near_enough() -> None:
    position = np.float32([[0, 0, 0], [1, 0, 0], [3, 0, 0], [5.5, 0, 0]])
    normal = np.stack([UP, UP, -UP, UP])
    near = compatible_neighbours(position, normal, 3, within=np.float32([2, 2, 2, 9]))
    np.testing.assert_array_equal(near.rows, [[0, 1, 2], [1, 0, 2], [2, 1, 3], [3, 2, 1]])
    expected = [[True, True, False], [True, True, False], [True, False, False], [True, False, True]]
    np.testing.assert_array_equal(near.compatible, expected)


@pytest.mark.parametrize("sites", [0, 1, 2])
def test_few_sites_have_few_neighbours(sites: int) -> None:
    position = np.arange(3 * sites, dtype=np.float32).reshape(sites, 3)
    near = compatible_neighbours(position, np.repeat(UP[None], sites, 0), 8)
    assert near.rows.shape == near.compatible.shape == (sites, sites)
    assert near.compatible.all()


@pytest.mark.parametrize("at_once", [1, 50, 1 << 22])
def test_pairs_are_all_that_are_near_whatever_the_portions(
    records_of: Any, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr("steadylight.cache.compatibility.PAIRS_AT_ONCE", at_once)
    records: Records = records_of(2, 60)
    portions = list(pairs_within(records.position[:40], records.position, records.radius))
    distance = np.linalg.norm(records.position[:, None] - records.position[:40], axis=2)
    place, site = np.nonzero(distance <= records.radius[:, None])
    np.testing.assert_array_equal(np.concatenate([pairs.place for pairs in portions]), place)
    np.testing.assert_array_equal(np.concatenate([pairs.site for pairs in portions]), site)
    covered = np.concatenate([np.arange(60)[pairs.places] for pairs in portions])
    np.testing.assert_array_equal(covered, np.arange(60))


def test_first_come_is_what_a_plain_loop_chooses() -> None:
    rng = np.random.default_rng(3)
    winner, loser = np.sort(rng.integers(80, size=(300, 2)), axis=1).T
    winner, loser = winner[winner != loser], loser[winner != loser]
    expected = np.ones(80, bool)
    for i in range(80):
        if expected[i]:
            expected[loser[winner == i]] = False
    np.testing.assert_array_equal(first_come(winner, loser, 80), expected)
    assert first_come(winner[:0], loser[:0], 5).all()
