from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, paint, place, plain_lighting, room

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.caustics import CausticMap
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.indirect import Secondary
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.photon_grid import PhotonGrid
from steadylight.renderers.mitsuba.records.photons import Photons, trace_photons
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.renderers.mitsuba.upload import download

GLASS = {"type": "dielectric", "int_ior": 1.5}
FROSTED = {"type": "roughdielectric", "int_ior": 1.5, "alpha": 0.3}
MIRROR = {"type": "conductor", "material": "none"}
VARNISH = {"type": "roughplastic", "int_ior": 4.0, "alpha": 0.3}
QUALITY = RecordQuality(polar_strata=20, azimuth_strata=80, refinement_paths=(25_600,))


def scene_of(**content: Any) -> mi.Scene:
    return build_scene(described(content))


def photons_of(scene: mi.Scene, seed: int = 1) -> Photons:
    photons = trace_photons(plain_lighting(scene), seed, 1 << 18)
    assert photons is not None
    return photons


def floor_points(count: int, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the floor within `extent` of the middle, and normals."""
    position = np.zeros((count, 3), np.float32)
    position[:, :2] = np.random.default_rng(0).uniform(-extent, extent, (count, 2))
    return position, np.tile(np.float32([0, 0, 1]), (count, 1))


def all_over_the_room(scene: mi.Scene, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the floor and the walls of `small_scenes.room`, and normals towards its middle."""
    numbers = np.random.default_rng(0).random((2, count), np.float32)
    towards = mi.warp.square_to_uniform_sphere(mi.Point2f(numbers))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, -1.5, 2), towards))
    rows = np.array(si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Diffuse))
    normal = mi.Normal3f(si.n * dr.select(dr.dot(si.n, towards) > 0, mi.Float(-1), mi.Float(1)))
    floor, walls = floor_points(count, 2.0), (download(si.p)[rows], download(normal)[rows])
    return np.concatenate([floor[0], walls[0]]), np.concatenate([floor[1], walls[1]])


def lit_by_photons(scene: mi.Scene, position: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """(P, 3) irradiance."""
    radii = np.full(len(position), radius, np.float32)
    return CausticMap(scene, photons_of(scene)).at(position, normal, radii).irradiance


# ---- known answers -----------------------------------------------------------------------


def test_a_mirror_lights_the_floor_as_a_second_lamp_behind_it_would() -> None:
    upright = place((6, 6, 1), (2, 0, 0), about=(0, 1, 0), degrees=-90)
    scene = scene_of(
        floor={"type": "rectangle", "to_world": place((2, 2, 1)), "bsdf": paint(0.5, 0.5, 0.5)},
        mirror={"type": "rectangle", "to_world": upright, "bsdf": MIRROR},
        lamp={"type": "point", "position": [0, 0, 1], "intensity": {"type": "rgb", "value": [3.0, 2.0, 1.0]}},
    )
    position, normal = floor_points(1000, 1.0)
    towards = np.array([4, 0, 1]) - position  # the image of the lamp
    expected = towards[:, 2] / np.linalg.norm(towards, axis=1) ** 3
    found = lit_by_photons(scene, position, normal, 0.4)
    # 200 photons or more in each disc, of which some begin at the same point: the mean of all discs is within 2 %.
    np.testing.assert_allclose(found.mean(axis=0), expected.mean() * np.array([3, 2, 1]), rtol=0.03)
    assert np.std(found[:, 0] / (3 * expected)) < 0.2


def sun_behind_glass(**content: Any) -> tuple[mi.Scene, float]:
    """A floor under a solid pane and the sun above it, and the irradiance of what lies flat, W/m²."""
    face = (0.5 / 2.5) ** 2  # reflectance of each, at right angles
    through = (1 - face) / (1 + face)  # with all reflections between them
    scene = scene_of(
        floor={"type": "rectangle", "to_world": place((2, 2, 1)), "bsdf": paint(0.5, 0.5, 0.5)},
        plate={"type": "cube", "to_world": place((1.5, 1.5, 0.01), (0, 0, 1)), "bsdf": GLASS},
        sun={"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 10.0}},
        **content,
    )
    return scene, 10 * through


def test_the_sun_shines_through_a_solid_window_as_fresnel_has_it() -> None:
    scene, expected = sun_behind_glass()
    position, normal = floor_points(500, 1.0)
    found = lit_by_photons(scene, position, normal, 0.2)
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=0.02)


def test_photons_neither_shine_through_a_wall_nor_lack_where_the_floor_goes_on_behind_it() -> None:
    scene, expected = sun_behind_glass(
        wall={
            "type": "cube",
            "to_world": place((0.005, 2, 0.25), (0, 0, 0.25)),
            "bsdf": paint(0.5, 0.5, 0.5),
        },
        roof={"type": "rectangle", "to_world": place((1, 2, 1), (-1, 0, 0.5)), "bsdf": paint(0.5, 0.5, 0.5)},
    )
    position, normal = floor_points(500, 1.0)
    position[:, 0] = np.random.default_rng(1).uniform(0.01, 0.2, 500)
    found = lit_by_photons(scene, position, normal, 0.2)
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=0.05)
    beside = position[:, 0] < 0.03  # nearly half of its disc is hidden
    np.testing.assert_allclose(found[beside].mean(axis=0), expected, rtol=0.1)
    dark = lit_by_photons(scene, position * np.float32([-1, 1, 1]), normal, 0.2)
    assert dark.mean() < 0.005 * expected
    assert dark.max() < 0.05 * expected  # of the cell that the wall divides


