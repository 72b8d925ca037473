"""PLY files as triangles: polygons of any size, and texture coordinates per vertex or per corner.

Blender writes polygons with any number of corners. MeshLab and Metashape write a second list for each face, with the
texture coordinates of its corners. None of Mitsuba, trimesh and meshio reads both, and the licence of plyfile does not
fit.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.polygons import has_direction, triangulate, with_directions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_SHORT_NAMES: Final = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
_LONG_NAMES: Final = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
_KINDS: Final = {
    name: np.dtype(long).str[1:]
    for short, long in zip(_SHORT_NAMES, _LONG_NAMES, strict=True)
    for name in (short, long)
}
"""NumPy's names of the types, by both of PLY's names."""
_FORMATS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_SHORT: Final = "it ends before all the data that its header declares"
_CORNERS: Final = ("vertex_indices", "vertex_index")
_UV: Final = (("u", "v"), ("texture_u", "texture_v"), ("s", "t"))
_TRIANGLE: Final = 3
"""Number of corners."""
_COLORS: Final = (("r", "g", "b"), ("red", "green", "blue"))
_PICTURE: Final = re.compile(r"comment\s+TextureFile\s+(.+)", re.IGNORECASE)


class _Property(NamedTuple):
    """A column of an element; `length` is the type of a list's length, or empty for a single number."""

    name: str
    length: str
    kind: str


class _Element(NamedTuple):
    """A table of the file: its rows and columns."""

    name: str
    rows: int
    properties: list[_Property]


class _Column(NamedTuple):
    """Values of one property, (C,), and the number of them in each row, (N,)."""

    values: NDArray[Any]
    counts: Integers

    def as_type(self, kind: str) -> _Column:
        """The same numbers in another type."""
        with np.errstate(invalid="ignore", over="ignore"):
            return _Column(self.values.astype(kind), self.counts)


@dataclass(frozen=True)
class PlyMesh:
    """The triangles of a PLY file.

    Attributes:
        vertices: (V, 3) positions.
        faces: (F, 3) indices of vertices.
        normals: (V, 3), or None; normals without a direction are replaced by that of the adjacent faces.
        uv: (V, 2), v upward from the bottom of the image; or None.
        corner_uv: (F, 3, 2) the same for each corner of a face; or None.
        colors: (V, 3), numbers as in the file; or None.
        pictures: names of the images that the file's header refers to.
        mended: whether normals without a direction were replaced, with which Mitsuba would shade to NaN.
        plain: whether Mitsuba reads the file correctly by itself.
    """

    vertices: Floats
    faces: Integers
    normals: Floats | None
    uv: Floats | None
    corner_uv: Floats | None
    colors: NDArray[Any] | None
    pictures: tuple[str, ...]
    mended: bool
    plain: bool


