"""The corridor of an institute: ceiling panels, doors, a side branch, an open office, and a corner."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.scenes import fittings, textures
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import Deferred, SceneDescription
from steadylight.scenes.furnishings import (
    Model,
    box,
    chamfered_box,
    diffuse,
    moulding,
    plastic,
    quad,
    standing,
    tube,
)
from steadylight.scenes.shell import Hollow, broken_path, hollow_out

if TYPE_CHECKING:
    from steadylight.scenes.furnishings import Floats

ANIMATION = BUNDLED["corridor"]
FRAMES, FPS = ANIMATION.frames, ANIMATION.fps
CEILING = 2.7
DADO = 1.1
"""Height of the washable paint on the lower part of the walls, metres."""

EAST, NORTH, WEST, SOUTH = 0.0, 90.0, 180.0, 270.0
"""Directions in which walls face, degrees counter-clockwise from +x."""

Wall = tuple[float, float, float]
"""A point (x, y) at the foot of a wall and the direction that the wall faces."""

MAIN = ((0.0, 0.0), (26.0, 2.6))
BRANCH = ((13.0, 2.6), (15.2, 10.0))
WING = ((23.4, -10.0), (26.0, 0.0))
NICHE = ((7.0, 2.6), (10.0, 3.9))
OFFICE = ((16.6, 2.8), (20.8, 6.4))
OFFICE_DOOR = ((17.125, 2.6), (18.075, 2.8))
GLASS_DOOR_Y = -5.5

DOORS: tuple[tuple[float, float, float, int], ...] = (
    (2.4, 0.0, NORTH, 1),
    (6.0, 0.0, NORTH, -1),
    (9.6, 0.0, NORTH, 1),
    (13.2, 0.0, NORTH, 1),
    (17.4, 0.0, NORTH, -1),
    (20.8, 0.0, NORTH, 1),
    (1.5, 2.6, SOUTH, 1),
    (4.6, 2.6, SOUTH, -1),
    (11.6, 2.6, SOUTH, 1),
    (22.4, 2.6, SOUTH, 1),
    (13.0, 4.6, EAST, 1),
    (13.0, 8.2, EAST, -1),
    (15.2, 7.3, WEST, 1),
    (23.4, -2.6, EAST, 1),
    (23.4, -7.6, EAST, 1),
)
"""Centre of the door on the floor (x, y), facing direction, hinge side."""

PANELS: tuple[tuple[float, float, bool], ...] = (
    *((1.4 + 2.9 * k, 1.3, True) for k in range(9)),
    (14.1, 4.4, False),
    (14.1, 7.6, False),
    (24.7, -1.9, False),
    (24.7, -3.9, False),
    (24.7, -8.1, False),
    (8.5, 3.25, True),
    (17.7, 4.6, False),
    (19.6, 4.6, False),
)
"""Centre (x, y) of the luminaires, and whether they are aligned with x."""

WINDOWS: tuple[Wall, ...] = (
    (26.0, 1.3, WEST),
    (26.0, -1.6, WEST),
    (26.0, -3.9, WEST),
    (26.0, -7.6, WEST),
    (14.1, 10.0, SOUTH),
)
"""Centre (x, y) of the frosted windows on the inner face of their wall, and facing direction."""

WINDOW_HALF = 0.75
SILL, LINTEL = 0.9, 2.35


def describe() -> SceneDescription:
    """The corridor with its lamps and the camera path along it and around the corner."""
    return SceneDescription(
        name="corridor",
        content=Deferred(_content),
        camera=_camera(),
        **dataclasses.asdict(ANIMATION),
    )


def _content() -> dict[str, Any]:
    """The corridors, what is in them, and the lamps."""
    model = Model(_materials())
    _add_building(model)
    _add_joinery(model)
    _add_lamps(model)
    _add_windows(model)
    for x, y, facing, hinge in DOORS:
        fittings.add_door(model, standing((x, y, 0.0), facing), hinge=hinge)
    screen = standing(((WING[0][0] + WING[1][0]) / 2, GLASS_DOOR_Y, 0.0), NORTH)
    fittings.add_glazed_screen(model, screen, (WING[1][0] - WING[0][0]) / 2, CEILING)
    _add_wall_fittings(model)
    _add_seats_and_plants(model)
    _add_office(model)
    return model.content()


def _materials() -> dict[str, dict[str, object]]:
    """All materials of the corridor by name."""
    return {
        "wall": diffuse((0.68, 0.66, 0.60)),
        "dado": diffuse((0.36, 0.45, 0.41)),
        "ceiling": diffuse(textures.ceiling_tile()),
        "plaster": diffuse(0.72),
        "lino": diffuse(textures.linoleum()),
        "polished_lino": plastic(textures.linoleum(), 0.3),
        "carpet": diffuse((0.14, 0.17, 0.22)),
        "skirting": diffuse((0.10, 0.12, 0.12)),
        "rail": diffuse((0.45, 0.27, 0.13)),
        "beech": diffuse(textures.veneer(31, (0.52, 0.33, 0.17))),
        "slats": diffuse((0.50, 0.31, 0.15)),
        "frame_paint": diffuse((0.20, 0.25, 0.27)),
        "aluminium": diffuse((0.50, 0.50, 0.51)),
        "steel": plastic((0.42, 0.42, 0.42), 0.2),
        "black": diffuse((0.045, 0.045, 0.05)),
        "label": diffuse((0.78, 0.78, 0.75)),
        "sign_blue": diffuse((0.04, 0.13, 0.36)),
        "sign_red": diffuse((0.52, 0.03, 0.03)),
        "exit_sign": diffuse(fittings.exit_sign()),
        "extinguisher": plastic((0.50, 0.02, 0.02), 0.12),
        "radiator": diffuse((0.76, 0.75, 0.70)),
        "cork": diffuse((0.36, 0.21, 0.10)),
        "pot": diffuse((0.30, 0.31, 0.33)),
        "soil": diffuse((0.06, 0.04, 0.03)),
        "leaf": diffuse((0.07, 0.21, 0.05)),
        "paper": diffuse((0.80, 0.79, 0.75)),
        "yellow_paper": diffuse((0.75, 0.62, 0.15)),
        "book_red": diffuse((0.42, 0.07, 0.05)),
        "book_green": diffuse((0.08, 0.24, 0.14)),
        "desk": diffuse((0.62, 0.60, 0.55)),
        "glass": {"type": "thindielectric", "int_ior": 1.5},
        **{f"poster_{k}": diffuse(fittings.poster(40 + k)) for k in range(4)},
    }


def _storey(plan: tuple[tuple[float, float], tuple[float, float]], top: float = CEILING) -> list[Hollow]:
    """A room from floor to ceiling, split at the dado so that the paint can differ."""
    (x0, y0), (x1, y1) = plan
    return [((x0, y0, 0.0), (x1, y1, DADO)), ((x0, y0, DADO), (x1, y1, top))]


def _recess(wall: Wall, half: float, heights: tuple[float, float], depth: float) -> Hollow:
    """A block of air of depth `depth` in a wall, extending `half` to both sides of a point on its face."""
    x, y, facing = wall
    out = np.round([np.cos(np.radians(facing)), np.sin(np.radians(facing))])
    along = np.abs(out[::-1]) * half
    ends = np.sort([np.array([x, y]) - along, np.array([x, y]) + along - depth * out], axis=0)
    back = np.sort([np.array([x, y]) - along - depth * out, np.array([x, y]) + along], axis=0)
    low, high = np.minimum(ends[0], back[0]), np.maximum(ends[1], back[1])
    return (float(low[0]), float(low[1]), heights[0]), (float(high[0]), float(high[1]), heights[1])


def _panel(x: float, y: float, lengthwise: bool) -> tuple[float, float, float, float]:
    """Edges (x0, y0, x1, y1) of a luminaire of 0.6 by 1.2 m."""
    a, b = (0.6, 0.3) if lengthwise else (0.3, 0.6)
    return x - a, y - b, x + a, y + b


def _add_building(model: Model) -> None:
    """Corridor, branch, wing, niche and office, with the niches for doors, windows and luminaires."""
    hollows = [part for plan in (MAIN, BRANCH, WING, NICHE, OFFICE) for part in _storey(plan)]
    hollows += _storey(OFFICE_DOOR, fittings.DOOR_HEIGHT)
    hollows += [
        _recess((x, y, facing), fittings.DOOR_WIDTH / 2, (0.0, fittings.DOOR_HEIGHT), fittings.DOOR_DEPTH)
        for x, y, facing, _ in DOORS
    ]
    hollows += [_recess(wall, WINDOW_HALF, (SILL, LINTEL), 0.25) for wall in WINDOWS]
    for panel in PANELS:
        x0, y0, x1, y1 = _panel(*panel)
        hollows.append(((x0, y0, CEILING), (x1, y1, CEILING + 0.07)))

    def material(centre: Floats, normal: Floats) -> str:
        x, y, z = centre
        in_office = OFFICE[0][0] < x < OFFICE[1][0] and y > 2.7
        if normal[2] > 0.5:
            if in_office:
                return "carpet"
            return "polished_lino" if y < GLASS_DOOR_Y else "plaster" if z > 0.5 else "lino"
        if z > CEILING + 1e-6:
            return "aluminium"
        if normal[2] < -0.5:
            return "ceiling" if z > 2.6 else "plaster"
        return "dado" if z < DADO and not in_office else "wall"

    for name, mesh in hollow_out(hollows, material).items():
        if name == "ceiling":
            model.add(name, mesh.moved(x=0.2, y=-0.1).mapped(0, 1, 0.6).moved(x=-0.2, y=0.1))
        elif name in {"lino", "polished_lino"}:
            model.add(name, mesh.mapped(0, 1, 2.0))
        else:
            model.add(name, mesh)


def _add_joinery(model: Model) -> None:
    """Skirting boards and the bumper rail above the dado."""
    skirting = [(-0.004, 0.10), (0.010, 0.10), (0.014, 0.094), (0.014, -0.004)]
    rail = [(-0.004, DADO + 0.035), (0.016, DADO + 0.035), (0.022, DADO + 0.025)]
    rail += [(0.022, DADO - 0.025), (0.016, DADO - 0.035), (-0.004, DADO - 0.035)]
    edge = fittings.DOOR_WIDTH / 2 + 0.02
    first_door = DOORS[0][0]
    around: list[tuple[float, float]] = [(first_door + edge, 0.0), (23.4, 0.0), (23.4, -10.0), (26.0, -10.0)]
    around += [(26.0, 2.6), (15.2, 2.6), (15.2, 10.0), (13.0, 10.0), (13.0, 2.6), (10.0, 2.6), (10.0, 3.9)]
    around += [(7.0, 3.9), (7.0, 2.6), (0.0, 2.6), (0.0, 0.0), (first_door - edge, 0.0)]
    doors = [(x, y) for x, y, _, _ in DOORS] + [(17.6, 2.6)]
    windows = [(x, y) for x, y, _ in WINDOWS]
    for run in broken_path(around, doors, edge):
        model.add("skirting", moulding(run, skirting))
        for part in broken_path(run, windows, WINDOW_HALF + 0.03):
            model.add("rail", moulding(part, rail))


def _add_lamps(model: Model) -> None:
    """Opal ceiling panels with trim."""
    panels = []
    trim = [
        (-0.022, CEILING + 0.003),
        (-0.022, CEILING - 0.006),
        (0.012, CEILING - 0.006),
        (0.012, CEILING + 0.05),
    ]
    for panel in PANELS:
        x0, y0, x1, y1 = _panel(*panel)
        panels.append(
            quad(
                (x0 + 0.002, y1 - 0.002, CEILING + 0.045),
                (x1 - x0 - 0.004, 0.0, 0.0),
                (0.0, y0 - y1 + 0.004, 0.0),
            )
        )
        edge = moulding([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], trim[::-1], closed=True)
        model.add("aluminium", edge)
    model.add_lamp("lamps", (13.0, 12.7, 12.0), *panels)
    for x, y in ((3.0, 1.9), (11.0, 0.7), (20.0, 1.9), (14.1, 6.0), (24.7, -3.0)):
        model.add("label", fittings.smoke_detector().moved(x, y, CEILING))


def _add_windows(model: Model) -> None:
    """Frosted windows: a pane emitting daylight behind a frame and a transom, and a sill."""
    panes = []
    for x, y, facing in WINDOWS:
        place = standing((x, y, 0.0), facing)
        half = WINDOW_HALF
        frame = [
            box((-half - 0.004, y0, -0.18), (half + 0.004, y1, -0.12))
            for y0, y1 in ((SILL - 0.004, SILL + 0.06), (LINTEL - 0.06, LINTEL + 0.004))
        ]
        frame += [
            box((x0, SILL - 0.004, -0.181), (x0 + 0.064, LINTEL + 0.004, -0.119))
            for x0 in (-half - 0.004, half - 0.06)
        ]
        frame += [
            box((-0.025, SILL, -0.179), (0.025, LINTEL, -0.121)),
            box((-half, 1.86, -0.178), (half, 1.905, -0.122)),
        ]
        model.add("label", *(part.transformed(place) for part in frame))
        sill = chamfered_box((-half - 0.05, SILL - 0.025, -0.006), (half + 0.05, SILL + 0.006, 0.045), 0.004)
        model.add("label", sill.transformed(place))
        pane = quad((-half, SILL, -0.165), (2 * half, 0.0, 0.0), (0.0, LINTEL - SILL, 0.0))
        panes.append(pane.transformed(place))
        fittings.add_radiator(model, place, 1.2)
    model.add_lamp("windows", (2.6, 2.9, 3.3), *panes)


def _add_wall_fittings(model: Model) -> None:
    """Boards, posters, extinguishers, clock, exit signs and switches."""
    papers = ("paper", "yellow_paper", "poster_0", "poster_1", "poster_2", "poster_3")
    for x, y, facing, width, seed in (
        (7.8, 0.0, NORTH, 1.8, 50),
        (15.3, 0.0, NORTH, 1.5, 51),
        (15.2, 4.8, WEST, 1.8, 52),
        (23.4, -4.4, EAST, 1.2, 53),
        (16.2, 2.6, SOUTH, 0.9, 58),
    ):
        fittings.add_notice_board(model, standing((x, y, 0.0), facing), (width, 0.9), papers, seed=seed)
    for x, y, facing, k in (
        (4.2, 0.0, NORTH, 0),
        (11.4, 0.0, NORTH, 1),
        (19.1, 0.0, NORTH, 2),
        (2.9, 2.6, SOUTH, 3),
        (19.4, 2.6, SOUTH, 1),
        (20.6, 2.6, SOUTH, 3),
        (24.7, -10.0, NORTH, 0),
    ):
        fittings.add_picture(model, standing((x, y, 0.0), facing), f"poster_{k}", (0.594, 0.832), middle=1.7)
    for x, y, facing in ((6.2, 2.6, SOUTH), (22.5, 0.0, NORTH), (15.2, 8.6, WEST)):
        fittings.add_extinguisher(model, standing((x, y, 0.0), facing))
    fittings.add_clock(model, standing((26.0, 0.25, 2.2), WEST))
    for x, y, turn in ((12.4, 1.3, 90.0), (23.1, 1.3, 90.0), (24.7, -5.2, 0.0)):
        _add_exit_sign(model, x, y, turn)
    for x, y, facing in ((0.6, 2.6, SOUTH), (12.7, 2.6, SOUTH), (16.8, 2.6, SOUTH), (22.9, 0.0, NORTH)):
        place = standing((x, y, 0.0), facing)
        model.add("label", chamfered_box((-0.04, 1.2, -0.003), (0.04, 1.28, 0.008), 0.002).transformed(place))
        model.add(
            "label", chamfered_box((-0.028, 1.21, 0.005), (0.028, 1.27, 0.011), 0.002).transformed(place)
        )


def _add_exit_sign(model: Model, x: float, y: float, turn: float) -> None:
    """A hanging sign across the corridor, lettered on both sides."""
    case = chamfered_box((-0.2, -0.018, CEILING - 0.28), (0.2, 0.018, CEILING - 0.09), 0.004)
    rods = [tube([(u, 0.0, CEILING - 0.1), (u, 0.0, CEILING + 0.01)], 0.005, sides=8) for u in (-0.12, 0.12)]
    model.add("label", *(part.turned(turn).moved(x, y) for part in (case, *rods)))
    for side in (-1.0, 1.0):
        face = quad((side * -0.19, side * -0.0195, CEILING - 0.27), (side * 0.38, 0.0, 0.0), (0.0, 0.0, 0.17))
        model.add("exit_sign", face.turned(turn).moved(x, y))


def _add_seats_and_plants(model: Model) -> None:
    """A seating niche, and plants in the corners."""
    slats, steel = fittings.bench(2.0)
    model.add("slats", *(part.turned(180.0).moved(8.5, 3.88) for part in slats))
    model.add("steel", *(part.turned(180.0).moved(8.5, 3.88) for part in steel))
    slats, steel = fittings.bench(1.5)
    model.add("slats", *(part.moved(18.95, 0.02) for part in slats))
    model.add("steel", *(part.moved(18.95, 0.02) for part in steel))
    for seed, x, y, height, leaves in (
        (60, 7.3, 3.55, 1.3, 30),
        (61, 9.72, 3.6, 0.9, 26),
        (62, 25.6, 0.28, 1.2, 30),
        (63, 13.4, 9.5, 1.3, 28),
        (64, 23.8, -9.6, 1.3, 28),
    ):
        for material, part in zip(("pot", "soil", "leaf"), fittings.plant(seed, height, leaves), strict=True):
            model.add(material, part.moved(x, y))
    for x, y in ((16.2, 0.2), (10.35, 2.38)):
        body, inside = fittings.litter_bin()
        model.add("aluminium", body.moved(x, y))
        model.add("black", inside.moved(x, y))


def _add_office(model: Model) -> None:
    """An office with an open door: a desk, a screen, bookshelves."""
    (x0, _), (x1, _) = OFFICE
    half = fittings.DOOR_WIDTH / 2
    model.add(
        "frame_paint",
        fittings.door_casing(half, fittings.DOOR_HEIGHT, 0.196).transformed(
            standing((17.6, 2.6, 0.0), SOUTH)
        ),
    )
    leaf = box((0.0, -0.045, 0.008), (0.9, 0.0, 2.06)).mapped(0, 2, 1.1)
    model.add("beech", leaf.turned(100.0).moved(17.17, 2.86))
    desk = [chamfered_box((18.4, 5.0, 0.71), (20.2, 5.8, 0.74), 0.004)]
    desk += [box((x, y, -0.01), (x + 0.05, y + 0.05, 0.712)) for x in (18.45, 20.1) for y in (5.05, 5.7)]
    model.add("desk", *desk)
    screen = [
        chamfered_box((18.95, 5.52, 0.85), (19.55, 5.55, 1.2), 0.006),
        box((19.2, 5.55, 0.735), (19.3, 5.57, 1.0)),
    ]
    model.add("black", *screen, chamfered_box((19.12, 5.45, 0.732), (19.38, 5.65, 0.75), 0.003))
    rng = np.random.default_rng(70)
    shelf_x0, shelf_x1 = x0 + 0.02, x0 + 0.32
    shelves = [
        box((shelf_x0, 4.2, z), (shelf_x1, 6.2, z + 0.025)) for z in (0.05, 0.45, 0.85, 1.25, 1.65, 2.0)
    ]
    shelves += [
        box((shelf_x0 - 0.01, y, -0.01), (shelf_x1 + 0.004, y + 0.025, 2.04)) for y in (4.18, 5.2, 6.195)
    ]
    model.add("desk", *shelves)
    for z in (0.075, 0.475, 0.875, 1.275, 1.675):
        y = 4.22
        while y < 6.1:
            thick, tall = rng.uniform(0.02, 0.06), rng.uniform(0.2, 0.3)
            if not 5.12 < y < 5.24 and rng.random() < 0.85:
                name = ("book_red", "book_green", "sign_blue", "paper", "black", "cork")[int(rng.integers(6))]
                model.add(
                    name,
                    box(
                        (shelf_x0 + 0.06, y, z - 0.002),
                        (shelf_x0 + rng.uniform(0.2, 0.26), y + thick, z + tall),
                    ),
                )
            y += thick + 0.002
    model.add("poster_2", quad((x1 - 0.004, 4.6, 1.2), (0.0, -0.7, 0.0), (0.0, 0.0, 0.95)))


def _camera() -> CameraPath:
    """Along the corridor, with a view into the side branch, and around the corner to the glass door."""
    way = (
        (0.0, (4.0, 1.2), (14.0, 1.4, 1.40)),
        (0.18, (7.2, 1.3), (14.0, 1.7, 1.40)),
        (0.34, (10.6, 1.35), (16.5, 2.2, 1.45)),
        (0.47, (13.1, 1.3), (14.2, 6.5, 1.40)),
        (0.60, (15.7, 1.3), (21.0, 1.9, 1.42)),
        (0.80, (20.5, 1.4), (26.0, 0.7, 1.40)),
        (0.92, (23.5, 0.95), (25.2, -3.6, 1.38)),
        (1.0, (24.5, -0.6), (24.75, -5.6, 1.35)),
    )
    last = (FRAMES - 1) / FPS
    return CameraPath(
        keyframes=tuple(
            Keyframe(time=t * last, origin=(*place, 1.65), target=target, up=(0.0, 0.0, 1.0), fov=70.0)
            for t, place, target in way
        ),
        loop=False,
    )
