"""The nearest walls beside a record: fitted exactly where there are any."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.records.barriers import nearest_barriers

M, N = 10, 40
AZIMUTH = (np.arange(N) + 0.5) * 2 * np.pi / N
HORIZONTAL = np.sqrt((M - 1.5) / M)  # horizontal distance over distance, in the ring that counts


def fitted(*horizontal: np.ndarray) -> np.ndarray:
    """(R, 2, 3) of records with normal z that see these (N,) horizontal distances low above the surface, metres."""
    closeness = np.full((len(horizontal), M, N), 100.0)  # other rings must not count
    closeness[:, M - 2] = HORIZONTAL / np.array(horizontal)
    normal = mi.Normal3f(np.tile([[0], [0], [1]], len(horizontal)).astype(np.float32))
    found = nearest_barriers(
        mi.Float(closeness.ravel().astype(np.float32)), normal, mi.UInt32(M), mi.UInt32(N)
    )
    x = mi.Frame3f(mi.Normal3f(0, 0, 1)).to_world(mi.Vector3f(1, 0, 0))
    np.testing.assert_allclose(np.array(x).ravel(), [1, 0, 0])  # azimuths count from x
    return np.stack([np.array(each).T for each in found], axis=1)


def wall(distance: float, azimuth: float, width: float = np.inf) -> np.ndarray:
    """(N,) horizontal distance to a wall, metres; it stretches `width` metres to either side."""
    turn = AZIMUTH - azimuth
    seen = (np.cos(turn) > 0) & (np.abs(np.tan(turn)) * distance < width)
    return np.where(seen, distance / np.where(seen, np.cos(turn), 1), np.inf)


@pytest.mark.parametrize("azimuth", [0.0, 0.05, 1.0, 2.5, 5.9])
def test_a_wall_is_fitted_exactly(azimuth: float) -> None:
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    np.testing.assert_allclose(fitted(wall(0.3, azimuth))[0, 0], towards / 0.3, rtol=1e-4, atol=1e-4)


def test_between_two_walls_both_are_fitted_the_nearer_one_first() -> None:
    slot = np.minimum(wall(0.4, 0.0), wall(0.2, np.pi))
    np.testing.assert_allclose(fitted(slot)[0], [[-5, 0, 0], [2.5, 0, 0]], atol=1e-3)


def test_in_a_corner_each_wall_is_fitted() -> None:
    corner = np.minimum(wall(0.1, 0.0), wall(0.2, np.pi / 2))
    first, second = fitted(corner)[0]
    np.testing.assert_allclose(first, [10, 0, 0], atol=0.5)
    np.testing.assert_allclose(second, [0, 5, 0], atol=0.5)


def test_a_screen_is_a_wall_a_leg_one_further_away_and_open_ground_none() -> None:
    seen = fitted(wall(0.3, 0.5, 0.03), wall(0.3, 0.5, 0.4), np.full(N, np.inf))
    leg, screen, nothing = np.linalg.norm(seen[:, 0], axis=1)
    assert nothing == 0
    assert 1 / leg > 5 * 0.3
    assert 1 / screen == pytest.approx(0.3, rel=1e-3)
