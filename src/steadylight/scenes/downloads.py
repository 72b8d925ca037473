"""Detects files that exist, but whose content was not downloaded."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_POINTER = b"version https://git-lfs.github.com/spec/"
_SAID = {
    b"": "is empty; download it again",
    _POINTER: "is a Git LFS pointer instead of the file itself; run `git lfs pull` in its repository",
}


def lacking(file: Path, *, may_be_empty: bool = False) -> str | None:
    """What is wrong with a file without its real content, and what to do.

    A repository cloned without Git Large File Storage has pointers of three lines in place of scenes, meshes and
    pictures.

    Args:
        file: a file of a scene.
        may_be_empty: whether to accept an empty file, because its reader reports what is wrong.

    Returns:
        A clause; None if the file has content, or cannot be read, which its reader reports.
    """
    try:
        with file.open("rb") as stream:
            begin = stream.read(len(_POINTER))
    except OSError:
        return None
    return None if may_be_empty and not begin else _SAID.get(begin)
