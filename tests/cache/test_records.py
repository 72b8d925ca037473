from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.records import Records


def test_no_records_have_the_shapes_of_records() -> None:
    empty = Records.empty()
    assert len(empty) == 0
    assert empty.translation.shape == (0, 1, 3, 3)
    assert empty.radius.shape == (0,)
    assert len(Records.concatenate()) == len(Records.concatenate(empty, empty)) == 0


def test_concatenated_records_keep_the_order_of_their_parts(records_of: Any) -> None:
    first, second = records_of(1, 3), records_of(2, 2)
    both = Records.concatenate(first, Records.empty(), second)
    assert len(both) == 5
    for name in Records.SHAPES:
        expected = np.concatenate([getattr(first, name), getattr(second, name)])
        np.testing.assert_array_equal(getattr(both, name), expected)


def test_taken_records_come_in_the_order_asked_for_or_of_the_mask(records_of: Any) -> None:
    records = records_of(1, 4)
    np.testing.assert_array_equal(records.take(np.array([2, 0])).radius, records.radius[[2, 0]])
    mask = np.array([False, True, False, True])
    taken = records.take(mask)
    np.testing.assert_array_equal(taken.translation, records.translation[mask])
    assert all(getattr(taken, name).flags.c_contiguous for name in Records.SHAPES)
    assert len(records.take(np.zeros(0, np.intp))) == 0


def test_arrays_of_another_type_or_length_are_a_mistake_of_ours(records_of: Any) -> None:
    records = records_of(1, 3)
    arrays = {name: getattr(records, name) for name in Records.SHAPES}
    with pytest.raises(AssertionError, match="radius"):
        Records(**{**arrays, "radius": arrays["radius"].astype(np.float64)})
    with pytest.raises(AssertionError, match="normal"):
        Records(**{**arrays, "normal": arrays["normal"][:2]})


def test_a_record_may_hold_several_values_at_one_place(records_of: Any) -> None:
    records = records_of(1, 4, values=3)
    assert records.values == 3
    assert records.translation.shape == (4, 3, 3, 3)
    assert records.radius.shape == (4,)
    assert Records.concatenate(records, Records.empty(values=3)).values == 3
    assert Records.shapes(1) == Records.SHAPES
