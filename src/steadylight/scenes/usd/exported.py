"""Facts about a scene that its USD export does not hold: cameras, environment, and what was lost.

`scenes.blender_export` writes the facts.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from steadylight.camera import CameraPath
from steadylight.errors import CameraError, SceneError
from steadylight.images import read_exr
from steadylight.scenes.description import Note
from steadylight.scenes.pbr import rgb
from steadylight.scenes.usd.cameras import View, moves
from steadylight.scenes.usd.lux import BLENDERS_POLE
from steadylight.scenes.world import camera_axes, chosen, keyframe, listed, rolls

_KINDS: Final = ("PERSP", "ORTHO")


def notes_of(facts: dict[str, Any]) -> list[Note]:
    """The notes of the exporting program."""
    return [Note(kind, where, text) for kind, where, text in facts["notes"]]


def environment(facts: dict[str, Any], folder: Path) -> dict[str, Any] | None:
    """The emitter of Blender's world; None if it is dark."""
    world = facts["world"]
    if world is None:
        return None
    if isinstance(world, list):
        return {"type": "constant", "radiance": rgb(world)} if any(world) else None
    image = read_exr(folder / world)
    if not np.ptp(image, axis=(0, 1)).any():
        return {"type": "constant", "radiance": rgb(image[0, 0].tolist())} if image.any() else None
    turned = np.eye(4)
    turned[:3, :3] = BLENDERS_POLE
    return {"type": "envmap", "data": image, "to_world": turned}


def view(path: Path, facts: dict[str, Any], wanted: str | None) -> tuple[View | None, list[Note]]:
    """The view of the camera with a name or number (from 1), or of the scene's own camera.

    Raises:
        SceneError: the camera has impossible values.
        SettingsError: there is no such camera.
    """
    name, notes = _chosen(path, facts, wanted)
    if name is None:
        return None, notes
    samples = facts["cameras"][name]
    rate, (width, height) = float(facts["fps"]), facts["size"]
    try:
        poses = [_pose(sample) for sample in samples]
        level = not any(rolls(matrix) for matrix, _ in poses)
        keys = [keyframe(i / rate, matrix, fov, level=level) for i, (matrix, fov) in enumerate(poses)]
        camera = CameraPath(tuple(keys if moves(keys) else keys[:1]))
    except CameraError as error:
        raise SceneError(f"{path}: camera {name}: {error}") from None
    sensor = _sensor(samples[0])
    if any(sample.get("lens") != samples[0].get("lens") for sample in samples):
        notes.append(Note("approximated", name, "its focus and aperture stay as in the first frame"))
    if any(not np.allclose(_shift(sample), _shift(samples[0]), atol=1e-4) for sample in samples):
        notes.append(Note("approximated", name, "the shift of its lens stays as in the first frame"))
    return View(camera, sensor, int(width), int(height), camera.frame_count(rate), rate), notes


def _chosen(path: Path, facts: dict[str, Any], wanted: str | None) -> tuple[str | None, list[Note]]:
    """Name of a camera; None if there is none that can be used."""
    usable = [name for name, samples in facts["cameras"].items() if samples[0]["kind"] in _KINDS]
    if wanted is not None:
        return usable[chosen(path, wanted, [(name,) for name in usable])], []
    if facts["camera"] in usable:
        return facts["camera"], []
    if not usable:
        return None, []
    text = f"the scene has no active camera that can be used; the first of {listed(usable)} is used"
    return usable[0], [Note("warning", "cameras", text)]


def _pose(sample: dict[str, Any]) -> tuple[Any, float]:
    """Camera-to-world matrix with our axes, and the horizontal field of view in degrees."""
    matrix = np.array(sample["to_world"], dtype=np.float64)
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise CameraError("its transform has no inverse")
    left, right, *_ = sample["window"]
    fov = math.degrees(2 * math.atan((right - left) / 2)) if sample["kind"] == "PERSP" else 45.0
    return camera_axes(matrix), fov


def _shift(sample: dict[str, Any]) -> tuple[float, float]:
    """Offset of the middle of the picture from the axis, as fractions of its width and height."""
    left, right, low, high = sample["window"]
    return (left + right) / 2 / (right - left), (low + high) / 2 / (high - low)


def _sensor(sample: dict[str, Any]) -> dict[str, Any]:
    """Mitsuba's sensor, without pose and field of view."""
    left, right, *_ = sample["window"]
    near, far = sample["clip"]
    sensor: dict[str, Any] = {"type": "perspective", "near_clip": near, "far_clip": far}
    if sample["kind"] == "ORTHO":
        half = (right - left) / 2
        return sensor | {"type": "orthographic", "scale": [half, half, 1.0]}
    if "lens" in sample and min(sample["lens"]) > 0:
        radius, focus = sample["lens"]
        sensor |= {"type": "thinlens", "aperture_radius": radius, "focus_distance": focus}
    x, y = _shift(sample)
    if max(abs(x), abs(y)) > 1e-6 and sensor["type"] == "perspective":
        sensor |= {"principal_point_offset_x": x, "principal_point_offset_y": -y}
    return sensor
