"""Camera: keyframes become one smooth pose per frame, and frames are selected for the first pass.

`path` and `curve` hold the path, `files` reads it, `selection` chooses frames.
"""

from __future__ import annotations

from steadylight.camera.files import load_camera
from steadylight.camera.path import CameraPath, Keyframe, Pose
from steadylight.camera.selection import change_measure, select_frames

__all__ = ["CameraPath", "Keyframe", "Pose", "change_measure", "load_camera", "select_frames"]
