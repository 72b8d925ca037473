"""The last audit finds all that the second pass will ask, on whatever paths, and in an order that never varies."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import LAMP, described, lamp, paint, place, renderer, room

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba import view
from steadylight.renderers.mitsuba.paths.misses import MissList, Point
from steadylight.renderers.mitsuba.view import Missed
from variants import slow

GLOSSY = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": paint(0.4, 0.3, 0.2)["reflectance"]}
WALL = {"type": "rectangle", "to_world": place((1.4, 1.4, 1), (0, 1.4, 1.5), degrees=60), "bsdf": GLOSSY}
SHINY = room({"type": "twosided", "bsdf": GLOSSY}) | {"wall": WALL, "lamp": lamp()}


GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.1}
SMOOTH = {"type": "roughplastic", "alpha": 0.05, "diffuse_reflectance": paint(0.4, 0.3, 0.2)["reflectance"]}
BLACK = {"type": "rectangle", "to_world": place((1, 1, 1), (0.5, 1, 1.5), degrees=80), "bsdf": paint(0, 0, 0)}
NEAR = {"type": "sphere", "center": [0.278, -0.88, 1.185], "radius": 0.03, "emitter": LAMP}
SLAB = {
    "type": "cube",
    "to_world": place((0.9, 0.9, 0.02), (0.4, -1.5, 1.2), degrees=75),
    "bsdf": {"type": "dielectric"},
}
PANES = {
    f"pane{number}": {
        "type": "rectangle",
        "to_world": place((0.9, 0.9, 1), (0, -1.4 - 0.1 * number, 1.3), degrees=80),
        "bsdf": {"type": "thindielectric"},
    }
    for number in range(2)
}
STEEP = np.broadcast_to([0.92, 0.5, 0.77], (4, 4, 3)).astype(np.float32)  # a normal of (0.84, 0, 0.54)
TURNED = {  # where a ray comes from below, by that normal, no direction can be drawn
    "type": "normalmap",
    "normalmap": {"type": "bitmap", "data": STEEP, "raw": True},
    "bsdf": {"type": "principled", "metallic": 0.5, "specular": 0.5, "roughness": 0.3},
}
CONTENT: dict[str, dict[str, Any]] = {
    "coats": SHINY,
    "metal beside a lamp": room(GOLD) | {"lamp": lamp(), "near": NEAR, "black": BLACK},
    "metal behind a slab of glass": room(GOLD) | {"lamp": lamp(), "slab": SLAB, "black": BLACK},
    "a coat beside a lamp behind two panes": room(SMOOTH) | {"lamp": lamp(), "near": NEAR} | PANES,
    "glass under a sky": room(GOLD) | PANES | {"slab": SLAB, "sky": {"type": "constant", "radiance": 1.0}},
    "gloss with a normal map": room({"type": "twosided", "bsdf": TURNED}) | {"lamp": lamp()},
}

EACH_TIME = "coats", "metal behind a slab of glass", "gloss with a normal map"


@pytest.fixture(scope="module")
def shiny() -> Any:
    """A renderer of a room with glossy things, on which a path asks the cache several times."""
    return renderer(described(SHINY), spp=16, bounces=1)


def noted(count: int, room: int, order: np.ndarray) -> MissList:
    """A list to which `count` lanes append what the lane says; lanes in the given order."""
    found = MissList(room)
    number = mi.UInt32(order.astype(np.uint32))
    value = mi.Float(number)
    found.note(
        number // 3,
        number % 3,
        Point(mi.Point3f(value, 1, 2), mi.Normal3f(0, value, 0), value / 2, value / 4),
        value >= 0,
    )
    assert found.count == count
    return found


def test_points_are_read_by_path_and_step_whatever_order_they_came_in() -> None:
    order = np.random.default_rng(1).permutation(50_000)
    position, normal, longest, smallest, path = noted(50_000, 60_000, order).read()
    expected = np.arange(50_000, dtype=np.float32)
    np.testing.assert_array_equal(position, np.stack([expected, np.ones(50_000), np.full(50_000, 2)], axis=1))
    np.testing.assert_array_equal(normal[:, 1], expected)
    np.testing.assert_array_equal(longest, expected / 2)
    np.testing.assert_array_equal(smallest, expected / 4)
    np.testing.assert_array_equal(path, np.arange(50_000) // 3)


def test_a_list_that_is_too_short_counts_all_and_is_not_read() -> None:
    found = noted(1000, 999, np.arange(1000))
    with pytest.raises(ValueError, match="1000 points, and room for 999"):
        found.read()


def test_an_empty_list_has_no_points() -> None:
    found = MissList(10)
    assert [array.shape for array in found.read()] == [(0, 3), (0, 3), (0,), (0,), (0,)]


def test_a_view_looks_again_when_there_are_more_points_than_room(shiny: Any, monkeypatch: Any) -> None:
    cache = shiny.load(Records.empty())
    shiny._look_from(1)
    whole = shiny.view.missed_in_pixels(cache, 1)
    assert whole.missed > 100
    monkeypatch.setattr(view, "MISSES_AT_ONCE", 100)
    again = shiny.view.missed_in_pixels(cache, 1)
    for first, second in zip(whole.points, again.points, strict=True):
        np.testing.assert_array_equal(first, second)


def test_a_path_notes_all_points_on_its_way(shiny: Any, monkeypatch: Any) -> None:
    cache = shiny.load(Records.empty())
    shiny._look_from(1)
    all_the_way = shiny.view.missed_in_pixels(cache, 1).missed
    monkeypatch.setattr(shiny.view.limits, "depth", dr.opaque(mi.UInt32, 0))
    # What the camera sees is the same; behind the gloss there is more.
    assert all_the_way > 1.02 * shiny.view.missed_in_pixels(cache, 1).missed > 1000


def test_a_path_that_asks_several_times_is_one_hit_one_miss_or_left(shiny: Any) -> None:
    for selected in ((), (1, 2, 3)):
        found = shiny.first_pass(1, selected)
        assert found.hits + found.misses + found.left == found.rays
        assert min(found.hits, found.misses) > 0
        assert (found.left > 0) == (len(selected) > 0)
        assert found.misses <= len(found.records)
        # The rule of the threshold ended it, not the limit for views that cannot be filled.
        assert found.hits >= shiny._settings.threshold * found.misses
        assert found.rays < 4 * 48 * 48


@pytest.fixture
def faintest(monkeypatch: Any) -> None:
    """The faintest answer is enough for an audit, as for a frame; else it asks for a little more."""
    monkeypatch.setattr("steadylight.renderers.mitsuba.renderer.ANSWERED", 1e-37)


def audited_and_missed(made: Any) -> tuple[Missed, int]:
    """What the last audit finds lacking in a cache of few records, and how many points the frame then misses."""
    few = made.first_pass(1).records.take(np.arange(0, 200, 5))
    audit = made.audit([1], made.load(few), last=True)
    return audit, made.shade(1, made.load(few)).missed


@pytest.mark.usefixtures("faintest")
@pytest.mark.parametrize("name", [each if each in EACH_TIME else slow(each) for each in CONTENT])
def test_the_last_audit_finds_as_many_points_as_the_frame_would_miss(name: str) -> None:
    audit, missed = audited_and_missed(renderer(described(CONTENT[name]), spp=16, bounces=1))
    assert audit.looked_up == 48 * 48 * 16
    assert 100 < audit.missed == missed


def test_a_frame_that_misses_all_the_same_is_lit_by_records_further_away(shiny: Any) -> None:
    few = shiny.first_pass(1).records.take(np.arange(0, 200, 5))
    found, gaps, filled = (
        shiny.shade(1, shiny.load(few)),
        shiny._shader.shade(shiny.load(few), shiny._shade_seed(1)),
        shiny._shader.shade(shiny.load(few).with_fallback(), shiny._shade_seed(1)),
    )
    assert found.missed == gaps.missed > 0
    np.testing.assert_array_equal(found.image, filled.image)
    assert found.image.mean() > 1.02 * gaps.image.mean()


def test_after_the_last_audit_and_its_filling_a_frame_misses_nothing(shiny: Any) -> None:
    records = shiny.first_pass(1).records
    for last in (False, True):
        found = shiny.audit([1, 2], shiny.load(records), last=last)
        assert found.missed > 0
        records = shiny.fill([found.points], records, 1 + last)
    cache = shiny.load(records)
    assert [shiny.shade(frame, cache).missed for frame in (1, 2)] == [0, 0]


@pytest.mark.usefixtures("faintest")
def test_passes_of_an_image_are_audited_with_the_samples_that_light_them(
    shiny: Any, monkeypatch: Any
) -> None:
    monkeypatch.setattr("steadylight.renderers.mitsuba.image.pixels.SPP_AT_ONCE", 4)
    audit, missed = audited_and_missed(shiny)
    assert audit.looked_up == 48 * 48 * 16
    assert 100 < audit.missed == missed


@pytest.mark.usefixtures("faintest")
def test_bands_of_an_image_are_audited_with_the_samples_that_light_them(shiny: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("steadylight.renderers.mitsuba.image.pixels.SAMPLES_AT_ONCE", 48 * 16 * 10)
    audit, missed = audited_and_missed(shiny)
    assert audit.looked_up == 48 * 48 * 16
    assert 100 < audit.missed == missed
