"""A cache in parts: found by looking along the animation, and read without a trace of what else is loaded."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, paint, place, random_records, renderer, room

from steadylight.cache.merge import merge_caches
from steadylight.cache.octree import Cube
from steadylight.cache.partition import Partition, merge_part, smooth_part
from steadylight.cache.records import Records
from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.light.emitters import NO_ROW
from steadylight.renderers.mitsuba.records.lookup import Part, PartedCache
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.renderers.mitsuba.survey import points_of, survey
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

CUBE = Cube((-4.0, -4.0, -4.0), 9.0)
MIRROR = {"type": "conductor", "material": "none"}
WALK = CameraPath(
    (
        Keyframe(0.0, (0, -5.5, 1.7), (0, 0, 1.4), fov=45),
        Keyframe(0.25, (0.4, -5.2, 1.8), (0.1, 0, 1.3), fov=45),
        Keyframe(0.375, (0, 14, 1.7), (0, 9, 0), fov=45),
    )
)
FRAMES = (1, 2, 3, 4)
"""Three look into a room, the last at the yard behind its back wall."""


def scene() -> SceneDescription:
    yard = {"type": "rectangle", "to_world": place((1.8, 3, 1), (0, 9, 0)), "bsdf": paint(0.5, 0.5, 0.5)}
    content = room() | {"lamp": lamp(), "yard": yard, "sky": {"type": "constant", "radiance": 0.3}}
    return SceneDescription("test", content | posts(-0.9, 6.6, 26), WALK)


def posts(x: float, y: float, deep: int = 10) -> dict[str, Any]:
    """Ten beside each other and `deep` behind each other, 0.2 m apart, from a corner on."""
    return {
        f"post{i}_{j}": {
            "type": "cube",
            "to_world": place((0.02, 0.02, 0.1), (x + 0.2 * i, y + 0.2 * j, 0.1)),
            "bsdf": paint(0.5, 0.5, 0.5),
        }
        for i in range(10)
        for j in range(deep)
    }


def settings(parts: int) -> RenderSettings:
    return RenderSettings.checked(
        frames=FRAMES, width=32, height=32, spp=4, quality="draft", cache_parts=parts
    )


def surveyed(description: SceneDescription, parts: int) -> Partition:
    poses = description.camera.frame_poses(FRAMES, 8.0)
    return survey(description, [[pose] for pose in poses], settings(parts))


@pytest.fixture(scope="module")
def film() -> tuple[Renderer, Partition, dict[str, Records]]:
    """A renderer of a film whose cache is in eight parts, and these, smoothed."""
    description = scene()
    partition = surveyed(description, 8)
    poses = dict(zip(FRAMES, description.camera.frame_poses(FRAMES, 8.0), strict=True))
    made = Renderer(description, poses, settings(8), partition)
    gathered = [made.first_pass(frame).records for frame in FRAMES]
    merged = [merge_part(gathered, partition, part) for part in range(8)]
    smoothed = {}
    for part in range(8):
        others = [merged[other] for other in partition.around([part]) if other != part]
        smoothed[f"smoothed_{part}"] = smooth_part(merged[part], others, partition.radius)
    return made, partition, smoothed


def test_the_survey_divides_what_is_seen_and_bounds_the_radius(film: Any) -> None:
    _, partition, smoothed = film
    assert partition.count == 8
    assert len(partition.windows) == 4
    assert all(0 < len(seen) < 8 for seen in partition.windows)
    records = Records.concatenate(*smoothed.values())
    assert float(records.radius.max()) <= partition.radius * 1.0001
    assert all(map(len, smoothed.values()))
    low = np.array(partition.cube.origin)
    assert ((records.position > low) & (records.position < low + partition.cube.size)).all()
    assert surveyed(scene(), 8) == partition


def test_a_frame_has_the_same_bytes_whatever_parts_are_loaded_beside_its_own(film: Any) -> None:
    made, _, smoothed = film
    own = sorted(smoothed)[:3]
    alone = made.load({name: smoothed[name] for name in own})
    expected = made.shade(2, alone)
    grown = made.load({own[2]: smoothed[own[2]]})
    made.shade(1, grown)  # other lights are known before
    grown = grown.with_parts(smoothed)
    grown.show(own)
    found = made.shade(2, grown)
    np.testing.assert_array_equal(found.image, expected.image)
    assert found.missed == expected.missed > 0
    grown.show(sorted(smoothed))
    everything = made.shade(2, grown)
    assert everything.missed < expected.missed
    assert np.abs(everything.image - expected.image).max() > 0


def test_a_frame_shaded_from_the_parts_it_sees_has_the_bytes_of_one_shaded_from_all(film: Any) -> None:
    made, partition, smoothed = film
    every = made.load(smoothed)
    for frame, seen in zip(FRAMES, partition.windows, strict=True):
        assert len(seen) < partition.count
        named = made.load({f"smoothed_{part}": smoothed[f"smoothed_{part}"] for part in seen})
        np.testing.assert_array_equal(made.shade(frame, named).image, made.shade(frame, every).image)


def on_device(position: np.ndarray, normal: np.ndarray) -> tuple[Any, Any, Any]:
    rows = (np.ascontiguousarray(array.T) for array in (position, normal))
    return mi.Point3f(next(rows)), mi.Normal3f(next(rows)), mi.Bool(True)


def test_only_parts_that_are_shown_answer_and_bit_for_bit_as_if_they_were_alone() -> None:
    records = random_records(1, 600, radius=(0.05, 0.4))
    side = records.position[:, 0] < 0.4
    parts = {"a": records.take(side), "b": records.take(~side)}
    asking = on_device(records.position + np.float32(0.01), records.normal)
    both = PartedCache({name: Part(part) for name, part in parts.items()}, cube=CUBE).with_fallback()
    for name, part in parts.items():
        alone = PartedCache({name: Part(part)}, cube=CUBE).with_fallback().look_up(*asking)
        both.show([name])
        found = both.look_up(*asking)
        for field in ("irradiance", "weight"):
            np.testing.assert_array_equal(np.array(getattr(found, field)), np.array(getattr(alone, field)))
        first = 0 if name == "a" else len(parts["a"])
        rows = np.array(alone.row)
        np.testing.assert_array_equal(
            np.array(found.row), np.where(rows == NO_ROW, rows, rows + np.uint32(first))
        )
    both.show(["a", "b"])
    whole = PartedCache({"": Part(merge_by_name(parts))}, cube=CUBE).with_fallback().look_up(*asking)
    np.testing.assert_array_equal(np.array(both.look_up(*asking).irradiance), np.array(whole.irradiance))


def merge_by_name(parts: dict[str, Records]) -> Records:
    return Records.concatenate(*(parts[name] for name in sorted(parts)))


def test_emitter_shares_of_a_part_do_not_depend_on_others_and_are_asked_for_once(film: Any) -> None:
    made, _, smoothed = film
    names = sorted(smoothed)
    alone = made.load({names[1]: smoothed[names[1]]})
    made.view.lighting(alone)
    every = made.load(smoothed)
    made.view.lighting(every)
    for known, also_known in zip(alone.parts[0].emitters, every.parts[1].emitters, strict=True):
        np.testing.assert_array_equal(known, also_known)
    grown = alone.with_parts({names[0]: smoothed[names[0]]})
    assert grown.parts[1].emitters is alone.parts[0].emitters
    assert grown.parts[0].emitters is None


@pytest.mark.parametrize("mirror", [True, False])
def test_the_survey_follows_mirrors(mirror: bool) -> None:
    behind = {"type": "rectangle", "to_world": place((3, 3, 1), (0, -8, 1.5), degrees=-90)}
    bsdf = MIRROR if mirror else paint(0.5, 0.5, 0.5)
    glass = {"type": "rectangle", "to_world": place((2, 1.5, 1), (0, 1.9, 1.5), degrees=90), "bsdf": bsdf}
    made = renderer(described(room(shape="panel") | {"behind": behind, "glass": glass}))
    points = points_of(made.view, [made._poses[1]], 1).position
    assert (points[:, 1] < -7.9).any() == mirror
    assert (np.abs(points[:, 2]) < 1e-3).any()  # the floor, seen directly


def test_parts_are_small_where_things_stand_close() -> None:
    # Most of what is seen is bare floor, most records stand between the posts.
    floor = {"type": "rectangle", "to_world": place((4, 1, 1), (0, 0, 0)), "bsdf": paint(0.5, 0.5, 0.5)}
    ((axis, bare),) = surveyed(described({"floor": floor}), 2).splits
    assert (axis, bare) == (0, pytest.approx(0, abs=0.4))
    ((axis, plane),) = surveyed(described({"floor": floor, **posts(2.1, -0.9)}), 2).splits
    assert axis == 0
    assert plane > 0.7


def test_a_film_that_sees_nothing_has_parts_all_the_same() -> None:
    away = described({"far": {"type": "sphere", "center": [0, -100, 0], "radius": 1.0}})
    partition = surveyed(away, 3)
    assert partition.count == 3
    assert partition.windows == ((),) * 4
    assert len(merge_caches([])) == len(merge_part([], partition, 2)) == 0
