from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from reference_gather import polygon_irradiance
from small_scenes import CAMERA, LAMP, described, lamp, paint, place, plain_lighting, room

from steadylight.cache.lookup import look_up
from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.grid import GridEmitterSampling
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records import reuse
from steadylight.renderers.mitsuba.records.filling import Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import (
    Gather,
    Places,
    gather_records,
    refinement_step,
)
from steadylight.renderers.mitsuba.records.indirect import MOST_VERTICES, Secondary, indirect_radiance
from steadylight.renderers.mitsuba.records.lookup import DeviceAnswer
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.sampling import samples_of
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes import furnace

if TYPE_CHECKING:
    from steadylight.cache.records import Records

QUALITY = RecordQuality(polar_strata=15, azimuth_strata=40, refinement_paths=(900,))
REFLECTANCE = 0.7
ARRIVING = 2.0  # W/m² on the ceiling


def gathered(
    scene: Any, position: Any, normal: Any, *, bounces: int = 1, seed: int = 1, **more: Any
) -> Records:
    position, normal = (np.ascontiguousarray(a, np.float32) for a in np.broadcast_arrays(position, normal))
    smallest = np.full(len(position), more.pop("smallest", 1e-3), np.float32)
    bounds = Bounds(smallest, np.full(len(position), more.pop("largest", 10.0), np.float32))
    faint = more.pop("faint", 0.0)
    quality = dataclasses.replace(QUALITY, **more)
    gather = Gather(quality, bounces, GatherContext(plain_lighting(scene)), faint)
    return gather_records(gather, Places(position, normal, bounds), seed)


# ---- known answers -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def furnace_scene() -> Any:
    return build_scene(furnace.describe())


@pytest.mark.parametrize(
    ("bounces", "radii"),
    [(1, "split-sphere"), (2, "split-sphere"), (3, "split-sphere"), (2, "occlusion-hessian")],
)
def test_irradiance_in_the_furnace_is_the_geometric_series(
    furnace_scene: Any, bounces: int, radii: str
) -> None:
    rng = np.random.default_rng(bounces)
    position = np.zeros((200, 3))
    position[:, :2] = rng.uniform(0.05, 1.95, (200, 2))
    records = gathered(furnace_scene, position, [0, 0, 1], bounces=bounces, radii=radii)
    # What the first hit emits itself is direct light: the series starts with what it reflects.
    expected = np.pi * furnace.EMISSION * sum(furnace.ALBEDO ** (k + 1) for k in range(bounces))
    # 1500 stratified paths each: a record is within 5 %, their mean within 0.3 %.
    np.testing.assert_allclose(records.irradiance.mean(axis=(0, 1)), expected, rtol=3e-3)
    np.testing.assert_allclose(records.irradiance, expected, rtol=0.05)


CORNERS = np.array([[-1.5, -1, 2], [1.5, -1, 2], [1.5, 1, 2], [-1.5, 1, 2]], float)


@pytest.fixture(scope="module")
def ceiling() -> Any:
    """A reflecting rectangle 2 m up that parallel light from below lights evenly: its radiance is known."""
    return build_scene(
        described(
            {
                "ceiling": {
                    "type": "rectangle",
                    "to_world": place((1.5, 1, 1), (0, 0, 2), degrees=180),
                    "bsdf": paint(*[REFLECTANCE] * 3),
                },
                "sun": {
                    "type": "directional",
                    "direction": [0, 0, 1],
                    "irradiance": {"type": "rgb", "value": [ARRIVING] * 3},
                },
            }
        )
    )


def exact(position: Any, normal: Any = (0, 0, 1)) -> float:
    radiance = REFLECTANCE * ARRIVING / np.pi
    return radiance * float(polygon_irradiance(CORNERS, np.array(position, float), np.array(normal, float)))


def test_the_brightest_path_of_a_half_brings_its_share(ceiling: Any) -> None:
    records = gathered(ceiling, np.zeros((50, 3)), [0, 0, 1])
    # All paths to the ceiling see the same light; of some strata, each half has one.
    expected = np.full((50, 2), REFLECTANCE * ARRIVING / QUALITY.strata)
    np.testing.assert_allclose(records.brightest[:, 0], expected, rtol=1e-3)


def appearing(edge: float, half: float) -> Any:
    """Gradient of the light of a patch of which a sheet, 2 cm over the floor, hides half; over the true gradient.

    It is along x, at the origin.

    Args:
        edge: x at which the sheet begins, metres.
        half: of the patch's size along x, metres.
    """
    height, up = 0.02, 2.0
    middle = edge * up / height
    rays = np.array([1, 0, 0.2]) / np.hypot(1, 0.2)
    content = {
        "sheet": {
            "type": "rectangle",
            "to_world": place((2, 4, 1), (edge + 2, 0, height)),
            "bsdf": paint(0, 0, 0),
        },
        "patch": {
            "type": "rectangle",
            "to_world": place((half, 0.2, 1), (middle, 0, up), degrees=180),
            "bsdf": paint(*[REFLECTANCE] * 3),
        },
        "sun": {
            "type": "directional",
            "direction": rays,
            "irradiance": {"type": "rgb", "value": [ARRIVING] * 3},
        },
    }
    radiance = REFLECTANCE * ARRIVING * rays[2] / np.pi

    def seen(x: float) -> float:
        end = x + (edge - x) * up / height
        sides = [(middle - half, -0.2), (end, -0.2), (end, 0.2), (middle - half, 0.2)]
        corners = np.array([[*side, up] for side in sides])
        return radiance * float(polygon_irradiance(corners, np.array([x, 0, 0]), np.array([0, 0, 1.0])))

    records = gathered(build_scene(described(content)), np.zeros((400, 3)), [0, 0, 1], largest=1e-3)
    # Paths start a little off the floor.
    np.testing.assert_allclose(records.irradiance.mean(axis=(0, 1)), seen(0), rtol=0.05)
    gradient = records.translation.mean(axis=(0, 1))[0]
    np.testing.assert_allclose(gradient[1:] / gradient[0], 0, atol=0.05)
    # Halves of the paths see it, too, but for strata of which they have a single path.
    guides = records.guide_translation.mean(axis=(0, 1))
    np.testing.assert_allclose(guides[:, 0], gradient[0], rtol=0.25)
    return gradient[0] * 2 * STEP / (seen(STEP) - seen(-STEP))


