"""All bounces of indirect light, from one measured bounce and what surfaces pass on to each other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, paint, place, random_records, renderer, room

from steadylight.renderers.mitsuba.coverage import usual_in_the_darkest
from steadylight.renderers.mitsuba.records import secondary
from steadylight.renderers.mitsuba.records.filling import Filler, Points
from steadylight.renderers.mitsuba.records.gather import Places, gather_records
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.settings import RenderSettings
from variants import slow

if TYPE_CHECKING:
    from steadylight.cache.records import Records


def closed_room(bsdf: dict[str, Any]) -> dict[str, Any]:
    """A room of one material, with nothing open: light leaves it only where it is absorbed."""
    content = room()
    content["front"] = {"type": "rectangle", "to_world": place((2, 1.5, 1), (0, -2, 1.5), degrees=-90)}
    content["ceiling"] = {"type": "rectangle", "to_world": place((2, 2, 1), (0, 0, 3), degrees=180)}
    return {name: {**thing, "bsdf": bsdf} for name, thing in content.items()} | {"lamp": lamp()}


MATERIALS = {
    "white paint": paint(0.8, 0.8, 0.8),
    "varnish": {
        "type": "roughplastic",
        "diffuse_reflectance": {"type": "rgb", "value": [0.7, 0.75, 0.8]},
        "alpha": 0.2,
    },
}


@pytest.mark.parametrize("name", ["white paint", slow("varnish")])
def test_a_closed_room_is_as_bright_with_auto_bounces_as_with_a_hundred(name: str) -> None:
    # The camera stands inside, before the front wall.
    content = closed_room({"type": "twosided", "bsdf": MATERIALS[name]})
    chosen: dict[str, Any] = {"width": 32, "height": 32, "quality": "normal"}
    ours = renderer(inside(content), bounces="auto", spp=64, **chosen).shade(1, None)
    theirs = renderer(inside(content), bounces=100, spp=256, **chosen).path(1)
    # Records are few in so small a picture and share their noise: between seeds the mean varies by 0.4 %.
    np.testing.assert_allclose(ours.image.mean((0, 1)), theirs.image.mean((0, 1)), rtol=0.015)
    few = renderer(inside(content), bounces=2, spp=16, **chosen).shade(1, None)
    assert few.image.mean() < 0.9 * ours.image.mean()


@pytest.mark.parametrize("light", ["lamp", "sky"])
def test_a_room_has_the_light_of_as_many_bounces_as_asked_for(light: str) -> None:
    # Albedo 0.8: each bounce adds much, so that one too few or too many would be seen.
    content = closed_room({"type": "twosided", "bsdf": MATERIALS["white paint"]})
    if light == "sky":
        # Open above, and no lamp: the cache holds the sky, the lowest level of its light.
        del content["ceiling"], content["lamp"]
        content["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": [1, 1.1, 1.3]}}
    chosen: dict[str, Any] = {"width": 32, "height": 32, "quality": "normal", "bounces": 4}
    ours = renderer(inside(content), spp=64, **chosen).shade(1, None)
    theirs = renderer(inside(content), spp=256, **chosen).path(1)
    np.testing.assert_allclose(ours.image.mean((0, 1)), theirs.image.mean((0, 1)), rtol=0.015)


@pytest.mark.parametrize("bounces", ["auto", 4])
@pytest.mark.parametrize("known", [True, False], ids=["with records of their own", "without"])
def test_surfaces_that_no_random_walk_met_pass_on_light_too(
    known: bool, bounces: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from steadylight.renderers.mitsuba import coverage

    if not known:
        # As of surfaces that none of the few paths found which look for them.
        nowhere = Points.anywhere(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
        monkeypatch.setattr(secondary, "_unknown", lambda *_: nowhere)

    def over_the_floor(*arguments: Any) -> tuple[Any, Any]:
        position, normal, diffuse = walk(*arguments)
        low = position[:, 2] < 0.01
        return position[low], normal[low], diffuse[low]

    walk = coverage.walk
    monkeypatch.setattr(coverage, "walk", over_the_floor)
    content = closed_room({"type": "twosided", "bsdf": MATERIALS["white paint"]})
    chosen: dict[str, Any] = {"width": 32, "height": 32, "quality": "normal"}
    ours = renderer(inside(content), bounces=bounces, spp=64, **chosen).shade(1, None)
    all_of_them = 100 if bounces == "auto" else bounces
    theirs = renderer(inside(content), bounces=all_of_them, spp=256, **chosen).path(1)
    np.testing.assert_allclose(ours.image.mean((0, 1)), theirs.image.mean((0, 1)), rtol=0.015)


def test_what_secondary_records_pass_on_is_as_measured_whatever_smoothing_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Smoothing takes light from what is brightest, which lights the rest.
    content = closed_room({"type": "twosided", "bsdf": MATERIALS["white paint"]})
    made = renderer(inside(content), bounces="auto")

    def light_if_smoothing_leaves(part: float) -> Any:
        def smooth(records: Records, **_: Any) -> Records:
            return dataclasses.replace(records, irradiance=records.irradiance * np.float32(part))

        monkeypatch.setattr(secondary, "smooth", smooth)
        prepared = made.prepare().secondary
        assert prepared is not None
        return prepared.records.irradiance

    none, half, whole = (light_if_smoothing_leaves(part) for part in (0.0, 0.5, 1.0))
    assert none.sum() > 0.5 * whole.sum()  # of albedo 0.8, by far the most is passed on
    assert (whole > none).any()
    np.testing.assert_allclose(half, (none + whole) / 2, rtol=1e-5)


@pytest.mark.parametrize(("bounces", "fewer"), [("auto", True), (4, False)])
def test_few_paths_say_where_secondary_records_stand_if_their_light_is_not_used(
    bounces: Any, fewer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int | None, int, int]] = []

    class Noted(Filler):
        def fill(self, points: Any, seed: int) -> Records:
            quality = self.gather.quality
            asked.append((self.gather.bounces, quality.strata, quality.paths_per_record[0]))
            return super().fill(points, seed)

    monkeypatch.setattr(secondary, "Filler", Noted)
    made = renderer(described(room() | {"lamp": lamp()}), bounces=bounces, quality="normal")
    made.prepare()
    usual = made.view.quality.secondary
    assert asked
    assert all(of == 0 and (strata < usual.strata) == fewer for of, strata, _ in asked)
    assert all((paths < usual.paths_per_record[0]) == fewer for _, _, paths in asked)


def test_what_is_faint_goes_by_the_darkest_picture_of_the_film(records_above: Any) -> None:
    # Two floors, of which records know that one has 100 times the light of the other, and a camera above each.
    floors = {
        name: {"type": "rectangle", "to_world": place((1, 1, 1), (x, 0, 0)), "bsdf": paint(0.5, 0.5, 0.5)}
        for name, x in (("bright", -2), ("dark", 2))
    }
    records = records_above({-2.0: 5.0, 2.0: 0.05})
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.uniform(-2.5, -1.5, 100), rng.uniform(1.5, 2.5, 100)])
    origin = mi.Point3f(np.stack([x, rng.uniform(-0.5, 0.5, 200), np.ones(200)]).astype(np.float32))
    rays = mi.Ray3f(origin, mi.Vector3f(0, 0, -1))
    scene = build_scene(described(floors))
    assert usual_in_the_darkest(records, scene, rays, 2) == pytest.approx(0.05, rel=1e-4)
    assert usual_in_the_darkest(records.take(np.array([0])), scene, rays, 2) == pytest.approx(5, rel=1e-4)
    up = mi.Ray3f(origin, mi.Vector3f(0, 0, 1))
    assert usual_in_the_darkest(records, scene, up, 2) == 0


@pytest.fixture
def records_above() -> Any:
    """Makes a record of 2 m radius at each place along x, on the floor, from the irradiance there."""

    def make(irradiance: dict[float, float]) -> Records:
        some = random_records(1, len(irradiance))
        position = np.zeros((len(irradiance), 3), np.float32)
        position[:, 0] = list(irradiance)
        return dataclasses.replace(
            some,
            position=position,
            normal=np.tile(np.float32([0, 0, 1]), (len(irradiance), 1)),
            irradiance=np.float32(list(irradiance.values()))[:, None, None] * np.ones((1, 1, 3), np.float32),
            translation=np.zeros_like(some.translation),
            rotation=np.zeros_like(some.rotation),
            radius=np.full(len(irradiance), 2, np.float32),
        )

    return make


def test_no_light_comes_through_a_table_top_that_meets_a_wall() -> None:
    # Secondary records are coarser than the table is high: those above its top are near enough to answer on the wall
    # below it. When they did, it was 4 % too bright there, and 1 % too dark above, where the others answered.
    content = closed_room({"type": "twosided", "bsdf": paint(0.5, 0.5, 0.5)})
    content["top"] = {
        "type": "cube",
        "to_world": place((2, 0.75, 0.02), (0, 1.25, 0.75)),
        "bsdf": paint(0.5, 0.5, 0.5),
    }
    content["lamp"] = {**content["lamp"], "to_world": place((0.1, 0.1, 1), (0, 0.5, 2.5), degrees=180)}
    made = renderer(inside(content), bounces="auto", width=192, height=108, quality="normal")
    gather = made.filler.gather
    assert gather.context.secondary is not None
    exact = dataclasses.replace(gather, context=gather.context._replace(secondary=None))
    rng = np.random.default_rng(0)
    for low, high in ((0.6, 0.72), (0.78, 0.9)):
        position = np.stack(
            [rng.uniform(-1.9, 1.9, 600), np.full(600, 2.0), rng.uniform(low, high, 600)], axis=1
        )
        normal = np.tile(np.float32([0, -1, 0]), (600, 1))
        bounds = Bounds(np.full(600, 1e-3, np.float32), np.ones(600, np.float32))
        places = Places(position.astype(np.float32), normal, bounds)
        mine, theirs = (gather_records(each, places, seed=3).irradiance.mean() for each in (gather, exact))
        assert mine == pytest.approx(theirs, rel=0.01)


def test_secondary_records_on_shelves_have_no_more_light_than_arrives_there() -> None:
    # Records are about as coarse as shelves are high. Where those further out answered without gradients, and next to
    # any surface, the darkest quarter was 5 % too bright.
    content = closed_room({"type": "twosided", "bsdf": paint(0.5, 0.5, 0.5)})
    for i in range(6):
        board = place((2, 0.25, 0.02), (0, 1.75, 0.3 + 0.4 * i))
        content[f"shelf_{i}"] = {"type": "cube", "to_world": board, "bsdf": paint(0.5, 0.5, 0.5)}
    made = renderer(inside(content), bounces="auto", width=192, height=108, quality="normal")
    prepared = made.prepare().secondary
    assert prepared is not None
    ours = prepared.records
    gather = made.filler.gather
    exact = dataclasses.replace(
        gather,
        quality=dataclasses.replace(gather.quality, refinement_paths=(1600,)),
        context=gather.context._replace(secondary=None),
    )
    bounds = Bounds(np.full(len(ours), 1e-3, np.float32), np.ones(len(ours), np.float32))
    theirs = gather_records(exact, Places(ours.position, ours.normal, bounds), seed=3)
    mine, right = (each.irradiance.sum(axis=(1, 2)) for each in (ours, theirs))
    for rows in np.array_split(np.argsort(right), 4):
        assert mine[rows].sum() == pytest.approx(right[rows].sum(), rel=0.02)


def inside(content: dict[str, Any]) -> Any:
    """The description of a room that the camera is in."""
    from steadylight.camera import CameraPath, Keyframe
    from steadylight.scenes.description import SceneDescription

    camera = CameraPath(
        (
            Keyframe(0.0, (-1.2, -1.8, 1.7), (0.2, 0.4, 1.2), fov=80),
            Keyframe(1.0, (-1, -1.8, 1.7), (0.2, 0.4, 1.2), fov=80),
        )
    )
    return SceneDescription("test", content, camera)


@pytest.mark.parametrize("value", [0, 3, "3", "auto"])
def test_bounces_are_a_number_or_auto(value: Any) -> None:
    settings = RenderSettings.checked(frames=(1,), width=8, height=8, bounces=value)
    assert settings.bounces == (value if value == "auto" else int(value))


@pytest.mark.parametrize("value", [-1, "many", 2.5, True])
def test_other_bounces_are_refused_with_what_would_be_right(value: Any) -> None:
    from steadylight.errors import SettingsError

    with pytest.raises(SettingsError, match=r"--bounces: .*give auto or a whole number"):
        RenderSettings.checked(frames=(1,), width=8, height=8, bounces=value)
