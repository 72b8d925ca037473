"""The art gallery: a walk past paintings and sculptures in three rooms under laylights and spotlights."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.scenes import artworks, textures
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import Deferred, SceneDescription
from steadylight.scenes.furnishings import (
    Floats,
    Mesh,
    Model,
    box,
    chamfered_box,
    diffuse,
    lathe,
    looking,
    metal,
    moulding,
    plastic,
    quad,
    standing,
    tube,
)
from steadylight.scenes.shell import Hollow, hollow_out

ANIMATION = BUNDLED["gallery"]
FRAMES, FPS = ANIMATION.frames, ANIMATION.fps
HEIGHT = 4.4
"""Ceiling height of all rooms, metres."""

HALL: Hollow = ((0.0, 0.0, 0.0), (9.0, 7.5, HEIGHT))
CABINET: Hollow = ((9.4, 0.0, 0.0), (16.4, 7.5, HEIGHT))
NORTH_ROOM: Hollow = ((9.8, 7.9, 0.0), (16.4, 13.2, HEIGHT))
EAST_DOOR: Hollow = ((9.0, 2.7, 0.0), (9.4, 5.1, 3.0))
NORTH_DOOR: Hollow = ((11.2, 7.5, 0.0), (13.3, 7.9, 2.9))
HALL_WELLS: tuple[Hollow, ...] = tuple(
    ((x, 2.9, HEIGHT), (x + 1.8, 6.3, HEIGHT + 0.55)) for x in (0.9, 3.6, 6.3)
)
COFFERS: tuple[Hollow, ...] = tuple(
    ((10.0 + 2.1 * i, 0.7 + 2.2 * j, HEIGHT), (11.6 + 2.1 * i, 2.4 + 2.2 * j, HEIGHT + 0.28))
    for i in range(3)
    for j in range(3)
)
LIT_COFFERS = (COFFERS[1], COFFERS[7])
NORTH_WELLS: tuple[Hollow, ...] = tuple(
    ((x, 9.2, HEIGHT), (x + 1.3, 11.9, HEIGHT + 0.4)) for x in (10.9, 14.0)
)

RED, BLUE, YELLOW = (0.5, 0.05, 0.03), (0.04, 0.1, 0.35), (0.7, 0.45, 0.06)
GREEN, BLACK, PALE = (0.08, 0.25, 0.12), (0.04, 0.04, 0.05), (0.75, 0.72, 0.65)
ORANGE, VIOLET, TEAL = (0.7, 0.25, 0.05), (0.16, 0.06, 0.22), (0.05, 0.3, 0.32)

EAST, NORTH, WEST, SOUTH = 0.0, 90.0, 180.0, 270.0
"""Directions in which walls face, degrees counter-clockwise from +x."""


def describe() -> SceneDescription:
    """The gallery with its lamps and a visitor's path through it."""
    return SceneDescription(
        name="gallery",
        content=Deferred(_content),
        camera=_camera(),
        **dataclasses.asdict(ANIMATION),
    )


def _content() -> dict[str, Any]:
    """The rooms, what is in them, and the lamps."""
    model = Model(_materials())
    _add_building(model)
    _add_joinery(model)
    _add_paintings(model)
    _add_sculptures(model)
    _add_benches(model)
    _add_ceiling_lamps(model)
    _add_spot_lamps(model)
    return model.content()