@pytest.mark.parametrize(("half", "off"), [(0.3, 0.5), (0.9, 0.4)])
def test_what_a_near_edge_hides_appears_at_the_speed_of_the_edge(half: float, off: float) -> None:
    # The smaller patch is no larger than a stratum. With strata that move as a whole, a third of the gradient is found.
    # The more samples a stratum at the edge gets, the nearer is its nearest: of the larger patch, a third too much.
    found = [appearing(edge, half) for edge in (0.02, 0.025, 0.03)]
    assert np.mean(found) == pytest.approx(1, abs=off)


def test_the_closed_form_of_the_tests_is_the_form_factor_of_a_rectangle() -> None:
    # Below the centre of a rectangle: four times the textbook formula for a corner (a = 0.75, b = 0.5).
    a, b = 0.75, 0.5
    p, q = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    factor = 4 * (a / p * np.arctan(b / p) + b / q * np.arctan(a / q)) / (2 * np.pi)
    assert polygon_irradiance(CORNERS, np.zeros(3), np.array([0, 0, 1.0])) == pytest.approx(np.pi * factor)


POINTS = [((0, 0, 0), (0, 0, 1)), ((1.2, 0.6, 0.2), (0, 0, 1)), ((-0.5, 0.3, 0.5), (0.3, 0.2, 0.93))]


STEP = 1e-4  # metres or radians, of differences of the closed form


def under_the_ceiling(ceiling: Any, position: Any, normal: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """A point, its normal, and many records of it."""
    p, n = np.array(position, float), np.array(normal, float) / np.linalg.norm(normal)
    return p, n, gathered(ceiling, np.repeat(p[None], 400, 0), n)


def tangents(normal: np.ndarray) -> np.ndarray:
    """(2, 3) axes of the tangent plane."""
    return np.linalg.svd(normal[None])[2][1:]


@pytest.mark.parametrize(("position", "normal"), POINTS, ids=["centre", "aside", "leaning"])
def test_light_off_a_lit_ceiling_has_the_value_of_its_form_factor_and_turns_with_it(
    ceiling: Any, position: Any, normal: Any
) -> None:
    p, n, records = under_the_ceiling(ceiling, position, normal)
    np.testing.assert_allclose(records.irradiance.mean(axis=(0, 1)), exact(p, n), rtol=5e-3)
    step, scale = STEP, exact(p, n)
    for axis in tangents(n):
        turned = [np.cos(step) * n + sign * np.sin(step) * np.cross(axis, n) for sign in (1, -1)]
        turning = (exact(p, turned[0]) - exact(p, turned[1])) / (2 * step)
        found = records.rotation[:, 0, 0] @ axis
        assert found.mean() == pytest.approx(turning, abs=0.01 * scale)


@pytest.mark.parametrize(("position", "normal"), POINTS, ids=["centre", "aside", "leaning"])
def test_light_off_a_lit_ceiling_moves_as_its_form_factor_does(
    ceiling: Any, position: Any, normal: Any
) -> None:
    p, n, records = under_the_ceiling(ceiling, position, normal)
    for axis in tangents(n):
        moved = (exact(p + STEP * axis, n) - exact(p - STEP * axis, n)) / (2 * STEP)
        found = records.translation[:, 0, 0] @ axis
        # Strata are coarse beside the ceiling's outline, which alone makes the gradient: 3 % of E / 1 m.
        assert found.mean() == pytest.approx(moved, abs=0.03 * exact(p, n))


def test_without_bounces_records_are_black(ceiling: Any) -> None:
    records = gathered(ceiling, np.zeros((5, 3)), [0, 0, 1], bounces=0)
    for name in ("irradiance", "translation", "rotation"):
        np.testing.assert_array_equal(getattr(records, name), 0)
    assert np.isfinite(records.radius).all()


def test_in_the_void_records_are_black_and_of_the_largest_radius(ceiling: Any) -> None:
    records = gathered(ceiling, np.zeros((3, 3)), [0, 0, -1], largest=4.0)
    np.testing.assert_array_equal(records.irradiance, 0)
    np.testing.assert_array_equal(records.radius, 4)


def test_what_the_first_hit_emits_is_left_to_direct_light() -> None:
    scene = build_scene(described({"lamp": lamp()}))  # a black lamp: all its light is direct
    records = gathered(scene, [[0, 0.8, 1]] * 4, [0, 0, 1], bounces=3)
    np.testing.assert_array_equal(records.irradiance, 0)


def test_an_even_sky_is_in_the_record_and_gives_pi_times_its_radiance() -> None:
    environment = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.5]}}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": environment}))
    records = gathered(scene, np.zeros((4, 3)), [0, 0, 1])
    np.testing.assert_allclose(records.irradiance, np.pi * np.float32([[[0.2, 0.3, 0.5]]] * 4), rtol=1e-4)
    np.testing.assert_allclose(records.translation, 0, atol=1e-6)


