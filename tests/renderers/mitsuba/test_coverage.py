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


def on_floor(x: np.ndarray, y: np.ndarray, smallest: float) -> Points:
    """Look-ups on a floor that need records of a smallest radius, metres."""
    position = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (len(x), 1))
    return Points.of_look_ups(
        position, up, *(np.full(len(x), each, np.float32) for each in (np.inf, smallest))
    )


def floor(*groups: tuple[float, int]) -> Points:
    """Groups of look-ups, each at a place along x, metres, and of so many."""
    at = np.repeat([place for place, _ in groups], [count for _, count in groups])
    return on_floor(at, np.zeros_like(at), SMALLEST)


def test_points_that_are_left_stand_for_the_look_ups_of_those_that_are_not(bounds: RadiusBounds) -> None:
    once = thinned(floor((0.01, 3), (1.01, 5)), bounds)
    assert once.number.tolist() == [3, 5]
    again = thinned(Points.concatenate([once, thinned(floor((1.01, 2), (2.01, 1)), bounds)]), bounds)
    order = np.argsort(again.position[:, 0])
    assert again.position[order, 0] == pytest.approx([0.01, 1.01, 2.01])
    assert again.number[order].tolist() == [3, 7, 1]


def scattered(smallest: float, density: float) -> Points:
    """Look-ups all over 2 m x 2 m of floor: so many in each square as wide as the smallest radius."""
    x, y = np.random.default_rng(1).uniform(0, 2, (2, round(density * (2 / smallest) ** 2)))
    return on_floor(x, y, smallest)


@pytest.mark.parametrize("smallest", [0.13, 0.2, 0.24, 0.26])
def test_the_same_density_of_look_ups_gives_the_same_factor_whatever_the_radius(
    bounds: RadiusBounds, smallest: float
) -> None:
    # Cells are as wide as the power of two below: 0.125 or 0.25.
    points = scattered(smallest, 100)
    worth = worth_look_ups(points, bounds, 800)
    assert worth.smallest.mean() / smallest == pytest.approx(8 ** (1 / 6), rel=0.02)
    thin = thinned(points, bounds)
    assert len(thin.number) < len(points.number) / 5
    assert thin.number.sum() == len(points.number)
    again = worth_look_ups(thin, bounds, 800)
    assert again.smallest.mean() / smallest == pytest.approx(8 ** (1 / 6), rel=0.02)


def test_radii_grow_with_the_inverse_sixth_root_of_the_number_of_look_ups(bounds: RadiusBounds) -> None:
    points = thinned(floor((0.01, 1), (1.01, 8), (2.01, 64), (3.01, 1000)), bounds)
    square = (SMALLEST / 2**-4) ** 2  # over the area of a cell
    worth = worth_look_ups(points, bounds, 64 * square)
    order = np.argsort(worth.position[:, 0])
    assert worth.smallest[order] == pytest.approx(SMALLEST * np.array([2, 2**0.5, 1, 1]), rel=1e-5)


def test_a_radius_that_look_ups_are_worth_is_trusted_and_within_bounds(bounds: RadiusBounds) -> None:
    points = floor((0.01, 1))._replace(longest=np.float32([SMALLEST]))
    worth = worth_look_ups(points, bounds, 64 * (SMALLEST / 2**-4) ** 2)
    assert worth.longest == pytest.approx([2 * SMALLEST])
    wide = worth_look_ups(points, bounds, 1e9)
    assert bounds.of(wide).smallest == pytest.approx([LARGEST])
