"""The division of a hemisphere's paths, and the sums over its strata, against readable twins."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from reference_gather import combine_samples, mean_tangent, reduce_strata, relative_error

from steadylight.renderers.mitsuba.records.gradients import reduced
from steadylight.renderers.mitsuba.records.hemisphere import (
    BEYOND,
    EVEN,
    OVERHEAD,
    RIM,
    Parts,
    PathSamples,
    Strata,
    allocate,
    angles,
    brightness,
    combined,
    direction,
    error_of_one_path,
    jittered,
    place_towards,
    stratum_of,
    stratum_towards,
)

M, N, COUNT, PATHS = 5, 8, 7, 256
STRATA = M * N


def colour(rows: np.ndarray) -> Any:
    """Color3f of (K, 3)."""
    return mi.Color3f(np.ascontiguousarray(rows.reshape(-1, 3).T, np.float32))


def counts(L: np.ndarray, paths: int = PATHS) -> np.ndarray:
    """(R, M, N) paths that each stratum gets for what the pilot samples saw, (R, M, N, 3)."""
    bright = brightness(mi.luminance(colour(L)), M, N)
    begin = np.array(allocate(bright, len(L), STRATA, mi.UInt32(paths))).reshape(len(L), STRATA)
    ends = np.column_stack([begin[:, 1:], np.full(len(L), paths)])
    return (ends.astype(int) - begin).reshape(-1, M, N)


def test_a_direction_lies_in_the_stratum_from_which_it_was_drawn() -> None:
    rng = np.random.default_rng(1)
    stratum = np.arange(STRATA).repeat(20).astype(np.uint32)
    jitter = np.clip(rng.random((2, len(stratum))), 1e-3, 1 - 1e-3).astype(np.float32)
    drawn = direction(*angles(mi.UInt32(stratum), mi.Point2f(jitter), M, N))
    np.testing.assert_array_equal(np.array(stratum_towards(drawn, M, N)), stratum)
    found, place = place_towards(drawn, M, N)
    np.testing.assert_array_equal(np.array(found), stratum)
    np.testing.assert_allclose(np.array(place), jitter, atol=1e-4)


# ---- where refinement samples go ---------------------------------------------------------


def test_every_stratum_gets_a_path_and_all_paths_are_given_out() -> None:
    rng = np.random.default_rng(1)
    L = rng.random((COUNT, M, N, 3)) ** 8  # few of them bright
    L[1] = 0
    L[2, 0, 0] = 1e6
    given = counts(L)
    assert given.min() >= 1
    np.testing.assert_array_equal(given.sum(axis=(1, 2)), PATHS)
    # As many paths as strata: one for each, whatever was seen.
    np.testing.assert_array_equal(counts(L, STRATA), 1)


def test_a_bright_stratum_gets_its_share_and_its_neighbours_some_of_it() -> None:
    L = np.zeros((1, M, N, 3))
    L[0, 2, 0] = 5.0  # at the seam of the azimuths
    given = counts(L, 4096)[0]
    spare, even = 4096 - STRATA, EVEN * (4096 - STRATA) / STRATA
    shares = np.outer([1, 2, 1], [1, 2, 1]) / 16
    around = given[1:4][:, [N - 1, 0, 1]]
    np.testing.assert_allclose(around, 1 + even + (1 - EVEN) * spare * shares, atol=1.5)
    given[1:4, [N - 1, 0, 1]] = 1 + round(even)
    np.testing.assert_allclose(given, 1 + even, atol=1.5)


def test_a_black_hemisphere_and_an_even_one_get_their_samples_evenly() -> None:
    for L in (np.zeros((2, M, N, 3)), np.full((2, M, N, 3), 3.0)):
        np.testing.assert_allclose(counts(L, 1000), 1000 / STRATA, atol=1.01)


def test_records_do_not_change_each_others_paths() -> None:
    L = np.random.default_rng(2).random((COUNT, M, N, 3)) ** 4
    alone = np.concatenate([counts(one[None]) for one in L])
    np.testing.assert_array_equal(counts(L), alone)


@pytest.mark.parametrize("faint", [0.0, 0.5])
def test_the_error_of_one_path_is_that_of_the_readable_twin_and_0_in_the_dark(faint: float) -> None:
    L = np.random.default_rng(8).random((COUNT, M, N, 3)) ** 4
    L[1] = 0
    bright = brightness(mi.luminance(colour(L)), M, N)
    found = np.array(error_of_one_path(mi.luminance(colour(L)), bright, COUNT, (M, N), mi.Float(faint)))
    blurred = np.array(bright).reshape(COUNT, M, N)
    for i in range(COUNT):
        grey = L[i] @ [0.212671, 0.715160, 0.072169]
        np.testing.assert_allclose(found[i], relative_error(grey, blurred[i], EVEN, faint), rtol=1e-4)
    assert found[1] == 0
    # As bright everywhere: nothing to tell strata apart.
    same = colour(np.ones((1, M, N, 3)))
    bright = brightness(mi.luminance(same), M, N)
    assert np.array(error_of_one_path(mi.luminance(same), bright, 1, (M, N), mi.Float(faint)))[0] < 1e-3


def test_a_path_knows_its_stratum() -> None:
    L = np.random.default_rng(3).random((COUNT, M, N, 3)) ** 8
    begin = allocate(brightness(mi.luminance(colour(L)), M, N), COUNT, STRATA, mi.UInt32(PATHS))
    lane = dr.arange(mi.UInt32, COUNT * PATHS)
    record = lane // PATHS
    found = np.array(stratum_of(begin, record, lane - record * PATHS, STRATA)).reshape(COUNT, PATHS)
    for strata, given in zip(found, counts(L), strict=True):
        np.testing.assert_array_equal(strata, np.repeat(np.arange(STRATA), given.ravel()))


def test_directions_lie_in_their_strata_and_all_of_them_are_cosine_distributed() -> None:
    each = 64
    stratum = np.repeat(np.arange(STRATA), each)
    number = np.tile(np.arange(each), STRATA)
    lanes = mi.UInt32(stratum)
    place = jittered(lanes, mi.UInt32(number), mi.UInt32(5))
    jitter = np.array(place)
    assert jitter.min() >= 0
    assert jitter.max() < 1
    cos_theta, sin_theta, phi = angles(lanes, place, M, N)
    sin2 = np.array(sin_theta) ** 2 * M
    turn = np.array(phi) / (2 * np.pi) * N
    slack = 1e-4
    assert ((sin2 >= stratum // N - slack) & (sin2 <= stratum // N + 1 + slack)).all()
    assert ((turn >= stratum % N - slack) & (turn <= stratum % N + 1 + slack)).all()
    d = np.array(direction(cos_theta, sin_theta, phi))
    np.testing.assert_allclose(np.linalg.norm(d, axis=0), 1, rtol=1e-5)
    # The mean of cos theta under that density is 2/3, and the sides cancel.
    np.testing.assert_allclose(d.mean(axis=1), [0, 0, 2 / 3], atol=2e-3)


def test_paths_of_one_stratum_keep_apart() -> None:
    place = np.array(jittered(mi.UInt32(3), dr.arange(mi.UInt32, 64), mi.UInt32(1))).T
    off = np.abs(place[:, None] - place[None])
    distance = np.linalg.norm(np.minimum(off, 1 - off), axis=2) + np.eye(64)
    # 64 random points have two that are within 0.01 of each other; a square grid's keep 0.125.
    assert distance.min() > 0.05


# ---- the twins ---------------------------------------------------------------------------


def made_up(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    distance = rng.uniform(0.5, 5, count).astype(np.float32)
    distance[rng.random(count) < 0.1] = np.inf  # rays that leave the scene
    return {
        "L": rng.random((count, 3), np.float32),
        "distance": distance,
        "tangent": rng.uniform(0, 8, count).astype(np.float32),
    }


def test_the_kernel_combines_pilot_and_refinement_samples_as_the_readable_twin_does() -> None:
    rng = np.random.default_rng(4)
    pilot, refinement = made_up(rng, COUNT * STRATA), made_up(rng, COUNT * PATHS)
    bright = rng.random((COUNT, M, N, 3)) ** 8
    begin = allocate(brightness(mi.luminance(colour(bright)), M, N), COUNT, STRATA, mi.UInt32(PATHS))

    def on_device(seen: dict[str, np.ndarray]) -> PathSamples:
        return PathSamples(colour(seen["L"]), mi.Float(seen["distance"]), mi.Float(seen["tangent"]))

    found, halves = combined(on_device(pilot), on_device(refinement), begin, M, N, mi.UInt32(PATHS))
    L, closeness, nearest = np.array(found.L).T, np.array(found.closeness), np.array(found.nearest)
    starts = np.array(begin).reshape(COUNT, STRATA).astype(int)
    for i in range(COUNT):
        ours, theirs = slice(i * STRATA, (i + 1) * STRATA), slice(i * PATHS, (i + 1) * PATHS)
        expected = combine_samples(
            {name: array[ours] for name, array in pilot.items()},
            {name: array[theirs] for name, array in refinement.items()},
            starts[i],
            (RIM, OVERHEAD, BEYOND),
            N,
        )
        np.testing.assert_allclose(L[ours], expected["L"], rtol=1e-5)
        np.testing.assert_allclose(np.array(found.variance)[ours], expected["variance"], rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(closeness[ours], expected["closeness"], rtol=1e-5)
        for name in ("beyond", "near_closeness", "far_closeness"):
            np.testing.assert_allclose(np.array(getattr(found.parts, name))[ours], expected[name], rtol=1e-6)
        for name in ("near_light", "far_light"):
            part = np.array(getattr(found.parts, name)).T[ours]
            np.testing.assert_allclose(part, expected[name], rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(nearest[ours], expected["nearest"].astype(np.float32))
        headroom = np.array(found.headroom)[ours]
        np.testing.assert_allclose(headroom, expected["headroom"], rtol=1e-6)
        difference = np.array(halves.difference).T[ours]
        np.testing.assert_allclose(difference, expected["difference"], rtol=1e-4, atol=1e-6)
        for h, guide in enumerate(halves.guides):
            for name, array in (("", guide.L), ("_near", guide.near_light), ("_far", guide.far_light)):
                of_half = expected[f"guide{name}"][:, h]
                np.testing.assert_allclose(np.array(array)[ours], of_half, rtol=1e-4, atol=1e-6)
            variance = np.array(guide.variance)[ours]
            np.testing.assert_allclose(variance, expected["guide_variance"][:, h], rtol=1e-3, atol=1e-6)


def test_the_kernel_sums_strata_as_the_readable_twin_does() -> None:
    rng = np.random.default_rng(1)
    L = rng.random((COUNT, M, N, 3), np.float32)
    closeness = rng.uniform(0.2, 2, (COUNT, M, N)).astype(np.float32)
    nearest = (1 / closeness * rng.uniform(0.5, 1, closeness.shape)).astype(np.float32)
    parts = {
        "beyond": np.where(rng.random(closeness.shape) < 0.5, 0, rng.random(closeness.shape)).astype(
            np.float32
        ),
        "near_light": rng.random(L.shape, np.float32),
        "far_light": rng.random(L.shape, np.float32),
        "near_closeness": closeness * rng.uniform(1, 2, closeness.shape).astype(np.float32),
        "far_closeness": closeness * rng.uniform(0, 0.5, closeness.shape).astype(np.float32),
    }
    for near in (closeness, parts["near_closeness"], parts["far_closeness"]):
        near[0, 2, 3] = near[1, :, 7] = 0  # strata all of whose rays leave the scene
    nearest[0, 2, 3] = nearest[1, :, 7] = np.inf
    normal = rng.standard_normal((COUNT, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    n = mi.Normal3f(np.ascontiguousarray(normal.T))
    variance = rng.random((COUNT, M, N), np.float32)
    plain = {"variance": variance, "closeness": closeness, "nearest": nearest, "headroom": 0.7 * nearest}
    lanes = [colour(array) if array.ndim == 4 else mi.Float(array.ravel()) for array in parts.values()]
    divided = Parts(*lanes)
    strata = Strata(
        colour(L), **{name: mi.Float(array.ravel()) for name, array in plain.items()}, parts=divided
    )
    sums = reduced(strata, n, M, N)
    made = mi.Frame3f(n)
    frames = np.stack([np.array(axis).T for axis in (made.s, made.t, made.n)], axis=2)
    for i in range(COUNT):
        expected = reduce_strata(
            {name: array[i] for name, array in {"L": L, **plain, **parts}.items()}, frames[i]
        )
        # Single precision against double, over 40 terms of both signs.
        np.testing.assert_allclose(np.array(sums["E"])[:, i], expected["E"], rtol=1e-5)
        for name in ("variance", "closeness", "horizon"):
            np.testing.assert_allclose(np.array(sums[name])[i], expected[name], rtol=1e-5)
        for name in ("nearest", "headroom"):
            assert np.array(sums[name])[i] == np.float32(expected[name])
        for kind in ("translation", "rotation"):
            channels = [np.array(sums[f"{kind[0]}_{c}"])[:, i] for c in "rgb"]
            np.testing.assert_allclose(channels, expected[kind], rtol=1e-4, atol=2e-5)


def test_the_twins_tangent_is_that_of_the_whole_hemisphere() -> None:
    # Over all of it the mean is pi / 2; strata share it out.
    assert mean_tangent(0, 1) == pytest.approx(np.pi / 2)
    assert np.mean([mean_tangent(j / M, (j + 1) / M) for j in range(M)]) == pytest.approx(np.pi / 2)


def test_paths_go_to_every_stratum_though_some_pilot_samples_are_below_zero() -> None:
    rng = np.random.default_rng(4)
    L = mi.Color3f(*rng.normal(0.1, 1.0, (3, 2 * 40)).astype(np.float32))
    bright = brightness(mi.luminance(L), 4, 10)
    assert np.array(bright).min() >= 0
    begin = np.array(allocate(bright, 2, 40, mi.UInt32(160))).reshape(2, 40)
    assert (np.diff(begin.astype(int), axis=1) >= 1).all()