def test_light_from_a_small_patch_overhead_has_the_rotational_curvature_of_a_cosine() -> None:
    plate = {
        "type": "rectangle",
        "to_world": place((0.4, 0.4, 1), (0, 0, 2), degrees=180),
        "bsdf": paint(0.5, 0.5, 0.5),
    }
    sun = {"type": "directional", "direction": [0, 0, 1], "irradiance": ARRIVING}
    records = gathered(build_scene(described({"plate": plate, "sun": sun})), np.zeros((4, 3)), [0, 0, 1])
    np.testing.assert_allclose(records.curvature, 1)


def test_an_even_sky_is_the_same_whichever_way_a_surface_turns() -> None:
    environment = {"type": "constant", "radiance": 1.0}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": environment}))
    records = gathered(scene, np.zeros((500, 3)), [0, 0, 1])
    np.testing.assert_allclose(records.curvature, 0, atol=1e-4)
    # Sums over whole circles vanish, but for single precision.
    np.testing.assert_allclose(records.rotation, 0, atol=1e-3)


def test_the_bright_part_of_the_sky_is_left_to_direct_light() -> None:
    image = np.ones((32, 64, 3), np.float32)
    image[2:5, 10:13] = 500.0
    environment = {"type": "envmap", "data": image, "to_world": place(degrees=90)}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": environment}))
    records = gathered(scene, np.zeros((20, 3)), [0, 0, 1])
    # The sun is no brighter in the record than the sky about it.
    np.testing.assert_allclose(records.irradiance, np.pi, rtol=1e-3)


@pytest.mark.parametrize("height", [1e-3, 2e-4, 5e-5])
def test_where_a_thing_stands_on_a_floor_records_do_not_see_what_is_under_the_floor(height: float) -> None:
    floor = {"type": "rectangle", "to_world": place((4, 4, 1), (0, 0, 0)), "bsdf": paint(0, 0, 0)}
    scene = build_scene(described({"floor": floor, "sky": {"type": "constant", "radiance": 1.0}}))
    lean = np.sqrt(0.5)
    records = gathered(scene, [[2.5, 0, height]] * 2, [lean, 0, -lean])
    # The floor is black, and above it is that part of an even sky.
    np.testing.assert_allclose(records.irradiance, np.pi * (1 - lean) / 2, rtol=0.02)


def test_records_on_wide_ground_see_the_sky_however_rounding_moves_them() -> None:
    ground = {"type": "rectangle", "to_world": place((1000, 1000, 1), (0, 0, 0)), "bsdf": paint(0, 0, 0)}
    scene = build_scene(described({"ground": ground, "sky": {"type": "constant", "radiance": 1.0}}))
    rounded = np.linspace(-2e-4, 2e-4, 9)
    position = np.stack([np.full(9, 5.0), np.zeros(9), rounded], axis=1)
    np.testing.assert_allclose(gathered(scene, position, [0, 0, 1]).irradiance, np.pi, rtol=1e-3)


def test_a_record_knows_the_free_height_above_it() -> None:
    wall = {"type": "rectangle", "to_world": place((3, 3, 1), (0, 2, 0), degrees=90)}
    panel = {"type": "rectangle", "to_world": place((0.5, 0.5, 1), (0, 0, 0.02))}
    scene = build_scene(described({"wall": wall, "panel": panel, "sky": {"type": "constant"}}))
    position = [[0.1, 0.2, 0], [0, 0.501, 0], [0, 0.55, 0], [0, 1.95, 0]]
    under, at_the_edge, beside, in_the_corner = gathered(scene, position, [0, 0, 1]).headroom
    assert under == pytest.approx(0.02, rel=0.01)  # rays start a little off the surface
    assert at_the_edge == pytest.approx(0.02, rel=0.01)
    assert beside > 1  # it sees the panel, but not overhead
    assert in_the_corner >= 0.1  # twice its distance from the wall


def test_a_record_beside_a_partition_answers_on_its_own_side_alone() -> None:
    # Beside things that high, no radius is shorter than half of the smallest, 15 cm: three times the distance.
    partition = {"type": "rectangle", "to_world": place((4, 4, 1), (0, 0, 0), degrees=90)}
    scene = build_scene(described({"partition": partition, "sky": {"type": "constant"}}))
    record = gathered(scene, [[0, -0.05, 0]], [0, 0, 1], smallest=0.3)
    np.testing.assert_allclose(record.barriers[:, 0], [[0, 20, 0]], atol=0.6)
    y = np.float32([-0.15, -0.1, 0.01, 0.03, 0.09])
    p = np.stack([0 * y, y, 0 * y], axis=1)
    answers = look_up(p, np.repeat(np.float32([[0, 0, 1]]), len(p), 0), record).weight > 0
    np.testing.assert_array_equal(answers, [True, True, False, False, False])


