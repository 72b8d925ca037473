"""Keyframe files: TOML or JSON, written by people and by `steadylight walk`.

Keys of the file: `keyframes`, a list of at least two; `fps`, frames per second; `loop`, see `CameraPath`; `up` and
`fov`, defaults for keyframes without them; `first_frame`, the number that the file gives to its first frame (1). Keys
of a keyframe: `time` in seconds or `frame` (at the file's fps, or 25); `origin`, `target`; `up`, `fov`.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, Final

from steadylight.camera.path import CameraPath, Keyframe
from steadylight.camera.values import LARGEST, checked_number, kind_of
from steadylight.errors import CameraError

DEFAULT_FPS: Final = 25.0
"""Frames per second of a file that counts frames but does not give a rate."""

_FILE_KEYS = ("keyframes", "fps", "loop", "up", "fov", "first_frame")
_KEYFRAME_KEYS = ("time", "frame", "origin", "target", "up", "fov")


def read_toml(text: str, first_frame: int | None) -> tuple[CameraPath, float | None]:
    """The path from the text of a TOML file; see `files.load_camera`."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CameraError(f"is not valid TOML: {error}") from None
    except (RecursionError, ValueError) as error:
        raise CameraError(_unusual(error)) from None
    return _path_from(content, first_frame, "`first_frame = {}` at the top of the file")


def read_json(text: str, first_frame: int | None) -> tuple[CameraPath, float | None]:
    """The path from the text of a JSON file; see `files.load_camera`."""
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise CameraError(
            f"is not valid JSON: {error.msg} (at line {error.lineno}, column {error.colno})"
        ) from None
    except (RecursionError, ValueError) as error:
        raise CameraError(_unusual(error)) from None
    return _path_from(content, first_frame, '`"first_frame": {}` beside `keyframes`')


def toml_of(path: CameraPath, fps: float, made_by: str) -> str:
    """A TOML file with the keyframes of a path.

    Args:
        path: what to write.
        fps: frames per second.
        made_by: the command, for a comment.
    """
    first = path.keyframes[0]
    printable = "".join(letter if letter.isprintable() else "?" for letter in made_by)
    encoded = printable.encode("utf-8", "replace").decode()
    lines = [f"# {encoded}", f"fps = {fps:g}", f"up = {_listed(first.up)}", f"fov = {first.fov:.6g}"]
    if path.loop:
        lines.append("loop = true")
    for key in path.keyframes:
        lines += ["", "[[keyframes]]", f"time = {key.time:.6g}"]
        lines += [f"origin = {_listed(key.origin)}", f"target = {_listed(key.target)}"]
        lines += [f"up = {_listed(key.up)}"] * (key.up != first.up)
        lines += [f"fov = {key.fov:.6g}"] * (key.fov != first.fov)
    return "\n".join(lines) + "\n"


def _listed(point: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:.7g}' for value in point)}]"


def frame_time(frame: int, first_frame: int | None, fps: float, remedy: str) -> float:
    """Seconds from the start of the path to a frame of a file.

    Args:
        frame: frame number in the file.
        first_frame: number of the first frame, if known.
        fps: frames per second.
        remedy: for messages: what to write into the file, with `{}` for the number of the first frame.

    Raises:
        CameraError: the frame is before the first one.
    """
    first = 1 if first_frame is None else first_frame
    if abs(frame) > LARGEST or abs(first) > LARGEST:
        raise CameraError(f"`frame` must be within {LARGEST:g} of 0; no animation is that long")
    if frame >= first:
        return (frame - first) / fps
    if frame == 0 and first_frame is None:
        raise CameraError(
            "`frame` is 0: this file counts its frames from 0, steadylight counts from 1; write "
            f"{remedy.format(0)}, or give --first-frame 0"
        )
    raise CameraError(
        f"`frame` is {frame}, before the first frame, {first}; write {remedy.format(frame)}, or give --first-frame "
        f"{frame}, if {frame} is the first"
    )


