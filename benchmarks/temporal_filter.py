"""A motion-compensated temporal filter: what a temporal denoiser does with neighbouring frames, in a few lines.

Exponential accumulation with reprojection and neighbourhood clamping, after Karis 2014, "High Quality Temporal
Supersampling", and Schied et al. 2017, "Spatiotemporal Variance-Guided Filtering", doi:10.1145/3105762.3105770: the
history is fetched from where each surface point was in the frame before, held within some standard deviations of what
the neighbourhood shows now, and averaged with it. It stands in for denoisers that see more than one frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from steadylight.metrics.reprojection import View, warp

Image = NDArray[np.float32]

LEAST = 0.1
"""Share of the newest frame at least: about the last nineteen frames count."""

SPREAD = 1.5
"""Standard deviations of the neighbourhood within which the history is held."""

REACH = 7
"""Edge of that neighbourhood, pixels."""


class TemporalFilter:
    """Filters the frames of a film, one after the other."""

    def __init__(self) -> None:
        """No history."""
        self._history: Image | None = None
        self._age: NDArray[np.float64] | None = None
        self._view: View | None = None

    def __call__(self, image: Image, view: View | None = None) -> Image:
        """The next frame, filtered.

        Args:
            image: (height, width, 3) scene-linear RGB.
            view: what it sees; None for a camera that stands still.
        """
        if self._history is None or self._age is None:
            self._history, self._age = image, np.ones(image.shape[:2])
        else:
            history, age = self._history, self._age
            if view is not None and self._view is not None:
                found = warp(view, self._view)
                history = np.where(found.known[..., None], found.sample(history), image)
                age = np.where(found.known, found.sample(age), 0)
            mean = uniform_filter(image.astype(np.float64), (REACH, REACH, 0))
            square = uniform_filter(image.astype(np.float64) ** 2, (REACH, REACH, 0))
            spread = SPREAD * np.sqrt(np.maximum(square - mean**2, 0))
            history = np.clip(history, np.minimum(mean - spread, image), np.maximum(mean + spread, image))
            share = np.maximum(LEAST, 1 / (age + 1))[..., None]
            self._age = age + 1
            self._history = (share * image + (1 - share) * history).astype(np.float32)
        self._view = view
        return self._history
