"""File names as scenes give them, some of them written where capital letters and slashes matter less."""

from __future__ import annotations

import unicodedata
from pathlib import Path, PurePath


def named(folder: Path, name: str) -> Path:
    r"""The path of a file that a scene names, which need not exist.

    Windows separates folders by backslashes. Windows and macOS also find `wood.JPG` by the name `wood.jpg`, and an ö in
    one code point by an ö in two. So do we, for each part of the name that nothing has exactly and one entry of its
    folder has but for that.

    Args:
        folder: what relative names are relative to.
        name: such as `textures\wood.jpg`.

    Raises:
        OSError: the name is too long, or a folder cannot be read.
        ValueError: it contains a null character.
    """
    exact = folder / name
    if exact.exists():
        return exact
    written = name.replace("\\", "/")
    found = folder
    for part in PurePath(written).parts:
        if not (found / part).exists() and found.is_dir():
            alike = [entry for entry in found.iterdir() if _plain(entry.name) == _plain(part)]
            found = alike[0] if len(alike) == 1 else found / part
        else:
            found /= part
    return found if found.exists() else folder / written


def _plain(name: str) -> str:
    """What names have in common that differ in capital letters or code points only."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
