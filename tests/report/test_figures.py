"""Figures for a paper, and the page about records: they are made of what is there, and say what is not."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from handmade_runs import flickering, record_of, write_run

from steadylight.camera import CameraPath, Keyframe
from steadylight.checksum import with_checksum
from steadylight.errors import InputError
from steadylight.metrics.region import Region
from steadylight.renderers.base import RecordTable, Surfaces
from steadylight.report.figures import STAGES, bfm_figure, change_figure, timeline_figure, write_figures
from steadylight.report.films import Film
from steadylight.report.records import Scenery, write_records_page

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from visits import Visit

WHOLE, LEFT = Region(0.0, 0.0, 1.0, 1.0), Region(0.0, 0.0, 0.5, 0.5)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A run of 9 frames whose camera moves evenly, with a journal."""
    root = write_run(tmp_path / "walk", list(range(1, 10)), flickering(0.2))
    record = record_of(list(range(1, 10)), (48, 36))
    key = record["camera"]["keyframes"][0]
    record["camera"]["keyframes"].append(key | {"time": 8 / 25, "origin": [4, 0, 0], "target": [4, 1, 0]})
    record["selected"] = [1, 5, 9]
    (root / "run.json").write_text(json.dumps(with_checksum(record)))
    (root / "log").mkdir()
    lines = [
        {
            "time": 100.0 + 5 * k,
            "task": f"shade-{k:05d}",
            "stage": "shade",
            "outcome": "failed" if k == 3 else "done",
        }
        | {"seconds": 4.0, "worker": f"node-{k % 2}", "attempt": 1, "result": {}}
        for k in range(1, 10)
    ]
    lines.append(lines[-1] | {"time": 5000.0, "task": "smooth", "stage": "smooth"})
    (root / "log" / "tasks.jsonl").write_text("".join(json.dumps(with_checksum(x)) + "\n" for x in lines))
    return root


def test_the_change_measure_rises_to_its_sum_with_a_mark_at_each_selected_frame(walk: Path) -> None:
    (axes, _) = change_figure(Film.open(walk)).axes
    line, marks = axes.lines
    assert line.get_ydata()[-1] == pytest.approx(1.0)  # the camera only moves
    assert list(marks.get_xdata()) == [1, 5, 9]
    assert marks.get_ydata()[1] == pytest.approx(0.5, abs=0.01)


def test_bfm_is_drawn_for_each_region_and_film(walk: Path, tmp_path: Path) -> None:
    steady = write_run(tmp_path / "steady", list(range(1, 10)), flickering(0.0), mode="single-pass")
    figure = bfm_figure([Film.open(steady), Film.open(walk)], [WHOLE, LEFT])
    _, left = figure.axes
    quiet, loud = (np.asarray(line.get_ydata()) for line in left.lines)
    assert quiet == pytest.approx(0.0)
    assert loud == pytest.approx(0.4, abs=0.02)
    assert [text.get_text().split(":")[0] for text in left.get_legend().get_texts()] == [
        "single-pass",
        "two-pass",
    ]


def test_bfm_has_whole_frames_as_ticks_and_more_films_than_colours(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / f"run-{k}", [51, 52, 53], flickering(0.1)) for k in range(7)]
    figure = bfm_figure([Film.open(run) for run in runs], [WHOLE])
    (axes,) = figure.axes
    assert len(axes.lines) == 7
    figure.draw_without_rendering()
    assert all(float(tick).is_integer() for tick in axes.get_xticks())


def test_frames_that_are_no_neighbours_have_no_bfm(tmp_path: Path) -> None:
    sparse = Film.open(write_run(tmp_path / "sparse", [1, 46, 91], flickering(0.1)))
    with pytest.raises(InputError, match="BFM needs two neighbouring frames"):
        bfm_figure([sparse], [WHOLE])


def test_a_timeline_of_all_stages_fills_its_width(walk: Path, tmp_path: Path) -> None:
    journal = walk / "log" / "tasks.jsonl"
    line = {"task": "a", "outcome": "done", "seconds": 4.0, "worker": "node", "attempt": 1, "result": {}}
    lines = [line | {"time": 10.0 * k, "stage": stage} for k, stage in enumerate(STAGES)]
    journal.write_text("".join(json.dumps(with_checksum(each)) + "\n" for each in lines))
    figure = timeline_figure(Film.open(walk))
    figure.savefig(tmp_path / "timeline.png")  # a layout that collapses is a warning, and so an error
    assert figure.axes[0].get_position().width > 0.8


