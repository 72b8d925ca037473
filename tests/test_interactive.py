"""Rendering from Python: who sees progress, and what requests, sessions and runs look like."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest
from rich.console import Console

import steadylight
from steadylight import interactive

FILM = {
    "frames": 2,
    "size": (16, 8),
    "quality": "draft",
    "spp": 1,
    "mode": "path",
    "cluster": "in-process",
}


@pytest.fixture
def finished(tmp_path, monkeypatch):
    """A run that was rendered where nobody watches."""
    monkeypatch.chdir(tmp_path)
    return steadylight.render("furnace", **FILM, output="out")


def test_nothing_is_said_where_there_is_no_terminal(finished, capfd):
    assert steadylight.render("furnace", **FILM, output="again").frames
    assert capfd.readouterr() == ("", "")


def test_a_terminal_shows_a_bar_for_each_pass(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(
        interactive, "Console", lambda stderr: Console(stderr=stderr, force_terminal=True, width=100)
    )
    steadylight.render("furnace", **FILM, output=tmp_path / "out")
    said = capfd.readouterr()
    assert said.out == ""
    assert re.search(r"frames .*\b2/2", re.sub(r"\x1b\[[\d;?]*\w", "", said.err))


def test_a_run_shows_its_numbers_and_in_a_notebook_its_video(finished):
    assert re.fullmatch(r"<Run out: 2 frames at 16x8 in [\d.]+ s, 0 missed>", repr(finished))
    view = finished._repr_html_()
    assert base64.b64encode(Path("out/animation.mp4").read_bytes()).decode() in view
    assert "2 frames at 16x8" in view


def test_requests_and_sessions_are_short(finished):
    request = steadylight.plan("furnace", **FILM, output="<a>")
    assert (
        repr(request) == "<Request scene furnace, frames 2, size 16x8, samples 1, mode path, directory <a>>"
    )
    assert "<td>&lt;a&gt;</td>" in request._repr_html_()
    session = steadylight.Session(steadylight.plan("furnace", **FILM, output="out"))
    assert repr(session) == "<Session out: not entered>"
    with session:
        assert repr(session) == "<Session out: 2 of 2 tasks done>"
        assert session._repr_html_() == "<p>Session out: 2 of 2 tasks done</p>"
