"""Which selected frame makes the records of a surface point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_scenes import described, lamp, paint, place

from steadylight.camera import CameraPath, Keyframe, Pose
from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.records.assignment import left_to_others
from steadylight.renderers.mitsuba.records.filling import Points
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.settings import RenderSettings

ASPECT = 4 / 3


def looking_down(x: float, height: float, fov: float = 60) -> Pose:
    """A camera above the floor: left is -x, up is +y."""
    to_world = np.eye(4)
    to_world[:3, :3] = np.diag([1.0, -1.0, -1.0])
    to_world[:3, 3] = x, 0, height
    return Pose(to_world, fov)


@pytest.fixture(scope="module")
def scene() -> Any:
    """A floor, and a board 1 m above a part of it."""
    board = {"type": "rectangle", "to_world": place((0.5, 0.5, 1), (2, 0, 1)), "bsdf": paint(0.5, 0.5, 0.5)}
    return build_scene(
        described({"floor": {"type": "rectangle", "to_world": place((9, 9, 1))}, "board": board})
    )


def floor_points(*places: tuple[float, float]) -> Points:
    position = np.array([(*place, 0) for place in places], np.float32).reshape(-1, 3)
    up = np.zeros_like(position) + np.float32([0, 0, 1])
    return Points.of_look_ups(
        position, up, np.ones(len(places), np.float32), np.zeros(len(places), np.float32)
    )


def kept(scene: Any, points: Points, *cameras: Pose) -> np.ndarray:
    """(P, cameras) which camera keeps which point for itself."""
    bsdfs = BSDFTraits(scene)
    left = [left_to_others(scene, bsdfs, points, cameras, mine, ASPECT) for mine in range(len(cameras))]
    return ~np.stack(left, axis=1)


def grid(half: float, count: int = 40) -> Points:
    x, y = np.meshgrid(np.linspace(-half, half, count), np.linspace(-half, half, count))
    return floor_points(*zip(x.ravel(), y.ravel(), strict=True))


def test_what_several_cameras_see_is_kept_by_one_of_them(scene: Any) -> None:
    shares = kept(scene, grid(0.5), looking_down(0, 3), looking_down(0.2, 3), looking_down(-0.1, 2.9))
    assert (shares.sum(axis=1) == 1).all()


def test_cameras_share_the_floor_about_evenly_in_cells_of_some_size(scene: Any) -> None:
    cameras = [looking_down(0.01 * number, 1.0, 110) for number in range(4)]
    points = grid(0.9, 200)
    shares = kept(scene, points, *cameras)
    assert (np.abs(shares.mean(axis=0) - 0.25) < 0.15).all()
    owner = shares.argmax(axis=1).reshape(200, 200)
    assert np.mean(owner[:, 1:] != owner[:, :-1]) < 0.05


def test_who_keeps_a_point_does_not_depend_on_which_others_are_asked_for(scene: Any) -> None:
    cameras = [looking_down(0.1 * number, 2.0, 80) for number in range(3)]
    points = grid(0.8)
    rows = np.random.default_rng(1).permutation(len(points.position))[:100]
    assert np.array_equal(kept(scene, points.take(rows), *cameras), kept(scene, points, *cameras)[rows])


def test_a_point_outside_of_the_other_pictures_is_kept(scene: Any) -> None:
    half_width = 3 * np.tan(np.radians(30))
    mine, other = looking_down(0.1, 3, 70), looking_down(0, 3)
    points = floor_points((-1.01 * half_width, 0), (0, 1.01 * half_width / ASPECT))
    assert kept(scene, points, mine, other).tolist() == [[True, False]] * 2


def test_a_point_that_something_hides_from_the_other_camera_is_kept(scene: Any) -> None:
    mine, other = looking_down(-1, 3, 120), looking_down(2, 3)
    assert kept(scene, floor_points((2, 0)), mine, other).tolist() == [[True, False]]


def test_a_camera_much_closer_has_the_point_and_one_behind_the_surface_never(scene: Any) -> None:
    point = floor_points((0, 0))
    assert kept(scene, point, looking_down(0, 6), looking_down(0, 3)).tolist() == [[False, True]]
    below = looking_down(0, -3)
    below.to_world[:3, :3] = np.eye(3)
    assert kept(scene, point, looking_down(0, 6), below).tolist() == [[True, False]]


def test_a_telephoto_lens_makes_up_for_the_distance(scene: Any) -> None:
    shares = kept(scene, floor_points((0, 0)), looking_down(0, 3), looking_down(0, 60, 3))
    assert shares.tolist() in ([[True, False]], [[False, True]])
    assert kept(scene, floor_points((0, 0)), looking_down(0, 3), looking_down(0, 60, 1)).tolist() == [
        [False, True]
    ]


@pytest.mark.parametrize("glass", ["dielectric", "thindielectric"])
def test_a_camera_sees_through_clear_glass_but_not_through_what_else_is_there(glass: str) -> None:
    pane = {"type": "cube", "to_world": place((0.5, 0.5, 0.01), (2, 0, 1)), "bsdf": {"type": glass}}
    content = {"floor": {"type": "rectangle", "to_world": place((9, 9, 1))}, "pane": pane}
    cameras = looking_down(-1, 3, 120), looking_down(2, 3)
    assert kept(build_scene(described(content)), floor_points((2, 0)), *cameras).tolist() == [[False, True]]
    board = {**pane, "to_world": place((0.4, 0.4, 0.01), (2, 0, 0.8)), "bsdf": paint(0.5, 0.5, 0.5)}
    hidden = build_scene(described(content | {"board": board}))
    assert kept(hidden, floor_points((2, 0)), *cameras).tolist() == [[True, False]]


def test_what_all_see_by_mirrors_only_is_kept_by_one_of_those_nearby(scene: Any) -> None:
    beside = floor_points(*((8, 0.01 * number) for number in range(100)))
    shares = kept(scene, beside, looking_down(0, 3), looking_down(0.1, 3), looking_down(-9, 3))
    assert (shares.sum(axis=1) == 1).all()
    assert not shares[:, 2].any()
    assert kept(scene, floor_points(), looking_down(0, 3), looking_down(0.1, 3)).shape == (0, 2)


def test_two_selected_frames_with_the_same_view_gather_hardly_more_than_one() -> None:
    room = {"floor": {"type": "rectangle", "to_world": place((3, 3, 1)), "bsdf": paint(0.5, 0.5, 0.5)}}
    wall = {"type": "rectangle", "to_world": place((3, 3, 1), (0, 0, 6)), "bsdf": paint(0.5, 0.5, 0.5)}
    scene = described(room | {"ceiling": wall | {"flip_normals": True}, "lamp": lamp()})
    path = CameraPath((Keyframe(0.0, (0, -2, 1.5), (0, 1, 0.5)), Keyframe(1.0, (0.01, -2, 1.5), (0, 1, 0.5))))
    poses = dict(zip((1, 2), path.poses([0.0, 1.0]), strict=True))
    settings = RenderSettings(frames=(1, 2), width=64, height=48, quality="draft")
    renderer = Renderer(scene, poses, settings)
    alone = [renderer.first_pass(frame) for frame in (1, 2)]
    shared = [renderer.first_pass(frame, (1, 2)) for frame in (1, 2)]
    assert all(done.left == 0 for done in alone)
    assert all(done.hits + done.misses + done.left == done.rays for done in [*alone, *shared])
    assert min(done.left for done in shared) > 0
    gathered = sum(len(done.records) for done in shared)
    assert gathered < 0.75 * sum(len(done.records) for done in alone)
    assert min(len(done.records) for done in shared) > 0
