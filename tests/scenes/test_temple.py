"""The temple is closed where it should be, finely enough modelled, and its cameras never touch a stone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from steadylight.scenes import temple, temple_rotation, temple_walk
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.modelling import areas

DESCRIBE = {"temple-walk": temple_walk.describe, "temple-rotation": temple_rotation.describe}


@cache
def description(name: str) -> SceneDescription:
    return DESCRIBE[name]()


def meshes(scene: SceneDescription) -> dict[str, dict]:
    return {
        key: entry
        for key, entry in scene.content.items()
        if isinstance(entry, dict) and entry.get("type") == "triangles"
    }


@cache
def everything() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of the whole temple with its ground."""
    parts = list(meshes(description("temple-walk")).values())
    starts = np.cumsum([0] + [len(part["vertices"]) for part in parts])
    vertices = np.concatenate([part["vertices"] for part in parts]).astype(float)
    faces = [part["faces"].astype(int) + start for part, start in zip(parts, starts, strict=False)]
    return vertices, np.concatenate(faces)


@cache
def surface_samples() -> cKDTree:
    """Points on all triangles, closer to each other than the clearance that is tested."""
    vertices, faces = everything()
    keep = np.abs(vertices[faces] - np.array([0.0, 30.0, 0.0])).max(axis=(1, 2)) < 60
    mesh = trimesh.Trimesh(vertices, faces[keep], process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 600_000, seed=1)
    return cKDTree(np.concatenate([points, vertices]))


