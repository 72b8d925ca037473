"""More samples for some pixels: what they give is what more samples of all pixels would have given."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_picture import SIZE, camera, noisy, rfilter

from steadylight.renderers.mitsuba.image import adaptive
from steadylight.renderers.mitsuba.image.adaptive import Refinement, refine, weight_of
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
    refinement = Refinement(EVERY, (0, SIZE[1]), 64, 64.0)
    given, means, _ = refine(Look(made, radiance), rfilter(kind), Sampling(1, 5), refinement)
    image = given / weight_of(rfilter(kind), SIZE)[..., None]
    whole = render_layers(Look(made, noisy), [rfilter(kind)], Sampling(64, 5)).images[0]
    # Other normalization: by the integral of the filter, not by the samples' own weights. The direction hardly changes
    # within a filter, and the noise of the third channel is of the order of 1 / 64.
    np.testing.assert_allclose(image[..., :2], whole[..., :2], rtol=0.03)
    np.testing.assert_allclose(image.mean((0, 1)), whole.mean((0, 1)), rtol=2e-3)
    boxed = render_layers(Look(made, noisy), [rfilter("box")], Sampling(64, 5)).images[0]
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
    arguments = (Look(made, radiance), rfilter("gaussian"), Sampling(4, 2), refinement)
    whole = refine(*arguments)
    monkeypatch.setattr(adaptive, "SAMPLES_AT_ONCE", 64 * 10)
    pieces = refine(*arguments)
    np.testing.assert_allclose(pieces.given, whole.given, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(pieces.mean, whole.mean)
    np.testing.assert_array_equal(pieces.noise, whole.noise)


def test_the_noise_that_is_told_is_as_large_as_the_error() -> None:
    made, f = camera(), rfilter("box")
    refinement = Refinement(EVERY, (0, SIZE[1]), 16, 1e9)

    def rough(samples: Samples, ray: Any) -> mi.Color3f:
        """Too rough for strata to help: of a smooth integrand, the halves differ by more than the error."""
        number = 1e4 * samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
        return mi.Color3f(number - dr.floor(number)) + 0 * ray.d.x

    seeds = range(8)
    refined = [refine(Look(made, rough), f, Sampling(4, seed), refinement) for seed in seeds]
    error = np.stack([each.mean for each in refined]).var(axis=0, ddof=1).mean()
    told = np.mean([np.square(each.noise).mean() for each in refined])
    assert error == pytest.approx(1 / 12 / 16, rel=0.1)
    assert told == pytest.approx(error, rel=0.1)


@pytest.mark.parametrize(
    ("pixels", "spp", "expected"),
    [(10, 4, 256), (10, 100, 400), (20, 4, 128), (100, 4, 16), (200, 4, 16), (200, 100, 400)],
)
def test_samples_are_halved_until_they_cost_no_more_than_they_may_but_are_four_times_those_of_the_picture(
    pixels: int, spp: int, expected: int
) -> None:
    assert Refinement(EVERY[:pixels], (0, SIZE[1]), 256, 2.5).spp(SIZE[0], spp) == expected