def test_a_ledge_much_narrower_than_the_discs_of_its_records_is_as_bright_as_a_floor() -> None:
    ledge = {"type": "cube", "to_world": place((0.01, 1, 0.1), (0, 0, 0.4)), "bsdf": paint(0.5, 0.5, 0.5)}
    scene, expected = sun_behind_glass(ledge=ledge)
    position, normal = floor_points(500, 0.8)
    position[:, 0] = np.random.default_rng(1).uniform(-0.009, 0.009, 500)
    position[:, 2] = 0.5
    found = lit_by_photons(scene, position, normal, 0.2)
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=0.05)


def test_photons_on_a_rug_do_not_light_the_floor_beneath() -> None:
    rug = {"type": "cube", "to_world": place((0.5, 0.5, 0.001), (0, 0, 0.004)), "bsdf": paint(0.5, 0.5, 0.5)}
    scene, expected = sun_behind_glass(rug=rug)
    position, normal = floor_points(200, 0.4)
    assert not lit_by_photons(scene, position, normal, 0.2).any()
    on_top = lit_by_photons(scene, position + np.float32([0, 0, 0.005]), normal, 0.2)
    np.testing.assert_allclose(on_top.mean(axis=0), expected, rtol=0.02)


@pytest.mark.parametrize("bsdf", [GLASS, FROSTED], ids=["glass", "frosted"])
def test_a_bulb_in_a_glass_ball_sends_out_nearly_all_of_its_light(bsdf: dict[str, Any]) -> None:
    radiance, bulb, wall = 2.0, 0.2, 5.0
    scene = scene_of(
        bulb={
            "type": "sphere",
            "radius": bulb,
            "bsdf": paint(0, 0, 0),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        },
        ball={"type": "sphere", "radius": 1.0, "bsdf": bsdf},
        wall={"type": "sphere", "radius": wall, "flip_normals": True, "bsdf": paint(0.5, 0.5, 0.5)},
    )
    photons = photons_of(scene)
    far = np.linalg.norm(photons.position, axis=1) > wall / 2
    sent = np.pi * radiance * 4 * np.pi * bulb**2
    # The rest returns to the bulb, which is black: 4 % for clear glass by Fresnel's equations, seen at right angles.
    assert 0.93 * sent < photons.power[far, 1].sum() < 0.999 * sent
    normal = np.random.default_rng(0).standard_normal((300, 3))
    normal /= -np.linalg.norm(normal, axis=1, keepdims=True)
    found = CausticMap(scene, photons).at(
        np.float32(-wall * normal), np.float32(normal), np.full(300, 1.0, np.float32)
    )
    expected = photons.power[far].sum(axis=0) / (4 * np.pi * wall**2)
    np.testing.assert_allclose(found.irradiance.mean(axis=0), expected, rtol=0.02)


