"""The Nubian sandstone temple of `temple-walk` and `temple-rotation`: plan, stones, columns, sun and sky.

It stands for the temple of Kalabsha: pylon, open court with columns on three sides, a columned hall behind
screen walls, and three rooms in a row that grow darker and lower towards the sanctuary. Frame: x across, y
inwards along the axis, z up, metres; the court's floor is at z = 0, the front of the pylon at y = 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from steadylight.scenes.masonry import Bond, Face, Masonry, core, masonry_skin
from steadylight.scenes.modelling import (
    Floats,
    Mesh,
    at_height,
    box,
    height_field,
    join,
    loft,
    projected_uv,
    tidy,
    triangles,
)
from steadylight.scenes.temple_columns import Capital, colonnade

SUN = (0.42, -0.62, 0.66)
"""Direction towards the sun (any length): over the pylon, on the right hand of who walks in."""

SUN_SCALE = 60.0
SKY_SCALE = 60.0
"""Factors on Mitsuba's sun and sky that bring the hall's walls to radiances of 0.1 to 1."""

HALL_FLOOR = 0.30
"""Height of the hall's floor, metres."""

_WALLS = Bond()
_CEILINGS = Bond(course=1.0, length=3.3, bevel=0.010, depth=(0.004, 0.018))
_FLOORS = Bond(course=0.95, length=1.35, bevel=0.010, depth=(0.004, 0.012), tilt=0.003)
_HUES = 3  # materials that the blocks of the walls are dealt onto

_HALL_COLUMNS = [(x, y) for y in (27.0, 31.2) for x in (-6.2, -2.4, 2.4, 6.2)]
_FRONT_COLUMNS = [(x, 22.65) for x in (-6.2, -2.4, 2.4, 6.2)]
_COURT_COLUMNS = [(s * 9.4, y) for s in (-1, 1) for y in (8.2, 10.9, 13.6, 17.0, 19.7)] + [
    (s * x, 8.2) for s in (-1, 1) for x in (3.9, 6.6)
]
ROOF_SLOTS = [
    # x0, y0, x1, y1 of the light slots through the roofs of hall, vestibule, offering room and sanctuary
    (-0.8, 28.2, 0.8, 30.2),
    (-4.9, 28.2, -3.7, 30.0),
    (3.7, 28.2, 4.9, 30.0),
    (-0.8, 32.4, 0.8, 34.4),
    (1.4, 37.9, 3.0, 39.9),
    (-2.2, 43.6, -0.6, 45.8),
    (-0.2, 48.7, 1.6, 50.9),
]


def court() -> Masonry:
    """Gate, court walls, the galleries' roofs and the pavement in front."""
    stone = Masonry()
    stone.add((-14.5, 4.0, -0.6), (14.5, 23.6, 8.0))
    stone.carve((-12.8, 5.3, 0.0), (12.8, 22.3, 8.0))
    stone.carve((-10.2, 22.3, 0.0), (10.2, 23.6, 8.0))  # the house stands here
    for x0, x1 in ((-12.8, -8.9), (8.9, 12.8)):
        stone.add((x0, 5.3, 6.9), (x1, 22.3, 7.5))
    stone.add((-12.8, 5.3, 6.9), (12.8, 8.7, 7.5))
    stone.add((-9.9, 7.7, 6.2), (9.9, 8.7, 6.9))
    for x0, x1 in ((-9.9, -8.9), (8.9, 9.9)):
        stone.add((x0, 7.7, 6.2), (x1, 22.3, 6.9))
    for x0, x1 in ((-14.5, -12.8), (12.8, 14.5)):
        stone.carve((x0, 15.2, 0.0), (x1, 18.3, 4.4))  # side gates
    stone.add((-3.6, 0.7, -0.6), (3.6, 5.3, 9.2))
    stone.carve((-1.6, 0.7, 0.0), (1.6, 5.3, 5.8))
    stone.carve((-2.1, 2.4, 0.0), (2.1, 5.3, 6.2))
    stone.add((-3.4, -24.0, -0.6), (3.4, 0.7, -0.02))
    return stone


def house() -> Masonry:
    """Hall and inner rooms, carved out of one block; its front is open between antae."""
    stone = Masonry()
    stone.add((-11.0, 22.0, -0.6), (11.0, 55.0, 8.6))
    stone.carve((-11.0, 37.4, 7.0), (11.0, 55.0, 8.6))
    stone.carve((-9.4, 22.0, HALL_FLOOR), (9.4, 35.2, 6.6))
    for x0, x1 in ((-9.4, -6.75), (-5.65, -2.95), (-1.85, 1.85), (2.95, 5.65), (6.75, 9.4)):
        stone.carve((x0, 23.3, 6.6), (x1, 35.2, 7.8))  # leaves beams from front to back
    _rooms(stone)
    for x0, y0, x1, y1 in ROOF_SLOTS:
        stone.carve((x0, y0, 5.0), (x1, y1, 8.6))
    return stone