def test_what_is_covered_has_a_smaller_radius_than_the_smallest_elsewhere() -> None:
    panel = {"type": "rectangle", "to_world": place((0.5, 0.5, 1), (0, 0, 0.02))}
    scene = build_scene(described({"panel": panel, "sky": {"type": "constant"}}))
    position = [[0, 0, 0], [0, 0.52, 0]]
    for smallest, radius in ((0.03, 0.02), (0.1, 0.05)):
        covered, beside = gathered(scene, position, [0, 0, 1], smallest=smallest).radius
        assert covered == pytest.approx(radius, rel=0.01)
        assert beside >= 0.999 * smallest


def test_the_halves_of_a_record_measure_the_same_and_know_nothing_of_each_other() -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    records = gathered(
        scene,
        np.repeat([[0.5, -1.5, 0.01]], 3000, 0),
        [0, 0, 1],
        polar_strata=6,
        azimuth_strata=16,
        refinement_paths=(225,),
    )
    E, half = (array[:, 0].mean(axis=1) for array in (records.irradiance, records.difference))
    spread = half.std() / np.sqrt(len(half))
    assert abs(half.mean()) < 3.5 * spread
    for own, other, guide in ((E + half, E - half, 0), (E - half, E + half, 1)):
        told = records.guide[:, 0, guide]
        assert np.corrcoef(own, told)[0, 1] > 0.3
        # Strata with one path are in both halves, but in no guide. What paths of one stratum see differs rather than
        # agrees, since they keep apart.
        assert np.corrcoef(other, told)[0, 1] < 3.5 / np.sqrt(len(half))
        assert told.mean() == pytest.approx(E.mean(), rel=0.05)
        estimated = np.sqrt(np.square(records.guide_error[:, 0, guide], dtype=np.float64).mean())
        assert estimated == pytest.approx(told.std(), rel=0.3)


def test_no_radius_passes_the_nearest_thing_above_a_record() -> None:
    # A small plate hardly changes the mean distance, but it is dark beneath.
    plate = {"type": "rectangle", "to_world": place((0.05, 0.05, 1), (0, 0, 0.3), degrees=180)}
    ceiling = {"type": "rectangle", "to_world": place((50, 50, 1), (0, 0, 20), degrees=180), "emitter": LAMP}
    scene = build_scene(described({"plate": plate, "ceiling": ceiling}))
    below, beside = gathered(scene, [[0, 0, 0], [30, 30, 0]], [0, 0, 1], bounces=1).radius
    assert below == pytest.approx(0.3, rel=0.03)
    assert beside > 1


def seen_along(scene: Any, ray: Any, bounces: int, seed: int) -> Any:
    """What arrives along rays, one sample each."""
    samples = samples_of(mi.UInt32(seed), dr.arange(mi.UInt32, dr.width(ray)), mi.UInt32(0))
    return indirect_radiance(plain_lighting(scene), samples, ray, mi.UInt32(bounces), None)[0]


def test_paths_bring_the_radiance_that_mitsubas_path_tracer_finds() -> None:
    # All kinds of hits: paint, glass, gloss, lamps of two kinds, and rays that leave the scene.
    content = room({"type": "dielectric"}) | {
        "lamp": lamp(),
        "mirror": {
            "type": "sphere",
            "center": [1.2, 0.8, 0.6],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "alpha": 0.2},
        },
        "bulb": {
            "type": "point",
            "position": [-1, -1, 2],
            "intensity": {"type": "rgb", "value": [1.0, 2, 3]},
        },
    }
    scene = build_scene(described(content))
    bounces, lanes = 3, 1 << 17
    # Its depth counts the emitter's end too; what the first hit emits is hidden from it as from us.
    path = mi.load_dict({"type": "path", "max_depth": bounces + 1, "rr_depth": 99, "hide_emitters": True})

    def estimates(seed: int, *, ours: bool) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, lanes)
        d = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ray = mi.Ray3f(mi.Point3f(0.5, -1.5, 0.01), d)
        if ours:
            L = seen_along(scene, ray, bounces, seed)
        else:
            L, _, _ = path.sample(scene, sampler, mi.RayDifferential3f(ray))
        return np.array(L).T.astype(np.float64)

    mine, theirs = estimates(1, ours=True), estimates(2, ours=False)
    error = np.sqrt((mine.var(axis=0) + theirs.var(axis=0)) / lanes)
    z = (mine.mean(axis=0) - theirs.mean(axis=0)) / error
    assert np.abs(z).max() < 4  # three channels: by chance once in 5000 runs, and seeds are fixed
    assert (error < 0.02 * theirs.mean(axis=0)).all()  # and the test could see 8 %


class EvenLight:
    """A cache that knows the same irradiance everywhere, by records of one radius."""

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def draw_in_sight(self, *query: Any) -> DeviceAnswer:  # as in `DeviceCache`
        del query
        return DeviceAnswer(mi.Color3f(1), mi.Float(1), mi.UInt32(0))

    def radius_of(self, row: Any) -> Any:
        del row
        return mi.Float(self.radius)

    def arrays(self) -> list[Any]:
        return []


