"""Renderers by name, by what they read, and by their cache files; that finding one loads none of its libraries."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from steadylight import renderers
from steadylight.errors import CacheFileError, SettingsError
from steadylight.renderers import find_renderer, renderer_names, renderer_of, renderers_for
from steadylight.renderers.base import Survey


class Entry:
    """An entry point of another package."""

    def __init__(self, name, loaded):
        self.name, self.load = name, loaded


@pytest.fixture
def installed(monkeypatch):
    """Give entry points that there are besides ours."""

    def install(*others):
        real = renderers.entry_points

        def all_of(group, name=None):
            ours = list(real(group=group, name="mitsuba"))
            return [entry for entry in (*ours, *others) if name in {None, entry.name}]

        monkeypatch.setattr(renderers, "entry_points", all_of)

    return install


def broken():
    raise ImportError("no module named wax")


def test_mitsuba_is_found_and_says_its_name():
    assert "mitsuba" in renderer_names()
    assert find_renderer("mitsuba").name == "mitsuba"


def test_a_name_that_is_not_there_is_told_with_those_that_are():
    with pytest.raises(SettingsError, match=r"no 'candle'; installed: .*mitsuba"):
        find_renderer("candle")


def test_a_package_that_cannot_be_loaded_is_told_and_spoils_nothing_else(installed):
    installed(Entry("candle", broken))
    with pytest.raises(SettingsError, match=r"--renderer: candle cannot be loaded \(no module named wax\)"):
        find_renderer("candle")
    assert renderers_for("mitsuba") == ["mitsuba"]


def test_a_cache_file_belongs_to_the_renderer_of_its_suffix(installed):
    installed(Entry("candle", broken))
    assert renderer_of(Path("a/merged.safetensors"))[0].name == "mitsuba"
    with pytest.raises(
        CacheFileError,
        match=r"a\.txt: does not have the extension of a cache file; .*\.safetensors \(mitsuba\)",
    ):
        renderer_of(Path("a.txt"))


def test_a_survey_of_one_part_is_read_by_every_window():
    survey = Survey.undivided(3)
    assert survey.parts == 1
    assert survey.windows == ((0,), (0,), (0,))
    assert survey.neighbours == ((),)


def test_to_find_every_renderer_loads_neither_mitsuba_nor_drjit():
    script = (
        "import sys; from steadylight.renderers import renderers_for\n"
        "renderers_for('mitsuba')\n"
        "print('loaded:', sorted({'mitsuba', 'drjit', 'dask', 'pyradiance'} & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "loaded: []" in said.stdout
