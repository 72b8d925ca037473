"""Ray queries against a scene by Mitsuba's ray intersection: for walks, checks of camera paths, and plans."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.base import Hits, Lamp
from steadylight.renderers.mitsuba.merged_meshes import Parts
from steadylight.renderers.mitsuba.scene import build_scene, parts_of_meshes
from steadylight.renderers.mitsuba.upload import download
from steadylight.scenes.description import SceneDescription

_BLOCK = 1 << 20
"""Rays per launch, to bound memory."""
_FACE_BITS = 32
"""Bits of a face's number within its shape."""
_GLOSSY_SAMPLES = 16
"""BSDF samples that estimate the reflectance of a surface without a diffuse one."""


class MitsubaGeometry:
    """See `base.Geometry`."""

    def __init__(self, description: SceneDescription) -> None:
        """Build the scene, on the current variant."""
        self._scene = build_scene(description)
        self._parts = parts_of_meshes(description)

    @property
    def ray_offset(self) -> float:
        """Mitsuba's, which is many times the rounding error of single precision."""
        return float(mi.math.RayEpsilon)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner, (2, 3)."""
        box = self._scene.bbox()
        return np.array([box.min, box.max], np.float64).reshape(2, 3)

    @cached_property
    def shapes(self) -> tuple[str, ...]:
        """Names, in Mitsuba's order; a merged mesh has one for each of its parts."""
        return tuple(name for _, parts in self._named for name in parts.names)

    @cached_property
    def _named(self) -> list[tuple[int, Parts]]:
        """Mitsuba's registry number of each shape, and its parts."""
        whole = np.zeros(1, np.int64)
        return [
            (
                int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]),
                self._parts.get(shape.id(), Parts([shape.id()], whole)),
            )
            for shape in self._scene.shapes()
        ]

    @cached_property
    def _first_faces(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """`_face` of the first face of each of `shapes`, ascending after -1, and their indices into `shapes`."""
        first = np.concatenate([[-1], *(_face(number, parts.first) for number, parts in self._named)])
        order = np.argsort(first)
        return first[order], order - 1

    def _shape(self, number: NDArray[np.int64], primitive: NDArray[np.int64]) -> NDArray[np.int64]:
        """Indices into `shapes`, by a shape's registry number in Mitsuba; -1 for shapes within instances."""
        first, order = self._first_faces
        place = np.searchsorted(first, _face(number, primitive), side="right") - 1
        return np.where(first[place] >> _FACE_BITS == number, order[place], -1)

    @cached_property
    def lamps(self) -> tuple[Lamp, ...]:
        """The emitters; those on shapes are placed at the centre of the shape."""
        found = []
        for emitter in self._scene.emitters():
            kind = emitter.class_name().lower()
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
                shape = emitter.get_shape()
                found.append(Lamp(kind, shape.id(), _point(shape.bbox().center())))
            elif mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) or "direction" in kind:
                found.append(Lamp(kind, emitter.id()))
            else:
                found.append(Lamp(kind, emitter.id(), _point(emitter.bbox().center())))
        return tuple(found)

    def cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64], longest: float = np.inf
    ) -> Hits:
        """First intersections of rays."""
        distance, normal = np.full(len(origins), np.inf), np.zeros((len(origins), 3))
        shape = np.full(len(origins), -1, np.int64)
        for rows, ray in _rays(origins, directions, longest):
            met = self._scene.ray_intersect_preliminary(ray, coherent=False)
            si = met.compute_surface_interaction(ray, mi.RayFlags.Minimal)
            number = dr.reinterpret_array(mi.UInt32, si.shape)
            dr.eval(si.t, si.n, number, si.prim_index)
            distance[rows] = np.array(si.t)
            hit = np.isfinite(distance[rows])
            normal[rows] = np.where(hit[:, None], download(si.n), 0.0)
            met_shape = self._shape(np.array(number, np.int64), np.array(si.prim_index, np.int64))
            shape[rows] = np.where(hit, met_shape, -1)
        return Hits(distance, normal, shape)

    def colours(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Diffuse reflectance; for a surface without a diffuse lobe, its total reflectance."""
        colours = np.full((len(origins), 3), np.nan)
        for rows, ray in _rays(origins, directions, np.inf):
            si = self._scene.ray_intersect(ray)
            bsdf = si.bsdf()
            found = bsdf.eval_diffuse_reflectance(si, si.is_valid())
            glossy = si.is_valid() & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
            dr.eval(found, glossy)
            if dr.any(glossy):
                found = dr.select(glossy, _reflected(si, bsdf, glossy), found)
            dr.eval(found, si.t)
            valid = np.isfinite(np.array(si.t))
            colours[rows] = np.where(valid[:, None], download(found), np.nan)
        return colours


def _face(number: NDArray[np.int64] | int, primitive: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number for each face of a scene: those of one shape are consecutive."""
    return (np.int64(number) << _FACE_BITS) + primitive


def _rays(
    origins: NDArray[np.float64], directions: NDArray[np.float64], longest: float
) -> Iterator[tuple[slice, mi.Ray3f]]:
    """Rays on the device, in blocks."""
    for first in range(0, len(origins), _BLOCK):
        rows = slice(first, min(first + _BLOCK, len(origins)))
        ray = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origins[rows].T, np.float32)),
            mi.Vector3f(np.ascontiguousarray(directions[rows].T, np.float32)),
        )
        if np.isfinite(longest):
            ray.maxt = dr.opaque(mi.Float, longest)
        yield rows, ray


@dr.syntax
def _reflected(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Color3f:
    """Reflectance for uniform illumination, towards the viewer: the mean weight of BSDF samples."""
    total, i = mi.Color3f(0), mi.UInt32(0)
    while active & (i < _GLOSSY_SAMPLES):
        lobe, x, y = (dr.fma(mi.Float(i), step, 0.5) for step in (1 / _GLOSSY_SAMPLES, 0.618034, 0.754878))
        at = mi.Point2f(x - dr.floor(x), y - dr.floor(y))
        _, weight = bsdf.sample(mi.BSDFContext(), si, lobe - dr.floor(lobe), at, active)
        total += dr.clip(weight, 0, 1)
        i += 1
    return total / _GLOSSY_SAMPLES


def _point(position: mi.Point3f) -> tuple[float, float, float]:
    x, y, z = (float(np.ravel(np.array(each))[0]) for each in position)
    return x, y, z
