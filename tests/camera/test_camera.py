"""Camera paths are smooth and exact at their keyframes; wrong ones are refused in words that help."""

from __future__ import annotations

import json
import pickle
from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.camera import (
    CameraPath,
    Keyframe,
    Pose,
    change_measure,
    load_camera,
    select_frames,
)
from steadylight.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path


def walk() -> CameraPath:
    """Forward, a stop from 2 to 4 s, then off to the side with a narrower view."""
    return CameraPath(
        (
            Keyframe(0, (0, 0, 1.6), (1, 0, 1.6)),
            Keyframe(2, (4, 0, 1.6), (4, 1, 1.2)),
            Keyframe(4, (4, 0, 1.6), (4, 1, 1.2)),
            Keyframe(6, (4, 4, 2), (3, 4, 1.8), fov=40),
        )
    )


def circle(keys: int = 8, radius: float = 4.0) -> CameraPath:
    """Once around the z axis in `keys` seconds, looking at (0, 0, 1)."""
    angles = np.linspace(0, 2 * np.pi, keys + 1)
    places = [(radius * np.cos(a), radius * np.sin(a), 2.0) for a in angles]
    return CameraPath(tuple(Keyframe(i, place, (0, 0, 1)) for i, place in enumerate(places)), loop=True)


def tumbling() -> CameraPath:
    """Keyframes with nothing in common, not even what is up."""
    rng = np.random.default_rng(4)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 2.0, 5))])
    draws = rng.normal(size=(6, 3, 3)) * 3
    return CameraPath(
        tuple(Keyframe(t, tuple(a), tuple(b), tuple(c)) for t, (a, b, c) in zip(times, draws, strict=True))
    )


def pose_at(x: float = 0.0, angle: float = 0.0) -> Pose:
    """At x on the first axis, view turned by an angle (radians) about z."""
    return CameraPath((Keyframe(0, (x, 0, 0), (x + np.cos(angle), np.sin(angle), 0)),)).pose(0)


