"""The choice of emitters and their patches: it may change the noise of direct light, never its mean."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import LAMP, described, lamp, paint, place, renderer, room

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.light import emitters as module
from steadylight.renderers.mitsuba.light.emitters import NO_ROW, EmitterSample, EmitterSampling, Sites
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.grid import GridEmitterSampling
from steadylight.renderers.mitsuba.scene import build_scene

LANES = 1 << 16
DARK = paint(0, 0, 0)
BULB = {"type": "point", "position": [0.2, 0.1, 1], "intensity": 2.0}
SAMPLE = EmitterSampling.sample


def panel(x: float, half_width: float, height: float, **more: Any) -> dict[str, Any]:
    """A horizontal rectangle that faces down, 2 m deep."""
    return {
        "type": "rectangle",
        "to_world": place((half_width, 1, 1), (x, 0, height), degrees=180),
        "bsdf": DARK,
        **more,
    }


def window_behind_a_slit() -> dict[str, Any]:
    """A lamp 4 m wide, of which the floor sees a strip only, between two plates."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}
    plates = {f"plate{side}": panel(side * 2.1, 2, 2) for side in (-1, 1)}
    return {"lamp": panel(0, 2, 3, emitter=light), **plates, "floor": {"type": "rectangle", "bsdf": DARK}}


