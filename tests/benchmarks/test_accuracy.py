"""Blocks of a picture that are too bright or too dark."""

import numpy as np
import pytest
from accuracy import BLOCK, blocks_off

SIZE = (2 * BLOCK, 3 * BLOCK, 3)


def references(noise=0.0):
    seeds = np.random.default_rng(5).standard_normal((2, *SIZE[:2], 1))
    return 1 + noise * seeds + np.zeros((2, *SIZE))


@pytest.mark.parametrize(("by", "off"), [(1.03, (1, 0)), (0.97, (0, 1)), (1.01, (0, 0))])
def test_a_block_that_is_off_by_more_than_two_percent_counts(by, off):
    image = np.ones(SIZE)
    image[BLOCK:, :BLOCK] *= by
    assert blocks_off(image, *references()) == off


def test_a_block_counts_only_above_twice_the_noise_of_the_references_mean():
    # The mean of the references is known to 3 % in each block: here, it is up to 4.4 % off.
    assert blocks_off(np.full(SIZE, 1.03), *references(1.0)) == (0, 0)
    assert blocks_off(np.full(SIZE, 1.12), *references(1.0)) == (6, 0)


def test_blocks_that_the_border_cuts_count_too():
    a, b = references()
    image = np.ones(SIZE)
    image[-10:, -5:] = 0.8
    assert blocks_off(image[5:, 7:], a[5:, 7:], b[5:, 7:]) == (0, 1)