def blocked(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) whether a ray from each origin meets a stone: all rays against all triangles that may matter."""
    vertices, faces = everything()
    corners = vertices[faces]
    hit = np.zeros(len(origins), dtype=bool)
    for k, (o, d) in enumerate(zip(origins, directions, strict=True)):
        # Möller & Trumbore (1997), all triangles at once
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        p = np.cross(d, edge2)
        scale = (edge1 * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / scale
            s = o - corners[:, 0]
            u = (s * p).sum(axis=1) * inverse
            q = np.cross(s, edge1)
            v = (q @ d) * inverse
            t = (edge2 * q).sum(axis=1) * inverse
        hit[k] = bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)).any())
    return hit


def upward(count: int) -> np.ndarray:
    """(count, 3) directions above the horizon, at least 10 degrees, so that the dunes do not count."""
    rng = np.random.default_rng(5)
    z = rng.uniform(np.sin(np.radians(10)), 1.0, count)
    a = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(a), r * np.sin(a), z])


@pytest.mark.parametrize(
    ("name", "frames", "size"), [("temple-walk", 91, (1024, 768)), ("temple-rotation", 1441, (2048, 1536))]
)
def test_defaults_are_those_of_the_paper(name: str, frames: int, size: tuple[int, int]) -> None:
    scene = description(name)
    assert scene.name == name
    assert (scene.frames, scene.width, scene.height, scene.fps) == (frames, *size, 25.0)
    assert scene.camera.frame_count(scene.fps) == frames
    assert scene.about


def test_the_temple_has_a_few_hundred_thousand_triangles() -> None:
    assert (
        200_000 <= sum(len(part["faces"]) for part in meshes(description("temple-walk")).values()) <= 500_000
    )


@pytest.mark.parametrize("name", ["temple-walk", "temple-rotation"])
def test_describing_twice_gives_the_same_hash(name: str) -> None:
    assert DESCRIBE[name]().hash == description(name).hash


def test_every_mesh_is_finite_and_refers_only_to_its_own_vertices() -> None:
    for name, part in meshes(description("temple-walk")).items():
        count = len(part["vertices"])
        assert part["faces"].max() < count, name
        for key in ("vertices", "normals", "uv"):
            if key in part:
                assert len(part[key]) == count, (name, key)
                assert np.isfinite(part[key]).all(), (name, key)
        if "normals" in part:
            np.testing.assert_allclose(np.linalg.norm(part["normals"], axis=1), 1.0, atol=1e-5)


def test_no_triangle_is_degenerate() -> None:
    for name, part in meshes(description("temple-walk")).items():
        smallest = areas(part["vertices"].astype(float), part["faces"].astype(int)).min()
        assert smallest > 1e-10, name


def test_smooth_normals_look_along_with_their_faces() -> None:
    for name, part in meshes(description("temple-walk")).items():
        if "normals" in part:
            a, b, c = (part["vertices"][part["faces"][:, k]] for k in range(3))
            facing = np.cross(b - a, c - a)
            agree = np.einsum("ij,ij->i", facing, part["normals"][part["faces"][:, 0]]) > 0
            assert agree.mean() > 0.98, name


@pytest.mark.parametrize("name", ["temple-walk", "temple-rotation"])
def test_the_camera_keeps_clear_of_every_stone(name: str) -> None:
    scene = description(name)
    origins = [pose.origin for pose in scene.camera.frame_poses(range(1, scene.frames + 1), scene.fps)]
    distance, _ = surface_samples().query(np.array(origins))
    assert distance.min() > 0.4  # samples lie about 0.1 m apart, so that 0.25 m is certain


def test_the_walk_is_some_metres_at_eye_height_above_the_hall_floor() -> None:
    scene = description("temple-walk")
    origins = np.array([pose.origin for pose in scene.camera.frame_poses(range(1, 92), 25.0)])
    steps = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    assert 6.0 < steps.sum() < 9.5
    assert steps.max() < 2.5 * steps.mean()
    np.testing.assert_allclose(origins[:, 2], temple.HALL_FLOOR + 1.65, atol=0.05)


def test_the_rotation_is_a_circle_that_passes_the_open_court() -> None:
    scene = description("temple-rotation")
    origins = np.array([pose.origin for pose in scene.camera.frame_poses(range(1, 1442), 25.0)])
    radius = np.linalg.norm(origins[:, :2] - [0.0, 50.0], axis=1)
    np.testing.assert_allclose(radius, 36.0, atol=0.05)
    within = (np.abs(origins[:, 0]) < 12.8) & (origins[:, 1] < 22)
    assert within.sum() > 100


def test_closed_parts_of_the_temple_let_no_ray_out_to_the_sky() -> None:
    inside = np.array(
        [
            (-8.0, 39.0, 2.0),  # side chamber
            (8.0, 39.0, 2.0),
            (-3.4, 52.8, 1.4),  # corner of the sanctuary, out of sight of slot and door
        ]
    )
    directions = np.concatenate([upward(60)] * len(inside))
    assert blocked(np.repeat(inside, 60, axis=0), directions).mean() > 0.97


def test_light_leaves_the_inner_rooms_only_through_their_slots() -> None:
    """Rays upward from the sanctuary: those that meet no stone pass the slot's rectangle at roof height."""
    origin, roof = np.array([0.7, 49.8, 2.0]), 7.0
    x0, y0, x1, y1 = temple.ROOF_SLOTS[-1]
    directions = upward(150)
    free = ~blocked(np.repeat(origin[None], len(directions), axis=0), directions)
    at_roof = origin + directions * ((roof - origin[2]) / directions[:, 2])[:, None]
    through = (at_roof[:, 0] > x0) & (at_roof[:, 0] < x1) & (at_roof[:, 1] > y0) & (at_roof[:, 1] < y1)
    assert free.any()
    assert not (free & ~through).any()


def test_the_sun_reaches_the_floor_of_the_hall() -> None:
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-9, 9, 200), rng.uniform(23.5, 35, 200), np.full(200, 0.4)])
    sun = np.repeat(np.array([temple.SUN]) / np.linalg.norm(temple.SUN), len(floor), axis=0)
    lit = 1.0 - blocked(floor, sun).mean()
    assert 0.05 < lit < 0.5
