"""A closed room with a window, which may be open, glazed, or glazed twice; lit from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
from small_scenes import paint, place

GREY = {"type": "twosided", "bsdf": paint(0.5, 0.5, 0.5)}
CLEAR = {"type": "thindielectric"}
ETA = 1.5046 / 1.000277
"""Mitsuba's index of refraction of glass in air."""

TINT = (0.6, 0.5, 0.4)
TINTED = {
    "type": "thindielectric",
    "int_ior": 1.0,
    "ext_ior": 1.0,
    "specular_transmittance": {"type": "rgb", "value": list(TINT)},
}
"""Reflects nothing, and transmits the same in every direction."""

SUN = (0.8, 0.1, -0.5)
OUTSIDE: dict[str, dict[str, Any]] = {
    "directional": {"type": "directional", "direction": list(SUN), "irradiance": 20.0},
    "sunsky": {
        "type": "sunsky",
        "sun_direction": [-0.8, -0.1, 0.5],
        "turbidity": 3.0,
        "sun_aperture": 5.0,
        "sun_scale": 0.2,
    },
    "area": {
        "type": "rectangle",
        "to_world": place((1, 1.5, 1), (-3.5, 0, 2), about=(0, 1, 0), degrees=100),
        "bsdf": paint(0, 0, 0),
        "emitter": {"type": "area", "radiance": 20.0},
    },
}


def wall(
    half: tuple[float, float], at: tuple[float, float, float], about: Any, degrees: float
) -> dict[str, Any]:
    return {
        "type": "rectangle",
        "to_world": place((*half, 1), at, about=about, degrees=degrees),
        "bsdf": GREY,
    }


def window(*panes: dict[str, Any]) -> dict[str, Any]:
    """A room of 4 x 8 x 3 metres around the camera, with a window of 2 x 1 metres in the left wall.

    Args:
        panes: BSDFs of the panes in the window, from the inside, half a millimetre apart; none if it is open.
    """
    x, y = (1, 0, 0), (0, 1, 0)
    content = {
        "floor": wall((2, 4), (0, -2, 0), x, 0),
        "ceiling": wall((2, 4), (0, -2, 3), x, 180),
        "back": wall((2, 1.5), (0, 2, 1.5), x, 90),
        "front": wall((2, 1.5), (0, -6, 1.5), x, -90),
        "right": wall((1.5, 4), (2, -2, 1.5), y, -90),
        "below": wall((0.5, 4), (-2, -2, 0.5), y, 90),
        "above": wall((0.5, 4), (-2, -2, 2.5), y, 90),
        "far": wall((0.5, 0.5), (-2, 1.5, 1.5), y, 90),
        "near": wall((0.5, 2.5), (-2, -3.5, 1.5), y, 90),
    }
    for number, bsdf in enumerate(panes):
        at = (-2 - 0.0005 * number, 0, 1.5)
        solid = {"type": "cube", "to_world": place((0.5, 1, 2e-4), at, about=y, degrees=90)}
        glass = solid if bsdf["type"] == "dielectric" else wall((0.5, 1), at, y, 90)
        content[f"pane{number}"] = glass | {"bsdf": bsdf}
    return content


def reflectance(cosine: float) -> float:
    """Of a face of glass, for light in air whose direction has this cosine to the normal."""
    inner = np.sqrt(1 - (1 - cosine**2) / ETA**2)
    s = (cosine - ETA * inner) / (cosine + ETA * inner)
    p = (ETA * cosine - inner) / (ETA * cosine + inner)
    return float((s * s + p * p) / 2)


def transmittance(cosine: float, panes: int = 1) -> float:
    """Of thin panes of glass, one behind the other: all reflections within, but not those between them."""
    R = reflectance(cosine)
    return float((1 - 2 * R / (1 + R)) ** panes)
