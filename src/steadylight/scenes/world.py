"""Conventions of all readers of scene files: which way is up, how bright a watt is, where to look from.

Readers of formats that state their axes and units (glTF, USD) turn and scale the scene so that z is up and lengths are
in metres. Files that state neither (Mitsuba, Radiance) are left unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadylight.camera import Keyframe
from steadylight.errors import SettingsError

LUMENS_PER_WATT: Final = 683.0
"""Photometric units are divided by this to give the W of our RGB: Rec. 709 luminance times 683 is cd/m². It is the
definition of the candela, and what Blender multiplies by when it exports glTF."""

Z_UP: Final = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Turns a frame with y up to ours with z up: (x, y, z) becomes (x, -z, y), as in Blender."""

DEFAULT_FOV: Final = 60.0
"""Horizontal field of view of a scene without a camera, degrees."""


def listed(names: Sequence[str]) -> str:
    """Cameras as text for messages: `1 (Walk), 2 (Door)`."""
    return ", ".join(f"{number} ({name})" if name else str(number) for number, name in enumerate(names, 1))


def chosen(path: Path, wanted: str, names: Sequence[Sequence[str]], kind: str = "camera") -> int:
    """Index, from 0, of the camera that `--sensor` gives by one of its names or by its number from 1.

    Args:
        path: path of the scene, for messages.
        wanted: name or number from `--sensor`.
        names: names of each camera; the first is shown in messages.
        kind: word for a camera in the format.

    Raises:
        SettingsError: there is no such camera.
    """
    for number, those in enumerate(names):
        if wanted in those:
            return number
    numbers = [str(number) for number in range(1, len(names) + 1)]
    if wanted in numbers:
        return numbers.index(wanted)
    has = f"it has {listed([those[0] for those in names])}" if names else "it has none"
    raise SettingsError(f"--sensor: {wanted!r} is not a {kind} of {path}; {has}")


def box_corners(low: ArrayLike, high: ArrayLike) -> NDArray[np.float64]:
    """The corners of a box, (8, 3)."""
    return np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)


def camera_axes(matrix: ArrayLike) -> NDArray[np.float64]:
    """Camera-to-world matrix with our axes (left, up, view, origin), from one that looks along -z (glTF, USD).

    Scale is dropped.

    Args:
        matrix: (4, 4) camera-to-world: right, up, backwards, origin.
    """
    found = np.array(matrix, dtype=np.float64)
    found[:3, :3] /= np.linalg.norm(found[:3, :3], axis=0)
    return found @ np.diag([-1.0, 1.0, -1.0, 1.0])


def keyframe(time: float, to_world: NDArray[np.float64], fov: float, *, level: bool = False) -> Keyframe:
    """A keyframe from a camera-to-world matrix (left, up, view, origin).

    Args:
        time: seconds.
        to_world: (4, 4) camera-to-world.
        fov: horizontal field of view, degrees.
        level: whether `up` is z instead of the camera's own up: the same view if the camera does not roll.
    """
    origin, view, up = (to_world[:3, column] for column in (3, 2, 1))
    x, y, z = (0.0, 0.0, 1.0) if level else up.tolist()
    return Keyframe(time, tuple(origin.tolist()), tuple((origin + view).tolist()), (x, y, z), fov)


def rolls(to_world: NDArray[np.float64]) -> bool:
    """Whether a camera's horizon is tilted, or it looks so steeply that it has none."""
    return bool(abs(to_world[2, 0]) > 1e-5 or abs(to_world[2, 2]) > 0.996 or to_world[2, 1] < 0)


def view_from_outside(low: ArrayLike, high: ArrayLike) -> Keyframe:
    """A view of a whole box from outside, slightly from above, z up; low and high are its corners."""
    lower, upper = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
        lower, upper = -np.ones(3), np.ones(3)
    centre = (lower + upper) / 2
    radius = max(float(np.linalg.norm(upper - lower)) / 2, 1e-3)
    away = np.array([0.5, -1.0, 0.5]) / np.sqrt(1.5)
    # With a margin of half the angle, because most films are wider than high.
    origin = centre + away * radius / np.sin(np.radians(DEFAULT_FOV / 3))
    return Keyframe(0.0, tuple(origin.tolist()), tuple(centre.tolist()), fov=DEFAULT_FOV)