@pytest.mark.parametrize(("radius", "surfaces"), [(0.9, 1), (1.1, 2), (3.9, 2)])
def test_the_secondary_cache_answers_a_radius_away_from_a_record_and_a_quarter_of_that_further_on(
    radius: float, surfaces: int
) -> None:
    # Two plates, 1 m apart: a path goes straight up and down between them until it is answered.
    plates = {
        "above": {"type": "rectangle", "to_world": place((5e3, 5e3, 1), (0, 0, 1), degrees=180)},
        "below": {"type": "rectangle", "to_world": place((5e3, 5e3, 1), (0, 0, 0))},
    }
    plates = {name: {**plate, "bsdf": paint(*[REFLECTANCE] * 3)} for name, plate in plates.items()}
    scene = build_scene(described(plates))
    samples = samples_of(mi.UInt32(1), dr.arange(mi.UInt32, 64), mi.UInt32(0))
    ray = mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, 64), 0, 0.001), mi.Vector3f(0, 0, 1))
    L, _ = indirect_radiance(
        plain_lighting(scene), samples, ray, mi.UInt32(MOST_VERTICES), Secondary(EvenLight(radius))
    )
    np.testing.assert_allclose(np.array(L), REFLECTANCE**surfaces / np.pi, rtol=1e-5)


def z_scores(irradiance: np.ndarray, expected: Any, error: Any = 0.0) -> np.ndarray:
    """Distance of the mean of many records from what it should be, in standard deviations of that mean."""
    values = irradiance.astype(np.float64)
    spread = values.var(axis=0) / len(values)
    z: np.ndarray = (values.mean(axis=0) - expected) / np.sqrt(spread + np.square(error))
    return z


PATCH = np.array([[0.55, 0.25, 2], [0.85, 0.25, 2], [0.85, 0.5, 2], [0.55, 0.5, 2]], float)


def patch_below_the_ceiling() -> dict[str, Any]:
    """A small reflecting rectangle 2 m up, at `PATCH`, that parallel light from below lights."""
    return {
        "patch": {
            "type": "rectangle",
            "to_world": place((0.15, 0.125, 1), (0.7, 0.375, 2), degrees=180),
            "bsdf": paint(*[REFLECTANCE] * 3),
        },
        "sun": {"type": "directional", "direction": [0, 0, 1], "irradiance": ARRIVING},
    }


def test_a_small_bright_patch_gives_its_form_factor_on_average_whatever_the_pilot_samples_saw() -> None:
    # The patch fills a part of a stratum: one pilot sample in two passes it, and the refinement samples are led astray.
    scene = build_scene(described(patch_below_the_ceiling()))
    expected = REFLECTANCE * ARRIVING / np.pi * polygon_irradiance(PATCH, np.zeros(3), np.array([0, 0, 1.0]))
    few = {
        "polar_strata": 6,
        "azimuth_strata": 12,
        "refinement_paths": (100, 144, 225),
        "standard_error": 0.1,
    }
    for smallest in (1e-6, 1.0):  # standing alone and crowded
        made = [
            gathered(scene, np.zeros((2000, 3)), [0, 0, 1], seed=seed, smallest=smallest, **few).irradiance
            for seed in range(4)
        ]
        found = np.concatenate(made)[:, 0, :1]
        assert 0.1 < found.std() / found.mean() < 2
        assert np.abs(z_scores(found, expected)).max() < 3.5
        assert found.std() / np.sqrt(len(found)) < 0.015 * expected  # the test could see 5 %


SLIT = np.array([(0.7, 0.3, 2), (0.8, 0.3, 2), (0.8, 0.5, 2), (0.7, 0.5, 2)])
"""Opening in a ceiling, a thousandth of the hemisphere over the origin: less than a stratum."""


def black_box_with_a_slit() -> dict[str, Any]:
    """A box, 6 m wide and 2 m high, that no light enters but of an even sky of radiance 1 through `SLIT`."""
    (left, near), (right, far) = SLIT[0, :2], SLIT[2, :2]
    pieces = {
        "left": ((-3, -3), (left, 3)),
        "right": ((right, -3), (3, 3)),
        "near": ((left, -3), (right, near)),
        "far": ((left, far), (right, 3)),
    }
    content: dict[str, Any] = {"floor": {"type": "rectangle", "to_world": place((3, 3, 1))}}
    for name, (low, high) in pieces.items():
        size, middle = (np.subtract(high, low) / 2), np.add(low, high) / 2
        matrix = place((size[0], size[1], 1), (middle[0], middle[1], 2), degrees=180)
        content[f"ceiling {name}"] = {"type": "rectangle", "to_world": matrix}
    for number in range(4):
        turn = place(about=(0, 0, 1), degrees=90 * number)
        content[f"wall {number}"] = {
            "type": "rectangle",
            "to_world": turn @ place((3, 1, 1), (0, 3, 1), degrees=90),
        }
    black = {"bsdf": {"type": "twosided", "bsdf": paint(0, 0, 0)}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1, 1, 1]}}
    return {name: shape | black for name, shape in content.items()} | {"sky": sky}


