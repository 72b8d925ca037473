"""Camera files: one table of formats, and how a file of any of them becomes text and then a path."""

from __future__ import annotations

import codecs
import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from steadylight.camera import csv_poses, keyframes, radiance_views, tum_poses
from steadylight.camera.path import CameraPath
from steadylight.errors import CameraError

LARGEST_FILE: Final = 64 * 2**20
"""Maximum size of a camera file, bytes: no real path is longer."""


@dataclass(frozen=True)
class Format:
    """How a camera file becomes a path.

    Attributes:
        name: name to show.
        read: makes the path from the text of a file and the number that the file gives to its first frame (None:
            what the file says, or 1). Returns the path, and the frames per second that the file states or implies.
    """

    name: str
    read: Callable[[str, int | None], tuple[CameraPath, float | None]]


FORMATS: Final[Mapping[str, Format]] = {
    ".toml": Format("keyframes", keyframes.read_toml),
    ".json": Format("keyframes", keyframes.read_json),
    ".csv": Format("table", csv_poses.read),
    ".tsv": Format("table", csv_poses.read),
    ".txt": Format("TUM poses", tum_poses.read),
    ".tum": Format("TUM poses", tum_poses.read),
    ".vf": Format("Radiance views", radiance_views.read),
}
"""Formats of camera files, by file extension. docs/cameras.md describes them."""

_ENCODINGS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
"""Text whose first bytes name its encoding, in the order in which they are tried."""


def load_camera(path: Path, first_frame: int | None = None) -> tuple[CameraPath, float | None]:
    """Read a camera path from a file of one of `FORMATS`, by its extension.

    Args:
        path: path of the file.
        first_frame: number that the file gives to its first frame; None for what the file says, or else 1.

    Returns:
        The path, and the frames per second that the file gives or its frame numbers imply, or None.

    Raises:
        CameraError: the message names the file, the place in it, the fault and the remedy.
    """
    path = Path(path)
    known = FORMATS.get(path.suffix.lower())
    if known is None:
        raise CameraError(f"{path}: {_unknown(path.suffix)}")
    try:
        return known.read(_text(path), first_frame)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None


def _unknown(suffix: str) -> str:
    near = difflib.get_close_matches(suffix.lower(), FORMATS, n=1, cutoff=0.7)
    hint = f"; did you mean {near[0]}?" if near else ""
    kinds = ", ".join(f"{ending} ({kind.name})" for ending, kind in FORMATS.items())
    return f"does not have the extension of a camera file{hint}; camera files end in {kinds}"


def _text(path: Path) -> str:
    """The text of a file, without byte order mark and carriage returns.

    Raises:
        CameraError: it cannot be read, is too large, or is not text.
    """
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise CameraError("is not a regular file")  # a pipe might never end
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise CameraError("no such camera file") from None
    except (OSError, ValueError) as error:
        raise CameraError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > LARGEST_FILE:
        raise CameraError(f"is larger than {LARGEST_FILE >> 20} MiB, too large for a camera path")
    mark, encoding = next(
        ((mark, name) for mark, name in _ENCODINGS.items() if content.startswith(mark)), (b"", "utf-8")
    )
    content = content.removeprefix(mark)
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        before = content[: error.start].decode(encoding, "replace")
        line, column = before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1
        raise CameraError(
            f"line {line}, column {column}: is not UTF-8 text (byte 0x{content[error.start]:02x}); save the file as "
            "UTF-8"
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")