def _materials() -> dict[str, dict[str, object]]:
    """All materials of the gallery by name; paintings are added to them."""
    materials: dict[str, dict[str, object]] = {
        "hall_wall": diffuse((0.52, 0.53, 0.48)),
        "cabinet_wall": diffuse((0.30, 0.40, 0.45)),
        "north_wall": diffuse((0.48, 0.17, 0.13)),
        "ceiling": diffuse(0.78),
        "stone_floor": diffuse(textures.flagstones()),
        "oak_floor": diffuse(textures.herringbone()),
        "joinery": diffuse((0.70, 0.68, 0.63)),
        "plinth": diffuse((0.66, 0.65, 0.62)),
        "marble": diffuse((0.72, 0.69, 0.63)),
        "terracotta": diffuse((0.48, 0.20, 0.10)),
        "slate": diffuse((0.12, 0.13, 0.15)),
        "glaze": plastic((0.05, 0.22, 0.30), 0.15),
        "bronze": metal("Cu", 0.3),
        "gilt": diffuse((0.55, 0.36, 0.10)),
        "ebony": diffuse((0.06, 0.05, 0.045)),
        "walnut": diffuse((0.20, 0.10, 0.05)),
        "leather": diffuse((0.17, 0.06, 0.035)),
        "steel": diffuse((0.32, 0.32, 0.33)),
        "lamp_black": diffuse((0.05, 0.05, 0.05)),
        "label": diffuse((0.80, 0.79, 0.75)),
    }
    return materials | {f"canvas_{name}": diffuse(picture) for name, picture in _pictures().items()}


def _pictures() -> dict[str, textures.Picture]:
    """The paintings."""
    field, circles, gestures = artworks.colour_field, artworks.circles, artworks.gestures
    return {
        "embers": field(1, (0.30, 0.03, 0.02), [(0.6, 0.12, 0.02), (0.08, 0.01, 0.015), (0.62, 0.3, 0.05)]),
        "harbour": field(2, (0.05, 0.09, 0.16), [(0.1, 0.22, 0.33), (0.55, 0.52, 0.42), (0.04, 0.06, 0.1)]),
        "orbits": circles(3, [RED, BLUE, YELLOW, BLACK, GREEN]),
        "fugue": circles(11, [TEAL, ORANGE, VIOLET, BLACK, YELLOW]),
        "streets": artworks.lattice(4),
        "ridges": artworks.landscape(5, (0.2, 0.32, 0.5), (0.05, 0.08, 0.04)),
        "dusk": artworks.landscape(6, (0.35, 0.16, 0.25), (0.03, 0.03, 0.07)),
        "storm": gestures(7, PALE, [BLACK, BLUE, ORANGE, PALE, RED]),
        "garden": gestures(8, (0.06, 0.12, 0.09), [GREEN, YELLOW, PALE, TEAL, RED]),
        "weft": artworks.bands(9, [RED, ORANGE, YELLOW, PALE, GREEN, BLUE]),
    }


def _add_building(model: Model) -> None:
    """Rooms, doorways, lamp wells and coffers."""
    hollows = [HALL, CABINET, NORTH_ROOM, EAST_DOOR, NORTH_DOOR, *HALL_WELLS, *COFFERS, *NORTH_WELLS]

    def material(centre: Floats, normal: Floats) -> str:
        x, y, z = centre
        if normal[2] > 0.5:
            return "oak_floor" if x > 9.2 else "stone_floor"
        if normal[2] < -0.5 or z > HEIGHT:
            return "ceiling"
        if (9.0 < x < 9.4 and y < 7.5) or 7.5 < y < 7.9:
            return "joinery"
        if y > 7.7:
            return "north_wall"
        return "hall_wall" if x < 9.2 else "cabinet_wall"

    for name, mesh in hollow_out(hollows, material).items():
        if name == "oak_floor":
            model.add(name, mesh.turned(45.0).mapped(0, 1, 1.6).turned(-45.0))
        elif name == "stone_floor":
            model.add(name, mesh.mapped(0, 1, 3.0))
        else:
            model.add(name, mesh)


