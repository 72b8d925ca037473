"""Camera files."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from steadylight.camera.path import CameraPath, Keyframe
from steadylight.camera.values import checked_number, kind_of
from steadylight.errors import CameraError

_DEFAULT_FPS = 25.0
_FILE_KEYS = ("keyframes", "fps", "loop", "up", "fov")
_KEYFRAME_KEYS = ("time", "frame", "origin", "target", "up", "fov")


def load_camera(path: Path) -> tuple[CameraPath, float | None]:
    """Read a camera path from a TOML or JSON file (by its suffix, `.toml` or `.json`).

    Keys of the file: `keyframes`, a list of at least two; `fps`, frames per second; `loop`, see `CameraPath`;
    `up` and `fov`, defaults for keyframes without. Keys of a keyframe: `time` in seconds or `frame` counted
    from 1 (at the file's fps, or 25); `origin`, `target`; `up`, `fov`.

    Returns:
        The path, and the frames per second that the file gives or its frame numbers imply, or None.

    Raises:
        CameraError: the message names the file, the keyframe, the fault and the remedy.
    """
    content = _parse(path)
    try:
        return _path_from(content)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None


def _parse(path: Path) -> Any:
    """Parse the file to plain data; read and syntax errors become CameraError."""
    if path.suffix.lower() not in (".toml", ".json"):
        raise CameraError(f"{path}: a camera file must end in .toml or .json")
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    except FileNotFoundError:
        raise CameraError(f"{path}: no such camera file") from None
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise CameraError(f"{path}: is not UTF-8 text (byte {error.start})") from None
    except tomllib.TOMLDecodeError as error:
        raise CameraError(f"{path}: is not valid TOML: {error}") from None
    except RecursionError:
        raise CameraError(f"{path}: is nested too deeply; a camera file is a list of keyframes") from None
    except json.JSONDecodeError as error:
        raise CameraError(
            f"{path}: is not valid JSON: {error.msg} (at line {error.lineno}, column {error.colno})"
        ) from None


def _path_from(content: Any) -> tuple[CameraPath, float | None]:
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
    fps = checked_number("fps", content["fps"]) if "fps" in content else None
    if fps is not None and fps <= 0:
        raise CameraError(f"`fps` is {fps:g}; it must be greater than 0")
    defaults = {key: content[key] for key in ("up", "fov") if key in content}
    if any(isinstance(entry, Mapping) and "frame" in entry for entry in entries):
        fps = fps or _DEFAULT_FPS
    keyframes = []
    for number, entry in enumerate(entries, start=1):
        try:
            keyframes.append(_keyframe_from(entry, defaults, fps))
        except CameraError as error:
            raise CameraError(f"keyframe {number}: {error}") from None
    return CameraPath(tuple(keyframes), loop), fps


def _keyframe_from(entry: Any, defaults: Mapping[str, Any], fps: float | None) -> Keyframe:
    """One keyframe from its table."""
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
    values = {**defaults, **entry}
    if "frame" in values:
        frame = values.pop("frame")
        if isinstance(frame, bool) or not isinstance(frame, int) or frame < 1:
            raise CameraError(f"`frame` is {frame!r}; it must be a whole number, counted from 1")
        values["time"] = (frame - 1) / (fps or _DEFAULT_FPS)
    return Keyframe(**values)


def _check_keys(table: Any, valid: Sequence[str], what: str) -> None:
    """Reject anything but a table, and unknown keys."""
    if not isinstance(table, Mapping):
        raise CameraError(f"{what} must be a table of keys and values, not {kind_of(table)}")
    for key in table:
        if key not in valid:
            near = difflib.get_close_matches(key, valid, n=1)
            hint = f"; did you mean `{near[0]}`?" if near else ";"
            raise CameraError(f"`{key}` is not a valid key{hint} valid keys: {', '.join(valid)}")
