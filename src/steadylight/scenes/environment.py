"""Suns in environment maps: a source that is wide enough becomes a disc in the map, and casts soft shadows.

As in Mitsuba, a map is a latitude-longitude picture in its own frame with y up, which `to_world` turns. Turned by
`Z_UP`, its middle is -y, its left edge is +y (north), and +x (east) is a quarter from the left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.world import Z_UP

Floats = NDArray[np.float64]

SIZE: Final = (1024, 512)
"""Columns and rows of a map that is made for suns."""

LEAST_TEXELS: Final = 6.0
"""Minimum number of texels across a sun in a map; a narrower sun is parallel light."""


@dataclass(frozen=True, eq=False)
class Sun:
    """A distant source.

    Attributes:
        name: name in notes.
        direction: (3,) unit vector towards it, world.
        angle: angular diameter, degrees.
        irradiance: (3,) irradiance of a surface that faces it, RGB.
    """

    name: str
    direction: Floats
    angle: float
    irradiance: Floats

    @property
    def parallel(self) -> dict[str, Any]:
        """The sun as parallel light."""
        irradiance = {"type": "rgb", "value": self.irradiance.tolist()}
        return {"type": "directional", "direction": (-self.direction).tolist(), "irradiance": irradiance}


def with_suns(
    entry: Mapping[str, Any] | None, suns: Sequence[Sun]
) -> tuple[Mapping[str, Any] | None, list[Sun]]:
    """Add suns that are wide enough to an environment; returns the environment and the other suns.

    Args:
        entry: `constant`, or an `envmap` that holds its picture; None for no environment. Any other is left unchanged.
        suns: suns in any order.
    """
    base = _picture_of(entry)
    if base is None:
        return entry, list(suns)
    picture, to_world = base
    wide = [sun for sun in suns if sun.angle * picture.shape[1] >= 360 * LEAST_TEXELS]
    if not wide:
        return entry, list(suns)
    directions, solid_angle = texels_of(picture.shape[1], picture.shape[0])
    for sun in wide:
        towards = directions @ (to_world[:3, :3].T @ sun.direction)
        inside = towards >= np.cos(np.radians(sun.angle) / 2)
        received = float((solid_angle * towards)[inside].sum())
        picture[inside] += sun.irradiance / received
    made = {"type": "envmap", "data": picture.astype(np.float32), "to_world": to_world}
    return made, [sun for sun in suns if sun not in wide]


def texels_of(width: int, height: int) -> tuple[Floats, Floats]:
    """Directions of the texels of a map in its own frame, (H, W, 3), and their solid angles, (H, W)."""
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi
    polar = ((np.arange(height) + 0.5) / height * np.pi)[:, None]
    across, up = np.sin(polar), np.broadcast_to(np.cos(polar), (height, width))
    directions = np.stack([across * np.sin(azimuth), up, -across * np.cos(azimuth)], axis=2)
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    rows = (edges[:-1] - edges[1:]) * 2 * np.pi / width
    return directions, np.broadcast_to(rows[:, None], (height, width))


def _picture_of(entry: Mapping[str, Any] | None) -> tuple[Floats, Floats] | None:
    """A copy of an environment's picture, (H, W, 3), and its `to_world`; None if the entry does not hold it."""
    width, height = SIZE
    if entry is None:
        return np.zeros((height, width, 3)), Z_UP
    if entry["type"] == "constant":
        return np.full((height, width, 3), np.array(entry["radiance"]["value"], np.float64)), Z_UP
    if entry["type"] == "envmap" and "data" in entry:
        return np.array(entry["data"], np.float64), np.array(entry.get("to_world", np.eye(4)), np.float64)
    return None