def _add_joinery(model: Model) -> None:
    """Skirting boards, cornices and the casings of the doorways."""
    skirting = [(-0.004, 0.15), (0.012, 0.15), (0.02, 0.135), (0.02, -0.004)]
    cornice = [(0.20, HEIGHT + 0.004), (0.20, HEIGHT - 0.03), (0.12, HEIGHT - 0.06)]
    cornice += [(0.06, HEIGHT - 0.14), (0.03, HEIGHT - 0.15), (0.03, HEIGHT - 0.18), (-0.004, HEIGHT - 0.18)]
    runs = [
        [(9.0, 5.15), (9.0, 7.5), (0.0, 7.5), (0.0, 0.0), (9.0, 0.0), (9.0, 2.65)],
        [(11.15, 7.5), (9.4, 7.5), (9.4, 5.15)],
        [(9.4, 2.65), (9.4, 0.0), (16.4, 0.0), (16.4, 7.5), (13.35, 7.5)],
        [(13.35, 7.9), (16.4, 7.9), (16.4, 13.2), (9.8, 13.2), (9.8, 7.9), (11.15, 7.9)],
    ]
    model.add("joinery", *(moulding(run, skirting) for run in runs))
    for (x0, y0, _), (x1, y1, _) in (HALL, CABINET, NORTH_ROOM):
        model.add("joinery", moulding([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], cornice, closed=True))
    casing = [(0.005, -0.004), (0.005, 0.03), (0.03, 0.045), (0.11, 0.045), (0.13, 0.03), (0.13, -0.004)]
    for wall, facing, width, height in (
        ((9.0, 3.9), WEST, 2.4, 3.0),
        ((9.4, 3.9), EAST, 2.4, 3.0),
        ((12.25, 7.5), SOUTH, 2.1, 2.9),
        ((12.25, 7.9), NORTH, 2.1, 2.9),
    ):
        half = width / 2
        around = moulding([(-half, -0.01), (-half, height), (half, height), (half, -0.01)], casing)
        model.add("joinery", around.transformed(standing((*wall, 0.0), facing)))


def _add_paintings(model: Model) -> None:
    """Framed pictures: name, point on the wall below the centre, facing, width, height, frame."""
    for name, wall, facing, width, height, frame in (
        ("ridges", (1.9, 0.0), NORTH, 1.9, 1.2, "gilt"),
        ("embers", (4.5, 0.0), NORTH, 1.2, 1.6, "ebony"),
        ("storm", (7.1, 0.0), NORTH, 1.7, 1.4, "walnut"),
        ("weft", (9.0, 1.25), WEST, 1.3, 0.65, "ebony"),
        ("orbits", (9.0, 6.35), WEST, 1.3, 1.0, "gilt"),
        ("streets", (6.6, 7.5), SOUTH, 1.3, 1.3, "ebony"),
        ("dusk", (3.6, 7.5), SOUTH, 1.9, 1.2, "gilt"),
        ("harbour", (0.0, 3.7), EAST, 1.5, 2.0, "walnut"),
        ("garden", (16.4, 2.0), WEST, 2.0, 1.6, "ebony"),
        ("fugue", (16.4, 5.3), WEST, 2.0, 1.5, "gilt"),
        ("harbour", (11.4, 0.0), NORTH, 1.2, 1.6, "ebony"),
        ("dusk", (14.2, 0.0), NORTH, 1.9, 1.2, "gilt"),
        ("streets", (14.9, 7.5), SOUTH, 1.2, 1.2, "walnut"),
        ("weft", (10.3, 7.5), SOUTH, 1.0, 0.5, "ebony"),
        ("storm", (11.5, 13.2), SOUTH, 1.7, 1.4, "gilt"),
        ("embers", (14.6, 13.2), SOUTH, 1.5, 2.0, "ebony"),
        ("ridges", (16.4, 10.4), WEST, 1.9, 1.2, "gilt"),
    ):
        place = standing((*wall, 1.65), facing)
        canvas, surround = _framed(width, height)
        model.add(f"canvas_{name}", canvas.transformed(place))
        model.add(frame, surround.transformed(place))
        label = chamfered_box((width / 2 + 0.16, -0.4, -0.004), (width / 2 + 0.3, -0.31, 0.006), 0.001)
        model.add("label", label.transformed(place))


def _framed(width: float, height: float) -> tuple[Mesh, Mesh]:
    """A canvas in the x-y plane around the origin, facing +z, and the moulding around it."""
    x, y = width / 2, height / 2
    section = [(-0.085, -0.004), (-0.085, 0.030), (-0.075, 0.045), (-0.060, 0.048), (-0.045, 0.040)]
    section += [(-0.020, 0.034), (-0.010, 0.038), (0.004, 0.036), (0.012, 0.028), (0.012, 0.010)]
    surround = moulding([(-x, -y), (x, -y), (x, y), (-x, y)], section, closed=True)
    return quad((-x, -y, 0.018), (width, 0.0, 0.0), (0.0, height, 0.0)), surround