def read_ply(path: Path) -> PlyMesh:
    """Read a PLY file.

    Raises:
        SceneError: it cannot be read, is damaged, or has no triangles.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None
    try:
        return _mesh(data)
    except MemoryError:
        raise SceneError(f"{path}: needs more memory than is available") from None
    except (ValueError, OverflowError) as error:
        raise SceneError(f"{path}: is not a valid PLY file: {error}") from None


def write_plain(path: Path, mesh: PlyMesh) -> None:
    """Write triangles in a form that Mitsuba reads, without texture coordinates per corner."""
    parts = [("x y z", mesh.vertices)]
    for names, values in (("nx ny nz", mesh.normals), ("u v", mesh.uv), ("r g b", mesh.colors)):
        if values is not None:
            parts.append((names, values))
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    head += [f"property float {name}" for names, _ in parts for name in names.split()]
    head += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = _TRIANGLE, mesh.faces
    vertices = np.concatenate([values for _, values in parts], axis=1).astype("<f4")
    path.write_bytes("\n".join(head).encode() + vertices.tobytes() + rows.tobytes())


def _mesh(data: bytes) -> PlyMesh:
    """The triangles of a file.

    Raises:
        ValueError: the file is damaged; the message says how.
    """
    order, elements, remarks, start = _header(data)
    source = _Source(memoryview(data)[start:], order)
    tables = {element.name: source.table(element) for element in elements}
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    points = _stacked(vertex, ("x", "y", "z"))
    name = next((name for name in _CORNERS if name in face), None)
    if points is None or name is None or not len(face[name].values):
        raise ValueError("it has no vertices with x, y and z, or no faces with vertex_indices")
    corners, counts = face[name].values.astype(np.int64), face[name].counts
    wrong = corners[(corners < 0) | (corners >= len(points))]
    if len(wrong):
        raise ValueError(f"a face refers to vertex {wrong[0]}, but there are {len(points)} vertices")
    triangles, _ = triangulate(counts, corners, points)
    if not len(triangles):
        raise ValueError("it has no triangles")
    flat = face.get("texcoord")
    by_corner = flat is not None and bool((flat.counts == 2 * counts).all())
    uv = next((found for pair in _UV if (found := _stacked(vertex, pair)) is not None), None)
    colors = next((found for three in _COLORS if (found := _stacked(vertex, three)) is not None), None)
    lists = [column for each in elements for column in each.properties if column.length]
    normals, faces, mended = _stacked(vertex, ("nx", "ny", "nz")), corners[triangles], False
    if normals is not None:
        mended = not has_direction(normals).all()
        normals = with_directions(normals, faces, points) if mended else normals
    return PlyMesh(
        vertices=points.astype(np.float64),
        faces=faces,
        normals=normals,
        uv=None if by_corner else uv,
        corner_uv=flat.values.reshape(-1, 2)[triangles] if flat is not None and by_corner else None,
        colors=colors,
        pictures=tuple(match[1].strip() for line in remarks if (match := _PICTURE.match(line))),
        mended=mended,
        plain=len(lists) == 1
        and not mended
        and bool((counts == _TRIANGLE).all())
        and not any(line.startswith("obj_info") for line in remarks),
    )


def _stacked(table: dict[str, _Column], names: Sequence[str]) -> NDArray[Any] | None:
    """Columns of single numbers side by side, (N, len(names)); None if one is missing."""
    if any(name not in table for name in names):
        return None
    return np.stack([table[name].values for name in names], axis=1)


def _header(data: bytes) -> tuple[str, list[_Element], list[str], int]:
    """Byte order, tables, `comment` and `obj_info` lines, and the offset at which the tables begin."""
    last = data.find(b"\nend_header")
    end = data.find(b"\n", last + 1)
    if not data.startswith((b"ply\n", b"ply\r\n")) or last < 0 or end < 0:
        raise ValueError("it does not begin with a PLY header")
    order: str | None = None
    elements: list[_Element] = []
    remarks: list[str] = []
    for line in data[:last].decode("utf-8", "replace").split("\n")[1:]:
        words = line.split()
        match words:
            case []:
                pass
            case ["comment" | "obj_info", *_]:
                remarks.append(line.strip())
            case ["format", kind, _] if kind in _FORMATS:
                order = _FORMATS[kind]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_KINDS):
                elements[-1].properties.append(_Property(name, _KINDS[length], _KINDS[kind]))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].properties.append(_Property(name, "", _KINDS[kind]))
            case _:
                raise ValueError(f"its header has an invalid line, {line[:80]!r}")
    if order is None:
        raise ValueError("its header has no format")
    return order, elements, remarks, end + 1


class _Source:
    """Reads tables one after the other. A text file is first converted to doubles, and then to its own types."""

    def __init__(self, data: memoryview, order: str) -> None:
        self.order = order
        self.at = 0
        self.data = data if order else memoryview(np.array(bytes(data).split(), np.float64).tobytes())

    def table(self, element: _Element) -> dict[str, _Column]:
        """The columns of the next table."""
        if not element.properties or not element.rows:
            empty = _Column(np.zeros(0), np.zeros(0, np.int64))
            return {each.name: empty for each in element.properties}
        if element.rows > len(self.data):
            raise ValueError(_SHORT)
        columns = self._even(element) or self._uneven(element)
        return {
            each.name: column if self.order else column.as_type(each.kind)
            for each, column in zip(element.properties, columns, strict=True)
        }

    def _dtype(self, kind: str) -> np.dtype[Any]:
        return np.dtype(self.order + kind if self.order else "f8")

    def _number(self, at: int, dtype: np.dtype[Any]) -> int:
        """Read one number."""
        if at + dtype.itemsize > len(self.data):
            raise ValueError(_SHORT)
        return int(np.frombuffer(self.data, dtype, 1, at)[0])

    def _even(self, element: _Element) -> list[_Column] | None:
        """The columns if all rows have lists of the same lengths as the first row; otherwise None."""
        places: list[tuple[int, np.dtype[Any], int, bool]] = []
        width = 0
        for each in element.properties:
            count = 1
            if each.length:
                length = self._dtype(each.length)
                count = self._number(self.at + width, length)
                places.append((width, length, 1, True))
                width += length.itemsize
            dtype = self._dtype(each.kind)
            places.append((width, dtype, count, False))
            width += max(count, 0) * dtype.itemsize
        end = self.at + element.rows * width
        if end > len(self.data) or min(count for _, _, count, _ in places) < 0:
            return None
        columns = []
        for number, (offset, dtype, count, is_length) in enumerate(places):
            values = np.ndarray(
                (element.rows, count), dtype, self.data, self.at + offset, (width, dtype.itemsize)
            )
            if is_length and (values != places[number + 1][2]).any():
                return None
            if not is_length:
                columns.append(_Column(values.ravel(), np.full(element.rows, count, np.int64)))
        self.at = end
        return columns

    def _uneven(self, element: _Element) -> list[_Column]:
        """The columns with lists of any length, row by row."""
        starts, counts = np.zeros((2, len(element.properties), element.rows), np.int64)
        types = [(self._dtype(each.length or "u1"), self._dtype(each.kind)) for each in element.properties]
        at = self.at
        for row in range(element.rows):
            for column, each in enumerate(element.properties):
                length, dtype = types[column]
                count = 1
                if each.length:
                    count = self._number(at, length)
                    at += length.itemsize
                if not 0 <= count <= len(self.data) - at:
                    raise ValueError(_SHORT)
                starts[column, row], counts[column, row] = at, count
                at += count * dtype.itemsize
        if at > len(self.data):
            raise ValueError(_SHORT)
        self.at = at
        return [
            self._gathered(*column)
            for column in zip(starts, counts, [kind for _, kind in types], strict=True)
        ]

    def _gathered(self, starts: Integers, counts: Integers, dtype: np.dtype[Any]) -> _Column:
        """The values of lists that begin at given offsets."""
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        first = np.repeat(starts, counts) + within * dtype.itemsize
        found = np.frombuffer(self.data, np.uint8)[first[:, None] + np.arange(dtype.itemsize)]
        return _Column(np.ascontiguousarray(found).view(dtype)[:, 0], counts)
