"""Records that were not measured: they answer what records further off would, and nothing else."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from steadylight.cache.lookup import STRETCHED, look_up, pair_weights
from steadylight.cache.records import Records
from steadylight.cache.stretching import answerable, stretched


@pytest.fixture
def records(records_of: Any) -> Records:
    made: Records = records_of(3, 60)
    return dataclasses.replace(made, headroom=np.full(60, np.inf, np.float32))


def test_a_point_is_answerable_if_a_record_answers_there_with_a_longer_radius(
    records: Records, queries_about: Any
) -> None:
    position, normal = queries_about(4, records, 400)
    position = position + np.float32(0.5) * (position - position.mean(axis=0))
    weight = pair_weights(position[:, None], normal[:, None], records, slice(None), STRETCHED)
    found = answerable(position, normal, records)
    np.testing.assert_array_equal(found, (weight > 0).any(axis=1))
    assert 0 < found.sum() < len(found)
    assert not answerable(position, normal, Records.empty()).any()


def test_stretched_records_answer_everywhere_with_what_stands_around(
    records: Records, queries_about: Any
) -> None:
    flat = {name: np.zeros_like(getattr(records, name)) for name in ("translation", "rotation", "curvature")}
    even = np.broadcast_to(np.float32([3, 2, 1]), records.irradiance.shape).copy()
    same = dataclasses.replace(records, irradiance=even, **flat)
    position, normal = queries_about(5, same, 20)
    known = answerable(position, normal, same)
    position, normal = position[known], normal[known]
    radius = np.full(len(position), 0.01, np.float32)
    made = stretched(position, normal, radius, same)
    assert 0 < len(made) <= len(position)
    answer = look_up(position, normal, made)
    assert (answer.weight > 0).all()
    np.testing.assert_allclose(answer.irradiance, np.broadcast_to([3, 2, 1], (len(position), 3)), rtol=1e-5)
    np.testing.assert_array_equal(made.radius, np.float32(0.01))


def test_where_nothing_is_missed_nothing_is_made(records: Records) -> None:
    none = np.zeros((0, 3), np.float32)
    assert len(stretched(none, none, np.zeros(0, np.float32), records)) == 0
