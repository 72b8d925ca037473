"""Quick frames: path tracing with as many samples as fit into a few seconds."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.images import animation_exposure, tone_map
from steadylight.preview.smoothing import smoothed, surfaces_of
from steadylight.renderers.base import Geometry, Job, Renderer, Survey
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

_PIXELS: Final = 32_000
"""Approximate number of pixels of a thumbnail."""

_SAMPLES: Final = 8
"""Samples per pixel and pass."""

_PASSES: Final = 64

_SPARKLE: Final = 6.0
"""In each pass, values are clipped at this many times the value that the exposure of the first pass maps to 1. This
removes fireflies, and a thumbnail needs no brighter values."""

Picture = NDArray[np.uint8]


class Thumbnail(NamedTuple):
    """A frame as shown.

    Attributes:
        pixels: (height, width, 3) uint8.
        stops: its exposure relative to the common exposure of all frames, in EV; 0 for a single frame.
    """

    pixels: Picture
    stops: float


def picture_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of thumbnails of frames of this size."""
    scale = np.sqrt(_PIXELS / (width * height))
    return max(8, round(width * scale)), max(8, round(height * scale))


@dataclass(frozen=True)
class Tracer:
    """How frames are made.

    Attributes:
        renderer: a renderer with the mode `path`.
        variant: its backend, as named by `Renderer.check`.
        seconds: time after which no further pass starts; every frame gets at least one.
    """

    renderer: Renderer
    variant: str
    seconds: float


def quick_frames(
    scene: SceneDescription, poses: Mapping[int, Pose], tracer: Tracer, geometry: Geometry | None
) -> dict[int, Thumbnail]:
    """Tone-mapped thumbnails by frame number, each with its own exposure, so that dim rooms are visible too.

    Args:
        scene: the scene.
        poses: camera poses by frame number.
        tracer: how frames are made.
        geometry: surfaces of the scene, along which noise is smoothed; without it, the noise stays.
    """
    means = _traced(scene, poses, tracer)
    if geometry is not None and scene.sensor.get("type", "perspective") in {"perspective", "thinlens"}:
        size = picture_size(scene.width, scene.height)
        means = {
            number: smoothed(image, surfaces_of(geometry, poses[number], size))
            for number, image in means.items()
        }
    common = animation_exposure(means.values())
    shown = {}
    for number, image in means.items():
        exposure = animation_exposure([image])
        shown[number] = Thumbnail(tone_map(image, exposure), float(np.log2(exposure / common)))
    return shown


def _traced(
    scene: SceneDescription, poses: Mapping[int, Pose], tracer: Tracer
) -> dict[int, NDArray[np.float64]]:
    """Scene-linear thumbnails, averaged over as many passes as time allows."""
    width, height = picture_size(scene.width, scene.height)
    numbers = tuple(sorted(poses))
    settings = RenderSettings.checked(
        renderer=tracer.renderer.name,
        mode="path",
        coverage="off",
        spp=_SAMPLES,
        frames=numbers,
        width=width,
        height=height,
    )
    beyond = numbers[-1] + 1
    # Each pass renders the same pose under another frame number, which gives it other random numbers.
    every = {number + each * beyond: pose for number, pose in poses.items() for each in range(_PASSES)}
    job = Job(scene, settings, tracer.variant, every, (numbers,), (), Survey.undivided(1))
    opened = tracer.renderer.open(job, None)
    sums: dict[int, NDArray[np.float64]] = {}
    bright, start, counts = dict.fromkeys(numbers, np.inf), 0.0, dict.fromkeys(numbers, 0)
    for each in range(_PASSES):
        for number in numbers:
            if each and time.perf_counter() - start > tracer.seconds:
                break
            image = np.nan_to_num(opened.trace(number + each * beyond).image, posinf=0.0).astype(np.float64)
            sums[number] = sums.get(number, 0.0) + np.minimum(image, bright[number])
            counts[number] += 1
            start = start or time.perf_counter()  # not counting the very first pass, which compiles
        if not each:
            bright = {number: _SPARKLE / animation_exposure([image]) for number, image in sums.items()}
            sums = {number: np.minimum(image, bright[number]) for number, image in sums.items()}
    return {number: sums[number] / counts[number] for number in numbers}
