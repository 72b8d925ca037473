from __future__ import annotations

from typing import Any

import numpy as np

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import look_up, pair_weights
from steadylight.cache.placement import (
    answered_weight,
    least_nearby,
    rows_in_box,
    select,
    thin,
    thin_and_count,
    totals,
)
from steadylight.cache.records import Records

Points = tuple[np.ndarray, np.ndarray, np.ndarray]


def scattered(seed: int, count: int = 1500) -> Points:
    """Points on two crossing walls, with spacings from 0.03 to 0.3."""
    rng = np.random.default_rng(seed)
    position = rng.random((count, 3), np.float32)
    floor = rng.random(count) < 0.5
    position[floor, 2] = 0
    position[~floor, 0] = 0
    normal = np.where(floor[:, None], np.float32([0, 0, 1]), np.float32([1, 0, 0]))
    return position, normal, rng.uniform(0.03, 0.3, count).astype(np.float32)


def test_no_two_selected_points_conflict_and_every_point_left_out_has_a_reason() -> None:
    position, normal, spacing = scattered(1)
    rows = select(position, normal, spacing)
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    compatible = normal @ normal.T > 1 - NORMAL_TOLERANCE
    conflict = compatible & (distance < np.minimum(spacing[:, None], spacing[None]))
    np.fill_diagonal(conflict, False)
    assert not conflict[np.ix_(rows, rows)].any()
    # Whoever is out shares a cell with an earlier point, or conflicts with an earlier point that is in.
    left = np.setdiff1d(thin(position, normal, spacing), rows)
    assert all(conflict[row, rows[rows < row]].any() for row in left)


def test_an_earlier_point_wins() -> None:
    # Each point conflicts with its neighbours; no two share a cell.
    line = np.float32([[0.05, 0, 0], [0.1, 0, 0], [0.15, 0, 0], [0.2, 0, 0]])
    up = np.repeat(np.float32([[0, 0, 1]]), 4, 0)
    spacing = np.full(4, 0.06, np.float32)
    np.testing.assert_array_equal(select(line, up, spacing), [0, 2])
    np.testing.assert_array_equal(select(line[::-1].copy(), up, spacing), [0, 2])
    second_first = line[[1, 0, 2, 3]]
    np.testing.assert_array_equal(second_first[select(second_first, up, spacing)], line[[1, 3]])


def test_points_of_unlike_normals_do_not_compete() -> None:
    position = np.zeros((2, 3), np.float32)
    normal = np.float32([[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(select(position, normal, np.ones(2, np.float32)), [0, 1])


def test_selection_and_thinning_depend_on_nothing_but_the_points() -> None:
    points = scattered(2)
    np.testing.assert_array_equal(select(*points), select(*(array.copy() for array in points)))
    np.testing.assert_array_equal(thin(*points), thin(*(array.copy() for array in points)))


def test_thinning_keeps_the_first_point_of_each_cell() -> None:
    position = np.float32([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.6, 0.1, 0.1], [0.3, 0.3, 0.3]])
    up = np.repeat(np.float32([[0, 0, 1]]), 4, 0)
    # A spacing of 0.7 is rounded down to cells of 0.5.
    np.testing.assert_array_equal(thin(position, up, np.full(4, 0.7, np.float32)), [0, 2])
    tilted = up.copy()
    tilted[3] = [1, 0, 0]
    np.testing.assert_array_equal(thin(position, tilted, np.full(4, 0.7, np.float32)), [0, 2, 3])


def test_what_points_of_a_cell_stand_for_is_added_up() -> None:
    position = np.float32([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.6, 0.1, 0.1], [0.3, 0.3, 0.3]])
    up = np.repeat(np.float32([[0, 0, 1]]), 4, 0)
    number = np.float32([1, 4, 2, 1])
    np.testing.assert_array_equal(totals(position, up, np.full(4, 0.7, np.float32), number), [6, 6, 2, 6])


def test_thinning_and_counting_at_once_agrees_with_either() -> None:
    rng = np.random.default_rng(7)
    position = rng.random((5000, 3), np.float32)
    normal = np.tile(np.array([0, 0, 1], np.float32), (5000, 1))
    spacing = rng.choice(np.array([0.1, 0.3], np.float32), 5000)
    number = rng.integers(1, 9, 5000).astype(np.float32)
    rank = rng.integers(0, 20, 5000).astype(np.float32)
    rows, counted = thin_and_count(position, normal, spacing, number, rank)
    by_rank = np.argsort(rank, kind="stable")  # the first of a cell is now the one of least rank
    np.testing.assert_array_equal(rows, by_rank[thin(position[by_rank], normal, spacing[by_rank])])
    np.testing.assert_array_equal(counted, totals(position, normal, spacing, number)[rows])
    assert 100 < len(rows) < 4000
    none = np.zeros((0, 3), np.float32)
    assert [len(each) for each in thin_and_count(none, none, spacing[:0], number[:0], rank[:0])] == [0, 0]


def test_a_point_asks_for_the_least_that_is_asked_for_in_its_own_cell() -> None:
    # Two frames: one from afar asks for 0.5 everywhere, another from near for 0.1 at one place.
    position = np.float32([[0.1, 0.1, 0], [0.4, 0.4, 0], [0.3, 0.2, 0], [0.9, 0.1, 0], [0.3, 0.2, 0]])
    normal = np.repeat(np.float32([[0, 0, 1]]), 5, 0)
    normal[4] = [1, 0, 0]
    wanted = np.float32([0.5, 0.5, 0.1, 0.5, 0.5])
    # The last faces elsewhere, and the one before stands in another cell; what is asked for least stays.
    np.testing.assert_array_equal(
        least_nearby(position, normal, wanted), np.float32([0.1, 0.1, 0.1, 0.5, 0.5])
    )


def test_boxes_hold_about_as_many_points_each() -> None:
    position = np.random.default_rng(1).random((30_000, 3), np.float32) ** 2
    np.testing.assert_array_equal(rows_in_box(position, 0, 1), np.arange(30_000))
    parts = [rows_in_box(position, number, 5) for number in range(5)]
    assert min(map(len, parts)) > 0.9 * 6000
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(30_000))  # each in one box
    box = np.zeros(30_000, int)
    for number, rows in enumerate(parts):
        box[rows] = number
    for number in range(5):
        inside = position[box == number]
        low, high = inside.min(axis=0), inside.max(axis=0)
        assert (box[((position >= low) & (position <= high)).all(axis=1)] == number).all()


