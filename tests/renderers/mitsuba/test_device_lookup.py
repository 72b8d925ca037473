from __future__ import annotations

import dataclasses
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import random_records

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import STRETCHED, look_up, pair_weights
from steadylight.cache.placement import answered_weight
from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.records.lookup import DeviceCache

Floats = np.ndarray


def on_device(position: Floats, normal: Floats) -> tuple[Any, Any, Any]:
    return (
        mi.Point3f(np.ascontiguousarray(position.T)),
        mi.Normal3f(np.ascontiguousarray(normal.T)),
        mi.Bool(True),
    )


def stretched(records: Records, factor: float) -> Records:
    arrays = {name: getattr(records, name) for name in Records.SHAPES}
    return Records(**{**arrays, "radius": records.radius * np.float32(factor)})


def queries(records: Records, seed: int, each: int) -> tuple[Floats, Floats]:
    """Points about the records, most within a radius, and normals most within the tolerance."""
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.arange(len(records)), each)
    offset = rng.uniform(-1, 1, (len(rows), 3)) * records.radius[rows, None]
    n = records.normal[rows]
    offset -= 0.9 * np.einsum("qi,qi->q", offset, n)[:, None] * n
    normal = n + 0.15 * rng.standard_normal(n.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return (records.position[rows] + offset).astype(np.float32), normal.astype(np.float32)


@pytest.mark.parametrize(
    ("radius", "values", "covered", "walled"),
    [
        ((0.1, 0.8), 1, 0.0, 0.0),
        ((1e-3, 20), 1, 0.0, 0.0),
        ((0.1, 0.8), 3, 0.0, 0.0),
        ((0.1, 0.8), 1, 0.7, 0.0),
        ((0.1, 0.8), 1, 0.0, 0.7),
    ],
    ids=["alike", "unlike", "three values", "covered", "beside walls"],
)
def test_the_kernel_answers_as_the_readable_look_up_does(
    radius: tuple[float, float], values: int, covered: float, walled: float
) -> None:
    records = random_records(1, 250, radius=radius, values=values)
    rng = np.random.default_rng(11)
    height = np.where(rng.random(250) < covered, 0.1 * rng.random(250) * records.radius, np.inf)
    towards = np.cross(records.normal[:, None], rng.standard_normal((250, 2, 3)))
    towards *= (rng.random((250, 2, 1)) < walled) / np.linalg.norm(towards, axis=2, keepdims=True)
    barriers = towards / (records.radius[:, None, None] * (0.1 + rng.random((250, 2, 1))))
    records = dataclasses.replace(
        records, headroom=height.astype(np.float32), barriers=barriers.astype(np.float32)
    )
    position, normal = queries(records, 2, 6)
    expected = look_up(position, normal, records)
    found = DeviceCache(records).with_fallback().look_up(*on_device(position, normal))
    assert 0.5 < (expected.weight > 0).mean() < 1
    # Weights are sums of up to 250 squares of differences of numbers near 1, in single precision.
    np.testing.assert_allclose(np.array(found.weight), expected.weight, rtol=2e-4, atol=2e-4)
    # A ratio of two such sums: where they are small, their errors are not.
    sure = expected.weight > 0.01
    np.testing.assert_allclose(np.array(found.irradiance).T[sure], expected.irradiance[sure], rtol=5e-3)
    p, n, asking = on_device(position, normal)
    weight = DeviceCache(records).weight(p, n, mi.Float(np.inf), asking)
    np.testing.assert_array_equal(np.array(weight), np.array(found.weight))


def test_the_kernel_turns_the_light_with_a_lobe_as_the_readable_look_up_does() -> None:
    records = random_records(1, 250)
    position, normal = queries(records, 2, 6)
    facing = normal + 0.3 * np.random.default_rng(3).standard_normal(normal.shape)
    facing = (facing / np.linalg.norm(facing, axis=1, keepdims=True)).astype(np.float32)
    expected = look_up(position, normal, records, facing)
    p, n, asking = on_device(position, normal)
    found = DeviceCache(records).look_up(p, n, asking, on_device(facing, facing)[1])
    plain = look_up(position, normal, records)
    sure = expected.weight > 0.01
    np.testing.assert_allclose(np.array(found.irradiance).T[sure], expected.irradiance[sure], rtol=5e-3)
    assert np.abs(expected.irradiance[sure] / plain.irradiance[sure] - 1).mean() > 0.03
    np.testing.assert_array_equal(expected.weight, plain.weight)


def test_the_kernel_trusts_no_record_of_a_longer_radius_than_may_be() -> None:
    records = random_records(8, 250)
    position, normal = queries(records, 9, 6)
    longest = np.random.default_rng(10).choice(records.radius, len(position))  # equal radii are trusted
    expected = answered_weight(position, normal, longest, records)
    everything = look_up(position, normal, records).weight
    assert 0.1 < (expected < 0.99 * everything).mean() < 0.9
    p, n, asking = on_device(position, normal)
    weight = DeviceCache(records).weight(p, n, mi.Float(longest), asking)
    np.testing.assert_allclose(np.array(weight), expected, rtol=2e-4, atol=2e-4)


def test_where_nothing_answers_the_same_records_are_asked_with_a_longer_radius_and_wider_normals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    records = random_records(3, 40, radius=(0.05, 0.1))
    far = stretched(records, STRETCHED)
    position, normal = queries(far, 4, 10)
    found = DeviceCache(records).with_fallback().look_up(*on_device(position, normal))
    near, strict = look_up(position, normal, records), look_up(position, normal, far)
    monkeypatch.setattr("steadylight.cache.lookup.NORMAL_TOLERANCE", STRETCHED * NORMAL_TOLERANCE)
    expected = look_up(position, normal, far)
    assert ((strict.weight == 0) & (expected.weight > 0)).sum() > 20  # some answer only for their normals
    relaxed = (near.weight == 0) & (expected.weight > 0.01)
    assert relaxed.sum() > 50
    np.testing.assert_allclose(np.array(found.irradiance).T[relaxed], expected.irradiance[relaxed], rtol=5e-3)
    assert (np.array(found.weight)[relaxed] == 0).all()  # and it still counts as a miss
    lost = expected.weight == 0
    assert lost.any()
    np.testing.assert_array_equal(np.array(found.irradiance).T[lost], 0)


def test_the_row_is_the_record_of_largest_weight() -> None:
    records = random_records(5, 60)
    position, normal = queries(records, 6, 4)
    weights = pair_weights(position[:, None], normal[:, None], records)
    rows = np.array(DeviceCache(records).with_fallback().look_up(*on_device(position, normal)).row)
    best = weights.max(axis=1)
    clear = best > 0.01
    assert clear.sum() > 100
    # Two records may weigh the same up to rounding.
    chosen = weights[clear, rows[clear]]
    np.testing.assert_allclose(chosen, best[clear], rtol=1e-3)


def test_an_empty_cache_answers_nothing_and_names_no_record() -> None:
    position, normal = queries(random_records(1, 5), 1, 1)
    found = DeviceCache(Records.empty()).with_fallback().look_up(*on_device(position, normal))
    np.testing.assert_array_equal(np.array(found.irradiance), 0)
    np.testing.assert_array_equal(np.array(found.weight), 0)
    np.testing.assert_array_equal(np.array(found.row), NO_ROW)


def test_lanes_that_do_not_ask_get_nothing() -> None:
    records = random_records(7, 20)
    position, normal, _ = on_device(records.position, records.normal)
    asking = np.arange(20) % 2 == 0
    weight = np.array(DeviceCache(records).with_fallback().look_up(position, normal, mi.Bool(asking)).weight)
    np.testing.assert_array_equal(weight > 0, asking)


def on_the_floor(x: list[float], radius: float | list[float] = 1.0) -> Records:
    """Records at these places of the plane z = 0, facing up."""
    records = random_records(1, len(x), radius=(1.0, 1.0))
    position = np.zeros((len(x), 3), np.float32)
    position[:, 0] = x
    normal = np.tile(np.float32([0, 0, 1]), (len(x), 1))
    radii = np.full(len(x), radius, np.float32)
    return dataclasses.replace(records, position=position, normal=normal, radius=radii)


def drawn(cache: DeviceCache, screen: float | None, lanes: int = 20000) -> np.ndarray:
    """Rows that a point at the origin draws, with a screen that stands at x = `screen`."""
    shape: dict[str, Any] = {"type": "rectangle"}
    if screen is not None:
        to_world = mi.ScalarTransform4f().translate([screen, 0, 0]).rotate([0, 1, 0], 90)
        shape["to_world"] = to_world
    else:
        shape["to_world"] = mi.ScalarTransform4f().translate([0, 0, 50])
    scene = mi.load_dict({"type": "scene", "shape": shape})
    position, normal = np.zeros((lanes, 3)), np.tile([0.0, 0.0, 1.0], (lanes, 1))
    number = mi.Float(((np.arange(lanes) + 0.5) / lanes).astype(np.float32))
    p, n, active = on_device(position, normal)
    return np.array(cache.draw_in_sight(scene, p, n, number, active).row)


def test_records_are_drawn_as_often_as_their_weights_say() -> None:
    records = on_the_floor([-0.6, -0.1, 0.3, 0.7, 5.0], [1.0, 0.5, 2.0, 1.5, 1.0])
    weights = pair_weights(np.zeros((5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1)), records, np.arange(5))
    weights = weights / records.radius**2  # as in the mean of all
    rows = drawn(DeviceCache(records), None)
    np.testing.assert_allclose(np.bincount(rows, minlength=5) / len(rows), weights / weights.sum(), atol=2e-3)


def test_no_record_is_drawn_that_something_hides() -> None:
    rows = drawn(DeviceCache(on_the_floor([-0.3, 0.3, 0.4])), 0.15)
    # Where the only one in sight is not among those that are drawn, none is.
    assert set(np.unique(rows)) <= {0, NO_ROW}
    assert (rows == 0).mean() > 0.7


def test_those_in_sight_are_drawn_by_their_weights_whatever_is_hidden() -> None:
    records = on_the_floor([0.3, 0.4, -0.2, -0.5], [2.0, 2.0, 1.0, 1.5])
    weights = pair_weights(np.zeros((4, 3)), np.tile([0.0, 0.0, 1.0], (4, 1)), records, np.arange(4))
    weights = (weights / records.radius**2)[2:]
    rows = drawn(DeviceCache(records), 0.15)
    seen = np.bincount(rows[rows != NO_ROW], minlength=4)
    assert seen[:2].sum() == 0
    np.testing.assert_allclose(seen[2:] / seen.sum(), weights / weights.sum(), atol=0.01)


def test_none_is_drawn_where_all_are_hidden_and_where_there_is_none() -> None:
    assert (drawn(DeviceCache(on_the_floor([0.3, 0.4])), 0.15) == NO_ROW).all()
    assert (drawn(DeviceCache(on_the_floor([8.0])), None) == NO_ROW).all()


def test_records_further_off_are_drawn_where_none_is_near() -> None:
    rows = drawn(DeviceCache(on_the_floor([1.5, 1.6])).with_fallback(), None)
    assert set(np.unique(rows)) == {0, 1}
    assert (drawn(DeviceCache(on_the_floor([1.5, 1.6])), None) == NO_ROW).all()


def test_no_other_record_speaks_for_one_that_is_drawn_out_of_its_reach() -> None:
    records = on_the_floor([-0.3, 0.3])
    rows = drawn(DeviceCache(records, np.float32([1.0, 0.2])), None)
    assert (rows == 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (rows == NO_ROW).mean() == pytest.approx(0.5, abs=0.01)


def test_a_record_that_is_drawn_says_what_it_expects_at_the_point() -> None:
    records = on_the_floor([-0.3, 0.4])
    position, normal = np.zeros((2000, 3)), np.tile([0.0, 0.0, 1.0], (2000, 1))
    p, n, active = on_device(position, normal)
    number = mi.Float(((np.arange(2000) + 0.5) / 2000).astype(np.float32))
    scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere", "center": [0, 0, 50]}})
    found = DeviceCache(records).draw_in_sight(scene, p, n, number, active)
    rows, E = np.array(found.row), np.array(found.irradiance).T
    for row in (0, 1):
        alone = look_up(position[:1], normal[:1], records.take(np.array([row])))
        np.testing.assert_allclose(
            E[rows == row], np.tile(alone.irradiance, ((rows == row).sum(), 1)), rtol=1e-4
        )
    both = look_up(position[:1], normal[:1], records)
    np.testing.assert_allclose(E.mean(axis=0), both.irradiance[0], rtol=2e-3)
    np.testing.assert_allclose(np.array(found.weight), both.weight[0], rtol=1e-4)
