from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import FLATNESS, STEP, look_up, pair_weights
from steadylight.cache.records import Records

UP = np.float32([[0, 0, 1]])
RADIUS = 2.0
VALUED = {name for name, shape in Records.SHAPES.items() if shape[:1] == (1,)}


def single(**changes: Any) -> Records:
    """One record at the origin, facing up, of irradiance (1, 2, 3) without gradients."""
    arrays = {
        "position": np.zeros((1, 3)),
        "normal": UP,
        "irradiance": [[[1, 2, 3]]],
        "translation": np.zeros((1, 1, 3, 3)),
        "rotation": np.zeros((1, 1, 3, 3)),
        "curvature": [[0]],
        "radius": [RADIUS],
        "standard_error": [[0]],
    }
    return Records.undivided(
        **{name: np.asarray(value, np.float32) for name, value in (arrays | changes).items()}
    )


def weight_at(x: float, y: float, z: float, normal: Any = UP) -> float:
    return float(pair_weights(np.float32([[x, y, z]]), np.float32(normal), single())[0])


def leaning(degrees: float) -> np.ndarray:
    return np.float32([[np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))]])


def test_light_from_above_falls_off_with_the_cosine_and_even_light_does_not_fall_off() -> None:
    n = leaning(15)
    for curvature, expected in ((1.0, np.cos(np.radians(15))), (0.0, 1.0)):
        answer = look_up(np.float32([[0, 0, 0]]), n, single(curvature=[[curvature]]))
        np.testing.assert_allclose(answer.irradiance, [expected * np.arange(1, 4)], rtol=1e-6)


def test_a_record_has_full_weight_where_it_is_and_is_repeated_there() -> None:
    assert weight_at(0, 0, 0) == 1
    answer = look_up(np.zeros((1, 3), np.float32), UP, single())
    np.testing.assert_array_equal(answer.irradiance, [[1, 2, 3]])
    assert answer.weight == 1


def test_the_weight_falls_as_the_formula_says_and_is_zero_from_the_radius_on() -> None:
    assert weight_at(RADIUS / 2, 0, 0) == pytest.approx((1 - 1 / 4) ** 2)
    assert weight_at(0, RADIUS, 0) == 0
    assert weight_at(0, 5 * RADIUS, 0) == 0


def test_weight_and_slope_are_continuous_at_the_radius() -> None:
    step = 1e-3
    just_inside = weight_at(RADIUS * (1 - step), 0, 0)
    assert (
        0 < just_inside == pytest.approx((2 * step) ** 2, rel=0.01)
    )  # quadratic in the distance to the border


def test_a_record_answers_up_to_half_of_the_free_height_over_and_under_its_plane() -> None:
    # What covers it, a picture that hangs before the wall, has a front that faces the same way.
    covered = single(headroom=[0.06])
    p, n = np.float32([[0, 0, z] for z in (-0.029, 0.029, 0.031, -0.031)]), np.repeat(UP, 4, 0)
    np.testing.assert_array_equal(pair_weights(p, n, covered)[:2], pair_weights(p, n, single())[:2])
    assert (pair_weights(p, n, single())[2:] > 0).all()
    assert (pair_weights(p, n, covered)[2:] == 0).all()


def test_a_record_between_two_skins_of_a_lampshade_does_not_answer_outside() -> None:
    gap, curvature = 0.001, 1 / 0.1  # 1 mm between skins that are bent with a radius of 10 cm
    inside = single(headroom=[gap])
    angle = np.linspace(0.1, 0.3, 9)
    n = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    outer = n * (1 / curvature + gap) - np.float64([0, 0, 1 / curvature])
    assert (pair_weights(np.float32(outer), np.float32(n), single()) > 0).all()
    # They come to lie under the record's plane, so that free height over it would not tell.
    assert (outer[3:, 2] < -0.5 * gap).all()
    assert (pair_weights(np.float32(outer[3:]), np.float32(n[3:]), inside) == 0).all()


def test_a_step_along_the_normal_counts_as_flatness_steps_along_the_surface() -> None:
    step = 0.9 * STEP * RADIUS
    assert weight_at(0, 0, step) == pytest.approx(weight_at(FLATNESS * step, 0, 0))
    left = np.sqrt(RADIUS**2 - (FLATNESS * step) ** 2)
    assert weight_at(left * 0.999, 0, step) > 0
    assert weight_at(left * 1.001, 0, step) == 0
    assert weight_at(0, 0, RADIUS / FLATNESS * 1.001) == 0


@pytest.mark.parametrize("side", [-1, 1], ids=["before it", "behind it"])
def test_a_record_whose_surface_lies_a_step_from_that_of_the_point_does_not_answer(side: int) -> None:
    step = side * STEP * RADIUS
    assert weight_at(0, 0, 1.01 * step) == 0
    assert weight_at(0, 0, 0.99 * step) > 0


