"""The temple is closed where it should be, finely enough modelled, and its cameras never touch a stone."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from steadylight.scenes import masonry, modelling, temple, temple_reliefs, temple_rotation, temple_walk
from steadylight.scenes.modelling import areas
from steadylight.scenes.temple_surroundings import pylon

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription

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
def surface_samples() -> cKDTree:
    """Points on everything but the sand, closer to each other than the clearance that is tested."""
    parts = {key: part for key, part in meshes(description("temple-walk")).items() if key != "desert"}
    per_metre = 80  # samples on a square metre: some 0.11 m apart
    clouds = []
    for part in parts.values():
        mesh = trimesh.Trimesh(part["vertices"], part["faces"], process=False)
        clouds.append(trimesh.sample.sample_surface(mesh, int(per_metre * mesh.area), seed=1)[0])
    return cKDTree(np.concatenate(clouds))


@cache
def bare() -> np.ndarray:
    """(F, 3, 3) corners of the walls, towers and screens without their thin skins of stones and reliefs."""
    towers, _ = pylon()
    walls = [masonry.core(part.faces()) for part in (temple.court(), temple.house())]
    solids = [*walls, towers, temple.screens()]
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in solids])


def blocked(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) whether a ray from each origin meets a bare wall, by Möller & Trumbore (1997)."""
    corners = bare()
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    hit = np.zeros(len(origins), dtype=bool)
    for k, (o, d) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(d, edge2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / (edge1 * p).sum(axis=1)
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
    assert distance.min() > 0.4  # gaps between samples are under 0.3 m, so that 0.25 m is certain


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


def test_closed_rooms_let_no_ray_out_to_the_sky() -> None:
    chambers = np.array([(-8.0, 39.0, 2.0), (8.0, 39.0, 2.0), (-9.0, 40.5, 4.0)])
    directions = np.tile(upward(300), (len(chambers), 1))
    assert blocked(np.repeat(chambers, 300, axis=0), directions).all()


def test_light_leaves_the_inner_rooms_only_through_their_slots() -> None:
    """Rays upward from the sanctuary: those that meet no stone pass the slot's rectangle at roof height."""
    origin, roof = np.array([0.7, 49.8, 2.0]), 7.0
    x0, y0, x1, y1 = temple.ROOF_SLOTS[-1]
    directions = upward(600)
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


def test_carved_masonry_is_a_closed_solid_of_the_right_volume() -> None:
    stone = masonry.Masonry()
    stone.add((0, 0, 0), (4, 3, 2))
    stone.carve((1, 1, 0.5), (3, 2, 2))
    stone.add((1.5, 1, 0.5), (2, 2, 1))
    corners = masonry.core(stone.faces())
    a, b, c = (corners.vertices[corners.faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6  # divergence theorem
    assert volume == pytest.approx(4 * 3 * 2 - 2 * 1 * 1.5 + 0.5 * 1 * 0.5)
    np.testing.assert_allclose(np.cross(b - a, c - a).sum(axis=0), 0.0, atol=1e-12)


def test_stones_cover_a_face_without_gaps() -> None:
    face = masonry.Face(axis=1, sign=-1, plane=2.0, lower=(0.0, 0.0), upper=(5.0, 2.6))
    rims, fronts = masonry.stones(face, masonry.Bond(), np.random.default_rng(2))
    edges = rims[:, 1] - rims[:, 0], rims[:, 3] - rims[:, 0]
    assert np.linalg.norm(np.cross(*edges), axis=1).sum() == pytest.approx(5.0 * 2.6)
    assert (rims[..., 1] > 2.0).all()  # behind the plane of a wall that looks along -y
    assert (fronts[..., 1] < 2.0).all()


def test_reliefs_stand_out_of_their_wall() -> None:
    relief = temple_reliefs.register(4.0, 2.0, 0.05, np.random.default_rng(4))
    a, b, c = (relief.vertices[relief.faces[:, k]] for k in range(3))
    facing = np.cross(b - a, c - a)
    assert (facing[:, 2] > -1e-9).mean() > 0.99
    assert relief.vertices[:, 2].max() < 0.06
    wall = temple_reliefs.placed(relief, (1.0, 5.0, 2.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(wall.vertices[:, 1].min(), 5.0 - relief.vertices[:, 2].max())


def test_a_lathe_makes_a_cylinder_with_its_normals_outwards() -> None:
    cylinder = modelling.lathe(np.full((3, 64), 0.5), [0.0, 1.0, 2.0])
    assert modelling.areas(cylinder.vertices, cylinder.faces).sum() == pytest.approx(2 * np.pi, rel=0.01)
    np.testing.assert_allclose(cylinder.normals[:, :2], cylinder.vertices[:, :2] / 0.5, atol=1e-9)


def test_mirroring_a_mesh_keeps_its_faces_outwards() -> None:
    solid = modelling.box((0, 0, 0), (1, 2, 3)).transformed(np.diag([-1.0, 1.0, 1.0]), (5.0, 0.0, 0.0))
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(6.0)
