"""The Nubian sandstone temple of `temple-walk` and `temple-rotation`: plan, stones, columns, sun and sky.

It represents the temple of Kalabsha: pylon, open court with columns on three sides, a columned hall behind
screen walls, and three rooms in a row that become darker and lower towards the sanctuary. Frame: x across, y
inwards along the axis, z up, metres; the court's floor is at z = 0, the front of the pylon at y = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.scenes.masonry import Bond, Face, Masonry, core, masonry_skin
from steadylight.scenes.modelling import (
    Mesh,
    box,
    join,
    projected_uv,
    triangles,
)
from steadylight.scenes.temple_columns import Capital, colonnade
from steadylight.scenes.temple_decoration import (
    around_columns,
    court_and_pylon,
    hall_and_rooms,
    house_outside,
)
from steadylight.scenes.temple_mouldings import cornice
from steadylight.scenes.temple_surroundings import desert, pylon, rubble

if TYPE_CHECKING:
    from numpy.typing import NDArray

SUN = (0.42, -0.62, 0.66)
"""Direction towards the sun (any length): over the pylon, to the right when walking in."""

SUN_SCALE = 60.0
SKY_SCALE = 60.0
"""Factors on Mitsuba's sun and sky that bring the hall's walls to radiances of 0.1 to 1."""

HALL_FLOOR = 0.30
"""Height of the hall's floor, metres."""

_WALLS = Bond(depth=(0.012, 0.018))
_CEILINGS = Bond(course=1.0, length=3.3, bevel=0.010, depth=(0.004, 0.018))
_FLOORS = Bond(course=0.95, length=1.35, bevel=0.010, depth=(0.004, 0.012), tilt=0.003)
_HUES = 3  # materials over which the wall blocks are distributed

_HALL_COLUMNS = [(x, y) for y in (27.0, 31.2) for x in (-6.2, -2.4, 2.4, 6.2)]
_FRONT_COLUMNS = [(x, 22.65) for x in (-6.2, -2.4, 2.4, 6.2)]
_COURT_COLUMNS = [(s * 9.4, y) for s in (-1, 1) for y in (8.2, 10.9, 13.6, 17.0, 19.7)] + [
    (s * x, 8.2) for s in (-1, 1) for x in (3.9, 6.6)
]
ROOF_SLOTS = [
    # x0, y0, x1, y1 of the light slots through the roofs of hall, vestibule, offering room and sanctuary
    (0.1, 28.2, 1.7, 30.4),
    (-4.3, 28.2, -3.0, 30.2),
    (4.3, 28.2, 5.6, 30.2),
    (1.4, 37.9, 3.0, 39.9),
    (-2.2, 43.6, -0.6, 45.8),
    (-0.2, 48.7, 1.6, 50.9),
]


def court() -> Masonry:
    """Gate, court walls, the galleries' roofs and the pavement in front."""
    stone = Masonry()
    stone.add((-14.5, 4.0, -0.6), (14.5, 23.6, 8.0))
    stone.carve((-12.8, 5.3, 0.0), (12.8, 22.3, 8.0))
    stone.carve((-10.2, 22.3, 0.0), (10.2, 23.6, 8.0))  # site of the house
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
        stone.carve((x0, 23.3, 6.6), (x1, 35.2, 7.8))  # leaves beams running from front to back
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


def cornices() -> Mesh:
    """Cornices over doors and around the roofs."""
    parts = [
        cornice((-10.58, 22.0), (10.58, 22.9), 8.56, 0.8, rib=0.24),
        cornice((-2.0, 35.0), (2.0, 35.4), 4.9, 0.6),
        cornice((-1.8, 41.2), (1.8, 41.6), 4.6, 0.55),
        cornice((-1.6, 46.6), (1.6, 47.0), 4.4, 0.5),
        cornice((-3.62, 0.68), (3.62, 5.32), 9.15, 0.9, rib=0.24),
    ]
    for s in (-1, 1):  # along the edges of the roofs, leaving the light slots open
        a, b = sorted((s * 10.57, s * 9.9))
        parts.append(cornice((a, 22.3), (b, 37.35), 8.55, 0.79, rib=0.0))
        a, b = sorted((s * 10.65, s * 10.0))
        parts.append(cornice((a, 36.9), (b, 54.6), 6.96, 0.6, rib=0.0))
        a, b = sorted((s * 14.5, s * 12.8))
        parts.append(cornice((a, 4.2), (b, 23.6), 7.95, 0.6, rib=0.0))
    parts.append(cornice((-10.5, 54.0), (10.5, 54.65), 6.95, 0.59, rib=0.0))
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
    plain += [towers, crowns, screens(), cornices(), furniture(), rubble()]
    turned, abaci = _columns()
    plain.append(abaci)
    for k, parts in enumerate(blocks):
        content[f"blocks-{k}"] = _stone(join(parts), k)
    content["paving"] = _stone(join(floors), 3)
    content["plain"] = _stone(join(plain), 1)
    content["columns"] = _stone(turned, 4)
    carved, painted = hall_and_rooms(HALL_FLOOR)
    content["reliefs"] = _stone(join([carved, _battered(house_outside()), court_and_pylon()]), 6)
    content["ornaments"] = _stone(painted, 7)
    content["column-reliefs"] = _stone(_column_reliefs(), 8)
    content["desert"] = _stone(desert(), 5)
    return content


