"""Irradiance by photons in a kernel: against the sum over all photons, and against known light."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, place

from steadylight.cache.records import Floats
from steadylight.renderers.mitsuba.records import photon_grid
from steadylight.renderers.mitsuba.records.discs import ALIKE
from steadylight.renderers.mitsuba.records.photon_grid import FLAT, PhotonGrid
from steadylight.renderers.mitsuba.records.photons import Photons
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.renderers.mitsuba.upload import download, upload

UP = np.float32([0, 0, 1])


def found(grid: PhotonGrid, position: Floats, normal: Floats) -> Floats:
    given = upload(mi.Point3f, position), upload(mi.Normal3f, normal)
    return download(grid.irradiance(*given, mi.Bool(True)))


def sheets(number: int) -> Photons:
    """Photons on both sides of level sheets, 0.05 m apart, on both sides of the origin."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-1, 1, (number, 3)).astype(np.float32)
    position[:, 2] = 0.05 * np.round(position[:, 2] / 0.05)
    normal = np.where(rng.random(number)[:, None] < 0.5, UP, -UP)
    return Photons(position, normal, rng.random((number, 3), np.float32))


def on_floor(number: int) -> Photons:
    """One watt on each square metre of a floor, where x is below 0."""
    position = np.zeros((number, 3), np.float32)
    position[:, :2] = np.random.default_rng(1).uniform(-1, [0, 1], (number, 2))
    return Photons(position, np.tile(UP, (number, 1)), np.full((number, 3), 2 / number, np.float32))


@pytest.mark.parametrize("radius", [0.03, 0.2])
def test_irradiance_is_the_sum_over_all_photons_on_the_disc(
    monkeypatch: pytest.MonkeyPatch, radius: float
) -> None:
    monkeypatch.setattr(photon_grid, "MOST", 1 << 20)
    photons = sheets(20_000)
    position = photons.position[:200] + np.float32([0.01, -0.01, 0.004])
    normal = np.tile(UP, (200, 1))
    offset = photons.position - position[:, None]
    apart = np.square(offset).sum(axis=2) / radius**2
    counts = (apart < 1) & (np.abs(offset @ UP) < FLAT * radius) & (photons.normal @ UP > ALIKE)
    expected = 2 / (np.pi * radius**2) * np.where(counts, 1 - apart, 0) @ photons.power
    np.testing.assert_allclose(found(PhotonGrid(photons, radius), position, normal), expected, rtol=1e-4)


def test_where_photons_are_dense_a_few_of_them_stand_for_all() -> None:
    grid = PhotonGrid(on_floor(200_000), 0.1)
    assert len(np.array(grid.rows)) < 12 * 20_000
    position = np.zeros((500, 3), np.float32)
    position[:, :2] = np.random.default_rng(2).uniform([-0.9, -0.9], [-0.1, 0.9], (500, 2))
    light = found(grid, position, np.tile(UP, (500, 1)))
    np.testing.assert_allclose(light.mean(axis=0), 1, rtol=0.03)


def test_photons_neither_light_what_lies_further_than_a_disc_from_them_nor_the_other_side() -> None:
    grid = PhotonGrid(on_floor(5000), 0.05)
    position = np.float32([[0.051, 0, 0], [-0.5, 0, 0], [-0.5, 0, 0.026], [-0.5, 0, 0]])
    normal = np.float32([UP, -UP, UP, [0, 1, 0]])
    assert not found(grid, position, normal).any()
    assert found(grid, position[1:2], np.float32([UP])).all()


@pytest.mark.parametrize("photons", [None, on_floor(1)], ids=["none", "one"])
def test_few_photons_or_none_are_no_special_case(photons: Photons | None) -> None:
    at = np.zeros((1, 3), np.float32) if photons is None else photons.position
    light = found(PhotonGrid(photons, 0.5), at, np.float32([UP]))
    expected = 0 if photons is None else 2 / (np.pi * 0.25) * photons.power
    np.testing.assert_allclose(light, np.broadcast_to(expected, (1, 3)), rtol=1e-5)


@pytest.mark.parametrize("width", [0.02, 0.1, 0.5])
def test_no_power_is_lost_at_the_edges_of_a_bar_however_narrow(width: float) -> None:
    # A bar of 1 m, lit by 1 W/m²; around it, 1 cm lower, is more surface.
    bar = {"type": "rectangle", "to_world": place((width / 2, 0.5, 1))}
    under = {"type": "rectangle", "to_world": place((2, 2, 1), (0, 0, -0.01))}
    rng = np.random.default_rng(3)
    position = np.zeros((20_000, 3), np.float32)
    position[:, :2] = rng.uniform(-0.5, 0.5, (20_000, 2)) * [width, 1]
    power = np.full((20_000, 3), width / 20_000, np.float32)
    photons = Photons(position, np.tile(UP, (20_000, 1)), power)
    at = np.zeros((5000, 3), np.float32)
    at[:, :2] = rng.uniform(-0.5, 0.5, (5000, 2)) * [width, 1]
    radius = 0.015
    up = np.tile(UP, (5000, 1))
    light = found(PhotonGrid(photons, radius), at, up)
    assert light.mean() < 1 - 0.2 * radius / width  # counted as whole, a disc loses what lies beyond the edge
    scene = build_scene(described({"bar": bar, "under": under}))
    light = found(PhotonGrid(photons, radius, scene), at, up)
    np.testing.assert_allclose(light.mean(axis=0), 1, rtol=0.02)
