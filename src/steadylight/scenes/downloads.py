"""Files that are there, but whose content a download did not bring."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_POINTER = b"version https://git-lfs.github.com/spec/"


def pointer(file: Path) -> str | None:
    """What to do if a file is a pointer of Git Large File Storage.

    A repository cloned without it has pointers of three lines in the place of scenes, meshes and pictures.

    Returns:
        None if it is something else, or cannot be read: its reader tells why.
    """
    if _begin(file) != _POINTER:
        return None
    return "is a pointer of Git LFS in the place of the file; run `git lfs pull` in its repository"


def lacking(file: Path) -> str | None:
    """What is wrong with a file that has no content of its own, and what to do; None as in `pointer`."""
    return "is empty; download it again" if _begin(file) == b"" else pointer(file)


def _begin(file: Path) -> bytes | None:
    """As many bytes as tell a pointer; None if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(_POINTER))
    except OSError:
        return None
