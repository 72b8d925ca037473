"""Cameras of a USD stage: one keyframe for each time code, so that every frame is as in the file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SceneError
from steadylight.scenes import world
from steadylight.scenes.description import Note
from steadylight.scenes.usd.stage import Stage, label, matrix_of
from steadylight.scenes.world import camera_axes, keyframe, rolls

_MOST_FRAMES: Final = 99_999
_WIDTH: Final = 1280
_TENTH: Final = 0.1
"""Apertures and focal lengths are in tenths of the stage's unit of length."""


@dataclass(frozen=True)
class View:
    """The part of a scene description that comes from a camera."""

    camera: CameraPath
    sensor: dict[str, Any]
    width: int
    height: int
    frames: int
    fps: float


def chosen(stage: Stage, cameras: Sequence[Any], wanted: str | None) -> tuple[Any | None, list[Note]]:
    """The camera with a name, path or number (from 1); by default, that of the render settings, or the first.

    Raises:
        SettingsError: there is no such camera.
    """
    if wanted is not None:
        names = [(label(camera), str(camera.GetPath()), str(camera.GetName())) for camera in cameras]
        return cameras[world.chosen(stage.assets.path, wanted, names)], []
    if not cameras:
        return None, []
    settings = _render_settings(stage)
    if settings is not None:
        targets = settings.GetCameraRel().GetTargets()
        for camera in cameras:
            if targets and camera.GetPath() == targets[0]:
                return camera, []
    if len(cameras) == 1:
        return cameras[0], []
    text = f"of {world.listed([label(camera) for camera in cameras])} the first is used; choose with --sensor"
    return cameras[0], [Note("warning", "cameras", text)]


def view(stage: Stage, prim: Any) -> tuple[View, list[Note]]:
    """A camera over the stage's time codes.

    Raises:
        SceneError: the camera has impossible values.
    """
    from pxr import UsdGeom

    camera = UsdGeom.Camera(prim)
    times = _times(stage, prim)
    rate = float(stage.stage.GetTimeCodesPerSecond())
    if not (math.isfinite(rate) and rate > 0):
        raise SceneError(f"{stage.assets.path}: timeCodesPerSecond is {rate:g}; it must be greater than 0")
    first = camera.GetCamera(times[0])
    width, height, widen = _size(stage, first)
    keys = []
    try:
        poses = [_pose(stage, camera.GetCamera(time), widen) for time in times]
        level = not any(rolls(matrix) for matrix, _ in poses)
        keys = [keyframe(i / rate, matrix, fov, level=level) for i, (matrix, fov) in enumerate(poses)]
        path = CameraPath(tuple(keys if moves(keys) else keys[:1]))
    except CameraError as error:
        raise SceneError(f"{stage.assets.path}: camera {label(prim)}: {error}") from None
    sensor, notes = _sensor(stage, prim, first, widen)
    return View(path, sensor, width, height, path.frame_count(rate), rate), notes


def _times(stage: Stage, prim: Any) -> list[Any]:
    """Time codes of the frames."""
    from pxr import Usd, UsdGeom

    samples = set(UsdGeom.Camera(prim).GetFocalLengthAttr().GetTimeSamples())
    holder = prim
    while holder and not holder.IsPseudoRoot():
        if holder.IsA(UsdGeom.Xformable):
            samples.update(UsdGeom.Xformable(holder).GetTimeSamples())
        holder = holder.GetParent()
    if not samples:
        return [stage.start]
    authored = stage.stage.HasAuthoredTimeCodeRange()
    low = stage.stage.GetStartTimeCode() if authored else min(samples)
    high = stage.stage.GetEndTimeCode() if authored else max(samples)
    if not (math.isfinite(low) and math.isfinite(high)) or not 0 <= high - low < _MOST_FRAMES:
        raise SceneError(
            f"{stage.assets.path}: its time codes run from {low:g} to {high:g}; at most {_MOST_FRAMES:,} frames are "
            "supported"
        )
    return [Usd.TimeCode(low + i) for i in range(math.floor(high - low + 1e-6) + 1)]


