"""What the comparison with other renderers computes by itself; none of them is needed."""

import itertools

import numpy as np
import pytest
from radiance_film import QUALITIES
from rivals import Crossing, time_at


def test_time_at_equal_error_lies_on_the_line_between_logarithms():
    # Error falls with the square root of time, as a path tracer's.
    curve = [(4.0, 0.1), (1.0, 0.2), (16.0, 0.05)]
    crossing = time_at(0.1 / np.sqrt(2), curve)
    assert crossing.sign == "="
    assert crossing.seconds == pytest.approx(8.0)


def test_time_at_equal_error_takes_a_setting_that_has_it():
    assert time_at(0.1, [(1.0, 0.2), (4.0, 0.1)]) == Crossing("=", 4.0)


def test_an_error_beyond_what_was_measured_gives_a_bound():
    curve = [(1.0, 0.2), (4.0, 0.1)]
    assert time_at(0.05, curve) == Crossing(">", 4.0)
    assert time_at(0.3, curve) == Crossing("<", 1.0)


def test_a_slower_setting_that_is_worse_does_not_count():
    assert time_at(0.1, [(1.0, 0.2), (2.0, 0.3), (4.0, 0.1)]) == Crossing("=", 4.0)


def test_each_quality_of_rpict_asks_for_more_than_the_one_before():
    for coarse, fine in itertools.pairwise(QUALITIES):
        assert fine.divisions > coarse.divisions
        assert fine.accuracy < coarse.accuracy
        assert fine.spacing < coarse.spacing
