"""Path-traced pictures: against Mitsuba's own renderer, for any number of samples, bands and passes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import CAMERA, described, lamp, room

from steadylight.renderers.mitsuba import frozen
from steadylight.renderers.mitsuba.frozen import forget_recordings
from steadylight.renderers.mitsuba.image import path_tracing, pixels
from steadylight.renderers.mitsuba.image.denoising import Denoiser
from steadylight.renderers.mitsuba.image.path_tracing import path_traced
from steadylight.renderers.mitsuba.image.pixels import Camera, Sampling
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor, release

SIZE = (24, 18)


@pytest.fixture(scope="module")
def scene() -> Any:
    return build_scene(described(room() | {"lamp": lamp()}))


def camera(kind: str = "gaussian") -> Camera:
    return Camera(build_sensor(described({}), CAMERA.pose(0), *SIZE, {"type": kind}), SIZE)


def integrator(**more: Any) -> Any:
    return mi.load_dict({"type": "path", "max_depth": 3, "rr_depth": 99, **more})


@pytest.mark.parametrize("kind", ["box", "gaussian"])
def test_a_picture_is_that_of_mitsubas_own_renderer(scene: Any, kind: str) -> None:
    made = camera(kind)
    ours = path_traced(scene, made, integrator(), Sampling(256, 1))
    theirs = np.array(mi.render(scene, sensor=made.sensor, integrator=integrator(), spp=1024, seed=2))
    assert ours.shape == (18, 24, 3)
    np.testing.assert_allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.01)
    parts = [a.reshape(3, 6, 4, 6, 3).mean(axis=(1, 3)) for a in (ours, theirs)]
    np.testing.assert_allclose(*parts, rtol=0.04, atol=0.005 * theirs.mean())


def test_what_needs_no_random_number_is_known_exactly() -> None:
    sky = build_scene(
        described(
            {"sky": {"type": "constant", "radiance": 0.7}, "far": {"type": "sphere", "center": [0, -99, 0]}}
        )
    )
    for spp in (1, 5, 16, 100):
        image = path_traced(sky, camera(), integrator(), Sampling(spp, 3))
        np.testing.assert_allclose(image, 0.7, rtol=1e-5)


def test_a_picture_has_the_same_bytes_each_time_and_others_with_another_seed(scene: Any) -> None:
    first, second, other = (
        path_traced(scene, camera(), integrator(), Sampling(5, seed)) for seed in (1, 1, 2)
    )
    assert first.tobytes() == second.tobytes() != other.tobytes()


def test_a_recording_is_replayed_for_other_views_but_not_for_other_integrators(scene: Any) -> None:
    def picture(time: float, depth: int) -> Any:
        made = Camera(build_sensor(described({}), CAMERA.pose(time), *SIZE), SIZE)
        return path_traced(scene, made, integrator(max_depth=depth), Sampling(5, 1))

    def by_itself(time: float, depth: int) -> Any:
        forget_recordings()
        return picture(time, depth)

    asked = [(0, 3), (1, 3), (1, 2)]
    alone = [by_itself(*each).tobytes() for each in asked]
    forget_recordings()
    assert [picture(*each).tobytes() for each in asked] == alone
    assert len(set(alone)) == 3


def test_a_released_scene_is_kept_by_no_recording() -> None:
    path_traced(build_scene(described(room() | {"lamp": lamp()})), camera(), integrator(), Sampling(1, 1))
    assert frozen._LOADED
    release()
    assert not frozen._LOADED


@pytest.mark.parametrize(("name", "value"), [("SPP_AT_ONCE", 60), ("SAMPLES_AT_ONCE", 10 * 24 * 256)])
def test_passes_and_bands_make_the_same_picture_but_for_the_noise(
    scene: Any, monkeypatch: pytest.MonkeyPatch, name: str, value: int
) -> None:
    monkeypatch.setattr(pixels, "SPP_AT_ONCE", 256)
    whole = path_traced(scene, camera(), integrator(), Sampling(256, 1))
    monkeypatch.setattr(pixels, name, value)
    parts = path_traced(scene, camera(), integrator(), Sampling(256, 1))
    assert (parts != whole).any()
    np.testing.assert_allclose(parts.mean((0, 1)), whole.mean((0, 1)), rtol=0.01)
    assert np.sqrt(((parts - whole) ** 2).mean()) < 0.05 * whole.mean()


def test_a_sampler_takes_at_least_the_samples_that_were_asked_for() -> None:
    for spp in (1, 2, 5, 16, 31):
        assert spp <= path_tracing._multijitter(spp).sample_count() <= spp + 8


def test_denoising_takes_most_of_the_noise_and_keeps_the_light(scene: Any) -> None:
    pytest.importorskip("pyoidn", reason="pip install pyoidn")
    box = mi.load_dict({"type": "box"})
    truth = path_traced(scene, camera(), integrator(), Sampling(1024, 7), box)
    noisy = path_traced(scene, camera(), integrator(), Sampling(4, 1), box)
    clean = path_tracing.path_traced_and_denoised(scene, camera(), integrator(), Sampling(4, 1), Denoiser(1))
    assert clean.shape == noisy.shape
    lit = truth.max(axis=-1) < 10 * np.median(truth)  # not the lamp itself
    off = [np.sqrt(((image - truth)[lit] ** 2).mean()) for image in (clean, noisy)]
    assert off[0] < 0.7 * off[1]
    # Four samples, and a picture so small that some of the lamp spreads into the rest.
    np.testing.assert_allclose(clean[lit].mean(), truth[lit].mean(), rtol=0.12)
