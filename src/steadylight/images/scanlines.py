"""Checks that the pixels of a scan-line EXR file are complete, before OpenEXR reads them.

Layout: magic, version, attributes (name, type, size, value) up to an empty name, a table of the offsets of all chunks,
then the chunks (first row, size, data).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Final

if TYPE_CHECKING:
    from pathlib import Path

FINGERPRINT: Final = "steadylight:pixels"
"""Attribute of the files that `write_exr` writes: a hash of the pixels."""

_MAGIC: Final = 20000630
_OTHER_LAYOUTS: Final = 0x1A00
"""Bits of the version field that mark tiled, deep and multi-part files."""

_ROWS: Final = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""Rows per chunk, by compression number."""

_FORMS: Final = {
    b"channels": (b"chlist", None),
    b"compression": (b"compression", 1),
    b"dataWindow": (b"box2i", 16),
    b"displayWindow": (b"box2i", 16),
}
"""Type and size of the attributes that determine how pixels are read."""

_ORDERS: Final = (b"\0", b"\1", b"\2")
_ZIP: Final = (2, 3)
_BYTES: Final = {0: 4, 1: 2, 2: 4}
"""Bytes of a sample, by pixel type: integer, half float, float."""


def fault_in(path: Path, *, header_only: bool = False) -> str:
    """What is wrong with a file, as a clause after "it is"; empty if nothing is.

    Tiled, deep and multi-part files are not checked, and chunks are unpacked only if their compression is ZIP.

    Args:
        path: the file.
        header_only: do not read the content of the chunks.

    Raises:
        ValueError: not an EXR file, or it ends within header or offset table.
    """
    with path.open("rb") as file:
        header = _header(file)
        if header is None:
            return ""
        table = file.read(8 * header.chunks)
        if len(table) < 8 * header.chunks:
            raise ValueError("it is truncated within the offset table")
        offsets = struct.unpack(f"<{header.chunks}Q", table)
        size, complete = path.stat().st_size, _end_of(file, max(offsets, default=0))
        if complete > size:
            return f"truncated: {size} of {complete} bytes"
        if not header_only and not all(_is_whole(file, header, k, place) for k, place in enumerate(offsets)):
            return "damaged: its pixels cannot be decoded"
    return ""


@dataclass(frozen=True)
class _Header:
    """The parts of a header that determine the size of the chunks.

    Attributes:
        compression: number of the compression.
        top: first row.
        bottom: last row.
        row: bytes of a row; 0 if channels are subsampled.
    """

    compression: int
    top: int
    bottom: int
    row: int

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return max(0, -(-(self.bottom - self.top + 1) // _ROWS[self.compression]))


def _header(file: BinaryIO) -> _Header | None:
    """Read the header, up to the offset table; None for other layouts and unknown compression."""
    magic, version = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if magic != _MAGIC:
        raise ValueError("it has no EXR magic number")
    if version & _OTHER_LAYOUTS:
        return None
    attributes: dict[bytes, bytes] = {}
    while name := _read_name(file):
        kind = _read_name(file)
        (size,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        attributes[name] = file.read(size)
        if len(attributes[name]) < size:
            raise ValueError("it is truncated within the header")
        own_kind, own_size = _FORMS.get(name, (kind, None))
        if kind != own_kind or size != (own_size or size):
            raise ValueError("its header is damaged")
    window, compression = attributes.get(b"dataWindow"), attributes.get(b"compression")
    if window is None or compression is None or attributes.get(b"lineOrder") not in _ORDERS:
        raise ValueError("its header is damaged")
    left, top, right, bottom = struct.unpack("<4i", window)
    pixel = _pixel(attributes.get(b"channels", b""))
    if FINGERPRINT.encode() in attributes and not (pixel and compression[0] in _ZIP):
        raise ValueError("its header is damaged")
    known = compression[0] in _ROWS
    return _Header(compression[0], top, bottom, (right - left + 1) * pixel) if known else None


def _pixel(channels: bytes) -> int:
    """Bytes per pixel, from the list of channels; 0 if some are subsampled, or the list is not understood."""
    total, rest = 0, channels
    while rest.strip(b"\0"):
        name, _, rest = rest.partition(b"\0")
        name.decode()  # raises a ValueError, where OpenEXR prints
        if len(rest) < 16:
            return 0
        kind, _, across, down = struct.unpack("<4i", rest[:16])
        if kind not in _BYTES or (across, down) != (1, 1):
            return 0
        total, rest = total + _BYTES[kind], rest[16:]
    return total


def _end_of(file: BinaryIO, place: int) -> int:
    """Offset of the end of a chunk."""
    file.seek(min(place + 4, 2**62))
    (size,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
    return int(place + 8 + size)


def _is_whole(file: BinaryIO, header: _Header, number: int, place: int) -> bool:
    """Whether a chunk is the one expected at its place in the table, and unpacks to the right size."""
    rows = _ROWS[header.compression]
    first = header.top + number * rows
    file.seek(min(place, 2**62))
    row, size = struct.unpack("<iI", file.read(8).ljust(8, b"\0"))
    whole = min(rows, header.bottom - first + 1) * header.row
    if place == 0 or row != first or size == 0:
        return False
    if (
        header.compression not in _ZIP or whole <= 0 or size == whole
    ):  # chunks that do not shrink are stored uncompressed
        return True
    unpacking = zlib.decompressobj()
    try:
        unpacked = len(unpacking.decompress(file.read(size), whole + 1))
    except zlib.error:
        return False
    return size < whole and unpacked == whole and unpacking.eof and not unpacking.unused_data


def _read_name(file: BinaryIO) -> bytes:
    """A null-terminated name in the header."""
    name = b""
    while (letter := file.read(1)) != b"\0":
        if not letter or len(name) > 255:
            raise ValueError("it is truncated within the header")
        name += letter
    return name
