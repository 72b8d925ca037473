"""More samples for some pixels: what they give is what more samples of all pixels would have given."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_picture import SIZE, camera, noisy, rfilter

from steadylight.renderers.mitsuba.image import adaptive
from steadylight.renderers.mitsuba.image.adaptive import (
    Refinement,
    control_weight,
    estimates,
    give,
    refine,
    refine_by_error,
    samples_by_error,
    weight_of,
    worst_around,
)
from steadylight.renderers.mitsuba.image.picture import render_layers
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
from steadylight.renderers.mitsuba.image.reconstruction import integral_of
from steadylight.renderers.mitsuba.sampling import Purpose, Samples

EVERY = np.arange(SIZE[0] * SIZE[1])


def radiance(samples: Samples, ray: Any) -> mi.Color3f:
    return noisy(samples, ray).layers[0]


@pytest.mark.parametrize("kind", ["box", "gaussian", "mitchell"])
def test_all_pixels_sampled_again_make_the_picture_of_as_many_samples(kind: str) -> None:
    made = camera()
    picture = refine(
        Look(made, radiance), rfilter(kind), Sampling(1, 5), Refinement(EVERY, (0, SIZE[1]), 64, 64.0)
    )
    image = picture.given / weight_of(rfilter(kind), SIZE)[..., None]
    whole = render_layers(Look(made, noisy), [rfilter(kind)], Sampling(64, 5)).images[0]
    # Other normalization: by the integral of the filter, not by the samples' own weights. The direction hardly changes
    # within a filter, and the noise of the third channel is of the order of 1 / 64.
    np.testing.assert_allclose(image[..., :2], whole[..., :2], rtol=0.03)
    np.testing.assert_allclose(image.mean((0, 1)), whole.mean((0, 1)), rtol=2e-3)
    boxed = render_layers(Look(made, noisy), [rfilter("box")], Sampling(64, 5)).images[0]
    means = estimates(Look(made, radiance), rfilter(kind), Sampling(64, 5), EVERY).mean
    np.testing.assert_allclose(means.reshape(boxed.shape), boxed, rtol=1e-5)


def test_pixels_give_to_their_neighbours_and_to_rows_that_are_wanted_only() -> None:
    made, width = camera(), SIZE[0]

    def white(samples: Samples, ray: Any) -> mi.Color3f:
        return mi.Color3f(1) + 0 * ray.d.x

    pixel = np.array([4 * width + 7])
    f = rfilter("gaussian")
    whole = refine(Look(made, white), f, Sampling(4, 1), Refinement(pixel, (0, SIZE[1]), 256, 1e9)).given
    rows, columns = np.nonzero(whole[..., 0])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (2, 6, 5, 9)
    assert whole[..., 0].sum() == pytest.approx(integral_of(f).sum() ** 2, rel=1e-3)
    part = refine(Look(made, white), f, Sampling(4, 1), Refinement(pixel, (5, 8), 256, 1e9)).given
    np.testing.assert_array_equal(part, whole[5:8])


def test_pieces_give_what_the_whole_does(monkeypatch: pytest.MonkeyPatch) -> None:
    made, pixels = camera(), EVERY[::3]
    refinement = Refinement(pixels, (0, SIZE[1]), 64, 1e9)
    arguments = (Look(made, radiance), rfilter("gaussian"))
    refined = refine(*arguments, Sampling(4, 2), refinement)
    whole = refined.given
    one_by_one = estimates(*arguments, Sampling(64, 2), pixels)
    monkeypatch.setattr(adaptive, "SAMPLES_AT_ONCE", 64 * 10)
    in_pieces = refine(*arguments, Sampling(4, 2), refinement)
    np.testing.assert_allclose(in_pieces.given, whole, rtol=1e-5, atol=1e-6)
    for means in (refined.mean, in_pieces.mean):
        np.testing.assert_array_equal(means, one_by_one.mean)
    for piece, part in zip(estimates(*arguments, Sampling(64, 2), pixels), one_by_one, strict=True):
        np.testing.assert_array_equal(piece, part)
    total = np.zeros_like(whole)
    give(total, 0, one_by_one.taps, pixels)
    np.testing.assert_allclose(total, whole, rtol=1e-5, atol=1e-6)


def rough(samples: Samples, ray: Any) -> mi.Color3f:
    """Too rough for strata to help: of a smooth integrand, the halves differ by more than the error."""
    number = 1e4 * samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
    return mi.Color3f(number - dr.floor(number)) + 0 * ray.d.x


def test_noise_and_error_that_are_told_are_as_large_as_the_error() -> None:
    made, f = camera(), rfilter("box")
    found = [estimates(Look(made, rough), f, Sampling(16, seed), EVERY) for seed in range(8)]
    error = np.stack([each.mean for each in found]).var(axis=0, ddof=1).mean()
    assert error == pytest.approx(1 / 12 / 16, rel=0.1)
    assert np.mean([np.square(each.noise).mean() for each in found]) == pytest.approx(error, rel=0.1)
    assert np.mean([np.square(each.error).mean() for each in found]) == pytest.approx(error, rel=0.1)


def test_no_sample_is_brighter_than_its_pixel_may_have() -> None:
    made, f = camera(), rfilter("box")
    bound = np.where(EVERY % 2 == 0, 0.5, 10).astype(np.float32)
    mean = estimates(Look(made, rough), f, Sampling(64, 1), EVERY, bound).mean
    # Of a number between 0 and 1, bounded by a half: 1/8 from those below and 1/4 from those above.
    np.testing.assert_allclose(mean[::2].mean(), 3 / 8, rtol=0.01)
    np.testing.assert_allclose(mean[1::2].mean(), 1 / 2, rtol=0.01)


def test_samples_that_are_not_known_count_as_the_mean_of_the_others() -> None:
    made, f = camera(), rfilter("gaussian")

    def known_below_a_half(samples: Samples, ray: Any) -> tuple[mi.Color3f, mi.Bool]:
        number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
        return mi.Color3f(number) + 0 * ray.d.x, (number < 0.5) | (ray.d.x < 0)

    def never_known(samples: Samples, ray: Any) -> tuple[mi.Color3f, mi.Bool]:
        return radiance(samples, ray), mi.Bool(False) & (ray.d.x > 0)

    found = estimates(Look(made, known_below_a_half), f, Sampling(64, 1), EVERY)
    mean, given = (part.reshape(SIZE[1], SIZE[0], -1) for part in (found.mean, found.taps.sum(axis=1)))
    for side, expected in ((np.s_[:, :9], 0.5), (np.s_[:, 11:], 0.25)):
        np.testing.assert_allclose(mean[side], expected, rtol=0.05)
        np.testing.assert_allclose(given[side].mean(), expected * integral_of(f).sum() ** 2, rtol=0.05)
    assert not estimates(Look(made, never_known), f, Sampling(16, 1), EVERY).mean.any()


def test_pixels_with_different_numbers_of_samples_are_those_of_as_many_samples_each() -> None:
    made, f = camera(), rfilter("gaussian")
    samples = np.where(EVERY % 3 == 0, 64, 16)
    bound = np.full(len(EVERY), 0.2, np.float32)
    found = refine_by_error(Look(made, rough), f, Sampling(4, 3), EVERY, samples, bound)
    for spp in (16, 64):
        some = samples == spp
        # The bound is on one of the picture's four samples: on one of 16, it is four times as high.
        alone = estimates(Look(made, rough), f, Sampling(spp, 3), EVERY[some], bound[some] * spp / 4)
        for part, whole in zip(found, alone, strict=True):
            np.testing.assert_array_equal(part[some], whole)
    assert found.mean[samples == 16].mean() == pytest.approx(0.48, abs=0.01)  # bounded by 0.8
    assert found.mean[samples == 64].mean() == pytest.approx(0.5, abs=0.01)


def test_samples_follow_errors_and_are_no_more_than_there_may_be() -> None:
    def samples(error: list[float], threshold: float, rays: float) -> list[int]:
        most = rays * 2 * SIZE[0]
        found = samples_by_error(np.array(error), threshold, 2, most)
        assert found.sum() <= max(most, 8 * len(error))
        return [int(each) for each in found]

    error = [0.01, 0.02, 0.08, 0.2, 5.0]
    assert samples(error, 0.02, 1e9) == [8, 8, 8, 32, 512]
    # Not all of these 568: the worst first.
    assert samples(error, 0.02, 14) == [8, 8, 8, 8, 512]
    assert samples(error, 0.02, 5) == [8, 8, 8, 8, 128]
    assert samples(error, 0.02, 2) == [8, 8, 8, 8, 32]
    assert samples(error, 0.02, 0.1) == [8] * 5
    assert samples([0.0] * 3, 0.0, 1) == [8] * 3


def test_samples_in_proportion_to_errors_leave_less_noise_than_as_many_for_all() -> None:
    spread = np.where(EVERY % 16 == 0, 10.0, 0.1)
    samples = samples_by_error(spread, 0.1, 4, 32 * len(EVERY))
    assert samples.sum() <= 32 * len(EVERY)
    assert (spread**2 / samples).sum() < 0.2 * (spread**2 / samples.mean()).sum()


def test_a_control_variate_counts_for_as_much_as_it_agrees_with_the_picture() -> None:
    rng = np.random.default_rng(1)
    pixels = np.arange(40, 400)
    control = rng.normal(size=(len(pixels), 1)) * np.ones(3)
    other = rng.normal(size=(len(pixels), 1)) * np.ones(3)
    np.testing.assert_allclose(control_weight(control, control, pixels, 20), 1, rtol=1e-6)
    assert control_weight(control + 0.3 * other, 2 * control, pixels, 20).mean() == pytest.approx(
        0.5, abs=0.05
    )
    assert control_weight(other, control, pixels, 20).mean() < 0.3
    assert (control_weight(-control, control, pixels, 20) == 0).all()
    assert (control_weight(other, 0 * control, pixels, 20) == 1).all()
    # A firefly of its own spoils it for the pixels around.
    spoilt = control.copy()
    spoilt[170] = 100
    weight = control_weight(control, spoilt, pixels, 20)
    near = np.isin(pixels - 40, [170 + 20 * y + x for y in (-1, 0, 1) for x in (-1, 0, 1)])
    assert weight[near].max() < 0.1
    np.testing.assert_allclose(weight[~near], 1, rtol=1e-6)


def test_the_worst_of_a_pixel_and_those_beside_it_is_found_where_some_are_missing() -> None:
    pixels = np.array([21, 22, 24, 41, 65, 66])  # 20 to a row; 41 touches 21 and 22, and 65 only 66
    error = np.array([1.0, 2.0, 7.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(worst_around(pixels, error, 20), [3, 3, 7, 3, 5, 5])


@pytest.mark.parametrize(
    ("pixels", "spp", "expected"),
    [(10, 4, 256), (10, 100, 400), (20, 4, 128), (100, 4, 16), (200, 4, 16), (200, 100, 400)],
)
def test_samples_are_halved_until_they_cost_no_more_than_they_may_but_are_four_times_those_of_the_picture(
    pixels: int, spp: int, expected: int
) -> None:
    assert Refinement(EVERY[:pixels], (0, SIZE[1]), 256, 2.5).spp(SIZE[0], spp) == expected
