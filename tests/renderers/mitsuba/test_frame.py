"""Whole frames whose every pixel is known: direct light, cached light, and what shines, with and without a denoiser."""

from __future__ import annotations

import numpy as np
import pytest
from small_scenes import Identity, described, paint, place, renderer

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.frame import FrameShader

ALBEDO, SUN, CACHED = np.array([0.2, 0.5, 0.7]), np.array([5.0, 4.0, 3.0]), np.array([1.0, 2.0, 4.0])
WALL = {
    "type": "rectangle",
    "to_world": place((99, 99, 1), (0, 3, 0), degrees=90),
    "bsdf": paint(*ALBEDO),
}
LIT = {
    "wall": WALL,
    "sun": {
        "type": "directional",
        "direction": [0, 0.8, -0.6],
        "irradiance": {"type": "rgb", "value": SUN.tolist()},
    },
}
GLOWING = {
    "glow": {**WALL, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 7.0]}}}
}


def record() -> Records:
    """One for the whole wall."""
    arrays = {name: np.zeros((1, *shape), np.float32) for name, shape in Records.shapes(1).items()}
    arrays |= {"position": np.float32([[0, 3, 0]]), "normal": np.float32([[0, -1, 0]])}
    arrays["headroom"] = np.float32([np.inf])
    return Records(
        **{**arrays, "irradiance": np.float32(CACHED).reshape(1, 1, 3), "radius": np.float32([500])}
    )


@pytest.mark.parametrize("denoise", [False, True])
@pytest.mark.parametrize("film", ["box", "gaussian", "mitchell"])
@pytest.mark.parametrize("spp", [1, 7, 100])
def test_a_wall_shows_direct_light_and_cached_light(spp: int, film: str, denoise: bool) -> None:
    made = renderer(described(LIT, film={"type": film}), width=12, height=9)
    made._look_from(1)
    shader = FrameShader(made.view, spp, denoise=denoise)
    shader.__dict__["denoiser"] = Identity()
    direct = np.broadcast_to(ALBEDO / np.pi * 0.8 * SUN, (9, 12, 3))
    np.testing.assert_allclose(shader.shade(None, 1).image, direct, rtol=1e-4)
    both = shader.shade(made.load(record()), 1)
    assert both.missed == 0
    np.testing.assert_allclose(both.image, direct + ALBEDO / np.pi * CACHED, rtol=1e-4)


@pytest.mark.parametrize("denoise", [False, True])
def test_what_shines_is_seen_as_it_is_beside_what_it_scatters(denoise: bool) -> None:
    made = renderer(described(GLOWING | {"sun": LIT["sun"]}), width=12, height=9)
    made._look_from(1)
    shader = FrameShader(made.view, 4, denoise=denoise)
    shader.__dict__["denoiser"] = Identity()
    expected = np.broadcast_to([9.0, 8, 7] + ALBEDO / np.pi * 0.8 * SUN, (9, 12, 3))
    np.testing.assert_allclose(shader.shade(None, 1).image, expected, rtol=1e-4)


def test_look_ups_that_nothing_answers_are_counted_and_dark() -> None:
    made = renderer(described(LIT), width=12, height=9)
    made._look_from(1)
    shader = FrameShader(made.view, 4, denoise=False)
    found = shader.shade(made.load(Records.empty()), 1)
    assert found.missed == 12 * 9 * 4
    np.testing.assert_allclose(
        found.image, np.broadcast_to(ALBEDO / np.pi * 0.8 * SUN, (9, 12, 3)), rtol=1e-4
    )
