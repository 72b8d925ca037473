"""Flicker after reprojection: a plane seen by a moving camera, where everything is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe, Pose
from steadylight.errors import InputError
from steadylight.images import write_layers
from steadylight.metrics.reprojection import View, project, temporal_deviation, thinned, warp

if TYPE_CHECKING:
    from pathlib import Path

WIDTH, HEIGHT = 60, 40


def pose(x: float = 0.0) -> Pose:
    """A camera at height 0 that looks along y, moved sideways."""
    return CameraPath((Keyframe(0.0, (x, 0, 0), (x, 1, 0), fov=60.0),)).pose(0.0)


def wall(at: Pose, distance: float = 4.0) -> View:
    """The plane y = distance, seen through the centres of all pixels."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    scale = 2 * np.tan(np.radians(at.fov) / 2) / WIDTH
    local = np.stack(
        [(WIDTH / 2 - columns) * scale, (HEIGHT / 2 - rows) * scale, np.ones_like(rows)], axis=-1
    )
    position = at.origin + local @ at.to_world[:3, :3].T * distance
    return View(at, (WIDTH, HEIGHT), position, np.broadcast_to([0.0, -1.0, 0.0], position.shape))


def pattern(view: View) -> np.ndarray:
    """Light that is fixed to the wall."""
    return 1 + 0.5 * np.sin(2 * view.position[..., 0]) * np.cos(3 * view.position[..., 2])


def test_a_point_ahead_is_in_the_middle_and_one_to_the_right_is_right_of_it() -> None:
    x, y, depth = project(
        np.array([[0.0, 2.0, 0.0], [0.5, 2.0, 0.0], [0.0, 2.0, 0.5]]), pose(), (WIDTH, HEIGHT)
    )
    assert x[0] == pytest.approx(WIDTH / 2)
    assert x[1] > x[0]
    assert y[2] < y[0]
    assert depth == pytest.approx([2.0, 2.0, 2.0])


def test_every_pixel_of_a_standing_camera_stays_where_it_is() -> None:
    found = warp(wall(pose()), wall(pose()))
    image = np.arange(WIDTH * HEIGHT, dtype=float).reshape(HEIGHT, WIDTH)
    inner = found.known[1:-1, 1:-1]
    assert inner.all()
    assert found.sample(image)[1:-1, 1:-1] == pytest.approx(image[1:-1, 1:-1], abs=1e-6)


def test_light_that_stays_on_its_surface_does_not_flicker_and_light_that_changes_does() -> None:
    before, now = wall(pose(0.0)), wall(pose(0.25))
    found = warp(now, before)
    assert 0.9 < found.known.mean() < 1.0
    steady = temporal_deviation(pattern(now), pattern(before), found)
    brighter = temporal_deviation(1.2 * pattern(now), pattern(before), found)
    assert steady.max() < 0.01
    assert brighter[found.known].mean() == pytest.approx(0.2 / 1.1 / 1.1, rel=0.05)
    # Without reprojection, the move itself would count as flicker.
    assert temporal_deviation(pattern(now), pattern(before)).mean() > 5 * steady.mean()


def test_what_was_hidden_before_is_not_compared() -> None:
    now = wall(pose(), 4.0)
    nearer = wall(pose(), 2.0)
    hidden = np.zeros((HEIGHT, WIDTH, 1), bool)
    hidden[:, :20] = True
    before = View(now.pose, now.size, np.where(hidden, nearer.position, now.position), now.normal)
    found = warp(now, before)
    assert not found.known[:, :19].any()
    assert found.known[2:-2, 22:-2].all()


def test_nothing_is_known_of_the_sky() -> None:
    sky = View(pose(), (WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH, 3)))
    found = warp(sky, sky)
    assert not found.known.any()
    assert not temporal_deviation(np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH)), found).any()


@pytest.mark.parametrize("by", [3, 5])
def test_a_thinned_view_goes_with_a_thinned_image(by: int) -> None:
    before, now = wall(pose(0.0)), wall(pose(0.3))
    found = warp(now.thinned(by), before.thinned(by))
    light, then = (thinned(pattern(view), by) for view in (now, before))
    assert found.known.shape == light.shape == (HEIGHT // by, WIDTH // by)
    assert np.abs(found.sample(then) - light)[found.known].max() < 0.03


def layers(view: View) -> dict[str, np.ndarray]:
    names = {f"P.{axis}": view.position[..., i] for i, axis in enumerate("XYZ")}
    return names | {f"N.{axis}": view.normal[..., i] for i, axis in enumerate("XYZ")}


def test_a_file_of_another_camera_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "frame_00001.exr"
    write_layers(path, layers(wall(pose(0.0))))
    assert View.read(path, pose(0.0)).position == pytest.approx(wall(pose(0.0)).position, abs=1e-6)
    with pytest.raises(InputError, match=r"frame_00001\.exr: its positions are not those of a perspective"):
        View.read(path, pose(1.0))


def test_a_file_without_positions_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "frame_00001.exr"
    write_layers(path, {"Z": np.ones((4, 4))})
    with pytest.raises(InputError, match=r"has no channel P\.X, P\.Y"):
        View.read(path, pose())
