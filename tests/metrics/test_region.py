from __future__ import annotations

import pytest

from steadylight.errors import InputError
from steadylight.metrics.region import Region


def test_integers_are_pixels() -> None:
    assert Region.parse("1, 2,30,40").pixels(64, 48) == (1, 2, 30, 40)


def test_numbers_with_a_point_are_fractions() -> None:
    assert Region.parse("0,0.5,1,1").pixels(64, 48) == (0, 24, 64, 48)


def test_a_fraction_holds_at_least_one_pixel_of_the_image() -> None:
    assert Region(0.999, 0.0, 1.0, 0.001).pixels(64, 48) == (63, 0, 64, 1)


def test_none_is_the_whole_image() -> None:
    assert Region.of(None).slices(64, 48) == (slice(0, 48), slice(0, 64))


def test_edges_may_be_given_as_a_sequence() -> None:
    assert Region.of((1, 2, 3, 4)) == Region.of(Region(1, 2, 3, 4)) == Region(1, 2, 3, 4)


@pytest.mark.parametrize("text", ["", "1,2,3", "a,b,c,d", "1,2,3,4,5"])
def test_another_form_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="cannot be read; expected x0,y0,x1,y1"):
        Region.parse(text)


@pytest.mark.parametrize("text", ["5,0,5,9", "5,9,9,2", "-1,0,5,5", "0.5,0.0,0.2,1.0", "nan.,0.,1.,1."])
def test_an_empty_rectangle_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"empty or starts outside|cannot be read"):
        Region.parse(text)


def test_fractions_above_one_are_refused() -> None:
    with pytest.raises(InputError, match=r"fractions must not exceed 1\.0"):
        Region.parse("0.5,0.5,640,480")


def test_pixels_and_fractions_do_not_mix() -> None:
    with pytest.raises(InputError, match="mixes pixels and fractions"):
        Region(0, 0, 0.5, 0.5)


def test_a_region_beyond_the_image_is_refused_with_the_size() -> None:
    with pytest.raises(InputError, match="0,0,65,10: extends beyond the image of 64x48"):
        Region(0, 0, 65, 10).pixels(64, 48)
