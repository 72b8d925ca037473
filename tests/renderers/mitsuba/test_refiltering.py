"""Pictures made with a box filter that are to look as by a wider one."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.image.refiltering import as_filtered, lit_as_filtered


def test_textures_under_even_light_look_as_by_the_wider_filter() -> None:
    rfilter = mi.load_dict({"type": "gaussian"})
    fine = 64  # steps in a pixel
    stripes = np.random.default_rng(2).uniform(0.1, 0.9, 40 * 8).repeat(fine // 8).astype(np.float32)
    boxed = np.tile(stripes.reshape(40, fine).mean(axis=1)[None, :, None], (9, 1, 3))
    t = (np.arange(4 * fine) + 0.5) / fine - 2
    f = np.array(rfilter.eval(mi.Float(t.astype(np.float32))))
    wide = np.convolve(np.pad(stripes, 2 * fine, mode="edge"), f / f.sum(), mode="same")[2 * fine : -2 * fine]
    centre = (wide[fine // 2 :: fine] + wide[fine // 2 - 1 :: fine]) / 2
    filtered = np.tile(centre[None, :, None], (9, 1, 3)).astype(np.float32)
    light = np.float32(2.5)
    inner = np.s_[:, 4:-4]
    found = lit_as_filtered(light * boxed, boxed, filtered, rfilter)
    np.testing.assert_allclose(found[inner], light * filtered[inner], rtol=1e-5)
    assert np.abs(as_filtered(light * boxed, rfilter)[inner] / (light * filtered[inner]) - 1).max() > 0.02


def test_gloss_on_something_black_makes_no_halo_beside_something_white() -> None:
    rfilter = mi.load_dict({"type": "gaussian"})
    albedo = np.full((16, 16, 3), 0.01, np.float32)
    albedo[:, 8:] = 0.9
    filtered = as_filtered(albedo, rfilter)
    filtered[:, 6:10] += np.float32([0.004, -0.02, 0.02, -0.004])[:, None]
    shining = np.ones_like(albedo)
    np.testing.assert_allclose(lit_as_filtered(shining, albedo, filtered, rfilter), 1, atol=0.06)
    dark = lit_as_filtered(np.zeros_like(albedo), albedo, filtered, rfilter)
    np.testing.assert_array_equal(dark, 0)


@pytest.mark.parametrize("kind", ["box", "tent", "gaussian", "mitchell"])
def test_a_wider_filter_is_imitated_by_neighbouring_pixels(kind: str) -> None:
    rfilter = mi.load_dict({"type": kind})
    flat = np.full((5, 7, 3), 0.3, np.float32)
    np.testing.assert_allclose(as_filtered(flat, rfilter), flat, rtol=1e-6)
    # Edges anywhere in a pixel: what the filter makes of them, and what a box does.
    at = (np.arange(4001) / 4000 * 2 - 1) * rfilter.radius()
    f = np.array(rfilter.eval(mi.Float(at.astype(np.float32))), np.float64)
    from_edge = np.arange(-4, 5) + (np.arange(32)[:, None] + 0.5) / 32
    right = np.interp(from_edge, at, np.cumsum(f) / f.sum())
    boxed = np.clip(from_edge + 0.5, 0, 1).astype(np.float32)
    image = np.repeat(boxed[:, :, None], 3, axis=2)
    found = np.concatenate([as_filtered(row[None], rfilter) for row in image])
    if kind == "box":
        np.testing.assert_array_equal(found, image)
    else:
        far = (boxed - right).std()
        assert (found[..., 0] - right).std() < (0.8 if kind == "mitchell" else 0.6) * far
    turned = as_filtered(np.swapaxes(image, 0, 1), rfilter)
    np.testing.assert_allclose(np.swapaxes(turned, 0, 1), as_filtered(image, rfilter), rtol=1e-5, atol=1e-6)
