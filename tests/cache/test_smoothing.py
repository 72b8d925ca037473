from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from steadylight.cache.records import Records
from steadylight.cache.smoothing import Smoothing, smooth

SPACING = 0.2


def row(irradiance: Any, **changes: Any) -> Records:
    """Records in a row on the floor, 0.2 m apart, with a radius of five of them."""
    irradiance = np.repeat(np.asarray(irradiance, np.float32)[:, None, None], 3, axis=2)
    count = len(irradiance)
    arrays = {
        "position": np.arange(count)[:, None] * [SPACING, 0, 0],
        "normal": np.tile([0, 0, 1], (count, 1)),
        "irradiance": irradiance,
        "translation": np.zeros((count, 1, 3, 3)),
        "rotation": np.zeros((count, 1, 3, 3)),
        "curvature": np.zeros((count, 1)),
        "radius": np.ones(count),
        "standard_error": np.zeros((count, 1)),
    }
    return Records.undivided(
        **{name: np.asarray(value, np.float32) for name, value in (arrays | changes).items()}
    )


def halved(first: Any, second: Any, error: Any) -> Records:
    """Records in a row, on a floor of the same light everywhere, of which two halves measured this and that."""
    first, second, error = (np.asarray(array, np.float32) for array in (first, second, error))
    return dataclasses.replace(
        row((first + second) / 2, standard_error=np.hypot(*error.T)[:, None] / 2),
        difference=np.repeat(((first - second) / 2)[:, None, None], 3, axis=2),
        guide=np.stack([first, second], axis=1)[:, None],
        guide_error=error[:, None],
    )


@pytest.mark.parametrize("odd", [0.1, 0.0, 30.0], ids=["dark", "black", "bright"])
def test_a_record_unlike_its_neighbours_neither_changes_them_nor_is_changed(odd: float) -> None:
    measured = np.full(21, 1.0)
    measured[10] = odd
    np.testing.assert_allclose(smooth(row(measured)).irradiance[:, 0, 0], measured, rtol=1e-6)


@pytest.mark.parametrize("odd", [0.4, 3.0], ids=["dark", "bright"])
def test_a_record_that_is_unlike_its_neighbours_by_its_own_noise_shares_it_with_them(odd: float) -> None:
    measured, standard_error = np.full(21, 1.0), np.full((21, 1), 0.05)
    measured[10], standard_error[10] = odd, 0.8 * abs(odd - 1)
    smoothed = smooth(row(measured, standard_error=standard_error)).irradiance[:, 0, 0]
    assert np.abs(smoothed - 1).max() < 0.2 * abs(odd - 1)


def test_tiles_keep_their_light_whatever_the_dimmer_joints_between_them_measured() -> None:
    # Joints have three records of a third of the radius for each record on a tile.
    joint = np.arange(80) % 4 != 0
    depth = 0.02  # more than a twentieth of the shorter radius
    position = np.stack([np.arange(80) * SPACING, np.zeros(80), np.where(joint, -depth, 0)], axis=1)
    radius, light = np.where(joint, 0.3, 1.0), np.where(joint, 0.9, 1.0)
    noise = np.full((80, 1), 0.05)  # joints are dimmer than tiles by less than both are known
    smoothed = smooth(row(light, position=position, radius=radius, standard_error=noise)).irradiance[:, 0, 0]
    np.testing.assert_allclose(smoothed, light, rtol=1e-6)
    flat = smooth(row(light, radius=radius, standard_error=noise)).irradiance[:, 0, 0]
    assert flat[~joint].max() < 0.97


def test_a_glint_that_one_half_found_is_spread_and_not_lost() -> None:
    first, error = np.full(61, 1.0), np.full((61, 2), 0.1)
    first[30], error[30, 0] = 11.0, 10.0
    smoothed = smooth(halved(first, np.ones(61), error)).irradiance[:, 0, 0]
    assert smoothed.max() < 1.6  # it was 6
    assert (smoothed - 1).sum() == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize("tail", [0.5, 1.0, 1.5])
def test_smoothing_neither_adds_nor_takes_light_however_long_the_tail_of_the_noise(tail: float) -> None:
    # Halves of eight paths each, whose light is log-normal with mean 1, as are what they know of their own error.
    paths = np.exp(tail * np.random.default_rng(7).standard_normal((20000, 2, 8)) - tail**2 / 2)
    halves, errors = paths.mean(axis=2), paths.std(axis=2, ddof=1) / np.sqrt(8)
    records = halved(*halves.T, errors)
    measured, smoothed = (each.irradiance[:, 0, 0].astype(np.float64) for each in (records, smooth(records)))
    assert smoothed.mean() == pytest.approx(measured.mean(), abs=0.3 * measured.std() / np.sqrt(20000))
    assert smoothed.std() < 0.5 * measured.std()


