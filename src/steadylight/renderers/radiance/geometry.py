"""Ray queries against an octree by Radiance's `rtrace`, for walks, checks of camera paths, and plans."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import RunError, SceneError
from steadylight.renderers.base import Hits, Lamp
from steadylight.renderers.radiance.passes import write_octree
from steadylight.renderers.radiance.workplace import Workplace
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance.programs import output_of

_FAR = 1e9
"""Metres: `rtrace` writes 1e10 for rays that hit nothing."""


class RadianceGeometry:
    """See `base.Geometry`.

    Names of shapes and lamps are unknown.
    """

    shapes: tuple[str, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    ray_offset = 0.0

    def __init__(self, scene: SceneDescription) -> None:
        """Write the octree."""
        self._workplace = Workplace()
        try:
            write_octree(scene, self._workplace.folder)
        except RunError as error:
            raise SceneError(f"scene {scene.name}: {error}") from error

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """The cube of the octree, (2, 3)."""
        *corner, side = map(
            float, output_of(self._workplace.folder, "getinfo", "-d", "scene.oct").split()[-4:]
        )
        return np.array([corner, [low + side for low in corner]])

    def cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], longest: float = np.inf
    ) -> Hits:
        """First intersections of rays."""
        given = np.hstack([origins, directions]).astype("<f8").tobytes()
        options = ("-h", "-fdd", "-ab", "0", "-w", "-oLN", "scene.oct")
        found = np.frombuffer(
            output_of(self._workplace.folder, "rtrace", *options, given=given), "<f8"
        ).reshape(-1, 4)
        met = (found[:, 0] < _FAR) & (found[:, 0] <= longest)
        return Hits(
            np.where(met, found[:, 0], np.inf),
            np.where(met[:, None], found[:, 1:], 0.0),
            np.full(len(found), -1, np.int64),
        )

    def colours(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:  # noqa: ARG002 - `rtrace` has no word for it
        """Unknown."""
        return np.full((len(origins), 3), np.nan)
