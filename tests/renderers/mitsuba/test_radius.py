"""The radius of a record, from sums that are made up."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.radius import extrapolated_radius, occlusion_hessian, wanted_radius
from steadylight.settings import Radii

QUALITY = RecordQuality(polar_strata=5, azimuth_strata=20, refinement_paths=(100,), accuracy=0.2)
EVEN = np.zeros(1)
"""Irradiance that does not change to first order."""

SMALLEST = np.full(1, 0.01)


def sums(distance: float, curvature: float, nearest: float = np.inf) -> dict[str, Any]:
    """Of one record from which all is at a distance (metres), with one second derivative (1/metres²) every way."""
    values = {"closeness": 100 / distance, "nearest": nearest, "xx": curvature, "xy": 0.0, "yy": curvature}
    return {name: np.full(1, value) for name, value in values.items()}


def wanted(seen: dict[str, Any], radii: Radii, steepness: np.ndarray = EVEN, **more: Any) -> float:
    quality = dataclasses.replace(QUALITY, radii=radii, **more)
    return float(wanted_radius(extrapolated_radius(seen, SMALLEST, quality), steepness, quality)[0])


def test_split_sphere_radii_go_by_distance_and_nothing_else() -> None:
    assert wanted(sums(3.0, 1.0), "split-sphere") == pytest.approx(0.2 * 3)
    assert wanted(sums(3.0, 50.0), "split-sphere") == pytest.approx(0.2 * 3)


def test_radii_by_the_hessian_go_by_the_fourth_root_of_the_second_derivative() -> None:
    once, more = (wanted(sums(3.0, curvature), "occlusion-hessian") for curvature in (1.0, 16.0))
    assert once == pytest.approx(2 * more)
    assert wanted(sums(0.3, 1.0), "occlusion-hessian") == once
    assert wanted(sums(3.0, -1.0), "occlusion-hessian") == once
    assert wanted(sums(3.0, 0.0), "occlusion-hessian") == np.inf


@pytest.mark.parametrize("radii", ["split-sphere", "occlusion-hessian"])
def test_no_radius_ends_where_the_gradient_would_bring_light_to_zero_nor_past_what_stands_over_it(
    radii: Radii,
) -> None:
    seen = sums(3.0, 1e-6, nearest=0.1)
    assert wanted(seen, radii, np.full(1, 10.0), clamped=False) == pytest.approx(0.2 / 10)
    assert wanted(seen, radii) == pytest.approx(0.1)
    assert wanted(seen, radii, clamped=False) > 0.1


def test_a_saddle_counts_as_much_as_a_bowl_and_so_does_one_that_is_turned() -> None:
    bowl = occlusion_hessian(*np.array([[2.0], [0.0], [2.0]]), SMALLEST)
    saddle = occlusion_hessian(*np.array([[2.0], [0.0], [-2.0]]), SMALLEST)
    turned = occlusion_hessian(*np.array([[0.0], [2.0], [0.0]]), SMALLEST)
    np.testing.assert_allclose([saddle, turned], [bowl, bowl])


def test_a_scene_twice_as_large_has_radii_twice_as_long() -> None:
    small = occlusion_hessian(*np.array([[2.0], [0.5], [1.0]]), SMALLEST)
    large = occlusion_hessian(*np.array([[2.0], [0.5], [1.0]]) / 4, 2 * SMALLEST)
    np.testing.assert_allclose(large, 2 * small)
