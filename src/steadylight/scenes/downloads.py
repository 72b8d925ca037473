"""Files that are there, but whose content a download did not bring."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_POINTER = b"version https://git-lfs.github.com/spec/"


def lacking(file: Path) -> str | None:
    """What is wrong with a file of which only the name was downloaded, and what to do.

    A repository cloned without Git Large File Storage has pointers of three lines in the place of meshes and pictures.

    Returns:
        None if it has a content, or cannot be read: its reader tells why.
    """
    try:
        with file.open("rb") as stream:
            begin = stream.read(len(_POINTER))
    except OSError:
        return None
    if not begin:
        return "is empty; download it again"
    if begin == _POINTER:
        return "is a pointer of Git LFS in the place of the file; run `git lfs pull` in its repository"
    return None
