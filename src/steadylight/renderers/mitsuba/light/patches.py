"""Patches of a scene's emitters: the units for which records measure visibility, and by which emitters are sampled.

A patch is a part of the sky, a piece of an emissive surface, or a group of nearby lamps. The density of directions
towards a patch can also be evaluated for a ray that hits the emitter by chance.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.light.clusters import Clusters
from steadylight.renderers.mitsuba.light.directions import DirectionTable
from steadylight.renderers.mitsuba.light.elements import Elements
from steadylight.renderers.mitsuba.light.environment import Environment

MOST_PATCHES = 64
"""Maximum number of patches of a scene: columns of the tables."""

ENVIRONMENT_PATCHES = 32
"""Maximum number of patches of an environment if there are other emitters."""


class Patches:
    """Parts of a scene's emitters, those of the environment first.

    Attributes:
        count: number of patches; may be 0.
        alike: (count,) shares that make all emitters equally likely; they sum to one.
        unasked: emitters that kernels never call; see `Elements`.
    """

    def __init__(self, scene: mi.Scene, environment: Environment, *, whole: bool) -> None:
        """Divide the emitters.

        Args:
            scene: mi.Scene.
            environment: of the scene.
            whole: sample all of the environment; only what the cache does not hold if False.
        """
        others = len(scene.emitters()) - environment.exists
        room = MOST_PATCHES
        self._directions = None
        sky = np.zeros(0)
        if environment.exists:
            patches = ENVIRONMENT_PATCHES if others else MOST_PATCHES
            self._directions = DirectionTable(environment, patches, whole=whole)
            room -= patches if others else 0
            sky = self._directions.energy
        self._of_sky = len(sky)
        self._elements = Elements(scene, room) if others else None
        self.unasked = [] if self._elements is None else self._elements.unasked
        self._clusters = None
        each, of = np.zeros(0), np.zeros(0, np.intp)
        if self._elements is not None:
            outline = self._elements.outline
            self._clusters = Clusters(outline, room)
            of_emitter = np.bincount(outline.emitter, outline.power)
            each = outline.power / of_emitter[outline.emitter]
            of = self._clusters.patch_of
        of_elements = np.bincount(of, each, 0 if self._clusters is None else self._clusters.count)
        self.alike = np.concatenate([sky / max(sky.sum(), 1e-300), of_elements])
        self.alike /= max(self.alike.sum(), 1e-300)
        self.count = len(self.alike)

    def arrays(self) -> list[object]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        parts = (self._directions, self._elements, self._clusters)
        return [array for part in parts if part is not None for array in part.arrays()]

    def sample(
        self, patch: mi.UInt32, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction to a patch, with its density within the patch, and the unshadowed radiance from there.

        Args:
            patch: number of the patch.
            si: where.
            sample: point in [0, 1)².
            active: lanes.
        """
        if self._elements is None:
            assert self._directions is not None
            return self._directions.sample(patch, si, sample, active)
        assert self._clusters is not None
        placed = active & (patch >= self._of_sky) if self._of_sky else active
        first = patch - self._of_sky if self._of_sky else patch
        element, share, x = self._clusters.choose(first, si, sample.x, placed)
        ds, radiance = self._elements.sample(element, si, mi.Point2f(x, sample.y), placed)
        ds.pdf *= share
        if self._of_sky:
            assert self._directions is not None
            sky, shine = self._directions.sample(patch, si, sample, active & ~placed)
            ds, radiance = dr.select(placed, ds, sky), dr.select(placed, radiance, shine)
        return ds, radiance

    def find(
        self,
        si: mi.SurfaceInteraction3f,
        hit: mi.SurfaceInteraction3f,
        emitter: mi.EmitterPtr,
        towards: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.UInt32, mi.Float]:
        """The patch that was hit, and the density with which `sample` would draw the direction to it, 1/sr.

        Args:
            si: where the ray began.
            hit: where it ends; invalid if it left the scene.
            emitter: the emitter that was hit.
            towards: the direction between them.
            active: lanes.
        """
        patch, pdf = mi.UInt32(0), mi.Float(0)
        placed = active
        if self._directions is not None:
            placed = active & hit.is_valid()
            if self._of_sky:
                patch, pdf = self._directions.pdf(towards.d, active & ~placed)
        if self._elements is None:
            return patch, pdf
        assert self._clusters is not None
        element, density = self._elements.find(si, hit, towards, emitter, placed)
        which, share = self._clusters.probability(element, si, placed)
        found = which + self._of_sky if self._of_sky else which
        if self._directions is None:
            return found, density * share
        return dr.select(placed, found, patch), dr.select(placed, density * share, pdf)