def checked_first_frame(value: Any) -> int:
    """A whole number."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise CameraError(f"`first_frame` must be a whole number, such as 0, not {kind_of(value)}")
    return value


def checked_fps(value: Any) -> float:
    """Frames per second."""
    fps = checked_number("fps", value)
    if fps <= 0:
        raise CameraError(f"`fps` is {fps:g}; it must be greater than 0")
    return fps


def _unusual(error: Exception) -> str:
    """Message about text on which a parser fails unexpectedly."""
    if isinstance(error, RecursionError):
        return "is nested too deeply; a camera file is a list of keyframes"
    return f"has a value that cannot be read: {error}"


def _path_from(content: Any, first_frame: int | None, remedy: str) -> tuple[CameraPath, float | None]:
    """The path from a parsed file."""
    _check_keys(content, _FILE_KEYS, "the file")
    if "keyframes" not in content:
        raise CameraError("`keyframes` is missing: a list of at least two keyframes")
    entries = content["keyframes"]
    if not isinstance(entries, list):
        raise CameraError(f"`keyframes` must be a list of keyframes, not {kind_of(entries)}")
    if len(entries) < 2:
        raise CameraError(
            f"has {len(entries)} keyframe{'s' * (not entries)}; a camera path needs at least two"
        )
    loop = content.get("loop", False)
    if not isinstance(loop, bool):
        raise CameraError(f"`loop` must be true or false, not {kind_of(loop)}")
    fps = checked_fps(content["fps"]) if "fps" in content else None
    if first_frame is None and "first_frame" in content:
        first_frame = checked_first_frame(content["first_frame"])
    defaults = {key: content[key] for key in ("up", "fov") if key in content}
    if any(isinstance(entry, Mapping) and "frame" in entry for entry in entries):
        fps = fps or DEFAULT_FPS
    keyframes = []
    for number, entry in enumerate(entries, start=1):
        try:
            values = {**defaults, **_timed(entry, fps or DEFAULT_FPS, first_frame, remedy)}
            keyframes.append(Keyframe(**values))
        except CameraError as error:
            raise CameraError(f"keyframe {number}: {error}") from None
    return CameraPath(tuple(keyframes), loop), fps


def _timed(entry: Any, fps: float, first_frame: int | None, remedy: str) -> dict[str, Any]:
    """The values of one keyframe, with its time instead of a frame number."""
    _check_keys(entry, _KEYFRAME_KEYS, "a keyframe")
    missing = [f"`{key}`" for key in ("origin", "target") if key not in entry]
    if not {"time", "frame"} & entry.keys():
        missing.insert(0, "`time` (seconds) or `frame` (counted from 1)")
    if missing:
        raise CameraError(
            f"{' and '.join(missing)} missing; every keyframe needs {'them' if len(missing) > 1 else 'one'}"
        )
    if {"time", "frame"} <= entry.keys():
        raise CameraError("has both `time` and `frame`; give one of them")
    values = dict(entry)
    if "frame" in values:
        frame = values.pop("frame")
        if isinstance(frame, bool) or not isinstance(frame, int):
            raise CameraError(f"`frame` is {frame!r}; it must be a whole number, counted from 1")
        values["time"] = frame_time(frame, first_frame, fps, remedy)
    return values


def _check_keys(table: Any, valid: Sequence[str], what: str) -> None:
    """Raise if `table` is not a table, or has unknown keys."""
    if not isinstance(table, Mapping):
        raise CameraError(f"{what} must be a table of keys and values, not {kind_of(table)}")
    for key in table:
        if key not in valid:
            near = difflib.get_close_matches(key, valid, n=1)
            hint = f"; did you mean `{near[0]}`?" if near else ";"
            raise CameraError(f"`{key}` is not a valid key{hint} valid keys: {', '.join(valid)}")
