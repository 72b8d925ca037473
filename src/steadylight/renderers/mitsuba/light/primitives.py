"""What emitters are made of: triangles of luminous meshes, and all other emitters whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.upload import upload

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]

FLAT = 1e-3
"""Difference of unit normals within a triangle that counts as none."""

FAR = 1e9
"""Metres. Radius of an emitter that has no place: as near to any point as to another."""

_AROUND = np.concatenate([np.eye(3), -np.eye(3)])
"""Directions in which the intensity of an emitter without extent is measured."""

_PLACES = 16
"""Points of an emitter's surface at which its radiance is measured, if it is sampled whole."""


@dataclass
class Primitives:
    """Triangles, and emitters that are sampled whole, P rows; those of an emitter side by side.

    Attributes:
        emitter: (P,) of the scene.
        shape: (P,) of the scene; 0 for whole emitters.
        triangle: (P,) number in its mesh; -1 for whole emitters.
        corner: (P, 3) of triangles, metres; the centre of others.
        edges: (P, 2, 3) of triangles, from that corner, metres; 0 of others.
        normal: (P, 3) of triangles, unit, on the luminous side; 0 of others.
        radius: (P,) of whole emitters, metres; FAR if they have no place.
        radiance: (P, 3) of triangles, at the middle, W/(m² sr).
        intensity: (P,) luminance of what others send to one side, W/sr; of those without place, W/m².
        textured: (P,) whether radiance varies over a triangle.
        detailed: whether anything but `radiance` decides what any triangle sends to its luminous side.
    """

    emitter: Indices
    shape: Indices
    triangle: Indices
    corner: Doubles
    edges: Doubles
    normal: Doubles
    radius: Doubles
    radiance: Doubles
    intensity: Doubles
    textured: NDArray[np.bool_]
    detailed: bool

    @property
    def area(self) -> Doubles:
        """(P,) of triangles, m²; 0 of others."""
        cross = np.cross(self.edges[:, 0], self.edges[:, 1])
        return np.asarray(np.linalg.norm(cross, axis=1) / 2)


def primitives_of(scene: mi.Scene) -> Primitives:
    """Those of all emitters but the environment."""
    emitters, shapes = scene.emitters(), scene.shapes()
    shape_of = _shape_of(scene)
    counts = np.zeros(len(emitters), np.intp)
    meshes = np.zeros(len(emitters), bool)
    for number, emitter in enumerate(emitters):
        k = shape_of[number]
        meshes[number] = k >= 0 and shapes[k].is_mesh() and emitter.class_name() == "AreaLight"
        if not emitter.is_environment():
            counts[number] = shapes[k].face_count() if meshes[number] else 1
    emitter = np.repeat(np.arange(len(emitters)), counts)
    own = meshes[emitter]
    begin = np.cumsum(counts) - counts
    triangle = np.where(own, np.arange(len(emitter)) - begin[emitter], -1)
    count = len(emitter)
    varying = np.array(
        [mi.has_flag(each.flags(), mi.EmitterFlags.SpatiallyVarying) for each in emitters], bool
    )
    made = Primitives(
        emitter,
        np.maximum(shape_of[emitter], 0),
        triangle,
        np.zeros((count, 3)),
        np.zeros((count, 2, 3)),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count),
        own & varying[emitter],
        bool((meshes & varying).any()),
    )
    if own.any():
        _read_triangles(scene, made, np.flatnonzero(own))
    for row in np.flatnonzero(~own):
        _read_whole(scene, made, row, shapes[shape_of[emitter[row]]] if shape_of[emitter[row]] >= 0 else None)
    return made


def numbers_of(scene: mi.Scene) -> Indices:
    """The numbers that Mitsuba knows a scene's emitters by, in their order."""
    return np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())).astype(np.intp)


def surface(
    shape: mi.ShapePtr, triangle: mi.UInt32, place: mi.Point2f, ray: mi.Ray3f, distance: mi.Float
) -> mi.SurfaceInteraction3f:
    """The point of a triangle that a ray meets.

    Args:
        shape: whose triangle.
        triangle: number in its mesh.
        place: coordinates along the edges from the first corner.
        ray: that meets it there.
        distance: along the ray, metres.
    """
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(shape))
    pi.t, pi.prim_uv, pi.prim_index, pi.shape = distance, place, triangle, shape
    pi.valid = mi.Bool(True)
    si = shape.compute_surface_interaction(ray, pi, int(mi.RayFlags.All), mi.Bool(True))
    si.shape, si.prim_index, si.t = shape, triangle, distance
    # An area light asks no more than from which side it is seen.
    si.wi = mi.Vector3f(0, 0, -dr.dot(ray.d, si.sh_frame.n))
    return si


def _shape_of(scene: mi.Scene) -> Indices:
    """Which shape of the scene each of its emitters belongs to; -1 if none."""
    numbers = numbers_of(scene)
    found = np.full(max(int(numbers.max(initial=0)) + 1, 1), -1, np.intp)
    if scene.shapes():
        of_shapes = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(scene.shapes_dr()).emitter()))
        luminous = np.flatnonzero((of_shapes > 0) & (of_shapes < len(found)))
        found[of_shapes[luminous]] = luminous
    return found[numbers]


