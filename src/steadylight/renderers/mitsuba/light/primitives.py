"""Primitives of emitters: triangles of emissive meshes, parallelograms of two of these, lamps, and whole emitters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.upload import download, upload

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]

FLAT = 1e-3
"""Tolerance for the difference of unit normals within a flat triangle."""

FAR = 1e9
"""Metres. Radius of an emitter at infinity: equally near to all points."""

SAME = 1e-5
"""Tolerance for the distance between equal corners, relative to the edges."""

EVEN = 1e-4
"""Relative tolerance for the variation of a lamp's intensity over all directions: rounding causes less."""

_AROUND = np.concatenate([np.eye(3), -np.eye(3)])
"""Directions in which the intensity of an emitter without extent is measured."""

_PLACES = 16
"""Points of an emitter's surface at which its radiance is measured, if it is sampled as a whole."""


@dataclass
class Primitives:
    """Triangles, parallelograms, lamps, and emitters that are sampled as a whole, P rows; those of an emitter adjacent.

    Two consecutive triangles of a mesh are joined if they form a parallelogram of uniform radiance: windows and panels
    do, and parts along their sides match the openings of frames and blinds better than triangles.

    A lamp emits uniformly from one point; it is a whole emitter too, but kernels need not call it.

    Attributes:
        emitter: (P,) of the scene.
        shape: (P,) of the scene; 0 for whole emitters.
        triangle: (P,) number in its mesh, the first one of a parallelogram; -1 for whole emitters.
        square: (P,) whether it is a parallelogram.
        lamp: (P,) whether it is a lamp.
        corner: (P, 3) first corner of triangles and parallelograms, metres; centre of others.
        edges: (P, 2, 3) of triangles and parallelograms, from that corner, metres; 0 for others.
        normal: (P, 3) likewise, unit, on the emissive side; 0 for others.
        radius: (P,) of whole emitters, metres; FAR for those at infinity.
        radiance: (P, 3) of triangles and parallelograms, at the centre, W/(m² sr); of lamps the intensity, W/sr.
        intensity: (P,) luminance of the intensity of others in their brightest direction, W/sr; at infinity, W/m².
        textured: (P,) whether radiance varies over a triangle.
        detailed: whether the emission of any triangle depends on more than `radiance` and its emissive side.
        row: (T,) row of each triangle of each mesh, or of each whole emitter, in the order of emitters.
        first: (emitters,) where in `row` each emitter begins.
    """

    emitter: Indices
    shape: Indices
    triangle: Indices
    square: NDArray[np.bool_]
    lamp: NDArray[np.bool_]
    corner: Doubles
    edges: Doubles
    normal: Doubles
    radius: Doubles
    radiance: Doubles
    intensity: Doubles
    textured: NDArray[np.bool_]
    detailed: bool
    row: Indices
    first: Indices

    @property
    def area(self) -> Doubles:
        """(P,) of triangles and parallelograms, m²; 0 for others."""
        cross = np.cross(self.edges[:, 0], self.edges[:, 1])
        return np.asarray(np.linalg.norm(cross, axis=1) * np.where(self.square, 1.0, 0.5))

    def take(self, rows: Indices) -> None:
        """Keep these rows in this order; the caller updates `row`."""
        for name in {field.name for field in fields(self)} - {"detailed", "row", "first"}:
            setattr(self, name, getattr(self, name)[rows])


def primitives_of(scene: mi.Scene) -> Primitives:
    """Primitives of all emitters except the environment."""
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
        np.zeros(count, bool),
        np.zeros(count, bool),
        np.zeros((count, 3)),
        np.zeros((count, 2, 3)),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count),
        own & varying[emitter],
        bool((meshes & varying).any()),
        np.arange(count),
        begin,
    )
    flat = _read_triangles(scene, made, np.flatnonzero(own)) if own.any() else own
    for row in np.flatnonzero(~own):
        _read_whole(scene, made, row, shapes[shape_of[emitter[row]]] if shape_of[emitter[row]] >= 0 else None)
    _join(made, flat & ~made.textured)
    return made


def numbers_of(scene: mi.Scene) -> Indices:
    """Mitsuba's registry numbers of a scene's emitters, in their order."""
    return np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())).astype(np.intp)


def surface(
    shape: mi.ShapePtr, triangle: mi.UInt32, place: mi.Point2f, ray: mi.Ray3f, distance: mi.Float
) -> mi.SurfaceInteraction3f:
    """Surface interaction of a ray with a triangle.

    Args:
        shape: mesh of the triangle.
        triangle: number in its mesh.
        place: coordinates along the edges from the first corner.
        ray: ray that hits it there.
        distance: along the ray, metres.
    """
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(shape))
    pi.t, pi.prim_uv, pi.prim_index, pi.shape = distance, place, triangle, shape
    pi.valid = mi.Bool(True)
    si = shape.compute_surface_interaction(ray, pi, int(mi.RayFlags.All), mi.Bool(True))
    si.shape, si.prim_index, si.t = shape, triangle, distance
    # An area light only depends on the side from which it is seen.
    si.wi = mi.Vector3f(0, 0, -dr.dot(ray.d, si.sh_frame.n))
    return si


def _shape_of(scene: mi.Scene) -> Indices:
    """Shape of the scene that each of its emitters belongs to; -1 if none."""
    numbers = numbers_of(scene)
    found = np.full(max(int(numbers.max(initial=0)) + 1, 1), -1, np.intp)
    if scene.shapes():
        of_shapes = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(scene.shapes_dr()).emitter()))
        luminous = np.flatnonzero((of_shapes > 0) & (of_shapes < len(found)))
        found[of_shapes[luminous]] = luminous
    return found[numbers]


