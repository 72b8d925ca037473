from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.compatibility import (
    NORMAL_TOLERANCE,
    CompatibleSites,
    compatible,
    compatible_neighbours,
    dominant_face,
    dominant_faces,
    first_come,
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


@pytest.mark.parametrize("tolerance", [NORMAL_TOLERANCE, 3 * NORMAL_TOLERANCE])
def test_dominant_faces_hold_every_compatible_normal(tolerance: float) -> None:
    rng = np.random.default_rng(1)
    # Corners, edges and faces of the sphere (where another axis may dominate the query), and all between.
    corners = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z])
    vectors = np.concatenate(
        [
            np.repeat(corners, 2000, 0) + 0.05 * rng.standard_normal((52000, 3)),
            rng.standard_normal((50000, 3)),
        ]
    )
    normal = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    # Lean each by up to the tolerance, towards anywhere.
    across = np.cross(normal, rng.standard_normal(normal.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    cosine = 1 - tolerance * rng.random((len(normal), 1)) ** 0.2
    query = cosine * normal + np.sqrt(1 - cosine**2) * across
    face = dominant_face(query)
    assert dominant_faces(normal.astype(np.float32), tolerance)[np.arange(len(query)), face].all()


def test_a_wall_is_in_no_tree_of_the_wall_opposite() -> None:
    walls = np.float32([[1, 0, 0], [0, 0, -1]])
    np.testing.assert_array_equal(dominant_faces(walls), [[1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1]])
    np.testing.assert_array_equal(dominant_face(walls), [0, 5])


@pytest.mark.parametrize("part", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("at_once", [1, 50, 1 << 22])
def test_pairs_are_all_that_are_near_and_compatible_whatever_the_portions(
    records_of: Any, monkeypatch: pytest.MonkeyPatch, at_once: int, part: float
) -> None:
    monkeypatch.setattr("steadylight.cache.compatibility.PAIRS_AT_ONCE", at_once)
    records: Records = records_of(2, 400)
    sites = CompatibleSites(records.position[:300], records.normal[:300], part)
    portions = list(sites.near(records.position, records.normal, records.radius))
    distance = np.linalg.norm(records.position[:, None] - records.position[:300], axis=2)
    near = (distance <= records.radius[:, None]) & compatible(
        records.normal[:, None], records.normal[:300], part
    )
    found = np.zeros_like(near)
    for pairs in portions:
        found[pairs.place, pairs.site] = True
        order = np.lexsort((pairs.site, pairs.place))
        np.testing.assert_array_equal(order, np.arange(len(order)))
        np.testing.assert_array_equal(pairs.place, pairs.places[pairs.at])
    np.testing.assert_array_equal(found, near)
    assert sum(len(pairs.site) for pairs in portions) == near.sum() > 300  # each once
    # Each place is in one portion, whether or not anything is near it.
    covered = np.sort(np.concatenate([pairs.places for pairs in portions]))
    np.testing.assert_array_equal(covered, np.arange(400))


def test_no_sites_make_no_pairs() -> None:
    none = np.zeros((0, 3), np.float32)
    (pairs,) = CompatibleSites(none, none).near(UP[None], UP[None], np.ones(1, np.float32))
    assert len(pairs.places) == 1
    assert len(pairs.site) == 0


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
