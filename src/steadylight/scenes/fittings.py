"""Fittings of the institute corridor: doors, radiators, boards, plants, seats, extinguishers.

Wall fittings are modelled on an upright wall: x to the right, y up from the floor, z out of the wall; the
functions take the wall's transform (`furnishings.standing`). Free-standing objects stand on z = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.furnishings import (
    Floats,
    Mesh,
    Model,
    box,
    chamfered_box,
    join,
    lathe,
    moulding,
    quad,
    sheet,
    tube,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from steadylight.scenes.textures import Picture

DOOR_WIDTH = 0.95
DOOR_HEIGHT = 2.1
DOOR_DEPTH = 0.1
"""Size of the wall niche of a door, metres."""


def poster(seed: int, size: tuple[int, int] = (160, 224)) -> Picture:
    """A scientific poster or notice: a coloured heading, columns of text, and a few diagrams."""
    rng = np.random.default_rng(seed)
    width, height = size
    image = np.full((height, width, 3), 0.74)
    head = rng.uniform(0.03, 0.45, 3)
    image[: height // 7] = head
    image[height // 20 : height // 12, width // 10 : width * 2 // 3] = 0.72
    columns = 2
    for column in range(columns):
        left = int(width * (0.06 + 0.46 * column))
        right = left + int(width * 0.42)
        row = height // 7 + 6
        while row < height - 8:
            if rng.random() < 0.14 and row < height - 44:
                _draw_diagram(image[row : row + 36, left:right], rng)
                row += 42
            else:
                image[row : row + 2, left : right - int(rng.choice([0, 0, 0, 18]))] = 0.38
                row += 4
    return np.asarray(image, dtype=np.float32)


def _draw_diagram(area: Floats, rng: np.random.Generator) -> None:
    """Fill a patch of a poster with bars or a field of colour."""
    from scipy.ndimage import gaussian_filter  # SciPy takes longer to load than `plan` needs

    height, width = area.shape[:2]
    area[:] = 0.62
    if rng.random() < 0.5:
        for x in range(4, width - 6, 9):
            area[height - int(rng.uniform(5, height - 3)) : height - 2, x : x + 6] = rng.uniform(0.05, 0.6, 3)
    else:
        relief = gaussian_filter(rng.normal(size=(height, width)), 4.0)
        t = ((relief - relief.min()) / np.ptp(relief))[..., None]
        area[:] = t * rng.uniform(0.3, 0.7, 3) + (1.0 - t) * rng.uniform(0.02, 0.3, 3)


def exit_sign() -> Picture:
    """A white door, arrow and runner on green."""
    image = np.broadcast_to(np.array([0.02, 0.30, 0.12]), (48, 112, 3)).copy()
    y, x = np.mgrid[0:48, 0:112]
    white = (np.abs(x - 88) < 13) & (np.abs(y - 24) < 18)
    white |= (np.abs(y - 24) < 3) & (x > 8) & (x < 36)
    white |= (np.abs(y - 24) < 36 - x) & (x > 24) & (x < 38)
    white |= (np.hypot(x - 60, y - 12) < 4.5) | (np.abs(x - 58 - 0.35 * (24 - y)) < 3.5) & (
        np.abs(y - 25) < 8
    )
    white |= (np.abs(x - 55 + 0.7 * (y - 38)) < 2.5) & (np.abs(y - 38) < 7)
    white |= (np.abs(x - 57 - 0.7 * (y - 38)) < 2.5) & (np.abs(y - 38) < 7)
    image[white] = 0.78
    return np.asarray(image, dtype=np.float32)


def add_door(model: Model, place: Floats, *, hinge: int = 1, leaf: str = "beech") -> None:
    """A door in its niche, with steel frame, lever handle, kick plate and name plate.

    Args:
        model: gets the materials `leaf`, frame_paint, steel and label.
        place: transform of the wall; x = 0 is the centre of the door.
        hinge: +1 for hinges on the right, -1 on the left.
        leaf: material of the leaf, with texture coordinates.
    """
    half = DOOR_WIDTH / 2
    model.add("frame_paint", door_casing(half, DOOR_HEIGHT).transformed(place))
    board = box((-half - 0.004, -0.01, -0.09), (half + 0.004, DOOR_HEIGHT + 0.004, -0.042))
    model.add(leaf, board.mapped(0, 1, 1.1).transformed(place))
    side = -hinge * (half - 0.09)
    parts = [box((-half + 0.06, 0.02, -0.05), (half - 0.06, 0.2, -0.0405)), *door_handle(side, hinge)]
    parts += [
        tube([(hinge * (half - 0.036), y, -0.036), (hinge * (half - 0.036), y + 0.1, -0.036)], 0.009, sides=8)
        for y in (0.25, 1.0, 1.8)
    ]
    _add_parts(model, "steel", parts, place)
    plate = chamfered_box(
        (-hinge * (half + 0.28) - 0.09, 1.5, -0.003), (-hinge * (half + 0.28) + 0.09, 1.62, 0.006), 0.002
    )
    model.add("label", plate.transformed(place))
    stripe = box((-hinge * (half + 0.28) - 0.08, 1.585, 0.004), (-hinge * (half + 0.28) + 0.08, 1.61, 0.0066))
    model.add("sign_blue", stripe.transformed(place))


def door_casing(half: float, height: float, depth: float = 0.045) -> Mesh:
    """A folded steel frame around a wall opening: it overlaps the wall and turns inward."""
    profile = [(-0.03, -depth), (-0.03, 0.014), (0.055, 0.014), (0.055, -0.004)]
    path = [(-half, -0.01), (-half, height), (half, height), (half, -0.01)]
    return moulding(path, profile)


def door_handle(x: float, inward: int) -> list[Mesh]:
    """Lever, rose and lock on a leaf whose face is at z = -0.042; the lever points to +x if inward > 0."""
    rose = lathe([(0.026, -0.043), (0.026, -0.034)], [(0.026, -0.034), (0.0, -0.034)], segments=20)
    lever = [
        (x, 1.05, -0.04),
        (x, 1.05, 0.008),
        (x + 0.006 * inward, 1.05, 0.016),
        (x + 0.02 * inward, 1.05, 0.02),
    ]
    lever += [(x + 0.13 * inward, 1.05, 0.02)]
    return [rose.moved(x, 1.05), rose.moved(x, 0.96), tube(lever, 0.009, sides=10)]


def add_glazed_screen(model: Model, place: Floats, half: float, ceiling: float) -> None:
    """A thin-glass screen across a corridor: a double door, fixed sidelights and a fanlight.

    Args:
        model: gets the materials frame_paint, steel and glass.
        place: transform of the screen; x = 0 is the centre of the door, z = 0 the centre of the frame.
        half: half the width of the corridor, at least 1.1 m.
        ceiling: height of the corridor, metres.
    """
    posts = [-half - 0.004, -0.93, 0.87, half - 0.056]
    parts = [box((u, -0.01, -0.05), (u + 0.06, ceiling + 0.004, 0.05)) for u in posts]
    parts += [box((-half, y, -0.049), (half, y + 0.06, 0.049)) for y in (2.1, ceiling - 0.056)]
    for u0, u1 in ((-half, -0.9), (0.9, half)):
        parts.append(box((u0, -0.01, -0.047), (u1, 0.12, 0.047)))
    panes = []
    for side in (-1, 1):
        a, b = sorted((side * 0.004, side * 0.868))
        parts += [box((u, 0.01, -0.024), (u + 0.09, 2.098, 0.024)) for u in (a, b - 0.09)]
        parts += [
            box((a + 0.08, y0, -0.022), (b - 0.08, y1, 0.022)) for y0, y1 in ((0.012, 0.26), (1.99, 2.096))
        ]
        outline = ((0.9, 0.0), (0.9, 0.06), (0.92, 0.07), (1.28, 0.07), (1.3, 0.06), (1.3, 0.0))
        bar = [(side * 0.05, y, z) for y, z in outline]
        model.add("steel", tube(bar, 0.011, sides=10).transformed(place))
        panes.append(quad((a + 0.07, 0.2, 0.0), (b - a - 0.14, 0.0, 0.0), (0.0, 1.85, 0.0)))
        left = -half + 0.03 if side < 0 else 0.9
        panes.append(quad((left, 0.1, 0.0), (half - 0.93, 0.0, 0.0), (0.0, 2.02, 0.0)))
    panes.append(quad((-half + 0.03, 2.13, 0.0), (2 * half - 0.06, 0.0, 0.0), (0.0, ceiling - 2.16, 0.0)))
    model.add("glass", *(pane.transformed(place) for pane in panes))
    model.add("frame_paint", *(part.transformed(place) for part in parts))


def _add_parts(model: Model, material: str, parts: Sequence[Mesh], place: Floats) -> None:
    """Add parts to a wall."""
    model.add(material, *(part.transformed(place) for part in parts))


def add_radiator(model: Model, place: Floats, width: float) -> None:
    """A sectional radiator in `radiator` paint with its pipes; x = 0 is its centre."""
    count = int(width / 0.06)
    start = -0.03 * count
    parts = [
        chamfered_box((start + 0.06 * k, 0.14, 0.035), (start + 0.06 * k + 0.048, 0.74, 0.115), 0.008)
        for k in range(count)
    ]
    parts += [box((start + 0.01, y, 0.055), (-start - 0.02, y + 0.045, 0.095)) for y in (0.18, 0.655)]
    parts += [
        box((s * (-start - 0.15) - 0.015, 0.6, -0.005), (s * (-start - 0.15) + 0.015, 0.66, 0.06))
        for s in (-1, 1)
    ]
    pipe = [
        (-start - 0.03, 0.2, 0.075),
        (-start + 0.05, 0.2, 0.075),
        (-start + 0.06, 0.19, 0.075),
        (-start + 0.06, -0.01, 0.075),
    ]
    parts.append(tube(pipe, 0.01, sides=8))
    _add_parts(model, "radiator", parts, place)
    knob = lathe(
        [(0.0, 0.0), (0.022, 0.0)], [(0.022, 0.0), (0.026, 0.05)], [(0.026, 0.05), (0.0, 0.06)], segments=20
    )
    model.add("radiator", knob.moved(-start + 0.06, 0.2, 0.08).transformed(place))


def add_notice_board(
    model: Model, place: Floats, size: tuple[float, float], papers: Sequence[str], *, seed: int
) -> None:
    """A cork board in an aluminium frame, centred at a height of 1.62 m, with sheets of the named materials."""
    rng = np.random.default_rng(seed)
    width, height = size
    x, y = width / 2, height / 2
    rim = [(-0.03, -0.003), (-0.03, 0.02), (0.0, 0.02), (0.006, 0.014), (0.006, 0.006)]
    frame = moulding([(-x, -y), (x, -y), (x, y), (-x, y)], rim, closed=True).moved(y=1.62)
    model.add("aluminium", frame.transformed(place))
    model.add("cork", box((-x, 1.62 - y, -0.004), (x, 1.62 + y, 0.010)).transformed(place))
    columns, rows = int(width / 0.3), max(int(height / 0.4), 1)
    for k in range(columns * rows):
        if rng.random() < 0.15:
            continue
        i, j = k % columns, k // columns
        centre = (
            -x + width * (i + 0.5) / columns + rng.uniform(-0.02, 0.02),
            1.62 - y + height * (j + 0.5) / rows + rng.uniform(-0.03, 0.03),
        )
        w, h = (0.21, 0.297) if rng.random() < 0.7 else (0.148, 0.21)
        sheet_ = quad((-w / 2, -h / 2, 0.0112), (w, 0.0, 0.0), (0.0, h, 0.0)).turned(
            float(rng.uniform(-4.0, 4.0))
        )
        model.add(papers[int(rng.integers(len(papers)))], sheet_.moved(*centre).transformed(place))
        pin = lathe([(0.006, 0.0), (0.007, 0.006)], [(0.007, 0.006), (0.0, 0.008)], segments=8)
        model.add("sign_red", pin.moved(centre[0], centre[1] + h / 2 - 0.02, 0.0115).transformed(place))


def add_picture(
    model: Model, place: Floats, name: str, size: tuple[float, float], *, middle: float = 1.55
) -> None:
    """A poster of material `name` in a slim black frame, centred at the height `middle`."""
    width, height = size
    x, y = width / 2, height / 2
    rim = [(-0.018, -0.003), (-0.018, 0.022), (0.0, 0.022), (0.004, 0.018), (0.004, 0.006)]
    frame = moulding([(-x, -y), (x, -y), (x, y), (-x, y)], rim, closed=True)
    model.add("black", frame.moved(y=middle).transformed(place))
    face = quad((-x, middle - y, 0.010), (width, 0.0, 0.0), (0.0, height, 0.0))
    model.add(name, face.transformed(place))


def add_extinguisher(model: Model, place: Floats) -> None:
    """A fire extinguisher on its bracket with the sign above; x = 0 is its centre."""
    upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.105], [0, 0, 0, 1]])
    body = lathe(
        [(0.0, 0.0), (0.068, 0.0)],
        [(0.068, 0.0), (0.075, 0.012), (0.075, 0.40), (0.070, 0.43), (0.052, 0.46), (0.024, 0.475)],
        segments=32,
    )
    model.add("extinguisher", body.moved(z=0.55).transformed(place @ upright))
    neck = lathe([(0.022, 0.47), (0.018, 0.53)], [(0.018, 0.53), (0.0, 0.53)], segments=16)
    parts = [neck.moved(z=0.55).transformed(upright)]
    parts.append(
        tube(
            [(0.01, 1.07, 0.105), (0.09, 1.06, 0.105), (0.105, 1.0, 0.11), (0.1, 0.72, 0.115)],
            0.011,
            sides=10,
        )
    )
    parts += [box((-0.1, 1.075, 0.09), (0.02, 1.09, 0.12)), box((-0.1, 1.11, 0.092), (0.02, 1.12, 0.118))]
    parts += [box((-0.03, 0.62, -0.004), (0.03, 0.66, 0.04)), box((-0.03, 0.88, -0.004), (0.03, 0.92, 0.04))]
    _add_parts(model, "black", parts, place)
    sign = box((-0.1, 1.75, -0.003), (0.1, 1.95, 0.004))
    model.add("sign_red", sign.transformed(place))
    mark = [
        box((-0.025, 1.78, 0.002), (0.025, 1.88, 0.0046)),
        box((-0.012, 1.885, 0.002), (0.012, 1.91, 0.0046)),
    ]
    model.add("label", *(part.transformed(place) for part in mark))


def add_clock(model: Model, place: Floats) -> None:
    """A round wall clock showing a quarter past ten, centred at the transform's origin."""
    rim = lathe(
        [(0.16, -0.004), (0.16, 0.03)],
        [(0.16, 0.03), (0.152, 0.036), (0.146, 0.03)],
        [(0.146, 0.03), (0.146, 0.014)],
        segments=48,
    )
    model.add("black", rim.transformed(place))
    model.add("label", lathe([(0.15, 0.015), (0.0, 0.015)], segments=48).transformed(place))
    hands = [box((-0.006, -0.02, 0.019), (0.006, 0.08, 0.021)).turned(52.0)]
    hands.append(box((-0.004, -0.02, 0.022), (0.004, 0.12, 0.024)).turned(-90.0))
    hands += [box((-0.003, 0.118, 0.0145), (0.003, 0.138, 0.0165)).turned(30.0 * k) for k in range(12)]
    _add_parts(model, "black", hands, place)