def test_the_sky_in_a_slit_that_pilot_samples_miss_is_measured_well() -> None:
    scene = build_scene(described(black_box_with_a_slit()))
    point, up, count = np.array([0.05, 0.05, 0], np.float32), np.array([0, 0, 1], np.float32), 400
    expected = polygon_irradiance(SLIT, point, up)
    assert expected < 2e-3 * np.pi
    # What guides emitter samples is measured nearby, not at the record itself; two more points span the grid.
    around = [(x, y, 0) for x in (0.02, 0.08) for y in (0.02, 0.05, 0.08)] + [(-3, -3, 0), (3, 3, 0)]
    sites = np.array(around, np.float32)
    emitters = GridEmitterSampling(scene, Environment(scene))
    emitters.measure_at(sites, np.tile(up, (len(sites), 1)), 1024)
    lighting = Lighting(scene, BSDFTraits(scene), Environment(scene), emitters, 2)
    bounds = Bounds(np.full(count, 1e-3, np.float32), np.full(count, 10.0, np.float32))
    places = Places(np.tile(point, (count, 1)), np.tile(up, (count, 1)), bounds)
    found = gather_records(Gather(QUALITY, 1, GatherContext(lighting)), places, 1).irradiance[:, 0, :1]
    assert np.abs(z_scores(found, expected)).max() < 3.5
    assert found.std() < 0.45 * expected  # 0.38; without emitter samples 0.61


def test_a_small_lit_patch_that_some_pilot_samples_find_is_measured_well_by_all_records() -> None:
    half, up, dim = 0.03, 1.99, 0.002
    content = {
        "ceiling": {
            "type": "rectangle",
            "to_world": place((1.5, 1, 1), (0, 0, 2), degrees=180),
            "bsdf": paint(*[dim] * 3),
        },
        "patch": {
            "type": "rectangle",
            "to_world": place((half, half, 1), (0.4, 0.1, up), degrees=180),
            "bsdf": paint(*[REFLECTANCE] * 3),
        },
        "sun": {
            "type": "directional",
            "direction": [0, 0, 1],
            "irradiance": {"type": "rgb", "value": [ARRIVING] * 3},
        },
    }
    rng = np.random.default_rng(3)
    position = np.zeros((400, 3), np.float32)
    position[:, :2] = rng.uniform(-0.3, 0.3, (400, 2))
    corners = np.array([[x, y, up] for x, y in [(-half, -half), (half, -half), (half, half), (-half, half)]])
    corners += [0.4, 0.1, 0]
    of_patch = [float(polygon_irradiance(corners, point, np.array([0, 0, 1.0]))) for point in position]
    of_ceiling = [exact(point) * dim / REFLECTANCE for point in position]
    expected = np.array(of_patch) * REFLECTANCE * ARRIVING / np.pi + of_ceiling
    # A thousandth of the hemisphere, a quarter of the light.
    assert np.mean(of_patch) < 1.2e-3 * np.pi
    assert np.mean(of_ceiling) < 0.8 * np.mean(expected)
    found = gathered(build_scene(described(content)), position, [0, 0, 1]).irradiance[:, 0, :1]
    ratio = found / expected[:, None]
    assert np.abs(z_scores(ratio, 1)).max() < 3.5
    assert ratio.std() < 0.1


