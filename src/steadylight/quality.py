"""Quality as one number: 1 is normal; higher is slower and more accurate.

Each renderer derives its own budgets and tolerances from it (`renderers/mitsuba/quality.py`).
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Annotated

from pydantic import BeforeValidator, PlainSerializer

WORDS = {"draft": 0.25, "normal": 1.0, "high": 2.0}
"""Named qualities."""

LEAST, MOST = 1 / 16, 16.0
"""Valid range; no images have been checked outside it."""

FEW_FRAMES = 24
"""In films with fewer frames, records are farther apart; otherwise the cache would take more time than the frames."""

WIDEST = 1.4
"""Maximum factor on the distance: a third fewer records, a twentieth more error in a frame (docs/experiments.md)."""


def spacing_of_film(frames: int) -> float:
    """Distance of records in a short film, relative to a long one of the same quality.

    The frames of a film share the cost of the cache: the fewer frames, the fewer records are worth their cost.

    Args:
        frames: number of frames of the film.

    Returns:
        A factor from 1 to `WIDEST`.
    """
    return min(max(sqrt(FEW_FRAMES / frames), 1.0), WIDEST)


def quality_number(value: object) -> float:
    """A quality from a number or a word.

    Args:
        value: one of `WORDS`, or a number from `LEAST` to `MOST`, also as text.

    Raises:
        ValueError: it is neither; the message says what is valid.
    """
    if isinstance(value, str) and value in WORDS:
        return WORDS[value]
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = float("nan")
    if isinstance(value, bool) or not isfinite(number) or not LEAST <= number <= MOST:
        raise ValueError(f"give {', '.join(WORDS)}, or a number from {LEAST:g} to {MOST:g}; not {value!r}")
    return number


def quality_word(number: float) -> str:
    """A quality as text: its word if it has one, otherwise the number."""
    short = f"{number:g}"
    exact = short if float(short) == number else repr(number)
    return next((word for word, value in WORDS.items() if value == number), exact)


Quality = Annotated[float, BeforeValidator(quality_number), PlainSerializer(quality_word)]
"""Type of a settings field that takes a number or a word, and is recorded as text."""
