"""Checks of camera paths: frames in walls, near walls and through walls are found, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from boxes import DIVIDED, FURNISHED, WALLS, Boxes
from steadylight.camera import CameraPath, Keyframe
from steadylight.walking.checks import check_path, stretches


def checked(geometry, start, end, frames=21):
    """A straight path along x, 20 cm a frame for 21 frames over 4 m."""
    path = CameraPath((Keyframe(0, start, (99, 0, 1.6)), Keyframe(1, end, (99, 0, 1.6))))
    poses = path.poses(np.linspace(0, 1, frames))
    return check_path(geometry, dict(zip(range(1, frames + 1), poses, strict=True)))


def test_a_path_through_a_door_is_clear_and_its_distances_are_right():
    found = checked(Boxes(DIVIDED), (2.0, 1.95, 1.6), (6.0, 1.95, 1.6))
    assert found.warnings == ()
    assert found.clearance[1] == pytest.approx(1.0, rel=0.02)  # the ceiling
    assert found.clearance[11] == pytest.approx(0.45, rel=0.02)  # the posts of the door


def test_a_path_through_a_wall_names_the_frames_and_the_wall():
    found = checked(Boxes(DIVIDED), (2.0, 1.0, 1.6), (6.0, 1.0, 1.6))
    words = [str(warning) for warning in found.warnings]
    assert "frames 10-11: the camera passes through a surface (`box_6`) between them" in words
    assert "frame 11: inside geometry" in words  # at x = 4.0, in the middle of the wall
    assert "frames 11-12: the camera passes through a surface (`box_6`) between them" in words
    assert len(words) == 3


def test_frames_near_a_surface_are_found():
    found = checked(Boxes(WALLS), (2.0, 0.1, 1.6), (6.0, 0.03, 1.6))
    assert [warning.fault for warning in found.warnings] == ["closer than 5 cm to a surface"]
    assert found.warnings[0].frames[-1] == 21
    near = np.linspace(0.1, 0.03, 21)
    assert found.warnings[0].frames[0] == pytest.approx(np.flatnonzero(near < 0.05)[0] + 1, abs=1)


def test_a_still_camera_in_a_wall_is_found_although_no_other_frame_is_outside():
    found = checked(Boxes(WALLS), (-0.1, 2.0, 1.6), (-0.1, 2.05, 1.6), frames=3)
    assert [str(warning) for warning in found.warnings] == ["frames 1-3: inside geometry"]


def test_a_room_that_is_modelled_as_one_box_is_not_geometry_to_be_inside_of():
    for reverse in (False, True):
        found = checked(
            Boxes([WALLS[0], [[0, 0, 0], [8, 4, 2.6]]], reverse=reverse), (2, 2, 1.6), (6, 2, 1.6)
        )
        assert found.warnings == ()


def test_gaps_between_frame_numbers_are_no_steps():
    path = CameraPath(
        (Keyframe(0, (2.0, 1.0, 1.6), (99, 1, 1.6)), Keyframe(1, (6.0, 1.0, 1.6), (99, 1, 1.6)))
    )
    poses = path.poses([0.0, 1.0])
    assert check_path(Boxes(DIVIDED), dict(zip((1, 30), poses, strict=True))).warnings == ()


def test_frames_so_far_from_the_origin_that_rays_start_far_off_surfaces_are_found():
    for away, far in ((50, False), (300, True)):
        geometry = Boxes(np.add(WALLS, [0, away, 0]), ray_offset=9e-5)
        found = checked(geometry, (2.0, away + 2, 1.6), (6.0, away + 2, 1.6), frames=3)
        assert len(found.warnings) == far
    assert str(found.warnings[0]).startswith(
        "frames 1-3: 302 m from the origin, where rays start 0.027 m off surfaces"
    )
    assert checked(Boxes(np.add(WALLS, [0, 300, 0])), (2.0, 302, 1.6), (6.0, 302, 1.6)).warnings == ()


def test_stretches():
    assert stretches((4,)) == "4"
    assert stretches((1, 2, 3, 7, 9, 10)) == "1-3, 7, 9-10"
    assert stretches(tuple(range(1, 40, 2))) == "1, 3, 5, 7, 9, 11 and 14 more stretches"


def test_a_long_path_takes_a_bounded_number_of_rays():
    geometry = Boxes(FURNISHED)
    checked(geometry, (2.0, 1.0, 1.6), (3.0, 1.0, 1.6), frames=5000)
    assert geometry.rays < 600_000
