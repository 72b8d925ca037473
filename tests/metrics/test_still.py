from __future__ import annotations

import numpy as np
import pytest

from steadylight.errors import InputError
from steadylight.metrics.still import flip, rel_bias, rel_rmse


@pytest.fixture
def reference() -> np.ndarray:
    return np.random.default_rng(7).random((24, 32, 3), dtype=np.float32) + 0.1


def test_equal_images_have_no_error(reference: np.ndarray) -> None:
    assert rel_rmse(reference, reference) == rel_bias(reference, reference) == 0.0
    assert flip(reference, reference) == 0.0


def test_a_factor_on_a_grey_image_gives_the_known_error() -> None:
    grey = np.full((4, 4, 3), 2.0)
    # (1.1 * 2 - 2) / (2 + 0.1 * 2)
    assert rel_rmse(1.1 * grey, grey) == pytest.approx(0.1 / 1.1)
    assert rel_bias(1.1 * grey, grey) == pytest.approx(0.1 / 1.1)
    assert rel_bias(0.9 * grey, grey) == pytest.approx(-0.1 / 1.1)


def test_the_floor_is_a_tenth_of_the_mean_over_pixels_and_channels() -> None:
    reference = np.zeros((1, 2, 3))
    reference[0, 0] = 2.0  # mean 1, floor 0.1
    image = reference + 0.1
    ratios = np.array([0.1 / 2.1, 0.1 / 0.1])
    assert rel_rmse(image, reference) == pytest.approx(np.sqrt(np.mean(ratios**2)))
    assert rel_bias(image, reference) == pytest.approx(ratios.mean())


def test_errors_of_both_signs_cancel_in_the_bias_only() -> None:
    grey = np.ones((2, 2, 3))
    image = grey + np.array([0.11, -0.11]).reshape(1, 2, 1)
    assert rel_rmse(image, grey) == pytest.approx(0.1)
    assert rel_bias(image, grey) == pytest.approx(0.0, abs=1e-15)


def test_the_scale_of_the_light_does_not_matter(reference: np.ndarray) -> None:
    image = reference * np.float32(1.05) + np.float32(0.01)
    assert rel_rmse(1000 * image, 1000 * reference) == pytest.approx(rel_rmse(image, reference), rel=1e-6)


def test_light_where_all_is_black_is_an_infinite_error() -> None:
    black = np.zeros((2, 2, 3))
    assert rel_rmse(black, black) == 0.0
    assert rel_rmse(black + 1, black) == np.inf


def test_flip_of_black_and_white_is_near_one_and_of_a_small_change_near_zero(reference: np.ndarray) -> None:
    black, white = np.zeros((24, 32, 3)), np.full((24, 32, 3), 1e3)
    assert flip(black, white, exposure=1.0) > 0.9
    assert 0 < flip(reference * np.float32(1.01), reference) < 0.05


def test_flip_sees_the_pictures_at_the_exposure_of_the_film(reference: np.ndarray) -> None:
    image = reference * np.float32(1.3)
    assert flip(image * 4, reference * 4, 0.25) == pytest.approx(flip(image, reference, 1.0), rel=1e-4)


@pytest.mark.parametrize("measure", [rel_rmse, rel_bias, flip])
def test_images_of_different_sizes_are_refused(measure, reference: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"\(24, 31, 3\) cannot be compared with one of \(24, 32, 3\)"):
        measure(reference[:, 1:], reference)
