"""A glTF file: its container, its document, and the bytes that it refers to.

The document is validated against `schema` before it is used. A library such as pygltflib does not validate it, so that
every use of every field would have to be checked.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import struct
import urllib.parse
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ValidationError

from steadylight.errors import SceneError
from steadylight.scenes.downloads import lacking
from steadylight.scenes.file_names import named
from steadylight.scenes.gltf.schema import HARMLESS, SUPPORTED, Accessor, BufferView, Document, Part

Bytes = NDArray[np.uint8]

MOST_VALUES: Final = 1 << 30
"""Maximum number of values in an array that the file does not store in full (zeros, or compressed): 4 GiB."""

_MAGIC, _JSON, _BINARY = b"glTF", 0x4E4F534A, 0x004E4942
_TYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SHAPES: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_FAULTS: Final = 5

Item = TypeVar("Item")


class _AnyAsset(Part):
    """Asset of any version; in some files of glTF 1, the version is a number."""

    version: Annotated[str, BeforeValidator(str)] = "2.0"


class _Versioned(Part):
    """A document of any version."""

    asset: _AnyAsset


class File:
    """An opened glTF file.

    Attributes:
        path: absolute path.
        document: content of the document.
        files: SHA-256 of the separate image files that were requested, by absolute path.
    """

    def __init__(self, path: Path, *, outside: bool = False) -> None:
        """Read and check the document.

        Args:
            path: absolute path.
            outside: whether it may refer to files outside its folder.

        Raises:
            SceneError: the message names the file, the place in it and the fault.
        """
        self.path = path
        self.files: dict[str, str] = {}
        self._outside = outside
        text, self._binary = _container(path)
        try:
            self.document = Document.model_validate_json(text)
        except ValidationError as error:
            self._check_version(_version(text))
            raise SceneError(f"{path}: {_faults(error)}") from None
        self._check_version(self.document.asset.version)
        self._check_extensions()
        self._buffers: dict[int, Bytes] = {}
        self._images: dict[int, Bytes | str] = {}
        self._arrays: dict[int, NDArray[np.float32]] = {}

    def _check_version(self, version: str) -> None:
        """Refuse versions other than 2."""
        if not version.startswith("2."):
            raise SceneError(
                f"{self.path}: is glTF {version[:9]}; only glTF 2.0 is supported: export it again"
            )

    def _check_extensions(self) -> None:
        """Refuse unsupported extensions that the scene requires."""
        missing = sorted(set(self.document.extensions_required) - SUPPORTED - HARMLESS)
        if missing:
            raise SceneError(
                f"{self.path}: requires {', '.join(missing)}, which is not supported; export the file without it"
            )

    def fault(self, place: str, text: str) -> SceneError:
        """An error about a place in the document."""
        return SceneError(f"{self.path}: {place}: {text}")

    def item(self, kind: str, items: Sequence[Item], index: int, place: str) -> Item:
        """Entry of a list in the document.

        Args:
            kind: name of the list.
            items: the list.
            index: index of the entry.
            place: where the document refers to the entry, for messages.
        """
        if index >= len(items):
            raise self.fault(place, f"refers to {kind}[{index}]; the file has {len(items)}")
        return items[index]

    def view_of(self, index: int, place: str) -> tuple[Bytes, BufferView]:
        """The bytes of a buffer view, (N,), and the view."""
        view = self.item("bufferViews", self.document.buffer_views, index, place)
        here = f"bufferViews[{index}]"
        data = self._buffer(view.buffer, here)
        end = view.byte_offset + view.byte_length
        if end > len(data):
            raise self.fault(
                here, f"ends at byte {end} of a buffer of {len(data)}; the file is damaged or truncated"
            )
        return data[view.byte_offset : end], view

    def _buffer(self, index: int, place: str) -> Bytes:
        """The bytes of a buffer, (N,)."""
        if index not in self._buffers:
            buffer = self.item("buffers", self.document.buffers, index, place)
            here = f"buffers[{index}]"
            if buffer.uri is None:
                if index or self._binary is None:
                    raise self.fault(here, "has no uri, and the file has no binary chunk for it")
                data = self._binary
            else:
                data = self._fetched(buffer.uri, here)
            if len(data) < buffer.byte_length:
                raise self.fault(
                    here, f"should have {buffer.byte_length} bytes but has {len(data)}; it is truncated"
                )
            self._buffers[index] = data
        return self._buffers[index]

    def _fetched(self, uri: str, place: str) -> Bytes:
        """The bytes of a data URI, or of a file within the scene's folder."""
        if uri.startswith("data:"):
            _, _, encoded = uri.partition(",")
            try:
                return np.frombuffer(base64.b64decode(urllib.parse.unquote(encoded)), np.uint8)
            except (binascii.Error, ValueError):
                raise self.fault(place, "is not valid base64") from None
        file = self._beside(uri, place)
        try:
            return np.fromfile(file, np.uint8)
        except OSError as error:
            raise self.fault(place, f"{file} cannot be read: {error.strerror}") from None

    def _beside(self, uri: str, place: str) -> Path:
        """A file that the scene refers to.

        Raises:
            SceneError: it does not exist, or is outside the folder of the scene.
        """
        shown = uri if len(uri) < 100 else f"{uri[:97]}..."
        parts = urllib.parse.urlsplit(uri.replace("\\", "/"))
        if parts.scheme or parts.netloc:
            raise self.fault(place, f"`{shown}` is not a file beside the scene; download it there")
        folder = self.path.parent.resolve()
        names = (urllib.parse.unquote(uri), uri)  # some exporters do not escape names
        for name in names:
            try:
                file = named(folder, name).resolve()
                if not self._outside and not file.is_relative_to(folder):
                    raise self.fault(
                        place,
                        f"`{shown}` lies outside the scene's folder {folder}; copy it there, or --allow-outside",
                    )
                if file.is_file():
                    wrong = lacking(file)
                    if wrong is not None:
                        raise self.fault(place, f"`{shown}` {wrong}")
                    return file
            except (OSError, ValueError, RuntimeError):
                continue
        raise self.fault(place, f"needs `{shown}`; no such file in {folder}")

    def image(self, index: int, place: str) -> Bytes | str:
        """The bytes of an embedded image, or the absolute path of an image file; the same object each time."""
        if index not in self._images:
            image = self.item("images", self.document.images, index, place)
            here = f"images[{index}]"
            if image.uri is not None and not image.uri.startswith("data:"):
                file = self._beside(image.uri, here)
                try:
                    with file.open("rb") as stream:
                        self.files[str(file)] = hashlib.file_digest(stream, "sha256").hexdigest()
                except OSError as error:
                    raise self.fault(here, f"{file} cannot be read: {error.strerror}") from None
                self._images[index] = str(file)
            elif image.uri is not None:
                self._images[index] = self._fetched(image.uri, here)
            elif image.buffer_view is not None:
                self._images[index] = np.array(self.view_of(image.buffer_view, here)[0])
            else:
                raise self.fault(here, "has neither uri nor bufferView")
        return self._images[index]

    def numbers(self, index: int, place: str, width: int) -> NDArray[np.float32]:
        """An accessor as (N, width) float32; normalized integers become -1 to 1 or 0 to 1.

        Raises:
            SceneError: it has another shape, or reaches beyond its buffer.
        """
        accessor = self.item("accessors", self.document.accessors, index, place)
        here = f"accessors[{index}]"
        if _SHAPES.get(accessor.type) != width:
            raise self.fault(here, f"is {accessor.type}; {place} needs {width} numbers for each element")
        if index not in self._arrays:
            values = as_numbers(self._elements(accessor, here, width), normalized=accessor.normalized)
            if not np.isfinite(values).all():
                raise self.fault(here, "has numbers that are not finite")
            self._arrays[index] = values
        return self._arrays[index]

    def indices(self, index: int, place: str) -> NDArray[np.int64]:
        """An accessor of whole numbers as (N,)."""
        accessor = self.item("accessors", self.document.accessors, index, place)
        here = f"accessors[{index}]"
        if accessor.type != "SCALAR" or accessor.component_type == 5126:
            raise self.fault(here, f"{place} needs whole numbers")
        return self._elements(accessor, here, 1)[:, 0].astype(np.int64)

    def _elements(self, accessor: Accessor, place: str, width: int) -> NDArray[Any]:
        """Elements as stored, (N, width)."""
        kind = _TYPES.get(accessor.component_type)
        if kind is None:
            raise self.fault(
                place, f"has componentType {accessor.component_type}, which glTF does not define"
            )
        dtype = np.dtype(kind)
        if accessor.buffer_view is None:
            if accessor.count * width > MOST_VALUES:
                raise self.fault(place, f"has {accessor.count:,} elements and no data; the file is damaged")
            values = np.zeros((accessor.count, width), dtype)
        else:
            values = self._strided(
                accessor.buffer_view, accessor.byte_offset, (accessor.count, width), dtype, place
            )
        if accessor.sparse is None:
            return values
        sparse = accessor.sparse
        kind = _TYPES.get(sparse.indices.component_type, "<f4")
        if kind == "<f4":
            raise self.fault(place, "sparse indices must be whole numbers")
        at = self._strided(
            sparse.indices.buffer_view, sparse.indices.byte_offset, (sparse.count, 1), np.dtype(kind), place
        )[:, 0].astype(np.int64)
        new = self._strided(
            sparse.values.buffer_view, sparse.values.byte_offset, (sparse.count, width), dtype, place
        )
        if at.size and (at.min() < 0 or at.max() >= accessor.count):
            raise self.fault(
                place, f"sparse indices go up to {at.max()}, but there are only {accessor.count} elements"
            )
        values = np.array(values)
        values[at] = new
        return values

    def _strided(
        self, view: int, offset: int, shape: tuple[int, int], dtype: np.dtype[Any], place: str
    ) -> NDArray[Any]:
        """Rows in a buffer view, without copying."""
        data, found = self.view_of(view, place)
        count, width = shape
        packed = width * dtype.itemsize
        stride = found.byte_stride or packed
        needed = offset + (count - 1) * stride + packed if count else 0
        if needed > len(data):
            raise self.fault(
                place,
                f"its {count:,} elements need {needed:,} bytes, but the view has {len(data):,}; the file is damaged",
            )
        if not count:
            return np.zeros(shape, dtype)
        rows = np.lib.stride_tricks.as_strided(data[offset:], (count, packed), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(dtype).reshape(shape)


def as_numbers(raw: NDArray[Any], *, normalized: bool) -> NDArray[np.float32]:
    """Stored values as float32; normalized integers become -1 to 1 or 0 to 1."""
    values = raw.astype(np.float32)
    if not normalized or raw.dtype.kind not in "iu":
        return values
    return np.asarray(np.maximum(values / np.float32(np.iinfo(raw.dtype).max), np.float32(-1)))


def _container(path: Path) -> tuple[bytes, Bytes | None]:
    """Text of the document, and the binary chunk of a GLB file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise SceneError(f"{path}: no such scene file") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    if data.startswith(_MAGIC):
        return _chunks(path, data)
    if path.suffix.lower() == ".glb":
        raise SceneError(f"{path}: is not a GLB file: it does not begin with `glTF`")
    return data.removeprefix(b"\xef\xbb\xbf"), None


def _chunks(path: Path, data: bytes) -> tuple[bytes, Bytes | None]:
    """The first chunk of a GLB file, which is JSON, and the second, which is binary and may be absent."""
    if len(data) < 20:
        raise SceneError(f"{path}: is truncated: a GLB file has a header of 20 bytes")
    _, version, length, size, kind = struct.unpack_from("<4sIIII", data)
    if version != 2:
        raise SceneError(f"{path}: is GLB version {version}; only version 2 is supported: export it again")
    if length > len(data):
        raise SceneError(f"{path}: is truncated: its header says {length} bytes, but it has {len(data)}")
    if kind != _JSON or 20 + size > len(data):
        raise SceneError(
            f"{path}: its first chunk must be JSON of at most {len(data) - 20} bytes; the file is damaged"
        )
    # Chunks begin at multiples of four, but some writers do not pad them.
    for start in (20 + (size + 3) // 4 * 4, 20 + size):
        if start + 8 <= len(data):
            size_binary, kind = struct.unpack_from("<II", data, start)
            if kind == _BINARY:
                break
    else:
        return data[20 : 20 + size], None
    if start + 8 + size_binary > len(data):
        raise SceneError(f"{path}: its binary chunk is truncated")
    return data[20 : 20 + size], np.frombuffer(data, np.uint8, size_binary, start + 8)


def _version(text: bytes) -> str:
    """Version of a document that is not valid; 2.0 if unknown."""
    try:
        return _Versioned.model_validate_json(text).asset.version
    except ValidationError:
        return "2.0"


def _faults(error: ValidationError) -> str:
    """Pydantic's errors, place first: `nodes[3].mesh: ...`."""
    lines = []
    for finding in error.errors(include_url=False)[:_MOST_FAULTS]:
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in finding["loc"])
        if finding["type"] == "json_invalid":
            lines.append(f"is not valid JSON: {finding['msg'].removeprefix('Invalid JSON: ')}")
        else:
            given = finding["input"]
            shown = "" if isinstance(given, dict | list) else f" ({str(given)[:40]!r})"
            lines.append(f"{place.removeprefix('.') or 'the document'}{shown}: {finding['msg'].lower()}")
    more = error.error_count() - len(lines)
    return "; ".join(lines) + (f"; and {more} more" if more > 0 else "")
