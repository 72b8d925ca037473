"""Walks: through doors, around furniture, up stairs, at the pace of a person; what cannot be walked is said."""

from __future__ import annotations

import numpy as np
import pytest

from boxes import DIVIDED, FURNISHED, WALLS, Boxes, box
from steadylight.camera.keyframes import read_toml, toml_of
from steadylight.errors import CameraError
from steadylight.walking.checks import check_path
from steadylight.walking.motion import Gait
from steadylight.walking.space import Body, Floor, Frame
from steadylight.walking.walk import Walker

UP = (0.0, 0.0, 1.0)


def frames_of(path, fps=25):
    """Origins and directions of all frames, (F, 3) each."""
    poses = path.frame_poses(range(1, path.frame_count(fps) + 1), fps)
    return np.array([pose.origin for pose in poses]), np.array([pose.direction for pose in poses])


def assert_human(geometry, path, speed=1.0):
    """That nothing is touched, and that speed and turns are those of a person."""
    poses = dict(enumerate(path.frame_poses(range(1, path.frame_count(25) + 1), 25), start=1))
    found = check_path(geometry, poses)
    assert found.warnings == ()
    assert min(found.clearance.values()) > 0.2
    origin, direction = frames_of(path)
    assert (np.linalg.norm(np.diff(origin, axis=0), axis=1) * 25).max() < 1.05 * speed
    cosine = (direction[1:] * direction[:-1]).sum(axis=1).clip(-1, 1)
    assert np.degrees(np.arccos(cosine).max()) * 25 < 66


class TestFloor:
    def floor(self, boxes, near=(2.0, 1.0, 0.0)):
        geometry = Boxes(boxes)
        return Floor(geometry, Frame(UP), Body(), geometry.bounds, np.array([near]))

    def test_one_stands_on_the_floor_only_neither_under_nor_on_a_table(self):
        floor = self.floor(FURNISHED)
        assert floor.places[:, 2] == pytest.approx(0.0, abs=1e-6)
        x, y, _ = floor.places.T
        assert not ((x > 1.2) & (x < 2.8) & (y > 1.4) & (y < 2.6)).any()
        assert not ((x > 6.0) & (x < 6.5) & (y > 1.6) & (y < 2.2)).any()
        assert floor.roofed.all()

    def test_clearance_is_the_distance_to_walls(self):
        floor = self.floor(WALLS)
        x, y, _ = floor.places.T
        wall = np.min([x, 8 - x, y, 4 - y], axis=0)
        inside = wall > 0.25
        assert floor.clearance[inside] == pytest.approx(wall[inside].clip(0, 1), abs=0.11)

    def test_a_thin_wall_that_no_cell_lies_in_cannot_be_crossed(self):
        floor = self.floor([*WALLS, box(4.0, 4.0, 0.0, 4.0, 0.0, 2.6)])
        assert floor.clearance[np.abs(floor.places[:, 0] - 4.0) < 0.2].max() < 0.2


