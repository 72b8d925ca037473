"""A painting just before a wall, a rug on the floor and a shelf: what lies behind must not show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_scenes import LAMP, paint, place, renderer

from steadylight.cache.records import Records
from steadylight.cache.smoothing import smooth
from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.records.filling import Points
from steadylight.scenes.description import SceneDescription

BLOCK = 8  # pixels


def slab(size: tuple[float, float, float], at: tuple[float, float, float], *albedo: float) -> dict[str, Any]:
    return {
        "type": "cube",
        "to_world": place((size[0] / 2, size[1] / 2, size[2] / 2), at),
        "bsdf": paint(*albedo),
    }


def furnished() -> dict[str, Any]:
    """A room without a front wall whose lamp shines up: all light that is seen below is indirect."""

    def wall(matrix: np.ndarray, *albedo: float) -> dict[str, Any]:
        bsdf = {"type": "twosided", "bsdf": paint(*(albedo or (0.6, 0.6, 0.6)))}
        return {"type": "rectangle", "to_world": matrix, "bsdf": bsdf}

    return {
        "floor": wall(place((2, 2, 1))),
        "back": wall(place((2, 1.5, 1), (0, 2, 1.5), degrees=90)),
        "left": wall(place((1.5, 2, 1), (-2, 0, 1.5), about=(0, 1, 0), degrees=90)),
        "right": wall(place((1.5, 2, 1), (2, 0, 1.5), about=(0, 1, 0), degrees=-90)),
        "ceiling": wall(place((2, 2, 1), (0, 0, 3), degrees=180)),
        "lamp": {
            "type": "rectangle",
            "to_world": place((0.5, 0.5, 1), (0, 0.6, 2.2)),
            "bsdf": paint(0, 0, 0),
            "emitter": LAMP,
        },
        "painting": wall(
            place((0.5, 0.35, 1), (-0.7, 1.98, 1.4), degrees=90), 0.5, 0.4, 0.3
        ),  # 2 cm before the wall
        "rug": wall(place((0.8, 0.6, 1), (0.2, 0.9, 0.003)), 0.4, 0.5, 0.6),  # 3 mm above the floor
        "shelf": slab((0.9, 0.25, 0.02), (0.9, 1.875, 1.2), 0.5, 0.5, 0.5),
    }


def hidden_points() -> Points:
    """The wall behind the painting and the floor under the rug, as cameras from aside would look them up."""
    x, z = np.meshgrid(np.linspace(-1.19, -0.21, 15), np.linspace(1.06, 1.74, 11))
    wall = np.stack([x.ravel(), np.full(x.size, 2.0), z.ravel()], axis=1)
    x, y = np.meshgrid(np.linspace(-0.59, 0.99, 21), np.linspace(0.31, 1.49, 15))
    floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    normal = np.repeat([[0, -1, 0], [0, 0, 1]], [len(wall), len(floor)], axis=0)
    position = np.concatenate([wall, floor])
    return Points.anywhere(position.astype(np.float32), normal.astype(np.float32))


def blocks(image: Any) -> np.ndarray:
    """(h, w) mean over blocks of pixels and channels."""
    image = np.asarray(image, np.float64).mean(axis=2)
    height, width = image.shape
    return image.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3))


def test_what_lies_behind_a_painting_or_under_a_rug_does_not_show() -> None:
    keys = (
        Keyframe(0.0, (0, -2.6, 1.5), (0, 1.5, 1.1), fov=50),
        Keyframe(1.0, (0.1, -2.6, 1.5), (0, 1.5, 1.1), fov=50),
    )
    description = SceneDescription("thin", furnished(), CameraPath(keys))
    size = {"frames": (1,), "width": 64, "height": 48, "quality": "normal", "bounces": 2}
    made = renderer(description, spp=64, **size)
    # Behind first: what is made later must not be kept from being made.
    records = made.fill([hidden_points()], Records.empty(), 0)
    hidden = len(records)
    for number in (1, 2):
        found = made.audit([1], made.load(records), last=number == 2)
        records = made.fill([tuple(found.points)], records, number)
    assert hidden > 100
    frame = made.shade(1, made.load(smooth(records)))
    assert frame.missed == 0
    truth = np.mean(
        [blocks(renderer(description, spp=2048, seed=seed, **size).path(1).image) for seed in (1, 2)], axis=0
    )
    ours = blocks(frame.image)
    lit = truth > 0.1 * np.median(truth)  # the lamp is black from below
    np.testing.assert_allclose(ours[lit], truth[lit], rtol=0.05)
    assert ours[lit].sum() == pytest.approx(truth[lit].sum(), rel=0.01)
