"""Which camera path an animation has: the scene's own, that of a file, or a circle."""

from __future__ import annotations

from pathlib import Path

from steadylight.camera import CameraPath, load_camera
from steadylight.camera.orbit import Orbit
from steadylight.errors import CameraError, SettingsError
from steadylight.renderers import geometry_of
from steadylight.scenes.description import SceneDescription
from steadylight.settings import Options


def camera_of(scene: SceneDescription, options: Options) -> tuple[CameraPath, float, int]:
    """The path, its frames per second, and the default number of frames.

    Raises:
        CameraError: the camera file or the circle is wrong.
        SettingsError: options exclude each other.
    """
    camera, fps = options.camera, options.fps
    if options.first_frame is not None and (camera is None or isinstance(camera, CameraPath)):
        raise SettingsError("--first-frame: only for a camera file; give --camera too, or leave it out")
    if options.orbit is not None:
        if camera is not None:
            raise SettingsError("--orbit: not together with --camera; leave one of them out")
        orbit = Orbit.parse(options.orbit)
        rate = scene.fps if fps is None else fps
        return _orbit(scene, orbit, rate, options), rate, orbit.frames
    if camera is None:
        rate = scene.fps if fps is None else fps
        # At another rate, the same part of the path is shown, not the same number of frames.
        same_stretch = round((scene.frames - 1) / scene.fps * rate) + 1
        return scene.camera, rate, scene.frames if rate == scene.fps else same_stretch
    if isinstance(camera, CameraPath):
        path, file_fps = camera, None
    else:
        path, file_fps = load_camera(Path(camera), options.first_frame)
    rate = next(value for value in (fps, file_fps, scene.fps) if value is not None)
    return path, rate, path.frame_count(rate)


def _orbit(scene: SceneDescription, orbit: Orbit, fps: float, options: Options) -> CameraPath:
    bounds = None
    if orbit.needs_bounds:
        geometry = geometry_of(scene, options.renderer, options.variant)
        if geometry is None:
            raise CameraError(
                "--orbit: the extent of this scene is not known; give around=X:Y:Z and radius=R"
            )
        bounds = geometry.bounds
    return orbit.path(scene.camera.upright, fps, bounds)
