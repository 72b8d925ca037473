"""What cannot be looked into, or compared, is refused in words that help."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from handmade_runs import flickering, write_run
from typer.testing import CliRunner

from steadylight.animation.inspection import BOX, Inspection, number_of
from steadylight.cli import app
from steadylight.engines import Task
from steadylight.errors import InputError, SettingsError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "walk", [1, 2, 3], flickering(0.1))


def test_a_frame_that_the_run_does_not_have_is_named(run: Path) -> None:
    with pytest.raises(SettingsError, match=r"--frame: 9 is not a frame of .*walk, which has 1 to 3"):
        Inspection(run, 9)


def test_a_cache_that_is_not_there_yet_is_named(run: Path) -> None:
    with pytest.raises(InputError, match=r"smoothed\.safetensors: does not exist yet"):
        Inspection(run, 2)


def test_a_mode_without_a_cache_is_refused(tmp_path: Path) -> None:
    single = write_run(tmp_path / "single", [1, 2], flickering(0.1), mode="single-pass")
    with pytest.raises(SettingsError, match="--mode single-pass, which keeps no cache"):
        Inspection(single, 1)


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="not a run directory"):
        Inspection(tmp_path, 1)


def test_a_pixel_outside_the_frame_or_without_a_comma_is_refused(run: Path) -> None:
    (run / "cache").mkdir()
    (run / "cache" / "smoothed.safetensors").write_bytes(b"")
    with pytest.raises(SettingsError, match=r"--pixel: 48,0 is outside the frame of 48x36 pixels"):
        Inspection(run, 2).questions(48, 0)
    for text in ("3", "3;4", "a,b", "1,2,3"):
        done = CliRunner().invoke(app, ["why", str(run), "--frame", "2", "--pixel", text])
        assert isinstance(done.exception, SettingsError)
        assert "give a column and a row" in str(done.exception)


@pytest.mark.parametrize("count", [1, 3])
def test_a_table_compares_two_runs_and_a_page_any_number(run: Path, tmp_path: Path, count: int) -> None:
    given = ["compare", *[str(run)] * count]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, SettingsError)
    assert "give two, or add --html" in str(done.exception)
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, [*given, "--html", "--output", str(page)], catch_exceptions=False)
    assert done.exit_code == 0
    assert page.is_file()


def test_figures_are_written_and_named(run: Path, tmp_path: Path) -> None:
    given = [
        "figures",
        str(run),
        "--region",
        "0.0,0.0,0.5,0.5",
        "--format",
        "svg",
        "--output",
        str(tmp_path / "f"),
    ]
    done = CliRunner().invoke(app, given, catch_exceptions=False)
    assert done.exit_code == 0
    assert (tmp_path / "f" / "bfm.svg").is_file()
    assert "timeline: no figure:" in done.output


def test_watching_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["watch", str(tmp_path / "nowhere")])
    assert isinstance(done.exception, InputError)
    assert "no such folder" in str(done.exception)


def test_makers_of_records_are_frames_boxes_and_rounds_of_the_audit() -> None:
    def task(key: str, **arguments: object) -> Task:
        return Task(key, key.partition("-")[0], ("out",), (), {"frames": [], "round": 0, **arguments})

    tasks = [task("gather-00012", frames=[12]), task("gather-003"), task("fill-2", round=2)]
    assert [number_of(each) for each in tasks] == [12, BOX + 3, -2]
