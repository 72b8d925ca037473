"""Light at a vertex: what rays meet and what emitter samples bring add up to the analytic answer, however split."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, paint, place
from test_emitters import BULB, discs, known_at

from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.vertex import (
    Departure,
    Lighting,
    Met,
    Receiver,
    all_lobes,
    emission,
    emitter_samples,
    mis_weight,
)
from steadylight.renderers.mitsuba.sampling import Purpose, samples_of
from steadylight.renderers.mitsuba.scene import build_scene

LANES = 1 << 17
ALBEDO, RADIANCE = np.array([0.8, 0.5, 0.2]), np.array([9.0, 8.0, 7.0])
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}


def under_a_lamp(height: float, **more: Any) -> Lighting:
    """A wide floor at z = 0 under a lamp of 2 x 1 m, and whatever else."""
    lamp = {
        "type": "rectangle",
        "to_world": place((1, 0.5, 1), (0, 0, height), degrees=180),
        "bsdf": paint(0, 0, 0),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE.tolist()}},
    }
    floor = {"type": "rectangle", "to_world": place((50, 50, 1)), "bsdf": paint(*ALBEDO)}
    scene = build_scene(described({"floor": floor, "lamp": lamp, **more}))
    return Lighting(scene, BSDFTraits(scene), Environment(scene), known_at(scene, discs(1)), 1)


def seen_from_the_floor(height: float) -> float:
    """Form factor of the lamp from the point below its middle (two parallel rectangles, four quarters)."""
    x, y = 1 / height, 0.5 / height
    quarter = x / np.hypot(1, x) * np.arctan(y / np.hypot(1, x))
    quarter += y / np.hypot(1, y) * np.arctan(x / np.hypot(1, y))
    return float(4 * quarter / (2 * np.pi))


def on_the_floor(lighting: Lighting) -> Any:
    zero = dr.zeros(mi.Float, LANES)
    ray = mi.Ray3f(mi.Point3f(zero, zero, zero + 0.01), mi.Vector3f(0, 0, -1))
    return lighting.scene.ray_intersect(ray)


def arrived(lighting: Lighting, row: int, samples: int, *, cached: bool = False) -> tuple[np.ndarray, ...]:
    """Radiance by emitter samples and by rays of the BSDF that meet something, (3,) each, and the sum's error."""
    si = on_the_floor(lighting)
    bsdf = si.bsdf()
    lane = dr.arange(mi.UInt32, LANES)
    numbers = samples_of(dr.opaque(mi.UInt32, 1), lane // 16, lane % 16).at(mi.UInt32(0), mi.UInt32(0))
    vertex = Receiver(si, mi.UInt32(row), mi.UInt32(samples), mi.Bool(False), mi.Bool(cached))
    place_on_it = numbers.sample_2d(Purpose.EMITTER)
    sampled = emitter_samples(lighting, vertex, all_lobes(bsdf, si), place_on_it, mi.Bool(True))
    lobe, direction = numbers.sample_1d(Purpose.LOBE), numbers.sample_2d(Purpose.DIRECTION)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction)
    there = lighting.scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)))
    departure = Departure(si, mi.UInt32(row), bs.pdf, mi.Bool(False), mi.Float(samples))
    found = emission(lighting, Met(there, None, None, there.t), departure, mi.Bool(True))
    held = found.cached if cached else mi.Float(0)
    met = dr.select(found.active, weight * found.radiance * (1 - held) * found.mis, 0)
    parts = [np.array(part, np.float64).reshape(3, -1, 16).mean(axis=2) for part in (sampled, met)]
    error = np.sum(parts, axis=0).std(axis=1) / np.sqrt(LANES / 16)
    return parts[0].mean(axis=1), parts[1].mean(axis=1), error


@pytest.mark.parametrize("row", [0, NO_ROW], ids=["known", "unknown"])
@pytest.mark.parametrize("samples", [1, 3, 16])
@pytest.mark.parametrize("height", [0.2, 1.0, 5.0])
def test_samples_and_rays_add_up_to_the_light_of_a_rectangle(height: float, samples: int, row: int) -> None:
    expected = ALBEDO * RADIANCE * seen_from_the_floor(height)
    sampled, met, error = arrived(under_a_lamp(height), row, samples)
    np.testing.assert_array_less(error, 0.002 * expected)
    np.testing.assert_array_less(np.abs(sampled + met - expected), 4 * error)
    assert sampled.min() > 0 < met.min()  # or nothing were shared