def _rooms(stone: Masonry) -> None:
    """Vestibule, offering room, sanctuary, side chambers and the doors between them."""
    stone.carve((-5.5, 36.8, 0.6), (5.5, 41.4, 6.3))
    stone.carve((-1.15, 35.2, HALL_FLOOR), (1.15, 36.2, 4.4))
    stone.carve((-1.15, 35.6, 0.45), (1.15, 36.8, 4.4))
    stone.add((-1.15, 35.6, HALL_FLOOR), (1.15, 36.8, 0.45))
    stone.carve((-4.5, 42.8, 0.9), (4.5, 46.8, 6.2))
    stone.carve((-1.05, 41.4, 0.6), (1.05, 42.0, 4.2))
    stone.carve((-1.05, 42.0, 0.75), (1.05, 42.8, 4.2))
    stone.carve((-3.6, 48.2, 1.2), (3.6, 53.0, 6.1))
    stone.carve((-0.95, 46.8, 0.9), (0.95, 47.4, 4.1))
    stone.carve((-0.95, 47.4, 1.05), (0.95, 48.2, 4.1))
    for s in (-1, 1):
        inner, outer = s * 6.8, s * 9.4
        stone.carve((min(inner, outer), 37.4, 0.6), (max(inner, outer), 41.0, 4.4))
        stone.carve((min(s * 5.5, inner), 38.6, 0.6), (max(s * 5.5, inner), 39.6, 2.8))


def screens() -> Mesh:
    """Screen walls between the front columns, with cornices; the middle is the way in."""
    parts = []
    for x0, x1 in ((2.4, 6.2), (6.2, 9.6)):
        for s in (-1, 1):
            a, b = sorted((s * x0, s * x1))
            parts.append(box((a, 22.4, HALL_FLOOR - 0.1), (b, 22.9, 2.5)))
            parts.append(cornice((a, 22.4), (b, 22.9), 2.5, 0.42))
    for s in (-1, 1):
        a, b = sorted((s * 1.25, s * 2.4))
        parts.append(box((a, 22.3, HALL_FLOOR - 0.1), (b, 23.0, 3.4)))
        parts.append(cornice((a, 22.3), (b, 23.0), 3.4, 0.5))
    return join(parts)


