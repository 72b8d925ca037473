"""Quality as a number or a word."""

from __future__ import annotations

import pytest

from steadylight.quality import LEAST, MOST, WORDS, quality_number, quality_word
from steadylight.settings import RenderSettings


@pytest.mark.parametrize(("value", "number"), [("normal", 1.0), ("draft", 0.25), (2, 2.0), ("0.5", 0.5)])
def test_a_quality_is_given_by_its_word_or_its_number(value: object, number: float) -> None:
    assert quality_number(value) == number


@pytest.mark.parametrize("value", ["best", 0, -1, 17, "nan", float("inf"), None, True, [1]])
def test_anything_else_is_refused_and_told_what_is_valid(value: object) -> None:
    with pytest.raises(ValueError, match=r"give draft, normal, high, or a number from 0\.0625 to 16; not"):
        quality_number(value)


def test_words_stand_in_order_and_numbers_are_said_as_words_where_they_have_one() -> None:
    assert list(WORDS.values()) == sorted(WORDS.values())
    assert [quality_word(number) for number in (0.25, 1, 2, LEAST, MOST)] == [
        "draft",
        "normal",
        "high",
        "0.0625",
        "16",
    ]


@pytest.mark.parametrize("value", ["draft", 0.123456789, "4"])
def test_settings_record_a_quality_as_people_say_it_and_read_it_back(value: object) -> None:
    settings = RenderSettings(frames=(1,), width=1, height=1, quality=value)
    recorded = settings.model_dump(mode="json")
    assert recorded["quality"] == str(value)
    assert RenderSettings(**recorded) == settings
