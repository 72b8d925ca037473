"""Ambient files are read and written byte by byte, and checked."""

from __future__ import annotations

import numpy as np
import pytest
from radiance_scenes import ROOM

from steadylight.errors import CacheFileError
from steadylight.renderers.radiance.ambient import (
    AmbientFile,
    Origin,
    concatenated,
    directions,
    encode_ambient,
    moved_off,
    numbers,
    positions,
    read_ambient,
    record_type,
    stored_numbers,
    values,
)
from steadylight.renderers.radiance.merging import united
from steadylight.scenes.radiance.programs import output_of

OPTIONS = ["-h", "-u-", "-n", "1", "-ab", "2", "-ad", "64", "-as", "0", "-aa", ".2", "-av", "0", "0", "0"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An ambient file as `rtrace` writes it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "room.rad").write_text(ROOM)
    (folder / "room.oct").write_bytes(output_of(folder, "oconv", "-f", "room.rad"))
    rays = b"0.5 0.5 1.5 1 1 -.1\n0.5 0.5 1.5 1 .5 -.4\n0.5 .5 1.5 0 1 0\n"
    output_of(folder, "rtrace", *OPTIONS, "-af", "made.amb", "room.oct", given=rays)
    return folder / "made.amb"


def without_dates(content):
    return b"\n".join(line for line in content.split(b"\n") if not line.startswith((b"CAPDATE=", b"GMT=")))


def test_a_file_of_rtrace_is_written_back_byte_by_byte(made):
    ambient = read_ambient(made)
    assert len(ambient.records) >= 3
    assert ambient.records.dtype.itemsize == 67
    head, _, body = made.read_bytes().partition(b"\n\n")
    assert encode_ambient(ambient) == without_dates(head) + b"\n\n" + body


def test_records_say_what_lookamb_says(made):
    records = read_ambient(made).records
    text = output_of(made.parent, "lookamb", "-h", "-d", made).decode().split()
    shown = np.array(text, float).reshape(len(records), -1)
    np.testing.assert_allclose(positions(records), shown[:, :3], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(directions(records["normal"]), shown[:, 3:6], atol=2e-4)
    np.testing.assert_allclose(directions(records["axis"]), shown[:, 6:9], atol=2e-4)
    assert np.array_equal(records["level"], shown[:, 9])
    np.testing.assert_allclose(numbers(records["weight"]), shown[:, 10], rtol=1e-4)
    np.testing.assert_allclose(numbers(records["radius"]), shown[:, 11:13], rtol=1e-4)
    np.testing.assert_allclose(values(records), shown[:, 13:16], rtol=1e-4)


def test_numbers_come_back_and_keep_nine_digits():
    figures = np.array([0.0, 1.0, -2.5, 3.14159265, 1e-20, -7e12])
    stored = stored_numbers(figures)
    np.testing.assert_allclose(numbers(stored), figures, rtol=1e-9)


def test_records_of_several_files_keep_their_bytes(made):
    records = read_ambient(made).records
    assert concatenated([records, records]).tobytes() == 2 * records.tobytes()
    assert united([records]).tobytes() == b"".join(sorted({record.tobytes() for record in records}))


def ours(made, records=None, clean=()):
    ambient = read_ambient(made)
    origin = Origin("abc", "def", "-ab 2").line
    return AmbientFile(
        ambient.header, ambient.records if records is None else records, origin, frozenset(clean)
    )


def test_our_files_tell_their_scene_and_the_clean_frames_and_radiance_reads_them(made, tmp_path):
    clean = [1, 2, 3, 7, *range(10, 2000, 2)]
    path = tmp_path / "ours.amb"
    path.write_bytes(encode_ambient(ours(made, clean=clean)))
    read = read_ambient(path, scene_hash="abc")
    assert read.scene == "abc"
    assert read.clean == set(clean)
    # The three rays of before find their records.
    moved = AmbientFile(read.header, moved_off(read.records), read.origin, read.clean)
    path.write_bytes(encode_ambient(moved))
    rays = b"0.5 0.5 1.5 1 1 -.1\n0.5 0.5 1.5 1 .5 -.4\n0.5 .5 1.5 0 1 0\n"
    output_of(made.parent, "rtrace", *OPTIONS, "-af", path, "room.oct", given=rays)
    assert len(read_ambient(path).records) == len(read.records)


def test_a_damaged_file_is_refused(made, tmp_path):
    path, content = tmp_path / "ours.amb", bytearray(encode_ambient(ours(made)))
    path.write_bytes(content)
    with pytest.raises(CacheFileError, match="belongs to another scene"):
        read_ambient(path, scene_hash="other")
    path.write_bytes(content[:-1])
    with pytest.raises(CacheFileError, match="is truncated: the last record is incomplete"):
        read_ambient(path)
    path.write_bytes(content[:-67])
    with pytest.raises(CacheFileError, match="do not match their checksum"):
        read_ambient(path, scene_hash="abc")
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CacheFileError, match="do not match their checksum"):
        read_ambient(path, scene_hash="abc")
    path.write_bytes(made.read_bytes())
    with pytest.raises(CacheFileError, match="which scene"):
        read_ambient(path, scene_hash="abc")
    path.write_bytes(b"hello")
    with pytest.raises(CacheFileError, match="is not a Radiance ambient file"):
        read_ambient(path)


def test_another_layout_is_refused_by_its_number(made, tmp_path):
    head, _, body = made.read_bytes().partition(b"\n\n")
    path = tmp_path / "old.amb"
    path.write_bytes(head + b"\n\n" + (559).to_bytes(2, "big") + body[2:])
    with pytest.raises(CacheFileError, match="layout 559"):
        read_ambient(path)


def test_spectral_records_have_a_byte_for_each_component():
    assert record_type(3).itemsize == 67
    assert record_type(9).itemsize == 73


def test_records_move_along_their_surface_only(made):
    records = read_ambient(made).records
    moved = moved_off(records)
    way = positions(moved) - positions(records)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 1e-5, rtol=0.1)
    assert np.abs((way * directions(records["normal"])).sum(axis=1)).max() < 5e-7
    assert np.array_equal(moved["value"], records["value"])
