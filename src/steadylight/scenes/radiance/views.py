"""Radiance's view files (`.vf`): one view, or a sequence of them, as a camera path."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, SceneError
from steadylight.scenes.radiance.grammar import read_text

_NUMBERS = {
    "-vp": 3,
    "-vd": 3,
    "-vu": 3,
    "-vh": 1,
    "-vv": 1,
    "-vs": 1,
    "-vl": 1,
    "-vo": 1,
    "-va": 1,
}
_DEFAULTS: dict[str, tuple[float, ...]] = {
    "-vp": (0, 0, 0),
    "-vd": (0, 1, 0),
    "-vu": (0, 0, 1),
    "-vh": (45,),
    "-vv": (45,),
}
_WIDTH = 1280
_FPS = 25.0
_LOWEST, _HIGHEST = 0.05, 20.0
_RIGHT = "it needs a line such as `rvu -vtv -vp 0 0 1.6 -vd 0 1 0 -vu 0 0 1 -vh 60 -vv 40`"


@dataclass(frozen=True)
class Views:
    """What a view file says.

    Attributes:
        camera: one keyframe for each view, a frame apart.
        frames: number of views.
        width: of the image, pixels.
        height: of the image, pixels, as the angles of the first view want it.
    """

    camera: CameraPath
    frames: int
    width: int
    height: int

    @property
    def fields(self) -> dict[str, Any]:
        """As fields of a scene description."""
        return {
            "camera": self.camera,
            "frames": self.frames,
            "fps": _FPS,
            "width": self.width,
            "height": self.height,
        }


def views_beside(path: Path) -> Views | None:
    """The view file next to a scene (`office.vf` next to `office.rad`), if there is one."""
    file = path.with_suffix(".vf")
    return read_views(file) if file.is_file() else None


def read_views(file: Path) -> Views:
    """Read a view file. As in Radiance, what a line leaves out is as in the line before.

    Raises:
        SceneError: it has no view, or one that is not a perspective.
    """
    values = dict(_DEFAULTS)
    keys: list[Keyframe] = []
    height = 0
    for number, line in enumerate(read_text(file).splitlines(), 1):
        words = line.replace("VIEW=", "VIEW= ", 1).split()
        if not any(word.startswith("-v") for word in words):
            continue
        place = f"{file}: line {number}"
        try:
            words = shlex.split(line.replace("VIEW=", "VIEW= ", 1))
            values |= _options(words, place)
            origin, direction = np.array(values["-vp"]), np.array(values["-vd"])
            keys.append(
                Keyframe(
                    len(keys) / _FPS,
                    tuple(origin.tolist()),
                    tuple((origin + direction / np.linalg.norm(direction)).tolist()),
                    tuple(values["-vu"]),  # type: ignore[arg-type]
                    values["-vh"][0],
                )
            )
        except (ValueError, CameraError) as error:
            raise SceneError(f"{place}: contains no usable view ({error}); {_RIGHT}") from None
        height = height or _height(values)
    if not keys:
        raise SceneError(f"{file}: contains no usable view; {_RIGHT}")
    return Views(CameraPath(tuple(keys)), len(keys), _WIDTH, height)


def _options(words: list[str], place: str) -> dict[str, tuple[float, ...]]:
    """The options of one line that count.

    Raises:
        ValueError: a number is missing, or is none.
        SceneError: the view is not a perspective.
    """
    found: dict[str, tuple[float, ...]] = {}
    at = 0
    while at < len(words):
        word = words[at]
        count = _NUMBERS.get(word, 0)
        if word.startswith("-vt") and word != "-vtv":
            raise SceneError(f"{place}: view type {word} is not supported; only perspective views (-vtv) are")
        if count:
            numbers = tuple(float(number) for number in words[at + 1 : at + 1 + count])
            if len(numbers) < count or not all(map(math.isfinite, numbers)):
                raise ValueError(f"{word} takes {count} numbers")
            if word in ("-vs", "-vl") and numbers[0]:
                raise SceneError(f"{place}: shifted views ({word} {numbers[0]:g}) are not supported; use 0")
            if word == "-vd" and not any(numbers):
                raise ValueError("-vd is zero")
            found[word] = numbers
        at += 1 + count
    return found


def _height(values: dict[str, tuple[float, ...]]) -> int:
    """Height of an image of the usual width, pixels."""
    half = [math.tan(math.radians(values[option][0]) / 2) for option in ("-vh", "-vv")]
    if not (half[0] > 0 and _LOWEST < half[1] / half[0] < _HIGHEST):
        raise ValueError(f"-vh {values['-vh'][0]:g} and -vv {values['-vv'][0]:g} make no image")
    return max(2, 2 * round(_WIDTH * half[1] / half[0] / 2))
