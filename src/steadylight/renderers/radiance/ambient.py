"""Radiance's ambient files: read, written and checked byte by byte.

The layout of RADIANCE 6 (`src/rt/ambio.c`): a header of text lines, an empty line, the two-byte magic number 561,
then records without padding, all big-endian. A record has its level (1 byte), weight, position (3), normal, direction
of its first axis, radii along both axes (2), gradients by translation (2) and rotation (2) along them, the directions
that are blocked nearby (32 bits), and its irradiance over pi as RGBE. A number is a mantissa of four bytes and an
exponent of one, a direction a code of four bytes. That makes 67 bytes in RGB; with more spectral samples (`NCOMP` in
the header) it is more.

Radiance reads a file without any warning even if it was made with other options or for another scene. The header
therefore has lines of our own (`STEADYLIGHT=`), which Radiance ignores. They hold hashes of the scene and the options,
and a checksum of the records.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import CacheFileError

MAGIC: Final = 561
COMPONENTS: Final = 3
"""Number of spectral components, unless the header specifies it."""

_FIRST = "#?RADIANCE"
_FORMAT = "FORMAT=Radiance_ambval"
_OWN = "STEADYLIGHT= "
_CLEAN = "STEADYLIGHT_CLEAN= "
_DATES = ("CAPDATE=", "GMT=")
_SPLIT = 100
"""Ranges of frames per header line: Radiance's own programs read lines of limited length."""

_FLOAT = 5
_MANTISSA = 0x7FFFFFFF
_DIRECTION_SCALE = 11584.5  # (2^13 - 1/2) sqrt(2), of Radiance's `dircode.c`
_AXES = np.array([[1, 0, 2], [0, 1, 2], [1, 2, 0], [0, 2, 1]])

Records = NDArray[Any]
"""Records in file layout: a structured array of `record_type`."""

Vectors = NDArray[np.float64]


def record_type(components: int = COMPONENTS) -> np.dtype[Any]:
    """The layout of a record with this number of spectral components."""
    return np.dtype(
        [
            ("level", "u1"),
            ("weight", "u1", _FLOAT),
            ("position", "u1", (3, _FLOAT)),
            ("normal", ">u4"),
            ("axis", ">u4"),
            ("radius", "u1", (2, _FLOAT)),
            ("position_gradient", "u1", (2, _FLOAT)),
            ("direction_gradient", "u1", (2, _FLOAT)),
            ("corral", ">u4"),
            ("value", "u1", components + 1),
        ]
    )


@dataclass(frozen=True)
class Origin:
    """Scene, octree and options that the records of a file were made with; stored in a header line of our own.

    Attributes:
        scene: hash of the scene description.
        octree: hash of the octree.
        options: of the programs.
    """

    scene: str
    octree: str
    options: str

    @property
    def line(self) -> str:
        """The header line, with the options by their hash."""
        digest = hashlib.sha256(self.options.encode()).hexdigest()[:16]
        return f"scene={self.scene} octree={self.octree} options={digest}"


@dataclass(frozen=True)
class AmbientFile:
    """An ambient file.

    Attributes:
        header: its lines, without our own and those with a date.
        records: in file layout.
        origin: our header line, as text; empty if steadylight did not write the file.
        clean: numbers of the frames that were found to need no further record.
    """

    header: tuple[str, ...]
    records: Records
    origin: str = ""
    clean: frozenset[int] = field(default_factory=frozenset)

    @property
    def scene(self) -> str:
        """Hash of the scene; empty if unknown."""
        match = re.search(r"scene=(\S+)", self.origin)
        return match[1] if match else ""

    @property
    def accuracy(self) -> float:
        """`-aa` of the command that made the file; Radiance's default if unknown."""
        match = re.search(r"^\S+ .*-aa (\S+)", "\n".join(self.header), re.MULTILINE)
        return float(match[1]) if match else 0.2

    def with_records(self, records: Records) -> AmbientFile:
        """The same header with other records."""
        return replace(self, records=records)


def encode_ambient(ambient: AmbientFile) -> bytes:
    """The bytes of an ambient file, in Radiance's format."""
    head = [line for line in ambient.header if line != _FORMAT]
    if ambient.origin:
        head.append(f"{_OWN}{ambient.origin} records={_checksum(ambient.records)}")
        ranges = _ranges(ambient.clean)
        head += [_CLEAN + ",".join(ranges[i : i + _SPLIT]) for i in range(0, len(ranges), _SPLIT)]
    text = "\n".join([*head, _FORMAT, "", ""])
    return text.encode() + MAGIC.to_bytes(2, "big") + ambient.records.tobytes()