def test_on_a_sphere_no_record_lies_a_step_from_others() -> None:
    angle, sphere = np.linspace(-0.4, 0.4, 9), 0.9 * RADIUS
    n = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    p = sphere * (n - [0, 0, 1])
    assert np.abs(p[:, 2]).max() > STEP * RADIUS
    assert (pair_weights(np.float32(p), np.float32(n), single()) > 0).all()


def test_normals_may_differ_up_to_the_tolerance_only() -> None:
    border = np.degrees(np.arccos(1 - NORMAL_TOLERANCE))
    assert weight_at(0, 0, 0, leaning(border * 0.99)) > 0
    assert weight_at(0, 0, 0, leaning(border * 1.01)) == 0
    assert weight_at(0, 0, 0, -UP) == 0


def test_gradients_make_a_linear_irradiance_field_exact() -> None:
    # E(x) = 20 + B x: every record extrapolates exactly, so any mixture of them is exact.
    rng = np.random.default_rng(3)
    slope = rng.standard_normal((3, 3))
    count = 40
    position = rng.random((count, 3)) * [1, 1, 0.02]
    arrays = {
        "position": position,
        "normal": np.repeat(UP, count, 0),
        "irradiance": (20 + position @ slope.T)[:, None],
        "translation": np.broadcast_to(slope, (count, 1, 3, 3)),
        "rotation": np.zeros((count, 1, 3, 3)),
        "curvature": np.zeros((count, 1)),
        "radius": np.full(count, 0.5),
        "standard_error": np.zeros((count, 1)),
    }
    records = Records.undivided(**{name: np.asarray(array, np.float32) for name, array in arrays.items()})
    query = (rng.random((30, 3)) * [1, 1, 0.02]).astype(np.float32)
    answer = look_up(query, np.repeat(UP, 30, 0), records)
    assert (answer.weight > 0).all()
    np.testing.assert_allclose(answer.irradiance, 20 + query @ slope.T, rtol=1e-5)


def test_turning_the_normal_adds_the_rotation_gradient_times_the_sine() -> None:
    # Gradient of channel 0 about y: turning +z towards +x is the rotation vector z x x = +y.
    gradient = np.zeros((1, 1, 3, 3))
    gradient[0, 0, 0, 1] = 0.5
    answer = look_up(np.zeros((1, 3), np.float32), leaning(10), single(rotation=gradient))
    np.testing.assert_allclose(answer.irradiance, [[1 + 0.5 * np.sin(np.radians(10)), 2, 3]], rtol=1e-5)


def test_the_answer_is_never_negative_nor_black_for_the_other_channels() -> None:
    gradient = np.zeros((1, 1, 3, 3))
    gradient[0, 0, 0, 0] = -10
    answer = look_up(np.float32([[1, 0, 0]]), UP, single(translation=gradient))
    np.testing.assert_allclose(answer.irradiance, [[0, 2, 3]], rtol=1e-6)


def test_two_records_are_mixed_by_their_weights() -> None:
    two = Records.concatenate(
        single(), single(position=np.float32([[1, 0, 0]]), irradiance=np.float32([[[5, 5, 5]]]))
    )
    near, far = (1 - 0.25**2 / 4) ** 2, (1 - 0.75**2 / 4) ** 2
    answer = look_up(np.float32([[0.25, 0, 0]]), UP, two)
    assert float(answer.weight[0]) == pytest.approx(near + far, rel=1e-5)
    assert float(answer.irradiance[0, 0]) == pytest.approx((near + 5 * far) / (near + far), rel=1e-5)


def test_where_nothing_answers_the_weight_and_the_irradiance_are_zero() -> None:
    far = np.float32([[9, 9, 9]])
    for records in (single(), Records.empty()):
        answer = look_up(far, UP, records)
        np.testing.assert_array_equal(answer.irradiance, np.zeros((1, 3)))
        assert answer.weight == 0


def test_an_answer_is_the_sum_of_all_values_each_no_less_than_black(
    records_of: Any, queries_about: Any
) -> None:
    records = records_of(4, 30, values=3)
    position, normal = queries_about(5, records, 4)
    alone = [
        Records(
            **{
                name: np.ascontiguousarray(array[:, k : k + 1] if name in VALUED else array)
                for name, array in ((name, getattr(records, name)) for name in Records.SHAPES)
            }
        )
        for k in range(3)
    ]
    answers = [look_up(position, normal, each) for each in alone]
    answer = look_up(position, normal, records)
    np.testing.assert_allclose(answer.irradiance, sum(each.irradiance for each in answers), rtol=1e-4)
    np.testing.assert_array_equal(answer.weight, answers[0].weight)
    assert (answer.weight > 0).any()