def cornice(lower: ArrayLike, upper: ArrayLike, z: float, size: float, rib: float = 0.11) -> Mesh:
    """A cavetto cornice around a rectangle in plan: torus moulding, ribbed throat, fillet; closed.

    Args:
        lower: (2,) smallest x and y of the wall under it, metres.
        upper: (2,) largest.
        z: height of the torus' underside, metres.
        size: height of the whole, metres; it juts out by half of that.
        rib: width of a palm rib in the throat, metres.
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
        ribs = max(1, round(float(np.linalg.norm(end - start)) / step))
        t = np.arange(0, ribs, 0.5 if ribs < 60 else 1.0)
        points.append(start + (end - start) * (t / ribs)[:, None])
        out = np.repeat(sides[k][None], len(t), axis=0)
        out[0] = sides[k] + sides[k - 1]
        outward.append(out)
        phase.append(t)
    return np.concatenate(points), np.concatenate(outward), np.concatenate(phase)


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
        crown = cornice(low, high, 13.99, 1.3, rib=0.26)
        mirror = np.diag([s, 1.0, 1.0])
        towers.append(tower.transformed(mirror))
        crowns.append(crown.transformed(mirror))
    return join(towers), join(crowns)


def cornices() -> Mesh:
    """Over doors and around the roofs."""
    parts = [
        cornice((-11.0 + 0.43, 22.0), (11.0 - 0.43, 37.4), 8.55, 0.8, rib=0.2),
        cornice((-2.0, 35.0), (2.0, 35.4), 4.9, 0.6),
        cornice((-1.8, 41.2), (1.8, 41.6), 4.6, 0.55),
        cornice((-1.6, 46.6), (1.6, 47.0), 4.4, 0.5),
        cornice((-3.62, 0.68), (3.62, 5.32), 9.15, 0.9, rib=0.2),
    ]
    frames = [
        (35.08, 35.3, 1.15, 1.65, HALL_FLOOR, 4.9),
        (41.28, 41.5, 1.05, 1.5, 0.6, 4.6),
        (46.68, 46.9, 0.95, 1.35, 0.9, 4.4),
    ]
    for y0, y1, inner, outer, z0, z1 in frames:
        parts.append(box((-outer, y0, z0 - 0.05), (-inner, y1, z1)))
        parts.append(box((inner, y0, z0 - 0.05), (outer, y1, z1)))
        parts.append(box((-inner - 0.01, y0 + 0.005, z1 - 0.62), (inner + 0.01, y1, z1 + 0.01)))
    return join(parts)


def furniture() -> Mesh:
    """Steps, altars, benches, statue bases."""
    parts = [
        box((-1.9, 20.9, -0.1), (1.9, 22.05, 0.155)),
        box((-1.25, 21.55, 0.1), (1.25, 22.4, 0.302)),
        box((-0.85, 50.6, 1.15), (0.85, 52.0, 2.1)),
        cornice((-0.85, 50.6), (0.85, 52.0), 2.1, 0.3),
        box((-1.05, 50.4, 1.15), (1.05, 52.2, 1.32)),
    ]
    for s in (-1, 1):
        a, b = sorted((s * 3.9, s * 4.9))
        parts.append(box((a, 34.0, HALL_FLOOR - 0.05), (b, 34.9, HALL_FLOOR + 0.75)))
        parts.append(cornice((a, 34.0), (b, 34.9), HALL_FLOOR + 0.75, 0.25))
        a, b = sorted((s * 8.8, s * 9.5))
        parts.append(box((a, 24.6, HALL_FLOOR - 0.05), (b, 34.0, HALL_FLOOR + 0.44)))
        a, b = sorted((s * 4.0, s * 4.6))
        parts.append(box((a, 43.4, 0.85), (b, 46.2, 1.3)))
    return join(parts)


def desert() -> Mesh:
    """Sand: nearly level around the temple, dunes at the rim that close the horizon."""
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


def describe_content() -> dict[str, Any]:
    """The temple, its ground, sun and sky as the content of a scene description."""
    rng = np.random.default_rng(19)
    content: dict[str, Any] = {"type": "scene", "sky": _sky()}
    blocks: list[list[Mesh]] = [[] for _ in range(_HUES)]
    floors: list[Mesh] = []
    plain: list[Mesh] = []
    for building, batter in ((court(), False), (house(), True)):
        faces = building.faces()
        shape = _battered if batter else _upright
        plain.append(shape(core(faces)))
        for k, mesh in enumerate(_walls(faces, rng)):
            blocks[k].append(shape(mesh))
        floors.append(shape(masonry_skin(_level(faces, 1), _FLOORS, 1, rng)[0]))
    towers, crowns = pylon()
    plain += [towers, crowns, screens(), cornices(), furniture()]
    turned, abaci = _columns()
    plain.append(abaci)
    for k, parts in enumerate(blocks):
        content[f"blocks-{k}"] = _stone(join(parts), k)
    content["paving"] = _stone(join(floors), 3)
    content["plain"] = _stone(join(plain), 1)
    content["columns"] = _stone(turned, 4)
    content["desert"] = _stone(desert(), 5)
    return content


def _columns() -> tuple[Mesh, Mesh]:
    kinds: list[Capital] = ["papyrus", "composite", "palm"]
    hall = [(x, y, HALL_FLOOR) for x, y in _FRONT_COLUMNS + _HALL_COLUMNS]
    outside = [(x, y, 0.0) for x, y in _COURT_COLUMNS]
    inside = colonnade(hall, kinds, 6.6 - HALL_FLOOR, 0.55, 64)
    around = colonnade(outside, kinds, 6.2, 0.5, 48)
    return join([inside[0], around[0]]), join([inside[1], around[1]])


def _walls(faces: list[Face], rng: np.random.Generator) -> list[Mesh]:
    """Blocks of the walls and slabs of the ceilings, by hue."""
    upright = [face for face in faces if face.axis != 2]
    walls = masonry_skin(upright, _WALLS, _HUES, rng)
    ceilings = masonry_skin(_level(faces, -1), _CEILINGS, _HUES, rng)
    return [join([a, b]) for a, b in zip(walls, ceilings, strict=True)]


def _level(faces: list[Face], sign: int) -> list[Face]:
    """Floors (sign 1) or ceilings (sign -1), without what lies under the ground."""
    return [face for face in faces if face.axis == 2 and face.sign == sign and face.plane > -0.5]


def _upright(mesh: Mesh) -> Mesh:
    return mesh


def _battered(mesh: Mesh) -> Mesh:
    """The house with its outer walls leaning inwards, as Egyptian walls do; what lies inside stays."""
    v = mesh.vertices.copy()
    lean = 0.05 * v[:, 2]
    v[:, 0] -= np.sign(v[:, 0]) * lean * np.clip((np.abs(v[:, 0]) - 9.6) / 1.4, 0.0, None)
    v[:, 1] -= lean * np.clip((v[:, 1] - 53.2) / 1.8, 0.0, None)
    return Mesh(v, mesh.faces, mesh.normals)


def _sky() -> dict[str, Any]:
    return {
        "type": "sunsky",
        "turbidity": 3.5,
        "sun_direction": list(SUN),
        "sun_scale": SUN_SCALE,
        "sky_scale": SKY_SCALE,
        "albedo": {"type": "rgb", "value": 0.4},
        "to_world": np.eye(4),
    }


_COLOURS = [
    (0.56, 0.46, 0.33),
    (0.50, 0.40, 0.28),
    (0.54, 0.42, 0.29),
    (0.45, 0.37, 0.28),
    (0.55, 0.45, 0.32),
    (0.55, 0.44, 0.30),
]


def _stone(mesh: Mesh, hue: int) -> dict[str, Any]:
    mesh, uv = projected_uv(mesh, 4.0)
    reflectance = {"type": "rgb", "value": list(_COLOURS[hue])}
    return triangles(mesh, {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}, uv)
