"""Light that goes straight through panes: as without them, times their transmittance, and counted once."""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, paint, place, renderer, room
from window_scenes import CLEAR, OUTSIDE, SUN, TINT, TINTED, reflectance, transmittance, window

from steadylight.cache.merge import merge_caches
from steadylight.renderers.mitsuba.light import panes as module
from steadylight.renderers.mitsuba.light.panes import Panes
from steadylight.renderers.mitsuba.scene import build_scene
from variants import slow

SOLID = {"type": "dielectric"}
HALF_OPEN = {"type": "mask", "opacity": 0.3, "bsdf": {"type": "twosided", "bsdf": paint(1, 1, 1)}}


@cache
def frames(kind: str, *panes: str, bounces: int = 0, **settings: Any) -> np.ndarray:
    """Two frames of different seeds through a window with these panes, lit from outside; (2, 48, 48, 3)."""
    bsdfs = {"clear": CLEAR, "tinted": TINTED, "solid": SOLID}
    content = window(*(bsdfs[pane] for pane in panes)) | {"light": OUTSIDE[kind]}
    both = (renderer(described(content), spp=16, bounces=bounces, seed=seed, **settings) for seed in (0, 1))
    return np.array([made.shade(1, None).image for made in both])


def brightness(images: np.ndarray) -> np.ndarray:
    return np.asarray(images.mean(axis=(0, 1, 2)))


def noise(images: np.ndarray) -> float:
    return float(((images[0] - images[1]) / brightness(images)).std())


COSINE = SUN[0] / np.linalg.norm(SUN)


@pytest.mark.parametrize("panes", [1, 2])
def test_sun_through_glass_is_that_of_the_open_window_times_fresnel(panes: int) -> None:
    glazed, open_ = frames("directional", *("clear",) * panes), frames("directional")
    np.testing.assert_allclose(
        brightness(glazed), transmittance(COSINE, panes) * brightness(open_), rtol=2e-3
    )
    assert noise(glazed) < 1.2 * noise(open_)


@pytest.mark.parametrize(
    ("kind", "bounces"),
    [("directional", 0), slow("sunsky", 0), ("area", 0), slow("sunsky", 2), slow("area", 2)],
)
def test_light_through_tinted_panes_is_that_of_the_open_window_times_the_tint(
    kind: str, bounces: int
) -> None:
    tinted, open_ = frames(kind, "tinted", bounces=bounces), frames(kind, bounces=bounces)
    np.testing.assert_allclose(brightness(tinted), np.multiply(TINT, brightness(open_)), rtol=0.01)
    assert noise(tinted) < 1.2 * noise(open_)


def test_path_traced_frames_show_the_sun_through_glass() -> None:
    glazed, open_ = (
        renderer(described(window(*panes) | {"light": OUTSIDE["directional"]}), spp=16, bounces=0).path(1)
        for panes in ((CLEAR,), ())
    )
    expected = transmittance(COSINE) * brightness(open_.image[None])
    np.testing.assert_allclose(brightness(glazed.image[None]), expected, rtol=5e-3)


@pytest.mark.slow
def test_indirect_light_of_a_sun_through_glass_is_less_by_as_much() -> None:
    # But for the few per cent that the pane reflects back into the room.
    glazed, open_ = frames("directional", "clear", bounces=2), frames("directional", bounces=2)
    np.testing.assert_allclose(brightness(glazed), transmittance(COSINE) * brightness(open_), rtol=0.01)
    assert noise(glazed) < 1.2 * noise(open_)


@pytest.mark.parametrize("bounces", [0, slow(2)])
def test_sun_through_solid_glass_is_less_by_what_both_faces_reflect_if_so_chosen(bounces: int) -> None:
    glazed = frames("directional", "solid", bounces=bounces, panes="straight")
    open_ = frames("directional", bounces=bounces)
    expected = (1 - reflectance(COSINE)) ** 2 * brightness(open_)
    np.testing.assert_allclose(brightness(glazed), expected, rtol=0.01)
    assert noise(glazed) < 1.2 * noise(open_)
    assert (brightness(frames("directional", "solid")) == 0).all()  # bent light finds no sun of one direction


