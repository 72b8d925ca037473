"""Cache files: safetensors with a versioned, hashed header. Format: docs/cache-file.md."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from steadylight.cache.records import Records
from steadylight.errors import CacheFileError

VERSION = 1
_KEY = "steadylight"  # one metadata entry, since the order of several is not fixed in the file


@dataclass(frozen=True)
class CacheFile:
    """What a cache file holds.

    Attributes:
        records: the records.
        scene_hash: `SceneDescription.hash` of the scene they were gathered in.
        about: further plain data of the maker (settings, statistics).
    """

    records: Records
    scene_hash: str
    about: dict[str, Any]


def encode_cache(cache: CacheFile) -> bytes:
    """The bytes of a cache file; the same cache gives the same bytes."""
    arrays = {name: np.ascontiguousarray(getattr(cache.records, name)) for name in Records.SHAPES}
    header = {
        "version": VERSION,
        "scene": cache.scene_hash,
        "sha256": _digest(arrays),
        "about": cache.about,
    }
    return save(arrays, metadata={_KEY: json.dumps(header, sort_keys=True)})


def read_cache(path: Path, *, scene_hash: str | None = None) -> CacheFile:
    """Read and check a cache file.

    Args:
        path: the file.
        scene_hash: the scene it must belong to, if given.

    Raises:
        CacheFileError: missing, cut short, damaged, of another version, or of another scene.
    """
    try:
        with safe_open(str(path), framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except FileNotFoundError:
        raise CacheFileError(f"{path}: no such cache file") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise CacheFileError(f"{path}: not a cache file, or cut short ({error}); make it again") from None
    if _KEY not in metadata:
        raise CacheFileError(f"{path}: a safetensors file, but not a steadylight cache")
    header = json.loads(metadata[_KEY])
    if header.get("version") != VERSION:
        raise CacheFileError(
            f"{path}: cache format version {header.get('version')}, this steadylight reads version {VERSION}"
        )
    if sorted(arrays) != sorted(Records.SHAPES) or header["sha256"] != _digest(arrays):
        raise CacheFileError(f"{path}: damaged (its content does not match its checksum); make it again")
    if scene_hash is not None and header["scene"] != scene_hash:
        raise CacheFileError(
            f"{path}: made for another scene (hash {header['scene'][:12]}, expected {scene_hash[:12]})"
        )
    return CacheFile(Records(**arrays), header["scene"], header["about"])


def _digest(arrays: dict[str, Any]) -> str:
    """sha256 over the arrays in a fixed order."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name}{arrays[name].shape}".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()
