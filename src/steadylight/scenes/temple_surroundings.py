"""Surroundings of the temple: the pylon's towers, the desert, fallen blocks."""

from __future__ import annotations

import numpy as np

from steadylight.scenes.modelling import Floats, Mesh, at_height, height_field, join, loft
from steadylight.scenes.temple_mouldings import cornice

PYLON_BATTER = 0.075
"""How far the towers' fronts lean back, metres per metre of height."""


def pylon() -> tuple[Mesh, Mesh]:
    """The two battered towers: closed lofts, and their cornices."""
    towers, crowns = [], []
    for s in (-1.0, 1.0):
        rings = []
        for z in (-0.6, 14.0):
            inset = 0.075 * z
            x0, x1 = 2.9 + 0.6 * inset, 17.0 - inset
            y0, y1 = inset, 5.2 - 0.6 * inset
            rings.append(at_height([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z))
        tower = loft(rings)
        low, high = rings[1][0, :2], rings[1][2, :2]
        crown = cornice(low, high, 13.99, 1.3, rib=0.5)
        mirror = np.diag([s, 1.0, 1.0])
        towers.append(tower.transformed(mirror))
        crowns.append(crown.transformed(mirror))
    return join(towers), join(crowns)


def desert() -> Mesh:
    """Sand: nearly level around the temple, with dunes at the rim that hide the horizon."""
    radius = np.concatenate([np.linspace(0.5, 70.0, 40), np.geomspace(75.0, 420.0, 28)])
    azimuth = np.linspace(0.0, 2 * np.pi, 161)
    r, a = np.meshgrid(radius, azimuth, indexing="ij")
    x, y = r * np.cos(a), 28.0 + r * np.sin(a)
    waves = np.sin(0.11 * x + 0.6 * np.sin(0.05 * y)) + np.sin(0.083 * y + 0.04 * x + 1.0)
    far = np.clip((r - 70.0) / 350.0, 0.0, 1.0)
    near = np.clip((r - 45.0) / 60.0, 0.0, 1.0)
    z = (
        -0.16
        + near * 0.5 * waves
        + 36.0 * far**1.5 * (1.0 + 0.35 * np.sin(5 * a) + 0.2 * np.sin(11 * a + 1.0))
    )
    return height_field(x, y, z)


def rubble() -> Mesh:
    """Fallen blocks, half buried in sand, around the temple, and a few in the corners of the court."""
    rng = np.random.default_rng(31)
    spots = [(s * rng.uniform(16.5, 24.0), rng.uniform(-8.0, 58.0), -0.2) for s in (-1, 1) for _ in range(16)]
    spots += [(rng.uniform(-15.0, 15.0), rng.uniform(58.5, 66.0), -0.2) for _ in range(8)]
    spots += [(s * rng.uniform(4.5, 15.0), rng.uniform(-9.0, -2.5), -0.2) for s in (-1, 1) for _ in range(7)]
    spots += [(-11.9, 20.9, 0.0), (-11.6, 19.4, 0.0), (11.8, 6.6, 0.0), (11.9, 21.3, 0.0), (-11.4, 6.4, 0.0)]
    parts = []
    for spot in spots:
        half = rng.uniform((0.35, 0.25, 0.18), (0.8, 0.45, 0.34))
        lean = rng.uniform(-0.22, 0.22, 2)
        block = loft([_chipped(half, -half[2], rng), _chipped(half, half[2], rng)])
        tilt = np.array([[1.0, 0.0, lean[0]], [0.0, 1.0, lean[1]], [-lean[0], -lean[1], 1.0]])
        block = Mesh(block.vertices @ tilt.T, block.faces).turned(rng.uniform(0.0, np.pi))
        parts.append(block.moved(np.add(spot, (0.0, 0.0, 0.6 * half[2]))))
    return join(parts)


def _chipped(half: Floats, z: float, rng: np.random.Generator) -> Floats:
    """The outline of a block at a height: a rectangle with broken corners."""
    x, y, cut = half[0], half[1], rng.uniform(0.02, 0.10, 4)
    plan = []
    for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        pair = [(sx * (x - cut[k]), sy * y), (sx * x, sy * (y - cut[k]))]
        plan += pair if sx * sy < 0 else pair[::-1]
    return at_height(plan, z)