def seen_lamp(*between: dict[str, Any]) -> np.ndarray:
    """Direct light of a lamp with sheets between it and the room; what the camera sees of them is left out."""
    sheets = {
        f"sheet{number}": {"type": "rectangle", "to_world": place((1, 0.9, 1), (0, 0.8, 2.9)), "bsdf": bsdf}
        for number, bsdf in enumerate(between)
    }
    made = renderer(described(room() | {"lamp": lamp()} | sheets), spp=64, bounces=0)
    image = made.shade(1, None).image
    return np.asarray(image[24:].mean(axis=(0, 1)))  # the floor, and the lower half of the ball


@pytest.mark.parametrize(
    ("sheet", "passes"),
    [
        ({"type": "mask", "opacity": 0.3, "bsdf": paint(0, 0, 0)}, 0.7),
        ({"type": "null"}, 1.0),
        ({"type": "blendbsdf", "weight": 0.25, "first": {"type": "null"}, "second": paint(0, 0, 0)}, 0.75),
        ({"type": "mask", "opacity": 0.5, "bsdf": TINTED}, tuple(0.5 + 0.5 * t for t in TINT)),
    ],
    ids=["mask", "null", "mixture", "mask over glass"],
)
def test_direct_light_through_a_sheet_is_less_by_what_the_sheet_takes(sheet: Any, passes: Any) -> None:
    # 9 cm below a lamp of 1.4 m: most of this light is found by rays of the BSDF as well as by emitter samples.
    np.testing.assert_allclose(seen_lamp(sheet), np.multiply(passes, seen_lamp()), rtol=0.01)


GLOW, ALBEDO = 0.5, 0.4


def furnace(*things: dict[str, Any], **settings: Any) -> np.ndarray:
    """A closed room that glows, seen over what its radiance must be; (12, 12, 3)."""
    box = {
        "type": "cube",
        "flip_normals": True,
        "to_world": place((3, 7, 3)),
        "bsdf": paint(*[ALBEDO] * 3),
        "emitter": {"type": "area", "radiance": GLOW},
    }
    content = {"box": box} | {f"thing{number}": thing for number, thing in enumerate(things)}
    made = renderer(described(content), width=12, height=12, spp=64, **{"bounces": 12} | settings)
    return np.asarray(made.shade(1, None).image * (1 - ALBEDO) / GLOW)


@pytest.mark.parametrize("bounces", [slow(12), "auto"])
def test_a_furnace_divided_by_panes_that_take_no_light_stays_as_bright_as_it_is(bounces: Any) -> None:
    panes = [
        {"type": "rectangle", "to_world": place((3, 3, 1), (0, y, 0), degrees=90), "bsdf": bsdf}
        for y, bsdf in ((-1, CLEAR), (0, HALF_OPEN))
    ]
    image = furnace(*panes, bounces=bounces)
    assert image.mean() == pytest.approx(1, abs=3e-3)
    np.testing.assert_allclose(image, 1, atol=0.06)


@pytest.mark.slow
def test_a_furnace_with_solid_glass_stays_as_bright_as_it_is_if_light_goes_straight() -> None:
    plate = {"type": "cube", "to_world": place((2.9, 2.9, 0.05), (0, -1, 0), degrees=90), "bsdf": SOLID}
    ball = {"type": "sphere", "center": [0, 2, 1], "radius": 1.2, "bsdf": SOLID}
    image = furnace(plate, ball, panes="straight")
    assert image.mean() == pytest.approx(1, abs=5e-3)
    np.testing.assert_allclose(image, 1, atol=0.06)


