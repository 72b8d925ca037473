"""Octrees and meshes that a scene refers to: their content, transformed as the scene says.

A frozen octree contains its primitives in binary form; any other one names the files that it was made from. A compiled
mesh (.rtm) is read from the Wavefront file next to it, from which `obj2mesh` made it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from steadylight.errors import SceneError
from steadylight.scenes.radiance.commands import DEEPEST, Expansion
from steadylight.scenes.radiance.grammar import VOID, Primitive
from steadylight.scenes.radiance.modifiers import Surface, surfaces_of
from steadylight.scenes.radiance.surfaces import Triangles, fault

_MAGIC: Final = 283
_EMPTY, _FULL, _TREE = 0, 1, 2
_PROBE = Primitive(VOID, "polygon", "probe", (), (0.0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1))


def octree_primitives(path: Path, expansion: Expansion, depth: int = 0) -> list[Primitive]:
    """The primitives of an octree.

    Raises:
        SceneError: the file is not an octree, is truncated, or names files that cannot be read.
    """
    octree = _Octree.open(path)
    try:
        files, found = octree.read()
    except (IndexError, OverflowError):
        raise _broken(path) from None
    expansion.counted(found, str(path))
    for name in files:
        found += expansion.named(name, str(path), depth + 1)
    return found


def octree_sources(path: Path) -> list[str]:
    """Names of the files that an octree was made from, which Radiance's programs read again; none if it is frozen.

    Raises:
        SceneError: it was made from the output of a command, which they would run again; or the file is not an octree.
    """
    octree = _Octree.open(path)
    try:
        return octree.files()[1]
    except (IndexError, OverflowError):
        raise _broken(path) from None


def _broken(path: Path) -> SceneError:
    return SceneError(f"{path}: is not a complete octree; make it again with `oconv`")


def expanded(surfaces: Sequence[Surface], expansion: Expansion, depth: int = 0) -> list[Surface]:
    """Surfaces, with each `instance` replaced by the surfaces of its octree."""
    result: list[Surface] = []
    for surface in surfaces:
        given = surface.primitive
        if given.kind != "instance":
            result.append(surface)
            continue
        if depth == DEEPEST:
            raise fault(given, "is nested in too many octrees")
        if not given.words:
            raise fault(given, "names no octree")
        path = expansion.found(given.words[0], given.place)
        inner = expansion.moved(octree_primitives(path, expansion, depth), given.words[1:], given.place)
        members = expanded(surfaces_of(inner), expansion, depth + 1)
        result += [
            each if each.modifier is not None else replace(each, modifier=surface.modifier)
            for each in members
            if each.primitive.kind != "source"
        ]
    return result


def mesh_triangles(given: Primitive, expansion: Expansion) -> Triangles:
    """The triangles of a `mesh`.

    Raises:
        SceneError: there is no Wavefront file next to it, or the file is not valid.
    """
    if not given.words:
        raise fault(given, "names no file")
    file = expansion.found(given.words[0], given.place, missing=True).with_suffix(".obj")
    expansion.check_named(str(file), given.place)
    if not file.is_file():
        raise fault(
            given, f"needs {file.name} beside {given.words[0]}: compiled meshes are read from the .obj file"
        )
    import trimesh

    try:
        with file.open("rb") as stream:
            mesh = trimesh.load(
                stream, file_type="obj", process=False, maintain_order=True, force="mesh", skip_materials=True
            )
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # noqa: BLE001 - whatever its parser meets in a damaged file
        raise fault(given, f"needs {file}, which is not a valid OBJ file: {error}") from None
    if not len(faces) or not np.isfinite(vertices).all():
        raise fault(given, f"needs {file}, which has no triangles, or vertices that are not finite")
    (moved,) = expansion.moved([_PROBE], given.words[1:], given.place)
    corners = np.array(moved.numbers).reshape(4, 3)
    matrix = (corners[1:] - corners[0]).T
    faces = faces[:, ::-1] if np.linalg.det(matrix) < 0 else faces
    return Triangles(vertices @ matrix.T + corners[0], faces)


class _Octree:
    """Reads Radiance's portable binary format: big-endian integers, null-terminated strings."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at = data, path, 0

    @classmethod
    def open(cls, path: Path) -> _Octree:
        """Open the octree in a file."""
        try:
            return cls(path.read_bytes(), path)
        except OSError as error:
            raise SceneError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None

    def read(self) -> tuple[list[str], list[Primitive]]:
        """The files that it was made from, and its primitives; one of the two is empty, depending on `oconv -f`."""
        size, files = self.files()
        self._integer(size)
        self._skip_tree(size)
        return files, [] if files else self._objects(size)

    def files(self) -> tuple[int, list[str]]:
        """Size of an object number in bytes, and the files that the octree was made from: none if it is frozen."""
        end = self.data.find(b"\n\n")
        if not self.data.startswith(b"#?RADIANCE") or end < 0 or b"Radiance_octree" not in self.data[:end]:
            raise SceneError(f"{self.path}: is not a Radiance octree")
        self.at = end + 2
        size = self._integer(2) - _MAGIC
        if not 0 < size <= 8:
            raise SceneError(
                f"{self.path}: is an octree of another version of Radiance; make it again with `oconv`"
            )
        for _ in range(4):
            self._text()
        files = []
        while name := self._text():
            if name.lstrip().startswith("!"):
                raise SceneError(
                    f"{self.path}: was made from the output of a command; freeze it with `oconv -f`"
                )
            files.append(name)
        return size, files

    def _integer(self, size: int) -> int:
        if self.at + size > len(self.data):
            raise IndexError
        number = int.from_bytes(self.data[self.at : self.at + size], "big", signed=True)
        self.at += size
        return number

    def _text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise IndexError
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def _number(self) -> float:
        mantissa = self._integer(4)
        exponent = self._integer(1)
        if mantissa == 0:
            return 0.0
        return math.ldexp((mantissa + math.copysign(0.5, mantissa)) / 0x7FFFFFFF, exponent)

    def _skip_tree(self, size: int) -> None:
        pending = 1
        while pending:
            pending -= 1
            kind = self._integer(1)
            if kind == _TREE:
                pending += 8
            elif kind == _FULL:
                count = self._integer(size)
                if count < 0:
                    raise IndexError
                self.at += count * size
            elif kind != _EMPTY:
                raise IndexError

    def _objects(self, size: int) -> list[Primitive]:
        kinds = []
        while kind := self._text():
            kinds.append(kind)
        found: list[Primitive] = []
        names: list[str] = []
        taken: set[str] = set()
        while (kind_number := self._integer(1)) >= 0:
            modifier = self._integer(size)
            name = self._text()
            words = tuple(self._text() for _ in range(self._integer(2)))
            numbers = tuple(self._number() for _ in range(self._integer(2)))
            top = VOID if modifier < 0 else names[modifier]
            kind = kinds[kind_number]
            if kind == "alias" and not words:
                top, words = VOID, (top,)
            name = f"{name} {len(names)}" if name in taken else name  # octrees refer to modifiers by number
            taken.add(name)
            found.append(Primitive(top, kind, name, words, numbers, f"{self.path}: object {len(names) + 1}"))
            names.append(name)
        return found
