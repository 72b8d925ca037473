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
from steadylight.renderers.mitsuba.light.elements import Elements
from steadylight.renderers.mitsuba.light.emitters import NO_ROW, EmitterSample, EmitterSampling, Sites
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.grid import GridEmitterSampling
from steadylight.renderers.mitsuba.light.primitives import primitives_of
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
        largest[name] = emitters._received(sites, 1 << 12, [False])[1][0]
    assert largest["bulb"] == 0
    # Straight above, 3 m away: the lamp is 4 m wide and 2 m deep, and has 49 patches.
    assert largest["lamp"] == pytest.approx(4 * 2 / 49 / 3**2, rel=0.01)


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
    """Two lamps, a mesh of several kinds, a bulb, and a sky."""
    return window_behind_a_slit() | {
        "mixed": mixed_mesh(),
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
    apart = np.abs(pairs[1] / pairs[0] - 1)
    assert np.median(apart) < 1e-4
    assert np.mean(apart > 5e-4) < 1e-3  # on the border of two patches, rounding decides


def test_where_no_record_knows_each_emitter_is_as_likely_whatever_its_patches() -> None:
    scene = build_scene(described(several()))
    emitters = known_at(scene, discs(3))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(6, LANES)
    found = emitters.sample(on_the_floor(), sampler.next_2d(), mi.UInt32(NO_ROW), mi.Bool(True))
    bulb = np.array(found.direction.delta & (found.direction.pdf > 0))  # which nothing hides
    assert bulb.mean() == pytest.approx(1 / 4, abs=0.01)  # the cache holds the whole sky


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
    emitters = GridEmitterSampling(scene, Environment(scene)).measure_at(position, normal, 512)
    si = on_the_floor()
    si.wi = mi.Vector3f(0, 0, 1)
    row = emitters.row_at(si, mi.Bool(False), mi.Bool(True))
    assert int(row[0]) != NO_ROW
    knowing, unknowing = arriving(emitters, si, int(row[0])), arriving(emitters, si, NO_ROW)
    assert (knowing.var(axis=0) < 0.35 * unknowing.var(axis=0)).all()


def bulbs(count: int) -> dict[str, Any]:
    """Bulbs of uneven power under a ceiling 3 m high, over a floor 4 m square."""
    generator = np.random.default_rng(2)
    place_of = generator.uniform([-2, -2, 2.5], [2, 2, 2.95], (count, 3))
    power = generator.uniform(0.5, 1.5, count) * 10 / count
    return {
        f"bulb{i}": {"type": "point", "position": place_of[i].tolist(), "intensity": float(power[i])}
        for i in range(count)
    }


def test_of_a_thousand_bulbs_each_is_chosen_about_as_often_as_it_gives_light() -> None:
    made = bulbs(1000)
    scene = build_scene(described({"floor": {"type": "rectangle"}, **made}))
    emitters = known_at(scene, discs(9))
    received = arriving(emitters, on_the_floor(), 4)[:, 0]
    from_there = np.array([bulb["position"] for bulb in made.values()]) - [0.02, 0, 0]
    distance = np.linalg.norm(from_there, axis=1)
    expected = sum(
        bulb["intensity"] * z / d**3
        for bulb, z, d in zip(made.values(), from_there[:, 2], distance, strict=True)
    )
    assert received.mean() == pytest.approx(expected, rel=4 * received.std() / expected / np.sqrt(LANES))
    assert received.std() < 0.6 * expected  # 1.2 if each were as likely


COLOURED = {
    "type": "point",
    "to_world": mi.ScalarTransform4f().translate([-0.4, 0.3, 1.2]),
    "intensity": {"type": "rgb", "value": [3.0, 2.0, 0.5]},
}
SPOT = {
    "type": "spot",
    "to_world": mi.ScalarTransform4f().look_at([0.5, 0, 2], [0, 0, 0], [0, 1, 0]),
    "intensity": 4.0,
}


@pytest.mark.parametrize("others", [{}, {"spot": SPOT}, {"lamp": lamp()}], ids=["alone", "spot", "lamp"])
def test_what_is_read_of_bulbs_is_what_mitsuba_says_of_them(others: dict[str, Any]) -> None:
    scene = build_scene(
        described({"floor": {"type": "rectangle"}, "bulb": BULB, "coloured": COLOURED, **others})
    )
    elements = Elements(scene, 16)
    assert len(elements.unasked) == (0 if "spot" in others else 2)
    si = on_the_floor()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, LANES)
    sample = sampler.next_2d()
    for element in np.flatnonzero((elements.outline.axis == 0).all(axis=1)):
        emitter = scene.emitters()[elements.outline.emitter[element]]
        found, shine = elements.sample(mi.UInt32(element), si, sample, mi.Bool(True))
        theirs, weight = emitter.sample_direction(si, sample)
        assert dr.all(found.emitter == mi.EmitterPtr(emitter))
        for name in ("p", "d", "dist", "pdf", "delta"):
            ours, expected = (np.broadcast_to(getattr(ds, name), (3, LANES)) for ds in (found, theirs))
            np.testing.assert_allclose(ours, expected, rtol=1e-6, err_msg=name)
        ours, expected = (np.broadcast_to(light, (3, LANES)) for light in (shine, weight * theirs.pdf))
        np.testing.assert_allclose(ours, expected, rtol=1e-5)