def read_ambient(path: Path, *, scene_hash: str | None = None) -> AmbientFile:
    """Read an ambient file.

        path: of the file.
        scene_hash: of the scene that it must belong to; if given, the checksum is verified too.

    Raises:
        CacheFileError: it is not an ambient file, of unknown layout, truncated, modified, or of another scene.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CacheFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    end = content.find(b"\n\n")
    lines = content[: max(end, 0)].decode("utf-8", errors="replace").split("\n")
    if lines[0] != _FIRST or _FORMAT not in lines:
        raise CacheFileError(f"{path}: is not a Radiance ambient file")
    body = content[end + 2 :]
    magic = int.from_bytes(body[:2], "big")
    if len(body) < 2 or magic != MAGIC:
        raise CacheFileError(
            f"{path}: has the layout {magic} of ambient files; only {MAGIC}, that of RADIANCE 6, can be read"
        )
    layout = record_type(_components(lines))
    if (len(body) - 2) % layout.itemsize:
        raise CacheFileError(f"{path}: is truncated: the last record is incomplete")
    records = np.frombuffer(body, layout, offset=2)
    own = next((line.removeprefix(_OWN) for line in lines if line.startswith(_OWN)), "")
    origin, _, checksum = own.rpartition(" records=")
    if scene_hash is not None:
        _check(path, origin, checksum, records, scene_hash)
    clean = ",".join(line.removeprefix(_CLEAN) for line in lines if line.startswith(_CLEAN))
    return AmbientFile(
        tuple(line for line in lines if not line.startswith((_OWN, _CLEAN, *_DATES))),
        records,
        origin,
        _frames(clean),
    )


def _check(path: Path, origin: str, checksum: str, records: Records, scene_hash: str) -> None:
    """Check that a file is from steadylight, undamaged, and of that scene."""
    if not origin:
        raise CacheFileError(
            f"{path}: does not say which scene it belongs to; only ambient files written by steadylight do"
        )
    if checksum != _checksum(records):
        raise CacheFileError(f"{path}: is damaged: its records do not match their checksum")
    if f"scene={scene_hash}" not in origin.split():
        raise CacheFileError(f"{path}: belongs to another scene")


def _components(lines: Sequence[str]) -> int:
    """Number of spectral components per record."""
    found = next((line for line in lines if line.startswith("NCOMP=")), f"NCOMP={COMPONENTS}")
    return int(found.removeprefix("NCOMP="))


def _checksum(records: Records) -> str:
    return hashlib.sha256(records.tobytes()).hexdigest()[:32]


def _ranges(frames: Iterable[int]) -> list[str]:
    """Frame numbers as `A-B` and single numbers."""
    numbers = sorted(frames)
    breaks = [0, *(i for i, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1), len(numbers)]
    runs = [numbers[a:b] for a, b in pairwise(breaks) if b > a]
    return [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]


def _frames(text: str) -> frozenset[int]:
    """Inverse of `_ranges`."""
    frames: set[int] = set()
    for item in filter(None, text.split(",")):
        first, _, last = item.partition("-")
        frames.update(range(int(first), int(last or first) + 1))
    return frozenset(frames)


def numbers(stored: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Radiance's portable numbers, (..., 5) bytes, decoded as by `getflt`."""
    mantissa = np.ascontiguousarray(stored[..., :4]).view(">i4")[..., 0].astype(np.float64)
    exponent = stored[..., 4].astype(np.int8).astype(np.int64)
    return np.where(
        mantissa == 0, 0.0, np.ldexp((mantissa + np.copysign(0.5, mantissa)) * 2.0**-31, exponent)
    )


def stored_numbers(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Numbers encoded as by Radiance's `putflt`, (..., 5) bytes."""
    fraction, exponent = np.frexp(np.asarray(values, np.float64))
    mantissa = (fraction * _MANTISSA).astype(np.int64)
    stored = np.zeros((*fraction.shape, _FLOAT), np.uint8)
    stored[..., :4] = np.asarray(mantissa, ">i4")[..., None].view(np.uint8)
    stored[..., 4] = np.where(mantissa == 0, 0, exponent).astype(np.int8).view(np.uint8)
    return stored


def directions(codes: NDArray[Any]) -> Vectors:
    """Radiance's direction codes, (N,), as unit vectors, (N, 3)."""
    code = codes.astype(np.int64)
    first = (code >> 5 & 0x1FFF) / _DIRECTION_SCALE
    second = (code >> 18 & 0x1FFF) / _DIRECTION_SCALE
    third = np.sqrt(np.maximum(1 - first**2 - second**2, 0.0))
    axes = _AXES[((code & 0o20) != 0) * 2 + ((code & 0o10) != 0)]
    found = np.zeros((len(code), 3))
    np.put_along_axis(found, axes, np.stack([first, second, third], axis=1), axis=1)
    signs = np.where(code[:, None] >> np.arange(3) & 1, -1.0, 1.0)
    return np.where((code != 0)[:, None], found * signs, 0.0)


def positions(records: Records) -> Vectors:
    """Positions, (N, 3), rounded to single precision as in Radiance."""
    return numbers(records["position"]).astype(np.float32).astype(np.float64)


def values(records: Records) -> Vectors:
    """Irradiance over pi, (N, components)."""
    stored = records["value"].astype(np.float64)
    scale = np.where(stored[:, -1:] > 0, np.exp2(stored[:, -1:] - 136), 0.0)
    return (stored[:, :-1] + 0.5) * scale


def concatenated(parts: Sequence[Records]) -> Records:
    """Records of several files, one after the other."""
    # NumPy's own concatenation of structured arrays would turn big-endian numbers into native ones.
    layout = parts[0].dtype
    return np.frombuffer(b"".join(part.astype(layout, copy=False).tobytes() for part in parts), layout)


def moved_off(records: Records) -> Records:
    """Records shifted slightly from the points that they were made at.

    Within 3e-6 units of a record's own point, Radiance's test for leaks (`plugaleak` in `ambient.c`) lacks precision
    and rejects the record, so that each further rendering of a picture makes such records again. We shift each record
    along its first axis, by 1e-5 units or four steps of single precision, whichever is larger.
    """
    before = positions(records)
    step = np.maximum(1e-5, 4 * np.spacing(np.abs(before).max(axis=1, initial=0.0).astype(np.float32)))
    after = (before + directions(records["axis"]) * step[:, None]).astype(np.float32)
    moved = records.copy()
    moved["position"] = stored_numbers(after)
    return moved