def test_light_through_more_panes_than_are_followed_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_PANES", 3)
    content = {
        f"pane{number}": {
            "type": "rectangle",
            "to_world": place((9, 9, 1), (0, 0, 1 + number)),
            "bsdf": TINTED,
        }
        for number in range(5)
    }
    lit = {
        "type": "rectangle",
        "to_world": place((9, 9, 1), (0, 0, 9)),
        "emitter": OUTSIDE["area"]["emitter"],
    }
    scene = build_scene(described(content | {"lit": lit}))
    panes = Panes(scene)
    si = dr.zeros(mi.SurfaceInteraction3f, 6)
    si.p = mi.Point3f(0, 0, mi.Float([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]))
    si.n, si.t = mi.Normal3f(0, 0, 1), mi.Float(1)
    passed = np.array([0, 0, 3, 2, 1, 0])  # of five, four and so on
    expected = np.where(passed[:, None] > 0, np.array(TINT) ** passed[:, None], 0)
    expected[-1] = 1
    between = panes.between(si, mi.Point3f(0, 0, 8), mi.Bool(True))
    np.testing.assert_allclose(np.array(between).T, expected, rtol=1e-5)
    # Rays that look for emitters end at the pane beyond, or on what shines.
    ray = mi.Ray3f(si.p, mi.Vector3f(0, 0, 1))
    first = scene.ray_intersect(ray)
    beyond = panes.beyond(first, ray.d, panes.transmission(first, mi.Bool(True)), mi.Bool(True))
    shines = np.array(beyond.si.emitter(scene) != mi.EmitterPtr(None))
    np.testing.assert_array_equal(shines, [False, False, True, True, True, True])
    np.testing.assert_allclose(np.array(beyond.distance)[2:], [6.5, 5.5, 4.5, 3.5], rtol=1e-3)


def test_a_shining_surface_is_no_pane() -> None:
    glass = {"type": "rectangle", "bsdf": CLEAR}
    content = {
        "glass": glass,
        "lit": glass | {"to_world": place(at=(0, 0, 1)), "emitter": OUTSIDE["area"]["emitter"]},
    }
    scene = build_scene(described(content))
    rays = mi.Ray3f(mi.Point3f(0, 0, mi.Float([-1, 0.5, 2])), mi.Vector3f(0, 0, 1))
    si = scene.ray_intersect(rays)
    through = np.array(Panes(scene).transmission(si, mi.Bool(True)))
    np.testing.assert_allclose(through[0], [transmittance(1), 0, 0], rtol=1e-5)


def test_a_record_on_a_sill_does_not_shrink_before_the_pane() -> None:
    def radius(*panes: dict[str, Any]) -> float:
        made = renderer(described(window(*panes) | {"light": OUTSIDE["sunsky"]}), bounces=1, seed=1)
        records = made.first_pass(1).records
        near = (np.abs(records.position[:, 0] + 2) < 0.3) & (np.abs(records.position[:, 1]) < 1)
        assert near.sum() > 3
        return float(np.median(records.radius[near]))

    assert radius(CLEAR) > 0.8 * radius()


def test_a_film_of_a_glazed_room_asks_the_cache_for_nothing_that_it_lacks() -> None:
    content = (
        window(CLEAR, CLEAR)
        | {"light": OUTSIDE["sunsky"]}
        | {
            "screen": {
                "type": "rectangle",
                "to_world": place((1, 1, 1), (0.5, 0, 1), degrees=80),
                "bsdf": HALF_OPEN,
            }
        }
    )
    made = renderer(described(content), spp=16, bounces=2)
    records = merge_caches([made.first_pass(frame).records for frame in (1, 3)])
    for number in range(3):
        found = made.audit((1, 2, 3), made.load(records), last=True)
        if not found.missed:
            break
        records = made.fill([found.points], records, number)
    assert found.missed == 0
    loaded = made.load(records)
    for frame in (1, 2, 3):
        shaded = made.shade(frame, loaded)
        assert (shaded.missed, shaded.new_records) == (0, 0)
