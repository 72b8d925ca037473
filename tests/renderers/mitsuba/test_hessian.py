"""The occlusion Hessian against the same mesh moved by hand, and against light that is known."""

from __future__ import annotations

from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.records.hessian import FAINTEST, FAR, UNCOVERED, second_derivatives

M, N = 5, 12
STEP = 1e-3
"""Metres by which the twin moves the record."""


def seconds_of(L: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Second derivatives xx, xy, yy above (M, N) radiances at (M, N) distances."""

    def lanes(values: np.ndarray) -> mi.Float:
        return mi.Float(np.ascontiguousarray(values.ravel(), np.float32))

    return np.ravel([np.array(v) for v in second_derivatives(lanes(L), lanes(1 / distance), M, N)])


def sent(vertices: list[np.ndarray]) -> float:
    """Irradiance at the origin, facing z, from a polygon of radiance 1 (Lambert)."""
    total = 0.0
    for a, b in pairwise([*vertices, vertices[0]]):
        cross = np.cross(a, b)
        length = np.linalg.norm(cross)
        total += cross[2] / length * np.arctan2(length, a @ b) / 2
    return float(total)


def irradiance(L: np.ndarray, distance: np.ndarray, x: float, y: float) -> float:
    """Relative irradiance at (x, y, 0) from the mesh around the origin, triangle by triangle."""
    light = FAINTEST + (1 - FAINTEST) * L / L.mean()
    light = np.vstack([light, light[-1:]])
    distance = np.minimum(distance, FAR / (1 / distance).mean())
    distance = np.vstack([distance, distance[-1:]])
    sin2 = np.r_[(np.arange(M) + 0.5) / M, 1][:, None]
    phi = 2 * np.pi * (np.arange(N) + 0.5) / N
    rays = np.stack(
        [np.sqrt(sin2) * np.cos(phi), np.sqrt(sin2) * np.sin(phi), np.sqrt(1 - sin2) + 0 * phi], axis=2
    )
    vertices = rays * distance[:, :, None] - [x, y, 0]

    def triangle(*corners: tuple[int, int]) -> float:
        weights = [distance[corner] ** UNCOVERED for corner in corners]
        radiance = np.average([light[corner] for corner in corners], weights=weights)
        return float(radiance) * sent([vertices[corner] for corner in corners])

    total = light[0].mean() * sent(list(vertices[0]))
    for j in range(M):
        for k in range(N):
            here, beside = (j, k), (j, (k + 1) % N)
            below, across = (j + 1, k), (j + 1, (k + 1) % N)
            total += triangle(here, below, across) + triangle(here, across, beside)
    return float(total / np.pi)


@pytest.mark.parametrize("depth", ["a shell", "a rough shell", "two shells"])
def test_second_derivatives_are_those_of_the_mesh_seen_from_beside(depth: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(4):
        L = rng.random((M, N))
        distance = {
            "a shell": np.full((M, N), 2.0),
            "a rough shell": 2 * np.exp(0.4 * rng.normal(size=(M, N))),
            "two shells": np.where(rng.random((M, N)) < 0.3, 0.5, 3.0),
        }[depth]
        h, E = STEP, irradiance(L, distance, 0, 0)

        def moved(x: float, y: float, L: np.ndarray = L, distance: np.ndarray = distance) -> float:
            return irradiance(L, distance, x, y)

        xx = (moved(h, 0) + moved(-h, 0) - 2 * E) / h**2
        yy = (moved(0, h) + moved(0, -h) - 2 * E) / h**2
        xy = (moved(h, h) + moved(-h, -h) - moved(h, -h) - moved(-h, h)) / (4 * h**2)
        np.testing.assert_allclose(seconds_of(L, distance), [xx, xy, yy], rtol=1e-3, atol=1e-3)


def test_even_light_from_all_sides_has_no_second_derivative_whatever_its_distance() -> None:
    rng = np.random.default_rng(4)
    for distance in (np.full((M, N), 3.0), 10.0 ** rng.uniform(-1, 2, (M, N)), np.full((M, N), np.inf)):
        seconds = seconds_of(np.ones((M, N)), distance)
        size = np.nan_to_num((1 / distance).mean()) ** 2
        assert np.abs(seconds).max() <= 0.05 * max(size, 1e-9)


def test_black_surroundings_have_no_second_derivative() -> None:
    np.testing.assert_allclose(seconds_of(np.zeros((M, N)), np.full((M, N), 2.0)), 0, atol=1e-5)


def test_in_a_scene_twice_as_large_second_derivatives_are_a_quarter() -> None:
    rng = np.random.default_rng(5)
    L, distance = rng.random((M, N)), rng.uniform(1, 4, (M, N))
    small, large = (seconds_of(L, scale * distance) for scale in (1, 2))
    np.testing.assert_allclose(large, small / 4, rtol=1e-4)
