"""The surfaces of a scene as rays meet them are those of boxes whose intersections are known, by every renderer."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from boxes import FURNISHED, Boxes
from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers import geometry_of
from steadylight.scenes import read_scene
from steadylight.scenes.description import SceneDescription
from steadylight.settings import SceneOptions

VIEW = CameraPath((Keyframe(0, (1, 1, 1), (2, 1, 1)),))


def rays(count=4000):
    rng = np.random.default_rng(7)
    directions = rng.normal(size=(count, 3))
    return rng.uniform((0.1, 0.1, 0.1), (7.9, 3.9, 2.5), (count, 3)), directions / np.linalg.norm(
        directions, axis=1, keepdims=True
    )


def assert_same_hits(found, wanted):
    met = np.isfinite(wanted.distance)
    assert (np.isfinite(found.distance) == met).mean() > 0.999
    both = met & np.isfinite(found.distance)
    near = np.isclose(found.distance, wanted.distance, rtol=1e-4, atol=1e-5) & both
    assert near[both].mean() > 0.998  # the rest passes through edges
    assert np.median(np.abs(found.normal - wanted.normal)[near]) < 1e-5
    same = np.linalg.norm(found.normal - wanted.normal, axis=1) < 1e-3
    assert same[near].mean() > 0.99  # where boxes touch, either may be met


class TestMitsuba:
    @pytest.fixture(scope="class")
    @classmethod
    def geometry(cls):
        content = {"lamp": {"type": "point", "position": [1.0, 2.0, 2.5], "intensity": 1.0}}
        for number, (low, high) in enumerate(np.array(FURNISHED)):
            to_world = np.diag([*(high - low) / 2, 1.0])
            to_world[:3, 3] = (low + high) / 2
            bsdf = {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": [0.1 + 0.05 * number, 0.5, 0.2]},
            }
            content[f"box_{number}"] = {"type": "cube", "to_world": to_world, "bsdf": bsdf}
        return geometry_of(SceneDescription("boxes", content, VIEW), "mitsuba", "llvm")

    @pytest.mark.parametrize("longest", [np.inf, 1.0])
    def test_hits(self, geometry, longest):
        given = rays()
        found, wanted = geometry.cast(*given, longest), Boxes(FURNISHED).cast(*given, longest)
        assert_same_hits(found, wanted)
        names = np.array([*geometry.shapes, ""])[found.shape]
        assert (names == np.array([*Boxes(FURNISHED).shapes, ""])[wanted.shape]).mean() > 0.99

    def test_bounds_lamps_and_colours(self, geometry):
        assert geometry.bounds == pytest.approx(Boxes(FURNISHED).bounds, abs=1e-5)
        (lamp,) = geometry.lamps
        assert lamp.position == pytest.approx((1.0, 2.0, 2.5))
        down = np.array([[3.0, 1.0, 1.0], [2.0, 2.0, 1.0], [2.0, 2.0, 9.0]])
        colours = geometry.colours(down, np.array([[0, 0, -1.0], [0, 0, -1.0], [0, 0, 1.0]]))
        assert colours[:2] == pytest.approx(np.array([[0.1, 0.5, 0.2], [0.55, 0.5, 0.2]]), abs=1e-5)
        assert np.isnan(colours[2]).all()

    @pytest.mark.parametrize("kind", ["conductor", "roughconductor"])
    def test_the_colour_of_metal_is_what_it_reflects(self, kind):
        content = {
            "sheet": {
                "type": "rectangle",
                "bsdf": {
                    "type": kind,
                    "material": "none",
                    "specular_reflectance": {"type": "rgb", "value": [0.8, 0.4, 0.1]},
                },
            }
        }
        geometry = geometry_of(SceneDescription("sheet", content, VIEW), "mitsuba", "llvm")
        slanted = np.array([[0.6, 0, -0.8]])
        assert geometry.colours(-slanted, slanted) == pytest.approx(np.array([[0.8, 0.4, 0.1]]), rel=0.03)


@pytest.mark.skipif(importlib.util.find_spec("pyradiance") is None, reason="needs pyradiance")
def test_radiance(tmp_path):
    text = "void plastic white\n0\n0\n5 .5 .5 .5 0 0\n"
    for number, ((x0, y0, z0), (x1, y1, z1)) in enumerate(FURNISHED):
        text += f"!genbox white box_{number} {x1 - x0:g} {y1 - y0:g} {z1 - z0:g} | xform -t {x0} {y0} {z0}\n"
    (tmp_path / "boxes.rad").write_text(text)
    geometry = geometry_of(
        read_scene(tmp_path / "boxes.rad", SceneOptions(), ("radiance",)), "radiance", "auto"
    )
    assert type(geometry).__name__ == "RadianceGeometry"
    given = rays()
    assert_same_hits(geometry.cast(*given), Boxes(FURNISHED).cast(*given))
    low, high = geometry.bounds
    assert (low <= (-0.2, -0.2, -0.2)).all()
    assert (high >= (8.2, 4.2, 2.8)).all()