def panels_in_one_mesh(count: int) -> dict[str, Any]:
    """Square panels 10 cm wide at different heights, which all face down."""
    generator = np.random.default_rng(4)
    centre = generator.uniform([-1.5, -1.5, 2], [1.5, 1.5, 2.9], (count, 3))
    corners = 0.05 * np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]])
    vertices = (centre[:, None] + corners).reshape(-1, 3).astype(np.float32)
    faces = (4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    mesh = {"type": "triangles", "vertices": vertices, "faces": faces.astype(np.uint32)}
    return {**mesh, "bsdf": DARK, "emitter": LAMP}


def mixed_mesh() -> dict[str, Any]:
    """A triangle, a slanted parallelogram whose triangles begin at any corner, and a kite, which is none."""
    vertices = np.array(
        [
            *([-1.5, -0.5, 1.4], [-1.5, 0.5, 1.4], [-0.9, 0, 1.4]),
            *([-0.5, -0.5, 1.4], [-0.2, 0.5, 1.7], [0.5, 0.7, 1.5], [0.2, -0.3, 1.2]),
            *([0.8, -0.5, 1.4], [0.7, 0.5, 1.4], [1.6, 0.9, 1.4], [1.2, -0.6, 1.4]),
        ],
        np.float32,
    )
    faces = np.array([[0, 1, 2], [5, 3, 4], [6, 3, 5], [7, 8, 9], [7, 9, 10]], np.uint32)
    mesh = {"type": "triangles", "vertices": vertices, "faces": faces}
    return {**mesh, "bsdf": DARK, "emitter": LAMP}


def test_pairs_of_triangles_are_squares_where_they_make_parallelograms() -> None:
    scene = build_scene(described({"lamps": mixed_mesh(), "bulb": BULB, "panels": panels_in_one_mesh(3)}))
    found = primitives_of(scene)
    names = ["whole", "triangle", "square"]
    kinds = [names[int(t >= 0) + int(q)] for t, q in zip(found.triangle, found.square, strict=True)]
    assert sorted(kinds) == ["square"] * 4 + ["triangle"] * 3 + ["whole"]
    counts = np.bincount(found.row)
    assert (counts == np.where(found.square, 2, 1)).all()
    of = found.emitter[found.row]
    assert (np.diff(of) >= 0).all()
    assert (found.first == np.searchsorted(of, np.arange(3))).all()
    meshes = (scene.shapes()[k] for k in range(len(scene.shapes())))
    whole = sum(float(mesh.surface_area()[0]) for mesh in meshes if mesh.is_emitter())
    assert found.area.sum() == pytest.approx(whole, rel=1e-5)


def textured_panel() -> dict[str, Any]:
    """A screen of few bright spots."""
    picture = np.random.default_rng(5).random((16, 16, 1)).astype(np.float32) ** 8
    picture = np.repeat(picture, 3, axis=2)
    radiance = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "nearest"}
    return panel(0, 1, 2, emitter={"type": "area", "radiance": radiance})


@pytest.mark.parametrize(
    ("lamps", "spread"),
    [
        ({"lamps": panels_in_one_mesh(200)}, 0.6),
        ({"screen": textured_panel()}, 1.4),
        ({"screen": panel(0, 1, 2, emitter=LAMP)}, 0.4),
        ({"lamps": mixed_mesh()}, 0.6),
        ({"screen": textured_panel(), "lamps": mixed_mesh()}, 1.4),
    ],
    ids=["many panels", "a textured panel", "a plain panel", "mixed", "mixed beside a textured one"],
)
def test_pieces_of_luminous_surfaces_give_the_light_that_rays_to_all_sides_find(
    lamps: dict[str, Any], spread: float
) -> None:
    scene = build_scene(described({"floor": {"type": "rectangle"}, **lamps}))
    emitters = known_at(scene, discs(9))
    si = on_the_floor()
    received = arriving(emitters, si, 4)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(8, 16 * LANES)
    d = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    ray = mi.Ray3f(mi.Point3f(0.02, 0, 1e-4), d)
    hit = scene.ray_intersect(ray)
    found = np.array(hit.emitter(scene).eval(hit)).T * np.pi
    error = np.hypot(found.std(axis=0) / np.sqrt(16 * LANES), received.std(axis=0) / np.sqrt(LANES))
    assert (np.abs(received.mean(axis=0) - found.mean(axis=0)) < 4 * error).all()
    assert (received.std(axis=0) < spread * received.mean(axis=0)).all()


