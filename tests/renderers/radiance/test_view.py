"""Cameras as Radiance sees them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError
from steadylight.renderers.radiance.view import View, check_sensor, is_mirrored
from steadylight.scenes import load_scene
from steadylight.scenes.radiance.programs import output_of


def test_rays_are_those_of_radiances_own_view(tmp_path):
    pose = CameraPath((Keyframe(0.0, (1.0, 2.0, 3.0), (4.0, 1.0, 2.5), fov=70.0),)).frame_poses([1], 25.0)[0]
    view = View(pose, 8, 6)
    y, x = np.mgrid[0:6, 0:8]
    points = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / [8, 6]
    out = output_of(tmp_path, "vwrays", "-ff", "-pj", "0", "-pa", "0", "-x", 8, "-y", 6, *view.words)
    expected = np.frombuffer(out, np.float32).reshape(-1, 6)
    np.testing.assert_allclose(view.rays(points), expected, atol=2e-6)


def test_sensors_that_radiance_does_not_have_are_refused_by_name():
    scene = load_scene("furnace")
    check_sensor(scene)
    assert not is_mirrored(scene)
    assert is_mirrored(dataclasses.replace(scene, sensor={"type": "perspective", "scale": [-1.0, 1.0, 1.0]}))
    with pytest.raises(SceneError, match="sensor `thinlens`"):
        check_sensor(dataclasses.replace(scene, sensor={"type": "thinlens"}))
    with pytest.raises(SceneError, match="`principal_point_offset_x`"):
        check_sensor(
            dataclasses.replace(scene, sensor={"type": "perspective", "principal_point_offset_x": 0.1})
        )
