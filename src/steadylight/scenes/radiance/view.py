"""The camera of Radiance's scenes: the view file next to them, or a view of the whole scene."""

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
        scene: path of the scene; each view in the file next to it (`office.vf` for `office.rad`) is one frame.
        low: (3,) lower corner of the scene.
        high: (3,) upper corner.

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
