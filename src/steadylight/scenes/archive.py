"""A scene as one file, as it travels to workers: compressed, with equal meshes and files in it once.

A zip archive with the pickled description, whose equal arrays are one (Chong, Sourin & Levinski 2006 hash duplicate
objects for the same reason), and, for machines that share no file system, the files that the scene refers to, named by
the hash of their content.
"""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from steadylight.errors import SceneError, StorageError
from steadylight.scenes.description import SceneDescription

_DESCRIPTION: Final = "description.pickle"
_FILES: Final = "files/"
_LEVEL: Final = 1
"""Of deflate: higher ones take three times as long for some per cent."""


def write_archive(path: Path, scene: SceneDescription, *, with_files: bool) -> None:
    """Write a scene to a file.

    Args:
        path: of the archive.
        scene: what to write.
        with_files: whether the files that the scene refers to go with it; else readers must see them where they are.

    Raises:
        SceneError: one of the files is not what it was when the scene was read.
    """
    arrays: dict[tuple[str, tuple[int, ...], bytes], Any] = {}

    def once(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        content = np.ascontiguousarray(value)
        return arrays.setdefault((value.dtype.str, value.shape, hashlib.sha256(content.data).digest()), value)

    slim = dataclasses.replace(scene, content=_mapped(scene.content, once))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
        archive.writestr(_DESCRIPTION, pickle.dumps(slim, protocol=5))
        if with_files:
            check_files(scene)
            for digest, name in {digest: name for name, digest in scene.files.items()}.items():
                archive.write(name, f"{_FILES}{digest}{Path(name).suffix}")


def read_archive(path: Path) -> SceneDescription:
    """The scene of an archive; files that it brings are unpacked beside it, and the scene refers to these.

    Args:
        path: of an archive of our own making: it holds a pickle, which may be any code.

    Raises:
        SceneError: it cannot be read, or a file that the scene refers to has changed.
        StorageError: such a file cannot be read here.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            scene: SceneDescription = pickle.loads(archive.read(_DESCRIPTION))  # noqa: S301 - see above
            brought = [name for name in archive.namelist() if name.startswith(_FILES)]
            folder = path.with_suffix("")
            archive.extractall(folder, brought)
    except (OSError, zipfile.BadZipFile, KeyError, pickle.UnpicklingError, EOFError) as error:
        raise SceneError(f"{path}: the scene cannot be read ({error}); run the same command again") from error
    here = {Path(name).stem: str((folder / name).resolve()) for name in brought}
    moved = {name: here.get(digest, name) for name, digest in scene.files.items()}
    if brought:
        content = _mapped(
            scene.content, lambda value: moved.get(value, value) if isinstance(value, str) else value
        )
        files = {moved[name]: digest for name, digest in scene.files.items()}
        scene = dataclasses.replace(scene, content=content, files=files)
    check_files(scene)
    return scene


def check_files(scene: SceneDescription) -> None:
    """See that the files that a scene refers to are what they were when it was read.

    Raises:
        SceneError: one is not; the frames of one animation must not show two scenes.
        StorageError: one cannot be read here, which another machine may well do.
    """
    for name, expected in scene.files.items():
        try:
            with Path(name).open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise StorageError(
                f"{name}: of scene {scene.name}, cannot be read on this machine ({error})"
            ) from error
        if digest != expected:
            raise SceneError(
                f"{name}: of scene {scene.name}, has changed since the run began; put the old one back, or choose "
                "another output for the new scene"
            )


def _mapped(value: Any, change: Callable[[Any], Any]) -> Any:
    """Plain data with every leaf changed."""
    if isinstance(value, Mapping):
        return {key: _mapped(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_mapped(item, change) for item in value)
    return change(value)
