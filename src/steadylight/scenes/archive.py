"""A scene as one file for the workers: compressed, without duplicate meshes and files.

A zip archive with the pickled description, in which equal arrays are stored once (as Chong, Sourin & Levinski 2006 do
for duplicate objects), and the images in the description. For machines without a shared file system, it also contains
the files that the scene refers to, named by the hash of their content. Equal scenes give equal bytes. Images that are
compressed already are stored unchanged.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import pickle
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from steadylight.atomic_file import atomic_write, storage_errors
from steadylight.errors import SceneError, StorageError
from steadylight.scenes.description import SceneDescription

_DESCRIPTION: Final = "description.pickle"
_IMAGES: Final = "images/"
_FILES: Final = "files/"
_MEMBER: Final = re.compile(r"files/[0-9a-f]{64}(\.[^/\\]*)?")
_LEVEL: Final = 1
"""Deflate level; higher ones take three times as long and save only a few per cent."""
_COMPRESSED: Final = (b"\x89PNG", b"\xff\xd8\xff", b"RIFF", b"\x76\x2f\x31\x01")
"""First bytes of PNG, JPEG, WebP and OpenEXR files, which deflate hardly shrinks."""
_ARRAYS: Final = frozenset(
    {
        ("numpy", "dtype"),
        ("numpy", "ndarray"),
        ("numpy._core.numeric", "_frombuffer"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
    }
)
"""Module and name of everything that pickled arrays call."""
_DESCRIPTIONS: Final = ("steadylight.scenes.description", "steadylight.camera.")
"""Modules with the classes that a description consists of; all of them hold plain data."""


class _Unpickler(pickle.Unpickler):
    """Reads descriptions, and never runs other code, whoever wrote the archive."""

    def find_class(self, module: str, name: str) -> Any:
        """The class or function that the pickle asks for, if descriptions use it."""
        found = super().find_class(module, name) if module.startswith(_DESCRIPTIONS) else None
        # Only classes that are defined in the module: what it imports could open files.
        if isinstance(found, type) and (found.__module__, found.__qualname__) == (module, name):
            return found
        if (module, name) in _ARRAYS:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not part of a scene")


def write_archive(path: Path, scene: SceneDescription, *, with_files: bool) -> None:
    """Write a scene to a file.

    Args:
        path: path of the archive.
        scene: what to write.
        with_files: whether to include the files that the scene refers to; otherwise readers need them at the same path.

    Raises:
        SceneError: one of the files has changed since the scene was read.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in _described(scene).items():
            _add(archive, member, content)
        if with_files:
            check_files(scene)
            for member, name in _members(scene).items():
                _add(archive, member, Path(name).read_bytes())


def _add(archive: zipfile.ZipFile, member: str, content: bytes | memoryview) -> None:
    """Write a member without a time stamp, so that equal scenes give equal bytes."""
    stored = bytes(content[:4]).startswith(_COMPRESSED)
    kind = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
    archive.writestr(zipfile.ZipInfo(member), content, kind, compresslevel=_LEVEL)


def is_archive_of(path: Path, scene: SceneDescription, *, with_files: bool) -> bool:
    """Whether a file is intact and holds exactly what `write_archive` would write; nothing in it is executed.

    Args:
        path: path of the file, which may be missing, damaged, or from somebody else.
        scene: what it should hold.
        with_files: as for `write_archive`.
    """
    if path.is_symlink():
        return False
    digests = {member: hashlib.sha256(content).hexdigest() for member, content in _described(scene).items()}
    if with_files:
        digests |= {member: Path(member).stem for member in _members(scene)}
    try:
        with zipfile.ZipFile(path) as archive:
            if sorted(archive.namelist()) != sorted(digests):
                return False
            for member, digest in digests.items():
                with archive.open(member) as file:
                    if hashlib.file_digest(file, "sha256").hexdigest() != digest:  # type: ignore[arg-type]
                        return False
    except Exception:  # noqa: BLE001 - whatever a damaged archive raises, it is not the one
        return False
    return True


def read_archive(path: Path) -> SceneDescription:
    """Read a scene from an archive; included files are unpacked next to it, and the scene refers to them.

    Args:
        path: path of the archive. Its pickle may only contain plain data. Files that the scene names are read.

    Raises:
        SceneError: the archive cannot be read, contains something that no scene does, or a file that the scene refers
            to has changed.
        StorageError: such a file cannot be read on this machine.
    """
    folder = path.with_suffix("")
    try:
        with zipfile.ZipFile(path) as archive:
            count = sum(name.startswith(_IMAGES) for name in archive.namelist())
            images = [archive.read(f"{_IMAGES}{number}") for number in range(count)]
            scene: SceneDescription = _Unpickler(
                io.BytesIO(archive.read(_DESCRIPTION)), buffers=images
            ).load()
            brought = [name for name in archive.namelist() if _MEMBER.fullmatch(name)]
            _unpack(archive, brought, folder)
    except StorageError:
        raise
    except Exception as error:
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


def _described(scene: SceneDescription) -> dict[str, bytes | memoryview]:
    """Archive members with the description itself, in which equal arrays are stored once, and with its images."""
    arrays: dict[tuple[str, tuple[int, ...], bytes], Any] = {}

    def once(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        content = np.ascontiguousarray(value)
        return arrays.setdefault((value.dtype.str, value.shape, hashlib.sha256(content.data).digest()), value)

    images: list[memoryview] = []

    def stays(buffer: pickle.PickleBuffer) -> bool:
        """Whether the bytes of an array stay in the pickle."""
        content = buffer.raw()
        if not bytes(content[:4]).startswith(_COMPRESSED):
            return True
        images.append(content)
        return False

    unique = dataclasses.replace(scene, content=_mapped(scene.content, once))
    pickled = pickle.dumps(unique, protocol=5, buffer_callback=stays)
    return {_DESCRIPTION: pickled} | {f"{_IMAGES}{number}": image for number, image in enumerate(images)}


def _members(scene: SceneDescription) -> dict[str, str]:
    """The files that a scene refers to, by name in the archive."""
    return {f"{_FILES}{digest}{Path(name).suffix}": name for name, digest in scene.files.items()}


def _unpack(archive: zipfile.ZipFile, members: list[str], folder: Path) -> None:
    """Write files of an archive into a folder, never through links.

    Raises:
        StorageError: the folder is a link, or a file cannot be written.
    """
    for place in (folder, folder / _FILES) if members else ():
        if place.is_symlink():
            raise StorageError(f"{place}: is a symbolic link; remove it, then run the same command again")
        with storage_errors(place):
            place.mkdir(exist_ok=True)
    for member in members:
        with (
            archive.open(member) as file,
            atomic_write(folder / member) as temporary,
            temporary.open("wb") as out,
        ):
            shutil.copyfileobj(file, out)


def check_files(scene: SceneDescription) -> None:
    """Check that the files that a scene refers to have not changed since it was read.

    Raises:
        SceneError: a file has changed; all frames of an animation must show the same scene.
        StorageError: a file cannot be read on this machine; another machine may succeed.
    """
    for name, expected in scene.files.items():
        try:
            with Path(name).open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise StorageError(
                f"{name} (scene {scene.name}) cannot be read on this machine ({error})"
            ) from error
        if digest != expected:
            raise SceneError(
                f"{name} (scene {scene.name}) has changed since the run began; restore the old file, or "
                "choose another output"
            )


def _mapped(value: Any, change: Callable[[Any], Any]) -> Any:
    """Plain data with `change` applied to every leaf."""
    if isinstance(value, Mapping):
        return {key: _mapped(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_mapped(item, change) for item in value)
    return change(value)
