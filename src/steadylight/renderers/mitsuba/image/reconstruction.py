"""From samples to pixels by the film's reconstruction filter, in a fixed order.

Mitsuba's image block splats samples with atomic operations, whose order, and so the last bit, changes from run to run.
Here each pixel gathers the samples of its neighbourhood: the same filter, but reproducible.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.image.pixels import Rows
from steadylight.renderers.mitsuba.upload import download, upload


def border_of(rfilter: mi.ReconstructionFilter) -> int:
    """Number of neighbouring pixels on each side that a reconstruction filter covers."""
    return math.ceil(rfilter.radius() - 0.5)


def integral_of(rfilter: mi.ReconstructionFilter) -> NDArray[np.float64]:
    """Integral of a filter along one axis over each pixel that it covers, from the leftmost to the rightmost."""
    border = border_of(rfilter)
    t = (np.arange(512) + 0.5) / 512 - 0.5 + np.arange(-border, border + 1)[:, None]
    f = np.array(rfilter.eval(upload(mi.Float, t.ravel().astype(np.float32))), np.float64).reshape(t.shape)
    return np.where(np.abs(t) <= rfilter.radius(), f, 0).mean(axis=1)


def reconstruct(
    L: mi.Color3f, offset: mi.Point2f, rfilter: mi.ReconstructionFilter, rows: Rows, width: int
) -> NDArray[np.float32]:
    """Filter-weighted sums of radiance, and of weights, for the wanted rows.

    Args:
        L: samples of the sampled rows; those of a pixel are adjacent.
        offset: position of each sample in its pixel.
        rfilter: separable reconstruction filter.
        rows: of the picture; pixels outside the sampled rows are ignored.
        width: pixels per row.

    Returns:
        (rows, width, 4) float32.
    """
    have, want = rows
    pixels = (have[1] - have[0]) * width
    border = border_of(rfilter)
    given = shares(L, offset, rfilter, pixels, dr.opaque(mi.UInt32, dr.width(offset) // pixels))
    dr.eval(given)
    height = want[1] - want[0]
    w = dr.opaque(mi.Int32, width)
    pixel = dr.arange(mi.Int32, height * width)
    y = pixel // w
    x = pixel - y * w
    y += dr.opaque(mi.Int32, want[0] - have[0])
    sampled = dr.opaque(mi.Int32, have[1] - have[0])
    side = 2 * border + 1
    total, weight = mi.Color3f(0), mi.Float(0)
    for step in range(side * side):
        from_y, from_x = y + border - step // side, x + border - step % side
        there = (from_x >= 0) & (from_x < w) & (from_y >= 0) & (from_y < sampled)
        index = mi.UInt32((from_y * w + from_x) * side + step // side)
        color, f = given[step % side]
        total += dr.gather(mi.Color3f, color, index, there)
        weight += dr.gather(mi.Float, f, index, there)
    dr.eval(total, weight)
    return np.stack([download(each) for each in (*total, weight)], axis=1).reshape(height, width, 4)


@dr.syntax
def shares(
    L: mi.Color3f, offset: mi.Point2f, rfilter: mi.ReconstructionFilter, pixels: int, spp: mi.UInt32
) -> list[tuple[mi.Color3f, mi.Float]]:
    """Contributions of each pixel's samples to itself and its neighbours: sums of the filter, and of filter * radiance.

    A lane handles one pixel and one row of neighbours, so that it evaluates the filter once for that row and once for
    each column.

    Args:
        L: samples; those of a pixel are adjacent.
        offset: position of each sample in its pixel.
        rfilter: separable reconstruction filter.
        pixels: number of pixels.
        spp: samples per pixel.

    Returns:
        For each column of neighbours, from the left: Color3f and Float; the rows of neighbours of a pixel are adjacent,
        from the top.
    """
    border = border_of(rfilter)
    radius = rfilter.radius()
    side = 2 * border + 1
    lane = dr.arange(mi.UInt32, pixels * side)
    pixel = lane // side
    dy = mi.Float(mi.Int32(lane - pixel * side) - border)
    # ---- loop state ----------------------------------------------------------------------
    s = mi.UInt32(0)
    total = [mi.Color3f(0) for _ in range(side)]
    weight = [mi.Float(0) for _ in range(side)]
    while s < spp:
        index = pixel * spp + s
        color = dr.gather(mi.Color3f, L, index)
        at = dr.gather(mi.Point2f, offset, index) - 0.5
        away_y = at.y - dy
        fy = dr.select(dr.abs(away_y) <= radius, rfilter.eval(away_y), 0)
        for column in range(side):
            away_x = at.x - (column - border)
            f = dr.select(dr.abs(away_x) <= radius, fy * rfilter.eval(away_x), 0)
            total[column] += f * color
            weight[column] += f
        s += 1
    return list(zip(total, weight, strict=True))
