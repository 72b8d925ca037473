"""Radiance view files: one view per line and frame, with the options `-vp`, `-vd`, `-vu` and `-vh` of `rpict`.

As with `rpict -S`, a view inherits missing options from the view before it.
"""

from __future__ import annotations

from typing import Final

from steadylight.camera.keyframes import DEFAULT_FPS
from steadylight.camera.path import CameraPath, Keyframe
from steadylight.camera.rows import MOST_ROWS, finite
from steadylight.errors import CameraError

_NUMBERS: Final = {
    "-vp": 3, "-vd": 3, "-vu": 3, "-vh": 1, "-vv": 1, "-vo": 1, "-va": 1, "-vs": 1, "-vl": 1
}  # fmt: skip
"""Options of a view, and the number of values of each."""

_START: Final = {"-vd": [0.0, 1.0, 0.0], "-vu": [0.0, 0.0, 1.0], "-vh": [45.0]}
"""Radiance's defaults for missing options."""

_TYPES: Final = {
    "l": "a parallel projection", "a": "an angular fisheye", "h": "a hemispherical fisheye",
    "s": "a planispheric fisheye", "c": "a cylindrical panorama",
}  # fmt: skip


def read(text: str, first_frame: int | None) -> tuple[CameraPath, float | None]:
    """The path from the text of a view file; see `files.load_camera`. A single view is a still."""
    del first_frame  # a view has no number of its own
    views = read_views(text)
    if len(views) > MOST_ROWS:
        raise CameraError(f"has more than {MOST_ROWS:,} views; keep, for example, every second one")
    return CameraPath(tuple(views)), None if len(views) == 1 else DEFAULT_FPS


def read_views(text: str) -> list[Keyframe]:
    """The views of a file, as keyframes one frame apart at 25 frames per second.

    Raises:
        CameraError: there is no view, or a line has one that is not valid or not a perspective view.
    """
    state: dict[str, list[float]] = dict(_START)
    views: list[Keyframe] = []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split("#", 1)[0].replace("VIEW=", " VIEW= ").split()
        first = next((at for at, word in enumerate(words) if word.startswith("-v")), None)
        if first is None:
            continue
        try:
            state |= _options(words[first:])
            views.append(_keyframe(state, len(views) / DEFAULT_FPS))
        except CameraError as error:
            raise CameraError(f"line {number}: {error}") from None
    if not views:
        raise CameraError(
            "has no view; a view is a line such as `rvu -vtv -vp 0 0 1.6 -vd 0 1 0 -vu 0 0 1 -vh 60`"
        )
    return views


def _options(words: list[str]) -> dict[str, list[float]]:
    """The options of a view with their values; options of other programs are ignored."""
    found: dict[str, list[float]] = {}
    at = 0
    while at < len(words):
        word = words[at]
        at += 1
        if word in _NUMBERS:
            given = words[at : at + _NUMBERS[word]]
            if len(given) < _NUMBERS[word]:
                raise CameraError(f"`{word}` needs {_NUMBERS[word]} numbers, and has {len(given)}")
            found[word] = [finite(each, word) for each in given]
            at += len(given)
        elif word.startswith("-vt"):
            if word != "-vtv":
                kind = _TYPES.get(word[3:], "a view of unknown type")
                raise CameraError(f"`{word}` is {kind}; only perspective views (-vtv) are supported")
        elif word == "-vf":
            raise CameraError("`-vf` names another file; give that file as the camera")
    return found


def _keyframe(state: dict[str, list[float]], time: float) -> Keyframe:
    if "-vp" not in state:
        raise CameraError("`-vp`, the position of the camera, is missing")
    for option in ("-vs", "-vl"):
        if state.get(option, [0.0]) != [0.0]:
            raise CameraError(f"`{option}` shifts the image, which is not supported; leave it out")
    x, y, z = state["-vp"]
    (fov,) = state["-vh"]
    a, b, c = (place + way for place, way in zip(state["-vp"], state["-vd"], strict=True))
    up_x, up_y, up_z = state["-vu"]
    return Keyframe(time, (x, y, z), (a, b, c), (up_x, up_y, up_z), fov)
