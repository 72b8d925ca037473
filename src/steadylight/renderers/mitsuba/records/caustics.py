"""Irradiance of records by caustic photons: a density estimate."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from steadylight.cache.records import Floats, Records
from steadylight.renderers.mitsuba.records.discs import ALIKE, Discs, measured
from steadylight.renderers.mitsuba.records.importance import Doubles
from steadylight.renderers.mitsuba.records.photon_grid import PhotonGrid
from steadylight.renderers.mitsuba.records.photons import Photons

NEAREST = 64
"""Number of photons from which the caustic light of a record is estimated, if they lie within the bounds of its disc:
14 % noise, which smoothing averages over neighbours."""

FEWEST = 16
"""Number of photons that a disc holds even where it must be larger for that. On a small disc, a single one would shine
like the sun."""

WITHIN = (0.5, 1.0)
"""Bounds of the radius of a record's disc, as parts of the record's radius. Smaller than half, a caustic between two
records would be lost, or count for more than its area. Larger, it would be blurred beyond what the cache resolves."""

STRIDES = (1, 8, 64, 512)
"""Where a disc holds many photons, every 8th, 64th or 512th stands for all."""

MOST = 2048
"""Number of photons on a disc above which the next stride is used: 3 to 7 % noise. Sunshine through a window may have
all photons on a few discs."""

ON_DISC, SOME, FINEST = 4, 4096, 1e-5
"""Photons on half of the discs of the grid or more, by the distances of SOME of them: a gather averages over hundreds
of discs, so that few are enough; and with few, caustics stay in their place. The radius of the discs is at least FINEST
times the extent of the photons."""

AT_ONCE = 4096
"""Records whose photons are searched together, to bound temporary memory."""


class Caustics(NamedTuple):
    """Irradiance of records by photons, W/m², scene-linear RGB.

    Attributes:
        halves: (R, 2, 3) by every other photon, and by the others.
        variance: (R,) of their mean, mean of the channels.
    """

    halves: Floats
    variance: Floats

    @property
    def irradiance(self) -> Floats:
        """(R, 3) by all photons."""
        return np.asarray(self.halves.mean(axis=1))


def with_caustics(records: Records, caustics: CausticMap | None) -> Records:
    """The records with their caustics (`CausticMap.added_to`); the same where no photons carry any."""
    return records if caustics is None else caustics.added_to(records)


class CausticMap:
    """The photons of a scene, ready to be searched."""

    def __init__(self, scene: mi.Scene, photons: Photons) -> None:
        """Index the photons."""
        self._scene, self._photons = scene, photons
        self._trees = [cKDTree(photons.position[::stride]) for stride in STRIDES]

    @cached_property
    def grid(self) -> PhotonGrid:
        """The photons for surfaces that paths meet. Half of its discs have ON_DISC photons or more."""
        whole, position = self._trees[0], self._photons.position
        distance = whole.query(position[:SOME], k=[min(ON_DISC, whole.n)], workers=-1)[0]
        finest = FINEST * np.linalg.norm(whole.maxes - whole.mins)
        return PhotonGrid(self._photons, max(float(np.median(distance)), float(finest)), self._scene)

    def added_to(self, records: Records) -> Records:
        """Records of one value, with their caustics.

        Args:
            records: gathered by paths that leave caustics out.
        """
        if len(records) == 0:
            return records
        light = self.at(records.position, records.surface, records.radius)
        half = light.halves.mean(axis=2)
        one = records.standard_error[:, 0]
        return dataclasses.replace(
            records,
            irradiance=records.irradiance + light.irradiance[:, None],
            difference=records.difference + (light.halves[:, :1] - light.halves[:, 1:]) / 2,
            guide=records.guide + half[:, None],
            standard_error=np.sqrt(one**2 + light.variance)[:, None],
            guide_error=np.sqrt(records.guide_error**2 + 2 * light.variance[:, None, None]),
        )

    def noise_of(self, records: Records, expected: Doubles) -> float:
        """Noise of the irradiance of records by photons, relative to all light: root mean square over the records.

        Those on surfaces that are much narrower than their discs are left out: more photons narrow these instead.

        Args:
            records: R records.
            expected: (R,) their other irradiance, mean of the channels, W/m².
        """
        discs = self._discs(records.position, records.surface, records.radius)
        rows = np.flatnonzero(discs.radius >= WITHIN[0] * records.radius)
        if len(rows) == 0:
            return 0.0
        light = self._on(records.position[rows], records.surface[rows], discs.take(rows))
        whole = expected[rows] + light.irradiance.mean(axis=1)
        noise = np.sqrt(light.variance)
        relative = np.divide(noise, whole, out=np.zeros_like(whole), where=noise > 0)
        return float(np.sqrt(np.square(np.minimum(relative, 1)).mean()))

    def at(self, position: Floats, normal: Floats, radius: Floats) -> Caustics:
        """Irradiance by photons on a disc around each of R surface points (Epanechnikov's kernel).

        Args:
            position: (R, 3) world, metres.
            normal: (R, 3) unit, of the flat surface.
            radius: (R,) of the records there, metres.
        """
        return self._on(position, normal, self._discs(position, normal, radius))

    def _on(self, position: Floats, normal: Floats, discs: Discs) -> Caustics:
        """Irradiance by photons on these discs around R surface points."""
        found = [
            self._near(position[some], normal[some], discs.take(some))
            for some in (slice(begin, begin + AT_ONCE) for begin in range(0, len(position), AT_ONCE))
        ]
        sums, squares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        halves, variance = 2 * sums / discs.covered[:, None, None], squares / discs.covered**2
        return Caustics(halves.astype(np.float32), variance.astype(np.float32))

    def _discs(self, position: Floats, normal: Floats, radius: Floats) -> Discs:
        """The disc around each of R points of a cache whose records have these radii, metres."""
        whole = self._trees[0]
        some = [min(number, whole.n) for number in (FEWEST, NEAREST)]
        fewest, nearest = whole.query(position, k=some, workers=-1)[0].astype(np.float32).T
        radius = np.maximum(np.clip(nearest, WITHIN[0] * radius, WITHIN[1] * radius), fewest)
        return measured(self._scene, position, normal, radius, fewest)

    def _near(self, position: Floats, normal: Floats, discs: Discs) -> tuple[Doubles, Doubles]:
        """Sums over photons on the discs around R points.

        Returns:
            (R, 2, 3) irradiance by every other photon, and by the others, if the whole disc counted; (R,) sum of the
            squares of what each photon adds, mean of the channels.
        """
        count, whole = len(position), self._trees[0]
        there = whole.query_ball_point(position, discs.radius, workers=-1, return_length=True)
        level = np.searchsorted(MOST * np.array(STRIDES[:-1]), there)
        sums, squares = np.zeros((count, 2, 3)), np.zeros(count)
        for k in np.unique(level).tolist():
            rows = np.flatnonzero(level == k)
            sums[rows], squares[rows] = self._sums(position[rows], normal[rows], discs.take(rows), k)
        return sums, squares

    def _sums(self, position: Floats, normal: Floats, discs: Discs, level: int) -> tuple[Doubles, Doubles]:
        """The results of `_near`, by the photons of a stride."""
        count, stride, disc = len(position), STRIDES[level], discs.radius
        near = self._trees[level].query_ball_point(position, disc, workers=-1, return_sorted=True)
        at = np.repeat(np.arange(count), np.fromiter(map(len, near), np.intp, count))
        which = np.concatenate([np.asarray(each, np.intp) for each in near])
        photon = stride * which
        offset = self._photons.position[photon] - position[at]
        height = np.abs(np.einsum("pi,pi->p", offset, normal[at]))
        cosine = np.einsum("pi,pi->p", self._photons.normal[photon], normal[at])
        apart = np.einsum("pi,pi->p", offset, offset) / disc[at] ** 2
        counts = (cosine > ALIKE) & (height < discs.height[at]) & (apart < 1)
        asked = np.flatnonzero(counts & discs.hidden.any(axis=1)[at])
        counts[asked] = ~discs.hide(normal, at[asked], offset[asked])
        at, which, photon, apart = at[counts], which[counts], photon[counts], apart[counts]
        weight = 2 * stride * (1 - apart) / (np.pi * disc[at].astype(np.float64) ** 2)
        added = weight[:, None] * self._photons.power[photon]
        place = 2 * at + which % 2
        sums = [np.bincount(place, channel, 2 * count) for channel in added.T]
        squares = np.bincount(at, added.mean(axis=1) ** 2, count)
        return np.stack(sums, axis=1).reshape(count, 2, 3), squares