def _add_sculptures(model: Model) -> None:
    """Sculptures on plinths: mesh, material, position, rotation in degrees, height and width of the plinth."""
    for shape, material, (x, y), turn, high, broad in (
        (artworks.knot(), "bronze", (5.9, 2.5), 60.0, 0.85, 0.62),
        (artworks.bust(), "marble", (7.6, 5.9), 215.0, 1.12, 0.48),
        (artworks.supershape(), "terracotta", (3.3, 2.3), 0.0, 0.80, 0.66),
        (artworks.flame(), "slate", (13.9, 3.7), 30.0, 0.45, 0.80),
        (artworks.pebble(3), "marble", (13.9, 11.2), 20.0, 0.75, 0.80),
        (artworks.bust(), "terracotta", (10.5, 1.3), 60.0, 1.12, 0.48),
    ):
        half = broad / 2
        plinth = chamfered_box((-half, -half, -0.02), (half, half, high), 0.008)
        foot = chamfered_box((-half - 0.03, -half - 0.03, -0.03), (half + 0.03, half + 0.03, 0.06), 0.006)
        model.add(
            "plinth", *(part.turned(turn if broad < 0.5 else 0.0).moved(x, y) for part in (plinth, foot))
        )
        model.add(material, shape.turned(turn).moved(x, y, high))
    stand = [chamfered_box((-0.75, -0.2, 0.72), (0.75, 0.2, 0.76), 0.006)]
    stand += [box((s * 0.66 - 0.03, -0.17, -0.01), (s * 0.66 + 0.03, 0.17, 0.73)) for s in (-1, 1)]
    model.add("walnut", *(part.turned(90.0).moved(15.9, 3.65) for part in stand))
    model.add("glaze", artworks.vase(0.16, 0.34).moved(15.9, 3.2, 0.76))
    model.add("terracotta", artworks.vase(0.12, 0.5).moved(15.9, 3.68, 0.76))
    model.add("marble", artworks.vase(0.19, 0.24).moved(15.9, 4.14, 0.76))


def _add_benches(model: Model) -> None:
    """Upholstered benches."""
    for x, y, turn in ((5.0, 3.75, 0.0), (12.0, 2.1, 0.0), (12.4, 10.6, 90.0)):
        seat = [
            chamfered_box((-0.9 + 0.6 * k, -0.25, 0.39), (-0.305 + 0.6 * k, 0.25, 0.47), 0.018)
            for k in range(3)
        ]
        rail = chamfered_box((-0.88, -0.23, 0.33), (0.88, 0.23, 0.40), 0.004)
        legs = [
            chamfered_box((u - 0.025, v - 0.025, -0.01), (u + 0.025, v + 0.025, 0.34), 0.004)
            for u in (-0.82, 0.82)
            for v in (-0.18, 0.18)
        ]
        model.add("leather", *(part.turned(turn).moved(x, y) for part in seat))
        model.add("walnut", *(part.turned(turn).moved(x, y) for part in (rail, *legs)))


def _add_ceiling_lamps(model: Model) -> None:
    """Luminous panels at the top of the lamp wells, behind glazing bars."""
    for name, wells, radiance, bars in (
        ("lamps_hall", HALL_WELLS, (6.4, 6.2, 5.8), (3, 5)),
        ("lamps_cabinet", LIT_COFFERS, (14.0, 12.9, 11.2), (2, 2)),
        ("lamps_north", NORTH_WELLS, (9.5, 9.0, 8.0), (2, 4)),
    ):
        panels = []
        for (x0, y0, _), (x1, y1, top) in wells:
            panels.append(
                quad((x0 + 0.03, y1 - 0.03, top - 0.02), (x1 - x0 - 0.06, 0, 0), (0, y0 - y1 + 0.06, 0))
            )
            for k in range(1, bars[0]):
                x = x0 + (x1 - x0) * k / bars[0]
                model.add(
                    "joinery", box((x - 0.015, y0 - 0.01, top - 0.16), (x + 0.015, y1 + 0.01, top - 0.11))
                )
            for k in range(1, bars[1]):
                y = y0 + (y1 - y0) * k / bars[1]
                model.add(
                    "joinery", box((x0 - 0.01, y - 0.013, top - 0.15), (x1 + 0.01, y + 0.013, top - 0.12))
                )
        model.add_lamp(name, radiance, *panels)


