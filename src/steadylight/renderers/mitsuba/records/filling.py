"""Make records until they cover every point of a given set, in rounds without sequential dependence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from steadylight.cache.disagreement import agreeing_radius, left_to_the_strongest
from steadylight.cache.lookup import ANSWERED
from steadylight.cache.placement import answered_weight, select
from steadylight.cache.records import Floats, Records
from steadylight.cache.smoothing import Smoothing
from steadylight.camera import Pose
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.sampling import seed_of

ROUNDS = 12
NARROWING = 0.4
"""Spacing shrinks by this factor per round; the last round takes all remaining points. From a twentieth of the scene's
diagonal, twelve rounds get below the smallest possible radius."""

ADAPTED = 3
"""Times that records are compared with their neighbours. Where light ends at an edge that no hemisphere saw, 24 % of a
floor are wrong by a fifth or more without comparison, and 10, 7 and 7 % with 1, 2 and 3. More rounds add records and
remove little error."""

FEW = 24
"""With at most this many points left, no further rounds are made: each point gets a record."""

SHORTEST = 1e-5
"""Lower bound of all radii, as a fraction of the scene's diagonal: smaller distances are rounding error."""


class Points(NamedTuple):
    """Surface points that need a record."""

    position: Floats  # (P, 3) metres, world
    normal: Floats  # (P, 3) unit, on the lit side
    longest: Floats  # (P,) upper bound of the radius of records that are trusted here, metres
    smallest: (
        Floats  # (P,) lower bound of the radius that a record here needs, metres; 0: that of the camera path
    )
    number: Floats  # (P,) look-ups that each point stands for

    @classmethod
    def anywhere(cls, position: Floats, normal: Floats) -> Points:
        """Points that trust any record, and whose smallest radius is that of the camera path."""
        count = len(position)
        return cls.of_look_ups(
            position, normal, np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
        )

    @classmethod
    def of_look_ups(cls, position: Floats, normal: Floats, longest: Floats, smallest: Floats) -> Points:
        """Points that each stand for one look-up."""
        return cls(position, normal, longest, smallest, np.ones(len(position), np.float32))

    def asking_alike(self) -> Points:
        """The same points without a smallest radius of their own: only the camera path bounds it."""
        return self._replace(smallest=np.zeros_like(self.smallest))

    @classmethod
    def concatenate(cls, parts: Sequence[Points]) -> Points:
        """All points of the parts, in that order."""
        none = (*np.zeros((2, 0, 3), np.float32), *np.zeros((3, 0), np.float32))
        return cls(*(np.concatenate([empty, *(part[i] for part in parts)]) for i, empty in enumerate(none)))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Points:
        """The points at `rows` (indices or a mask)."""
        return Points(*(array[rows] for array in self))


class RadiusBounds:
    """Bounds of a record's radius; they depend on the whole camera path, never on the frame that makes the record.

    The smallest radius spans a number of pixels at that point, as small as they get on the camera path: from the
    nearest camera position and with the narrowest field of view, whether or not something stands between. The largest
    is a fraction of the scene's diagonal, or less if the cache is divided into parts.
    """

    def __init__(
        self,
        poses: Sequence[Pose],
        width: int,
        diagonal: float,
        quality: RecordQuality,
        longest: float = np.inf,
    ) -> None:
        """Index the camera path.

        Args:
            poses: of the cameras.
            width: of the pictures, pixels.
            diagonal: of the scene, metres.
            quality: spacings of records.
            longest: upper bound of all radii, metres.
        """
        self._cameras = cKDTree(np.array([pose.to_world[:3, 3] for pose in poses]))
        narrowest = min(np.tan(np.radians(pose.fov) / 2) for pose in poses)
        self._per_metre = quality.minimum_spacing * 2 * narrowest / width
        self.floor = SHORTEST * diagonal
        self.largest = min(quality.maximum_spacing * diagonal, longest)

    def of(self, points: Points) -> Bounds:
        """Bounds at points; largest radius at most `points.longest`.

        Where points know their smallest radius, no camera is searched for: no path to a point is shorter than its
        distance to the nearest camera, so none asks for less.
        """
        smallest, unknown = points.smallest.copy(), points.smallest <= 0
        if unknown.any():
            smallest[unknown] = self._of_camera_path(points.position[unknown])
        return self._between(smallest, points.longest)

    def at(self, position: Floats) -> Bounds:
        """Bounds at (P, 3) points, metres."""
        return self._between(self._of_camera_path(position), np.inf)

    def _of_camera_path(self, position: Floats) -> Floats:
        """(P,) smallest radius that any camera asks for at (P, 3) points, metres."""
        distance, _ = self._cameras.query(position)
        return np.asarray(self._per_metre * distance, np.float32)

    def _between(self, smallest: Floats, longest: Floats | float) -> Bounds:
        smallest = np.clip(smallest, np.float32(self.floor), np.float32(self.largest))
        largest = np.minimum(np.full_like(smallest, self.largest), longest)
        return Bounds(smallest, np.maximum(largest, smallest))


