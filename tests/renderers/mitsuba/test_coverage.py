"""Points that cameras look up: thinned without losing count of the look-ups, and radii that these are worth."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.coverage import thinned, worth_look_ups
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.filling import Points, RadiusBounds

SMALLEST, LARGEST = 0.1, 0.5


@pytest.fixture(scope="module")
def bounds() -> RadiusBounds:
    """Bounds of a camera of so many pixels that only the points bound the smallest radius."""
    poses = CameraPath((Keyframe(0.0, (0, 0, 1), (1, 0, 1)),)).frame_poses([1], 24)
    return RadiusBounds(poses, 1 << 20, LARGEST / RecordQuality.maximum_spacing, RecordQuality())


def floor(*groups: tuple[float, int]) -> Points:
    """Groups of look-ups on a floor, each at a place along x, metres, and of so many."""
    at = np.repeat([place for place, _ in groups], [count for _, count in groups])
    position = np.zeros((len(at), 3), np.float32)
    position[:, 0] = at
    up = np.tile(np.float32([0, 0, 1]), (len(at), 1))
    longest = np.full(len(at), np.inf, np.float32)
    return Points.of_look_ups(position, up, longest, np.full(len(at), SMALLEST, np.float32))


def test_points_that_are_left_stand_for_the_look_ups_of_those_that_are_not(bounds: RadiusBounds) -> None:
    once = thinned(floor((0.01, 3), (1.01, 5)), bounds)
    assert once.number.tolist() == [3, 5]
    again = thinned(Points.concatenate([once, thinned(floor((1.01, 2), (2.01, 1)), bounds)]), bounds)
    order = np.argsort(again.position[:, 0])
    assert again.position[order, 0] == pytest.approx([0.01, 1.01, 2.01])
    assert again.number[order].tolist() == [3, 7, 1]


def test_radii_grow_with_the_inverse_sixth_root_of_the_number_of_look_ups(bounds: RadiusBounds) -> None:
    points = thinned(floor((0.01, 1), (1.01, 8), (2.01, 64), (3.01, 1000)), bounds)
    worth = worth_look_ups(points, bounds, 64)
    order = np.argsort(worth.position[:, 0])
    assert worth.smallest[order] == pytest.approx(SMALLEST * np.array([2, 2**0.5, 1, 1]), rel=1e-5)


def test_a_radius_that_look_ups_are_worth_is_trusted_and_within_bounds(bounds: RadiusBounds) -> None:
    points = floor((0.01, 1))._replace(longest=np.float32([SMALLEST]))
    worth = worth_look_ups(points, bounds, 64)
    assert worth.longest == pytest.approx([2 * SMALLEST])
    wide = worth_look_ups(points, bounds, 1e9)
    assert bounds.of(wide).smallest == pytest.approx([LARGEST])
