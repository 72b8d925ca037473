"""Meshes whose normals are interpolated over flat walls, as those of files without normals are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from reference_gather import polygon_irradiance
from small_scenes import described, lamp, paint, place, plain_lighting, renderer

from steadylight.cache.lookup import height_over, look_up, step_between
from steadylight.camera import CameraPath
from steadylight.camera.path import Keyframe
from steadylight.metrics.still import errors_against
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.scene import build_scene

REFLECTANCE, ARRIVING = 0.7, 2.0
LEANING = np.array([0.5, 0, np.sqrt(0.75)])
"""A normal of the floor, 30 degrees off the vertical."""

INSIDE = CameraPath(
    (
        Keyframe(0.0, (1.5, -1.5, 1.5), (-1.5, 1.2, 1.1), fov=75),
        Keyframe(1.0, (1.6, -1.0, 1.5), (-1.5, 1.2, 1.1), fov=75),
    )
)


def box(low: tuple[float, ...], high: tuple[float, ...], albedo: float, *, smooth: bool) -> dict[str, Any]:
    """A box of eight corners; `smooth` as Mitsuba reads a file without normals: means of the faces around a corner."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, 8).T
    squares = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    faces = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    mesh = {"type": "triangles", "vertices": corners, "faces": faces}
    if smooth:
        outwards = np.sign(corners - corners.mean(axis=0)) / np.sqrt(3)
        mesh["normals"] = outwards
    return mesh | {"bsdf": {"type": "twosided", "bsdf": paint(*[albedo] * 3)}}


def closed_room(*, smooth: bool) -> Any:
    """A closed room with a box in it, lit from under its ceiling."""
    content = {
        "room": box((-2, -2, 0), (2, 2, 3), 0.6, smooth=smooth),
        "block": box((-1.2, 0.2, 0), (-0.4, 1, 0.9), 0.4, smooth=smooth),
        "lamp": lamp(),
    }
    return dataclasses.replace(described(content), camera=INSIDE)


def test_a_room_of_eight_corners_takes_few_records_and_looks_as_path_traced() -> None:
    made = renderer(closed_room(smooth=True), bounces=2, quality="normal", spp=16, coverage="off")
    records = made.first_pass(1).records
    flat = renderer(closed_room(smooth=False), bounces=2, quality="normal", spp=16, coverage="off")
    assert len(records) < 2 * len(flat.first_pass(1).records)
    image = made.shade(1, made.load(records).with_fallback()).image
    paths = (renderer(closed_room(smooth=True), bounces=2, spp=512, seed=seed) for seed in (1, 2))
    errors = errors_against(image, *(each.path(1).image for each in paths))
    # When rays met their own wall, half of the records around a point lay in front of it or behind it, and what turns
    # away from the viewer was lit as if flat, there were nearly ten times as many records, and this was 1.5 %.
    assert errors.rel_rmse < 0.01
    assert abs(errors.rel_bias) < 0.002


def gathered(content: dict[str, Any], **more: Any) -> Any:
    """400 records on a floor around the origin, under the closed form's conditions, facing `LEANING`."""
    position, normal = np.zeros((400, 3), np.float32), np.tile(np.float32(LEANING), (400, 1))
    least, most = (np.full(400, each, np.float32) for each in (1e-4, more.pop("largest", 10.0)))
    quality = RecordQuality(polar_strata=15, azimuth_strata=40, refinement_paths=(900,), **more)
    gather = Gather(quality, 1, GatherContext(plain_lighting(build_scene(described(content)))))
    return gather_records(gather, Places(position, normal, Bounds(least, most)), 1)


def patch(at: tuple[float, float, float], half: float, *, down: bool) -> tuple[dict[str, Any], np.ndarray]:
    """A square patch, lit evenly by parallel light on its front, and its corners."""
    turned = place((half, half, 1), at, degrees=180 if down else 0)
    corners = (turned @ [[-1, 1, 1, -1], [-1, -1, 1, 1], [0] * 4, [1] * 4])[:3].T
    content = {
        "patch": {"type": "rectangle", "to_world": turned, "bsdf": paint(*[REFLECTANCE] * 3)},
        "sun": {
            "type": "directional",
            "direction": [0, 0, 1 if down else -1],
            "irradiance": {"type": "rgb", "value": [ARRIVING] * 3},
        },
    }
    return content, corners


