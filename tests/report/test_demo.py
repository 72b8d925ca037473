"""The demo, with films that are made up instead of rendered: what it asks for, and the page that it ends with."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from handmade_runs import flickering, record_of, write_run
from typer.testing import CliRunner

from steadylight.checksum import with_checksum
from steadylight.cli import app, demo

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Settings of the films that the demo wants, in order; the third part of a second for each frame."""
    wanted: list[Any] = []

    def work_on(session: Any) -> Any:
        request = session.request
        settings = request.settings
        wanted.append(settings)
        numbers = list(settings.frames)
        root = request.directory
        if not (root / "run.json").exists():
            write_run(root, numbers, flickering(0.2 if settings.mode == "single-pass" else 0.0))
        record = record_of(numbers, (48, 36), settings.mode)
        record["settings"] = settings.model_dump(mode="json")
        (root / "run.json").write_text(json.dumps(with_checksum(record)))
        statistics = {
            "makespan_s": 2.0 * len(numbers),
            "second_pass": {"frame_seconds": [9.0] + [0.32] * (len(numbers) - 1)},
        }
        return SimpleNamespace(directory=root, statistics=statistics, frames=numbers)

    monkeypatch.setattr(demo, "work_on", work_on)
    monkeypatch.setattr(demo, "SCENE", "furnace")
    monkeypatch.setattr(demo, "FRAMES", "1-3")
    monkeypatch.setattr(demo, "_FIRST", 1)
    return wanted


def test_path_tracing_gets_the_time_of_two_pass_and_all_films_are_on_the_page(
    asked: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "_can_denoise", lambda: True)
    given = ["demo", "--output", str(tmp_path / "demo"), "--no-browser"]
    done = CliRunner().invoke(app, given, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert [settings.mode for settings in asked] == ["two-pass", "single-pass", "path", "path"]
    # Two seconds a frame at 0.02 seconds a sample are 100 samples, which is a square.
    assert asked[-1].spp == 100
    assert len({(settings.quality, settings.denoise, settings.width) for settings in asked}) == 1
    page = (tmp_path / "demo" / "compare.html").read_text()
    for name in ("two-pass", "single-pass", "path-denoised"):
        assert f"{name} <span>" in page
    assert str(tmp_path / "demo" / "compare.html") in done.output.replace("\n", "")

    asked.clear()
    monkeypatch.setattr(demo, "_can_denoise", lambda: False)  # what is installed meanwhile changes nothing
    CliRunner().invoke(app, given, catch_exceptions=False)
    assert {settings.denoise for settings in asked} == {True}
    # It is resumed: the path-traced film keeps its samples, and nothing is tried out again.
    assert [(settings.mode, settings.spp) for settings in asked] == [
        ("two-pass", 8),
        ("single-pass", 8),
        ("path", 100),
    ]


def test_a_demo_that_is_stopped_says_how_to_go_on(
    asked: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "work_on", stop)
    done = CliRunner().invoke(app, ["demo", "--output", str(tmp_path / "demo")])
    assert done.exit_code == 130
    assert not (tmp_path / "demo" / "compare.html").exists()
