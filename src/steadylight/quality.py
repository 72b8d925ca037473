"""Quality as one number: 1 is normal; higher is slower and more accurate.

Each renderer derives its own budgets and tolerances from it (`renderers/mitsuba/quality.py`).
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import Annotated

from pydantic import BeforeValidator, PlainSerializer

WORDS = {"draft": 0.25, "normal": 1.0, "high": 2.0}
"""Numbers with a name."""

LEAST, MOST = 1 / 16, 16.0
"""Valid range; no images have been checked outside it."""

FEW_FRAMES = 24
"""A film of fewer has records further apart: it would spend more time on its cache than on its frames."""

WIDEST = 1.4
"""Times as far apart, at most: a third fewer records, for a twentieth more error in a frame (docs/experiments.md)."""


def spacing_of_film(frames: int) -> float:
    """How much further apart the records of a short film are than those of a long one, with the same quality.

    Each frame of a film shares the cost of the cache; the fewer there are, the fewer records are worth it.

    Args:
        frames: of the film.

    Returns:
        A factor from 1 to `WIDEST`.
    """
    return min(max(sqrt(FEW_FRAMES / frames), 1.0), WIDEST)


def quality_number(value: object) -> float:
    """A quality from a number or a word.

    Args:
        value: one of `WORDS`, or a number from `LEAST` to `MOST`, also as text.

    Raises:
        ValueError: neither; the message says what is valid.
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
"""A field of settings that takes a number or a word, and is recorded as text."""
