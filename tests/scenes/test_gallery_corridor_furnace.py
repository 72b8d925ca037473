"""The interiors are closed, well modelled and passable; the furnace has the answer that it claims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
import trimesh

from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.scenes import corridor, furnace, gallery
from steadylight.scenes.furnishings import Mesh, box, chamfered_box, lathe, looking, moulding, standing, tube
from steadylight.scenes.shell import broken_path, hollow_out

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription

MODULES = {"gallery": gallery, "corridor": corridor, "furnace": furnace}
TRIANGLES = {"gallery": (50_000, 300_000), "corridor": (20_000, 200_000), "furnace": (24, 1_000)}
CLEARANCE = 0.25


@cache
def description(name: str) -> SceneDescription:
    return MODULES[name].describe()


def meshes(name: str) -> dict[str, dict]:
    entries = description(name).content.items()
    return {key: e for key, e in entries if isinstance(e, dict) and e.get("type") == "triangles"}


def corners(name: str) -> np.ndarray:
    """All triangles of a scene, (T, 3, 3), metres."""
    return np.concatenate([entry["vertices"][entry["faces"]] for entry in meshes(name).values()]).astype(
        float
    )


def poses(name: str) -> list:
    scene = description(name)
    return scene.camera.frame_poses(range(1, scene.frames + 1), scene.fps)


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


@pytest.mark.parametrize("name", MODULES)
class TestEveryInterior:
    def test_describing_it_twice_gives_the_same_hash(self, name):
        assert MODULES[name].describe().hash == description(name).hash

    def test_it_is_finite_and_no_triangle_is_degenerate(self, name):
        for key, entry in meshes(name).items():
            assert np.isfinite(entry["vertices"]).all(), key
            assert entry["faces"].max() < len(entry["vertices"]), key
            a, b, c = np.moveaxis(entry["vertices"][entry["faces"]].astype(float), 1, 0)
            doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
            longest = np.max([np.linalg.norm(e, axis=1) for e in (b - a, c - b, a - c)], axis=0)
            assert (doubled / longest > 1e-5).all(), f"{key}: a triangle is thinner than 10 micrometres"

    def test_shading_normals_are_unit_and_on_the_side_of_their_triangles(self, name):
        for key, entry in meshes(name).items():
            if "normals" not in entry:
                continue
            np.testing.assert_allclose(np.linalg.norm(entry["normals"], axis=1), 1.0, atol=1e-5)
            a, b, c = np.moveaxis(entry["vertices"][entry["faces"]].astype(float), 1, 0)
            mean = entry["normals"][entry["faces"]].sum(axis=1)
            assert (np.sum(np.cross(b - a, c - a) * mean, axis=1) > 0).mean() > 0.999, key

    def test_it_has_a_sensible_number_of_triangles_in_few_meshes(self, name):
        low, high = TRIANGLES[name]
        assert low <= len(corners(name)) <= high
        assert len(meshes(name)) < 80

    def test_every_albedo_is_above_0_and_at_most_0_9(self, name):
        colours = list(reflectances(description(name).content))
        assert colours
        for colour in colours:
            assert (colour > 0).all()
            assert (colour <= 0.9).all()

    def test_the_camera_keeps_clear_of_everything(self, name):
        triangles = corners(name)
        low, high = triangles.min(axis=1), triangles.max(axis=1)
        for frame, pose in enumerate(poses(name), start=1):
            near = triangles[((low < pose.origin + CLEARANCE) & (high > pose.origin - CLEARANCE)).all(axis=1)]
            if len(near):
                points = np.broadcast_to(pose.origin, (len(near), 3))
                nearest = trimesh.triangles.closest_point(near, points)
                distance = np.linalg.norm(nearest - pose.origin, axis=1).min()
                assert distance > CLEARANCE, f"frame {frame}: {distance:.3f} m to the nearest surface"

    def test_the_camera_stands_in_the_air_at_every_frame(self, name):
        origins = np.array([pose.origin for pose in poses(name)])
        _, facing = cast(name, origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        assert facing.all(), "below the camera there is the upper side of something"

    def test_no_ray_from_the_camera_leaves_the_building(self, name):
        rng = np.random.default_rng(1)
        directions = rng.normal(size=(4000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.array([pose.origin for pose in poses(name)[::12]])
        distance, _ = cast(name, np.repeat(origins, 4000, axis=0), np.tile(directions, (len(origins), 1)))
        assert np.isfinite(distance).all()
        assert distance.max() < 45.0

    def test_the_path_lasts_as_long_as_the_film(self, name):
        scene = description(name)
        assert scene.camera.duration == pytest.approx((scene.frames - 1) / scene.fps)


def reflectances(value):
    """Every diffuse reflectance within a description, as arrays."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if key in {"reflectance", "diffuse_reflectance"}:
                yield np.asarray(item["data"] if item["type"] == "bitmap" else item["value"])
            else:
                yield from reflectances(item)


