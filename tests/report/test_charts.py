from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from steadylight.report.charts import Series, line_chart


def parse(svg: str) -> tuple[list[tuple[float, float]], ET.Element]:
    root = ET.fromstring(svg)
    line = root.find("polyline")
    assert line is not None
    return [tuple(map(float, point.split(","))) for point in line.get("points", "").split()], root


def test_the_line_runs_from_left_to_right_and_higher_values_stand_higher() -> None:
    points, _ = parse(line_chart(Series([1, 2, 3], [1.0, 3.0, 2.0])))
    (x1, y1), (x2, y2), (x3, y3) = points
    assert x1 < x2 < x3
    assert y2 < y3 < y1


def test_each_dot_tells_its_frame_and_value() -> None:
    _, root = parse(line_chart(Series([7], [0.25], "s")))
    assert [title.text for title in root.iter("title")] == ["frame 7: 0.25 s"]


def test_marked_frames_have_a_triangle_each_and_others_outside_none() -> None:
    _, root = parse(line_chart(Series([1, 2, 3], [0, 1, 2]), marked=[3, 1, 9]))
    assert [title.text for title in root.iterfind("path/title")] == ["selected frame 1", "selected frame 3"]


@pytest.mark.parametrize("from_zero", [True, False])
@pytest.mark.parametrize("level", [0.0, 1.0, -2.0])
def test_a_flat_line_stays_within_the_picture(level: float, from_zero: bool) -> None:
    points, _ = parse(line_chart(Series([1, 2], [level, level], from_zero=from_zero)))
    assert all(0 < y < 220 for _, y in points)


def test_the_line_joins_neighbouring_frames_only() -> None:
    root = ET.fromstring(line_chart(Series([1, 2, 3, 7, 9, 10], [0.1] * 6)))
    assert [len(line.get("points", "").split()) for line in root.findall("polyline")] == [3, 1, 2]
    assert len(root.findall("circle")) == 6


def test_a_chart_says_what_it_shows_without_being_seen() -> None:
    root = ET.fromstring(line_chart(Series([1, 2], [0.25, 0.5], "s"), title="Seconds <per> frame"))
    assert root.get("aria-label") == "Seconds <per> frame: 0.25 to 0.5 s, frames 1 to 2"


def test_a_long_film_has_no_dots() -> None:
    numbers = list(range(1, 1442))
    points, root = parse(line_chart(Series(numbers, [0.5] * 1441)))
    assert len(points) == 1441
    assert root.find("circle") is None
