"""Transmittance of specular layers over a diffuse base, for incident light."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from reference_gather import polygon_irradiance
from small_scenes import described, paint, place, plain_lighting

from steadylight.renderers.mitsuba.bsdf.base_transmittance import STEPS, BaseTransmittance
from steadylight.renderers.mitsuba.bsdf.lobes import diffuse_context
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.scene import build_scene

VARNISH = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}
COSINE = (np.arange(STEPS) + 0.5) / STEPS


def transmitted(bsdf: mi.BSDF, cosine: np.ndarray) -> np.ndarray:
    """What the table says of a BSDF; 1 without a table."""
    table = BaseTransmittance.of([bsdf], diffuse_context())
    if table is None:
        return np.ones_like(cosine)
    number = dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))
    return np.array(table.at(dr.repeat(number, len(cosine)), mi.Float(cosine)))


def test_what_enters_varnish_is_what_fresnel_leaves() -> None:
    fine = np.linspace(0.02, 1, 200)
    ior = 1.49 / 1.000277  # polypropylene in air, Mitsuba's defaults
    passed = 1 - np.array(mi.fresnel(mi.Float(fine), mi.Float(ior))[0])
    every = (np.arange(20000) + 0.5) / 20000
    mean = 2 * np.mean((1 - np.array(mi.fresnel(mi.Float(every), mi.Float(ior))[0])) * every)
    np.testing.assert_allclose(transmitted(mi.load_dict(VARNISH), fine), passed / mean, rtol=0.01)


@pytest.mark.parametrize("kind", ["plastic", "roughplastic"])
def test_light_from_all_sides_enters_as_much_as_irradiance_says(kind: str) -> None:
    row = transmitted(mi.load_dict(VARNISH | {"type": kind}), COSINE)
    assert row[0] < 0.5
    assert row[-1] > 1
    assert (row * COSINE).sum() / COSINE.sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("reflectance", [0.0, 0.8])
def test_a_black_base_and_a_lambertian_lobe_need_no_table(reflectance: float) -> None:
    value = {"type": "rgb", "value": [reflectance] * 3}
    black = mi.load_dict({"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.0] * 3}})
    assert (
        BaseTransmittance.of(
            [black, mi.load_dict({"type": "diffuse", "reflectance": value})], diffuse_context()
        )
        is None
    )


def test_a_mixture_of_varnish_and_paint_lies_between_the_two() -> None:
    mixed = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": VARNISH, "b": paint(0.9, 0.9, 0.9)})
    varnish, row = transmitted(mi.load_dict(VARNISH), COSINE), transmitted(mixed, COSINE)
    assert (np.abs(row - 1) < np.abs(varnish - 1)).mean() > 0.9
    assert row[0] - varnish[0] > 0.1
    assert 1 - row[0] > 0.1


def lit_from_the_side(bsdf: dict[str, Any]) -> tuple[float, float]:
    """Irradiance of records on a square of this BSDF, by a wall that parallel light lights; and the closed form."""
    turned = place((1.0, 1.0, 1), (-1.5, 0, 0.6), about=(0, 1, 0), degrees=90)
    content = {
        "square": {"type": "rectangle", "to_world": place((0.05, 0.05, 1)), "bsdf": bsdf},
        "wall": {"type": "rectangle", "to_world": turned, "bsdf": paint(0.7, 0.7, 0.7)},
        "sun": {
            "type": "directional",
            "direction": [-1, 0, 0],
            "irradiance": {"type": "rgb", "value": [2.0] * 3},
        },
    }
    lighting = plain_lighting(build_scene(described(content)))
    quality = RecordQuality(polar_strata=15, azimuth_strata=40, refinement_paths=(900,))
    position, up = np.zeros((300, 3), np.float32), np.tile(np.float32([0, 0, 1]), (300, 1))
    size = np.full(300, 1e-2, np.float32)
    places = Places(position, up, Bounds(size, size))
    found = gather_records(Gather(quality, 1, GatherContext(lighting)), places, 1).irradiance.mean()
    corners = (turned @ [[-1, 1, 1, -1], [-1, -1, 1, 1], [0] * 4, [1] * 4])[:3].T
    corners[:, 2] = np.maximum(corners[:, 2], 0)  # the rest is below the horizon
    seen = abs(float(polygon_irradiance(corners, np.zeros(3), np.array([0, 0, 1.0]))))
    return float(found), 0.7 * 2.0 / np.pi * seen


def test_a_record_on_varnish_weighs_what_it_gathers_by_what_enters() -> None:
    painted, expected = lit_from_the_side(paint(0.5, 0.5, 0.5))
    assert painted == pytest.approx(expected, rel=0.01)
    varnished, _ = lit_from_the_side(VARNISH)
    # By quadrature: directions to the wall, weighted by the cosine and by what enters.
    y, z = np.meshgrid((np.arange(400) + 0.5) / 200 - 1, (np.arange(400) + 0.5) / 400 * 1.6)
    squared = 1.5**2 + y**2 + z**2
    weight = 1.5 * z / squared**2  # cosines at both ends over the distance squared
    share = transmitted(mi.load_dict(VARNISH), np.ravel(z / np.sqrt(squared)))
    ratio = (np.ravel(weight) * share).sum() / weight.sum()
    assert ratio < 0.96
    assert varnished / painted == pytest.approx(ratio, rel=0.01)
