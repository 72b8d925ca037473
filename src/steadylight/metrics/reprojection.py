"""Flicker pixel by pixel: how much a surface point changes from one frame to the next, wherever the camera moves.

A renderer knows which world position each pixel sees (`--aovs`). Projected into the previous frame, it tells where that
surface point was. Differences there are flicker, reflections that move with the camera, and residual resampling error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from steadylight.errors import InputError
from steadylight.images import read_layers
from steadylight.metrics.still import FLOOR

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from steadylight.camera import Pose

STEEPEST = 8.0
"""Pixel footprints by which neighbouring positions on one surface may be apart, as on one seen at 7 degrees."""

OFF_SURFACE = 1.5
"""Pixel footprints by which a position may be off the plane of a surface and still belong to it."""


@dataclass(frozen=True)
class View:
    """What a frame shows, and its camera.

    Attributes:
        pose: pose of the camera.
        size: width and height of the frame, pixels.
        position: (rows, columns, 3) world, metres, of the first surface.
        normal: (rows, columns, 3) unit, 0 where there is no surface.
        thinning: odd edge, pixels, of the blocks of which the arrays hold only the middle pixel; incomplete blocks are
            left out.
    """

    pose: Pose
    size: tuple[int, int]
    position: NDArray[np.floating]
    normal: NDArray[np.floating]
    thinning: int = 1

    @classmethod
    def read(cls, path: Path, pose: Pose) -> View:
        """Read a file in `aovs/`, given the pose of its frame.

        Raises:
            InputError: the file cannot be read, or does not fit the pose because the camera is no perspective camera.
        """
        layers = read_layers(path, "P.X", "P.Y", "P.Z", "N.X", "N.Y", "N.Z")
        height, width = layers.shape[:2]
        view = cls(pose, (width, height), layers[..., :3], layers[..., 3:])
        seen = view.normal.any(axis=-1)
        rows, columns = np.nonzero(seen)
        x, y, _ = project(view.position[seen], pose, (width, height))
        if seen.any() and np.median(np.hypot(x - columns - 0.5, y - rows - 0.5)) > 0.5:
            raise InputError(
                f"{path}: its positions are not those of a perspective camera, which the flicker measure needs"
            )
        return view

    def thinned(self, by: int) -> View:
        """The same view with one position for each block of `by` x `by` pixels."""
        width, height = self.size
        inner = (slice(by // 2, height // by * by, by), slice(by // 2, width // by * by, by))
        return replace(self, position=self.position[inner], normal=self.normal[inner], thinning=by)


def thinned(image: NDArray[np.floating], by: int) -> NDArray[np.floating]:
    """Means over blocks of `by` x `by` pixels, as in `View.thinned`; incomplete blocks are left out."""
    rows, columns = (size // by for size in image.shape[:2])
    blocks = image[: rows * by, : columns * by].reshape(rows, by, columns, by, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)))


def project(
    points: NDArray[np.floating], pose: Pose, size: tuple[int, int]
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Where a perspective camera sees points: column and row in pixels (centres at +0.5), and depth in metres.

    Args:
        points: (..., 3) world.
        pose: pose of the camera.
        size: width and height of the image, pixels.
    """
    width, height = size
    local = (points - pose.origin) @ pose.to_world[:3, :3]
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = width / (2 * np.tan(np.radians(pose.fov) / 2)) / np.where(depth > 0, depth, np.nan)
    return width / 2 - local[..., 0] * scale, height / 2 - local[..., 1] * scale, depth


class Warp(NamedTuple):
    """Where the pixels of a frame were in another frame, for bilinear sampling.

    Attributes:
        rows: (4, height, width) rows of the four surrounding pixels.
        columns: (4, height, width) their columns.
        weights: (4, height, width) their weights, which sum to 1.
        known: (height, width) whether all four see the same surface.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    weights: NDArray[np.floating]
    known: NDArray[np.bool_]

    def sample(self, image: NDArray[np.floating]) -> NDArray[np.floating]:
        """The other frame as this one sees it, (height, width, ...); meaningless where not `known`."""
        weights = self.weights if image.ndim == 2 else self.weights[..., None]
        return np.asarray((image[self.rows, self.columns] * weights).sum(axis=0))


def warp(now: View, before: View) -> Warp:
    """Find the pixels of `now` in the frame `before`."""
    height, width = now.position.shape[:2]
    x, y, depth = project(now.position, before.pose, before.size)
    seen = now.normal.any(axis=-1) & (depth > 0)
    x, y = (np.where(seen, value / now.thinning, 0.5) - 0.5 for value in (x, y))
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    left, top = np.floor(x), np.floor(y)
    u, v = x - left, y - top
    corners = [(dx, dy) for dy in (0, 1) for dx in (0, 1)]
    columns = np.stack([np.clip(left + dx, 0, width - 1) for dx, _ in corners]).astype(np.intp)
    rows = np.stack([np.clip(top + dy, 0, height - 1) for _, dy in corners]).astype(np.intp)
    weights = np.stack([(u if dx else 1 - u) * (v if dy else 1 - v) for dx, dy in corners])
    footprint = np.abs(depth) * 2 * np.tan(np.radians(before.pose.fov) / 2) / (before.size[0] / now.thinning)
    offset = before.position[rows, columns] - now.position
    off_plane = np.abs(np.einsum("...i,...i", offset, now.normal)) < OFF_SURFACE * footprint
    near = np.linalg.norm(offset, axis=-1) < STEEPEST * footprint
    known = seen & inside & (off_plane & near & before.normal[rows, columns].any(axis=-1)).all(axis=0)
    return Warp(rows, columns, weights, known)


def temporal_deviation(
    light: NDArray[np.floating], before: NDArray[np.floating], warped: Warp | None = None
) -> NDArray[np.float32]:
    """Relative change of each surface point since the previous frame.

    |mean over 3x3 pixels of (L(t) - L(t-1))| / (mean of both over 3x3 + 0.1 mean of the frame), L being luminance. The
    mean over 3x3 pixels excludes the effect of resampling a texture, which is no flicker: it adds to one pixel what it
    takes from the next.

    Args:
        light: (height, width) luminance of a frame.
        before: (height, width) luminance of the previous frame.
        warped: where the pixels were in the previous frame; None if the camera stands still.

    Returns:
        (height, width), at least 0; 0 where the point was not seen before.
    """
    from scipy.ndimage import uniform_filter

    known = np.ones(light.shape, bool) if warped is None else warped.known
    then = before if warped is None else warped.sample(before)
    share = np.maximum(uniform_filter(known.astype(np.float64), 3), 1e-9)
    difference = uniform_filter(np.where(known, light - then, 0), 3) / share
    level = uniform_filter(np.where(known, (light + then) / 2, 0), 3) / share + FLOOR * light.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(known & (difference != 0), np.abs(difference) / level, 0)
    return np.asarray(relative, np.float32)