class Filler:
    """Makes records in one scene.

    Attributes:
        gather: how records are made.
        bounds: of every radius.
    """

    def __init__(self, gather: Gather, bounds: RadiusBounds) -> None:
        self.gather = gather
        self.bounds = bounds

    def with_fewer_paths(self, steps: int) -> Filler:
        """The same filler, restricted to the `steps` lowest numbers of refinement paths."""
        quality = self.gather.quality
        quality = replace(quality, refinement_paths=quality.refinement_paths[:steps])
        return Filler(replace(self.gather, quality=quality), self.bounds)

    def fill_adaptively(self, points: Points, seed: int, smoothing: Smoothing) -> Records:
        """As `fill`; then shrink records that disagree with their neighbours, and add records where coverage is lost.

        Args:
            points: P points that the cache does not cover.
            seed: of the priorities and of the gather.
            smoothing: how much two records may differ.
        """
        records = self.fill(points, seed)
        smallest, places = self.bounds.of(points).smallest, cKDTree(points.position)
        for number in range(ADAPTED):
            _, made_at = places.query(records.position)
            radius = agreeing_radius(records, smallest[made_at], smoothing)
            before, records = records, replace(records, radius=radius)
            weight = answered_weight(points.position, points.normal, points.longest, records)
            missed = weight < ANSWERED
            if not missed.any():
                break
            waiting = points.take(missed)
            # New records must not extend over the same edge again, but none is shorter than is needed there.
            left = left_to_the_strongest(waiting.position, waiting.normal, before, radius)
            longest = np.maximum(np.minimum(left, waiting.longest), smallest[missed])
            further = self.fill(waiting._replace(longest=longest), seed_of(seed, ROUNDS + number))
            records = Records.concatenate(records, further)
        return records

    def fill(self, points: Points, seed: int) -> Records:
        """Records that together cover all of the points.

        Each round chooses points no closer than the round's spacing, gathers there, and removes every point that the
        new records cover. Early rounds are sparse, so that few records are made where light is smooth; later rounds
        fill the gaps between records of short radius.

        Args:
            points: P points that the cache does not cover.
            seed: of the priorities and of the gather.

        Returns:
            At most P records.
        """
        points = points.take(np.random.default_rng(seed).permutation(len(points.position)))
        made: list[Records] = []
        weight = np.zeros(len(points.position), np.float32)
        if len(points.position) == 0:
            return Records.empty()
        extent = float(np.ptp(points.position, axis=0).max())
        coarse = min(self.bounds.largest, max(extent, 1e-6))
        for number in range(ROUNDS):
            if len(points.position) == 0:
                break
            limits = self.bounds.of(points)
            spacing = np.maximum(coarse * NARROWING**number, limits.smallest / 4).astype(np.float32)
            last = number == ROUNDS - 1 or len(spacing) <= FEW
            rows = np.arange(len(spacing)) if last else select(points.position, points.normal, spacing)
            places = Places(points.position, points.normal, limits).take(rows)
            new = gather_records(self.gather, places, seed_of(seed, number))
            made.append(new)
            weight += answered_weight(points.position, points.normal, points.longest, new)
            waiting = weight < ANSWERED
            waiting[rows] = False
            points, weight = points.take(waiting), weight[waiting]
        return Records.concatenate(*made)
