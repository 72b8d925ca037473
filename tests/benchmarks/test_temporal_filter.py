"""The temporal filter that stands in for denoisers of several frames: what it takes away, and what it keeps."""

import numpy as np
import pytest
from temporal_filter import LEAST, TemporalFilter

from steadylight.camera import CameraPath, Keyframe
from steadylight.metrics.reprojection import View

HEIGHT, WIDTH = 24, 32


def test_noise_of_a_standing_camera_goes_down_to_what_the_newest_frames_share():
    rng = np.random.default_rng(0)
    noisy = [(1 + 0.1 * rng.standard_normal((HEIGHT, WIDTH, 3))).astype(np.float32) for _ in range(60)]
    smooth = TemporalFilter()
    filtered = [smooth(image) for image in noisy]
    # Exponential accumulation leaves a / (2 - a) of the variance; clamping some more.
    assert filtered[-1].std() == pytest.approx(0.1 * np.sqrt(LEAST / (2 - LEAST)), rel=0.25)
    assert filtered[-1].mean() == pytest.approx(1.0, abs=0.01)


def test_steady_light_passes_as_it_is():
    image = np.random.default_rng(1).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    smooth = TemporalFilter()
    for _ in range(5):
        assert smooth(image) == pytest.approx(image, abs=1e-6)


def test_what_was_not_seen_before_is_taken_from_the_newest_frame():
    pose = CameraPath((Keyframe(0.0, (0, 0, 0), (0, 1, 0), fov=60.0),)).pose(0.0)
    normal = np.broadcast_to([0.0, -1.0, 0.0], (HEIGHT, WIDTH, 3))
    near, far = (View(pose, (WIDTH, HEIGHT), wall(distance), normal) for distance in (2.0, 4.0))
    smooth = TemporalFilter()
    smooth(np.zeros((HEIGHT, WIDTH, 3), np.float32), near)
    image = np.random.default_rng(2).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    assert smooth(image, far) == pytest.approx(image)


def wall(distance):
    """Positions behind the pixels of a camera that looks along y."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    scale = 2 * np.tan(np.radians(30)) / WIDTH * distance
    return np.stack(
        [(columns - WIDTH / 2) * scale, np.full(rows.shape, distance), (HEIGHT / 2 - rows) * scale], axis=-1
    )
