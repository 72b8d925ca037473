"""Which records may answer beside a ledge, where the answer is known."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, place, renderer, room

from steadylight.renderers.mitsuba.records.obstacles import (
    OBSTACLE,
    PROBE_HEIGHTS,
    PROBES,
    Trust,
    obstacle_distance,
    trusted_radius,
    wanted_spacing,
)
from steadylight.renderers.mitsuba.scene import build_scene
from variants import slow

LEDGE = 0.1
FARTHEST = 1.5


@pytest.fixture(scope="module")
def floor() -> Any:
    """A floor with a ledge 0.1 m high that runs along x = 0."""
    ledge = {
        "type": "rectangle",
        "to_world": place((LEDGE / 2, 50, 1), (0, 0, LEDGE / 2), about=(0, 1, 0), degrees=90),
    }
    return build_scene(
        described({"floor": {"type": "rectangle", "to_world": place((50, 50, 1))}, "ledge": ledge})
    )


def at(scene: Any, x: np.ndarray) -> tuple[Any, Any]:
    """Points of the floor and their normals."""
    y = np.linspace(-1, 1, len(x))
    ray = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), 5), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    assert np.array(si.is_valid()).all()
    return si, mi.Normal3f(si.n)


def seen(scene: Any, x: np.ndarray, farthest: float = FARTHEST) -> np.ndarray:
    return np.array(obstacle_distance(scene, *at(scene, x), mi.Float(farthest), mi.Bool(True)))


def bounds_of_a_probe() -> tuple[float, float]:
    """Least and greatest length of the probe that meets a long wall a metre off: by height and by azimuth.

    Low and high probes alternate, so that a low one is never further than 2 pi / PROBES from the wall's direction.
    """
    level = np.sqrt(1 - PROBE_HEIGHTS[0] ** 2)
    return 1 / level, 1 / (level * np.cos(2 * np.pi / PROBES))


@pytest.mark.parametrize("side", [-1, 1])
def test_beside_a_ledge_the_distance_is_that_to_the_ledge(floor: Any, side: int) -> None:
    distance = np.linspace(0.005, 0.3, 200)  # so near that the low probes do not pass over it
    found = seen(floor, side * distance) / distance
    least, most = bounds_of_a_probe()
    assert distance.max() * most * PROBE_HEIGHTS[0] < LEDGE
    assert found.min() >= 0.999 * least
    assert found.max() <= 1.001 * most
    assert found.std() > 0.01  # each point turns its probes another way


def test_far_from_anything_the_distance_is_the_farthest(floor: Any) -> None:
    np.testing.assert_array_equal(seen(floor, np.linspace(2, 10, 50)), np.float32(FARTHEST))
    # No probe looks further than it is told.
    np.testing.assert_array_equal(seen(floor, np.full(50, 0.2), 0.1), np.float32(0.1))


def test_points_that_do_not_ask_see_nothing(floor: Any) -> None:
    si, normal = at(floor, np.full(10, 0.1))
    asking = np.arange(10) % 2 == 0
    found = np.array(obstacle_distance(floor, si, normal, mi.Float(FARTHEST), mi.Bool(asking)))
    np.testing.assert_array_equal(found < FARTHEST, asking)


def test_a_record_is_trusted_as_far_as_twice_the_distance_to_a_ledge_or_a_few_pixels(floor: Any) -> None:
    x = np.array([0.05, 0.1, 0.2, 4.0])
    si, normal = at(floor, x)
    beside = seen(floor, x)

    def trusted(detail: float, travelled: float, smallest: float = 0) -> np.ndarray:
        numbers = (mi.Float(value) for value in (detail, smallest, FARTHEST, 1))
        trust = Trust(mi.Point3f(0, 0, 5), *numbers)
        wanted = wanted_spacing(si, mi.Float(travelled), mi.Color3f(1), trust)
        return np.array(trusted_radius(floor, si, normal, wanted, trust, mi.Bool(True)))

    np.testing.assert_allclose(trusted(1e-4, 10), OBSTACLE * beside, rtol=1e-6)
    # From afar a pixel is larger than the distance to the ledge.
    np.testing.assert_allclose(trusted(0.01, 30), np.maximum(OBSTACLE * beside, 0.3), rtol=1e-6)
    assert (OBSTACLE * beside[:2] < 0.3).all()
    # The camera is 5 m above; a path that starts nearer, at a clip plane, is no reason to ask for more.
    away = np.linalg.norm(np.array(si.p).T - (0, 0, 5), axis=1)
    np.testing.assert_allclose(trusted(0.1, 1), np.maximum(OBSTACLE * beside, 0.1 * away), rtol=1e-6)
    np.testing.assert_allclose(trusted(1e-4, 1, 0.4), np.maximum(OBSTACLE * beside, 0.4), rtol=1e-6)


def test_what_a_faint_mirror_shows_asks_for_less(floor: Any) -> None:
    si, _ = at(floor, np.array([0.1]))

    def wanted(throughput: list[float], weakest: float) -> float:
        numbers = (mi.Float(value) for value in (0.01, 0, FARTHEST, weakest))
        trust = Trust(mi.Point3f(0, 0, 5), *numbers)
        return float(wanted_spacing(si, mi.Float(20), mi.Color3f(throughput), trust)[0])

    assert wanted([1, 1, 1], 1 / 64) == pytest.approx(0.2)
    # The brightest channel counts, and its root: a mirror of 4 % has five times the spacing.
    assert wanted([0.01, 0.04, 0.02], 1 / 64) == pytest.approx(1.0)
    assert wanted([1e-6, 0, 0], 1 / 64) == pytest.approx(1.6)
    assert wanted([0.01, 0.04, 0.02], 1) == pytest.approx(0.2)


@pytest.mark.parametrize("sensor", [{"near_clip": 3.2}, slow({"near_clip": 1e-3})])
def test_a_record_made_for_a_point_answers_it_whatever_the_camera_clips(sensor: dict[str, Any]) -> None:
    made = renderer(
        described(room() | {"lamp": lamp()}, sensor={"type": "perspective", **sensor}), base_rays=32
    )
    filled = made.first_pass(1)
    # Hits and misses balance as the threshold says after few rays: no point was filled again and again.
    assert filled.rays < 4 * 48 * 48
    records = made.load(filled.records)
    for number in range(4):
        found = made.audit([1, 2, 3], records, last=False)
        if found.missed == 0:
            break
        records = made.load(made.fill([found.points], records.records, number))
    assert found.missed == 0
    assert found.looked_up == 3 * 48 * 48