class TestPoses:
    @pytest.mark.parametrize("path", [walk(), tumbling(), circle()], ids=["walk", "tumbling", "circle"])
    def test_the_path_goes_through_its_keyframes(self, path):
        for key, pose in zip(path.keyframes, path.poses([key.time for key in path.keyframes]), strict=True):
            np.testing.assert_allclose(pose.origin, key.origin, atol=1e-9)
            np.testing.assert_allclose(pose.direction, key.view, atol=1e-9)
            assert pose.fov == pytest.approx(key.fov)

    def test_columns_are_left_up_view_and_origin_as_in_mitsubas_look_at(self):
        pose = CameraPath((Keyframe(0, (1, 2, 3), (1, 5, 3)),)).pose(0)
        expected = [[-1, 0, 0, 1], [0, 0, 1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
        np.testing.assert_allclose(pose.to_world, expected, atol=1e-12)

    @pytest.mark.parametrize("path", [walk(), tumbling(), circle()], ids=["walk", "tumbling", "circle"])
    def test_axes_are_orthonormal_and_right_handed_everywhere(self, path):
        for pose in path.poses(np.linspace(0, path.duration, 50)):
            axes = pose.to_world[:3, :3]
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
            assert np.linalg.det(axes) == pytest.approx(1)

    @pytest.mark.parametrize("path", [walk(), tumbling(), circle()], ids=["walk", "tumbling", "circle"])
    def test_position_and_orientation_have_no_sudden_change_of_velocity(self, path):
        jumps = []
        for steps in (1000, 2000):
            times = np.linspace(0, path.duration * (1 - 1e-9), steps + 1)
            matrices = np.array([pose.to_world for pose in path.poses(times)])
            velocity = np.diff(matrices, axis=0) * steps / path.duration
            jumps.append(np.abs(np.diff(velocity, axis=0)).max())
        # Of a smooth curve the jump between steps halves with the step; at a kink it stays.
        assert jumps[1] < 0.6 * jumps[0]

    def test_a_loop_is_smooth_where_it_closes_and_repeats(self):
        path = circle()
        h = 1e-4
        before, at, after, later = (p.to_world for p in path.poses([8 - h, 0, h, 16 + h]))
        np.testing.assert_allclose((at - before) / h, (after - at) / h, atol=1e-3)
        np.testing.assert_allclose(after, later, atol=1e-9)

    def test_a_circle_of_eight_keyframes_is_round_within_one_percent(self):
        radii = [np.hypot(*pose.origin[:2]) for pose in circle().poses(np.linspace(0, 8, 200))]
        assert max(radii) <= 4 + 1e-9
        assert min(radii) > 3.96

    def test_the_camera_stands_still_between_equal_keyframes(self):
        poses = walk().poses(np.linspace(2, 4, 20))
        for pose in poses:
            np.testing.assert_allclose(pose.to_world, poses[0].to_world, atol=1e-12)

    def test_the_path_keeps_within_a_corridor_that_turns_a_corner(self):
        path = CameraPath(
            (
                Keyframe(0, (0, 0, 1.6), (1, 0, 1.6)),
                Keyframe(2, (4, 0, 1.6), (4, 1, 1.6)),
                Keyframe(4, (4, 4, 1.6), (4, 5, 1.6)),
            )
        )
        for pose in path.poses(np.linspace(0, 4, 100)):
            x, y, z = pose.origin
            assert max(x - 4, -y) < 0.4  # a tenth of the distance between keyframes
            assert z == pytest.approx(1.6)

    def test_the_path_turns_with_the_scene(self):
        turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
        path = walk()
        turned = CameraPath(
            tuple(
                Keyframe(k.time, tuple(turn @ k.origin), tuple(turn @ k.target), k.up, k.fov)
                for k in path.keyframes
            )
        )
        times = np.linspace(0, 6, 40)
        for a, b in zip(path.poses(times), turned.poses(times), strict=True):
            np.testing.assert_allclose(turn @ a.to_world[:3], b.to_world[:3], atol=1e-9)

    def test_the_horizon_stays_level_between_level_keyframes(self):
        for pose in walk().poses(np.linspace(0, 6, 60)):
            assert abs(pose.to_world[2, 0]) < 1e-12  # the camera's left is horizontal

    def test_two_keyframes_make_a_steady_walk(self):
        path = CameraPath((Keyframe(0, (0, 0, 0), (0, 1, 0)), Keyframe(4, (8, 0, 0), (8, 1, 0))))
        np.testing.assert_allclose([p.origin[0] for p in path.poses([1, 2, 3])], [2, 4, 6], atol=1e-12)

    def test_the_field_of_view_stays_between_its_keyframes(self):
        fovs = [pose.fov for pose in walk().poses(np.linspace(0, 6, 50))]
        assert min(fovs) == pytest.approx(40)
        assert max(fovs) == pytest.approx(60)

    def test_a_still_view_is_the_same_at_all_times(self):
        still = CameraPath((Keyframe(0, (0, 0, 0), (0, 1, 0)),))
        a, b = still.poses([0, 99])
        np.testing.assert_array_equal(a.to_world, b.to_world)
        assert len(still.frame_poses(range(1, 5), 25)) == 4

    def test_a_path_pickles_compares_and_takes_numpy_numbers(self):
        path = CameraPath((Keyframe(np.float32(0), tuple(np.zeros(3)), np.array([0.0, 1, 0])),))
        path.pose(0)
        assert pickle.loads(pickle.dumps(path)) == path
        assert type(path.keyframes[0].origin[0]) is float


class TestFrames:
    def test_frame_one_is_at_time_zero_and_the_last_at_the_end(self):
        path = walk()
        assert path.frame_count(25) == 151
        first, last = path.frame_poses([1, 151], 25)
        np.testing.assert_allclose(first.origin, (0, 0, 1.6))
        np.testing.assert_allclose(last.origin, (4, 4, 2))

    def test_rounding_of_the_end_time_loses_no_frame(self):
        for fps in (24, 29.97, 30, 60):
            keys = (Keyframe(0, (0, 0, 0), (0, 1, 0)), Keyframe(90 / fps, (1, 0, 0), (1, 1, 0)))
            assert CameraPath(keys).frame_count(fps) == 91
            CameraPath(keys).frame_poses([91], fps)

    def test_a_loop_does_not_show_its_first_pose_twice(self):
        assert circle().frame_count(25) == 200

    def test_a_frame_beyond_the_end_is_refused_with_the_number_there_are(self):
        with pytest.raises(CameraError, match=r"frame 152 .* 6 s: 151 frames at 25 frames per second"):
            walk().frame_poses([1, 152], 25)

    def test_a_time_off_the_path_is_refused(self):
        with pytest.raises(CameraError, match="from 0 to 6 s"):
            walk().pose(6.5)
        with pytest.raises(CameraError, match="from 0 to 6 s"):
            walk().pose(float("nan"))


class TestChangeMeasure:
    def test_turn_and_travel_are_shares_of_the_path_and_weigh_the_same(self):
        poses = [pose_at(0, 0), pose_at(3, 0), pose_at(3, 0.4), pose_at(4, 0.5)]
        np.testing.assert_allclose(change_measure(poses), [0.75, 0.8, 0.25 + 0.2], atol=1e-12)

    def test_what_never_changes_is_zero(self):
        np.testing.assert_allclose(change_measure([pose_at(x) for x in (0, 1, 4)]), [0.25, 0.75])
        np.testing.assert_array_equal(change_measure([pose_at()] * 3), [0, 0])
        assert change_measure([pose_at()]).shape == (0,)

    def test_an_even_walk_selects_evenly_spaced_frames_with_both_ends(self):
        poses = [pose_at(x) for x in range(101)]
        assert select_frames(poses, 5) == [0, 25, 50, 75, 100]
        assert select_frames(poses, 1) == [50]

    def test_frames_gather_where_the_change_is(self):
        poses = [pose_at(x) for x in [*np.linspace(0, 1, 50), *np.linspace(1.1, 10, 50)]]
        chosen = select_frames(poses, 10)
        assert len(chosen) == 10
        assert sum(index < 50 for index in chosen) <= 2

    def test_a_standing_camera_needs_one_frame(self):
        assert select_frames([pose_at()] * 20, 8) == [0]
        assert select_frames([pose_at()], 8) == [0]

    def test_no_frame_is_chosen_twice_even_if_one_step_makes_most_of_the_change(self):
        poses = [pose_at(x) for x in (0, 1, 2, 1000, 1001, 1002, 1002, 1002)]
        chosen = select_frames(poses, 5)
        assert chosen == sorted(set(chosen))
        assert len(chosen) == 5
        assert len(select_frames(poses, 7)) == 6  # three frames are one and the same view

    def test_more_frames_wanted_than_there_are_gives_all(self):
        assert select_frames([pose_at(x) for x in range(4)], 9) == [0, 1, 2, 3]


class TestRefusedPaths:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"origin": (0, 1, 0)}, "same point"),
            ({"up": (0, 2, 0)}, "parallel to the view"),
            ({"up": (0, 0, 0)}, "is zero"),
            ({"origin": (0, float("nan"), 0)}, "finite"),
            ({"target": (float("inf"), 0, 0)}, "finite"),
            ({"time": float("nan")}, "finite"),
            ({"fov": 0}, "between 0 and 180"),
            ({"fov": 180}, "between 0 and 180"),
            ({"fov": True}, "must be a number"),
            ({"origin": (0, 0)}, "three numbers"),
            ({"time": 10**400}, "finite"),
        ],
    )
    def test_a_keyframe_that_is_no_view_is_refused(self, change, words):
        with pytest.raises(CameraError, match=words):
            Keyframe(**{"time": 0.0, "origin": (0, 0, 0), "target": (0, 1, 0), **change})

    def test_times_must_start_at_zero_and_increase(self):
        def path(*times: float) -> None:
            CameraPath(tuple(Keyframe(t, (0, 0, 0), (0, 1, 0)) for t in times))

        with pytest.raises(CameraError, match=r"keyframe 3: is at 1 s, not later than keyframe 2 at 1 s"):
            path(0, 1, 1)
        with pytest.raises(CameraError, match="must start at time 0"):
            path(1, 2)
        with pytest.raises(CameraError, match="at least one keyframe"):
            path()

    def test_a_loop_must_close(self):
        keys = circle().keyframes
        with pytest.raises(
            CameraError, match="keyframe 8: the last keyframe of a loop must repeat the first"
        ):
            CameraPath(keys[:-1], loop=True)
        with pytest.raises(CameraError, match="at least three"):
            CameraPath(keys[:2], loop=True)


