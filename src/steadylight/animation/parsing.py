"""Parses what the user writes for frames, sizes and cache parts."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final, Literal

from steadylight.errors import SettingsError
from steadylight.settings import MOST_PIXELS, Frames

_MOST_FRAMES: Final = 99_999  # five digits in file names
_COUNT = re.compile(r"[+-]?\d{1,9}")
_ITEM = re.compile(r"(\d{1,9})(?:-(\d{1,9})(?::(\d{1,9}))?)?")


def parse_parts(choice: int | str) -> int | Literal["auto"]:
    """`--cache-parts` as a number or `auto`."""
    if choice == "auto":
        return "auto"
    if isinstance(choice, str) and choice.strip().isdecimal():
        return int(choice)
    if isinstance(choice, bool) or not isinstance(choice, int):
        raise SettingsError(f"--cache-parts: {choice!r} is not valid; give auto or a positive whole number")
    return choice


def parse_frames(frames: Frames) -> tuple[int, ...]:
    """Parse frame numbers; the result is ascending, without duplicates.

    Raises:
        SettingsError: not a number, range or list of these; or a frame number below 1 or above the maximum.
    """
    if isinstance(frames, str) and not _COUNT.fullmatch(frames.strip()):
        numbers = _parse_items(frames)
    elif isinstance(frames, str | int):
        count = int(frames)
        if isinstance(frames, bool) or count < 1:
            raise _wrong_frames(frames, "an animation has at least one frame")
        numbers = list(range(1, min(count, _MOST_FRAMES + 1) + 1))
    else:
        numbers = list(frames)
        if not numbers or any(isinstance(n, bool) or not isinstance(n, int) for n in numbers):
            raise _wrong_frames(frames, "give at least one frame number; they are whole numbers")
    result = tuple(sorted(set(numbers)))
    if result[0] < 1:
        raise _wrong_frames(frames, "frames are counted from 1")
    if result[-1] > _MOST_FRAMES:
        raise _wrong_frames(frames, f"an animation has at most {_MOST_FRAMES} frames")
    return result


def _parse_items(text: str) -> list[int]:
    """Frame numbers of a comma list of `A`, `A-B` and `A-B:STEP`."""
    numbers: list[int] = []
    for item in text.split(","):
        match = _ITEM.fullmatch(item.strip())
        if match is None:
            raise _wrong_frames(text, f"{item.strip()!r} is neither a frame number nor a range")
        first, last, step = int(match[1]), int(match[2] or match[1]), int(match[3] or 1)
        if last < first or step < 1:
            raise _wrong_frames(text, f"{item.strip()!r} contains no frames")
        numbers += range(first, min(last, _MOST_FRAMES + 1) + 1, step)
    return numbers


def _wrong_frames(frames: Frames, why: str) -> SettingsError:
    return SettingsError(
        f"--frames: {frames!r} is not valid: {why}; give a number such as 24, a range such as 30-53 or "
        "1-91:45 (every 45th), or a list such as 1,5,9"
    )


def parse_size(size: str | Iterable[int]) -> tuple[int, int]:
    """Width and height in pixels from `WxH` or a pair.

    Raises:
        SettingsError: it is neither, or a side is not between 1 and MOST_PIXELS.
    """
    given = size
    sides: Iterable[int]
    if isinstance(size, str):
        match = re.fullmatch(r"\s*(\d{1,9})\s*[xX×]\s*(\d{1,9})\s*", size)
        sides = () if match is None else (int(match[1]), int(match[2]))
    else:
        sides = size
    pair = tuple(sides)
    if len(pair) != 2 or not all(isinstance(side, int) and 1 <= side <= MOST_PIXELS for side in pair):
        raise SettingsError(
            f"--size: {given!r} is not valid; give width x height in pixels, each from 1 to {MOST_PIXELS}, such as "
            "1024x768"
        )
    return pair[0], pair[1]