def test_records_of_a_room_have_the_mean_of_paths_in_every_direction() -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    point, bounces, lanes = (0.5, -1.5, 0.01), 2, 1 << 17
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(9, lanes)
    ray = mi.Ray3f(mi.Point3f(*point), mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    L = seen_along(scene, ray, bounces, 9)
    plain = np.pi * np.array(L).T.astype(np.float64)
    few = {
        "polar_strata": 6,
        "azimuth_strata": 16,
        "refinement_paths": (100, 144, 225),
        "standard_error": 0.1,
    }
    places = np.repeat(np.array([point]), 2000, 0)
    found = gathered(scene, places, [0, 0, 1], bounces=bounces, **few).irradiance[:, 0]
    error = plain.std(axis=0) / np.sqrt(lanes)
    assert np.abs(z_scores(found, plain.mean(axis=0), error)).max() < 3.5
    assert (error < 0.01 * plain.mean(axis=0)).all()


def test_a_record_that_is_bright_by_chance_answers_as_far_as_one_that_is_dark() -> None:
    # Else a look-up, which weighs records by their radius, would find less light than they hold.
    dim = {
        "type": "rectangle",
        "to_world": place((3, 3, 1), (0, 0, 2.5), degrees=180),
        "bsdf": paint(*[0.05] * 3),
    }
    scene = build_scene(described(patch_below_the_ceiling() | {"ceiling": dim}))
    few = {"polar_strata": 5, "azimuth_strata": 20, "refinement_paths": (100,), "clamped": False}
    far = {"smallest": 1e-4, "largest": 1e3, "radii": "occlusion-hessian"}
    made = gathered(scene, np.zeros((6000, 3)), [0, 0, 1], **far, **few)
    E, area = made.irradiance.mean(axis=(1, 2), dtype=np.float64), made.radius.astype(np.float64) ** 2
    assert E.std() > 0.1 * E.mean()
    assert area.std() > 0.05 * area.mean()
    # By the same paths it was 0.9947; the error is 0.0002.
    assert area @ E / (area.sum() * E.mean()) == pytest.approx(1, abs=1e-3)


def test_records_take_paths_by_the_square_of_their_noise_and_fewer_in_a_crowd() -> None:
    quality = dataclasses.replace(QUALITY, refinement_paths=(625, 1225, 2500), standard_error=0.04)
    standard_error = np.array([0, 1, 1.3, 1.5, 2, 9, 1.5, 2])
    crowded = np.arange(8) >= 6
    chosen = np.take(quality.refinement_paths, refinement_step(standard_error, crowded, quality))
    # In order 0, 625, 1056, 1406, 2500, 50625; then half of 1406 and of 2500.
    np.testing.assert_array_equal(chosen, [625, 625, 1225, 1225, 2500, 2500, 625, 1225])
    one = dataclasses.replace(quality, refinement_paths=(900,))
    np.testing.assert_array_equal(refinement_step(standard_error, crowded, one), 0)


def test_a_record_has_less_noise_where_less_is_asked_for_and_no_more_paths_where_none_are_needed() -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    points = np.repeat(np.array([(0.5, -1.5, 0.01)]), 200, 0)
    few = {"polar_strata": 6, "azimuth_strata": 16, "bounces": 2}
    fixed = gathered(scene, points, [0, 0, 1], refinement_paths=(100,), **few)
    free = gathered(scene, points, [0, 0, 1], refinement_paths=(100, 400), standard_error=1e-3, **few)
    lax = gathered(scene, points, [0, 0, 1], refinement_paths=(100, 400), standard_error=10.0, **few)
    assert free.standard_error.mean() < 0.6 * fixed.standard_error.mean()
    np.testing.assert_array_equal(lax.irradiance, fixed.irradiance)


def test_light_that_is_faint_beside_the_rest_takes_no_more_paths_than_the_least() -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    points = np.repeat(np.array([(0.5, -1.5, 0.01)]), 200, 0)
    few = {"polar_strata": 6, "azimuth_strata": 16, "bounces": 2, "standard_error": 0.03}
    least = gathered(scene, points, [0, 0, 1], refinement_paths=(100,), **few)
    usual = gathered(scene, points, [0, 0, 1], refinement_paths=(100, 400), **few)
    brighter = 100 * float(usual.irradiance.mean())
    faint = gathered(scene, points, [0, 0, 1], refinement_paths=(100, 400), faint=brighter, **few)
    assert usual.standard_error.mean() < 0.6 * least.standard_error.mean()
    np.testing.assert_array_equal(faint.irradiance, least.irradiance)


def test_a_record_knows_its_own_noise() -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    few = {"polar_strata": 6, "azimuth_strata": 16, "refinement_paths": (225,)}
    for point in ((0.5, -1.5, 0.01), (-1.2, 0.5, 0.01)):
        records = gathered(scene, np.repeat(np.array([point]), 1000, 0), [0, 0, 1], bounces=2, **few)
        actual = records.irradiance.mean(axis=2).std()
        # Its paths are spread more evenly than the estimate believes, so that it may be too high, but not by much.
        estimated = np.sqrt(np.square(records.standard_error, dtype=np.float64).mean())
        assert 0.8 * actual < estimated < 1.6 * actual


# ---- radius ------------------------------------------------------------------------------


def test_the_radius_stays_within_its_bounds(furnace_scene: Any) -> None:
    position = np.zeros((100, 3))
    position[:, :2] = np.random.default_rng(3).uniform(0.01, 1.99, (100, 2))
    # What the Hessian asks for goes by the smallest radius, too.
    by_distance = {"radii": "split-sphere"}
    free = gathered(furnace_scene, position, [0, 0, 1], smallest=1e-6, largest=1e3, **by_distance)
    assert free.radius.min() < 0.08
    assert free.radius.max() > 0.12
    bound = gathered(furnace_scene, position, [0, 0, 1], smallest=0.08, largest=0.12, **by_distance)
    smallest = np.clip(bound.headroom, 0.04, 0.08)  # corners cover what is next to them
    np.testing.assert_allclose(bound.radius, np.clip(free.radius, smallest, 0.12), rtol=1e-6)
    # The lower bound is the stronger one: it keeps the number of records finite.
    both = gathered(furnace_scene, position, [0, 0, 1], smallest=0.5, largest=0.12)
    np.testing.assert_allclose(both.radius, np.clip(both.headroom, 0.25, 0.5), rtol=1e-6)


def test_radii_by_the_hessian_are_long_under_a_wide_ceiling_and_short_under_a_narrow_one() -> None:
    def panel(half: float, x: float) -> dict[str, Any]:
        to_world = place((half, half, 1), (x, 0, 2), degrees=180)
        return {"type": "rectangle", "to_world": to_world, "bsdf": paint(*[REFLECTANCE] * 3)}

    sun = {"type": "directional", "direction": [0, 0, 1], "irradiance": ARRIVING}
    scene = build_scene(described({"wide": panel(40, 0), "narrow": panel(1, 90), "sun": sun}))
    free = {"smallest": 1e-3, "largest": 1e3, "clamped": False}
    # Distances say the opposite: half of what lies over the second point is empty.
    for radii, wide_is_longer in (("split-sphere", False), ("occlusion-hessian", True)):
        wide, narrow = gathered(scene, [[0, 0, 0], [90, 0, 0]], [0, 0, 1], radii=radii, **free).radius
        assert (wide > 1.3 * narrow) == wide_is_longer
        assert (narrow > 1.3 * wide) != wide_is_longer


def test_gradients_are_flattened_where_the_radius_is_longer_than_wanted(furnace_scene: Any) -> None:
    position = np.zeros((50, 3))
    position[:, :2] = np.random.default_rng(4).uniform(0.01, 1.99, (50, 2))
    # What the Hessian asks for goes by the smallest radius, too.
    same = {"radii": "split-sphere"}
    free = gathered(furnace_scene, position, [0, 0, 1], smallest=1e-6, largest=1e3, **same)
    bound = gathered(furnace_scene, position, [0, 0, 1], smallest=10.0, largest=10.0, **same)
    shrink = free.radius / bound.radius
    np.testing.assert_allclose(bound.translation, free.translation * shrink[:, None, None, None], rtol=1e-4)
    np.testing.assert_array_equal(bound.rotation, free.rotation)


def test_a_gradient_changes_no_more_than_half_of_the_light_over_the_radius(ceiling: Any) -> None:
    # Beside the lit rectangle and close to its plane, most of its light goes within a few centimetres.
    free, bound = (
        gathered(
            ceiling, np.tile([1.9, 0, 1.9], (200, 1)), [0, 0, 1], clamped=False, smallest=each, largest=each
        )
        for each in (1e-3, 1.0)
    )
    change = np.linalg.norm(bound.translation, axis=3).sum(axis=(1, 2)) / bound.irradiance.sum(axis=(1, 2))
    assert np.all(np.linalg.norm(free.translation, axis=3) >= np.linalg.norm(bound.translation, axis=3))
    np.testing.assert_allclose(change, 0.5, rtol=1e-4)


def test_bounds_come_from_the_nearest_camera_of_the_whole_path() -> None:
    poses = CAMERA.frame_poses(range(1, 9), 8.0)
    diagonal, width = 10.0, 100
    bounds = RadiusBounds(poses, width, diagonal, QUALITY)
    position = np.array([[0, 0, 0], [0, -5.5, 1.7], [0, 4000, 0]], np.float32)
    at = bounds.at(position)
    distance = min(np.linalg.norm(pose.origin) for pose in poses)
    pixel = 2 * np.tan(np.radians(45) / 2) / width
    assert at.smallest[0] == pytest.approx(QUALITY.minimum_spacing * pixel * distance, rel=1e-5)
    assert at.smallest[1] == pytest.approx(1e-5 * diagonal)  # at the camera itself: a floor
    np.testing.assert_allclose(at.largest, QUALITY.maximum_spacing * diagonal, rtol=1e-6)
    assert at.smallest[2] == pytest.approx(at.largest[2])
    # A point may ask for less, but never for less than the smallest.
    anywhere = Points.anywhere(position, np.tile(np.float32([0, 0, 1]), (3, 1)))
    asked = bounds.of(anywhere._replace(longest=np.float32([0.2, 1e-6, np.inf])))
    np.testing.assert_array_equal(asked.smallest, at.smallest)
    np.testing.assert_array_equal(asked.largest, [np.float32(0.2), at.smallest[1], at.largest[2]])
    # A path that knows its length asks for the radius that follows from it.
    asked = bounds.of(anywhere._replace(smallest=np.float32([0.05, 0, 1e9])))
    np.testing.assert_array_equal(asked.smallest, [np.float32(0.05), at.smallest[1], at.largest[2]])
    backwards = RadiusBounds(poses[::-1], width, diagonal, QUALITY).at(position)
    np.testing.assert_array_equal(backwards.smallest, at.smallest)


def test_a_record_looks_at_bright_places_above_its_horizon_as_often_as_it_faces_them() -> None:
    each = reuse.CANDIDATES * reuse.SAMPLES
    cosine = np.zeros((3, each), np.float32)  # those of the last record all lie behind its wall
    cosine[0, [5, 90]] = 0.25, 0.75
    cosine[1] = 0.5
    kept = reuse._kept(cosine).reshape(3, reuse.SAMPLES)
    quarter = reuse.SAMPLES // 4
    assert kept[0].tolist() == [5] * quarter + [90] * 3 * quarter
    assert np.diff(kept[1]).tolist() == [reuse.CANDIDATES] * (reuse.SAMPLES - 1)
    assert (kept // each == np.arange(3)[:, None]).all()


# ---- bytes -------------------------------------------------------------------------------


def test_the_same_points_and_seed_give_the_same_bytes_on_any_number_of_threads(furnace_scene: Any) -> None:
    position = np.zeros((30, 3))
    position[:, :2] = np.random.default_rng(5).uniform(0.1, 1.9, (30, 2))

    def content(seed: int) -> bytes:
        records = gathered(furnace_scene, position, [0, 0, 1], bounces=2, seed=seed)
        return b"".join(array.tobytes() for array in dataclasses.astuple(records))

    threads = dr.thread_count()
    first = content(1)
    dr.set_thread_count(1)
    try:
        assert content(1) == first
    finally:
        dr.set_thread_count(threads)
    assert content(1) == first
    assert content(2) != first


def test_points_beyond_one_batch_are_gathered_in_the_next(
    furnace_scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    position = np.zeros((10, 3))
    position[:, 0] = position[:, 1] = np.linspace(0.2, 0.8, 10)
    module = "steadylight.renderers.mitsuba.records.gather"
    monkeypatch.setattr(
        f"{module}.looks_at_bright", Mock(return_value=None)
    )  # where others of the batch look
    whole = gathered(furnace_scene, position, [0, 0, 1])
    monkeypatch.setattr(f"{module}.PATHS_AT_ONCE", 4 * QUALITY.refinement_paths[-1])
    parts = gathered(furnace_scene, position, [0, 0, 1])
    # Random numbers go by the place, not by the batch.
    for name in parts.SHAPES:
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    assert (parts.irradiance[4:8] != parts.irradiance[:4]).any()