TOML = """
fps = 30
fov = 70
[[keyframes]]
frame = 1
origin = [0, 0, 1.6]
target = [1, 0, 1.6]
[[keyframes]]
frame = 61
origin = [4, 0, 1.6]
target = [5, 0, 1.6]
fov = 50
"""


class TestFiles:
    def read(self, folder: Path, text: str, name: str = "walk.toml"):
        file = folder / name
        file.write_text(text)
        return load_camera(file)

    def entry(self, **change) -> dict:
        entry = {"time": 0.0, "origin": [0, 0, 0], "target": [0, 1, 0], **change}
        return {key: value for key, value in entry.items() if value is not None}

    def test_toml_with_frames_and_defaults(self, tmp_path):
        path, fps = self.read(tmp_path, TOML)
        assert fps == 30
        assert [key.time for key in path.keyframes] == [0, 2]
        assert [key.fov for key in path.keyframes] == [70, 50]

    def test_json_with_times_and_a_loop(self, tmp_path):
        square = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (1, 0, 0)]
        keys = [self.entry(time=i, origin=place, target=[0, 0, 5]) for i, place in enumerate(square)]
        text = json.dumps({"keyframes": keys, "loop": True, "up": [1, 1, 0]})
        path, fps = self.read(tmp_path, text, "round.json")
        assert path.loop
        assert fps is None
        assert path.duration == 4
        assert path.keyframes[0].up == (1, 1, 0)

    def test_frame_numbers_without_fps_count_by_25(self, tmp_path):
        path, fps = self.read(tmp_path, TOML.replace("fps = 30", ""))
        assert fps == 25
        assert path.duration == pytest.approx(2.4)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (
                {"orign": [0, 0, 0]},
                r"keyframe 2: `orign` is not a valid key; did you mean `origin`\? valid keys: time",
            ),
            ({"zzz": 1}, r"keyframe 2: `zzz` is not a valid key; valid keys: time, frame, origin"),
            ({"origin": None}, "keyframe 2: `origin` missing"),
            ({"time": None, "target": None}, r"keyframe 2: `time` .* or `frame` .* and `target` missing"),
            ({"frame": 3}, "keyframe 2: has both `time` and `frame`"),
            ({"time": None, "frame": 0}, "keyframe 2: `frame` is 0: this file counts its frames from 0"),
            ({"origin": [0, 0]}, r"keyframe 2: `origin` must be three numbers \[x, y, z\], not a list of 2"),
            ({"origin": "here"}, "keyframe 2: `origin` must be three numbers"),
            ({"time": "soon"}, "keyframe 2: `time` must be a number, not 'soon'"),
            ({"origin": [0, float("nan"), 0]}, "keyframe 2: `origin` is nan"),
            ({"time": float("inf")}, "keyframe 2: `time` is inf"),
            ({"up": [0, 3, 0]}, "keyframe 2: `up` .* parallel to the view"),
            ({"target": [0, 0, 0]}, "keyframe 2: `origin` and `target` are the same"),
            ({"time": 0}, "keyframe 2: is at 0 s, not later"),
            ({"fov": 200}, "keyframe 2: `fov` is 200"),
        ],
    )
    def test_a_wrong_keyframe_is_named_with_its_fault(self, tmp_path, change, words):
        text = json.dumps({"keyframes": [self.entry(), self.entry(**{"time": 1.0, **change})]})
        with pytest.raises(CameraError, match=r"walk\.json: " + words):
            self.read(tmp_path, text, "walk.json")

    @pytest.mark.parametrize(
        ("name", "text", "words"),
        [
            ("a.toml", "fps = = 3", r"not valid TOML: .*line 1"),
            ("a.json", '{"keyframes": [}', r"not valid JSON: .*line 1, column 16"),
            ("a.json", "[" * 100_000, "is nested too deeply"),
            ("a.json", "[1]", "must be a table"),
            ("a.json", "{}", "`keyframes` is missing"),
            ("a.json", '{"keyframes": 3}', "must be a list of keyframes"),
            ("a.json", '{"keyframes": [1, 2]}', "keyframe 1: a keyframe must be a table"),
            ("a.json", '{"keyframes": []}', "has 0 keyframes; a camera path needs at least two"),
            ("a.json", '{"keyframes": [{}]}', "has 1 keyframe; a camera path needs at least two"),
            ("a.json", '{"keyframe": []}', "did you mean `keyframes`"),
            ("a.json", '{"keyframes": [{}, {}], "loop": 1}', "`loop` must be true or false"),
            ("a.json", '{"keyframes": [{}, {}], "fps": 0}', "`fps` is 0; it must be greater than 0"),
            ("a.yaml", "", r"does not have the extension of a camera file; camera files end in \.toml"),
        ],
    )
    def test_a_wrong_file_is_named_with_its_fault(self, tmp_path, name, text, words):
        with pytest.raises(CameraError, match=r"a\.\w+: .*" + words):
            self.read(tmp_path, text, name)

    def test_a_file_that_cannot_be_read_is_refused(self, tmp_path):
        with pytest.raises(CameraError, match="no such camera file"):
            load_camera(tmp_path / "nowhere.toml")
        (tmp_path / "folder.toml").mkdir()
        with pytest.raises(CameraError, match="cannot be read"):
            load_camera(tmp_path / "folder.toml")
        (tmp_path / "latin.toml").write_bytes(b"# \xe9")
        with pytest.raises(CameraError, match="not UTF-8"):
            load_camera(tmp_path / "latin.toml")
