"""Brightness of blocks: regions of whole blocks have the brightness that the image itself has there."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.images import luminance
from steadylight.metrics.blocks import Grid


@pytest.mark.parametrize(
    ("width", "height", "most"), [(48, 36, 100), (50, 37, 100), (7, 5, 1000), (1, 1, 4), (300, 2, 9)]
)
def test_a_grid_has_at_most_so_many_blocks_and_covers_the_image(width: int, height: int, most: int) -> None:
    grid = Grid.of(width, height, most)
    image = np.random.default_rng(1).random((height, width, 3))
    sums = grid.sums(image)
    assert sums.shape == (grid.rows, grid.columns)
    assert grid.count <= most
    assert sums.sum() == pytest.approx(luminance(image).sum())


def test_the_sum_over_blocks_is_that_of_the_region() -> None:
    image = np.random.default_rng(2).random((20, 30, 3))
    grid = Grid(30, 20, 4)
    assert grid.sums(image)[1:3, 2:5].sum() == pytest.approx(luminance(image)[4:12, 8:20].sum())
    # The last block of a row is narrower.
    assert grid.sums(image)[0, 7] == pytest.approx(luminance(image)[:4, 28:].sum())
