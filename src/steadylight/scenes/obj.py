"""Rewrites OBJ files so that Mitsuba and trimesh read them correctly.

Both split a polygon into a fan, which fills the notches of concave ones: a wall with a window in one polygon loses the
window. Mitsuba supports neither indices that count backwards nor lines of 1024 bytes, and refuses normals without a
direction: those that are not finite, and those of length zero.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.polygons import SHORTEST_NORMAL, triangulate

Floats = NDArray[np.float64]

LONGEST_LINE: Final = 1000
"""Bytes."""

_POSITION = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_POLYGON = re.compile(rb"^[ \t]*f((?:[ \t]+[^\s#]+){4,})", re.MULTILINE)
_BACKWARDS = re.compile(rb"^[ \t]*f[ \t][^\r\n#]*-\d", re.MULTILINE)
_NOT_FINITE = re.compile(rb"^[ \t]*vn[ \t][^\r\n#]*(?:nan|inf)", re.MULTILINE | re.IGNORECASE)
_ZERO: Final = rb"[ \t]+[-+]?(?:0{1,30}\.?0{0,30}|\.0{1,30})(?:e[-+]?\d{1,3})?"
_NO_LENGTH = re.compile(rb"^[ \t]*vn(?:" + _ZERO + rb"){3}(?=[\s#]|\Z)", re.MULTILINE | re.IGNORECASE)
_TRIANGLE: Final = 3
_KINDS: Final = (b"v", b"vt", b"vn")
_NAMES: Final = (b"g", b"o")
"""Statements that name groups and objects."""


def simplified(data: bytes) -> bytes | None:
    """The same mesh with triangles only and indices that count forwards; None if the file can stay as it is.

    A normal without a direction is replaced by that of a polygon that uses it. Damaged files are not repaired.

    Args:
        data: content of an OBJ file.
    """
    joined = re.sub(rb"\\\r?\n", b" ", data) if b"\\" in data else data
    lines = joined.split(b"\n")
    patterns = [_BACKWARDS, _NO_LENGTH]
    lower = joined.lower()
    if b"nan" in lower or b"inf" in lower:  # a quick test, since most files have neither
        patterns.append(_NOT_FINITE)
    must = (
        len(joined) != len(data)
        or max(map(len, lines)) >= LONGEST_LINE
        or any(pattern.search(joined) for pattern in patterns)
    )
    polygons = _POLYGON.findall(joined)
    if not must and not polygons:
        return None
    try:
        points = np.array(_POSITION.findall(joined), dtype="S").astype(np.float64).reshape(-1, 3)
        if not must and _are_fans(polygons, points):
            return None
        file = _File(lines, points)
        file.split()
    except (ValueError, IndexError, OverflowError):
        return None
    return b"\n".join(file.lines)


def _are_fans(polygons: list[bytes], points: Floats) -> bool:
    """Whether fans triangulate the polygons correctly, given the corners of each as in the file."""
    counts = np.array([len(polygon.split()) for polygon in polygons], np.int64)
    vertices = re.sub(rb"/\S*", b"", b" ".join(polygons)).split()
    triangles, owners = triangulate(counts, np.array(vertices, dtype="S").astype(np.int64) - 1, points)
    step = np.arange(len(owners)) - np.searchsorted(owners, owners)
    fan = np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    return bool((triangles - (np.cumsum(counts) - counts)[owners, None] == fan).all())


@dataclass
class _File:
    """The lines of a file, which are changed in place.

    Attributes:
        lines: lines without line ends.
        points: (V, 3) positions of all vertices.
        seen: number of lines so far, by kind (`_KINDS`).
        damaged: line numbers of the normals without a direction, by index of the normal.
        polygons: line number, corners as words, and vertices of each polygon.
    """

    lines: list[bytes]
    points: Floats
    seen: dict[bytes, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    damaged: dict[int, int] = field(default_factory=dict)
    polygons: list[tuple[int, list[bytes], list[int]]] = field(default_factory=list)

    def split(self) -> None:
        """Rewrite the polygons."""
        for number, line in enumerate(self.lines):
            words = line.split(b"#", 1)[0].split()
            if not words or (words[0] in _NAMES and len(line) >= LONGEST_LINE):
                self.lines[number] = b""
            elif words[0] in self.seen:
                self.seen[words[0]] += 1
                if words[0] == b"vn" and not _has_direction(words[1:4]):
                    self.damaged[self.seen[b"vn"]] = number
                    self.lines[number] = b"vn 0 0 1"
            elif words[0] == b"f" and len(words) <= _TRIANGLE:
                self.lines[number] = b""  # a point or a line has no surface
            elif words[0] == b"f":
                corners = [self._forwards(word) for word in words[1:]]
                vertices = [int(corner.split(b"/", 1)[0]) - 1 for corner in corners]
                self.polygons.append((number, corners, vertices))
                self._mend(corners, vertices)
        self._write()

    def _forwards(self, corner: bytes) -> bytes:
        """A corner `v/vt/vn` with indices that count from the beginning."""
        if b"-" not in corner:
            return corner
        indices = [
            b"%d" % (self.seen[kind] + 1 + int(index)) if index.startswith(b"-") else index
            for kind, index in zip(_KINDS, corner.split(b"/"), strict=False)
        ]
        return b"/".join(indices)

    def _mend(self, corners: list[bytes], vertices: list[int]) -> None:
        """Replace normals without a direction by that of a polygon that uses them."""
        for corner in corners if self.damaged else ():
            parts = corner.split(b"/")
            index = int(parts[2]) if len(parts) == _TRIANGLE and parts[2] else 0
            if index in self.damaged:
                around = self.points[vertices] - self.points[vertices[0]]
                normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
                length = np.linalg.norm(normal)
                if length > 0:
                    self.lines[self.damaged.pop(index)] = b"vn %.9g %.9g %.9g" % tuple(normal / length)

    def _write(self) -> None:
        """Replace polygons by triangles."""
        counts = np.array([len(vertices) for _, _, vertices in self.polygons], np.int64)
        indices = np.array([vertex for _, _, vertices in self.polygons for vertex in vertices], np.int64)
        if not len(counts):
            return
        if indices.min() < 0 or indices.max() >= len(self.points):
            raise IndexError
        triangles, owners = triangulate(counts, indices, self.points)
        local = triangles - (np.cumsum(counts) - counts)[owners, None]
        starts = np.searchsorted(owners, np.arange(len(counts) + 1))
        for polygon, (number, corners, _) in enumerate(self.polygons):
            split = local[starts[polygon] : starts[polygon + 1]]
            self.lines[number] = b"\n".join(b"f " + b" ".join(corners[i] for i in row) for row in split)


def _has_direction(words: list[bytes]) -> bool:
    """As `polygons.has_direction`, for a single line; anything that is not a normal is left unchanged."""
    length = math.hypot(*(float(_plain(word)) for word in words))
    return len(words) < _TRIANGLE or SHORTEST_NORMAL < length < math.inf


def _plain(word: bytes) -> bytes:
    """A number in a form that Python reads; the C library of Windows writes `-nan(ind)`."""
    return word.split(b"(", 1)[0]
