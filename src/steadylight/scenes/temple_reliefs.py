"""Raised relief for temple walls: walking figures, columns of signs, winged discs, friezes, as geometry.

Everything is made of ribbons: rounded strips of varying width along a line. A relief is modelled in its own frame (u to
the right, v up, h out of the wall, metres) and placed on a wall by `placed`.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.modelling import Floats, Integers, Mesh, join

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

Station = tuple[float, float, float]  # u, v, half width

_BROAD = 1.12  # figures are slightly broader than the table of their parts
_BURIED = 0.004  # depth of a ribbon's rim behind the wall, metres


def ribbon(stations: Sequence[Station] | Floats, height: float) -> Mesh:
    """A rounded strip along a line, projecting from the wall.

    Args:
        stations: (S, 3) of u, v and half width, metres; at least two, all different.
        height: height of its ridge above the wall, metres.
    """
    line = np.asarray(stations, dtype=np.float64)
    along = np.gradient(line[:, :2], axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right = np.column_stack([along[:, 1], -along[:, 0]])
    section = np.array([(1.0, -_BURIED), (0.94, 0.62 * height), (0.55, height), (-0.55, height)])
    section = np.vstack([section, [(-0.94, 0.62 * height), (-1.0, -_BURIED)]])
    sideways = line[:, None, 2] * section[None, :, 0]
    plan = line[:, None, :2] + right[:, None, :] * sideways[:, :, None]
    points = np.dstack([plan, np.broadcast_to(section[:, 1], sideways.shape)])
    return Mesh(points.reshape(-1, 3), _ribbon_faces(len(line), len(section)))


@cache
def _ribbon_faces(stations: int, width: int) -> Integers:
    """Faces of a strip of stations x width points, open towards the wall, and of its two ends."""
    index = np.arange(stations * width).reshape(stations, width)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    k = np.arange(1, width - 1)
    start = np.column_stack([index[0][np.zeros_like(k)], index[0][k], index[0][k + 1]])
    end = np.column_stack([index[-1][np.zeros_like(k)], index[-1][k + 1], index[-1][k]])
    return np.concatenate([np.column_stack([a, c, b]), np.column_stack([a, d, c]), start, end])


def disc(u: float, v: float, radius: float, height: float, steps: int = 7) -> Mesh:
    """A round boss."""
    angle = np.linspace(0.12, np.pi - 0.12, steps)
    stations = np.column_stack([np.full(steps, u), v - radius * np.cos(angle), radius * np.sin(angle)])
    return ribbon(stations, height)


def placed(mesh: Mesh, origin: ArrayLike, right: ArrayLike, up: ArrayLike) -> Mesh:
    """A relief on a wall: its (0, 0) at `origin`, u along `right`, v along `up` (unit, perpendicular)."""
    u, v = np.asarray(right, dtype=np.float64), np.asarray(up, dtype=np.float64)
    return mesh.transformed(np.column_stack([u, v, np.cross(u, v)]), origin)


def figure(kind: int, facing: int, size: float, depth: float) -> Mesh:
    """A walking king, god or goddess.

    Args:
        kind: any number; selects dress, crown and the objects in the hands.
        facing: 1 to look along u, -1 for the other way.
        size: from the ground line to the top of the head, metres; a crown adds a quarter.
        depth: how far the body projects, metres.
    """
    shapes: list[tuple[float, list[Station]]] = [*_BODY]
    shapes += _DRESSES[kind % len(_DRESSES)] + _ARMS[kind % len(_ARMS)] + _CROWNS[(kind // 2) % len(_CROWNS)]
    parts = [
        ribbon([(_BROAD * facing * u * size, v * size, _BROAD * w * size) for u, v, w in line], depth * share)
        for share, line in shapes
    ]
    return join(parts)


_BODY: list[tuple[float, list[Station]]] = [
    (0.70, [(-0.02, 0.47, 0.052), (-0.05, 0.25, 0.042), (-0.075, 0.12, 0.033), (-0.09, 0.01, 0.027)]),
    (0.66, [(-0.125, 0.014, 0.014), (-0.04, 0.018, 0.016), (0.03, 0.010, 0.010)]),
    (0.86, [(0.02, 0.47, 0.052), (0.065, 0.25, 0.042), (0.10, 0.12, 0.033), (0.11, 0.01, 0.027)]),
    (0.80, [(0.075, 0.014, 0.014), (0.16, 0.018, 0.016), (0.23, 0.010, 0.010)]),
    (
        0.94,
        [
            (0.0, 0.49, 0.062),
            (0.0, 0.58, 0.054),
            (0.0, 0.68, 0.074),
            (0.0, 0.76, 0.112),
            (0.0, 0.80, 0.108),
            (0.0, 0.82, 0.045),
        ],
    ),
    (0.88, [(0.005, 0.80, 0.030), (0.012, 0.87, 0.030)]),
    (
        1.0,
        [
            (0.012, 0.85, 0.028),
            (0.028, 0.88, 0.044),
            (0.026, 0.92, 0.052),
            (0.016, 0.955, 0.044),
            (0.0, 0.98, 0.02),
        ],
    ),
    (1.06, [(-0.052, 0.78, 0.022), (-0.046, 0.88, 0.032), (-0.030, 0.95, 0.040), (0.0, 0.985, 0.026)]),
]
_DRESSES: list[list[tuple[float, list[Station]]]] = [
    [
        (1.0, [(0.0, 0.515, 0.064), (0.005, 0.43, 0.088), (0.02, 0.33, 0.112)]),
        (1.1, [(0.0, 0.50, 0.066), (0.0, 0.525, 0.063)]),
    ],
    [(0.98, [(0.0, 0.52, 0.060), (0.0, 0.40, 0.082), (0.01, 0.22, 0.082), (0.02, 0.05, 0.092)])],
    [
        (1.0, [(0.0, 0.515, 0.064), (0.005, 0.43, 0.086), (0.03, 0.30, 0.13)]),
        (0.6, [(-0.075, 0.50, 0.012), (-0.10, 0.30, 0.014), (-0.10, 0.12, 0.020)]),
    ],
]
_RAISED: list[Station] = [
    (0.10, 0.775, 0.030),
    (0.17, 0.685, 0.027),
    (0.26, 0.71, 0.022),
    (0.35, 0.75, 0.018),
]
_HANGING: list[Station] = [
    (-0.10, 0.775, 0.030),
    (-0.135, 0.65, 0.027),
    (-0.125, 0.54, 0.022),
    (-0.118, 0.46, 0.021),
]
_ARMS: list[list[tuple[float, list[Station]]]] = [
    [  # offers two vessels
        (1.05, _RAISED),
        (0.85, [(-0.08, 0.77, 0.028), (0.04, 0.66, 0.027), (0.20, 0.655, 0.022), (0.33, 0.67, 0.018)]),
        (0.9, [(0.385, 0.72, 0.014), (0.385, 0.76, 0.034), (0.385, 0.80, 0.030), (0.385, 0.83, 0.014)]),
        (0.8, [(0.37, 0.645, 0.012), (0.37, 0.675, 0.030), (0.37, 0.70, 0.016)]),
    ],
    [  # holds a staff, and the sign of life in the other hand
        (0.9, [(0.10, 0.775, 0.030), (0.16, 0.66, 0.027), (0.25, 0.60, 0.022), (0.33, 0.60, 0.020)]),
        (0.7, [(0.34, 0.0, 0.009), (0.34, 0.45, 0.009), (0.34, 0.88, 0.009)]),
        (0.7, [(0.31, 0.90, 0.012), (0.36, 0.925, 0.016), (0.40, 0.90, 0.010)]),
        (0.9, _HANGING),
        (0.7, [(-0.118, 0.33, 0.010), (-0.118, 0.41, 0.010)]),
        (0.66, [(-0.152, 0.405, 0.009), (-0.084, 0.405, 0.009)]),
    ],
    [  # adores
        (1.05, _RAISED),
        (0.9, [(0.35, 0.755, 0.016), (0.385, 0.81, 0.014), (0.39, 0.85, 0.008)]),
        (0.8, [(-0.08, 0.77, 0.028), (0.06, 0.69, 0.026), (0.24, 0.77, 0.020), (0.30, 0.86, 0.012)]),
    ],
    [
        (0.9, _HANGING),
        (1.02, [(0.10, 0.775, 0.030), (0.15, 0.65, 0.027), (0.17, 0.54, 0.022), (0.17, 0.46, 0.02)]),
    ],
]
_CROWNS: list[list[tuple[float, list[Station]]]] = [
    [  # white crown
        (
            0.95,
            [
                (-0.005, 0.955, 0.050),
                (-0.02, 1.04, 0.044),
                (-0.035, 1.13, 0.022),
                (-0.04, 1.165, 0.026),
                (-0.042, 1.19, 0.012),
            ],
        )
    ],
    [  # disc between horns
        (
            0.9,
            [
                (-0.01, 1.00, 0.02),
                (-0.01, 1.03, 0.052),
                (-0.01, 1.07, 0.064),
                (-0.01, 1.11, 0.052),
                (-0.01, 1.14, 0.02),
            ],
        ),
        (0.7, [(-0.01, 0.985, 0.016), (-0.075, 1.03, 0.014), (-0.095, 1.12, 0.011), (-0.08, 1.19, 0.006)]),
        (0.76, [(-0.01, 0.985, 0.016), (0.055, 1.03, 0.014), (0.075, 1.12, 0.011), (0.06, 1.19, 0.006)]),
    ],
    [  # two plumes
        (0.9, [(-0.035, 0.97, 0.018), (-0.042, 1.12, 0.030), (-0.042, 1.23, 0.030), (-0.035, 1.27, 0.012)]),
        (0.84, [(0.018, 0.97, 0.018), (0.022, 1.12, 0.030), (0.022, 1.23, 0.030), (0.016, 1.27, 0.012)]),
    ],
    [  # red crown
        (0.95, [(0.0, 0.955, 0.055), (-0.005, 1.02, 0.062), (-0.008, 1.035, 0.060)]),
        (0.9, [(-0.055, 1.02, 0.014), (-0.062, 1.12, 0.012), (-0.066, 1.18, 0.010)]),
    ],
]

_Sign = list[tuple[float, list[Station]]]
_SIGNS: list[_Sign] = [
    [(0.8, [(0.5, 0.05, 0.05), (0.52, 0.45, 0.13), (0.5, 0.8, 0.10), (0.44, 0.95, 0.03)])],  # reed
    [(0.8, [(0.05 + 0.15 * k, 0.5 + 0.1 * (-1) ** k, 0.06) for k in range(7)])],  # water
    [
        (0.9, [(0.12, 0.5, 0.04), (0.3, 0.5, 0.15), (0.5, 0.5, 0.19), (0.7, 0.5, 0.15), (0.88, 0.5, 0.04)])
    ],  # mouth
    [
        (0.9, [(0.2, 0.3, 0.03), (0.5, 0.33, 0.06), (0.8, 0.3, 0.03)]),
        (0.8, [(0.5, 0.30, 0.27), (0.5, 0.5, 0.23), (0.5, 0.62, 0.09)]),
    ],  # loaf
    [  # bird
        (0.9, [(0.08, 0.24, 0.05), (0.35, 0.42, 0.15), (0.6, 0.58, 0.17), (0.72, 0.74, 0.08)]),
        (1.0, [(0.66, 0.74, 0.07), (0.74, 0.85, 0.10), (0.92, 0.83, 0.025)]),
        (0.7, [(0.46, 0.38, 0.035), (0.48, 0.1, 0.03), (0.62, 0.05, 0.025)]),
        (0.64, [(0.58, 0.42, 0.035), (0.60, 0.12, 0.03), (0.76, 0.06, 0.025)]),
    ],
    [  # life
        (0.8, [(0.5, 0.05, 0.055), (0.5, 0.55, 0.045)]),
        (0.74, [(0.2, 0.5, 0.045), (0.8, 0.5, 0.045)]),
        (
            0.86,
            [
                (0.49, 0.55, 0.04),
                (0.34, 0.75, 0.045),
                (0.5, 0.93, 0.045),
                (0.66, 0.75, 0.045),
                (0.51, 0.55, 0.04),
            ],
        ),
    ],
    [
        (0.85, [(0.35, 0.95, 0.05), (0.37, 0.4, 0.07), (0.36, 0.12, 0.07)]),
        (0.8, [(0.3, 0.07, 0.05), (0.82, 0.07, 0.05)]),
    ],  # leg
    [
        (
            0.85,
            [(0.08, 0.42, 0.03), (0.3, 0.5, 0.05), (0.55, 0.42, 0.06), (0.75, 0.55, 0.06), (0.9, 0.72, 0.05)],
        )
    ],  # snake
    [  # pillar
        (0.8, [(0.5, 0.05, 0.14), (0.5, 0.4, 0.09), (0.5, 0.95, 0.09)]),
        *[(0.9, [(0.26, v, 0.035), (0.74, v, 0.035)]) for v in (0.58, 0.7, 0.82)],
    ],
    [
        (0.9, [(0.5, 0.18, 0.06), (0.5, 0.3, 0.24), (0.5, 0.5, 0.32), (0.5, 0.7, 0.24), (0.5, 0.82, 0.06)])
    ],  # sun
    [(0.8, [(0.5, 0.28, 0.10), (0.5, 0.42, 0.34), (0.5, 0.60, 0.42)])],  # basket
    [
        (0.8, [(0.3, 0.06, 0.04), (0.3, 0.9, 0.04)]),
        (0.9, [(0.3, 0.9, 0.05), (0.55, 0.86, 0.12), (0.7, 0.7, 0.05)]),
    ],  # flag
]


def signs(width: float, height: float, cell: float, depth: float, rng: np.random.Generator) -> Mesh:
    """Columns of signs between raised rules, filling a rectangle from (0, 0).

    Args:
        width: width of the rectangle, metres.
        height: height of the rectangle, metres.
        cell: size of a sign, metres.
        depth: how far the signs project, metres.
        rng: selects the signs.
    """
    columns, rows = max(1, int(width / (1.25 * cell))), max(1, int(height / (1.08 * cell)))
    pitch = width / columns
    parts = []
    for c in range(columns):
        left = c * pitch + 0.5 * (pitch - cell)
        for r in range(rows):
            sign = _SIGNS[int(rng.integers(len(_SIGNS)))]
            base = r * height / rows
            parts += [
                ribbon([(left + u * cell, base + v * cell, w * cell) for u, v, w in line], depth * share)
                for share, line in sign
            ]
    for c in range(columns + 1):
        parts.append(ribbon([(c * pitch, 0.0, 0.06 * cell), (c * pitch, height, 0.06 * cell)], 0.7 * depth))
    return join(parts)


def register(width: float, height: float, depth: float, rng: np.random.Generator, sign: float = 0.25) -> Mesh:
    """A row of figures that face each other in pairs, their ground line, and signs above them.

    Args:
        width: metres, from u = 0.
        height: metres, from the ground line at v = 0 to the next register.
        depth: how far the figures project, metres.
        rng: selects figures and signs.
        sign: size of the signs, metres.
    """
    size = 0.74 * height
    count = max(1, int(width / (0.76 * size)))
    pitch = width / count
    line = 0.012 * height
    parts = [ribbon([(0.0, line, line), (width, line, line)], 0.75 * depth)]
    for k in range(count):
        facing = 1 if k % 2 == 0 else -1
        middle = (k + 0.5) * pitch - 0.10 * size * facing
        kind = int(rng.integers(12))
        parts.append(figure(kind, facing, size, depth).moved((middle, 2.2 * line, 0.0)))
        free = 0.44 * pitch
        left = k * pitch + (0.54 * pitch if facing > 0 else 0.02 * pitch)
        text = signs(free, 0.28 * height, sign, 0.6 * depth, rng)
        parts.append(text.moved((left, 0.70 * height, 0.0)))
    return join(parts)


def winged_disc(width: float, depth: float) -> Mesh:
    """The sun between two wings of three tiers of feathers, centred at (0, 0), `width` metres wide."""
    half, parts = width / 2, [disc(0.0, 0.0, 0.085 * width, 1.25 * depth, 9)]
    for side in (-1.0, 1.0):
        for tier, (reach, drop, share) in enumerate(
            ((1.0, 0.05, 0.7), (0.8, 0.01, 0.85), (0.55, -0.035, 1.0))
        ):
            feathers = 12 - 3 * tier
            for k in range(feathers):
                t = (k + 0.5) / feathers
                u = side * half * (0.16 + (reach - 0.16) * t)
                top = width * (0.055 - 0.035 * t)
                low = width * (-0.06 - drop + 0.055 * t)
                w = 0.46 * half * (reach - 0.16) / feathers
                tip = u + side * 0.05 * width
                parts.append(
                    ribbon(
                        [(u, top, w), ((u + tip) / 2, (top + low) / 2, w), (tip, low, 0.5 * w)], depth * share
                    )
                )
        for drop in (0.0, 1.0):  # two cobras
            u = side * width * (0.10 + 0.02 * drop)
            parts.append(
                ribbon(
                    [
                        (u, -0.085 * width, 0.012 * width),
                        (u, 0.0, 0.014 * width),
                        (0.9 * u, 0.06 * width, 0.008 * width),
                    ],
                    depth,
                )
            )
    return join(parts)


def frieze(width: float, height: float, depth: float) -> Mesh:
    """A row of knotted reed bundles along the top of a wall, from u = 0, above a rule."""
    count = max(1, round(width / (0.42 * height)))
    pitch = width / count
    line = 0.04 * height
    parts = [ribbon([(0.0, line, line), (width, line, line)], depth)]
    for k in range(count):
        u = (k + 0.5) * pitch
        shape = [(0.10, 0.42), (0.45, 0.30), (0.56, 0.12), (0.66, 0.26), (0.98, 0.40)]
        parts.append(ribbon([(u, v * height, w * pitch) for v, w in shape], 0.8 * depth))
    return join(parts)


def marsh(width: float, height: float, depth: float) -> Mesh:
    """Papyrus stems with alternating umbels and buds, as along the foot of a wall, from (0, 0)."""
    count = max(1, round(width / (0.34 * height)))
    pitch = width / count
    parts = []
    for k in range(count):
        u, tall = (k + 0.5) * pitch, 1.0 if k % 2 == 0 else 0.74
        parts.append(ribbon([(u, 0.0, 0.05 * pitch), (u, 0.72 * tall * height, 0.05 * pitch)], 0.7 * depth))
        head = (
            ((0.70, 0.06), (0.82, 0.20), (1.0, 0.46))
            if k % 2 == 0
            else ((0.70, 0.08), (0.84, 0.19), (1.0, 0.03))
        )
        parts.append(ribbon([(u, v * tall * height, w * pitch) for v, w in head], depth))
    return join(parts)
