from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from safetensors.numpy import save

from steadylight.cache.file import (
    VERSION,
    CacheFile,
    encode_cache,
    encode_points,
    read_cache,
    read_points,
)
from steadylight.cache.records import Records
from steadylight.errors import CacheFileError

if TYPE_CHECKING:
    from pathlib import Path

SCENE = "5c" * 32


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "merged.cache"


@pytest.fixture(scope="module")
def content(records_of: Any) -> bytes:
    return encode_cache(CacheFile(records_of(1, 6), SCENE, {"frames": [1, 5], "name": "Gang"}))


def refused(path: Path, words: str = ".", **how: Any) -> None:
    """Reading must fail with our error, which names the file."""
    with pytest.raises(CacheFileError, match=words) as caught:
        read_cache(path, **how)
    assert str(caught.value).startswith(f"{path}: ")


def test_what_is_written_is_read_back_and_encodes_to_the_same_bytes(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    cache = read_cache(path, scene_hash=SCENE)
    assert cache.scene_hash == SCENE
    assert cache.about == {"frames": [1, 5], "name": "Gang"}
    assert len(cache.records) == 6
    assert encode_cache(cache) == content


def test_an_empty_cache_is_a_cache(path: Path) -> None:
    path.write_bytes(encode_cache(CacheFile(Records.empty(), SCENE, {})))
    assert len(read_cache(path).records) == 0


@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.99])
def test_a_cache_cut_short_is_refused(path: Path, content: bytes, part: float) -> None:
    path.write_bytes(content[: int(part * len(content))])
    refused(path, "not a cache file, or truncated")


def test_a_cache_with_bytes_behind_its_end_is_refused(path: Path, content: bytes) -> None:
    path.write_bytes(content + b"\0")
    refused(path, "not a cache file, or truncated")


def test_a_flipped_bit_of_the_records_is_found(path: Path, content: bytes) -> None:
    for place in (len(content) - 1, len(content) - 200):
        flipped = bytearray(content)
        flipped[place] ^= 4
        path.write_bytes(flipped)
        refused(path, "damaged")


def test_a_flipped_bit_anywhere_is_refused_with_our_error(path: Path, content: bytes) -> None:
    length = int.from_bytes(content[:8], "little")
    accepted = []
    for place in range(0, 8 + length, 3):  # of the header; the records behind it are one checksum
        flipped = bytearray(content)
        flipped[place] ^= 1 << (place % 7)
        path.write_bytes(flipped)
        try:
            read_cache(path, scene_hash=SCENE)
        except CacheFileError as error:
            assert str(path) in str(error)  # noqa: PT017 - any of our messages will do
        else:
            accepted.append(place)
    # Spaces that pad the header may become other white space.
    assert all(content[place : 8 + length].isspace() for place in accepted)


def test_another_version_is_named(path: Path, content: bytes) -> None:
    path.write_bytes(content.replace(rb"\"version\": %d" % VERSION, rb"\"version\": %d" % (VERSION + 1)))
    refused(path, f"cache format version {VERSION + 1}, this steadylight reads version {VERSION}")


def test_a_cache_of_another_scene_is_refused_with_both_hashes(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    refused(path, "another scene .*5c5c5c5c5c5c.*expected abababababab", scene_hash="ab" * 32)


def test_what_is_no_cache_is_refused(path: Path) -> None:
    refused(path, "no such cache file")
    refused(path.parent, "is a folder; give a cache file")
    path.write_text("records: 7\n")
    refused(path, "not a cache file")
    path.write_bytes(save({"weights": np.zeros(3, np.float32)}))
    refused(path, "a safetensors file, but not a steadylight cache")


def test_metadata_that_is_not_ours_is_refused(path: Path) -> None:
    for metadata in ("{", "[]", "7", "[" * 100_000, json.dumps({"version": 1})):
        path.write_bytes(save({"position": np.zeros((1, 3), np.float32)}, metadata={"steadylight": metadata}))
        refused(path)


def test_metadata_nested_without_end_is_refused(path: Path) -> None:
    deep = "[" * 100_000 + "]" * 100_000
    path.write_bytes(save({"position": np.zeros((1, 3), np.float32)}, metadata={"steadylight": deep}))
    refused(path, "damaged|not a steadylight cache")


def test_points_are_read_back(path: Path) -> None:
    rng = np.random.default_rng(1)
    points = (
        *rng.random((2, 5, 3), np.float32),
        np.float32([1, 2, 3, 4, np.inf]),
        *rng.random((2, 5), np.float32),
    )
    content = encode_points(*points, SCENE)
    path.write_bytes(content)
    found = read_points(path, scene_hash=SCENE)
    for array, written in zip(found, points, strict=True):
        np.testing.assert_array_equal(array, written)
    assert encode_points(*found, SCENE) == content


def test_points_are_no_cache_and_a_cache_is_no_points(path: Path, content: bytes) -> None:
    path.write_bytes(encode_points(*np.zeros((2, 3, 3), np.float32), *np.zeros((3, 3), np.float32), SCENE))
    refused(
        path,
        "holds longest, normal, number, position, smallest, not barriers, brightest, curvature, difference, guide, ",
    )
    path.write_bytes(content)
    with pytest.raises(
        CacheFileError, match=r"merged\.cache: holds .*, not longest, normal, number, position"
    ):
        read_points(path)


@pytest.mark.parametrize("damage", ["cut", "flip", "scene"])
def test_damaged_points_are_refused(path: Path, damage: str) -> None:
    content = bytearray(encode_points(*np.ones((2, 3, 3), np.float32), *np.ones((3, 3), np.float32), SCENE))
    if damage == "flip":
        content[-1] ^= 1
    path.write_bytes(content[:-4] if damage == "cut" else content)
    with pytest.raises(CacheFileError, match=r"merged\.cache: "):
        read_points(path, scene_hash="00" * 32 if damage == "scene" else SCENE)


def test_values_of_records_have_names_in_the_file(path: Path, records_of: Any) -> None:
    cache = CacheFile(records_of(1, 6, values=2), SCENE, {}, ("day", "lamps"))
    path.write_bytes(encode_cache(cache))
    found = read_cache(path)
    assert found.values == ("day", "lamps")
    np.testing.assert_array_equal(found.records.irradiance, cache.records.irradiance)
    with pytest.raises(AssertionError, match="day"):
        CacheFile(records_of(1, 6), SCENE, {}, ("day", "lamps"))
