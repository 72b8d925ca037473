"""Enlarged, contrast-stretched pieces of a frame, beside the same pieces of a reference.

    python benchmarks/crops.py RUN REFERENCE --frame 13 --at 40,60 200,20 --size 64 --output crops.png

Both pieces of a pair are stretched alike: 1 % of the reference's pixels are darker than black, and 1 % brighter than
white. In a piece that is about as bright all over, a fault of a hundredth of the brightness is seen.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steadylight.images import read_exr, tone_map, write_png

Picture = NDArray[np.float32]

GAP = 4
"""White pixels between the pieces."""


def main() -> None:
    """Write a picture with a row for each piece: the run, then the reference."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--frame", type=int, required=True)
    parser.add_argument("--at", nargs="+", required=True, metavar="X,Y", help="upper left corners, pixels")
    parser.add_argument("--size", type=int, default=64, help="of a piece, pixels")
    parser.add_argument("--times", type=int, default=4, help="so many times enlarged")
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    name = f"frame_{options.frame:05d}.exr"
    both = [read_exr(folder / "frames" / name) for folder in (options.run, options.reference)]
    rows = []
    for corner in options.at:
        x, y = map(int, corner.split(","))
        pieces = [image[y : y + options.size, x : x + options.size] for image in both]
        black, white = np.percentile(pieces[1].mean(axis=2), (1, 99))
        rows.append([stretched(piece, black, white, options.times) for piece in pieces])
    write_png(options.output, side_by_side(rows))


def stretched(piece: Picture, black: float, white: float, times: int) -> NDArray[np.uint8]:
    """A piece on the display: (times * height, times * width, 3)."""
    shown = tone_map(piece - np.float32(black), 1 / max(white - black, 1e-9), "none")
    return np.asarray(np.kron(shown, np.ones((times, times, 1), np.uint8)))


def side_by_side(rows: list[list[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """All pieces in rows, with gaps between."""
    lines = [np.concatenate([padded(piece, 1) for piece in row], axis=1)[:, :-GAP] for row in rows]
    return np.concatenate([padded(line, 0) for line in lines], axis=0)[:-GAP]


def padded(piece: NDArray[np.uint8], axis: int) -> NDArray[np.uint8]:
    """A piece with a gap after it."""
    edges = [(0, 0)] * 3
    edges[axis] = (0, GAP)
    return np.pad(piece, edges, constant_values=255)


if __name__ == "__main__":
    main()