def with_a_bright_path(records: Records, bright: float, at: int = 30) -> Records:
    """The same, one of which a path brought light in its first half."""
    irradiance, difference = records.irradiance.copy(), records.difference.copy()
    brightest = np.full_like(records.brightest, 1e-3)
    irradiance[at] += bright / 2
    difference[at] += bright / 2
    brightest[at, 0, 0] = bright
    return dataclasses.replace(records, irradiance=irradiance, difference=difference, brightest=brightest)


def test_what_a_single_path_brought_goes_to_all_around_whatever_the_other_half_says() -> None:
    # Its second half is quiet, and a little darker than what is around.
    second = np.full(61, 1.0)
    second[30] = 0.7
    records = halved(second, second, np.full((61, 2), 0.01))
    bright = with_a_bright_path(records, 8.0)
    before, after = (smooth(each).irradiance[:, 0, 0].astype(np.float64) for each in (records, bright))
    assert after.max() < 1.5  # it was 4.7; records further off than three radii get none
    assert (after - before).sum() == pytest.approx(8.0 / 2, rel=1e-3)
    unknown = dataclasses.replace(bright, brightest=np.zeros_like(bright.brightest))
    assert smooth(unknown).irradiance.max() > 2


def test_a_path_that_brought_very_much_is_shared_further_than_others() -> None:
    records = halved(np.ones(401), np.ones(401), np.full((401, 2), 0.01))
    bright = with_a_bright_path(records, 100.0, at=200)
    near, far = (smooth(bright, longest=longest).irradiance[:, 0, 0] for longest in (1.0, 20.0))
    assert near.max() > 3
    assert far.max() < 1.2
    for after in (near, far):
        assert (after.astype(np.float64) - 1).sum() == pytest.approx(50, rel=0.01)


def test_by_area_no_light_is_lost_where_radii_differ() -> None:
    rng = np.random.default_rng(8)
    records = halved(np.ones(61), np.ones(61), np.full((61, 2), 0.01))
    records = dataclasses.replace(records, radius=rng.uniform(0.5, 1.5, 61).astype(np.float32))
    area = np.square(records.radius, dtype=np.float64)
    after = smooth(with_a_bright_path(records, 8.0)).irradiance[:, 0, 0]
    assert (area * (after - 1)).sum() == pytest.approx(area[30] * 4.0, rel=0.05)


def test_the_light_of_a_single_path_among_black_records_is_not_lost() -> None:
    black = halved(np.zeros(61), np.zeros(61), np.zeros((61, 2)))
    after = smooth(with_a_bright_path(black, 8.0)).irradiance[:, 0, 0]
    assert after.sum() == pytest.approx(4.0, rel=0.02)


def test_records_that_agree_average_their_noise() -> None:
    measured = 1 + 0.02 * np.random.default_rng(1).standard_normal(400)
    smoothed = smooth(row(measured)).irradiance[:, 0, 0]
    # Twenty neighbours speak, those near the most: about a dozen records' worth.
    assert smoothed.std() < 0.4 * measured.std()
    assert smoothed.mean() == pytest.approx(measured.mean(), rel=2e-3)


def test_a_step_of_light_stays_a_step() -> None:
    measured = np.repeat([1.0, 2.0], 10)
    np.testing.assert_allclose(smooth(row(measured)).irradiance[:, 0, 0], measured, rtol=1e-6)


def test_a_linear_field_with_its_gradient_is_unchanged() -> None:
    slope = np.zeros((15, 1, 3, 3))
    slope[..., 0] = 0.5
    records = row(10 + 0.5 * SPACING * np.arange(15), translation=slope)
    smoothed = smooth(records)
    for name in Records.SHAPES:
        np.testing.assert_allclose(getattr(smoothed, name), getattr(records, name), rtol=1e-5, atol=1e-6)


def test_light_that_changes_with_the_square_of_the_distance_is_unchanged_by_its_gradients() -> None:
    # By the neighbours' gradients alone all would expect too much: their tangents lie above the light.
    x = SPACING * np.arange(31)
    slope = np.zeros((31, 1, 3, 3))
    slope[..., 0] = (-0.04 * (x - 3))[:, None, None]
    measured = 10 - 0.02 * (x - 3) ** 2
    smoothed = smooth(row(measured, translation=slope)).irradiance[:, 0, 0]
    np.testing.assert_allclose(smoothed, measured, rtol=1e-6)