class TestThroughPoints:
    @pytest.fixture(scope="class")
    @classmethod
    def walked(cls):
        geometry = Boxes(FURNISHED)
        return geometry, Walker(geometry, UP).through([(0.6, 2.0, 0.0), (4.0, 2.0, 1.6), (7.4, 2.0, 0.0)])

    def test_the_walk_is_that_of_a_person(self, walked):
        assert_human(*walked)

    def test_it_passes_the_points_at_eye_height(self, walked):
        origin, _ = frames_of(walked[1])
        assert origin[:, 2] == pytest.approx(1.6, abs=2e-3)
        for point in ((0.6, 2.0), (4.0, 2.0), (7.4, 2.0)):
            assert np.linalg.norm(origin[:, :2] - point, axis=1).min() < 0.35

    def test_it_goes_around_table_and_stool_and_looks_where_it_goes(self, walked):
        origin, direction = frames_of(walked[1])
        table = np.maximum(np.abs(origin[:, 0] - 2.0) - 0.8, np.abs(origin[:, 1] - 2.0) - 0.6)
        stool = np.maximum(np.abs(origin[:, 0] - 6.25) - 0.25, np.abs(origin[:, 1] - 1.9) - 0.3)
        assert min(table.min(), stool.min()) > 0.2
        ahead = origin[25:] - origin[:-25]
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        assert (ahead * direction[:-25]).sum(axis=1).min() > np.cos(np.radians(50))
        assert np.degrees(np.arcsin(direction[:, 2])) == pytest.approx(-3, abs=0.5)

    def test_it_is_little_longer_than_the_shortest_way(self, walked):
        origin, _ = frames_of(walked[1])
        assert np.linalg.norm(np.diff(origin, axis=0), axis=1).sum() < 8.5  # 6.8 m through the table

    def test_the_file_holds_the_same_path(self, walked):
        path, fps = read_toml(toml_of(walked[1], 30, "steadylight walk ü\n\udce4"), None)
        assert fps == 30
        for a, b in zip(frames_of(path), frames_of(walked[1]), strict=True):
            assert a == pytest.approx(b, abs=1e-4)

    def test_up_is_any_axis(self, walked):
        turned = Boxes(np.sort(Boxes(FURNISHED).boxes[:, :, [0, 2, 1]] * (1, 1, -1), axis=1))
        path = Walker(turned, (0.0, 1.0, 0.0)).through([(0.6, 0.0, -2.0), (4.0, 1.6, -2.0), (7.4, 0.0, -2.0)])
        assert_human(turned, path)
        origin, _ = frames_of(path)
        assert origin[:, 1] == pytest.approx(1.6, abs=2e-3)

    def test_speed(self):
        geometry = Boxes(DIVIDED)
        path = Walker(geometry, UP, gait=Gait(speed=2.0)).through([(0.6, 2.0, 0.0), (7.4, 2.0, 0.0)])
        assert_human(geometry, path, speed=2.0)
        origin, _ = frames_of(path)
        assert (np.linalg.norm(np.diff(origin, axis=0), axis=1) * 25).max() > 1.7

    def test_stairs_are_climbed(self):
        steps = [box(2 + 0.28 * n, 8.0, 0.0, 4.0, 0.0, 0.17 * (n + 1)) for n in range(8)]
        room = [
            [low, [x, y, z + 4]] if high == 2.6 else [low, high] for low, high in WALLS for x, y, z in [high]
        ]
        room[1] = box(-0.2, 8.2, -0.2, 4.2, 5.0, 5.2)
        geometry = Boxes([*room, *steps])
        path = Walker(geometry, UP).through([(0.6, 2.0, 0.0), (7.0, 2.0, 1.36)])
        origin, _ = frames_of(path)
        assert origin[0, 2] == pytest.approx(1.6, abs=1e-2)
        assert origin[-1, 2] == pytest.approx(1.36 + 1.6, abs=1e-2)
        assert np.diff(origin[:, 2]).min() > -1e-3
        assert_human(geometry, path, speed=1.1)


class TestRefusals:
    @pytest.mark.parametrize(
        ("points", "words"),
        [
            (
                [(0.6, 2, 0), (99, 2, 0)],
                r"point 2 \(99,2,0\) is outside the scene, which extends from -0.2,-0.2",
            ),
            (
                [(0.6, 2, 0), (2, 2, -9)],
                r"point 2 \(2,2,-9\): there is no place to stand within 0.75 m; the nearest",
            ),
            ([(0.6, 2, 0), (0.7, 2, 0)], "the points are less than half a metre apart"),
        ],
    )
    def test_points_that_cannot_be_walked(self, points, words):
        with pytest.raises(CameraError, match=words):
            Walker(Boxes(FURNISHED), UP).through(points)

    def test_a_closed_door(self):
        closed = Boxes([*DIVIDED, box(3.95, 4.0, 1.5, 2.4, 0.0, 2.1)])
        words = r"no way from point 1 \(0.6,2,0\) \(1\d\.\d m².*\) to point 2 .* a door is closed"
        with pytest.raises(CameraError, match=words):
            Walker(closed, UP).through([(0.6, 2.0, 0.0), (7.4, 2.0, 0.0)])

    def test_a_person_too_wide_for_the_door(self):
        with pytest.raises(CameraError, match="a gap is narrower than 1 m"):
            Walker(Boxes(DIVIDED), UP, Body(radius=0.5)).through([(0.6, 2.0, 0.0), (7.4, 2.0, 0.0)])

    def test_no_floor(self):
        with pytest.raises(CameraError, match="there is no room to walk in"):
            Walker(Boxes([box(0, 1, 0, 1, 0, 1), box(0, 1, 0, 1, 2, 3)]), (1.0, 0.0, 0.0)).rooms(None)

    def test_a_scene_in_other_units(self):
        large = Boxes(np.array(WALLS) * 1000)
        with pytest.raises(CameraError, match=r"the scene is too large .* check its units"):
            Walker(large, UP).through([(600.0, 2000.0, 0.0), (7400.0, 2000.0, 0.0)])


class TestRooms:
    def test_all_rooms_are_visited_from_where_one_is(self):
        geometry = Boxes(FURNISHED)
        path = Walker(geometry, UP).rooms((7.0, 3.0, 1.6))
        assert_human(geometry, path)
        x = frames_of(path)[0][:, 0]
        assert x[0] > 4.1
        assert x.min() < 3.0

    def test_without_a_place_to_begin_the_largest_space_counts(self):
        geometry = Boxes([*DIVIDED, box(3.95, 4.0, 1.5, 2.4, 0.0, 2.1), box(6.0, 8.0, 0.0, 4.0, 0.0, 2.6)])
        x = frames_of(Walker(geometry, UP).rooms((6.5, 2.0, 40.0)))[0][:, 0]
        assert x.max() < 3.9
