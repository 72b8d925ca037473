"""The contact sheet: frames, plan, heights and words in one picture."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_WIDTH, _GAP, _COLUMNS = 1200, 12, 4
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
    """What the sheet says.

    Attributes:
        title: in large letters.
        facts: lines below it.
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
        words: what to say.
        pictures: frames of one size, by caption.
        plan: from above; None if there is none.
        heights: of the eye along the path, metres.
    """
    sheet = Image.new("RGB", (_WIDTH, 6000), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_GAP, _GAP), words.title, fill=_INK, font=ImageFont.load_default(30))
    top = _paste_pictures(sheet, pictures, 60)
    half = (_WIDTH - 3 * _GAP) // 2
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
    for colour, lines in ((_ALARM, words.warnings), (_INK, words.facts)):
        for line in lines:
            for part in textwrap.wrap(line, 66) or [""]:
                draw.text((left, y), part, fill=colour, font=font)
                y += 22
            y += 4
    return np.asarray(sheet.crop((0, 0, _WIDTH, min(max(bottom, y) + _GAP, sheet.height))))


def _paste_pictures(sheet: Image.Image, pictures: Mapping[str, Pixels], top: int) -> int:
    """Rows of captioned pictures; returns where they end."""
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    columns = min(_COLUMNS, max(2, len(pictures)))
    width = (_WIDTH - (columns + 1) * _GAP) // columns
    rows = 0
    height = 0
    for number, (caption, pixels) in enumerate(pictures.items()):
        height = round(width * pixels.shape[0] / pixels.shape[1])
        rows, column = divmod(number, columns)
        x, y = _GAP + column * (width + _GAP), top + rows * (height + 26)
        sheet.paste(Image.fromarray(pixels).resize((width, height), Image.Resampling.BICUBIC), (x, y))
        draw.text((x, y + height + 3), caption, fill=_QUIET, font=font)
    return top + (rows + 1) * (height + 26) + _GAP


def _draw_heights(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], heights: NDArray[np.float64]
) -> None:
    """A line of the heights, from zero."""
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
