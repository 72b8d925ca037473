"""From samples to pixels: the filter's sums against plain loops and integrals."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.image.pixels import Rows
from steadylight.renderers.mitsuba.image.reconstruction import integral_of, reconstruct


def rfilter(kind: str) -> Any:
    return mi.load_dict({"type": kind})


@pytest.mark.parametrize("kind", ["gaussian", "box"])
def test_the_filter_sums_what_a_plain_double_loop_sums(kind: str) -> None:
    width, height, spp = 6, 5, 4
    rng = np.random.default_rng(1)
    L = rng.random((height, width, spp, 3), np.float32)
    offset = rng.random((height, width, spp, 2), np.float32)
    f = rfilter(kind)
    radius = f.radius()
    # Rows 1 to 3 of an image of which rows 0 to 4 were sampled.
    found = reconstruct(
        mi.Color3f(np.ascontiguousarray(L.reshape(-1, 3).T)),
        mi.Point2f(np.ascontiguousarray(offset.reshape(-1, 2).T)),
        f,
        Rows((0, height), (1, 4)),
        width,
    )
    y, x = np.mgrid[0:height, 0:width]
    place = np.stack([x, y], axis=-1)[:, :, None] + offset
    expected = np.zeros((3, width, 4))
    for row in range(3):
        for column in range(width):
            away = place - [column + 0.5, row + 1.5]
            weight = np.array(f.eval(mi.Float(away[..., 0].ravel()))) * np.array(
                f.eval(mi.Float(away[..., 1].ravel()))
            )
            weight *= (np.abs(away) <= radius).all(axis=-1).ravel()
            expected[row, column, :3] = weight @ L.reshape(-1, 3)
            expected[row, column, 3] = weight.sum()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["box", "tent", "gaussian", "mitchell"])
def test_the_integral_of_a_filter_is_that_of_its_pixels(kind: str) -> None:
    rfilter = mi.load_dict({"type": kind})
    weights = integral_of(rfilter)
    np.testing.assert_allclose(weights, weights[::-1], rtol=1e-6)
    radius = rfilter.radius()
    t = ((np.arange(20000) + 0.5) / 10000 - 1) * radius
    whole = np.array(rfilter.eval(mi.Float(t.astype(np.float32))), np.float64).mean() * 2 * radius
    assert weights.sum() == pytest.approx(whole, rel=2e-3)
