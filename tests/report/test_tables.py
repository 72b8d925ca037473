from __future__ import annotations

import pytest

from steadylight.report.tables import duration, key_figures, settings_tables, statistics_tables


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "0 s"), (0.2634, "0.263 s"), (59.9, "59.9 s"), (200, "3 min 20 s"), (7500, "2 h 05 min")],
)
def test_durations_are_told_in_the_units_people_use(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_the_groups_stand_in_the_order_of_the_work_and_hit_rates_are_added() -> None:
    tables = statistics_tables(
        {
            "mode": "two-pass",
            "tasks": {"done": 5},
            "first_pass": {"hits": 900, "misses": 100, "seconds": 2.0},
            "extra_group": {"points": 1234567},
        }
    )
    assert [table.title for table in tables] == ["First pass", "Tasks", "Extra group"]
    assert ("hit rate", "90.00%") in tables[0].rows
    assert tables[2].rows == (("points", "1\u202f234\u202f567"),)


def test_times_of_frames_are_told_as_range_and_median() -> None:
    (table,) = statistics_tables({"second_pass": {"frame_seconds": [0.3, 0.1, 0.2]}})
    assert table.rows == (("time per frame", "0.1 s to 0.3 s, median 0.2 s"),)


def test_long_lists_keyframes_and_empty_values_are_told_in_few_words() -> None:
    tables = settings_tables(
        {
            "format": 1,
            "settings": {"frames": list(range(1, 31)), "loop": True, "note": None, "none": []},
            "camera": {"keyframes": [{}, {}]},
            "survey": {"windows": [[0, 1], [1]], "neighbours": [[1], [0]], "details": {"planes": [1.0]}},
            "host": {"isa": ["avx", "fma"], "limits": {"spp": 4}},
            "variant": "llvm_ad_rgb",
        }
    )
    assert [table.title for table in tables] == ["Settings", "Camera", "Survey", "Host", "Backend"]
    values = [value for table in tables for _, value in table.rows]
    assert values == [
        *("1, 2 … 30 (30)", "yes", "–", "none"),
        *("2", "2", "1.5", "avx, fma", "samples per pixel 4", "llvm_ad_rgb"),
    ]


def test_the_key_figures_leave_out_what_a_mode_does_not_have() -> None:
    assert key_figures({"makespan_s": 12.0, "frames": 3}) == [("12 s", "makespan"), ("3", "frames")]
    assert key_figures({}) == []
    both = key_figures({"merge": {"records_out": 1000}, "coverage": {"records": 50}})
    assert both == [("1\u202f050", "records in the merged cache")]
