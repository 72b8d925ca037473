"""Checks that the camera stays clear of surfaces on every frame of an animation."""

from __future__ import annotations

from steadylight.animation.request import Request
from steadylight.errors import SteadylightError
from steadylight.renderers import geometry_of
from steadylight.renderers.base import Geometry
from steadylight.walking.checks import Checked, check_path


def check_camera(request: Request, geometry: Geometry | None = None) -> Checked | None:
    """Check whether the camera passes through surfaces, or close to them, between the first and the last frame.

    Args:
        request: the animation.
        geometry: geometry of its scene; built if None.

    Returns:
        What was found; None if the surfaces of the scene are not known.
    """
    try:
        if geometry is None:
            geometry = geometry_of(request.scene, request.renderer.name, request.execution.variant)
        if geometry is None:
            return None
        numbers = range(request.settings.frames[0], request.settings.frames[-1] + 1)
        poses = request.scene.camera.frame_poses(numbers, request.settings.fps)
        return check_path(geometry, dict(zip(numbers, poses, strict=True)))
    except SteadylightError:
        return None  # the command reports the error where it needs the scene
