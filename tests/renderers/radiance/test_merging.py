"""Caches of many frames become one, in whatever order they come."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.renderers.radiance.ambient import record_type, stored_numbers
from steadylight.renderers.radiance.merging import thinned, united

UP, DOWN = 0o10, 0o10 | 0o4
"""Radiance's codes of the directions +z and -z."""


def records(*rows):
    """Records of (x, radius, weight, level, normal)."""
    made = np.zeros(len(rows), record_type())
    for record, (x, radius, weight, level, normal) in zip(made, rows, strict=True):
        record["position"] = stored_numbers(np.array([x, 0.0, 0.0]))
        record["radius"] = stored_numbers(np.array([radius, radius]))
        record["weight"] = stored_numbers(np.array(weight))
        record["level"], record["normal"] = level, normal
        record["axis"] = 0x5A9D << 5
    return made


def ways(made):
    return {bytes(record.tobytes()) for record in made}


def test_equal_records_are_kept_once_in_the_order_of_their_bytes():
    a, b = records((1, 1, 1, 0, UP)), records((2, 1, 1, 0, UP))
    assert np.array_equal(united([a, b, a]), united([b, a]))
    assert len(united([a, b, a])) == 2


@pytest.mark.parametrize(("distance", "kept"), [(0.04, 1), (0.06, 2)])
def test_a_record_goes_where_a_better_one_is_near(distance, kept):
    # A quarter of the reach of both, 0.2, is 0.05.
    pair = records((0, 1, 1.0, 0, UP), (distance, 1, 0.5, 0, UP))
    left = thinned(pair, accuracy=0.2)
    assert len(left) == kept
    assert ways(pair[:1]) <= ways(left)


def test_a_record_that_reaches_less_far_is_the_better_one():
    pair = records((0, 2, 1.0, 0, UP), (0.01, 1, 1.0, 0, UP))
    assert ways(thinned(pair, accuracy=0.2)) == ways(pair[1:])


def test_other_levels_and_other_sides_stay():
    near = records((0, 1, 1.0, 0, UP), (0.01, 1, 1.0, 1, UP), (0.02, 1, 1.0, 0, DOWN))
    assert len(thinned(near, accuracy=0.2)) == 3


def test_the_order_of_records_does_not_matter():
    rng = np.random.default_rng(0)
    many = records(*((rng.uniform(0, 3), rng.uniform(0.2, 2), 1.0, 0, UP) for _ in range(200)))
    left = thinned(many, accuracy=0.2)
    assert 20 < len(left) < 200
    assert np.array_equal(thinned(many[rng.permutation(200)], accuracy=0.2), left)
