"""Directions of an environment: the density is what it says, and all that shines is found."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, paint, place

from steadylight.renderers.mitsuba.light.directions import DirectionTable, guided_search, search_guide
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.scene import build_scene

LANES = 1 << 18
FLOOR = {"type": "rectangle", "to_world": place((2, 2, 1)), "bsdf": paint(0.5, 0.5, 0.5)}
SUN = np.array([0.6, 0.0, 0.8])


def few_pixels() -> dict[str, Any]:
    """A sun of two by three pixels, smooth between them, in a map turned so that it stands at `SUN`, about."""
    image = np.full((256, 512, 3), 0.8, np.float32)
    image[90:92, 120:123] = 3000
    return {"type": "envmap", "data": image}


SKIES: dict[str, dict[str, Any]] = {
    "small sun": {"type": "sunsky", "sun_direction": SUN.tolist()},
    "wide sun": {"type": "sunsky", "sun_direction": SUN.tolist(), "sun_aperture": 10.0},
    "no sun": {"type": "sunsky", "sun_direction": SUN.tolist(), "sun_scale": 0.0},
    "few pixels": few_pixels(),
    "even": {"type": "constant", "radiance": 2.0},
}


def table(sky: dict[str, Any], *, whole: bool) -> tuple[DirectionTable, Environment]:
    scene = build_scene(described({"floor": FLOOR, "sky": sky}))
    environment = Environment(scene)
    return DirectionTable(environment, 32, whole=whole), environment


def sampler(seed: int) -> Any:
    made = mi.load_dict({"type": "independent"})
    made.seed(seed, LANES)
    return made


def evenly(found: DirectionTable, seed: int) -> list[tuple[Any, float]]:
    """Directions spread evenly over the sun, if there is one, and over all else; and the solid angle of each part."""
    points = sampler(seed)
    sphere = mi.warp.square_to_uniform_sphere(points.next_2d())
    if found.sun is None:
        return [(sphere, 4 * np.pi)]
    cap = 1.5 * found.sun.height
    axis = mi.Vector3f(*found.sun.frame[2].tolist())
    near = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(points.next_2d(), 1 - cap))
    kept = np.array(dr.dot(sphere, axis) < 1 - cap)
    far = mi.Vector3f(np.ascontiguousarray(np.array(sphere)[:, kept]))
    return [(near, 2 * np.pi * cap), (far, 4 * np.pi - 2 * np.pi * cap)]


def shining(environment: Environment, d: Any, *, whole: bool) -> Any:
    """Luminance, of all or of what the cache does not hold."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
    si.wi = -d
    radiance = environment.emitter.eval(si)
    return mi.luminance(radiance if whole else radiance * (1 - environment.cached_fraction(radiance)))


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "what the cache does not hold"])
@pytest.mark.parametrize("name", SKIES)
def test_samples_of_all_patches_sum_up_to_what_the_environment_sends(name: str, whole: bool) -> None:
    found, environment = table(SKIES[name], whole=whole)
    expected, variance = 0.0, 0.0
    for d, solid_angle in evenly(found, 1):
        values = np.array(shining(environment, d, whole=whole) + dr.zeros(mi.Float, dr.width(d)), np.float64)
        expected += values.mean() * solid_angle
        variance += np.square(values.std() * solid_angle) / len(values)
    if expected == 0:
        assert found.count == 0
        return
    share = found.energy / found.energy.sum()
    points = sampler(2)
    patch = np.minimum(np.searchsorted(np.cumsum(share), np.array(points.next_1d())), found.count - 1)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    ds, _ = found.sample(mi.UInt32(patch.astype(np.uint32)), si, points.next_2d(), mi.Bool(True))
    pdf = np.array(ds.pdf, np.float64) * share[patch]
    sent = np.array(shining(environment, ds.d, whole=whole) + dr.zeros(mi.Float, LANES), np.float64)
    values = np.divide(sent, pdf, out=np.zeros(LANES), where=pdf > 0)
    error = np.hypot(np.sqrt(variance), values.std() / np.sqrt(LANES))
    assert abs(values.mean() - expected) < 4 * error + 1e-3 * expected
    assert values.std() < 0.4 * values.mean()


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "what the cache does not hold"])
@pytest.mark.parametrize("name", ["small sun", "wide sun", "few pixels"])
def test_the_density_of_a_patch_integrates_to_one_and_is_that_of_its_samples(name: str, whole: bool) -> None:
    found, _ = table(SKIES[name], whole=whole)
    total, error = np.zeros(found.count), np.zeros(found.count)
    for d, solid_angle in evenly(found, 3):
        patch, pdf = (np.array(values) for values in found.pdf(d, mi.Bool(True)))
        for number in range(found.count):
            values = np.where(patch == number, pdf, 0).astype(np.float64)
            total[number] += values.mean() * solid_angle
            error[number] = np.hypot(error[number], values.std() * solid_angle / np.sqrt(len(values)))
    # Of cells on the edge of the sun, samples that fall into it are left out.
    assert (total < 1 + 5 * error).all()
    assert (np.abs(total - 1) < 5 * error + 0.02).sum() >= found.count - 2
    points = sampler(4)
    patch = np.arange(LANES) % found.count
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    ds, _ = found.sample(mi.UInt32(patch.astype(np.uint32)), si, points.next_2d(), mi.Bool(True))
    told_patch, told = (np.array(values) for values in found.pdf(ds.d, mi.Bool(True)))
    drawn = np.array(ds.pdf)
    same = (drawn > 0) & (told_patch == patch)
    assert same.sum() > 0.75 * LANES
    # But for directions that rounding takes to the next cell.
    assert (np.abs(told[same] - drawn[same]) < 1e-4 * drawn[same]).mean() > 0.999


