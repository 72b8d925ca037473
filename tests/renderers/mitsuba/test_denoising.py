"""The two layers of a frame, and a denoiser that gets one of them only."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import LAMP, described, lamp, paint, place, renderer, room

import steadylight
from steadylight.camera import CameraPath, Keyframe
from steadylight.engines.performing import describe
from steadylight.errors import BackendError, SettingsError
from steadylight.renderers.mitsuba import frame as frame_module
from steadylight.renderers.mitsuba.frame import FrameShader
from steadylight.renderers.mitsuba.image.denoising import (
    REGION,
    Denoiser,
    balanced,
    check_denoiser,
    mixed,
    scale_of,
)
from steadylight.renderers.mitsuba.image.picture import Sampled, render_layers
from steadylight.renderers.mitsuba.image.pixels import Look, Sampling
from steadylight.renderers.mitsuba.paths.shading import Layers
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings
from variants import slow

needs_oidn = pytest.mark.skipif(find_spec("pyoidn") is None, reason="Open Image Denoise is not installed")

SKY = {"type": "constant", "radiance": 0.3}
THINGS = {
    "plastic": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.2, 0.1]}},
    "mirror": {"type": "conductor"},
    "glass": {"type": "dielectric"},
    "principled": {"type": "principled", "roughness": 0.3, "metallic": 0.3},
}


def layers_of(made: Any, cache: Any, rfilter: Any, seed: int = 5) -> Layers:
    made.view.lighting(cache)

    def seen(samples: Any, ray: Any) -> Sampled:
        shade = made.view.shade(samples, ray, cache, layered=True)
        of_all = shade.radiance
        layers = of_all._replace(cached=of_all.cached + shade.indirect, rest=of_all.rest + shade.direct)
        return Sampled(layers, shade.missed)

    rendered = render_layers(Look(made.view.camera, seen), [rfilter] * 4, Sampling(16, seed))
    return Layers(*rendered.images)


@pytest.mark.slow
def test_the_layers_add_up_to_the_frame() -> None:
    things = {
        name.replace(" ", "_"): {"type": "sphere", "center": [x, -0.6, z], "radius": 0.45, "bsdf": bsdf}
        for (x, z), (name, bsdf) in zip(
            ((-1, 0.5), (1, 0.5), (-0.6, 1.8), (0.6, 1.8)), THINGS.items(), strict=True
        )
    }
    made = renderer(described(room() | things | {"lamp": lamp(), "sky": SKY}), width=32, height=32, spp=16)
    cache = made.load(made.first_pass(1).records)
    for thing in made.view.scene.shapes():
        assert thing.id() not in things or seen_pixels(made, thing) > 10
    rfilter = mi.load_dict({"type": "gaussian"})
    layers = layers_of(made, cache, rfilter)

    def seen(samples: Any, ray: Any) -> Sampled:
        shade = made.view.shade(samples, ray, cache)
        return Sampled((shade.radiance + shade.direct,), shade.missed)

    image = render_layers(Look(made.view.camera, seen), [rfilter], Sampling(16, 5)).images[0]
    assert layers.cached.mean() > 0.02 * image.mean()
    assert layers.rest.mean() > 0.1 * image.mean()
    # The same numbers are added in another order.
    np.testing.assert_allclose(layers.cached + layers.rest, image, rtol=1e-5, atol=1e-6)


def behind_a_mask(opacity: float) -> tuple[Layers, Layers]:
    """The middle of what two seeds see of a room behind a panel that lets some light through, by chance."""
    cloth = {
        "type": "mask",
        "opacity": opacity,
        "nested": {"type": "twosided", "nested": {"type": "diffuse"}},
    }
    made = renderer(described(room(cloth, "panel") | {"lamp": lamp()}), width=32, height=32, spp=16)
    cache = made.load(made.first_pass(1).records)
    box = mi.load_dict({"type": "box"})
    one, other = (layers_of(made, cache, box, seed) for seed in (5, 6))
    middle = (slice(12, 20), slice(12, 20))
    return Layers(*(layer[middle] for layer in one)), Layers(*(layer[middle] for layer in other))


def test_what_is_behind_a_half_transparent_mask_is_for_the_denoiser() -> None:
    """The mask itself is lit from the cache without noise; whether a sample passes is a matter of chance."""
    one, other = behind_a_mask(0.7)
    np.testing.assert_allclose(one.cached, other.cached, rtol=0.01)
    assert one.cached.mean() > 0
    passed = (one.rest - other.rest).std() / one.cached.mean()
    assert passed > 0.02  # and that is the grain that a denoiser must see


def test_what_is_behind_a_hole_in_a_mask_comes_from_the_cache() -> None:
    one, other = behind_a_mask(0.0)
    np.testing.assert_allclose(one.cached, other.cached, rtol=0.01)
    assert one.cached.mean() > 0


def grain(seed: int, scale: float, shape: tuple[int, int] = (40, 40)) -> np.ndarray:
    """Noise that is independent in each pixel, the same in all channels."""
    numbers = np.random.default_rng(seed).normal(0, scale, (*shape, 1)).astype(np.float32)
    return np.repeat(numbers, 3, axis=2)


def error(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image - truth) ** 2)))


def test_what_was_noise_stays_away() -> None:
    truth = np.full((40, 40, 3), 0.5, np.float32)
    mixture = mixed(truth + grain(1, 0.05), truth, grain(2, 0.05))
    assert error(mixture, truth) < 0.2 * 0.05


def test_noise_of_few_and_bright_causes_stays_away() -> None:
    """One sample in fifty finds a small and bright thing: most windows hold few of these, some twice as many."""
    truth = np.full((120, 120, 3), 1.0, np.float32)
    found = np.random.default_rng(1).binomial(8, 0.02, (2, 120, 120, 1)).astype(np.float32)
    halves = np.repeat(0.5 + 0.5 * found / 0.16, 3, axis=3)
    mixture = mixed(halves.mean(axis=0), truth, (halves[0] - halves[1]) / 2)
    assert np.mean(np.abs(mixture - truth) > 0.05) < 0.06
    assert error(mixture, truth) < 0.1 * error(halves.mean(axis=0), truth)


def test_what_was_no_noise_comes_back() -> None:
    """The shadow of a wire, in quiet light, which the denoiser took for noise."""
    truth = np.full((40, 40, 3), 0.5, np.float32)
    truth[:, 20] = 0.3
    smeared = np.full_like(truth, 0.5)
    mixture = mixed(truth + grain(1, 0.01), smeared, grain(2, 0.01))
    wire = (slice(None), slice(18, 23))
    assert error(mixture[wire], truth[wire]) < 0.15 * error(smeared[wire], truth[wire])
    assert error(mixture[:, :15], truth[:, :15]) < 0.3 * 0.01  # and elsewhere the noise stays away


def rebalanced(noisy: np.ndarray, clean: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """`balanced`, where no firefly was cut."""
    return balanced(noisy, clean, noise, np.zeros_like(noisy))


def grainy(random: np.random.Generator, part: float = 0.02) -> np.ndarray:
    """On the left a fiftieth of the pixels has a third of the light, or so: 0.75 in the mean; on the right 0.1."""
    bright = np.where(random.random((200, 203)) < part, 12.5, 0.0) + 0.5
    bright[:, 100:] = 0.1
    return np.repeat(bright[..., None], 3, axis=2).astype(np.float32) * np.float32([1.0, 0.8, 0.6])


def test_light_that_the_denoiser_took_for_outliers_is_given_back() -> None:
    random = np.random.default_rng(3)
    one, other, clean = grainy(random), grainy(random), grainy(random, 0)
    made = rebalanced((one + other) / 2, clean, (one - other) / 2)
    np.testing.assert_allclose(made[:, :100].mean((0, 1)), 0.75 * np.array([1.0, 0.8, 0.6]), rtol=0.03)
    assert made[:, :80].std(axis=0).max() < 0.05  # and no grain with it
    quiet = made[:, 100:, 0].mean(axis=0)  # nothing was lost there, and little comes over the edge
    assert quiet[:16].mean() < 0.13
    np.testing.assert_allclose(quiet[32:], 0.1, rtol=0.01)


def test_light_that_fireflies_had_lost_is_given_back_around_them() -> None:
    random = np.random.default_rng(3)
    truth = np.full((200, 203, 3), 0.5, np.float32)
    cut = np.where(random.random((200, 203, 1)) < 0.02, np.float32(5.0), 0) * np.float32([1.0, 0.8, 0.6])
    made = balanced(truth, truth, grain(1, 0.01, (200, 203)), cut)
    np.testing.assert_allclose(made.mean((0, 1)), 0.5 + 0.1 * np.array([1.0, 0.8, 0.6]), rtol=0.02)
    assert made.std(axis=(0, 1)).max() < 0.05


def test_the_light_of_a_firefly_that_is_alone_is_no_more_than_it_may_be() -> None:
    truth, cut = (np.full((200, 203, 3), value, np.float32) for value in (0.5, 0.0))
    cut[100, 100] = 500
    made = balanced(truth, truth, grain(1, 0.01, (200, 203)), cut)
    assert made.max() < 0.55  # spread over `REGION`, it would be 0.8


def test_light_that_the_denoiser_added_is_taken_away() -> None:
    truth = np.full((64, 64, 3), 0.5, np.float32)
    made = rebalanced(truth + grain(1, 0.1, (64, 64)), 1.2 * truth, grain(2, 0.1, (64, 64)))
    np.testing.assert_allclose(made.mean(), 0.5, rtol=0.01)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (12, 9), (41, 43)])
def test_of_any_size_a_picture_without_noise_stays_and_black_stays_black(shape: tuple[int, int]) -> None:
    picture, black = grain(1, 0.1, shape) + 1, np.zeros((*shape, 3), np.float32)
    np.testing.assert_array_equal(rebalanced(picture, picture, grain(2, 0.1, shape)), picture)
    np.testing.assert_array_equal(rebalanced(black, black, black), black)


def test_a_pixel_that_is_not_finite_spoils_no_other() -> None:
    noisy, clean, noise = (grain(i, 0.1, (64, 64)) + 1 for i in range(3))
    noisy[30, 30], noise[30, 30] = np.nan, np.inf
    assert np.isfinite(rebalanced(noisy, clean, noise - 1)).all()


def test_where_the_denoiser_lost_nothing_noise_brings_nothing() -> None:
    truth = np.full((40, 40, 3), 0.5, np.float32)
    errors = [error(rebalanced(truth + grain(i, 0.1), truth, grain(99 - i, 0.1)), truth) for i in range(20)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 / np.sqrt(4 * np.pi) / REGION


def test_a_firefly_that_both_halves_of_the_samples_found_stays_away() -> None:
    truth = np.full((40, 40, 3), 0.5, np.float32)
    noisy, noise = truth + grain(1, 0.02), grain(2, 0.02)
    noisy[20, 20] = 3.0
    mixture = mixed(noisy, truth, noise)
    around = (slice(16, 25), slice(16, 25))
    assert error(mixture[around], truth[around]) < 0.5 * 0.02
    assert np.abs(mixture[20, 20] - 0.5).max() < 3 * 0.02  # of 2.5


def test_mixing_changes_nothing_where_nothing_was_taken_away_or_all_is_dark() -> None:
    image = np.random.default_rng(1).random((12, 9, 3), np.float32)
    np.testing.assert_array_equal(mixed(image, image, np.zeros_like(image)), image)
    dark = np.zeros_like(image)
    np.testing.assert_array_equal(mixed(dark, dark, dark), dark)


def seen_pixels(made: Any, thing: Any) -> int:
    """How many of 32x32 pixels show a thing at their centre."""
    across = (np.arange(32) + 0.5) / 32
    x, y = (axis.ravel() for axis in np.meshgrid(across, across))
    ray, _ = made.view.camera.sensor.sample_ray(0, 0, mi.Point2f(x, y), mi.Point2f(0.5))
    hit = made.view.scene.ray_intersect(ray)
    return int(np.sum(np.array(hit.shape == mi.ShapePtr(thing))))


def test_albedo_and_normal_are_those_of_the_surface() -> None:
    content = {
        "wall": {
            "type": "rectangle",
            "to_world": place((20, 20, 1), (0, 3, 0), degrees=90),
            "bsdf": paint(0.2, 0.5, 0.7),
        },
        "lamp": lamp(),
    }
    made = renderer(described(content), width=16, height=16, spp=16, bounces=0)
    made._look_from(1)
    layers = layers_of(made, None, mi.load_dict({"type": "box"}))
    np.testing.assert_allclose(layers.albedo[12:], np.broadcast_to([0.2, 0.5, 0.7], (4, 16, 3)), rtol=1e-5)
    np.testing.assert_allclose(layers.normal[12:], np.broadcast_to([0.0, -1, 0], (4, 16, 3)), atol=1e-5)
    # There is no cache, and the lamp that is in view is in no layer.
    assert not layers.cached.any()
    assert layers.rest[12:].min() > 0
    assert layers.rest.max() < 1


def test_a_mirror_shows_the_surface_that_is_in_it() -> None:
    mirror = {
        "type": "rectangle",
        "to_world": place((20, 20, 1), (0, 3, 0), degrees=90),
        "bsdf": {"type": "conductor", "material": "none"},
    }
    behind = {
        "type": "rectangle",
        "to_world": place((90, 90, 1), (0, -9, 0), degrees=-90),
        "bsdf": paint(0.2, 0.5, 0.7),
    }
    made = renderer(
        described({"mirror": mirror, "behind": behind, "lamp": lamp()}),
        width=16,
        height=16,
        spp=16,
        bounces=0,
    )
    made._look_from(1)
    layers = layers_of(made, None, mi.load_dict({"type": "box"}))
    np.testing.assert_allclose(layers.albedo[12:], np.broadcast_to([0.2, 0.5, 0.7], (4, 16, 3)), rtol=1e-5)
    np.testing.assert_allclose(layers.normal[12:], np.broadcast_to([0.0, 1, 0], (4, 16, 3)), atol=1e-5)


def test_the_scale_takes_middle_tones_to_middle_grey_and_heeds_no_black_and_no_noise() -> None:
    picture = np.zeros((40, 50, 3), np.float32)
    assert scale_of(picture) == 1.0
    picture[:] = 0.02
    assert scale_of(picture) == pytest.approx(9.0, rel=1e-3)
    picture[:16] = 0
    assert scale_of(picture) == pytest.approx(9.0, rel=1e-3)
    picture[16:] *= np.random.default_rng(1).gamma(1.0, 1.0, (24, 50, 1)).astype(np.float32)
    assert scale_of(picture) == pytest.approx(9.0, rel=0.1)


class Takes:
    """A denoiser that gives back a part of what it gets."""

    def __init__(self, part: float) -> None:
        self.part = part

    def clean(
        self, color: np.ndarray, albedo: np.ndarray, normal: np.ndarray, *, scale: float, prefilter: bool
    ) -> np.ndarray:
        assert (color >= 0).all()
        assert ((albedo >= 0) & (albedo <= 1)).all()
        return np.float32(self.part) * color


class Still:
    """Frame 1 of a scene, from records that are made once, with a denoiser or without."""

    def __init__(self, description: SceneDescription) -> None:
        self.made = renderer(description, width=32, height=32, spp=16)
        self.cache = self.made.load(self.made.first_pass(1).records)

    def __call__(self, denoiser: Any = None, *, denoise: bool = True) -> np.ndarray:
        shader = FrameShader(self.made.view, self.made._settings.spp, denoise=denoise)
        if denoiser is not None:
            shader.__dict__["denoiser"] = denoiser
        self.made._shader = shader
        return self.made.shade(1, self.cache).image


def test_what_gloss_shows_of_the_cache_is_left_to_the_denoiser() -> None:
    rough = {"type": "roughconductor", "alpha": 0.3}
    made = renderer(described(room(rough) | {"lamp": lamp()}), width=32, height=32, spp=16)
    cache = made.load(made.first_pass(1).records)
    made._look_from(1)
    layers = layers_of(made, cache, mi.load_dict({"type": "box"}))
    ball = np.s_[14:18, 14:18]
    assert layers.rest[ball].mean() > 0.02
    assert not layers.cached[ball].any()
    assert layers.cached[28:].min() > 0  # the floor
    ahead = layers.normal[ball]
    assert (ahead[..., 1] < -0.6).all()  # towards the camera


@pytest.mark.parametrize("thing", ["white paint", slow("principled")])
def test_only_the_rest_goes_through_the_denoiser(thing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for step in ("balanced", "mixed"):
        monkeypatch.setattr(frame_module, step, lambda noisy, clean, *_: clean)
    frame = Still(described(room(THINGS.get(thing)) | {"lamp": lamp(), "sky": SKY}, film={"type": "box"}))
    plain = frame(denoise=False)
    kept, half, cached = (frame(Takes(part)) for part in (1, 0.5, 0))
    np.testing.assert_allclose(kept, plain, rtol=1e-5, atol=1e-6)
    assert 0.1 * plain.mean() < cached.mean() < 0.9 * plain.mean()
    np.testing.assert_allclose(half, (cached + plain) / 2, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("alone", ["mixed", "balanced"])
def test_light_that_a_denoiser_takes_away_comes_back(alone: str, monkeypatch: pytest.MonkeyPatch) -> None:
    other = "balanced" if alone == "mixed" else "mixed"
    monkeypatch.setattr(frame_module, other, lambda noisy, clean, *_: clean)
    frame = Still(described(room() | {"lamp": lamp()}, film={"type": "box"}))
    plain, taken = frame(denoise=False), frame(Takes(0.5))
    assert np.mean(plain - taken) < 0.1 * plain.mean()


@needs_oidn
def test_where_all_light_is_cached_the_denoiser_changes_nothing() -> None:
    # The lamp shines at the ceiling, which is out of view.
    upward = {
        "type": "rectangle",
        "to_world": place((0.7, 0.5, 1), (0, 0.8, 2.7)),
        "bsdf": paint(0, 0, 0),
        "emitter": LAMP,
    }
    low = CameraPath(tuple(Keyframe(time, (0, -5.5, 0.8), (0, 0, 0.7), fov=12 + time) for time in (0.0, 1.0)))
    frame = Still(SceneDescription("test", room() | {"lamp": upward}, low))
    plain = frame(denoise=False)
    assert plain.min() > 0
    assert frame().tobytes() == plain.tobytes()


@needs_oidn
@pytest.mark.parametrize("prefilter", [False, True])
def test_a_denoised_picture_has_the_same_bytes_each_time_and_on_any_number_of_threads(
    prefilter: bool,
) -> None:
    rng = np.random.default_rng(1)
    color = rng.gamma(1.0, 1.0, (72, 128, 3)).astype(np.float32)
    albedo = rng.random((72, 128, 3), np.float32)
    normal = 2 * rng.random((72, 128, 3), np.float32) - 1
    before = [color.copy(), albedo.copy(), normal.copy()]
    threads = (1, 2, 2, 3, 7)  # the library takes as many as there are cores
    found = {
        Denoiser(n).clean(color, albedo, normal, scale=2.0, prefilter=prefilter).tobytes() for n in threads
    }
    assert len(found) == 1
    again = Denoiser(2)
    assert {
        again.clean(color, albedo, normal, scale=2.0, prefilter=prefilter).tobytes() for _ in range(3)
    } == found
    for was, now in zip(before, (color, albedo, normal), strict=True):
        np.testing.assert_array_equal(was, now)


@needs_oidn
def test_a_denoised_frame_has_the_same_bytes_each_time_and_on_any_number_of_threads() -> None:
    frame = Still(described(room(THINGS["plastic"]) | {"lamp": lamp(), "sky": SKY}))
    first = frame()
    assert (first != frame(denoise=False)).any()
    threads = dr.thread_count()
    try:
        for number in (1, 1, 3):
            dr.set_thread_count(number)
            assert frame().tobytes() == first.tobytes()
    finally:
        dr.set_thread_count(threads)


@needs_oidn
def test_a_frame_of_the_gallery_comes_nearer_to_the_truth() -> None:
    # Without bounces there is no cache to fill: all light is what the denoiser gets.
    def frame(**settings: Any) -> np.ndarray:
        scene = steadylight.load_scene("gallery")
        made = renderer_of(scene, **settings)
        return made.shade(91, None).image

    def renderer_of(scene: Any, **settings: Any) -> Any:
        chosen = {"frames": (91,), "width": 96, "height": 54, "bounces": 0} | settings
        poses = dict(zip((91,), scene.camera.frame_poses((91,), scene.fps), strict=True))
        return Renderer(scene, poses, RenderSettings.checked(**chosen))

    truth = frame(spp=256, seed=7)

    def error(image: np.ndarray) -> float:
        return float(np.sqrt((((image - truth) / (truth + 0.1 * truth.mean())) ** 2).mean()))

    plain, denoised = (frame(spp=16, denoise=denoise) for denoise in (False, True))
    assert error(denoised) < 0.8 * error(plain)
    assert abs(denoised.mean() / truth.mean() - 1) < 0.01


def test_a_machine_without_the_library_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(SettingsError, match="-m pip install pyoidn"):
        check_denoiser()
    with pytest.raises(BackendError, match="-m pip install pyoidn") as caught:
        Denoiser(1)
    assert describe(caught.value)["cause"] == "host"
    # Before it has lit anything.
    made = renderer(described(room() | {"lamp": lamp()}), denoise=True, bounces=0)
    monkeypatch.setattr(frame_module, "render_layers", lambda *_: pytest.fail("it has begun"))
    with pytest.raises(BackendError):
        made.shade(1, None)
