"""The integrator plugin in Mitsuba's own loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
import pytest

from steadylight.cache.file import CacheFile, encode_cache

if TYPE_CHECKING:
    from pathlib import Path


def integrator(**parameters: Any) -> Any:
    return mi.load_dict({"type": "irradiance_cache", "quality": "draft", **parameters})


@pytest.fixture(scope="module")
def box() -> Any:
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": 48, "height": 48}
    return mi.load_dict(box)


@pytest.fixture(scope="module")
def rendered(box: Any) -> tuple[Any, np.ndarray]:
    plugin = integrator()
    return plugin, np.array(mi.render(box, integrator=plugin, spp=64, seed=1))


def test_the_cornell_box_looks_as_path_traced(box: Any, rendered: Any) -> None:
    _, image = rendered
    path = mi.load_dict({"type": "path", "max_depth": 64, "rr_depth": 99})
    reference = np.array(mi.render(box, integrator=path, spp=256, seed=2))
    assert image.shape == reference.shape == (48, 48, 3)
    np.testing.assert_allclose(image.mean((0, 1)), reference.mean((0, 1)), rtol=0.02)
    parts = [a.reshape(4, 12, 4, 12, 3).mean(axis=(1, 3)) for a in (image, reference)]
    np.testing.assert_allclose(*parts, rtol=0.1, atol=0.01)


def test_further_renders_add_only_what_is_missing(box: Any, rendered: Any) -> None:
    plugin, image = rendered
    before = len(plugin.records)
    assert before > 100
    again = np.array(mi.render(box, integrator=plugin, spp=64, seed=2))
    assert before <= len(plugin.records) < 1.1 * before
    np.testing.assert_allclose(again.mean((0, 1)), image.mean((0, 1)), rtol=0.02)


def test_a_cache_file_is_a_start(box: Any, rendered: Any, tmp_path: Path) -> None:
    plugin, _ = rendered
    path = tmp_path / "box.cache"
    path.write_bytes(encode_cache(CacheFile(plugin.records, "0" * 64, {})))
    started = integrator(filename=str(path))
    assert len(started.records) == len(plugin.records)
    mi.render(box, integrator=started, spp=1, seed=1)
    assert len(started.records) < 1.1 * len(plugin.records)
    # Mitsuba puts whatever a constructor raises into an error of its own.
    with pytest.raises(RuntimeError, match=r"none\.cache: no such cache file"):
        integrator(filename=str(tmp_path / "none.cache"))


def test_without_bounces_no_records_are_made(box: Any) -> None:
    plugin = integrator(bounces=0)
    image = np.array(mi.render(box, integrator=plugin, spp=16))
    assert len(plugin.records) == 0
    assert image.mean() > 0.05


def test_what_is_changed_in_a_scene_between_two_renders_is_seen() -> None:
    """Kernels were recorded with the scene as it was."""
    content = mi.cornell_box()
    content["sensor"]["film"] |= {"width": 24, "height": 24}
    own = mi.load_dict(content)
    walls = mi.traverse(own)
    irradiance = []
    for reflectance in (0.8, 0.4):
        for key in [key for key in walls.keys() if key.endswith("reflectance.value")]:  # noqa: SIM118 - no dict
            walls[key] = mi.Color3f(reflectance)
        walls.update()
        plugin = integrator(bounces=1)
        mi.render(own, integrator=plugin, spp=1, seed=1)
        irradiance.append(plugin.records.irradiance.sum(axis=1).mean())
    assert irradiance[1] == pytest.approx(irradiance[0] / 2, rel=0.05)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"bounces": -2}, "bounces must be at least -1"),
        ({"depth": 0}, "depth at least 1"),
        ({"quality": "best"}, "quality: give draft, normal, high, or a number from 0.0625 to 16; not .*best"),
    ],
)
def test_a_bad_parameter_is_refused_with_what_would_be_right(parameters: Any, words: str) -> None:
    with pytest.raises(RuntimeError, match=words):
        integrator(**parameters)


def test_a_misspelt_parameter_is_refused() -> None:
    with pytest.raises(RuntimeError, match="bounce_count"):
        integrator(bounce_count=3)


def test_sampling_before_the_cache_is_filled_is_refused(box: Any) -> None:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0, 0, 3), mi.Vector3f(0, 0, -1)))
    with pytest.raises(RuntimeError, match=r"call render\(\) or fill"):
        integrator().sample(box, sampler, ray)


def test_its_words_for_logs_name_the_settings() -> None:
    assert "bounces=3, depth=5, quality=draft, records=0" in str(integrator(bounces=3, depth=5))
