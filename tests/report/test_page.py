from __future__ import annotations

import base64
import json
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.checksum import parse, with_checksum
from steadylight.errors import SettingsError
from steadylight.images import write_exr
from steadylight.report import page, write_report

if TYPE_CHECKING:
    from pathlib import Path

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Elements, addresses and text of a page; fails on elements that do not close."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in {"src", "href", "xlink:href"}]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.words.append(data.strip())


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run of 5 frames."""
    (tmp_path / "frames").mkdir()
    for number in range(1, 6):
        write_exr(tmp_path / "frames" / f"frame_{number:05d}.exr", np.full((6, 8, 3), 0.1 * number))
    settings = {"frames": [1, 2, 3, 4, 5], "mode": "two-pass", "width": 8, "height": 6, "spp": 16}
    record = {"scene": {"name": "<gallery> & co"}, "settings": settings, "selected": [1, 4]}
    (tmp_path / "run.json").write_text(json.dumps(with_checksum(record)))
    statistics = {
        "makespan_s": 75.0,
        "frames": 5,
        "selected_frames": [1, 4],
        "first_pass": {"rays": 640, "hits": 580, "misses": 58, "records": 58, "seconds": 1.5},
        "second_pass": {"seconds": 2.0, "frame_seconds": [0.3, 0.2, 0.2, 0.2, 0.2], "missed": 0},
        "tasks": {"done": 9, "attempts": 10, "failed": 0, "lost": 1},
    }
    (tmp_path / "stats.json").write_text(json.dumps(statistics))
    (tmp_path / "animation.mp4").write_bytes(b"a film")
    return tmp_path


def test_the_page_is_well_formed_and_holds_pictures_film_charts_and_tables(run: Path) -> None:
    assert write_report(run) == run / "report.html"
    found = Page(run / "report.html")
    assert found.elements.count("img") == 5
    assert found.elements.count("svg") == 3
    assert found.elements.count("video") == 1
    for words in ("<gallery> & co", "1 min 15 s", "First pass", "90.91%", "Tasks", "Seconds per frame"):
        assert words in found.words


def test_the_page_needs_nothing_but_itself(run: Path) -> None:
    found = Page(write_report(run))
    assert all(address.startswith("data:") for address in found.addresses)
    film = next(a for a in found.addresses if a.startswith("data:video/mp4;base64,"))
    assert base64.b64decode(film.partition(",")[2]) == b"a film"
    text = (run / "report.html").read_text()
    assert "http" not in text
    assert "@import" not in text


def test_a_large_film_is_linked_beside_the_page(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "LARGEST_EMBEDDED_VIDEO", 3)
    assert "animation.mp4" in Page(write_report(run)).addresses


def test_frames_of_the_first_pass_are_marked_in_strip_and_charts(run: Path) -> None:
    words = Page(write_report(run)).words
    assert words.count("▲ first pass") == 2
    assert words.count("selected frame 4") == 3


def test_the_same_run_gives_the_same_page(run: Path) -> None:
    first = write_report(run).read_bytes()
    assert write_report(str(run)).read_bytes() == first


def test_a_run_that_is_not_finished_is_said_to_be_so(run: Path) -> None:
    (run / "stats.json").unlink()
    (run / "animation.mp4").unlink()
    (run / "frames" / "frame_00002.exr").unlink()
    found = Page(write_report(run))
    assert any("not finished" in words for words in found.words)
    assert "video" not in found.elements
    assert found.elements.count("svg") == 2  # brightness, and BFM of the neighbouring frames


def test_frames_with_gaps_between_all_of_them_have_no_flicker(run: Path) -> None:
    for number in (2, 4):
        (run / "frames" / f"frame_{number:05d}.exr").unlink()
    assert "Brightness flickering metric" not in Page(write_report(run)).words


def test_the_page_begins_with_what_a_client_asks(run: Path) -> None:
    statistics = json.loads((run / "stats.json").read_text())
    session = {"started": "2026-11-24T04:07:53+00:00", "host": "node-1", "seconds": 75.0}
    (run / "stats.json").write_text(json.dumps(statistics | {"sessions": [session, session]}))
    record = parse((run / "run.json").read_bytes())
    record["settings"]["fps"] = 25.0
    (run / "run.json").write_text(json.dumps(with_checksum(record)))
    words = Page(write_report(run)).words
    order = [
        "5 frames, 0.2 s at 25 frames per second · 8×6",
        "Rendered 24 November 2026 on node-1 in 1 min 15 s",
        "Video",
        "Frames",
        "How it was rendered",
        "two-pass · 16 samples per pixel",
        "makespan",
        "Over the animation",
        "Statistics",
    ]
    places = [words.index(each) for each in order]
    assert places == sorted(places)


def test_a_film_of_one_frame_has_a_page(run: Path) -> None:
    for number in range(2, 6):
        (run / "frames" / f"frame_{number:05d}.exr").unlink()
    assert Page(write_report(run)).elements.count("img") == 1


def test_the_strip_of_a_long_film_is_short(run: Path) -> None:
    for number in range(6, 40):
        write_exr(run / "frames" / f"frame_{number:05d}.exr", np.full((6, 8, 3), 0.5))
    assert Page(write_report(run)).elements.count("img") == page.THUMBNAILS


class TestErrors:
    def test_a_folder_that_is_no_run(self, tmp_path: Path) -> None:
        with pytest.raises(SettingsError, match="not a run directory"):
            write_report(tmp_path)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("text", ["{", "[]"])
    def test_statistics_that_cannot_be_read_are_named_and_the_rest_is_shown(
        self, run: Path, text: str
    ) -> None:
        (run / "stats.json").write_text(text)
        found = Page(write_report(run))
        assert any("stats.json: cannot be read" in words for words in found.words)
        assert found.elements.count("img") == 5

    def test_a_run_without_frames_has_a_page_that_says_so(self, run: Path) -> None:
        for path in (run / "frames").iterdir():
            path.unlink()
        found = Page(write_report(run))
        assert any("contains no frames" in words for words in found.words)
        assert "makespan" in found.words
        assert found.elements.count("img") == 0

    def test_a_frame_that_was_cut_short_is_named_and_left_out(self, run: Path) -> None:
        path = run / "frames" / "frame_00003.exr"
        path.write_bytes(path.read_bytes()[:-5])
        found = Page(write_report(run))
        assert any("frame_00003.exr: is truncated" in words for words in found.words)
        assert found.elements.count("img") == 4

    def test_a_damaged_record_is_named_and_the_frames_are_shown(self, run: Path) -> None:
        (run / "run.json").write_text("{")
        found = Page(write_report(run))
        assert any("run.json: cannot be read" in words for words in found.words)
        assert found.elements.count("img") == 5
