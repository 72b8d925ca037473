"""Which part of the environment the cache holds: all that is even, and of a sun no more than of the sky beside it."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import LAMP, described, lamp, paint, place

from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.scene import build_scene

FLOOR = {"type": "rectangle", "to_world": place((2, 2, 1)), "bsdf": paint(0.5, 0.5, 0.5)}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}
BULB = {"type": "point", "position": [0, 0, 2], "intensity": 3.0}


def environment_of(**more: dict[str, Any]) -> Environment:
    return Environment(build_scene(described({"floor": FLOOR, **more})))


def cached(environment: Environment, *radiance: float) -> float:
    return float(environment.cached_fraction(mi.Color3f(*radiance))[0])


def test_an_even_sky_is_cached_whole_and_what_is_brighter_up_to_there() -> None:
    sky = environment_of(sky=SKY)
    assert sky.exists
    assert cached(sky, 0.5, 1, 2) == 1
    assert cached(sky, 0, 0, 0) == 1
    # Cut by its brightest channel, so that the colour stays.
    assert cached(sky, 8, 1, 2) == pytest.approx(1 / 4, rel=1e-4)


def test_a_sun_is_cut_at_the_radiance_of_the_sky() -> None:
    image = np.full((64, 128, 3), 0.8, np.float32)
    image[30:34, 40:44] = 1000  # 0.2 % of the directions
    sky = environment_of(sky={"type": "envmap", "data": image})
    assert cached(sky, 0.8, 0.8, 0.8) == pytest.approx(1, rel=1e-3)
    assert cached(sky, 1000, 1000, 1000) == pytest.approx(0.8e-3, rel=1e-3)


def test_a_window_of_the_sky_wider_than_a_hundredth_is_cached_whole() -> None:
    image = np.full((64, 128, 3), 0.1, np.float32)
    image[24:40, 0:32] = 5  # 6 % of the directions
    sky = environment_of(sky={"type": "envmap", "data": image})
    assert cached(sky, 5, 5, 5) == pytest.approx(1, rel=1e-3)


def test_without_an_environment_nothing_is_cached() -> None:
    none = environment_of(lamp=lamp())
    assert not none.exists
    assert cached(none, 1, 2, 3) == 0
    assert none.arrays() == []


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"sky": SKY}, True),
        ({"sky": SKY, "bulb": BULB}, True),
        ({"sky": SKY, "lamp": lamp()}, False),
        ({"sky": SKY, "ball": {"type": "sphere", "emitter": LAMP}}, False),
        ({"lamp": lamp()}, False),
        ({"bulb": BULB}, False),
    ],
    ids=["sky", "sky and bulb", "sky and lamp", "sky and ball", "lamp", "bulb"],
)
def test_it_is_the_only_emitter_where_a_ray_can_hit_no_other(more: dict[str, Any], expected: bool) -> None:
    assert bool(environment_of(**more).only_emitter) is expected


def test_scenes_are_told_apart_by_their_number() -> None:
    assert environment_of(sky=SKY).scene_number != environment_of(sky=SKY).scene_number