@pytest.mark.parametrize("bsdf", [GLASS, FROSTED, MIRROR, {"type": "plastic"}], ids=lambda bsdf: bsdf["type"])
def test_paths_and_photons_together_bring_the_light_of_paths_alone(bsdf: dict[str, Any]) -> None:
    scene = scene_of(**room(bsdf), lamp=lamp())
    position, normal = floor_points(60, 1.5)
    bounds = Bounds(np.full(60, 0.2, np.float32), np.full(60, 0.2, np.float32))
    lighting = plain_lighting(scene)

    def gathered(secondary: Secondary, caustics: CausticMap | None) -> np.ndarray:
        context = GatherContext(lighting, secondary, caustics)
        records = gather_records(Gather(QUALITY, None, context), Places(position, normal, bounds), 1)
        return records.irradiance[:, 0].mean(axis=0)

    alone = gathered(Secondary.black(), None)
    without = gathered(Secondary.black(photons=True), None)
    assert np.all(without < 0.98 * alone)  # or the room has no caustics worth a test
    # At these points, the photons of one seed have 2 % of noise.
    maps = (CausticMap(scene, photons_of(scene, seed)) for seed in range(1, 5))
    together = np.mean([gathered(Secondary.black(photons=True), each) for each in maps], axis=0)
    np.testing.assert_allclose(together, alone, rtol=0.015)


@pytest.mark.parametrize("bsdf", [paint(0.5, 0.5, 0.5), VARNISH], ids=lambda bsdf: bsdf["type"])
def test_surfaces_without_a_record_of_their_own_are_lit_by_the_photons_on_them(bsdf: dict[str, Any]) -> None:
    content = room(FROSTED)
    for name in ("floor", "back", "ceiling"):
        content[name]["bsdf"] = bsdf
    scene = scene_of(**content, lamp=lamp())
    lighting, photons = plain_lighting(scene), CausticMap(scene, photons_of(scene))

    def gathered(
        quality: RecordQuality, context: GatherContext, at: tuple[np.ndarray, np.ndarray]
    ) -> Records:
        radius = np.full(len(at[0]), 0.25, np.float32)
        return gather_records(Gather(quality, None, context), Places(*at, Bounds(radius, radius)), 1)

    few = dataclasses.replace(QUALITY, polar_strata=4, azimuth_strata=16, refinement_paths=(64,))
    known = gathered(few, GatherContext(lighting, Secondary.black()), all_over_the_room(scene, 1000))
    cache = DeviceCache(known)

    def light(grid: PhotonGrid | None) -> np.ndarray:
        secondary = Secondary(cache, least=np.inf, photons=grid)  # which covers no surface
        context = GatherContext(lighting, secondary, None if grid is None else photons)
        return gathered(QUALITY, context, floor_points(200, 1.5)).irradiance[:, 0].mean(axis=0)

    alone = light(None)
    told = light(photons.grid)
    assert np.all(light(PhotonGrid(None)) < 0.99 * told)  # paths do not find what photons tell
    # What the gloss of these surfaces reflects of the ball is 2 % of the light: paths must find it.
    np.testing.assert_allclose(told, alone, rtol=0.012)


# ---- where surfaces end ------------------------------------------------------------------


def test_the_corner_of_a_plate_is_as_bright_as_its_middle() -> None:
    scene = scene_of(plate={"type": "rectangle", "bsdf": paint(0.5, 0.5, 0.5)})  # 2 m x 2 m
    number = 200_000
    position = np.zeros((number, 3), np.float32)
    position[:, :2] = np.random.default_rng(1).uniform(-1, 1, (number, 2))
    normal = np.tile(np.float32([0, 0, 1]), (number, 1))
    photons = Photons(position, normal, np.full((number, 3), 4 / number, np.float32))  # 1 W/m²
    places = np.float32([[0, 0, 0], [0.99, 0, 0], [0.99, 0.99, 0], [0.9, -0.95, 0]])
    found = CausticMap(scene, photons).at(places, normal[:4], np.full(4, 0.2, np.float32))
    # Sixteen rays tell the part of the disc that is there.
    np.testing.assert_allclose(found.irradiance, 1, rtol=0.2)
    np.testing.assert_allclose(found.irradiance[0], 1, rtol=0.05)


def test_where_photons_are_dense_a_few_of_them_stand_for_all() -> None:
    scene = scene_of(plate={"type": "rectangle", "bsdf": paint(0.5, 0.5, 0.5)})
    number = 400_000
    position = np.zeros((number, 3), np.float32)
    position[:, :2] = np.random.default_rng(1).uniform(-1, 1, (number, 2))
    normal = np.tile(np.float32([0, 0, 1]), (number, 1))
    photons = CausticMap(scene, Photons(position, normal, np.full((number, 3), 4 / number, np.float32)))
    places = np.zeros((3, 3), np.float32)
    radius = np.float32([0.02, 0.4, 1.6])  # of which half or more: 64, 12,600 and 201,000 photons
    found = photons.at(places, normal[:3], radius)
    np.testing.assert_allclose(found.irradiance[1:], 1, rtol=0.2)
    assert np.all(found.variance[1:] > 1 / 4096)
    np.testing.assert_allclose(found.halves.mean(axis=1), found.irradiance, rtol=1e-5)