def _read_triangles(scene: mi.Scene, made: Primitives, rows: Indices) -> NDArray[np.bool_]:
    """Fill in the rows of triangles; returns a (P,) mask of triangles with a constant normal, over all rows."""
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
    positions, facing = [each.p for each in corners], [each.sh_frame.n for each in (*corners, middle)]
    middle.wi = mi.Vector3f(0, 0, 1)
    radiance = emitter.eval(middle)
    dr.eval(positions, facing, radiance)  # in one kernel
    p, normals = (
        np.stack([download(each) for each in parts], axis=1, dtype=np.float64)
        for parts in (positions, facing)
    )
    made.corner[rows] = p[:, 0]
    made.edges[rows] = p[:, 1:] - p[:, :1]
    cross = np.cross(made.edges[rows, 0], made.edges[rows, 1])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    cross = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    made.normal[rows] = cross * np.where((cross * normals[:, 3]).sum(axis=1) < 0, -1, 1)[:, None]
    bent = (np.linalg.norm(normals - made.normal[rows, None], axis=2).max(axis=1) > FLAT) & (length[:, 0] > 0)
    made.detailed |= bool(bent.any())
    flat = np.zeros(len(made.emitter), bool)
    flat[rows[~bent & (length[:, 0] > 0)]] = True
    made.radiance[rows] = np.nan_to_num(download(radiance).astype(np.float64))
    return flat


def _join(made: Primitives, plain: NDArray[np.bool_]) -> None:
    """Join consecutive triangles that form a parallelogram, if they are flat and of the same uniform radiance.

    With a diagonal from u to v and the corners b and d beside it, b + d = u + v: the two sums over the corners of the
    triangles therefore determine where b and d must be.
    """
    if len(plain) < 2:
        return
    one, two = slice(None, -1), slice(1, None)
    corners = np.stack([made.corner, made.corner + made.edges[:, 0], made.corner + made.edges[:, 1]], axis=1)
    total = corners.sum(axis=1)
    size = np.abs(made.edges).max(axis=(1, 2))[one]

    def apart(a: Doubles, b: Doubles) -> Doubles:
        return np.asarray(np.abs(a - b).max(axis=-1))

    # Index of the corner of each triangle that is not on the diagonal.
    off_b = apart(corners[one], ((2 * total[one] - total[two]) / 3)[:, None])
    off_d = apart(corners[two], ((2 * total[two] - total[one]) / 3)[:, None])
    at = np.arange(len(size))
    b, d = off_b.argmin(axis=1), off_d.argmin(axis=1)
    u, v = corners[one][at, (b + 1) % 3], corners[one][at, (b + 2) % 3]
    p, q = corners[two][at, (d + 1) % 3], corners[two][at, (d + 2) % 3]
    shared = np.minimum(np.maximum(apart(u, p), apart(v, q)), np.maximum(apart(u, q), apart(v, p)))
    pairs = plain[one] & plain[two] & (made.emitter[one] == made.emitter[two])
    pairs &= np.maximum(np.maximum(off_b[at, b], off_d[at, d]), shared) <= SAME * size
    pairs &= (made.normal[one] * made.normal[two]).sum(axis=1) > 0
    pairs &= (made.radiance[one] == made.radiance[two]).all(axis=1)
    # In a run of triangles that pair on both sides, take every other pair.
    begins = pairs & ~np.concatenate([[False], pairs[:-1]])
    start = np.maximum.accumulate(np.where(begins, at, 0))
    pairs &= (at - start) % 2 == 0
    rows = np.flatnonzero(pairs)
    made.corner[rows] = u[rows]
    made.edges[rows] = np.stack([corners[rows, b[rows]], corners[rows + 1, d[rows]]], axis=1) - u[rows, None]
    made.square[rows] = True
    kept = np.ones(len(plain), bool)
    kept[rows + 1] = False
    made.row = np.cumsum(kept) - 1
    made.take(np.flatnonzero(kept))


def _read_whole(scene: mi.Scene, made: Primitives, row: int, shape: mi.Shape | None) -> None:
    """Fill in the row of an emitter that is sampled as a whole."""
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
        # Samples of it show its position from anywhere; Mitsuba keeps that in one of several parameters.
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
    sent = np.nan_to_num(np.array(weight, np.float64)).T
    made.intensity[row] = luminances(sent).max()
    if emitter.class_name() == "PointLight" and np.ptp(sent, axis=0).max() <= EVEN * sent.max():
        made.lamp[row], made.radiance[row] = True, sent.mean(axis=0)


def _mean_radiance(emitter: mi.Emitter, shape: mi.Shape) -> float:
    """Mean luminance of a surface that is sampled as a whole."""
    k = np.arange(_PLACES)
    points = np.stack([(k + 0.5) / _PLACES, (k * 0.6180339887 + 0.5) % 1], axis=1)
    found = shape.sample_position(mi.Float(0), upload(mi.Point2f, points.astype(np.float32)), mi.Bool(True))
    si = dr.zeros(mi.SurfaceInteraction3f, _PLACES)
    si.p, si.uv, si.wi = found.p, found.uv, mi.Vector3f(0, 0, 1)
    return float(np.nan_to_num(np.array(mi.luminance(emitter.eval(si)))).mean())


def luminances(radiance: Sequence[float] | Doubles) -> Doubles:
    """Luminance of (..., 3) linear RGB, as `mi.luminance`."""
    return np.asarray(radiance) @ np.array([0.212671, 0.715160, 0.072169])