def test_the_timeline_has_a_bar_for_each_attempt_and_no_long_pause(walk: Path) -> None:
    (axes,) = timeline_figure(Film.open(walk)).axes
    names = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert names == ["shade", "smooth", "failed or lost"]
    assert len(axes.patches) == 9 + 1 + 1
    assert max(bar.get_x() + bar.get_width() for bar in axes.patches) < 70
    assert [label.get_text() for label in axes.get_yticklabels()] == ["worker 1", "worker 2"]


def test_what_is_missing_costs_its_figure_only_and_the_same_run_gives_the_same_bytes(
    walk: Path, tmp_path: Path
) -> None:
    first = write_figures([walk], tmp_path / "a", [WHOLE])
    again = write_figures([walk], tmp_path / "b", [WHOLE])
    assert all(
        first[name].read_bytes() == again[name].read_bytes() for name in ("change-measure", "bfm", "timeline")
    )
    (walk / "log" / "tasks.jsonl").unlink()
    found = write_figures([walk], tmp_path / "c", [WHOLE], "svg")
    assert "records no task attempts" in str(found["timeline"])
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["bfm.svg", "change-measure.svg"]


def scenery(height: int = 24, width: int = 32) -> tuple[Scenery, np.ndarray]:
    """A wall ahead of a camera, and the position behind each pixel."""
    pose = CameraPath((Keyframe(0.0, (0, 0, 0), (0, 1, 0), fov=60.0),)).pose(0.0)
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    scale = 2 * np.tan(np.radians(30)) / width * 3
    position = np.stack(
        [(columns - width / 2) * scale, np.full(rows.shape, 3.0), (height / 2 - rows) * scale], axis=-1
    )
    normal = np.broadcast_to(np.float32([0, -1, 0]), position.shape)
    surfaces = Surfaces(position.astype(np.float32), normal, np.full((height, width), 3.0, np.float32))
    return Scenery(7, np.full((height, width, 3), 0.2, np.float32), pose, surfaces), position


def test_records_are_drawn_where_nothing_hides_them(tmp_path: Path, visit: Callable[..., Visit]) -> None:
    place, position = scenery()
    seen = position[::4, ::4].reshape(-1, 3)
    hidden = seen + np.array([0, 2.0, 0])
    everything = np.concatenate([seen, hidden, [[0, -5, 0]]]).astype(np.float32)
    count = len(everything)
    table = RecordTable(
        everything,
        np.tile(np.float32([0, -1, 0]), (count, 1)),
        np.full(count, 0.2, np.float32),
        np.full((count, 3), 1.5, np.float32),
        np.linspace(0.01, 0.3, count).astype(np.float32),
        np.zeros(count, np.intp),
    )
    origin = np.where(np.arange(count) % 2, 4, -1)
    page = write_records_page(
        tmp_path / "records.html", "walk", place, table, {"frame": origin, "part": np.zeros(count, np.int64)}
    )
    visited = visit(page, 400, "dark", ready=False)
    facts = visited.page.inner_text(".figures")
    assert f"{count}" in facts
    assert f"{len(seen)}\nseen in it" in facts
    assert visited.page.locator("figure:visible").count() == 2
    visited.page.check("#by2")
    assert visited.page.get_attribute("figure:visible img", "alt").endswith("coloured by frame")
    assert visited.findings() == []
    assert visited.overflow() <= 0
    assert visited.complaints == []


def test_a_cache_without_records_has_a_page_too(tmp_path: Path) -> None:
    place, _ = scenery()
    none = [np.zeros(shape, np.float32) for shape in ((0, 3), (0, 3), (0,), (0, 3), (0,))]
    page = write_records_page(
        tmp_path / "r.html", "walk", place, RecordTable(*none, np.zeros(0, np.intp)), {}
    )
    assert "<b>0</b>" in page.read_text()