def moves(keys: Sequence[Keyframe]) -> bool:
    """Whether any key differs from the first."""
    return any(
        (key.origin, key.target, key.up, key.fov) != (keys[0].origin, keys[0].target, keys[0].up, keys[0].fov)
        for key in keys
    )


def _pose(stage: Stage, camera: Any, widen: float) -> tuple[Any, float]:
    """Camera-to-world matrix with our axes, and the horizontal field of view in degrees."""
    matrix = stage.to_ours @ matrix_of(camera.transform)
    axes = matrix[:3, :3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(axes)) < 1e-30:
        raise CameraError("its transform has no inverse")
    if str(camera.projection).endswith("Orthographic"):
        return camera_axes(matrix), 45.0
    aperture, focal = float(camera.horizontalAperture) * widen, float(camera.focalLength)
    if not (aperture > 0 and focal > 0):
        raise CameraError(
            f"its aperture is {aperture:g} and its focal length {focal:g}; both must be greater than 0"
        )
    return camera_axes(matrix), math.degrees(2 * math.atan(aperture / 2 / focal))


def _render_settings(stage: Stage) -> Any | None:
    """The stage's render settings, or None."""
    from pxr import UsdRender

    found = UsdRender.Settings.GetStageRenderSettings(stage.stage)
    return found if found and found.GetPrim() else None


def _size(stage: Stage, camera: Any) -> tuple[int, int, float]:
    """Width and height of the picture, and its width relative to the camera's aperture."""
    aspect = float(camera.horizontalAperture) / max(float(camera.verticalAperture), 1e-9)
    aspect = aspect if 0.05 < aspect < 20 else 16 / 9
    settings = _render_settings(stage)
    if settings is not None and settings.GetResolutionAttr().HasAuthoredValue():
        width, height = (int(size) for size in settings.GetResolutionAttr().Get())
        if 1 <= width <= 65536 and 1 <= height <= 65536:
            return width, height, max(1.0, width / height / aspect)
    return _WIDTH, max(1, round(_WIDTH / aspect)), 1.0


def _sensor(stage: Stage, prim: Any, camera: Any, widen: float) -> tuple[dict[str, Any], list[Note]]:
    """Mitsuba's sensor, without pose and field of view."""
    from pxr import UsdGeom

    notes = []
    given = UsdGeom.Camera(prim)
    width, height = float(camera.horizontalAperture) * widen, float(camera.verticalAperture)
    sensor: dict[str, Any] = {"type": "perspective"}
    if str(camera.projection).endswith("Orthographic"):
        half = width * _TENTH * stage.unit / 2
        sensor = {"type": "orthographic", "scale": [half, half, 1.0]}
    elif camera.fStop > 0 and camera.focusDistance > 0:
        radius = float(camera.focalLength) * _TENTH * stage.unit / float(camera.fStop) / 2
        focus = float(camera.focusDistance) * stage.unit
        sensor = {"type": "thinlens", "aperture_radius": radius, "focus_distance": focus}
        lens = (given.GetFStopAttr(), given.GetFocusDistanceAttr(), given.GetFocalLengthAttr())
        if any(attribute.ValueMightBeTimeVarying() for attribute in lens):
            notes.append(
                Note("approximated", label(prim), "its focus and aperture stay as in the first frame")
            )
    if given.GetClippingRangeAttr().HasAuthoredValue():
        near, far = (
            float(distance) * stage.unit for distance in given.GetClippingRangeAttr().Get(stage.start)
        )
        if 0 < near < far:
            sensor |= {"near_clip": near, "far_clip": far}
    offset = (
        float(camera.horizontalApertureOffset) / width,
        float(camera.verticalApertureOffset) / max(height, 1e-9),
    )
    if any(abs(part) > 1e-6 for part in offset):
        if sensor["type"] == "perspective":
            sensor |= {"principal_point_offset_x": offset[0], "principal_point_offset_y": -offset[1]}
        else:
            notes.append(Note("left out", label(prim), "its shifted lens; only a perspective camera has one"))
    return sensor, notes
