"""Checks of a camera path: frames inside geometry or too close to it, and steps that pass through a surface."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.renderers.base import Geometry

NEAR: Final = 0.05
"""Metres to a surface below which there is a warning: the near clipping plane, and a person's nose."""

BLURRED: Final = 1 / 50
"""Fraction of the distance to the nearest surface by which rays may start off surfaces without a warning. What is
nearer to a surface than that casts no shadow on it: in a room at 200 m from the origin, what is thinner than 2 cm."""

_MOST_RAYS: Final = 500_000
"""Maximum number of rays for a whole path: about a second."""

_DIRECTIONS: Final = (64, 256)
"""Minimum and maximum number of rays around a frame."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Warned:
    """A fault on some frames.

    Attributes:
        fault: the fault, in words that follow "frames 3-9".
        frames: frame numbers, ascending.
    """

    fault: str
    frames: tuple[int, ...]

    def __str__(self) -> str:
        return f"{'frames' if len(self.frames) > 1 else 'frame'} {stretches(self.frames)}: {self.fault}"


@dataclass(frozen=True)
class Checked:
    """What a check found.

    Attributes:
        warnings: warnings in the order of the frames.
        clearance: distance to the nearest surface, by frame number, metres.
    """

    warnings: tuple[Warned, ...]
    clearance: Mapping[int, float]


def check_path(geometry: Geometry, poses: Mapping[int, Pose]) -> Checked:
    """Check the frames of a path, and the straight steps between them.

    Args:
        geometry: the surfaces.
        poses: poses by frame number. Steps between consecutive numbers are checked for surfaces in between.
    """
    numbers = sorted(poses)
    origins = np.array([poses[number].origin for number in numbers])
    around = directions_around(int(np.clip(_MOST_RAYS // max(len(numbers), 1), *_DIRECTIONS)))
    nearest, inside = _look_around(geometry, origins, around)
    warnings = list(_crossings(geometry, numbers, origins))
    for shown, fault in ((inside, "inside geometry"), (~inside & (nearest < NEAR), _NEAR_WORDS)):
        frames = tuple(number for number, wrong in zip(numbers, shown, strict=True) if wrong)
        if frames:
            warnings.append(Warned(fault, frames))
    warnings += _far(geometry, numbers, origins, nearest)
    warnings.sort(key=lambda each: each.frames)
    return Checked(tuple(warnings), dict(zip(numbers, nearest.tolist(), strict=True)))


_NEAR_WORDS = f"closer than {100 * NEAR:g} cm to a surface"


def stretches(frames: Sequence[int], most: int = 6) -> str:
    """Frame numbers as people write them: `3-9, 14 and 3 more stretches`."""
    starts = [0, *(at + 1 for at, (a, b) in enumerate(pairwise(frames)) if b != a + 1), len(frames)]
    words = [
        str(frames[first]) if last - first == 1 else f"{frames[first]}-{frames[last - 1]}"
        for first, last in pairwise(starts)
    ]
    rest = f" and {len(words) - most} more stretches" if len(words) > most + 1 else ""
    return ", ".join(words[:most] if rest else words) + rest


def _far(geometry: Geometry, numbers: Sequence[int], origins: Array, nearest: Array) -> Iterator[Warned]:
    """A warning about frames so far from the origin that single precision blurs what is around the camera."""
    farthest = np.abs(origins).max(axis=1)
    offset = geometry.ray_offset * farthest
    frames = tuple(number for number, far in zip(numbers, offset > BLURRED * nearest, strict=True) if far)
    if frames:
        yield Warned(
            f"{farthest.max():,.0f} m from the origin, where rays start {offset.max():.2g} m off surfaces, since "
            "coordinates are of single precision; move scene and camera to the origin",
            frames,
        )


def directions_around(count: int) -> Array:
    """Directions spread evenly over the sphere (Fibonacci), (count, 3)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)


def _look_around(geometry: Geometry, origins: Array, around: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Distance to the nearest surface at each origin, and which origins are inside a solid.

    Inside a solid, nearly all rays hit the backs of surfaces. But the surfaces of some rooms are modelled facing
    outwards. An origin therefore counts as inside only if other frames of the path see fronts, or if most surfaces
    around it are closer than 0.5 m.
    """
    count = len(around)
    nearest, backs = np.empty(len(origins)), np.empty(len(origins))
    enclosed, typical = np.empty(len(origins)), np.empty(len(origins))
    step = max(1, (1 << 20) // count)
    for first in range(0, len(origins), step):
        some = slice(first, first + step)
        places = np.repeat(origins[some], count, axis=0)
        directions = np.tile(around, (len(places) // count, 1))
        hits = geometry.cast(places, directions)
        distance = hits.distance.reshape(-1, count)
        back = ((hits.normal * directions).sum(axis=1) > 0).reshape(-1, count)
        met = np.isfinite(distance)
        nearest[some] = distance.min(axis=1)
        enclosed[some] = met.mean(axis=1)
        backs[some] = back.sum(axis=1) / np.maximum(met.sum(axis=1), 1)
        typical[some] = np.median(distance, axis=1)
    suspect = (enclosed > 0.97) & (backs > 0.85)
    return nearest, suspect & ((backs.min(initial=1.0) < 0.55) | (typical < 0.5))


def _crossings(geometry: Geometry, numbers: Sequence[int], origins: Array) -> Iterator[Warned]:
    """Steps between neighbouring frames that pass through a surface."""
    steps = np.diff(origins, axis=0)
    length = np.linalg.norm(steps, axis=1)
    moved = np.flatnonzero((np.diff(numbers) == 1) & (length > 0))
    if not len(moved):
        return
    hits = geometry.cast(origins[moved], steps[moved] / length[moved, None], float(length[moved].max()))
    through = hits.distance < length[moved]
    for row in np.flatnonzero(through):
        shape = int(hits.shape[row])
        name = f" (`{geometry.shapes[shape]}`)" if shape >= 0 and geometry.shapes[shape] else ""
        first = numbers[moved[row]]
        yield Warned(f"the camera passes through a surface{name} between them", (first, first + 1))
