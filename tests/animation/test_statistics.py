"""Wall-clock seconds of a pass: the time during which something of it was at work."""

from __future__ import annotations

import pytest

from steadylight.animation.statistics import busy_seconds


def line(start, end):
    return {"time": end, "seconds": end - start}


@pytest.mark.parametrize(
    ("lines", "seconds"),
    [
        ([], 0.0),
        ([line(0, 2)], 2.0),
        ([line(0, 2), line(2, 3)], 3.0),
        ([line(0, 2), line(1, 3)], 3.0),
        ([line(0, 9), line(1, 3)], 9.0),
        ([line(5, 6), line(0, 1)], 2.0),  # a session between which nobody worked
    ],
)
def test_overlapping_attempts_count_once(lines, seconds):
    assert busy_seconds(lines) == seconds