@pytest.mark.parametrize(("name", "radius"), [("small sun", 0.2669), ("wide sun", 5.0), ("no sun", None)])
def test_the_sun_is_found_where_it_is_and_as_wide_as_it_is(name: str, radius: float | None) -> None:
    found, _ = table(SKIES[name], whole=False)
    if radius is None:
        assert found.sun is None
        return
    assert found.sun is not None
    assert np.degrees(np.arccos(1 - found.sun.height)) == pytest.approx(radius, rel=4e-3)
    assert np.linalg.norm(found.sun.frame[2] - SUN) < 2e-3 * np.radians(radius)


# Mitsuba finds the edge of the sun by the cosine of a quarter of a degree, which has few digits: it is ragged.
@pytest.mark.parametrize(("name", "missing"), [("small sun", 0.01), ("wide sun", 1e-3)])
def test_hardly_a_sample_of_the_sun_misses_it_and_all_others_bring_as_much(name: str, missing: float) -> None:
    found, environment = table(SKIES[name], whole=False)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    ds, _ = found.sample(mi.UInt32(found.count - 1), si, sampler(5).next_2d(), mi.Bool(True))
    values = np.array(shining(environment, ds.d, whole=False) / ds.pdf, np.float64)
    assert (values == 0).mean() < missing
    hits = values[values > 0]
    assert hits.std() < 0.03 * hits.mean()


def test_a_guided_search_finds_what_a_search_of_all_cells_finds() -> None:
    rng = np.random.default_rng(1)
    sizes = [1, 2, 3, 700, 5000, 20000]
    ends = np.cumsum([0, *sizes])
    patches = []
    for size in sizes:
        # Many cells are never chosen, and a few nearly always.
        share = np.where(rng.random(size) < 0.3, 0, rng.random(size) ** 12)
        share[-1] += 1e-6
        sums = (np.cumsum(share) / share.sum()).astype(np.float32)
        sums[-1] = 1
        patches.append(sums)
    cumulative = np.concatenate(patches)
    patch, number, expected = [], [], []
    for which, sums in enumerate(patches):
        edges = np.concatenate([sums, np.arange(len(sums), dtype=np.float32) / np.float32(len(sums))])
        around = [edges, np.nextafter(edges, np.float32(0)), np.nextafter(edges, np.float32(1))]
        asked = np.concatenate([*around, rng.random(2000, np.float32)])
        asked = asked[asked < 1]
        patch.append(np.full(len(asked), which))
        number.append(asked)
        expected.append(ends[which] + np.minimum(np.searchsorted(sums, asked, "right"), len(sums) - 1))
    which = np.concatenate(patch)
    rows = [mi.UInt32(edge[which].astype(np.uint32)) for edge in (ends[:-1], ends[1:] - 1)]
    guide = mi.UInt32(search_guide(cumulative, ends))
    asked = mi.Float(np.concatenate(number))
    found = guided_search(mi.Float(cumulative), guide, (rows[0], rows[1]), asked, mi.Bool(True))
    np.testing.assert_array_equal(np.array(found), np.concatenate(expected))
