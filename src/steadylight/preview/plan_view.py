"""The plan: the scene from above, cut below the ceiling, with the camera path and the lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from steadylight.camera import Pose
from steadylight.camera.values import Vector
from steadylight.renderers.base import Geometry
from steadylight.walking.space import Array, Frame

_LARGEST: Final = 420
"""Number of rays along the longer side of a plan."""
_ENLARGED: Final = 2
_ABOVE_EYE: Final = 0.3
"""Metres from the eye up to the cut, where there is room: below the lintels of doors."""

Colour = tuple[int, int, int]

_PAPER, _WALL, _PATH, _MARK, _LAMP = (
    (251, 250, 248),
    (60, 64, 68),
    (11, 122, 117),
    (179, 56, 44),
    (214, 150, 20),
)


@dataclass(frozen=True)
class Plan:
    """A plan as a picture.

    Attributes:
        pixels: (height, width, 3) uint8.
        metres: width of the plan, metres.
    """

    pixels: NDArray[np.uint8]
    metres: float


def draw_plan(
    geometry: Geometry, frame: Frame, region: Array, path: Sequence[Pose], shown: Mapping[int, Pose]
) -> Plan:
    """Draw a plan.

    Args:
        geometry: the surfaces.
        frame: the level frame.
        region: (2, 2) lowest and highest corner of what to show, x and y in the level frame.
        path: poses along the whole path.
        shown: poses to mark with an arrow and their frame number, by frame.
    """
    size = region[1] - region[0]
    cell = float(size.max()) / _LARGEST
    eyes = frame.local([pose.origin for pose in path])
    cut = _cut_height(geometry, frame, path)
    picture = Image.fromarray(_surfaces(geometry, frame, region, (cell, cut), eyes))
    picture = picture.resize(
        (picture.width * _ENLARGED, picture.height * _ENLARGED), Image.Resampling.BICUBIC
    )
    drawing = _Drawing(picture, frame, region[0], _ENLARGED / cell)
    drawing.lamps([lamp.position for lamp in geometry.lamps if lamp.position is not None])
    drawing.path(eyes)
    for number, pose in shown.items():
        drawing.view(pose, str(number))
    drawing.scale_bar()
    return Plan(np.asarray(picture), float(size[0]))


class _Drawing:
    """Lines and marks on a plan."""

    def __init__(self, picture: Image.Image, frame: Frame, corner: Array, scale: float) -> None:
        """Draw on a picture whose lower left is `corner`, at `scale` pixels per metre."""
        self._size = picture.size
        self._draw = ImageDraw.Draw(picture)
        self._font = ImageFont.load_default(15)
        self._frame, self._corner, self._scale = frame, corner, scale

    def _at(self, point: Array) -> tuple[float, float]:
        """Pixel position of a point in the level frame."""
        x, y = (point[:2] - self._corner) * self._scale
        return float(x), float(self._size[1] - y)

    def _write(self, place: tuple[float, float], text: str, colour: Colour) -> None:
        self._draw.text(place, text, fill=colour, font=self._font, stroke_width=3, stroke_fill=_PAPER)

    def lamps(self, positions: Sequence[Vector]) -> None:
        """Draw lights as yellow dots."""
        for position in positions:
            x, y = self._at(self._frame.local(position))
            self._draw.ellipse((x - 6, y - 6, x + 6, y + 6), fill=_LAMP, outline=_PAPER, width=2)

    def path(self, eyes: Array) -> None:
        """Draw the path of the camera."""
        if len(eyes) > 1:
            points = [self._at(eye) for eye in eyes]
            self._draw.line(points, fill=_PAPER, width=8, joint="curve")
            self._draw.line(points, fill=_PATH, width=4, joint="curve")

    def view(self, pose: Pose, label: str) -> None:
        """Draw a pose: a dot, an arrow in the direction of view, and the label."""
        x, y = self._at(self._frame.local(pose.origin))
        ahead = self._frame.local(pose.direction)[:2] * (1, -1)
        length = float(np.linalg.norm(ahead))
        if length > 1e-3:
            ahead /= length
            side = np.array([-ahead[1], ahead[0]])
            tip = np.array([x, y]) + 22 * ahead
            corners = (tip, tip - 9 * ahead + 5 * side, tip - 9 * ahead - 5 * side)
            self._draw.line([(x, y), _pair(tip - 6 * ahead)], fill=_MARK, width=3)
            self._draw.polygon([_pair(corner) for corner in corners], fill=_MARK)
        self._draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=_MARK, outline=_PAPER)
        self._write((x + 7, y - 8), label, _MARK)

    def scale_bar(self) -> None:
        """Draw a scale bar of a round number of metres."""
        wish = 0.25 * self._size[0] / self._scale
        power = 10.0 ** np.floor(np.log10(wish))
        metres = max(step * power for step in (1, 2, 5) if step * power <= wish)
        x, y = 14.0, self._size[1] - 16.0
        for colour, width in ((_PAPER, 9), (_WALL, 4)):
            self._draw.line([(x, y), (x + metres * self._scale, y)], fill=colour, width=width)
        self._write((x, y - 22), f"{metres:g} m", _WALL)


def _pair(point: Array) -> tuple[float, float]:
    x, y = point.tolist()
    return x, y


def _cut_height(geometry: Geometry, frame: Frame, path: Sequence[Pose]) -> float:
    """Height of the cut: above the highest eye position, and below the ceiling there."""
    heights = frame.local([pose.origin for pose in path])[:, 2]
    highest = path[int(heights.argmax())]
    overhead = geometry.cast(highest.origin[None], frame.matrix[2][None]).distance[0]
    return float(heights.max() + min(_ABOVE_EYE, 0.6 * overhead))


def _surfaces(
    geometry: Geometry, frame: Frame, region: Array, scale: tuple[float, float], eyes: Array
) -> NDArray[np.uint8]:
    """The view from above, (height, width, 3) uint8; `scale` is the edge of a cell and the height of the cut."""
    cell, cut = scale
    width, height = (max(1, round(side / cell)) for side in region[1] - region[0])
    x = region[0, 0] + (np.arange(width) + 0.5) * cell
    y = region[1, 1] - (np.arange(height) + 0.5) * cell
    grid = np.stack([*np.meshgrid(x, y), np.full((height, width), cut)], axis=-1).reshape(-1, 3)
    origins = frame.world(grid)
    down = np.broadcast_to(-frame.matrix[2], origins.shape)
    hits = geometry.cast(origins, down)
    colours = geometry.colours(origins, down)
    colours = np.where(np.isfinite(colours), colours, 0.6).clip(0, 1)
    tilt = np.abs(hits.normal @ frame.matrix[2])
    met = np.isfinite(hits.distance)
    light = 0.55 + 0.45 * tilt
    shaded = (0.35 + 0.65 * colours ** (1 / 2.2)) * light[:, None]
    image = np.where(met[:, None], 255 * shaded, _PAPER).reshape(height, width, 3)
    depth = np.where(met, hits.distance, 100.0).reshape(height, width)
    image *= _edges(depth)[..., None]
    walls, backs = (found.reshape(height, width) for found in _walls(geometry, frame, origins, cell))
    if not _at_eyes(backs, region, cell, eyes).any():  # otherwise walls are modelled inside out
        walls |= backs
    image[walls] = _WALL
    return np.asarray(np.rint(image.clip(0, 255)), np.uint8)


def _edges(depth: Array) -> Array:
    """Factor on brightness that darkens jumps in depth, which outline furniture."""
    jump = np.zeros_like(depth)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis))
        pad = [(0, 1) if each == axis else (0, 0) for each in (0, 1)]
        jump = np.maximum(jump, np.pad(step, pad))
    return np.asarray(1 - 0.5 * np.clip(jump / 0.1, 0, 1))


def _walls(
    geometry: Geometry, frame: Frame, origins: Array, cell: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells with a surface about a cell away at the height of the cut, and cells inside a solid."""
    near, inside = np.zeros(len(origins), bool), np.zeros(len(origins), bool)
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        backs = np.ones(len(origins), bool)
        for way in (1, -1):
            direction = np.broadcast_to(way * frame.world(axis), origins.shape)
            hits = geometry.cast(origins, direction)
            near |= hits.distance < 1.2 * cell
            backs &= (hits.normal * direction).sum(axis=1) > 0
        inside |= backs  # along one axis is enough: along the other, solids may touch or overlap
    return near, inside


def _at_eyes(image: NDArray[np.bool_], region: Array, cell: float, eyes: Array) -> NDArray[np.bool_]:
    """Values of an image at the positions of the camera."""
    columns = ((eyes[:, 0] - region[0, 0]) / cell).astype(int).clip(0, image.shape[1] - 1)
    rows = ((region[1, 1] - eyes[:, 1]) / cell).astype(int).clip(0, image.shape[0] - 1)
    return np.asarray(image[rows, columns])