def test_nothing_is_selected_from_nothing() -> None:
    none = np.zeros((0, 3), np.float32)
    assert len(thin(none, none, np.zeros(0, np.float32))) == 0
    assert len(select(none, none, np.zeros(0, np.float32))) == 0


def test_answered_weights_are_those_of_the_look_up(records_of: Any, queries_about: Any) -> None:
    records = records_of(3, 80)
    position, normal = queries_about(4, records, 5)
    expected = look_up(position, normal, records).weight
    assert (expected > 0).mean() > 0.3
    # The same pairs, added up in another order.
    weight = answered_weight(position, normal, np.full(len(position), np.inf), records)
    np.testing.assert_allclose(weight, expected, rtol=1e-5, atol=1e-6)


def test_answered_weights_are_the_same_bytes_however_many_pairs_are_looked_at_together(
    records_of: Any, queries_about: Any, monkeypatch: Any
) -> None:
    records = records_of(3, 80)
    points = (*queries_about(4, records, 5), np.full(400, np.inf, np.float32))
    whole = answered_weight(*points, records)
    for pairs in (1, 100, 1000):
        monkeypatch.setattr("steadylight.cache.compatibility.PAIRS_AT_ONCE", pairs)
        np.testing.assert_array_equal(answered_weight(*points, records), whole)


def test_records_that_reach_further_than_a_point_trusts_do_not_answer_it(
    records_of: Any, queries_about: Any
) -> None:
    records = records_of(5, 80)
    position, normal = queries_about(6, records, 5)
    longest = np.random.default_rng(7).choice(records.radius, len(position))  # equal reaches are trusted
    weights = pair_weights(position[:, None], normal[:, None], records)
    trusted = records.radius <= longest[:, None]
    expected = (weights * trusted).sum(axis=1)
    assert 0.1 < (expected < weights.sum(axis=1)).mean() < 0.9
    weight = answered_weight(position, normal, longest, records)
    np.testing.assert_allclose(weight, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(answered_weight(position, normal, 0 * longest, records), 0)


def test_no_records_or_no_points_answer_nothing(records_of: Any) -> None:
    none = np.zeros((0, 3), np.float32)
    assert len(answered_weight(none, none, none[:, 0], records_of(1, 5))) == 0
    points = scattered(1, 7)
    np.testing.assert_array_equal(answered_weight(*points, Records.empty()), np.zeros(7))