def test_photons_do_not_light_the_far_side_of_a_sheet() -> None:
    scene = scene_of(plate={"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": paint(0.5, 0.5, 0.5)}})
    position, normal = floor_points(5000, 1.0)
    photons = Photons(position, normal, np.ones((5000, 3), np.float32))
    found = CausticMap(scene, photons).at(position[:3], -normal[:3], np.full(3, 0.2, np.float32))
    assert not found.irradiance.any()


# ---- which surfaces cast -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("bsdf", "casts"),
    [
        (GLASS, True),
        (FROSTED, True),
        (MIRROR, True),
        ({"type": "roughconductor"}, True),
        ({"type": "thindielectric"}, True),
        ({"type": "plastic"}, True),
        ({"type": "twosided", "bsdf": MIRROR}, True),
        ({"type": "roughplastic"}, False),
        ({"type": "null"}, False),
        ({"type": "mask", "opacity": 0.5, "bsdf": paint(0.5, 0.5, 0.5)}, False),
        (paint(0.5, 0.5, 0.5), False),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_surfaces_cast_caustics_by_delta_lobes_or_without_a_diffuse_lobe(bsdf: Any, casts: bool) -> None:
    lighting = plain_lighting(scene_of(thing={"type": "sphere", "bsdf": bsdf}))
    assert (len(lighting.bsdfs.casters.number) == 1) == casts


def test_what_a_shape_group_casts_is_left_to_paths() -> None:
    group = {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": {"type": "ref", "id": "glass"}}}
    scene = scene_of(
        glass={**GLASS, "id": "glass"},
        group=group,
        one={"type": "instance", "group": {"type": "ref", "id": "group"}},
        other={"type": "sphere", "center": [3, 0, 0], "bsdf": {"type": "ref", "id": "glass"}},
    )
    casters = plain_lighting(scene).bsdfs.casters
    assert len(casters.number) == 0
    assert casters.table is None


def test_a_scene_without_lit_casters_has_no_photons() -> None:
    dark = {**lamp(), "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.0}}}
    assert trace_photons(plain_lighting(scene_of(**room(GLASS), lamp=dark)), 1, 1 << 12) is None
    assert trace_photons(plain_lighting(scene_of(**room(), lamp=lamp())), 1, 1 << 12) is None


# ---- bytes -------------------------------------------------------------------------------


def test_photons_and_their_light_are_the_same_bytes_each_time() -> None:
    scene = scene_of(**room(GLASS), lamp=lamp())
    first, again = (trace_photons(plain_lighting(scene), 7, 1 << 14) for _ in range(2))
    assert first is not None
    assert again is not None
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    position, normal = floor_points(30, 1.5)
    radius = np.full(30, 0.3, np.float32)
    whole = CausticMap(scene, first).at(position, normal, radius)
    parts = [CausticMap(scene, again).at(position[k : k + 10], normal[:10], radius[:10]) for k in (0, 10, 20)]
    for name in whole._fields:
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(getattr(whole, name), joined)


def test_halves_of_the_photons_make_the_difference_of_the_halves_of_a_record() -> None:
    scene = scene_of(**room(GLASS), lamp=lamp())
    photons = CausticMap(scene, photons_of(scene))
    position, normal = floor_points(20, 0.5)
    context = GatherContext(plain_lighting(scene), Secondary.black(photons=True))
    gather = Gather(dataclasses.replace(QUALITY, refinement_paths=(1600,)), None, context)
    bounds = Bounds(np.full(20, 0.2, np.float32), np.full(20, 0.2, np.float32))
    records = gather_records(gather, Places(position, normal, bounds), 1)
    light = photons.at(position, normal, records.radius)
    np.testing.assert_allclose(light.halves.mean(axis=1), light.irradiance, rtol=1e-5)
    whole = photons.added_to(records)
    first, second = whole.irradiance + whole.difference, whole.irradiance - whole.difference
    before, after = records.irradiance + records.difference, records.irradiance - records.difference
    np.testing.assert_allclose((first - before)[:, 0], light.halves[:, 0], atol=1e-5)
    np.testing.assert_allclose((second - after)[:, 0], light.halves[:, 1], atol=1e-5)
    np.testing.assert_allclose((whole.guide - records.guide)[:, 0], light.halves.mean(axis=2), atol=1e-5)