@cache
def solids(name: str):
    """A Mitsuba scene of all the triangles, for casting rays."""
    variant = resolve_variant("llvm")  # before Mitsuba is imported
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)
    triangles = corners(name)
    mesh = mi.Mesh("all", 3 * len(triangles), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(triangles).astype(np.float32)
    parameters["faces"] = np.arange(3 * len(triangles), dtype=np.uint32)
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


def cast(name: str, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray (inf: nothing is met), and whether it meets the side that a triangle faces."""
    scene = solids(name)
    import mitsuba as mi

    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T)))
    return np.array(si.t), np.sum(np.array(si.n).T * directions, axis=1) < 0


class TestFurnace:
    def test_its_surfaces_are_closed_and_face_the_air(self):
        volume = {}
        for name, entry in meshes("furnace").items():
            mesh = trimesh.Trimesh(entry["vertices"], entry["faces"])
            assert mesh.is_watertight, name
            volume[name] = mesh.volume
        assert volume["room"] == pytest.approx(-(furnace.SIDE**3))
        assert volume["ball"] > 0.1
        assert volume["block"] == pytest.approx(0.4 * 0.5 * 0.7, rel=1e-5)

    def test_what_stands_in_it_floats_free_and_apart(self):
        parts = {key: entry["vertices"] for key, entry in meshes("furnace").items()}
        for name in ("ball", "block"):
            assert parts[name].min() > 0.05
            assert parts[name].max() < furnace.SIDE - 0.05
        gap = np.linalg.norm(parts["block"] - np.array([1.25, 1.3, 0.9]), axis=1).min() - 0.35
        assert gap > 0.05

    def test_every_surface_glows_and_reflects_alike(self):
        for entry in meshes("furnace").values():
            assert entry["emitter"]["radiance"]["value"] == [furnace.EMISSION] * 3
            assert entry["bsdf"]["reflectance"]["value"] == [furnace.ALBEDO] * 3
            assert "normals" not in entry

    def test_its_answer_is_the_geometric_series(self):
        assert furnace.expected_radiance() == 2.0
        assert furnace.expected_radiance(0) == 1.5
        assert furnace.expected_radiance(2) == 1.0 + 0.5 + 0.25 + 0.125


class TestShell:
    def test_the_surface_of_touching_blocks_is_closed_and_faces_the_air(self):
        blocks = [
            ((0, 0, 0), (5, 4, 3)),
            ((5, 1, 0), (5.3, 2, 2)),
            ((5.3, 0, 0), (8, 4, 3)),
            ((1, 1, 3), (2, 2, 3.5)),
        ]
        mesh = solid(hollow_out(blocks, lambda *_: "stone")["stone"])
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(-(60 + 0.6 + 32.4 + 0.5))

    def test_a_material_is_chosen_by_place_and_normal(self):
        def material(centre, normal):
            return "floor" if normal[2] > 0.5 else "lamp" if centre[2] > 2.9 else "wall"

        shell = hollow_out([((0, 0, 0), (2, 2, 3))], material)
        assert {name: len(mesh.faces) for name, mesh in shell.items()} == {"floor": 2, "wall": 8, "lamp": 2}

    def test_gaps_break_a_path_and_leave_the_rest(self):
        parts = broken_path(
            [(0.0, 0.0), (10.0, 0.0), (10.0, 5.0)], [(4.0, 0.0), (10.0, 3.0), (7.0, 7.0)], 0.5
        )
        assert parts == [
            [(0.0, 0.0), (3.5, 0.0)],
            [(4.5, 0.0), (10.0, 0.0), (10.0, 2.5)],
            [(10.0, 3.5), (10.0, 5.0)],
        ]


class TestFurnishings:
    @pytest.mark.parametrize(
        ("mesh", "volume"),
        [
            (box((0, 0, 0), (1, 2, 3)), 6.0),
            (chamfered_box((0, 0, 0), (1, 1, 1), 0.1), 1.0 - 12 * 0.8 * 0.005 - 8 * 0.001 * 5 / 6),
            (
                lathe(
                    [(0.0, 0.0), (1.0, 0.0)], [(1.0, 0.0), (1.0, 2.0)], [(1.0, 2.0), (0.0, 2.0)], segments=200
                ),
                2 * np.pi,
            ),
            (tube([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.5, sides=200), 0.5 * np.pi),
        ],
        ids=["box", "chamfered box", "lathe", "tube"],
    )
    def test_a_body_is_closed_and_faces_outward(self, mesh, volume):
        assert solid(mesh).is_watertight
        assert solid(mesh).volume == pytest.approx(volume, rel=1e-3)

    def test_a_closed_tube_joins_without_a_seam(self):
        t = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
        ring = tube(np.stack([np.cos(t), np.sin(t), 0.3 * np.sin(3 * t)], 1), 0.2, sides=16, closed=True)
        assert solid(ring).is_watertight
        edges = ring.vertices[ring.faces[:, 0]] - ring.vertices[ring.faces[:, 1]]
        assert np.linalg.norm(edges, axis=1).max() < 0.15

    def test_a_closed_moulding_faces_away_from_its_wall(self):
        section = [(-0.1, 0.0), (-0.1, 0.05), (0.0, 0.05), (0.0, 0.0)]
        frame = moulding([(0, 0), (2, 0), (2, 1), (0, 1)], section, closed=True)
        open_edges = Counter(map(tuple, np.sort(solid(frame).edges, axis=1)))
        assert sum(count == 1 for count in open_edges.values()) == 8  # only where it lies on the wall
        top = frame.vertices[frame.faces].mean(axis=1)[:, 2] > 0.049
        a, b, c = np.moveaxis(frame.vertices[frame.faces[top]], 1, 0)
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()

    def test_what_stands_on_a_wall_is_upright_and_faces_the_room(self):
        place = standing((4.0, 7.0, 0.0), 270.0)
        np.testing.assert_allclose(place @ [0, 1, 0, 0], [0, 0, 1, 0], atol=1e-12)
        np.testing.assert_allclose(place @ [0, 0, 1, 0], [0, -1, 0, 0], atol=1e-12)
        assert np.linalg.det(place[:3, :3]) == pytest.approx(1.0)

    def test_looking_turns_the_z_axis_to_the_target(self):
        matrix = looking((1.0, 2.0, 3.0), (4.0, 2.0, -1.0))
        np.testing.assert_allclose(matrix[:3, 2], [0.6, 0.0, -0.8])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)


class TestGalleryLamps:
    def test_every_spot_lamp_shines_past_its_own_housing(self):
        spots = [
            e for e in description("gallery").content.values() if isinstance(e, dict) and e["type"] == "spot"
        ]
        assert len(spots) >= 6
        rng = np.random.default_rng(2)
        for spot in spots:
            to_world = spot["to_world"]
            tangent = np.tan(np.radians(spot["cutoff_angle"])) * np.sqrt(rng.random(200))
            turn = rng.uniform(0, 2 * np.pi, 200)
            local = np.column_stack([tangent * np.cos(turn), tangent * np.sin(turn), np.ones(200)])
            rays = local @ to_world[:3, :3].T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            distance, _ = cast("gallery", np.broadcast_to(to_world[:3, 3], rays.shape), rays)
            assert distance.min() > 0.4