def _column_reliefs() -> Mesh:
    hall = [(x, y, HALL_FLOOR) for x, y in _FRONT_COLUMNS + _HALL_COLUMNS]
    return around_columns(hall, 6.6 - HALL_FLOOR, 0.55)


def _columns() -> tuple[Mesh, Mesh]:
    kinds: list[Capital] = ["papyrus", "composite", "palm"]
    hall = [(x, y, HALL_FLOOR) for x, y in _FRONT_COLUMNS + _HALL_COLUMNS]
    outside = [(x, y, 0.0) for x, y in _COURT_COLUMNS]
    inside = colonnade(hall, kinds, 6.6 - HALL_FLOOR, 0.55, 56)
    around = colonnade(outside, kinds, 6.2, 0.5, 32)
    return join([inside[0], around[0]]), join([inside[1], around[1]])


def _walls(faces: list[Face], rng: np.random.Generator) -> list[Mesh]:
    """Blocks of the walls and slabs of the ceilings, by hue."""
    upright = [face for face in faces if face.axis != 2]
    walls = masonry_skin(upright, _WALLS, _HUES, rng)
    ceilings = masonry_skin(_level(faces, -1), _CEILINGS, _HUES, rng)
    return [join([a, b]) for a, b in zip(walls, ceilings, strict=True)]


def _level(faces: list[Face], sign: int) -> list[Face]:
    """Floors (sign 1) or ceilings (sign -1), without those below the ground."""
    return [face for face in faces if face.axis == 2 and face.sign == sign and face.plane > -0.5]


def _upright(mesh: Mesh) -> Mesh:
    return mesh


def _battered(mesh: Mesh) -> Mesh:
    """The house with its outer walls leaning inwards, as Egyptian walls do; the inside is unchanged."""
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


_LEVEL_HUES = (3, 5)  # of paving and sand
_GRAIN_SPAN = 4.0  # size of the texture before it repeats, metres
_COLOURS = [
    (0.55, 0.45, 0.32),  # blocks of three hues
    (0.49, 0.39, 0.27),
    (0.53, 0.41, 0.28),
    (0.45, 0.37, 0.28),  # paving
    (0.56, 0.46, 0.33),  # columns
    (0.55, 0.44, 0.30),  # sand
    (0.61, 0.49, 0.34),  # reliefs, worn paler
    (0.40, 0.40, 0.34),  # ornaments with traces of blue and green
    (0.56, 0.38, 0.26),  # figures on columns with traces of red
]


def _stone(mesh: Mesh, hue: int) -> dict[str, Any]:
    mesh, uv = projected_uv(mesh, _GRAIN_SPAN)
    texture = {"type": "bitmap", "data": _sandstone(hue), "raw": True, "filter_type": "bilinear"}
    return triangles(mesh, {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}, uv)


def _sandstone(hue: int) -> NDArray[np.float32]:
    """(256, 256, 3) repeating albedo: sediment in horizontal beds, with a finer grain."""
    rng = np.random.default_rng(100 + hue)
    size = 256
    across, level = np.meshgrid(np.fft.fftfreq(size, 1 / size), np.fft.fftfreq(size, 1 / size))
    width = 6.0 if hue in _LEVEL_HUES else 1.5  # a slab cut parallel to the beds shows spots instead
    beds = 1.0 / (1.0 + (across / width) ** 2 + (level / 6.0) ** 2) ** 0.85
    grain = 0.05 / (1.0 + (across**2 + level**2) / 60.0**2)
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * (beds + grain)).real
    noise = np.clip((noise - noise.mean()) / noise.std(), -2.5, 2.5)[..., None]
    tint = np.array([0.10, 0.115, 0.13])  # dark beds are redder
    return np.asarray(np.array(_COLOURS[hue]) * (1.0 + tint * noise), dtype=np.float32)