def floor(half: float) -> dict[str, Any]:
    """A black square around the origin."""
    black = {"type": "twosided", "bsdf": paint(0, 0, 0)}
    return {"floor": {"type": "rectangle", "to_world": place((half, half, 1)), "bsdf": black}}


def test_gradients_are_along_the_surface_and_not_along_the_plane_of_the_hemisphere() -> None:
    content, corners = patch((0.5, 0.2, 2), 0.8, down=True)
    records = gathered(content | floor(0.01), largest=1e-3)  # hardly any of the parallel light is lost

    def seen(x: float, y: float) -> float:
        form = polygon_irradiance(corners, np.array([x, y, 0.0]), LEANING)
        return REFLECTANCE * ARRIVING / np.pi * float(form)

    np.testing.assert_allclose(records.surface, np.tile([0, 0, 1], (400, 1)), atol=1e-6)
    np.testing.assert_allclose(records.irradiance.mean(axis=(0, 1)), seen(0, 0), rtol=0.01)
    gradient = records.translation.mean(axis=(0, 1))[0]
    step = 1e-3
    along = [seen(step, 0) - seen(-step, 0), seen(0, step) - seen(0, -step)]
    np.testing.assert_allclose(gradient[:2], np.array(along) / (2 * step), rtol=0.1, atol=0.003)
    assert abs(gradient[2]) < 1e-6


def test_directions_below_the_surface_see_what_is_there_and_do_not_shorten_the_radius() -> None:
    # The floor is a sheet, and a tenth of the hemisphere is under it, where a patch shines.
    content, corners = patch((0.7, 0, -0.25), 0.2, down=False)
    records = gathered(content | floor(0.3))
    expected = REFLECTANCE * ARRIVING / np.pi * abs(float(polygon_irradiance(corners, np.zeros(3), LEANING)))
    np.testing.assert_allclose(records.irradiance.mean(axis=(0, 1)), expected, rtol=0.05)
    # Nothing above the floor is near.
    np.testing.assert_allclose(records.radius, 10.0)


def test_a_wall_is_flat_though_its_normals_lean() -> None:
    offset = np.array([[0.3, 0.1, 0], [-0.3, 0, 0], [0.1, 0, 0.02]])
    flat, ahead = np.array([0, 0, 1.0]), np.array([0.6, 0, 0.8])
    np.testing.assert_allclose(height_over(offset, LEANING, flat), [0, 0, 0.02], atol=1e-12)
    np.testing.assert_allclose(step_between(offset, LEANING, flat, ahead), [0, 0, 0.02], atol=1e-12)


def test_a_round_surface_is_smooth_though_its_triangles_are_flat() -> None:
    turn = np.radians(20)
    first, second = np.array([0, 0, 1.0]), np.array([np.sin(turn), 0, np.cos(turn)])
    facet = np.array([np.sin(-0.1), 0, np.cos(-0.1)])
    assert step_between(second - first, first, facet, second) == pytest.approx(0, abs=1e-12)


def test_a_record_on_a_leaning_wall_answers_on_both_sides_of_itself() -> None:
    content, _ = patch((0, 0, 2), 1.5, down=True)
    record = gathered(content | floor(0.3)).take(np.array([0]))
    record = dataclasses.replace(record, radius=np.float32([0.5]), headroom=np.float32([np.inf]))
    beside = np.float32([[0.2, 0, 0], [-0.2, 0, 0], [0, 0.2, 0]])
    weight = look_up(beside, np.tile(np.float32(LEANING), (3, 1)), record).weight
    np.testing.assert_allclose(weight, (1 - 0.16) ** 2, rtol=1e-3)
