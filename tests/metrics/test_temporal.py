from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.errors import InputError
from steadylight.images import write_exr
from steadylight.metrics.region import Region
from steadylight.metrics.temporal import (
    bfm,
    bfm_excess,
    brightness_series,
    mean_luminance,
    overshoot,
    static_deviation,
)

if TYPE_CHECKING:
    from pathlib import Path


def grey(level: float, height: int = 4, width: int = 6) -> np.ndarray:
    return np.full((height, width, 3), level, np.float32)


class TestBrightness:
    def test_luminance_is_rec_709(self) -> None:
        assert mean_luminance(np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])) == pytest.approx(0.9278 / 2)

    def test_it_is_relative_to_the_mean_of_the_film(self) -> None:
        assert brightness_series([grey(1), grey(2), grey(3)]) == pytest.approx([0.5, 1.0, 1.5])

    def test_only_the_region_counts(self) -> None:
        frames = [grey(1), grey(1)]
        frames[1][:2, :3] = 3
        assert brightness_series(frames, (0, 0, 3, 2)) == pytest.approx([0.5, 1.5])
        assert brightness_series(frames, Region(0.5, 0.5, 1.0, 1.0)) == pytest.approx([1.0, 1.0])

    def test_frames_may_be_files(self, tmp_path: Path) -> None:
        for number in (1, 2):
            write_exr(tmp_path / f"{number}.exr", grey(number))
        paths = [tmp_path / "1.exr", tmp_path / "2.exr"]
        assert brightness_series(paths) == pytest.approx([2 / 3, 4 / 3])

    def test_a_black_film_has_no_brightness_and_does_not_flicker(self) -> None:
        assert brightness_series([grey(0)] * 3).tolist() == [0, 0, 0]


class TestFlicker:
    def test_bfm_is_the_absolute_step(self) -> None:
        assert bfm([1.0, 1.25, 0.75]) == pytest.approx([0.25, 0.5])

    def test_an_even_trend_has_bfm_but_no_overshoot(self) -> None:
        trend = np.linspace(0.5, 1.5, 11)
        assert bfm(trend) == pytest.approx(np.full(10, 0.1))
        assert overshoot(trend) == pytest.approx(0.0, abs=1e-15)

    def test_alternating_brightness_overshoots_by_the_whole_swing(self) -> None:
        assert overshoot([0.9, 1.1, 0.9, 1.1]) == pytest.approx(0.2)

    def test_a_trend_does_not_hide_overshoot(self) -> None:
        swing = 0.01 * (-1.0) ** np.arange(20)
        assert overshoot(np.linspace(0.5, 1.5, 20) + swing) == pytest.approx(overshoot(1 + swing))

    def test_a_film_like_its_reference_has_no_bfm_excess(self) -> None:
        sequence = [1.0, 1.2, 0.8, 1.0]
        assert bfm_excess(sequence, sequence) == 0.0

    def test_bfm_excess_is_the_mean_difference_of_the_graphs(self) -> None:
        # BFM 0.1 0.3 against 0.2 0.1
        assert bfm_excess([1.0, 1.1, 0.8], [1.0, 0.8, 0.9]) == pytest.approx((0.1 + 0.2) / 2)

    def test_films_too_short_or_of_different_length_are_refused(self) -> None:
        with pytest.raises(InputError, match="at least 3 neighbouring frames, not 2"):
            overshoot([1.0, 1.0])
        with pytest.raises(InputError, match="at least 2 neighbouring frames, not 1"):
            bfm_excess([1.0], [1.0])
        with pytest.raises(InputError, match="3 frames cannot be compared with one of 2"):
            bfm_excess([1.0, 1.0, 1.0], [1.0, 1.0])


class TestStaticDeviation:
    def test_frames_that_do_not_change_have_none(self) -> None:
        assert static_deviation([grey(1)] * 3, grey(2)) == 0.0

    def test_two_levels_around_the_reference_give_the_known_value(self) -> None:
        # standard deviation 0.1, reference 1 + 0.1 * 1
        assert static_deviation([grey(0.9), grey(1.1)], grey(1)) == pytest.approx(0.1 / 1.1, rel=1e-6)

    def test_it_is_the_mean_over_the_region_of_what_each_pixel_does(self) -> None:
        frames = np.random.default_rng(5).normal(1.0, 0.1, (7, 4, 6, 3))
        reference = np.linspace(0.5, 1.5, 72).reshape(4, 6, 3)
        expected = frames.std(axis=0) / (reference + 0.1 * reference.mean())
        assert static_deviation(frames, reference) == pytest.approx(expected.mean())
        assert static_deviation(frames, reference, (1, 2, 4, 3)) == pytest.approx(expected[2:3, 1:4].mean())

    def test_frames_of_another_size_are_named(self, tmp_path: Path) -> None:
        write_exr(tmp_path / "frame_00001.exr", grey(1, 5, 5))
        with pytest.raises(InputError, match=r"frame_00001\.exr: is 5x5 pixels; the reference is 6x4"):
            static_deviation([tmp_path / "frame_00001.exr"], grey(1))

    def test_one_frame_is_not_enough(self) -> None:
        with pytest.raises(InputError, match="at least 2 frames, not 1"):
            static_deviation([grey(1)], grey(1))
