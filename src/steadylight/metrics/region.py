"""The region of the image in which something is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from steadylight.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

_FORM = "x0,y0,x1,y1: four integers (pixels) or four numbers from 0.0 to 1.0 with a decimal point (fractions)"


@dataclass(frozen=True)
class Region:
    """A rectangle of the image: left and top edge inclusive, right and bottom edge exclusive.

    Integers are pixels; floats are fractions of width and height, so `Region(0.0, 0.5, 1.0, 1.0)` is the
    lower half of any image. Fractions are rounded to whole pixels, and the region has at least one.

    Attributes:
        x0: left edge, counted from the left.
        y0: top edge, counted from the top.
        x1: right edge.
        y1: bottom edge.

    Raises:
        InputError: pixels and fractions are mixed, or the rectangle is empty or outside the image.
    """

    x0: float
    y0: float
    x1: float
    y1: float

    def __post_init__(self) -> None:
        edges = (self.x0, self.y0, self.x1, self.y1)
        kinds = {isinstance(edge, int) for edge in edges}
        if len(kinds) > 1:
            raise InputError(f"region {self}: mixes pixels and fractions; expected {_FORM}")
        if not (0 <= self.x0 < self.x1 and 0 <= self.y0 < self.y1):
            raise InputError(f"region {self}: is empty or starts outside the image; expected {_FORM}")
        if kinds == {False} and max(edges) > 1:
            raise InputError(f"region {self}: fractions must not exceed 1.0; expected {_FORM}")

    def __str__(self) -> str:
        return f"{self.x0},{self.y0},{self.x1},{self.y1}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse `x0,y0,x1,y1` from the command line; a decimal point in any number makes all four fractions.

        Raises:
            InputError: the text has another form, or the region is not valid (see the class).
        """
        number = float if "." in text else int
        try:
            x0, y0, x1, y1 = (number(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"region {text!r}: cannot be read; expected {_FORM}") from None
        return cls(x0, y0, x1, y1)

    @classmethod
    def of(cls, edges: Region | Sequence[float] | None) -> Region:
        """Make a region from a region, four edges, or None for the whole image."""
        if edges is None:
            return Region(0.0, 0.0, 1.0, 1.0)
        return edges if isinstance(edges, Region) else Region(*edges)

    def pixels(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The edges in whole pixels of an image.

        Args:
            width: width of the image, pixels.
            height: height of the image, pixels.

        Returns:
            x0, y0, x1, y1 with 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height.

        Raises:
            InputError: a region in pixels extends beyond the image.
        """
        if isinstance(self.x0, int):
            if self.x1 > width or self.y1 > height:
                raise InputError(f"region {self}: extends beyond the image of {width}x{height} pixels")
            return int(self.x0), int(self.y0), int(self.x1), int(self.y1)
        x0, x1 = _whole(self.x0, self.x1, width)
        y0, y1 = _whole(self.y0, self.y1, height)
        return x0, y0, x1, y1

    def slices(self, width: int, height: int) -> tuple[slice, slice]:
        """Row and column slices for indexing an image (height, width, ...); see `pixels`."""
        x0, y0, x1, y1 = self.pixels(width, height)
        return slice(y0, y1), slice(x0, x1)


def _whole(start: float, end: float, size: int) -> tuple[int, int]:
    first = min(round(start * size), size - 1)
    return first, max(round(end * size), first + 1)
