"""Quality as one number: 1 is normal, more is slower and closer to the truth.

Each renderer turns the number into budgets and tolerances of its own (`renderers/mitsuba/quality.py`).
"""

from __future__ import annotations

from math import isfinite
from typing import Annotated

from pydantic import BeforeValidator, PlainSerializer

WORDS = {"draft": 0.25, "normal": 1.0, "high": 2.0}
"""Numbers that have a name."""

LEAST, MOST = 1 / 16, 16.0
"""Range of the number; beyond it, nobody has looked at a picture."""


def quality_number(value: object) -> float:
    """A quality by its number or its word.

    Args:
        value: one of `WORDS`, or a number within `LEAST` and `MOST`, which may be written out.

    Raises:
        ValueError: neither; says what is valid.
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
    """A quality as people say it: its word if it has one, otherwise its number."""
    short = f"{number:g}"
    exact = short if float(short) == number else repr(number)
    return next((word for word, value in WORDS.items() if value == number), exact)


Quality = Annotated[float, BeforeValidator(quality_number), PlainSerializer(quality_word)]
"""A field of settings that takes a number or a word, and is recorded as people say it."""
