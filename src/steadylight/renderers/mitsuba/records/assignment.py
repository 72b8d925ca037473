"""Which selected frame makes the records of a surface point that several of them see.

Selected frames look at the same walls. If each made records there, the merge would discard half of them. Which frames
see a point follows from the geometry alone, so first-pass tasks agree without communication. Among the frames that see
a point about as closely as the closest does, one is drawn. The draw is the same for a whole cell of space, so that the
work spreads evenly and the records of two frames share few borders. A point that no frame sees directly, but only by
mirrors, goes to one of the nearby frames. If that frame does not look there, the coverage audit will.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.camera import Pose
from steadylight.renderers.mitsuba.bsdf.lobes import MOST_DIELECTRICS, BSDFTraits
from steadylight.renderers.mitsuba.records.filling import Points
from steadylight.renderers.mitsuba.upload import upload

AS_WELL = 0.5
"""A frame sees a point about as closely as another if it has at least this fraction of its pixels on the surface."""

INSIDE = 0.98
"""Fraction of a picture, in each direction, that counts as inside: no records reach across its rim from beyond."""

CELL = 0.5
"""Edge of a cell relative to the distance of the nearest selected camera, rounded to a power of two."""


def left_to_others(
    scene: mi.Scene, bsdfs: BSDFTraits, points: Points, selected: Sequence[Pose], mine: int, aspect: float
) -> NDArray[np.bool_]:
    """Mask of the points whose records another selected frame makes.

    Args:
        scene: mi.Scene.
        bsdfs: of this scene.
        points: P points that frame `mine` looks up, directly or by a mirror.
        selected: cameras of the selected frames; all are perspective cameras.
        mine: index of this frame among them.
        aspect: width of the pictures over height.

    Returns:
        (P,) mask. Each point is kept by exactly one frame.
    """
    closeness = np.stack([_closeness(scene, bsdfs, points, camera, aspect) for camera in selected], axis=1)
    offsets = points.position[:, None] - np.stack([camera.origin for camera in selected])
    # Points that no camera sees directly: use the distance to each camera, whichever way it looks.
    nearness = 1 / np.maximum(_dot(offsets, offsets), 1e-30)
    closeness = np.where(closeness.any(axis=1, keepdims=True), closeness, nearness)
    eligible = closeness > AS_WELL * closeness.max(axis=1, keepdims=True)
    drawn = np.where(eligible, _draw(points, offsets), -1).argmax(axis=1)
    return np.asarray(drawn != mine)


def _closeness(
    scene: mi.Scene, bsdfs: BSDFTraits, points: Points, camera: Pose, aspect: float
) -> NDArray[np.float64]:
    """Pixels per area of surface, up to a factor common to all frames; 0 where it is not visible."""
    towards = camera.origin - points.position
    distance2 = np.maximum(_dot(towards, towards), 1e-30)
    cosine = np.maximum(_dot(towards, points.normal) / np.sqrt(distance2), 0)
    left, up, ahead = (-_dot(towards, camera.to_world[:3, axis]) for axis in range(3))
    scale = np.tan(np.radians(camera.fov) / 2)
    half = INSIDE * scale * ahead
    inside = (ahead > 0) & (np.abs(left) < half) & (np.abs(up) < half / aspect) & (cosine > 0)
    rows = np.flatnonzero(inside)
    closeness = np.zeros(len(cosine))
    if len(rows):
        seen = rows[_unhidden(scene, bsdfs, points.take(rows), camera)]
        closeness[seen] = cosine[seen] / (distance2[seen] * scale**2)
    return closeness


def _dot(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Dot product, term by term rather than as a matrix product: the same bits for any number of points."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2], np.float64)


def _unhidden(scene: mi.Scene, bsdfs: BSDFTraits, points: Points, camera: Pose) -> NDArray[np.bool_]:
    """Whether only clear glass, if anything, lies between points and a camera; refraction is neglected."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(points.position))
    si.p = upload(mi.Point3f, points.position)
    si.n = upload(mi.Normal3f, points.normal)
    si.t = mi.Float(1)
    origin = mi.Point3f(camera.origin.tolist())
    dr.make_opaque(origin)
    ray = si.spawn_ray_to(origin)
    if bsdfs.dielectric is None:
        return ~np.array(scene.ray_test(ray))
    between = dr.ones(mi.Bool, len(points.position))
    for _ in range(MOST_DIELECTRICS):
        si = scene.ray_intersect(ray, mi.RayFlags.All, False, between)
        between &= si.is_valid()
        between &= bsdfs.is_dielectric(si.bsdf(), between)
        ray = dr.select(between, si.spawn_ray_to(origin), ray)
        dr.eval(between, ray)
    return ~np.array(scene.ray_test(ray))


def _draw(points: Points, offsets: NDArray[Any]) -> NDArray[np.int64]:
    """(P, frames) random numbers, of which the largest wins; the same throughout a cell.

    `offsets` are (P, frames, 3), from the cameras, metres.
    """
    frames = offsets.shape[1]
    nearest = np.sqrt(_dot(offsets, offsets).min(axis=1))
    edge = np.exp2(np.round(np.log2(CELL * np.maximum(nearest, 1e-6))))
    cell = np.floor(points.position / edge[:, None]).astype(np.int64)
    key = np.stack([*cell.T, np.round(np.log2(edge)).astype(np.int64)], axis=1).astype(np.uint64)
    mixed = np.zeros((len(key), frames), np.uint64) + np.arange(1, frames + 1, dtype=np.uint64)
    for column in key.T:
        # The finaliser of SplitMix64 (Steele, Lea & Flood 2014) after each number.
        mixed = (mixed + column[:, None]) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(1)).astype(np.int64)