def test_light_that_falls_off_and_turns_away_along_a_curve_is_unchanged_by_its_gradients() -> None:
    # Around a pillar above a lit floor, the lower and the more tilted both have more light. Neighbours that took the
    # two changes for independent of each other would expect too little.
    angle = 2 * np.pi * np.arange(60) / 60
    n = np.stack([np.cos(angle), np.zeros(60), np.sin(angle)], axis=1)
    near, facing = 1.5 + n[:, 2], 1.5 + n[:, 2]  # the product of these is the light
    to_floor = np.array([0.0, 0, 1])

    def in_all_channels(gradient: Any) -> Any:
        return np.repeat(gradient[:, None, None], 3, axis=2)

    records = row(
        near * facing,
        position=n,
        normal=n,
        translation=in_all_channels(facing[:, None] * to_floor),
        rotation=in_all_channels(near[:, None] * np.cross(n, to_floor)),
        curvature=np.ones((60, 1)),
        radius=np.full(60, 0.3),
    )
    np.testing.assert_allclose(smooth(records).irradiance, records.irradiance, rtol=1e-3)


def test_gradients_that_what_neighbours_measured_refutes_bend_no_light() -> None:
    # The same light everywhere, but one half of the records believes that it doubles within 4 m. Without the
    # neighbours' word, the border of these was 3 % too bright on one side and too dark on the other: a scallop.
    slope = np.zeros((40, 1, 3, 3))
    slope[:20, ..., 0] = 0.25
    records = row(np.ones(40), translation=slope, standard_error=np.full((40, 1), 0.01))
    smoothed = smooth(records)
    np.testing.assert_allclose(smoothed.irradiance, 1, atol=0.005)
    assert np.abs(smoothed.translation).max() < 0.2 * 0.25


def test_gradients_that_what_neighbours_measured_confirms_stay() -> None:
    rng = np.random.default_rng(12)
    slope = np.zeros((40, 1, 3, 3))
    slope[..., 0] = 0.25
    measured = 10 + 0.25 * SPACING * np.arange(40) + 0.05 * rng.standard_normal(40)
    smoothed = smooth(row(measured, translation=slope, standard_error=np.full((40, 1), 0.05)))
    np.testing.assert_allclose(smoothed.translation[5:35, ..., 0], 0.25, rtol=0.05)


def test_black_records_among_lit_ones_stay_finite() -> None:
    slope = np.random.default_rng(13).standard_normal((20, 1, 3, 3))
    smoothed = smooth(row(np.where(np.arange(20) % 2, 1.0, 0.0), translation=slope))
    for name in ("irradiance", "translation", "rotation"):
        assert np.isfinite(getattr(smoothed, name)).all()


def test_gradients_are_averaged_too() -> None:
    noise = np.random.default_rng(2).standard_normal((2, 200, 1, 3, 3))
    translation = 1e-3 * noise[0]
    smoothed = smooth(row(np.ones(200), translation=translation, rotation=noise[1]))
    assert smoothed.translation.std() < 0.5 * translation.std()
    assert smoothed.rotation.std() < 0.5 * noise[1].std()


def test_steep_gradients_of_a_crowd_of_short_radius_say_nothing_to_a_record_of_long_radius() -> None:
    # One record that answers for a metre, and a crowd of centimetres about it, at the foot of an edge.
    radius = np.full(41, 0.02)
    radius[20] = 1.0
    place = np.zeros((41, 3))
    place[:, 0] = 0.002 * (np.arange(41) - 20)
    slope = np.zeros((41, 1, 3, 3))
    slope[..., 1] = 20.0  # along the row nothing changes, so all agree
    slope[20] = 0.0
    smoothed = smooth(row(np.ones(41), position=place, radius=radius, translation=slope, rotation=slope))
    assert np.abs(smoothed.translation[20] * radius[20]).max() < 1e-3
    assert np.abs(smoothed.rotation[20]).max() < 1e-3
    # Among each other they average as ever.
    np.testing.assert_allclose(smoothed.translation[5, ..., 1], 20.0, rtol=1e-3)


def test_a_record_of_longer_radius_says_little_to_one_beside_an_edge() -> None:
    # Equal but for their radius, and alike enough to speak.
    near = row([1.0, 1.05], radius=np.float32([1, 1]))
    far = row([1.0, 1.05], radius=np.float32([1, 10]))
    assert smooth(near).irradiance[0, 0, 0] > 1.01
    assert 1 < smooth(far).irradiance[0, 0, 0] < 1.001