def test_more_samples_take_over_from_the_rays() -> None:
    lighting = under_a_lamp(1.0)
    shares = [arrived(lighting, 0, samples)[1].mean() for samples in (1, 3, 16)]
    assert shares[0] > 2 * shares[1] > 4 * shares[2]


@pytest.mark.parametrize("row", [0, NO_ROW], ids=["known", "unknown"])
def test_among_several_emitters_the_sum_is_that_of_all(row: int) -> None:
    # The bulb shines at the floor from z = 1: I cos³ / h²; the lamp above does not shade it.
    x, y, z = BULB["position"]
    distance = float(np.sqrt(x * x + y * y + z * z))
    bulb = ALBEDO / np.pi * BULB["intensity"] * (z / distance) / distance**2
    lamp = ALBEDO * RADIANCE * seen_from_the_floor(2.0)
    sky = ALBEDO * np.array([0.5, 1, 2]) * (1 - seen_from_the_floor(2.0))
    lighting = under_a_lamp(2.0, bulb=BULB, sky=SKY)
    sampled, met, error = arrived(lighting, row, 2)
    np.testing.assert_array_less(np.abs(sampled + met - (bulb + lamp + sky)), 4 * error)
    assert (error < 0.005 * (bulb + lamp + sky)).all()
    # What the cache holds of the environment, here all of it, is left out.
    sampled, met, error = arrived(lighting, row, 2, cached=True)
    np.testing.assert_array_less(np.abs(sampled + met - (bulb + lamp)), 4 * error)


def test_where_emitter_samples_are_enough_they_count_in_full() -> None:
    lighting = under_a_lamp(1.0)
    si = on_the_floor(lighting)
    lane = dr.arange(mi.UInt32, LANES)
    numbers = samples_of(dr.opaque(mi.UInt32, 2), lane // 16, lane % 16).at(mi.UInt32(0), mi.UInt32(0))
    vertex = Receiver(si, mi.UInt32(0), mi.UInt32(2), mi.Bool(True), mi.Bool(False))
    sample = numbers.sample_2d(Purpose.EMITTER)
    light = emitter_samples(lighting, vertex, all_lobes(si.bsdf(), si), sample, mi.Bool(True))
    expected = ALBEDO * RADIANCE * seen_from_the_floor(1.0)
    np.testing.assert_allclose(np.array(light).mean(axis=1), expected, rtol=2e-3)


def test_a_mirror_meets_emitters_in_full_and_only_the_environment_is_cached() -> None:
    lighting = under_a_lamp(1.0, sky=SKY)
    origin = mi.Point3f(mi.Float([0, 5, 5]), 0, 0.01)
    rays = mi.Ray3f(origin, mi.Vector3f(0, 0, mi.Float([1, 1, -1])))  # to the lamp, the sky and the floor
    si = lighting.scene.ray_intersect(rays)
    found = emission(lighting, Met(si, None, None, si.t), Departure.nowhere(), mi.Bool(True))
    assert list(found.active) == [True, True, False]
    np.testing.assert_allclose(np.array(found.radiance).T, [RADIANCE, [0.5, 1, 2], [0, 0, 0]], rtol=1e-6)
    np.testing.assert_array_equal(np.array(found.mis), 1)
    np.testing.assert_allclose(np.array(found.cached)[:2], [0, 1], rtol=1e-6)


def test_weights_of_two_densities_add_up_to_one_and_are_never_no_number() -> None:
    a, b = mi.Float([1, 3, 0, 1e19, 5]), mi.Float([1, 4, 2, 1, 0])
    np.testing.assert_allclose(np.array(mis_weight(a, b) + mis_weight(b, a)), [1, 1, 1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(np.array(mis_weight(a, b))[:3], [0.5, 9 / 25, 0], rtol=1e-6)
    assert float(mis_weight(mi.Float(0), mi.Float(0))[0]) == 0
    assert np.isfinite(np.array(mis_weight(mi.Float(np.inf), mi.Float(1)))).all()
