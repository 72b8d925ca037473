"""The contact sheet: frames, plan, heights and text in one picture."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_WIDTH, _GAP, _COLUMNS = 1200, 12, 4
_TOP, _LINE_HEIGHT = 60, 22
_PAPER, _INK, _QUIET, _LINE, _ALARM = (
    (251, 250, 248),
    (34, 38, 43),
    (92, 98, 104),
    (11, 122, 117),
    (179, 56, 44),
)

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Words:
    """Text on the sheet.

    Attributes:
        title: title, in large letters.
        facts: lines below the title.
        warnings: lines in another colour.
    """

    title: str
    facts: Sequence[str]
    warnings: Sequence[str]


def contact_sheet(
    words: Words, pictures: Mapping[str, Pixels], plan: Pixels | None, heights: NDArray[np.float64]
) -> Pixels:
    """One picture, (height, 1200, 3) uint8.

    Args:
        words: the text.
        pictures: frames of one size, by caption.
        plan: plan from above; None if there is none.
        heights: heights of the eye along the path, metres.
    """
    half = (_WIDTH - 3 * _GAP) // 2
    lines = [
        (colour, part)
        for colour, said in ((_ALARM, words.warnings), (_INK, words.facts))
        for line in said
        for part in [*(textwrap.wrap(line, 66) or [""]), None]
    ]
    size, columns = _picture_size(pictures)
    rows = -(-len(pictures) // columns)
    top = _TOP + rows * (size[1] + 26) + _GAP
    beside = 130 + 2 * _GAP + _LINE_HEIGHT * len(lines)
    sheet = Image.new("RGB", (_WIDTH, top + max(half, beside) + _GAP), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_GAP, _GAP), words.title, fill=_INK, font=ImageFont.load_default(30))
    _paste_pictures(sheet, pictures, size, columns)
    bottom = top
    if plan is not None:
        picture = Image.fromarray(plan)
        picture.thumbnail((half, half))
        sheet.paste(picture, (_GAP, top))
        bottom = top + picture.height
    left = 2 * _GAP + half
    y = top
    if len(heights) > 1:
        _draw_heights(draw, (left, y, left + half, y + 130), heights)
        y += 130 + 2 * _GAP
    font = ImageFont.load_default(16)
    for colour, part in lines:
        if part is not None:
            draw.text((left, y), part, fill=colour, font=font)
        y += 4 if part is None else _LINE_HEIGHT
    return np.asarray(sheet.crop((0, 0, _WIDTH, max(bottom, y) + _GAP)))


def _picture_size(pictures: Mapping[str, Pixels]) -> tuple[tuple[int, int], int]:
    """Width and height of the pictures, which are all of one size, and the number of columns."""
    columns = min(_COLUMNS, max(2, len(pictures)))
    width = (_WIDTH - (columns + 1) * _GAP) // columns
    rows, across, _ = next(iter(pictures.values())).shape
    return (width, max(1, round(width * rows / across))), columns


def _paste_pictures(
    sheet: Image.Image, pictures: Mapping[str, Pixels], size: tuple[int, int], columns: int
) -> None:
    """Paste rows of captioned pictures."""
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    width, height = size
    for number, (caption, pixels) in enumerate(pictures.items()):
        row, column = divmod(number, columns)
        x, y = _GAP + column * (width + _GAP), _TOP + row * (height + 26)
        sheet.paste(Image.fromarray(pixels).resize(size, Image.Resampling.BICUBIC), (x, y))
        draw.text((x, y + height + 3), caption, fill=_QUIET, font=font)


def _draw_heights(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], heights: NDArray[np.float64]
) -> None:
    """Draw the heights as a line, on an axis from zero."""
    left, top, right, bottom = box
    font = ImageFont.load_default(15)
    known = heights[np.isfinite(heights)]
    if not len(known):
        return
    most = max(float(known.max()) * 1.1, 0.1)
    draw.text((left, top), "height of the eye above the floor", fill=_QUIET, font=font)
    top += 24
    draw.line([(left, bottom), (right, bottom)], fill=_QUIET)
    draw.text((right - 60, top - 24), f"{known.max():.2f} m", fill=_QUIET, font=font)
    x = np.linspace(left, right, len(heights))
    y = bottom - heights / most * (bottom - top)
    for first, second in zip(range(len(x) - 1), range(1, len(x)), strict=True):
        if np.isfinite(y[first]) and np.isfinite(y[second]):
            draw.line([(x[first], y[first]), (x[second], y[second])], fill=_LINE, width=2)
