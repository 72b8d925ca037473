"""The camera of Radiance's scenes: the view file beside them, or a view of the whole scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from steadylight.camera import CameraPath, load_camera
from steadylight.errors import CameraError, SceneError
from steadylight.scenes.world import view_from_outside


def view_of(scene: Path, low: ArrayLike, high: ArrayLike) -> dict[str, Any]:
    """Camera and frames, as fields of a scene description.

    Args:
        scene: its file; views beside it (`office.vf` for `office.rad`) are one frame each.
        low: lower corner of the scene, (3,).
        high: upper corner, (3,).

    Raises:
        SceneError: there is a view file, but no usable view in it.
    """
    file = scene.with_suffix(".vf")
    if not file.is_file():
        return {"camera": CameraPath((view_from_outside(low, high),))}
    try:
        path, fps = load_camera(file)
    except CameraError as error:
        raise SceneError(str(error)) from None
    return {"camera": path} if fps is None else {"camera": path, "frames": path.frame_count(fps), "fps": fps}