def _read_triangles(scene: mi.Scene, made: Primitives, rows: Indices) -> None:
    """Fill in the rows of triangles."""
    shape = dr.gather(mi.ShapePtr, scene.shapes_dr(), upload(mi.UInt32, made.shape[rows].astype(np.uint32)))
    triangle = upload(mi.UInt32, made.triangle[rows].astype(np.uint32))
    listed = scene.emitters_dr()
    emitter = dr.gather(mi.EmitterPtr, listed, upload(mi.UInt32, made.emitter[rows].astype(np.uint32)))
    down = mi.Ray3f(dr.zeros(mi.Point3f, len(rows)), mi.Vector3f(0, 0, -1))

    def at(u: float, v: float) -> mi.SurfaceInteraction3f:
        place = mi.Point2f(dr.full(mi.Float, u, len(rows)), v)
        return surface(shape, triangle, place, down, mi.Float(1))

    corners = [at(0, 0), at(1, 0), at(0, 1)]
    middle = at(1 / 3, 1 / 3)
    p = np.stack([np.array(corner.p, np.float64).T for corner in corners], axis=1)
    normals = np.stack([np.array(corner.sh_frame.n, np.float64).T for corner in (*corners, middle)], axis=1)
    made.corner[rows] = p[:, 0]
    made.edges[rows] = p[:, 1:] - p[:, :1]
    cross = np.cross(made.edges[rows, 0], made.edges[rows, 1])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    cross = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    made.normal[rows] = cross * np.where((cross * normals[:, 3]).sum(axis=1) < 0, -1, 1)[:, None]
    bent = (np.linalg.norm(normals - made.normal[rows, None], axis=2).max(axis=1) > FLAT) & (length[:, 0] > 0)
    made.detailed |= bool(bent.any())
    middle.wi = mi.Vector3f(0, 0, 1)
    made.radiance[rows] = np.nan_to_num(np.array(emitter.eval(middle), np.float64).T)


def _read_whole(scene: mi.Scene, made: Primitives, row: int, shape: mi.Shape | None) -> None:
    """Fill in the row of an emitter that is sampled whole."""
    emitter = scene.emitters()[made.emitter[row]]
    flags = emitter.flags()
    box = scene.bbox()
    middle = (np.array(box.min, np.float64) + np.array(box.max, np.float64)) / 2
    if shape is not None:
        box = shape.bbox()
        made.corner[row] = (np.array(box.min) + np.array(box.max)) / 2
        made.radius[row] = np.linalg.norm(np.array(box.max) - np.array(box.min)) / 2
        if not mi.has_flag(flags, mi.EmitterFlags.DeltaDirection):
            made.intensity[row] = _mean_radiance(emitter, shape) * float(shape.surface_area()[0]) / 4
            return
        origins = made.corner[row] + made.radius[row] * _AROUND
    elif mi.has_flag(flags, mi.EmitterFlags.DeltaPosition):
        # Seen from anywhere, it is where its samples are; Mitsuba keeps its place in one of several parameters.
        si = dr.zeros(mi.SurfaceInteraction3f, 1)
        si.p = upload(mi.Point3f, middle[None].astype(np.float32))
        ds, _ = emitter.sample_direction(si, mi.Point2f(0.5), mi.Bool(True))
        made.corner[row] = np.array(ds.p, np.float64).ravel()[:3]
        axis = np.array(emitter.world_transform().matrix, np.float64).reshape(4, 4)[:3, 2]
        origins = made.corner[row] + np.concatenate([_AROUND, axis[None]])
    else:
        made.corner[row], made.radius[row] = middle, FAR
        origins = middle[None]
    si = dr.zeros(mi.SurfaceInteraction3f, len(origins))
    si.p = upload(mi.Point3f, origins.astype(np.float32))
    _, weight = emitter.sample_direction(si, mi.Point2f(0.5), mi.Bool(True))
    made.intensity[row] = np.nan_to_num(np.array(mi.luminance(weight), np.float64)).max()


def _mean_radiance(emitter: mi.Emitter, shape: mi.Shape) -> float:
    """Luminance of a surface that is sampled whole."""
    k = np.arange(_PLACES)
    points = np.stack([(k + 0.5) / _PLACES, (k * 0.6180339887 + 0.5) % 1], axis=1)
    found = shape.sample_position(mi.Float(0), upload(mi.Point2f, points.astype(np.float32)), mi.Bool(True))
    si = dr.zeros(mi.SurfaceInteraction3f, _PLACES)
    si.p, si.uv, si.wi = found.p, found.uv, mi.Vector3f(0, 0, 1)
    return float(np.nan_to_num(np.array(mi.luminance(emitter.eval(si)))).mean())


def luminances(radiance: Sequence[float] | Doubles) -> Doubles:
    """Luminance of (..., 3) linear RGB, as `mi.luminance`."""
    return np.asarray(radiance) @ np.array([0.212671, 0.715160, 0.072169])