def test_the_density_of_a_mesh_integrates_to_one_over_the_hemisphere() -> None:
    scene = build_scene(described({"floor": {"type": "rectangle"}, "lamps": panels_in_one_mesh(1)}))
    emitters = known_at(scene, discs(9))
    si = on_the_floor()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(9, LANES)
    # The panel is small: only a cone around it is looked into.
    cosine = 0.8
    d = mi.warp.square_to_uniform_cone(sampler.next_2d(), cosine)
    centre = panels_in_one_mesh(1)["vertices"].mean(axis=0) - np.array([0.02, 0, 0])
    d = mi.Frame3f(mi.Vector3f((centre / np.linalg.norm(centre)).tolist())).to_world(d)
    hit = scene.ray_intersect(si.spawn_ray(d))
    emitter = hit.emitter(scene)
    met = emitter != None  # noqa: E711 - element-wise
    pdf = np.array(dr.select(met, emitters.pdf(si, mi.UInt32(4), hit, emitter, met), 0), np.float64)
    error = pdf.std() / np.sqrt(LANES)
    assert pdf.mean() * 2 * np.pi * (1 - cosine) == pytest.approx(1, abs=4 * error * 2 * np.pi * (1 - cosine))


def test_a_record_behind_a_window_knows_which_part_of_the_sky_it_sees() -> None:
    sky = {"type": "sunsky", "sun_direction": [0.1, 0.0, 1.0]}
    plates = {f"plate{side}": panel(side * 1.6, 1.5, 1.5) for side in (-1, 1)}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": sky, **plates}))
    position = np.random.default_rng(1).uniform([-1, -1, 0], [1, 1, 0], (8000, 3)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (8000, 1))
    emitters = GridEmitterSampling(scene, Environment(scene)).measure_at(position, normal, 512)
    si = on_the_floor(0.5)  # which the sun does not reach
    si.wi = mi.Vector3f(0, 0, 1)
    row = int(emitters.row_at(si, mi.Bool(False), mi.Bool(True))[0])
    knowing, unknowing = arriving(emitters, si, row), arriving(emitters, si, NO_ROW)
    error = np.hypot(*(a.std(axis=0) / np.sqrt(LANES) for a in (knowing, unknowing)))
    assert (np.abs(knowing.mean(axis=0) - unknowing.mean(axis=0)) < 4 * error).all()
    assert (knowing.var(axis=0) < 0.3 * unknowing.var(axis=0)).all()


def test_where_the_cache_holds_the_sky_gather_paths_look_for_the_sun_alone() -> None:
    sky = {"type": "sunsky", "sun_direction": [0.3, 0.0, 1.0], "sun_aperture": 5.0}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": sky}))
    position = np.random.default_rng(1).uniform([-1, -1, 0], [1, 1, 0], (8000, 3)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (8000, 1))
    environment = Environment(scene)
    emitters = GridEmitterSampling(scene, environment).measure_at(position, normal, 512)
    si = on_the_floor()
    si.wi = mi.Vector3f(0, 0, 1)
    means, errors, sunny = [], [], []
    for cached in (False, True):
        row = emitters.row_at(si, mi.Bool(cached), mi.Bool(True))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(9, LANES)
        found = emitters.sample(si, sampler.next_2d(), row, mi.Bool(True))
        rest = 1 - environment.cached_fraction(found.radiance)
        received = np.array(mi.luminance(found.weight) * rest * found.direction.d.z, np.float64)
        means.append(received.mean())
        errors.append(received.std() / np.sqrt(LANES))
        sunny.append((received > 0).mean())
    assert means[0] == pytest.approx(means[1], abs=4 * np.hypot(*errors))
    assert sunny[0] < 0.9
    assert sunny[1] > 0.98
    assert errors[1] < errors[0]


def test_what_records_know_does_not_depend_on_how_many_rays_are_traced_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    content = {"floor": {"type": "rectangle"}, **bulbs(100), "lamps": panels_in_one_mesh(20)}
    scene = build_scene(described({**content, "sky": {"type": "sunsky"}}))
    records = discs(9)
    sites = Sites(records.position, records.normal, records.radius)
    emitters = EmitterSampling(scene, Environment(scene))
    at_once = emitters.measure(sites, 512)
    monkeypatch.setattr(module, "PATHS_AT_ONCE", 1 << 10)
    in_parts = emitters.measure(sites, 512)
    assert at_once.shares.tobytes() == in_parts.shares.tobytes()
