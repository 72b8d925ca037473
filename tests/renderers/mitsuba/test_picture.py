from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import CAMERA, described

from steadylight.renderers.mitsuba import film
from steadylight.renderers.mitsuba.image.reconstruction import make_sampler, render_image, seed_of
from steadylight.renderers.mitsuba.scene import build_sensor

if TYPE_CHECKING:
    from collections.abc import Callable

SIZE = (20, 13)


def rfilter(kind: str) -> Any:
    return mi.load_dict({"type": kind})


def sensor(**properties: Any) -> Any:
    return build_sensor(
        described({}, sensor={"type": "perspective", **properties}), CAMERA.pose(0), *SIZE, {"type": "box"}
    )


def constant(sampler: Any, ray: Any) -> tuple[Any, Any]:
    return mi.Color3f(0.25, 1, 7) + 0 * ray.d.x, mi.UInt32(0)


def noisy(sampler: Any, ray: Any) -> tuple[Any, Any]:
    """Something that depends on the ray and on the sampler; counts the rays that point up."""
    L = mi.Color3f(ray.d.x + 1, ray.d.z + 1, sampler.next_1d())
    return L, dr.select(ray.d.z > 0, mi.UInt32(1), 0)


def image_of(radiance: Callable[..., Any], kind: str = "gaussian", spp: int = 9, seed: int = 1) -> np.ndarray:
    image, _ = render_image(sensor(), rfilter(kind), SIZE, spp, seed, radiance)
    return image


@pytest.mark.parametrize("kind", ["box", "tent", "gaussian", "mitchell"])
def test_a_constant_radiance_makes_a_constant_image(kind: str) -> None:
    image = image_of(constant, kind)
    assert image.shape == (13, 20, 3)
    np.testing.assert_allclose(image, np.broadcast_to([0.25, 1, 7], image.shape), rtol=2e-5)


def test_an_image_has_the_same_bytes_each_time_and_on_any_number_of_threads() -> None:
    first = image_of(noisy)
    assert image_of(noisy).tobytes() == first.tobytes()
    threads = dr.thread_count()
    try:
        for number in (1, 3):
            dr.set_thread_count(number)
            assert image_of(noisy).tobytes() == first.tobytes()
    finally:
        dr.set_thread_count(threads)
    assert image_of(noisy, seed=2).tobytes() != first.tobytes()


def test_pixels_are_where_the_sensor_sees_them() -> None:
    image = image_of(noisy, "box", spp=64)
    # To the right is +x, and up is +z.
    assert (np.diff(image[:, :, 0], axis=1) > 0).all()
    assert (np.diff(image[:, :, 1], axis=0) < 0).all()


def test_counts_are_summed_over_all_samples_and_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    def one(sampler: Any, ray: Any) -> tuple[Any, Any]:
        return constant(sampler, ray)[0], dr.select(ray.d.x == ray.d.x, mi.UInt32(2), 0)

    assert render_image(sensor(), rfilter("box"), SIZE, 4, 0, one)[1] == 2 * 4 * 20 * 13
    monkeypatch.setattr(film, "SPP_AT_ONCE", 4)
    assert render_image(sensor(), rfilter("box"), SIZE, 16, 0, one)[1] == 2 * 16 * 20 * 13


@pytest.mark.parametrize("kind", ["box", "gaussian"])
def test_bands_make_the_image_that_one_piece_would_but_for_the_noise(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    whole = image_of(noisy, kind, spp=64)
    monkeypatch.setattr(film, "LANES", 7 * SIZE[0] * 64)
    banded = image_of(noisy, kind, spp=64)
    # The ray's direction is smooth, so a stratified mean over 64 samples leaves little noise.
    np.testing.assert_allclose(banded[..., :2], whole[..., :2], atol=4e-3)
    assert (banded != whole).any()
    np.testing.assert_allclose(image_of(constant, kind), whole * 0 + np.float32([0.25, 1, 7]), rtol=2e-5)
    monkeypatch.setattr(film, "LANES", 1)  # a band is a row, at least
    np.testing.assert_allclose(image_of(noisy, kind, spp=64)[..., :2], whole[..., :2], atol=4e-3)


@pytest.mark.parametrize("kind", ["gaussian", "box"])
def test_the_filter_sums_what_a_plain_double_loop_sums(kind: str) -> None:
    width, height, spp = 6, 5, 4
    rng = np.random.default_rng(1)
    L = rng.random((height, width, spp, 3), np.float32)
    offset = rng.random((height, width, spp, 2), np.float32)
    f = rfilter(kind)
    radius = f.radius()
    # Rows 1 to 3 of an image of which rows 0 to 4 were sampled.
    found = film._reconstruct(
        mi.Color3f(np.ascontiguousarray(L.reshape(-1, 3).T)),
        mi.Point2f(np.ascontiguousarray(offset.reshape(-1, 2).T)),
        f,
        width,
        (0, height),
        (1, 4),
        spp,
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


def test_a_thin_lens_spreads_rays_over_its_aperture() -> None:
    lens = sensor(type="thinlens", aperture_radius=0.2, focus_distance=5.0)

    def origin(_: Any, ray: Any) -> tuple[Any, Any]:
        return mi.Color3f(ray.o.x, dr.square(ray.o.x), ray.o.z), mi.UInt32(0)

    image, _ = render_image(lens, rfilter("box"), SIZE, 64, 1, origin)
    # Variance of a coordinate over a disc: radius² / 4.
    assert image[..., 1].mean() - image[..., 0].mean() ** 2 == pytest.approx(0.2**2 / 4, rel=0.05)


def test_seeds_of_unlike_numbers_are_unlike() -> None:
    seeds = {seed_of(a, b, c) for a in range(6) for b in range(6) for c in range(6)}
    assert len(seeds) == 216
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert seed_of(-1) == seed_of(2**64 - 1)
    assert seed_of(1, 2) != seed_of(2, 1)


def test_a_sampler_takes_at_least_the_samples_that_were_asked_for() -> None:
    for spp in (1, 2, 5, 16, 31):
        assert spp <= make_sampler(spp).sample_count() <= spp + 8
