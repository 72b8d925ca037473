"""The soft part of the surroundings is gathered into the records; what is brighter stays direct light.

A sky seen through a door is all but impossible to sample from the far end of a hall, yet changes slowly along the
walls: it belongs in the cache, as in Radiance, where `glow` is left to the ambient calculation. The sun belongs in
direct light: it is small, and its shadows are sharp. An environment is cut at the radiance that all but a hundredth
of it stays below.
"""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import numpy as np

import mitsuba as mi

DIRECTIONS = 8192
SOFT = 0.99

_NUMBERS = itertools.count()


class Environment:
    """How a scene's environment is divided.

    Attributes:
        soft: whether there is an environment at all.
        alone: whether the environment is the only emitter that a ray can hit. Then all of its bright part is left to
            emitter samples: rays that surfaces scatter would hardly ever find it.
        scene_number: no other scene of this process has it; tells frozen kernels apart.
    """

    def __init__(self, scene: Any) -> None:
        """Look at the environment in all directions (a spherical Fibonacci set)."""
        self.scene_number = next(_NUMBERS)
        environment = scene.environment()
        self.exists = environment is not None
        self.only_emitter = self.exists and not any(
            mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface) for emitter in scene.emitters()
        )
        if not self.exists:
            return
        k = np.arange(DIRECTIONS) + 0.5
        z = 1 - 2 * k / DIRECTIONS
        phi = np.pi * (1 + 5**0.5) * k
        r = np.sqrt(1 - z * z)
        si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
        outward = np.stack([r * np.cos(phi), r * np.sin(phi), z]).astype(np.float32)
        si.wi = -mi.Vector3f(outward)
        seen = np.array(dr.max(environment.eval(si)))
        self._cut = dr.opaque(mi.Float, float(np.quantile(seen, SOFT)) * (1 + 1e-5))

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        return [self._cut] if self.exists else []

    def cached_fraction(self, radiance: Any) -> Any:
        """Share of an environment's radiance (Color3f) that the cache holds, in [0, 1]."""
        return dr.minimum(1, self._cut / dr.maximum(dr.max(radiance), 1e-20))
