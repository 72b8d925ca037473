"""Cache files: safetensors with a versioned, hashed header. Format: docs/cache-file.md."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from steadylight.cache.records import Floats, Records
from steadylight.errors import CacheFileError

VERSION = 8
WHOLE = ("all",)
"""Names of the values of records with a single value, which holds all light."""

_KEY = "steadylight"  # a single metadata entry, since the file format does not fix the order of several


@dataclass(frozen=True)
class CacheFile:
    """Contents of a cache file.

    Attributes:
        records: the records.
        scene_hash: `SceneDescription.hash` of the scene that they were gathered in.
        about: further plain data from the program that made the file (settings, statistics).
        values: name of each value of a record; see `Records`.
    """

    records: Records
    scene_hash: str
    about: dict[str, Any]
    values: tuple[str, ...] = WHOLE

    def __post_init__(self) -> None:
        assert len(self.values) == self.records.values, self.values


def encode_cache(cache: CacheFile) -> bytes:
    """The bytes of a cache file; the same cache gives the same bytes."""
    arrays = {name: np.ascontiguousarray(getattr(cache.records, name)) for name in Records.SHAPES}
    header = {"scene": cache.scene_hash, "about": cache.about, "values": list(cache.values)}
    return _encode(arrays, header)


def read_cache(path: Path, *, scene_hash: str | None = None) -> CacheFile:
    """Read and check a cache file.

    Args:
        path: the file.
        scene_hash: the scene it must belong to, if given.

    Raises:
        CacheFileError: missing, truncated, damaged, of another version, or of another scene.
    """
    arrays, header = _read(path, Records.SHAPES, scene_hash)
    return CacheFile(Records(**arrays), header["scene"], header["about"], tuple(header["values"]))


_POINTS = ("position", "normal", "longest", "smallest", "number")


def encode_points(
    position: Floats, normal: Floats, longest: Floats, smallest: Floats, number: Floats, scene_hash: str
) -> bytes:
    """The bytes of a file of points that need a record.

    Args:
        position: (P, 3) metres.
        normal: (P, 3) unit.
        longest: (P,) upper bound of the radius of records that are trusted there, metres.
        smallest: (P,) lower bound of the radius that a record there needs, metres.
        number: (P,) look-ups that each point stands for.
        scene_hash: of the scene.
    """
    arrays = dict(zip(_POINTS, (position, normal, longest, smallest, number), strict=True))
    return _encode(arrays, {"scene": scene_hash})


def read_points(
    path: Path, *, scene_hash: str | None = None
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Read and check a file of points; returns the arrays that `encode_points` takes.

    Raises:
        CacheFileError: missing, truncated, damaged, of another version, or of another scene.
    """
    arrays, _ = _read(path, _POINTS, scene_hash)
    position, normal, longest, smallest, number = (arrays[name] for name in _POINTS)
    return position, normal, longest, smallest, number


def encode_arrays(arrays: dict[str, NDArray[Any]], scene_hash: str) -> bytes:
    """The bytes of a file of named arrays that belong to a scene."""
    return _encode(
        {name: np.ascontiguousarray(array) for name, array in arrays.items()}, {"scene": scene_hash}
    )


def read_arrays(path: Path, *, scene_hash: str | None = None) -> dict[str, NDArray[Any]]:
    """Read and check a file of named arrays.

    Raises:
        CacheFileError: missing, truncated, damaged, of another version, or of another scene.
    """
    return _read(path, None, scene_hash)[0]


def _encode(arrays: dict[str, Any], header: dict[str, Any]) -> bytes:
    header = {"version": VERSION, **header}
    header["sha256"] = _digest(arrays, header)
    content: bytes = save(arrays, metadata={_KEY: json.dumps(header, sort_keys=True)})
    return content


def _read(
    path: Path, names: Iterable[str] | None, scene_hash: str | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and header of a file, checked; any array names are accepted if `names` is None."""
    if path.is_dir():
        raise CacheFileError(
            f"{path}: is a folder; give a cache file, for example RUN/cache/merged.safetensors"
        )
    try:
        with safe_open(str(path), framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except FileNotFoundError:
        raise CacheFileError(f"{path}: no such cache file") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise CacheFileError(f"{path}: not a cache file, or truncated ({error}); make it again") from None
    if _KEY not in metadata:
        raise CacheFileError(f"{path}: a safetensors file, but not a steadylight cache")
    try:
        header = dict(json.loads(metadata[_KEY]))
    except (ValueError, TypeError, RecursionError):
        raise CacheFileError(f"{path}: damaged (its header cannot be read); make it again") from None
    if header.get("version") != VERSION:
        raise CacheFileError(
            f"{path}: cache format version {header.get('version')}, this steadylight reads version "
            f"{VERSION}; make it again, or use the steadylight that made it"
        )
    if header.pop("sha256", None) != _digest(arrays, header):
        raise CacheFileError(f"{path}: damaged (its content does not match its checksum); make it again")
    if names is not None and sorted(arrays) != sorted(names):
        raise CacheFileError(f"{path}: holds {', '.join(sorted(arrays))}, not {', '.join(sorted(names))}")
    if scene_hash is not None and header["scene"] != scene_hash:
        raise CacheFileError(
            f"{path}: made for another scene (hash {header['scene'][:12]}, expected {scene_hash[:12]})"
        )
    return arrays, header


def _digest(arrays: dict[str, Any], header: dict[str, Any]) -> str:
    """SHA-256 over the rest of the header and the arrays, in a fixed order."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(f"{name}{arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()
