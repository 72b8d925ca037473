from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from steadylight.errors import InputError
from steadylight.metrics.sequence import FrameSequence, spans

if TYPE_CHECKING:
    from pathlib import Path


def touch(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def frames(folder: Path, *numbers: int) -> FrameSequence:
    return FrameSequence.open(touch(folder, *(f"frame_{number:05d}.exr" for number in numbers)))


def test_a_run_directory_is_a_film(tmp_path: Path) -> None:
    touch(tmp_path / "frames", "frame_00002.exr", "frame_00010.exr", ".partial-1-a-frame_00003.exr")
    sequence = FrameSequence.open(tmp_path)
    assert list(sequence.frames) == [2, 10]
    assert sequence.frames[2] == tmp_path / "frames" / "frame_00002.exr"


def test_any_folder_of_numbered_exr_files_is_a_film(tmp_path: Path) -> None:
    assert list(FrameSequence.open(touch(tmp_path, "shot3.0012.EXR", "shot3.7.exr", "notes.txt")).frames) == [
        7,
        12,
    ]


def test_a_folder_that_is_missing_empty_or_holds_two_films_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gone: no such folder"):
        FrameSequence.open(tmp_path / "gone")
    with pytest.raises(InputError, match="empty: contains no frames"):
        FrameSequence.open(touch(tmp_path / "empty"))
    with pytest.raises(InputError, match=r"a_1\.exr and b_1\.exr are both frame 1"):
        FrameSequence.open(touch(tmp_path / "two", "a_1.exr", "b_1.exr"))


def test_a_short_film_is_compared_with_a_part_of_a_long_one(tmp_path: Path) -> None:
    assert frames(tmp_path / "a", 1, 2, 3, 4).shared_with(frames(tmp_path / "b", 2, 3, 9)) == (2, 3)


def test_films_without_a_common_frame_are_both_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a \(frames 1-3\) and .*b \(frames 5, 7-8\) have no frame"):
        frames(tmp_path / "a", 1, 2, 3).shared_with(frames(tmp_path / "b", 5, 7, 8))


def test_a_hole_in_either_film_is_named(tmp_path: Path) -> None:
    whole, holed = frames(tmp_path / "whole", 1, 2, 3, 4), frames(tmp_path / "holed", 1, 4)
    for sequences in ((whole, holed), (holed, whole)):
        with pytest.raises(InputError, match=r"holed: has no frame 2-3, but .*whole has"):
            sequences[0].shared_with(sequences[1])


def test_frame_numbers_are_told_in_few_words() -> None:
    assert spans([5, 1, 2, 3, 7, 8]) == "1-3, 5, 7-8"