def with_glints(glint: Any, of_guides: tuple[float, float] = (0.0, 0.0)) -> Records:
    """Records in a row; some have a fifth more light, are steep across the row, and of a radius that short.

    Args:
        glint: mask of these.
        of_guides: how steep their two guides are.
    """
    light, radius = np.where(glint, 1.2, 1.0), np.where(glint, 0.3, 1.0)
    steep = np.zeros((len(glint), 1, 3, 3))
    steep[glint, :, :, 1] = 2.5
    made = row(light, radius=radius, translation=steep, standard_error=np.full((len(glint), 1), 0.1))
    guided = np.zeros_like(made.guide_translation)
    guided[glint, 0, :, 1] = of_guides
    return dataclasses.replace(made, guide=np.ones_like(made.guide), guide_translation=guided)


@pytest.mark.parametrize("of_guides", [(0.0, 0.0), (2.5, 0.1)], ids=["no guide", "one guide"])
def test_a_record_that_a_single_path_tilts_is_no_dot_among_those_of_longer_radius(of_guides: Any) -> None:
    """Its radius goes by its steepness, so that by itself it would hear none of them."""
    smoothed = smooth(with_glints(np.arange(41) == 20, of_guides))
    assert smoothed.irradiance[20].max() < 1.07
    assert np.abs(smoothed.translation[20]).max() < 0.4 * 2.5


def test_a_steep_record_whose_guides_are_as_steep_keeps_its_light() -> None:
    assert smooth(with_glints(np.arange(41) == 20, (2.5, 2.5))).irradiance[20].max() > 1.1


def test_records_that_a_single_path_tilts_are_no_dots_on_a_floor_either() -> None:
    """Neighbours on both sides refute their gradients, and they hear them in full all the same."""
    random = np.random.default_rng(14)
    side = 30
    glint = random.random(side**2) < 0.02
    records = with_glints(glint)
    place = np.stack([*np.divmod(np.arange(side**2), side), np.zeros(side**2)], axis=1) * SPACING
    noise = 0.03 * random.standard_normal(side**2)
    measured = records.irradiance + noise[:, None, None].astype(np.float32)
    smoothed = smooth(dataclasses.replace(records, position=place.astype(np.float32), irradiance=measured))
    assert smoothed.irradiance[glint].mean() < 1.01
    assert smoothed.irradiance[glint].max() < 1.04


def test_tilted_records_lose_no_light_that_their_area_would_show() -> None:
    measured = with_glints(np.random.default_rng(11).random(4000) < 0.05)
    before, after = (
        np.average(each.irradiance[:, 0, 0], weights=each.radius**2) for each in (measured, smooth(measured))
    )
    assert after >= before


def test_other_normals_and_places_are_not_asked() -> None:
    apart = row([1.0, 1.1], position=np.float32([[0, 0, 0], [5, 0, 0]]))
    turned = row([1.0, 1.1], normal=np.float32([[0, 0, 1], [1, 0, 0]]))
    for records in (apart, turned):
        np.testing.assert_array_equal(smooth(records).irradiance, records.irradiance)


def test_places_normals_and_radii_stay_and_portions_do_not_show(
    records_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = records_of(3, 100)
    whole = smooth(records)
    for name in set(Records.SHAPES) - {"irradiance", "translation", "rotation"}:
        np.testing.assert_array_equal(getattr(whole, name), getattr(records, name))
    monkeypatch.setattr("steadylight.cache.compatibility.PAIRS_AT_ONCE", 40)
    for one, other in zip(dataclasses.astuple(smooth(records)), dataclasses.astuple(whole), strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_records_stay_none() -> None:
    assert len(smooth(Records.empty())) == 0


def test_values_are_smoothed_with_the_weights_of_their_sum() -> None:
    measured = 1 + 0.02 * np.random.default_rng(1).standard_normal(40)
    whole = row(measured, standard_error=np.full((40, 1), 0.01))
    share = np.float32([0.25, 0.75])
    parts = Records.undivided(
        position=whole.position,
        normal=whole.normal,
        radius=whole.radius,
        irradiance=whole.irradiance * share[:, None],
        translation=np.zeros((40, 2, 3, 3), np.float32),
        rotation=np.zeros((40, 2, 3, 3), np.float32),
        curvature=np.zeros((40, 2), np.float32),
        standard_error=np.float32([[0.006, 0.008]] * 40),
    )
    expected = smooth(whole).irradiance * share[:, None]
    np.testing.assert_allclose(smooth(parts).irradiance, expected, rtol=1e-5)


def test_a_smaller_tolerance_keeps_smaller_differences() -> None:
    measured = np.repeat([1.0, 1.08], 10)
    lax, strict = (smooth(row(measured), None, Smoothing(tolerance=t)).irradiance for t in (0.2, 0.05))
    assert np.ptp(lax[8:12]) < 0.05
    np.testing.assert_allclose(strict[:, 0, 0], measured, rtol=1e-6)
