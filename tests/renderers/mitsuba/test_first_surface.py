"""Light on the first surface of noisy pixels: against that of the frame, and against as many samples in every pixel."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import Identity, adapt, described, lamp, paint, place, renderer, room, sample_again

from steadylight.renderers.mitsuba import frame as frame_module
from steadylight.renderers.mitsuba.image import picture, pixels
from steadylight.renderers.mitsuba.image.picture import Sampled, render_layers
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
from steadylight.renderers.mitsuba.paths.first_surface import direct_light, indirect_light
from variants import slow

SIZE = (96, 72)
THINGS = {
    "white paint": None,
    "plastic": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.2, 0.1]}},
    "rough metal": {"type": "roughconductor", "alpha": 0.3},
    "principled": {"type": "principled", "roughness": 0.3, "metallic": 0.3},
    "glass": {"type": "dielectric"},
}
SKY = {"type": "constant", "radiance": 0.3}


def barred() -> dict[str, Any]:
    """A room whose lamp glows behind bars, thinner than a pixel, that it lights from nearby."""
    bars = {
        f"bar_{i}": {
            "type": "cube",
            "to_world": place((0.006, 0.7, 0.02), (0.12 * i - 0.6, 0, 2.9)),
            "bsdf": paint(0.8, 0.8, 0.8),
        }
        for i in range(11)
    }
    return room() | {"lamp": lamp()} | bars


def made_of(content: dict[str, Any], **more: Any) -> tuple[Any, Any]:
    made = renderer(described(content), width=SIZE[0], height=SIZE[1], spp=16, **more)
    cache = made.load(made.first_pass(1).records).with_fallback()
    made._look_from(1)
    made.view.lighting(cache)
    return made, cache


@pytest.mark.parametrize("with_sky", [False, True], ids=["lamp", "sky"])
@pytest.mark.parametrize("thing", [each if each == "white paint" else slow(each) for each in THINGS])
def test_direct_light_by_itself_has_the_mean_of_that_in_the_frame(thing: str, with_sky: bool) -> None:
    made, cache = made_of(room(THINGS[thing]) | {"lamp": lamp()} | ({"sky": SKY} if with_sky else {}))
    view, spp = made.view, 64
    lighting = view.lighting(cache)

    def in_the_frame(samples: Any, ray: Any) -> Sampled:
        return Sampled((view.shade(samples, ray, cache).direct,), mi.UInt32(0))

    def alone(samples: Any, ray: Any) -> Sampled:
        return Sampled((direct_light(lighting, samples, ray, cache),), mi.UInt32(0))

    box = mi.load_dict({"type": "box"})

    def means(radiance: Any, first: int) -> np.ndarray:
        seeds = range(first, first + 4)
        sampled = [render_layers(Look(view.camera, radiance), [box], Sampling(spp, seed)) for seed in seeds]
        images = [rendered.images[0] for rendered in sampled]
        # Blocks of 12 x 12 pixels: an error in one place must not hide behind the rest of the picture.
        return np.stack(images).reshape(4, SIZE[1] // 12, 12, SIZE[0] // 12, 12, 3).mean((2, 4))

    frame, ours = means(in_the_frame, 0), means(alone, 4)
    error = np.hypot(frame.std(axis=0), ours.std(axis=0)) / np.sqrt(3) + 1e-4
    z = (frame.mean(axis=0) - ours.mean(axis=0)) / error
    assert frame.mean() > 0.01
    assert abs(frame.mean() / ours.mean() - 1) < 0.01
    assert np.mean(np.abs(z) > 4) < 0.05  # of three samples each, so that some are far out


@pytest.mark.parametrize("thing", ["white paint", slow("plastic"), slow("glass"), slow("principled")])
def test_cached_light_by_itself_is_that_of_the_frame_along_the_same_rays(thing: str) -> None:
    made, cache = made_of(room(THINGS[thing]) | {"lamp": lamp()})
    view = made.view
    lighting = view.lighting(cache)

    def in_the_frame(samples: Any, ray: Any) -> Sampled:
        return Sampled((view.shade(samples, ray, cache, layered=True).indirect,), mi.UInt32(0))

    def alone(samples: Any, ray: Any) -> Sampled:
        light, known = indirect_light(lighting, samples, ray, cache)
        return Sampled((light,), dr.select(known, mi.UInt32(0), 1))

    box = mi.load_dict({"type": "box"})
    frame, ours = (
        render_layers(Look(view.camera, radiance), [box], Sampling(16, 3))
        for radiance in (in_the_frame, alone)
    )
    assert frame.images[0].mean() > 0.01
    assert ours.count == 0
    np.testing.assert_allclose(ours.images[0], frame.images[0], rtol=1e-4, atol=1e-6)


def images_of(made: Any, cache: Any, seeds: int) -> np.ndarray:
    pictures = []
    for seed in range(seeds):
        made._settings = made._settings.model_copy(update={"seed": seed})
        pictures.append(made.shade(1, cache).image)
    return np.array(pictures)


def test_a_lamp_behind_bars_is_steadier_and_as_bright_with_more_samples_where_it_is_noisy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, cache = made_of(barred())
    sample_again(made, "direct", threshold=0.05, pixels=1 / 32, rays=1 / 8)
    again = images_of(made, cache, 60)  # of 12, single pixels decide: the ratio below is 0.3 to 0.8
    # In two bands, which look for noisy pixels each by itself.
    with monkeypatch.context() as patch:
        patch.setattr(pixels, "SAMPLES_AT_ONCE", SIZE[0] * 16 * 40)
        bands = images_of(made, cache, 60)
    sample_again(made, "direct", threshold=np.inf)
    plain = images_of(made, cache, 60)
    assert 0.01 < (again != plain).any((0, 3)).mean() < 0.3
    for pictures in (again, bands):
        ours, theirs = pictures.var(axis=0).mean(axis=2), plain.var(axis=0).mean(axis=2)
        direct = np.s_[:34]  # the upper half, where the lamp is
        worst = ours[direct] + theirs[direct] > np.quantile((ours + theirs)[direct], 0.98)
        assert ours[direct][worst].mean() < 0.8 * theirs[direct][worst].mean()
        np.testing.assert_allclose(pictures[:, direct].mean(), plain[:, direct].mean(), rtol=0.01)


def chequered() -> dict[str, Any]:
    """A room whose floor is chequered, by squares smaller than a pixel; its lamp shines at the ceiling alone."""
    chequers = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": 0.1},
        "color1": {"type": "rgb", "value": 0.8},
        "to_uv": mi.ScalarTransform3f().scale([90, 90]),
    }
    content = room() | {"lamp": lamp()}
    content["floor"] = content["floor"] | {"bsdf": {"type": "diffuse", "reflectance": chequers}}
    content["lamp"]["to_world"] = content["lamp"]["to_world"] @ np.diag([1.0, 1, -1, 1])
    content["lamp"]["to_world"][2, 3] = 2.6
    return content


@pytest.mark.parametrize("denoise", [False, True], ids=["plain", "denoised"])
def test_cached_light_on_a_fine_texture_is_steadier_and_as_bright_with_more_samples(
    monkeypatch: pytest.MonkeyPatch, denoise: bool
) -> None:
    made, cache = made_of(chequered(), denoise=denoise)
    made._shader.__dict__["denoiser"] = Identity()
    sample_again(made, "indirect", threshold=0.0, pixels=1 / 8)
    adapt(made, worth_indirect=0.0)
    again = images_of(made, cache, 12)
    # In two bands, which look for noisy pixels each by itself.
    with monkeypatch.context() as patch:
        patch.setattr(pixels, "SAMPLES_AT_ONCE", SIZE[0] * 16 * 40)
        bands = images_of(made, cache, 12)
    sample_again(made, "indirect", threshold=np.inf)
    plain = images_of(made, cache, 12)
    again, bands, plain = (pictures[:, 40:] for pictures in (again, bands, plain))  # the floor
    # A band of floor alone has fewer pixels that stand out, and most of those that change are beside one.
    for pictures, least, most in ((again, 0.2, 0.5), (bands, 0.05, 0.8)):
        changed = (pictures != plain).any(axis=3).mean(axis=0) > 0.5
        assert changed.mean() > least
        assert pictures.var(axis=0)[changed].mean() < most * plain.var(axis=0)[changed].mean()
        np.testing.assert_allclose(pictures.mean(), plain.mean(), rtol=2e-3)


def test_what_a_frame_takes_for_noise_is_that_of_the_pixels_that_were_sampled_again_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else what is left of it would pass for a texture, and come back after denoising."""
    monkeypatch.setattr(picture, "PROMINENT", 0.0)
    made, cache = made_of(barred(), denoise=True)
    made._shader.__dict__["denoiser"] = Identity()

    def rendered(threshold: float) -> tuple[np.ndarray, np.ndarray]:
        """Light of 48 frames in the upper half of the picture, where the lamp is, and what they take for its noise."""
        lights, noises = [], []

        def heard(noisy: np.ndarray, clean: np.ndarray, noise: np.ndarray, _: np.ndarray) -> np.ndarray:
            lights.append(noisy[:34])
            noises.append(noise[:34])
            return clean

        monkeypatch.setattr(frame_module, "mixed", heard)
        sample_again(made, "direct", threshold=threshold, pixels=1 / 4)
        images_of(made, cache, 48)
        return np.array(lights), np.array(noises)

    before, now = rendered(np.inf), rendered(0.05)
    again = (now[0] != before[0]).any(axis=3).mean(axis=0) > 0.5
    assert again.mean() > 0.1

    # Of most pixels: a mean over them would be that of the few with fireflies.
    told, true = np.square(now[1]).mean(axis=0), now[0].var(axis=0, ddof=1)
    assert np.median(told[again]) == pytest.approx(np.median(true[again]), rel=0.2)
    assert np.median(np.square(before[1]).mean(axis=0)[again]) > 1.5 * np.median(told[again])


def test_no_more_pixels_are_sampled_again_than_a_part_of_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    made, cache = made_of(room() | {"lamp": lamp()})
    sample_again(made, "direct", threshold=0.0, pixels=1 / 32)
    seen: list[int] = []
    direct = made._shader._direct

    def counted(band: Any, *rest: Any) -> Any:
        seen.append(len(band.direct.pixels))
        return direct(band, *rest)

    monkeypatch.setattr(made._shader, "_direct", counted)
    made.shade(1, cache)
    assert 0 < sum(seen) <= made.view.quality.adaptive.direct.pixels * SIZE[0] * SIZE[1]


def test_a_frame_with_noisy_pixels_has_the_same_bytes_on_any_number_of_threads() -> None:
    made, cache = made_of(barred())
    first = made.shade(1, cache).image
    threads = dr.thread_count()
    try:
        for number in (1, 3):
            dr.set_thread_count(number)
            assert made.shade(1, cache).image.tobytes() == first.tobytes()
    finally:
        dr.set_thread_count(threads)
