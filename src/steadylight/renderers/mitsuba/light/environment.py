"""Division of the environment between the cache and direct light.

A sky seen through a door can hardly be sampled from the far end of a hall, but its irradiance changes slowly along the
walls: it belongs in the cache, as in Radiance, which leaves `glow` to the ambient calculation. The sun is small and
casts sharp shadows: it belongs in direct light. The environment is clamped at the radiance that all but a hundredth of
its directions stay below; the cache holds what is below, direct light is what exceeds it.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

DIRECTIONS = 8192
"""Directions in which the environment is evaluated: a hundredth of them is 82, enough for a quantile."""

CACHED_QUANTILE = 0.99
"""Fraction of the directions whose radiance the cache holds entirely. The sun and its aureole are less than 0.01."""

_NUMBERS = itertools.count()


class Environment:
    """How a scene's environment is divided.

    Attributes:
        emitter: the environment, if there is one.
        exists: whether there is one.
        only_emitter: whether the environment is the only emitter that a ray can hit. Then its uncached part is left to
            emitter samples: scattered rays would hardly ever find it.
        scene_number: unique to the scene within this process; separates frozen kernels.
    """

    def __init__(self, scene: mi.Scene) -> None:
        """Evaluate the environment in all directions (a spherical Fibonacci set)."""
        self.scene_number = next(_NUMBERS)
        environment = scene.environment()
        self.emitter = environment
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
        radiance = np.array(dr.max(environment.eval(si)))
        # Slightly above the quantile, so that rounding does not clamp a uniform sky.
        self._cut = dr.opaque(mi.Float, float(np.quantile(radiance, CACHED_QUANTILE)) * (1 + 1e-5))
        box = scene.bbox()
        extent = float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
        self._reach = dr.opaque(mi.Float, 2 * extent + 1)

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        return [self._cut, self._reach] if self.exists else []

    def towards(
        self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction sample from a point to beyond the scene, without a density yet, and the radiance from there.

        Args:
            si: the point.
            d: unit, world.
            active: lanes.
        """
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d, ds.dist, ds.n = d, self._reach, mi.Normal3f(-d)
        ds.p = si.p + d * self._reach
        ds.emitter = mi.EmitterPtr(self.emitter)
        looking = dr.zeros(mi.SurfaceInteraction3f)
        looking.wi = -d
        return ds, self.emitter.eval(looking, active)

    def cached_fraction(self, radiance: mi.Color3f) -> mi.Float:
        """Fraction of an environment's radiance, W/(m² sr), that the cache holds, in [0, 1]; 0 without environment."""
        if not self.exists:
            return mi.Float(0)
        return dr.minimum(1, self._cut / dr.maximum(dr.max(radiance), 1e-20))
