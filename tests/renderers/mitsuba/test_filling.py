"""Filling, and the secondary cache, which ends the paths of a gather, against paths that it does not end."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from small_scenes import random_records

from steadylight.cache.lookup import ANSWERED, look_up
from steadylight.cache.records import Records
from steadylight.cache.smoothing import Smoothing
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.records import filling
from steadylight.renderers.mitsuba.records.filling import Points, RadiusBounds
from steadylight.renderers.mitsuba.records.gather import Places, gather_records
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.secondary import SHORT, with_least_radius
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.scenes import load_scene
from steadylight.settings import RenderSettings

FRAMES = (40, 80)
SETTINGS = RenderSettings(frames=FRAMES, width=256, height=144)


@pytest.fixture(scope="module")
def corridor() -> Renderer:
    scene = load_scene("corridor")
    poses = dict(zip(FRAMES, scene.camera.frame_poses(FRAMES, scene.fps), strict=True))
    return Renderer(scene, poses, SETTINGS)


def test_the_secondary_cache_takes_hardly_any_light_and_adds_none(corridor: Renderer) -> None:
    # Lamps in slots of the ceiling, recesses and doors: light that coarse records could lose, or spread too far. It
    # takes 0.4 %; with records twice as far apart it took 1.6 %.
    gather = corridor.filler.gather
    context = gather.context
    assert context.secondary is not None
    seen, _ = corridor.view.missed_through(
        np.random.default_rng(0).random((1000, 2), np.float32), corridor.load(Records.empty()), 1
    )
    bounds = Bounds(np.full(len(seen.position), 1e-3, np.float32), np.ones(len(seen.position), np.float32))
    with_it, without = (
        gather_records(
            dataclasses.replace(
                gather, quality=dataclasses.replace(gather.quality, refinement_paths=(1600,)), context=each
            ),
            Places(seen.position, seen.normal, bounds),
            seed=3,
        ).irradiance.mean(axis=(1, 2))
        for each in (context, context._replace(secondary=None))
    )
    scale = without + 0.1 * without.mean()
    assert abs(((with_it - without) / scale).mean()) < 0.01
    assert abs(with_it.mean() / without.mean() - 1) < 0.01


def stepped(_gather: Any, places: Places, _seed: int) -> Records:
    """Records that see light of 1 on one side of x = 0 and of 3 on the other, and nothing of the edge."""
    records = random_records(1, len(places.position))
    count = len(records)
    return dataclasses.replace(
        records,
        position=places.position,
        normal=places.normal,
        irradiance=np.where(places.position[:, 0] < 0, np.float32(1), np.float32(3))[:, None, None]
        * np.ones((1, 1, 3), np.float32),
        translation=np.zeros_like(records.translation),
        rotation=np.zeros_like(records.rotation),
        curvature=np.zeros_like(records.curvature),
        radius=np.clip(np.float32(0.7), places.bounds.smallest, places.bounds.largest),
        headroom=np.full(count, np.inf, np.float32),
        barriers=np.zeros((count, 2, 3), np.float32),
    )


def test_filling_adaptively_finds_an_edge_of_light_that_no_record_saw(
    corridor: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filling, "gather_records", stepped)
    rng = np.random.default_rng(1)
    position = np.zeros((4000, 3), np.float32)
    position[:, :2] = rng.uniform(-1, 1, (4000, 2))
    normal = np.tile(np.float32([0, 0, 1]), (4000, 1))
    points = Points.anywhere(position, normal)
    filler = corridor.filler
    bounds = RadiusBounds([Pose(np.eye(4), 60)], 256, 20.0, filler.gather.quality)
    filler = filling.Filler(filler.gather, bounds)
    wrong = []
    for records in (filler.fill(points, 1), filler.fill_adaptively(points, 1, Smoothing())):
        answer = look_up(position, normal, records)
        assert (answer.weight >= ANSWERED).all()
        error = np.abs(answer.irradiance[:, 0] / np.where(position[:, 0] < 0, 1, 3) - 1)
        wrong.append((error > 0.2).mean())
    assert wrong[0] > 0.2
    assert wrong[1] < wrong[0] / 3


def test_records_that_disagree_shrink_no_further_than_is_needed_there(
    corridor: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filling, "gather_records", stepped)
    position = np.zeros((4000, 3), np.float32)
    position[:, :2] = np.random.default_rng(1).uniform(-1, 1, (4000, 2))
    normal = np.tile(np.float32([0, 0, 1]), (4000, 1))
    points = Points.anywhere(position, normal)
    bounds = RadiusBounds([Pose(np.eye(4), 60)], 256, 20.0, corridor.filler.gather.quality)
    filler = filling.Filler(corridor.filler.gather, bounds)
    fine = filler.fill_adaptively(points, 1, Smoothing())
    needed = np.where(position[:, 1] < 0, 0.2, 0.1).astype(np.float32)
    coarse = filler.fill_adaptively(points._replace(smallest=needed), 1, Smoothing())
    least = np.where(coarse.position[:, 1] < 0, 0.2, 0.1)
    assert (fine.radius < 0.05).any()
    assert (coarse.radius >= least * (1 - 1e-6)).all()
    assert (coarse.radius < 0.25).any()
    assert len(coarse) < len(fine) / 2
    assert (look_up(position, normal, coarse).weight >= ANSWERED).all()


def row_of(brightness: list[float], radius: float) -> Records:
    """Records in a row on a floor, 0.1 m apart."""
    count = len(brightness)
    records = random_records(1, count)
    position = np.zeros((count, 3), np.float32)
    position[:, 0] = 0.1 * np.arange(count)
    return dataclasses.replace(
        records,
        position=position,
        normal=np.tile(np.float32([0, 0, 1]), (count, 1)),
        irradiance=np.tile(np.float32(brightness)[:, None, None], (1, 1, 3)),
        radius=np.full(count, radius, np.float32),
    )


@pytest.mark.parametrize(("odd", "outlier"), [(4.0, True), (2.5, False), (0.1, False)])
def test_a_record_much_brighter_than_its_neighbours_speaks_no_further_than_its_light_allows(
    odd: float, outlier: bool
) -> None:
    records = row_of([1.0] * 5 + [odd] + [1.0] * 5, radius=0.1)
    smallest = np.full(11, 1.01 * SHORT * 0.1, np.float32)
    made = with_least_radius(records, smallest)
    expected = smallest.copy()
    if outlier:
        expected[5] = 0.1
    np.testing.assert_array_equal(made.radius, expected)
    # Gradients are good for the radius that light allows, not for the one they are given.
    trust = (records.radius / expected)[:, None, None, None]
    np.testing.assert_allclose(made.translation, records.translation * trust, rtol=1e-6)
    half = with_least_radius(records, smallest / 2)
    np.testing.assert_array_equal(half.radius, smallest / 2)  # light allows enough


def test_a_record_that_is_bright_by_its_own_noise_is_no_outlier() -> None:
    records = row_of([1.0] * 5 + [9.0] + [1.0] * 5, radius=0.1)
    error = np.zeros((11, 1), np.float32)
    error[5] = 4.0
    smallest = np.full(11, 1.01 * SHORT * 0.1, np.float32)
    made = with_least_radius(dataclasses.replace(records, standard_error=error), smallest)
    np.testing.assert_array_equal(made.radius, smallest)


def test_a_record_alone_is_no_outlier() -> None:
    lonely = row_of([9.0], radius=0.1)
    assert with_least_radius(lonely, np.float32([10.0])).radius[0] == 10
    assert len(with_least_radius(Records.empty(), np.zeros(0, np.float32))) == 0
