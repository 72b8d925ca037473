"""What the renderer says of itself, checks before a run, and does with cache files."""

from __future__ import annotations

import pytest

from steadylight.errors import BackendError, CacheFileError, SettingsError
from steadylight.renderers import find_renderer
from steadylight.renderers.radiance.ambient import encode_ambient, read_ambient
from steadylight.renderers.radiance.plugin import RENDERER
from steadylight.scenes.radiance import programs as radiance_programs


def test_it_is_found_by_its_name():
    assert find_renderer("radiance") is RENDERER
    assert RENDERER.capabilities.scenes == ("radiance", "mitsuba")


def test_a_scene_that_it_can_render_passes_with_versions_and_constants(job_of):
    job = job_of("room")
    backend = RENDERER.check(job.scene, job.settings, "auto", build=True)
    assert backend.versions["radiance"].startswith("RADIANCE")
    assert set(backend.versions) == {"radiance", "pyradiance"}
    assert backend.constants["divisions"] == 256


def test_settings_without_a_meaning_are_refused(job_of):
    job = job_of("room")
    with pytest.raises(SettingsError, match="--variant: cuda"):
        RENDERER.check(job.scene, job.settings, "cuda", build=False)
    split = job.settings.model_copy(update={"radii": "split-sphere"})
    with pytest.raises(SettingsError, match="--radii: split-sphere"):
        RENDERER.check(job.scene, split, "auto", build=False)


def test_without_pyradiance_it_says_what_to_install(job_of, monkeypatch):
    job = job_of("room")
    radiance_programs.home.cache_clear()
    radiance_programs.version.cache_clear()
    monkeypatch.setattr(radiance_programs, "find_spec", lambda _: None)
    try:
        with pytest.raises(BackendError, match="pip install pyradiance"):
            RENDERER.check(job.scene, job.settings, "auto", build=False)
    finally:
        radiance_programs.home.cache_clear()


def test_cache_files_are_described_merged_and_compared(gathered, tmp_path):
    _, paths = gathered
    files = RENDERER.cache_files
    lines = files.describe(paths[0])
    assert lines["scene"] == read_ambient(paths[0]).scene
    assert " -aa " in lines["made by"]
    counts = files.merge(paths, tmp_path / "merged.amb")
    assert 0 < counts["records_out"] <= counts["records_in"]
    assert files.differences(paths[0], paths[0])[0]
    same, lines = files.differences(paths[0], paths[1])
    assert not same
    assert lines["scene and options"] == "the same"


def test_files_of_other_scenes_are_not_merged(gathered, tmp_path):
    _, paths = gathered
    ambient = read_ambient(paths[0])
    other = tmp_path / "other.amb"
    other.write_bytes(encode_ambient(type(ambient)(ambient.header, ambient.records, "scene=x options=y")))
    with pytest.raises(CacheFileError, match="another scene or with other options"):
        RENDERER.cache_files.merge([paths[0], other], tmp_path / "merged.amb")