def bench(length: float) -> tuple[list[Mesh], list[Mesh]]:
    """Slats and steel of a bench along x with its back at y = 0: (wooden parts, steel parts)."""
    half = length / 2
    slats = [
        chamfered_box((-half, y, 0.42), (half, y + 0.07, 0.45), 0.006) for y in (0.1, 0.185, 0.27, 0.355)
    ]
    slats += [chamfered_box((-half, 0.045, z), (half, 0.07, z + 0.075), 0.006) for z in (0.56, 0.66, 0.76)]
    steel: list[Mesh] = []
    for x in (-half + 0.25, half - 0.25):
        steel.append(box((x - 0.02, 0.09, 0.385), (x + 0.02, 0.42, 0.422)))
        steel.append(tube([(x, 0.38, 0.39), (x, 0.40, -0.01)], 0.016, sides=10))
        steel.append(
            tube([(x, 0.16, -0.01), (x, 0.11, 0.40), (x, 0.085, 0.45), (x, 0.05, 0.84)], 0.016, sides=10)
        )
    return slats, steel


def plant(seed: int, height: float, leaves: int) -> tuple[Mesh, Mesh, Mesh]:
    """A potted plant with arching leaves: (pot, soil, leaves)."""
    rng = np.random.default_rng(seed)
    pot = lathe(
        [(0.0, 0.004), (0.13, 0.004)],
        [(0.13, 0.004), (0.165, 0.30)],
        [(0.165, 0.30), (0.18, 0.305), (0.18, 0.335), (0.165, 0.34)],
        [(0.165, 0.34), (0.155, 0.27)],
        segments=36,
    )
    soil = lathe([(0.16, 0.285), (0.08, 0.292), (0.0, 0.29)], segments=24)
    blades = []
    s = np.linspace(0.0, 1.0, 12)[:, None]
    across = np.linspace(-1.0, 1.0, 5)[None, :]
    for k in range(leaves):
        reach = height * rng.uniform(0.25, 0.6) * (0.4 + 0.6 * (k % 5) / 4)
        rise = height * rng.uniform(0.65, 1.0) - 0.3 * reach
        droop = rng.uniform(0.15, 0.5) * height * reach / height
        out = 0.03 + reach * s**1.4
        up = 0.28 + rise * (1.0 - (1.0 - s) ** 1.6) - droop * s**3
        breadth = rng.uniform(0.025, 0.04) * np.sin(np.pi * (0.06 + 0.93 * s)) ** 0.8
        blade = np.stack(
            np.broadcast_arrays(out, breadth * across, up - 0.35 * breadth * across**2 * -1.0), -1
        )
        blades.append(sheet(blade).turned(float(137.5 * k + rng.uniform(-15.0, 15.0))))
    return pot, soil, join(blades)


def litter_bin() -> tuple[Mesh, Mesh]:
    """A cylindrical bin with an opening at the top: (body, dark inside)."""
    body = lathe([(0.13, -0.004), (0.15, 0.62)], [(0.15, 0.62), (0.145, 0.635), (0.135, 0.62)], segments=36)
    return body, lathe([(0.138, 0.622), (0.128, 0.3)], [(0.128, 0.3), (0.0, 0.3)], segments=36)


def smoke_detector() -> Mesh:
    """A smoke detector on a ceiling at z = 0."""
    return lathe(
        [(0.0, -0.045), (0.025, -0.044), (0.032, -0.035)],
        [(0.032, -0.035), (0.05, -0.022), (0.055, 0.004)],
        segments=24,
    )