def _add_spot_lamps(model: Model) -> None:
    """Tracks under the ceiling and the lamps on them: position on the track, target, intensity."""
    track_height = 4.0
    tracks = (
        ((0.8, 2.3), (8.2, 2.3)),
        ((13.6, 1.0), (13.6, 6.6)),
        ((11.2, 10.5), (15.6, 10.5)),
        ((6.0, 6.75), (8.2, 6.75)),
    )
    for (x0, y0), (x1, y1) in tracks:
        model.add(
            "lamp_black",
            box((x0 - 0.018, y0 - 0.018, track_height), (x1 + 0.018, y1 + 0.018, track_height + 0.03)),
        )
        for s in (0.1, 0.9):
            x, y = x0 + s * (x1 - x0), y0 + s * (y1 - y0)
            rod = tube([(x, y, track_height + 0.02), (x, y, HEIGHT + 0.02)], 0.006, sides=8)
            model.add("lamp_black", rod)
    housing = lathe(
        [(0.0, -0.17), (0.05, -0.17)],
        [(0.05, -0.17), (0.055, 0.0)],
        [(0.055, 0.0), (0.048, 0.0)],
        [(0.048, 0.0), (0.035, -0.06)],
        [(0.035, -0.06), (0.0, -0.06)],
        segments=24,
    )
    for k, ((x, y), target, strength) in enumerate(
        (
            ((2.0, 2.3), (1.9, 0.0, 1.6), 34.0),
            ((4.5, 2.3), (4.5, 0.0, 1.6), 34.0),
            ((7.0, 2.3), (7.1, 0.0, 1.6), 34.0),
            ((7.0, 6.75), (7.6, 5.9, 1.4), 20.0),
            ((6.4, 6.75), (9.0, 6.35, 1.6), 34.0),
            ((13.6, 1.5), (16.4, 2.0, 1.6), 38.0),
            ((13.6, 6.0), (16.4, 5.3, 1.6), 38.0),
            ((13.6, 5.2), (13.9, 3.7, 1.2), 24.0),
            ((14.4, 10.5), (14.6, 13.2, 1.6), 36.0),
            ((12.4, 10.5), (11.5, 13.2, 1.6), 34.0),
        )
    ):
        pivot = np.array([x, y, track_height - 0.12])
        ahead = looking(pivot, target)
        mouth = pivot + 0.09 * ahead[:3, 2]
        body = ahead.copy()
        body[:3, 3] = mouth
        model.add("lamp_black", housing.transformed(body))
        model.add("lamp_black", tube([(x, y, pivot[2]), (x, y, track_height + 0.01)], 0.012, sides=8))
        front = mouth + 0.004 * ahead[:3, 2]  # just outside, so that the housing cannot shade its own lamp
        model.add_spot(f"spot_{k}", front, target, (strength, 0.9 * strength, 0.74 * strength))


def _camera() -> CameraPath:
    """From a corner of the hall through the doorway into the cabinet, with a view into the north room."""
    way = (
        (0.0, (1.5, 6.1), (6.6, 3.1, 1.45)),
        (0.25, (3.6, 5.5), (7.6, 3.0, 1.5)),
        (0.5, (5.9, 4.75), (9.4, 3.6, 1.55)),
        (0.75, (8.1, 4.0), (13.5, 3.7, 1.5)),
        (1.0, (10.2, 4.0), (12.9, 8.6, 1.5)),
    )
    last = (FRAMES - 1) / FPS
    return CameraPath(
        keyframes=tuple(
            Keyframe(time=t * last, origin=(*place, 1.65), target=target, up=(0.0, 0.0, 1.0), fov=70.0)
            for t, place, target in way
        ),
        loop=False,
    )
