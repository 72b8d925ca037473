"""Brightness on a grid of blocks, from which a page can draw the BFM of any region that the reader marks.

The mean luminance of a region of whole blocks is the mean over these blocks, weighted by their areas.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from steadylight.images import luminance

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Grid:
    """Blocks of an image: all of one size, except for the last of each row and column.

    Attributes:
        width: width of the image, pixels.
        height: height of the image, pixels.
        block: edge of a block, pixels.
    """

    width: int
    height: int
    block: int

    @classmethod
    def of(cls, width: int, height: int, most: int) -> Grid:
        """The finest grid of at most `most` blocks whose edge is at least 2 pixels."""
        block = 2
        while cls(width, height, block).count > max(most, 1):
            block += 1
        return cls(width, height, block)

    @property
    def columns(self) -> int:
        """Number of blocks in a row."""
        return -(-self.width // self.block)

    @property
    def rows(self) -> int:
        """Number of blocks in a column."""
        return -(-self.height // self.block)

    @property
    def count(self) -> int:
        """Number of blocks."""
        return self.columns * self.rows

    def sums(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Sum of the luminance of the pixels of each block, (rows, columns).

        Args:
            image: (height, width, 3) scene-linear RGB.
        """
        light = luminance(image)
        down = np.add.reduceat(light, np.arange(0, self.height, self.block), axis=0)
        return np.asarray(np.add.reduceat(down, np.arange(0, self.width, self.block), axis=1))
