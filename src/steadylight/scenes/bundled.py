"""The bundled animations as a table: what is known without building their geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True)
class Animation:
    """A bundled animation; the module `steadylight.scenes.NAME` describes its scene.

    Attributes:
        frames: default number of frames.
        width: default image width, pixels.
        height: default image height, pixels.
        about: one-line description for `steadylight scenes`.
        fps: default frames per second.
    """

    frames: int
    width: int
    height: int
    about: str
    fps: float = 25.0


BUNDLED: Final[Mapping[str, Animation]] = MappingProxyType(
    {
        "temple-walk": Animation(
            91,
            1024,
            768,
            "walk into the columned hall of an Egyptian temple: sun patches, mostly indirect light",
        ),
        "temple-rotation": Animation(
            1441,
            2048,
            1536,
            "once around an Egyptian temple on a circle that crosses its open court; repeats",
        ),
        "gallery": Animation(
            192,
            2048,
            1536,
            "art gallery: three rooms of paintings and sculptures under spotlights and area lights",
        ),
        "corridor": Animation(
            361,
            2048,
            2048,
            "institute corridor: ceiling panels, doors, a side branch, long views, round a corner",
        ),
        "furnace": Animation(
            8,
            64,
            64,
            "closed test room where every surface glows: radiance is exactly emission / (1 - albedo)",
        ),
    }
)
"""Bundled animations by name, in the order of `steadylight scenes`."""
