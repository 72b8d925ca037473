"""Placement of the temple's reliefs: figures, signs, friezes and winged discs on its walls and columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.modelling import Mesh, join
from steadylight.scenes.temple_columns import shaft_radius
from steadylight.scenes.temple_reliefs import figure, frieze, marsh, placed, register, signs, winged_disc
from steadylight.scenes.temple_surroundings import PYLON_BATTER

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_UP = (0.0, 0.0, 1.0)
_FACING = {
    "front": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "right": (0.0, 1.0, 0.0),
    "left": (0.0, -1.0, 0.0),
}
# the direction to the right for a viewer facing a wall whose open side is the temple's front (-y),
# back (+y), right (+x) or left (-x)


def hall_and_rooms(floor: float) -> tuple[Mesh, Mesh]:
    """Inside: registers on walls and screens; the ornaments (friezes, papyrus, winged discs) between them.

    Args:
        floor: height of the hall's floor, metres.

    Returns:
        The registers, and the ornaments, which have kept more of their paint.
    """
    rng = np.random.default_rng(7)
    registers, ornaments = [], []
    for x0 in (-9.25, 1.75):  # beside the inner door
        wall = _wall(7.5, [(1.1, 1.65), (2.75, 1.65), (4.4, 1.6)], rng)
        registers.append(_put(wall, (x0, 35.2, 0.0), "front"))
        ornaments.append(_put(marsh(7.5, 0.55, 0.045), (x0, 35.2, floor + 0.12), "front"))
        ornaments.append(_put(frieze(7.5, 0.45, 0.05), (x0, 35.2, 6.08), "front"))
    side = [(1.0, 1.8), (2.8, 1.8), (4.6, 1.4)]
    for x, y, facing in ((-9.4, 23.5, "right"), (9.4, 35.1, "left")):
        registers.append(_put(_wall(11.6, side, rng), (x, y, 0.0), facing))
        ornaments.append(_put(frieze(11.6, 0.45, 0.05), (x, y, 6.08), facing))
    for x0, width in ((-8.9, 2.0), (-5.5, 2.4), (3.1, 2.4), (6.9, 2.0)):  # screens, both faces
        registers.append(_put(_wall(width, [(0.55, 1.85)], rng), (x0, 22.4, 0.0), "front"))
        registers.append(_put(_wall(width, [(0.55, 1.85)], rng), (x0 + width, 22.9, 0.0), "back"))
    vestibule, offering = [(1.2, 2.0), (3.2, 2.0)], [(1.6, 3.0)]
    registers += [_put(_wall(3.6, vestibule, rng), (x0, 41.4, 0.0), "front") for x0 in (-5.3, 1.7)]
    registers += [_put(_wall(2.65, offering, rng), (x0, 46.8, 0.0), "front") for x0 in (-4.3, 1.65)]
    registers.append(_put(_wall(6.8, [(1.7, 2.0), (3.7, 1.8)], rng), (-3.4, 53.0, 0.0), "front"))
    for y, z, width in ((35.085, 4.6, 1.9), (41.285, 4.3, 1.7), (46.685, 4.1, 1.5)):  # over the doors
        ornaments.append(_put(winged_disc(width, 0.035), (0.0, y, z), "front"))
    return join(registers), join(ornaments)


def house_outside() -> Mesh:
    """Outside of the house, on planes that are later tilted with its walls: a row of tall figures on each flank."""
    rng = np.random.default_rng(11)
    row = [(0.9, 4.6)]
    tall = {"depth": 0.075, "sign": 0.42}
    left = _put(_wall(29.0, row, rng, **tall), (-11.0, 53.6, 0.0), "left")
    right = _put(_wall(29.0, row, rng, **tall), (11.0, 24.6, 0.0), "right")
    back = _put(_wall(20.0, row, rng, **tall), (10.0, 55.0, 0.0), "back")
    disc = _put(winged_disc(4.4, 0.05), (0.0, 22.0, 7.5), "front")
    bands = [_put(signs(6.4, 0.64, 0.3, 0.04, rng), (x0, 22.0, 7.1), "front") for x0 in (-9.0, 2.6)]
    return join([left, right, back, disc, *bands])


def court_and_pylon() -> Mesh:
    """Registers in the court's galleries, single figures on the gate, colossal figures on the pylon."""
    rng = np.random.default_rng(13)
    parts = []
    for y0, width in ((8.9, 6.0), (18.6, 3.6)):
        parts.append(_put(_wall(width, [(0.9, 2.4)], rng), (-12.8, y0, 0.0), "right"))
        parts.append(_put(_wall(width, [(0.9, 2.4)], rng), (12.8, y0 + width, 0.0), "left"))
    for x0 in (-3.5, 1.7):
        rows = [(0.5, 2.4), (2.9, 2.4), (5.3, 2.2)]
        parts.append(_put(_wall(1.8, rows, rng), (x0, 0.7, 0.0), "front"))
    parts.append(_put(winged_disc(4.6, 0.06), (0.0, 0.7, 7.9), "front"))
    up = np.array([0.0, PYLON_BATTER, 1.0]) / np.hypot(PYLON_BATTER, 1.0)
    for side in (-1, 1):
        for k, x in enumerate((6.0, 11.2)):
            giant = figure(2 * k + side, -side, 7.2, 0.14)
            parts.append(placed(giant, (side * x, PYLON_BATTER, 1.0), _FACING["front"], up))
        text = signs(3.0, 2.0, 0.55, 0.08, rng)
        parts.append(placed(text, (side * 8.8 - 1.5, 8.2 * PYLON_BATTER, 8.2), _FACING["front"], up))
    return join(parts)


def around_columns(places: ArrayLike, height: float, radius: float) -> Mesh:
    """Three figures around the middle of each column shaft.

    Args:
        places: (N, 3) feet of the columns, metres.
        height: height of the columns, metres.
        radius: radius of the shafts' feet, metres.
    """
    rng = np.random.default_rng(17)
    parts = []
    for place in np.asarray(places, dtype=np.float64):
        for k in range(3):
            relief = figure(int(rng.integers(12)), 1 - 2 * (k % 2), 1.35, 0.035)
            angle = 2 * np.pi * k / 3 + 0.5
            parts.append(_bent(relief, angle, height, radius, 1.45).moved(place))
    return join(parts)


def _bent(relief: Mesh, azimuth: float, height: float, radius: float, foot: float) -> Mesh:
    """A relief bent around a column shaft; its origin is at an azimuth, `foot` metres up the column."""
    u, v, out = relief.vertices.T
    shaft = np.asarray(shaft_radius(height, radius, foot + v))
    angle = azimuth + u / radius
    reach = shaft + out
    return Mesh(np.column_stack([reach * np.cos(angle), reach * np.sin(angle), foot + v]), relief.faces)


def _wall(
    width: float,
    rows: list[tuple[float, float]],
    rng: np.random.Generator,
    depth: float = 0.055,
    sign: float = 0.25,
) -> Mesh:
    """Stacked registers: (height of the ground line, height of the register), metres."""
    return join([register(width, height, depth, rng, sign).moved((0.0, base, 0.0)) for base, height in rows])


def _put(relief: Mesh, origin: ArrayLike, facing: str) -> Mesh:
    """A relief on a vertical wall whose open side is `facing`."""
    return placed(relief, origin, _FACING[facing], _UP)
