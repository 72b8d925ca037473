"""Cameras of a glTF scene: which one is used, and its path.

A moving camera is sampled once per frame: what its curves do between frames is not visible at this frame rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import CameraPath
from steadylight.errors import CameraError
from steadylight.scenes.description import Note
from steadylight.scenes.gltf.curves import Curve
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.tree import Tree
from steadylight.scenes.world import Z_UP, camera_axes, chosen, keyframe, listed, rolls

Array = NDArray[np.float64]

LARGER_SIDE: Final = 1280
"""Pixels on the larger side of the picture: glTF only gives its aspect ratio."""

_ASPECT: Final = 16 / 9
_RATES: Final = (
    25.0,
    24.0,
    30.0,
    60.0,
    50.0,
    48.0,
    20.0,
    15.0,
    12.0,
    10.0,
    120.0,
    100.0,
    24000 / 1001,
    30000 / 1001,
)
_DENSE: Final = 1.5
"""Maximum distance of the closest keys, in frames, at which a frame rate is inferred from them."""

_MOST_FRAMES: Final = 99_999


@dataclass(frozen=True)
class View:
    """The part of a description that comes from a camera.

    Attributes:
        camera: camera path.
        sensor: type and other properties.
        width: image width, pixels.
        height: image height, pixels.
        frames: number of frames of the path.
        fps: frames per second.
        notes: notes on what was converted.
    """

    camera: CameraPath
    sensor: dict[str, Any]
    width: int
    height: int
    frames: int
    fps: float
    notes: tuple[Note, ...]


def view_of(file: File, tree: Tree, wanted: str | None) -> View | None:
    """The view of a camera of the scene; None if the scene has no camera and none is requested.

    Args:
        file: the scene.
        tree: nodes of the scene.
        wanted: name of a camera or of its node, or its number, counted from 1; the first if None.

    Raises:
        SettingsError: there is no such camera.
        SceneError: the camera is not valid.
    """
    nodes = tree.among(index for index, node in enumerate(file.document.nodes) if node.camera is not None)
    names = [_names(file, tree, index) for index in nodes]
    notes: list[Note] = []
    if wanted is None:
        if not nodes:
            return None
        number = 0
        if len(nodes) > 1:
            text = f"of {listed([name[0] for name in names])} the first is used; choose with --sensor"
            notes.append(Note("warning", "cameras", text))
    else:
        number = chosen(file.path, wanted, names)
    return _view(file, tree, nodes[number], notes)


def _names(file: File, tree: Tree, index: int) -> tuple[str, ...]:
    """Names of a camera: that of its node, and its own."""
    number = tree.node(index).camera
    assert number is not None
    camera = file.item("cameras", file.document.cameras, number, f"nodes[{index}].camera")
    return (tree.name(index), *([camera.name] if camera.name else []))


def _view(file: File, tree: Tree, index: int, notes: list[Note]) -> View:
    """The view of the camera at a node."""
    number = tree.node(index).camera
    assert number is not None
    camera, place = file.document.cameras[number], f"cameras[{number}]"
    lens = camera.perspective
    sensor: dict[str, Any] = {"type": "perspective"}
    aspect, yfov = _ASPECT, 1.0
    curve = tree.curves.get(("cameras", number, "yfov"))
    if camera.type == "orthographic":
        if camera.orthographic is None or not (camera.orthographic.xmag and camera.orthographic.ymag):
            raise file.fault(place, "an orthographic camera needs xmag and ymag other than zero")
        half = abs(camera.orthographic.xmag), abs(camera.orthographic.ymag)
        aspect, sensor, curve = (
            half[0] / half[1],
            {"type": "orthographic", "scale": [half[0], half[0], 1.0]},
            None,
        )
    elif lens is None:
        raise file.fault(place, "a perspective camera needs `perspective`")
    else:
        aspect, yfov = lens.aspect_ratio or _ASPECT, lens.yfov
        if lens.znear > 0:
            sensor["near_clip"] = lens.znear
    curves = tree.moving(index) + ([curve] if curve else [])
    fps = _rate(curves)
    times = _times(file, index, curves, fps)
    angles = np.full(len(times), yfov) if curve is None else curve.at(times)[:, 0]
    if not ((angles > 0) & (angles < math.pi)).all():
        raise file.fault(place, "its yfov is outside the range from 0 to pi radians")
    fovs = np.degrees(2 * np.arctan(np.tan(angles / 2) * aspect))
    path = _path(file, tree, index, times, fovs)
    if len(path.keyframes) > 1:
        text = f"moves: sampled at {len(times)} frames, {fps:g} per second"
        notes.append(Note("converted", f"camera {tree.name(index)}", text))
    width, height = (
        (LARGER_SIDE, LARGER_SIDE / aspect) if aspect >= 1 else (LARGER_SIDE * aspect, LARGER_SIDE)
    )
    return View(
        path, sensor, max(1, round(width)), max(1, round(height)), len(path.keyframes), fps, tuple(notes)
    )


def _rate(curves: list[Curve]) -> float:
    """Frames per second of an animation with keys on neighbouring frames, as exporters write them; otherwise 25."""
    times = np.unique(np.concatenate([curve.times for curve in curves])) if curves else np.zeros(1)
    relative = times - times[0]
    for rate in _RATES if len(times) > 2 else ():
        frames = relative * rate
        if np.abs(frames - np.round(frames)).max() < 0.01 and np.diff(frames).min() < _DENSE:
            return rate
    return _RATES[0]


def _times(file: File, index: int, curves: list[Curve], fps: float) -> Array:
    """Times of the frames, from the first key to the last."""
    if not curves:
        return np.zeros(1)
    start, end = min(curve.times[0] for curve in curves), max(curve.times[-1] for curve in curves)
    count = (end - start) * fps
    if not count < _MOST_FRAMES:
        raise file.fault(
            f"nodes[{index}]", f"its camera moves for {end - start:g} s, more than {_MOST_FRAMES} frames"
        )
    return np.asarray(start + np.arange(int(count + 0.01) + 1) / fps)


def _path(file: File, tree: Tree, index: int, times: Array, fovs: Array) -> CameraPath:
    """The path of a camera, with a keyframe for each frame; a still view if it does not move."""
    worlds = Z_UP @ (tree.world_at(index, times) if len(times) > 1 else tree.world(index)[None])
    sizes = np.linalg.norm(worlds[:, :3, :3], axis=1)
    if not (np.isfinite(worlds).all() and (sizes > 1e-12).all()):
        raise file.fault(
            f"nodes[{index}]", "its camera has no direction: a scale is zero, or its position is not finite"
        )
    poses = np.stack([_upright(camera_axes(world)) for world in worlds])
    if np.ptp(poses, axis=0).max() == 0 and np.ptp(fovs) == 0:
        poses, fovs = poses[:1], fovs[:1]
    level = not any(rolls(pose) for pose in poses)
    seconds = times - times[0]
    try:
        return CameraPath(
            tuple(
                keyframe(float(time), pose, float(fov), level=level)
                for time, pose, fov in zip(seconds, poses, fovs, strict=False)
            )
        )
    except CameraError as error:
        raise file.fault(f"nodes[{index}]", f"its camera: {error}") from None


def _upright(pose: Array) -> Array:
    """A pose with perpendicular, right-handed axes: shear and negative scale of parents are dropped."""
    view = pose[:3, 2]
    left = np.cross(pose[:3, 1], view)
    left /= np.linalg.norm(left)
    found = pose.copy()
    found[:3, 0], found[:3, 1] = left, np.cross(view, left)
    return found
