"""Random numbers by address: stratified in every dimension, the same wherever and whenever they are asked for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import qmc

from steadylight.renderers.mitsuba import sampling
from steadylight.renderers.mitsuba.sampling import R2, Purpose, numbers_from, samples_of, seed_of, spread


def points(count, *, seed=1, place=0, branch=0, vertex=0, purpose=Purpose.DIRECTION):
    """(count, 2) points of one address over its samples."""
    numbers = samples_of(dr.opaque(mi.UInt32, seed), mi.UInt32(place), dr.arange(mi.UInt32, count))
    return np.array(numbers.at(mi.UInt32(branch), mi.UInt32(vertex)).sample_2d(purpose)).T


def test_without_scrambling_the_digits_are_those_of_the_sobol_sequence():
    index = dr.arange(mi.UInt32, 64)
    second = np.array(dr.brev(sampling._second_dimension(index))) / 2.0**32
    first = np.array(dr.brev(index)) / 2.0**32
    expected = qmc.Sobol(2, scramble=False).random(64)
    assert {tuple(p) for p in np.stack([first, second], 1)} == {tuple(p) for p in expected}


@pytest.mark.parametrize("place", [0, 7, 123456])
@pytest.mark.parametrize("columns", [1, 2, 4, 8, 16])
def test_sixteen_samples_have_one_point_in_every_elementary_interval(place, columns):
    xy = points(16, place=place)
    cell = np.floor(xy * [columns, 16 // columns]).astype(int)
    assert len({tuple(c) for c in cell}) == 16


def test_one_dimensional_samples_are_stratified():
    numbers = samples_of(dr.opaque(mi.UInt32, 3), mi.UInt32(5), dr.arange(mi.UInt32, 32))
    x = np.array(numbers.at(mi.UInt32(0), mi.UInt32(2)).sample_1d(Purpose.LOBE))
    assert sorted(np.floor(x * 32).astype(int)) == list(range(32))


@pytest.mark.parametrize(
    "other", [{"seed": 2}, {"place": 1}, {"branch": 1}, {"vertex": 1}, {"purpose": Purpose.EMITTER}]
)
def test_every_part_of_the_address_counts(other):
    a, b = points(4096), points(4096, **other)
    assert not np.array_equal(a, b)
    # Sets of two addresses must be independent of each other, sample by sample.
    correlation = np.corrcoef(a.T, b.T)[:2, 2:]
    assert np.abs(correlation).max() < 0.06


def test_numbers_do_not_depend_on_the_wavefront():
    whole = points(64)
    alone = samples_of(dr.opaque(mi.UInt32, 1), mi.UInt32(0), mi.UInt32([37]))
    one = np.array(alone.at(mi.UInt32(0), mi.UInt32(0)).sample_2d(Purpose.DIRECTION)).T
    assert np.array_equal(one[0], whole[37])


def test_neighbouring_pixels_are_independent():
    lanes = dr.arange(mi.UInt32, 1 << 16)
    numbers = samples_of(dr.opaque(mi.UInt32, 1), lanes, mi.UInt32(0))
    x = np.array(numbers.at(mi.UInt32(0), mi.UInt32(0)).sample_1d(Purpose.PIXEL))
    assert abs(x.mean() - 0.5) < 0.005
    assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) < 0.02
    assert np.bincount(np.floor(x * 64).astype(int), minlength=64).std() < 3 * 32


def test_seeds_of_unlike_numbers_are_unlike():
    seeds = {seed_of(a, b, c) for a in range(6) for b in range(6) for c in range(6)}
    assert len(seeds) == 216
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert seed_of(-1) == seed_of(2**64 - 1)
    assert seed_of(1, 2) != seed_of(2, 1)


@pytest.mark.parametrize("count", [3, 4, 7])
def test_points_made_from_one_are_as_many_strata_of_the_square(count):
    below_one = np.nextafter(np.float32(1), np.float32(0))
    whole = mi.Point2f(points(16).T)
    # The greatest number below one: with the number of a stratum added, it is rounded up to the next.
    whole.x = dr.select(dr.arange(mi.UInt32, 16) == 0, mi.Float(below_one), whole.x)
    made = [np.array(spread(whole, mi.UInt32(k), mi.Float(1 / count))).T for k in range(count)]
    for k, part in enumerate(made):
        assert part.min() >= 0
        assert part.max() < 1
        assert (np.floor(part[1:, 0] * count) == k).all()
    # The strata differ in the second coordinate, too.
    assert len({float(part[5, 1]) for part in made}) == count


def test_points_made_from_those_of_a_set_estimate_an_area_with_half_the_variance_of_shifted_copies():
    ways, area = 4, 0.35
    spread_out, shifted = [], []
    for seed in range(300):
        own = points(16, seed=seed)
        parts = [np.array(spread(mi.Point2f(own.T), mi.UInt32(k), mi.Float(1 / ways))).T for k in range(ways)]
        copies = [(own + k * np.array(R2)) % 1 for k in range(ways)]
        for found, sets in ((spread_out, parts), (shifted, copies)):
            x, y = np.concatenate(sets).T - 0.5
            found.append(np.mean(x**2 + y**2 < area / np.pi))
    assert np.mean(spread_out) == pytest.approx(area, abs=3 * np.std(spread_out) / np.sqrt(300))
    assert np.var(spread_out) < 0.5 * np.var(shifted)


def test_further_numbers_from_one_are_even_and_independent_of_each_other() -> None:
    rng = np.random.default_rng(5)
    first = mi.Float(rng.integers(0, 2**24, 40000).astype(np.float32) * np.float32(2**-24))
    numbers = np.array([np.array(each) for each in numbers_from(first, 8)], np.float64)
    assert (numbers[0] == np.array(first)).all()
    assert (numbers >= 0).all()
    assert (numbers < 1).all()
    counts = np.stack([np.histogram(each, 16, (0, 1))[0] for each in numbers])
    assert np.abs(counts - 2500).max() < 4 * np.sqrt(2500)
    assert np.abs(np.corrcoef(numbers) - np.eye(8)).max() < 4 / np.sqrt(40000)
