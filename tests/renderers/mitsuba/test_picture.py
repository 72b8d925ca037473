"""Pictures of what camera rays see: in bands and passes, the same bytes each time."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import CAMERA, described

from steadylight.renderers.mitsuba.image import pixels
from steadylight.renderers.mitsuba.image.picture import Rendered, Sampled, SurfaceLight, render_layers
from steadylight.renderers.mitsuba.image.pixels import Camera, Look, Sampling, Seen, passes
from steadylight.renderers.mitsuba.quality import AdaptiveSamples
from steadylight.renderers.mitsuba.sampling import Purpose, Samples, samples_of
from steadylight.renderers.mitsuba.scene import build_sensor

SIZE = (20, 13)


def rfilter(kind: str) -> Any:
    return mi.load_dict({"type": kind})


def camera(size: tuple[int, int] = SIZE, **properties: Any) -> Camera:
    description = described({}, sensor={"type": "perspective", **properties})
    return Camera(build_sensor(description, CAMERA.pose(0), *size, {"type": "box"}), size)


def constant(samples: Samples, ray: Any) -> Sampled:
    return Sampled((mi.Color3f(0.25, 1, 7) + 0 * ray.d.x,), mi.UInt32(0))


def noisy(samples: Samples, ray: Any) -> Sampled:
    """Something that depends on the ray and on the random numbers; counts the rays that point up."""
    number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
    return Sampled((mi.Color3f(ray.d.x + 1, ray.d.z + 1, number),), dr.select(ray.d.z > 0, mi.UInt32(1), 0))


def rendered(seen: Seen, kind: str = "gaussian", spp: int = 9, seed: int = 1) -> Rendered:
    return render_layers(Look(camera(), seen), [rfilter(kind)], Sampling(spp, seed))


def image_of(seen: Seen, kind: str = "gaussian", spp: int = 9, seed: int = 1) -> np.ndarray:
    return rendered(seen, kind, spp, seed).images[0]


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


@pytest.mark.parametrize("spp", [8, 9, 16, 1500])
def test_halves_of_the_samples_tell_the_error_of_a_pixel(spp: int) -> None:
    """1500 samples are taken in several passes, and of 9 the last belongs to neither half."""

    def flips(samples: Samples, ray: Any) -> Sampled:
        # Two numbers that no point set stratifies together: the error is that of independent samples.
        numbers = [samples.at(mi.UInt32(0), mi.UInt32(n)).sample_1d(Purpose.LOBE) for n in (1, 2)]
        odd = dr.select((numbers[0] < 0.5) == (numbers[1] < 0.5), mi.Float(1), 0)
        return Sampled((mi.Color3f(odd) + 0 * ray.d.x,), mi.UInt32(0))

    look = Look(camera(), flips)
    found = [render_layers(look, [rfilter("box")], Sampling(spp, seed), noise_of=0) for seed in range(8)]
    errors = np.array([each.images[0] - 0.5 for each in found])
    noise = np.array([each.noise for each in found])
    assert noise.shape == errors.shape
    np.testing.assert_allclose(np.mean(noise), 0, atol=4 * noise.std() / np.sqrt(noise.size / 3))
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.15)


def test_one_sample_tells_nothing_of_its_error() -> None:
    found = render_layers(Look(camera(), noisy), [rfilter("box")], Sampling(1, 1), noise_of=0)
    assert found.noise is not None
    assert not found.noise.any()


def one(samples: Samples, ray: Any) -> Sampled:
    return constant(samples, ray)._replace(count=dr.select(ray.d.x == ray.d.x, mi.UInt32(2), 0))


def test_counts_are_summed_over_all_samples_and_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rendered(one, "box", 4).count == 2 * 4 * 20 * 13
    monkeypatch.setattr(pixels, "SPP_AT_ONCE", 4)
    assert rendered(one, "box", 16).count == 2 * 16 * 20 * 13
    assert rendered(one, "box", 9).count == 2 * 9 * 20 * 13


def test_samples_at_the_rims_of_bands_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels, "SAMPLES_AT_ONCE", 7 * SIZE[0] * 9)
    assert rendered(one, "gaussian", 9).count == 2 * 9 * 20 * 13


@pytest.mark.parametrize("spp", [1, 7, 63, 64, 65, 100, 129])
def test_every_sample_of_every_pixel_is_taken_once(spp: int) -> None:
    made = camera((5, 3))
    taken = []
    for part in passes(made, spp, 0):
        assert part.spp <= 64
        samples, _, _ = part.rays(made, 1)
        taken.append(np.stack([np.array(samples.key), np.array(samples.index)]))
    keys, indices = np.concatenate(taken, axis=1)
    assert len(np.unique(keys)) == 15
    for key in np.unique(keys):
        np.testing.assert_array_equal(np.sort(indices[keys == key]), np.arange(spp))


@pytest.mark.parametrize("kind", ["box", "gaussian"])
def test_bands_make_the_bytes_that_one_piece_would(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    whole = rendered(noisy, kind, spp=64)
    for lanes in (7 * SIZE[0] * 64, 1):  # a band is a row, at least
        monkeypatch.setattr(pixels, "SAMPLES_AT_ONCE", lanes)
        banded = rendered(noisy, kind, spp=64)
        np.testing.assert_array_equal(banded.images[0], whole.images[0])
        assert banded.count == whole.count


@pytest.mark.parametrize("spp", [64, 50])
def test_passes_make_the_image_that_one_piece_would_but_for_rounding(
    monkeypatch: pytest.MonkeyPatch, spp: int
) -> None:
    whole = rendered(noisy, spp=spp)
    monkeypatch.setattr(pixels, "SPP_AT_ONCE", 12)
    passed = rendered(noisy, spp=spp)
    np.testing.assert_allclose(passed.images[0], whole.images[0], rtol=1e-5)
    assert passed.count == whole.count


def shining(samples: Samples, ray: Any) -> Sampled:
    """Black, but for a lamp to the right that shines with a noise."""
    number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
    return Sampled(
        (mi.Color3f(0 * ray.d.x),), mi.UInt32(0), emitted=mi.Color3f(dr.select(ray.d.x > 0, number, 0))
    )


@pytest.mark.parametrize(("name", "value"), [("SPP_AT_ONCE", 12), ("SAMPLES_AT_ONCE", 3 * SIZE[0] * 50)])
def test_what_shines_is_known_alike_from_passes_and_bands(
    monkeypatch: pytest.MonkeyPatch, name: str, value: int
) -> None:
    whole = rendered(shining, spp=50).emitted
    monkeypatch.setattr(pixels, name, value)
    parts = rendered(shining, spp=50).emitted
    assert whole is not None
    assert parts is not None
    assert whole.mean[:, :9].max() == 0 < whole.lowest[:, 11:].max()
    for a, b in zip(parts, whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def with_direct(samples: Samples, ray: Any) -> Sampled:
    """Direct light that is even on the left and noisy in a few pixels on the right, on something grey."""
    number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
    direct = mi.Color3f(dr.select(ray.d.x > 0.36, 30 * number**8, 1))
    return Sampled((mi.Color3f(1) + 0 * ray.d.x,), mi.UInt32(0), direct=direct)


@pytest.mark.parametrize("spp", [16, 100])
def test_noisy_direct_light_is_left_out_of_the_picture_and_the_rest_is_in_it(spp: int) -> None:
    quality = AdaptiveSamples(threshold=0.2, pixels=1 / 4, rays=1)
    found = render_layers(
        Look(camera(), with_direct), [rfilter("box")], Sampling(spp, 1), SurfaceLight(0, quality)
    )
    (band,) = found.noisy
    lacking = np.zeros(SIZE[::-1], bool)
    lacking.ravel()[band.direct.pixels] = True
    assert 0 < lacking.sum() <= 20 * 13 / 4
    assert not lacking[:, :14].any()
    np.testing.assert_allclose(found.images[0][lacking], 1, rtol=1e-5)
    np.testing.assert_allclose(found.images[0][:, :14], 2, rtol=1e-5)
    assert (found.images[0][:, 18:][~lacking[:, 18:]] > 1.01).all()


@pytest.mark.parametrize(("worth", "omitted"), [(0.0, True), (10.0, False)])
@pytest.mark.parametrize("spp", [16, 100])
def test_noisy_cached_light_is_left_out_of_the_first_picture_if_it_is_worth_it(
    spp: int, worth: float, omitted: bool
) -> None:
    def with_indirect(samples: Samples, ray: Any) -> Sampled:
        """As `with_direct`, but the light that is noisy in part is that of the cache."""
        even, noisy = mi.Color3f(1) + 0 * ray.d.x, with_direct(samples, ray).direct
        return Sampled((mi.Color3f(0.5), mi.Color3f(0.25)), mi.UInt32(0), direct=even, indirect=noisy)

    never = AdaptiveSamples(threshold=np.inf, pixels=1.0, rays=1)
    quality = AdaptiveSamples(threshold=0.2, pixels=1 / 4, rays=1)
    surface = SurfaceLight(1, never, None, quality, worth)
    box = rfilter("box")
    found = render_layers(Look(camera(), with_indirect), [box, box], Sampling(spp, 1), surface)
    (band,) = found.noisy
    lacking = np.zeros(SIZE[::-1], bool)
    lacking.ravel()[band.indirect.pixels] = True
    assert lacking.any() == omitted
    assert not lacking[:, :14].any()
    np.testing.assert_allclose(found.images[0][lacking], 0.5, rtol=1e-5)
    np.testing.assert_allclose(found.images[0][:, :14], 1.5, rtol=1e-5)
    assert (found.images[0][:, 18:][~lacking[:, 18:]] > 0.51).all()
    np.testing.assert_allclose(found.images[1], 1.25, rtol=1e-5)
    assert not len(band.direct.pixels)


def test_a_part_of_all_pixels_may_be_noisy() -> None:
    quality = AdaptiveSamples(threshold=0.0, pixels=1.0, rays=1)
    found = render_layers(
        Look(camera(), with_direct), [rfilter("box")], Sampling(16, 1), SurfaceLight(0, quality)
    )
    assert len(found.noisy[0].direct.pixels) > 10


@pytest.mark.parametrize("part", [0.03, 0.9])
def test_pixels_are_noisy_if_they_stand_out_from_the_others(part: float) -> None:
    def noisy_in_part(samples: Samples, ray: Any) -> Sampled:
        """Direct light that is as noisy in all pixels of a part of the picture."""
        spread = mi.Float(mi.sample_tea_32(samples.key, mi.UInt32(0))[0]) * 2.0**-32
        number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
        direct = mi.Color3f(dr.select(spread < part, 8 * number**3, 2)) + 0 * ray.d.x
        return Sampled((mi.Color3f(0) + 0 * ray.d.x,), mi.UInt32(0), direct=direct)

    quality = AdaptiveSamples(threshold=0.05, pixels=1.0, rays=1)
    (band,) = render_layers(
        Look(camera(), noisy_in_part), [rfilter("box")], Sampling(16, 1), SurfaceLight(0, quality)
    ).noisy
    assert band.direct.threshold > 0.05
    assert (len(band.direct.pixels) > 0) == (part < 0.5)


def test_pixels_are_noisy_for_what_is_beside_them_and_not_by_their_own_samples() -> None:
    def one_glint(samples: Samples, ray: Any) -> Sampled:
        """Half of the samples of one pixel are bright; direct light is even."""
        number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
        glint = (samples.key == key) & (number < 0.5)
        even = mi.Color3f(1) + 0 * ray.d.x
        return Sampled((mi.Color3f(1) + dr.select(glint, mi.Color3f(40), 0),), mi.UInt32(0), direct=even)

    column, row = 12, 6
    key = samples_of(mi.UInt32(1), mi.UInt32(row * SIZE[0] + column), mi.UInt32(0)).key[0]
    quality = AdaptiveSamples(threshold=0.2, pixels=1 / 4, rays=1)
    found = render_layers(
        Look(camera(), one_glint),
        [rfilter("box")],
        Sampling(16, 1),
        SurfaceLight(0, quality, quality),
        None,
        1.0,
    )
    (band,) = found.noisy
    rows, columns = np.divmod(band.rest.pixels, SIZE[0])
    near = [(row + dy, column + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == near
    assert not len(band.direct.pixels)
    assert (band.rest.error > 0.2).all()
    assert (band.bound > 1).all()
    assert np.isfinite(band.bound).all()


@pytest.mark.parametrize("spp", [16, 100])
def test_fireflies_are_cut_and_what_they_lose_is_told(spp: int) -> None:
    def with_fireflies(samples: Samples, ray: Any) -> Sampled:
        number = samples.at(mi.UInt32(0), mi.UInt32(1)).sample_1d(Purpose.LOBE)
        few = mi.Float(4 / (spp * SIZE[0] * SIZE[1]))
        bright = mi.Color3f(dr.select(number < few, mi.Float(1000 * spp), 1))
        return Sampled((bright,), mi.UInt32(0), direct=mi.Color3f(2) + 0 * ray.d.x)

    where = SurfaceLight(0, AdaptiveSamples(threshold=10.0, pixels=0.0, rays=1))
    look, box = Look(camera(), with_fireflies), [rfilter("box")]
    whole, cut = (render_layers(look, box, Sampling(spp, 1), where, None, each) for each in (None, 1.0))
    assert not whole.cut.any()
    assert whole.images[0].max() > 1000
    assert 2.999 < cut.images[0].min() <= cut.images[0].max() < 250  # some are near each other
    np.testing.assert_allclose(cut.images[0] + cut.cut, whole.images[0], rtol=1e-4)


def test_a_thin_lens_spreads_rays_over_its_aperture() -> None:
    lens = camera(type="thinlens", aperture_radius=0.2, focus_distance=5.0)
    assert lens.random_aperture

    def origin(_: Samples, ray: Any) -> Sampled:
        return Sampled((mi.Color3f(ray.o.x, dr.square(ray.o.x), ray.o.z),), mi.UInt32(0))

    image = render_layers(Look(lens, origin), [rfilter("box")], Sampling(64, 1)).images[0]
    # Variance of a coordinate over a disc: radius² / 4.
    assert image[..., 1].mean() - image[..., 0].mean() ** 2 == pytest.approx(0.2**2 / 4, rel=0.05)
    # The place on the lens has nothing to do with the place in the pixel.
    samples, ray, offset = next(passes(lens, 64, 0)).rays(lens, 1)
    del samples
    both = np.corrcoef([*np.array(ray.o)[[0, 2]], *np.array(offset)])
    assert np.abs(both[:2, 2:]).max() < 0.02
