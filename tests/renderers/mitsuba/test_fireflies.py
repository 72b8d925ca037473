"""A path that is far brighter than all around it is bounded; edges, lines and what many paths find are not."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from steadylight.images import luminance
from steadylight.renderers.mitsuba.image.fireflies import FEWEST, bounded, sample_limit
from steadylight.renderers.mitsuba.upload import download, upload

WIDTH, HEIGHT, SPP = 24, 20, 16


def luminances(samples: np.ndarray, limit: float, beside: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """What is left of grey (height, width, spp) samples, and the luminance that each pixel lost."""
    rows = np.repeat(samples.reshape(-1, 1), 3, axis=1)
    found = bounded(
        upload(mi.Color3f, rows), mi.Color3f(dr.full(mi.Float, beside, len(rows))), (WIDTH, SPP), limit
    )
    left = download(found.radiance)
    np.testing.assert_allclose(left, np.repeat(left[:, :1], 3, axis=1), rtol=1e-6)
    return left[:, 0].reshape(HEIGHT, WIDTH, SPP), luminance(
        download(found.lost).reshape(HEIGHT, WIDTH, SPP, 3).sum(axis=2)
    )


def grey() -> np.ndarray:
    return np.full((HEIGHT, WIDTH, SPP), 0.5)


@pytest.mark.parametrize("at", [(9, 11), (0, 11), (HEIGHT - 1, WIDTH - 1)], ids=["within", "edge", "corner"])
def test_a_single_bright_path_adds_no_more_than_its_surroundings_have(at: tuple[int, int]) -> None:
    samples = grey()
    samples[(*at, 3)] = 4000
    left, cut = luminances(samples, sample_limit(1.0, SPP))
    assert left[(*at, 3)] == pytest.approx(0.5 * SPP, rel=1e-5)
    samples[(*at, 3)] = left[(*at, 3)]
    np.testing.assert_allclose(left, samples, rtol=1e-5)
    assert cut[at] == pytest.approx(4000 - 0.5 * SPP, rel=1e-5)
    assert np.count_nonzero(cut) == 1


def test_direct_and_visible_light_around_counts_for_the_bound_but_is_not_bounded() -> None:
    samples = grey()
    samples[9, 11, 3] = 4000
    left, _ = luminances(samples, sample_limit(1.0, SPP), beside=1.5)
    assert left[9, 11, 3] == pytest.approx(2.0 * SPP, rel=1e-5)


@pytest.mark.parametrize("bright", ["half", "line", "corner", "dot", "dark half"])
def test_what_all_samples_of_a_pixel_see_is_left_as_it_is(bright: str) -> None:
    samples = grey()
    if bright == "half":
        samples[:, 12:] *= 1000
    elif bright == "line":
        samples[:, 12] *= 1000
    elif bright == "dot":
        samples[9, 11] *= 1000
    elif bright == "corner":
        samples[:3, :3] *= 1000
    else:
        samples[:, 12:] = 0
    left, cut = luminances(samples, sample_limit(1.0, SPP))
    np.testing.assert_allclose(left, samples, rtol=1e-5)
    assert not cut.any()


def test_noise_of_which_each_pixel_has_its_share_keeps_nearly_all_of_its_mean() -> None:
    # One sample in fourteen is bright: what a lamp in a rough mirror looks like.
    samples = np.where(np.random.default_rng(1).random((HEIGHT, WIDTH, SPP)) < 1 / 14, 14.0, 0.0)
    left, cut = luminances(samples, sample_limit(1.0, SPP))
    assert cut.any()
    assert left.mean() == pytest.approx(samples.mean(), rel=0.07)


def test_a_picture_of_one_pixel_and_the_faintest_light_stay_as_they_are() -> None:
    one = bounded(mi.Color3f(0.5 + dr.arange(mi.Float, SPP)), mi.Color3f(0), (1, SPP), sample_limit(1.0, SPP))
    np.testing.assert_allclose(np.array(one.radiance)[0], 0.5 + np.arange(SPP), rtol=1e-6)
    faint = 0 * grey()
    faint[9, 11, 3] = 1e-40
    left, _ = luminances(faint, sample_limit(1.0, SPP))
    assert np.isfinite(left).all()


def test_all_is_black_where_all_was_black() -> None:
    left, cut = luminances(0 * grey(), sample_limit(1.0, SPP))
    assert not left.any()
    assert not cut.any()


def test_the_bound_rises_with_the_samples_but_is_never_that_of_a_few() -> None:
    assert sample_limit(2.0, 64) == 128
    assert sample_limit(2.0, 1) == sample_limit(2.0, FEWEST) == 32