def discs(count: int) -> Records:
    """Records on the floor in a row, 0.1 m apart."""
    position = np.zeros((count, 3), np.float32)
    position[:, 0] = 0.1 * (np.arange(count) - count // 2)
    shapes = {name: np.zeros((count, *shape), np.float32) for name, shape in Records.SHAPES.items()}
    shapes |= {"position": position, "normal": np.tile(np.float32([0, 0, 1]), (count, 1))}
    return Records(**{**shapes, "radius": np.full(count, 0.1, np.float32)})


def known_at(scene: Any, records: Records, rays: int = 512) -> EmitterSampling:
    """The choice of emitters with what some records know of them."""
    emitters = EmitterSampling(scene, Environment(scene))
    emitters.use([emitters.measure(Sites(records.position, records.normal, records.radius), rays)])
    return emitters


def on_the_floor(x: float = 0.02) -> Any:
    """The same point of the floor in every lane."""
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.p = mi.Point3f(x, 0, 0)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.t = mi.Float(1)
    return si


def arriving(emitters: EmitterSampling, si: Any, row: int) -> Any:
    """Direct irradiance by each of many samples, (LANES, 3)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, LANES)
    found = emitters.sample(si, sampler.next_2d(), mi.UInt32(row), mi.Bool(True))
    cosine = dr.maximum(dr.dot(found.direction.d, si.n), 0)
    received = dr.select(found.direction.pdf > 0, found.weight * cosine, 0)
    return np.array(received).T.astype(np.float64)


def test_a_record_that_knows_what_part_of_a_lamp_it_sees_has_less_noise_and_the_same_mean() -> None:
    scene = build_scene(described(window_behind_a_slit()))
    emitters = known_at(scene, discs(9))
    assert emitters.guided
    knowing = arriving(emitters, on_the_floor(), 4)
    unknowing = arriving(emitters, on_the_floor(), NO_ROW)
    error = np.hypot(*(a.std(axis=0) / np.sqrt(LANES) for a in (knowing, unknowing)))
    assert (np.abs(knowing.mean(axis=0) - unknowing.mean(axis=0)) < 4 * error).all()
    assert (error < 0.02 * unknowing.mean(axis=0)).all()  # and the test could see 8 %
    assert (knowing.var(axis=0) < 0.35 * unknowing.var(axis=0)).all()


def test_a_record_knows_for_how_much_of_its_hemisphere_one_sample_of_a_lamp_stands() -> None:
    point = discs(1)
    sites = Sites(point.position, point.normal, np.zeros(1, np.float32))
    largest = {}
    for name in ("lamp", "bulb"):
        some = {"floor": several()["floor"], name: several()[name]}
        some["second"] = {"type": "point", "position": [0, 0, 1], "intensity": 1.0}
        scene = build_scene(described(some))
        emitters = EmitterSampling(scene, Environment(scene))
        by_patch = emitters._received(sites, 1 << 12)[0]
        largest[name] = by_patch[2 * emitters._patches.count :].max()
    assert largest["bulb"] == 0
    # Straight above, 3 m away: the lamp is 4 m wide and 2 m deep, and has 50 patches.
    assert largest["lamp"] == pytest.approx(4 * 2 / 50 / 3**2, rel=0.01)


@pytest.mark.parametrize(
    ("half_width", "height", "expected"),
    [(2, 30, True), (2, 3, True), (2, 0.4, False), (0.05, 0.05, False)],
    ids=["far", "wide but not near", "near", "narrow and near"],
)
def test_rays_are_sent_where_they_would_hit_lamps_that_samples_of_them_do_not_sum_up_well(
    half_width: float, height: float, expected: bool
) -> None:
    content = {"lamp": panel(0, half_width, height, emitter=LAMP), "spot": BULB}
    scene = build_scene(described(content))
    emitters = EmitterSampling(scene, Environment(scene))
    point = discs(1)
    sites = Sites(point.position, point.normal, point.radius)
    emitters.use([emitters.measure(sites, 4096)])
    assert bool(emitters.emitters_only(mi.UInt32(0), mi.Bool(True))[0]) is expected
    assert not emitters.emitters_only(mi.UInt32(NO_ROW), mi.Bool(True))[0]


def test_records_beside_the_frame_of_a_window_all_know_that_it_is_near(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The reveal of a window 4 m square; each of its records may, by chance, draw no sample that is near.
    window = {"type": "rectangle", "to_world": place((2, 2, 1), (0, 2, 2), about=(0, 1, 0), degrees=90)}
    scene = build_scene(described({"window": {**window, "emitter": LAMP}, "spot": BULB}))
    emitters = EmitterSampling(scene, Environment(scene))
    generator = np.random.default_rng(0)
    position = np.zeros((64, 3), np.float32)
    position[:, 0], position[:, 2] = generator.uniform(0, 0.4, 64), generator.uniform(1, 3, 64)
    sites = Sites(position, np.tile(np.float32([0, 1, 0]), (64, 1)), np.full(64, 0.3, np.float32))

    assert not emitters.measure(sites, 64).emitters_only.any()
    monkeypatch.setattr(module, "NEIGHBOURS", 1)
    assert emitters.measure(sites, 64).emitters_only.any()


@pytest.mark.parametrize("bsdf", [None, {"type": "plastic"}], ids=["diffuse", "plastic"])
def test_without_rays_by_the_bsdf_as_much_light_arrives(
    bsdf: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def direct() -> Any:
        made = renderer(described(room(bsdf) | {"lamp": lamp(), "spot": BULB}), spp=256, bounces=0)
        return made.shade(1, None).image

    def rays_alone() -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(EmitterSampling, "sample", nothing_arrives)
            return direct()[18:]  # below the lamp, which the camera sees

    with_rays = direct()
    assert rays_alone().any()
    monkeypatch.setattr(EmitterSampling, "emitters_only", lambda *_: mi.Bool(True))
    assert direct().mean() == pytest.approx(with_rays.mean(), rel=0.003)
    assert rays_alone().any() == (bsdf is not None)


def nothing_arrives(self: EmitterSampling, si: Any, sample: Any, row: Any, active: Any) -> EmitterSample:
    """Stands in for `EmitterSampling.sample`."""
    found = SAMPLE(self, si, sample, row, active)
    found.direction.pdf = mi.Float(0)
    return found


def test_what_a_record_overlooked_still_arrives() -> None:
    # The row of a record in the dark, used at a point that sees the lamp.
    scene = build_scene(described(window_behind_a_slit()))
    far = discs(1)
    far.position[:] = [0.9, 0.9, 0]
    strange = arriving(known_at(scene, far), on_the_floor(), 0)
    plain = arriving(known_at(scene, far), on_the_floor(), NO_ROW)
    error = np.hypot(*(a.std(axis=0) / np.sqrt(LANES) for a in (strange, plain)))
    assert (np.abs(strange.mean(axis=0) - plain.mean(axis=0)) < 4 * error).all()


def several() -> dict[str, Any]:
    """Two lamps, a bulb, and a sky."""
    return window_behind_a_slit() | {
        "other": lamp(),
        "bulb": BULB,
        "sky": {"type": "constant", "radiance": 0.5},
    }


@pytest.mark.parametrize("row", [4, NO_ROW], ids=["known", "unknown"])
def test_who_hits_an_emitter_by_chance_hears_the_density_that_sampling_it_had(row: int) -> None:
    scene = build_scene(described(several()))
    emitters = known_at(scene, discs(9))
    si = on_the_floor()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, LANES)
    found = emitters.sample(si, sampler.next_2d(), mi.UInt32(row), mi.Bool(True))
    hittable = (found.direction.pdf > 0) & ~found.direction.delta
    hit = scene.ray_intersect(si.spawn_ray(found.direction.d), hittable)
    told = emitters.pdf(si, mi.UInt32(row), hit, hit.emitter(scene, hittable), hittable)
    pairs = np.stack([np.array(found.direction.pdf), np.array(told)])[:, np.array(hittable)]
    assert pairs.shape[1] > 1000
    np.testing.assert_allclose(*pairs, rtol=1e-4)


def test_where_no_record_knows_each_emitter_is_as_likely_whatever_its_patches() -> None:
    scene = build_scene(described(several()))
    emitters = known_at(scene, discs(3))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(6, LANES)
    found = emitters.sample(on_the_floor(), sampler.next_2d(), mi.UInt32(NO_ROW), mi.Bool(True))
    bulb = np.array(found.direction.delta & (found.direction.pdf > 0))  # which nothing hides
    assert bulb.mean() == pytest.approx(1 / 3, abs=0.01)  # the cache holds the whole sky


def test_the_cached_part_of_the_environment_is_not_sampled() -> None:
    scene = build_scene(described(several()))
    shares = []
    for whole in (False, True):
        records = discs(1)
        sites = Sites(records.position, records.normal, records.radius)
        emitters = EmitterSampling(scene, Environment(scene), whole=whole)
        emitters.use([emitters.measure(sites, 512)])
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(7, LANES)
        # Its shares are known by how often its emitters are drawn where nothing is in shadow: just under the lamp.
        si = on_the_floor()
        si.p = mi.Point3f(0.02, 0.02, 2.9)
        found = emitters.sample(si, sampler.next_2d(), mi.UInt32(0), mi.Bool(True))
        drawn = mi.EmitterPtr(found.direction.emitter).is_environment() & (found.direction.pdf > 0)
        shares.append(np.array(drawn).mean())
    assert shares[0] < 0.5 * shares[1]


def test_the_grid_leads_gather_paths_to_the_strip_they_see() -> None:
    scene = build_scene(described(window_behind_a_slit()))
    position = np.random.default_rng(1).uniform([-1, -1, 0], [1, 1, 0], (8000, 3)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (8000, 1))
    emitters = GridEmitterSampling(scene, Environment(scene), position, normal, 512)
    si = on_the_floor()
    si.wi = mi.Vector3f(0, 0, 1)
    row = emitters.row_at(si, mi.Bool(True))
    assert int(row[0]) != NO_ROW
    knowing, unknowing = arriving(emitters, si, int(row[0])), arriving(emitters, si, NO_ROW)
    assert (knowing.var(axis=0) < 0.35 * unknowing.var(axis=0)).all()
