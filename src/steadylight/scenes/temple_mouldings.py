"""Cavetto cornices of the temple: torus, ribbed throat and fillet around a wall's top."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.modelling import Floats, Mesh, at_height, loft, tidy

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def cornice(lower: ArrayLike, upper: ArrayLike, z: float, size: float, rib: float = 0.15) -> Mesh:
    """A cavetto cornice around a rectangle in plan: torus moulding, ribbed throat, fillet; closed.

    Args:
        lower: (2,) smallest x and y of the wall under it, metres.
        upper: (2,) largest x and y.
        z: height of the torus' underside, metres.
        size: total height, metres; it projects by half of that.
        rib: width of a palm rib in the throat, metres; 0 for a plain throat.
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    plan, outward, phase = _perimeter(low, high, rib)
    angle = np.linspace(-1.0, 1.0, 5) * np.pi / 2
    torus = [(0.09 * size * np.cos(a), 0.11 * size * (1 + np.sin(a)), 0.0) for a in angle]
    turn = np.linspace(0.0, 1.0, 6) * np.pi / 2
    throat = [(0.5 * size * (1 - np.cos(a)), size * (0.24 + 0.54 * np.sin(a)), 1.0) for a in turn]
    profile = [(-0.01, 0.0, 0.0), *torus, *throat, (0.5 * size, 0.80 * size, 0.0), (0.5 * size, size, 0.0)]
    depth = 0.022 * np.abs(np.sin(np.pi * phase))[:, None]
    rings = [at_height(plan + outward * (out - depth * ribs), z + up) for out, up, ribs in profile]
    return tidy(loft(rings))


def _perimeter(low: Floats, high: Floats, step: float) -> tuple[Floats, Floats, Floats]:
    """Points around a rectangle, their outward directions (diagonal at the corners), and rib phases."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    sides = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    points, outward, phase = [], [], []
    for k in range(4):
        start, end = corners[k], corners[(k + 1) % 4]
        ribs = max(1, round(float(np.linalg.norm(end - start)) / step)) if step > 0 else 1
        t = np.arange(0, ribs, 0.5) if step > 0 else np.zeros(1)
        points.append(start + (end - start) * (t / ribs)[:, None])
        out = np.repeat(sides[k][None], len(t), axis=0)
        out[0] = sides[k] + sides[k - 1]
        outward.append(out)
        phase.append(t)
    return np.concatenate(points), np.concatenate(outward), np.concatenate(phase)
