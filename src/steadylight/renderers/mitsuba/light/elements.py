"""Emitters in the smallest pieces that are sampled: triangles and parallelograms of emissive meshes, or parts of these.

Lamps, which emit uniformly from a point, are read from a table. All other emitters are sampled as a whole, by Mitsuba.

Mitsuba samples a mesh as one emitter. If one mesh contains many lamps, a ray that hits a lamp cannot know the density
with which that lamp would have been sampled. Here, the density follows from the triangle that was hit.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.light.primitives import (
    FAR,
    Primitives,
    luminances,
    numbers_of,
    primitives_of,
    surface,
)
from steadylight.renderers.mitsuba.upload import upload

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]

MOST_DIVISIONS = 8
"""Maximum number of strips along each edge into which a triangle or parallelogram is divided."""

TEXTURED_ELEMENTS = 1 << 14
"""Approximate total number of parts of triangles whose radiance varies: samples follow the texture."""

CROWD = 4
"""If there are more triangles than wanted, the largest are divided so that no part exceeds its share among this many
times the wanted number."""

LEAST = 0.02
"""Minimum radiance in choosing a part, relative to the mean of its emitter: few evaluations estimate its radiance."""

LOOKS = 8
"""Points of a part at which its radiance is evaluated, if it varies."""

WHOLE, TRIANGLE, SQUARE, LAMP = range(4)
"""Kinds of primitives, as read by kernels."""


@dataclass
class Outline:
    """Geometry and power of elements, by which they are chosen, E rows.

    Attributes:
        emitter: (E,) of the scene.
        centre: (E, 3) world, metres.
        radius: (E,) of a bounding sphere, metres.
        axis: (E, 3) unit normal of flat elements; 0 for those that emit all around.
        power: (E,) luminance of the intensity along the axis, W/sr; positive.
        placed: (E,) False for emitters at infinity.
    """

    emitter: Indices
    centre: Doubles
    radius: Doubles
    axis: Doubles
    power: Doubles
    placed: NDArray[np.bool_]


class Elements:
    """The elements of a scene's emitters, by number, except for its environment.

    Attributes:
        count: number of elements.
        outline: by which they are chosen.
        unasked: emitters that kernels never call: lamps, if no emitter is sampled as a whole. Otherwise Mitsuba's
            virtual call contains the code of lamps too.
    """

    def __init__(self, scene: mi.Scene, wanted: int) -> None:
        """Divide the emitters.

        Args:
            scene: mi.Scene.
            wanted: untextured emitters are divided until there are about this many elements.
        """
        primitives = primitives_of(scene)
        own = primitives.triangle >= 0
        division = _divisions(primitives, wanted)
        prim, corner, edge = _parts(division, primitives.square)
        self.count = len(prim)
        self._pieces, self._lamps = bool(own.any()), bool(primitives.lamp.any())
        self._others = bool((~own & ~primitives.lamp).any())
        emitters, lamps = scene.emitters(), primitives.emitter[primitives.lamp]
        self.unasked = [] if self._others else [emitters[number] for number in lamps]
        self._squares, self._triangles = bool(primitives.square.any()), bool((own & ~primitives.square).any())
        self._divided, self._detailed = bool((division > 1).any()), primitives.detailed
        if self.count:
            self._upload(scene, primitives, division)
            self._prim = upload(mi.UInt32, prim.astype(np.uint32))
            self._place = upload(mi.Float, np.column_stack([corner, edge, edge]).astype(np.float32).ravel())
            dr.eval(self.arrays())
        power = self._powers(primitives, prim, edge)
        self.outline = _outline(primitives, prim, corner, edge, power)

    def _upload(self, scene: mi.Scene, primitives: Primitives, division: Indices) -> None:
        def listed(pointers: mi.EmitterPtr | mi.ShapePtr, rows: Indices) -> mi.UInt32:
            """As plain numbers: for a pointer, a recording would traverse all that Mitsuba has loaded."""
            return upload(mi.UInt32, np.array(dr.reinterpret_array(mi.UInt32, pointers))[rows])

        def rows(vector: Doubles, last: Doubles | Indices) -> mi.Float:
            return upload(mi.Float, np.column_stack([vector, last]).astype(np.float32).ravel())

        self._emitters = listed(scene.emitters_dr(), primitives.emitter)
        self._shapes = listed(scene.shapes_dr(), primitives.shape) if self._detailed else None
        own = primitives.triangle >= 0
        self._corner = rows(primitives.corner, _kind(primitives))
        self._edge1 = rows(primitives.edges[:, 0], primitives.area)
        self._edge2 = rows(primitives.edges[:, 1], division)
        self._normal = rows(primitives.normal, own)
        self._radiance = rows(primitives.radiance, own)
        self._begin = upload(mi.UInt32, (np.cumsum(division**2) - division**2).astype(np.uint32))
        self._triangle = upload(mi.UInt32, np.maximum(primitives.triangle, 0).astype(np.uint32))
        # By Mitsuba's number of an emitter: where its rows begin, and whether it is divided into triangles.
        numbers = numbers_of(scene)
        first = np.zeros((int(numbers.max()) + 1, 2), np.uint32)
        first[numbers, 0] = primitives.first
        first[numbers[primitives.emitter], 1] = own
        self._first = upload(mi.UInt32, first.ravel())
        self._row = upload(mi.UInt32, primitives.row.astype(np.uint32))

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        if self.count == 0:
            return []
        tables = [self._corner, self._edge1, self._edge2, self._normal, self._radiance, self._place]
        shapes = [self._shapes] if self._detailed else []
        return [
            self._emitters,
            *shapes,
            *tables,
            self._prim,
            self._begin,
            self._triangle,
            self._first,
            self._row,
        ]

    def sample(
        self, element: mi.UInt32, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction to an element, with its density within the element, and the unshadowed radiance from there.

        If only one direction is possible, the density is 1, as in Mitsuba.

        Args:
            element: number of the element.
            si: where.
            sample: point in [0, 1)².
            active: lanes.
        """
        prim = dr.gather(mi.UInt32, self._prim, element, active)
        emitter = self._emitter(prim, active)
        kind = dr.gather(mi.Vector4f, self._corner, prim, active).w
        ways = []
        if self._pieces:
            ways.append((mi.Bool(True), *self._sample_piece(element, prim, si, sample, active)))
        if self._lamps:
            ways.append((kind == LAMP, *self._sample_lamp(prim, si, active)))
        if self._others:
            whole = active & (kind == WHOLE)
            ds, weight = emitter.sample_direction(si, sample, whole)
            ways.append((whole, ds, weight * ds.pdf))
        (_, found, shine), *others = ways
        for taken, ds, radiance in others:
            found, shine = dr.select(taken, ds, found), dr.select(taken, radiance, shine)
        found.emitter = emitter
        return found, shine

    def _emitter(self, prim: mi.UInt32, active: mi.Bool) -> mi.EmitterPtr:
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._emitters, prim, active))

    def find(
        self,
        si: mi.SurfaceInteraction3f,
        hit: mi.SurfaceInteraction3f,
        towards: mi.DirectionSample3f,
        emitter: mi.EmitterPtr,
        active: mi.Bool,
    ) -> tuple[mi.UInt32, mi.Float]:
        """The element that was hit, and the density with which `sample` would draw the direction to it, 1/sr.

        Args:
            si: where the ray began.
            hit: where it ends.
            towards: the direction between them.
            emitter: the emitter that was hit; not an environment.
            active: lanes.
        """
        number = dr.reinterpret_array(mi.UInt32, emitter)
        first = dr.gather(mi.UInt32, self._first, 2 * number, active)
        if not self._pieces:
            element = dr.gather(
                mi.UInt32, self._begin, dr.gather(mi.UInt32, self._row, first, active), active
            )
            return element, emitter.pdf_direction(si, towards, active) if self._others else mi.Float(0)
        own = active & (dr.gather(mi.UInt32, self._first, 2 * number + 1, active) > 0)
        prim = dr.gather(mi.UInt32, self._row, dr.select(own, first + hit.prim_index, first), active)
        element = dr.gather(mi.UInt32, self._begin, prim, active)
        edge1 = dr.gather(mi.Vector4f, self._edge1, prim, own)
        area = edge1.w
        if self._divided:
            corner = dr.gather(mi.Vector4f, self._corner, prim, own)
            edge2 = dr.gather(mi.Vector4f, self._edge2, prim, own)
            place = _place_of(hit.p - mi.Point3f(_xyz(corner)), _xyz(edge1), _xyz(edge2), edge2.w)
            part = self._part_at(place, edge2.w, corner.w)
            element = dr.select(own, element + part, element)
            area = area / dr.square(edge2.w)
        normal = _xyz(dr.gather(mi.Vector4f, self._normal, prim, own))
        pdf = _per_steradian(area, dr.square(towards.dist), dr.dot(normal, towards.d))
        whole = emitter.pdf_direction(si, towards, active & ~own) if self._others else mi.Float(0)
        return element, dr.select(own, pdf, whole)

    def _part_at(self, place: mi.Point2f, n: mi.Float, kind: mi.Float) -> mi.UInt32:
        """Which part of a primitive contains a position, given in strips along its edges, for n strips."""
        if not self._squares:
            return _part_of_triangle(place, n)
        i, j = (dr.clip(dr.floor(x), 0, n - 1) for x in (place.x, place.y))
        part = mi.UInt32(j * n + i)
        return dr.select(kind == SQUARE, part, _part_of_triangle(place, n)) if self._triangles else part

    def _sample_piece(
        self,
        element: mi.UInt32,
        prim: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        sample: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        corner = dr.gather(mi.Vector4f, self._corner, prim, active)
        place = self._within(element, corner.w, sample, active)
        edge1 = dr.gather(mi.Vector4f, self._edge1, prim, active)
        edge2 = dr.gather(mi.Vector4f, self._edge2, prim, active)
        normal = _xyz(dr.gather(mi.Vector4f, self._normal, prim, active))
        point = mi.Point3f(_xyz(corner) + place.x * _xyz(edge1) + place.y * _xyz(edge2))
        ds, squared = _towards(point, si)
        ds.n, ds.uv = mi.Normal3f(normal), place
        cosine = -dr.dot(ds.d, normal)
        area = edge1.w / dr.square(edge2.w) if self._divided else edge1.w
        ds.pdf = dr.select(active, _per_steradian(area, squared, cosine), 0)
        square = corner.w == SQUARE
        shine = mi.Color3f(0)
        if self._squares or not self._detailed:
            listed = active & (cosine > 0)
            shine = mi.Color3f(
                _xyz(
                    dr.gather(
                        mi.Vector4f, self._radiance, prim, listed & square if self._detailed else listed
                    )
                )
            )
        if self._detailed:
            shine += self._radiance_at(prim, place, mi.Ray3f(si.p, ds.d), ds.dist, active & ~square)
        return ds, shine

    def _sample_lamp(
        self, prim: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        ds, squared = _towards(mi.Point3f(_xyz(dr.gather(mi.Vector4f, self._corner, prim, active))), si)
        ds.pdf, ds.delta = dr.select(active, mi.Float(1), 0), mi.Bool(True)
        intensity = mi.Color3f(_xyz(dr.gather(mi.Vector4f, self._radiance, prim, active)))
        return ds, intensity / dr.maximum(squared, 1e-20)

    def _within(self, element: mi.UInt32, kind: mi.Float, sample: mi.Point2f, active: mi.Bool) -> mi.Point2f:
        """A point of an element, in coordinates along the edges of its primitive."""
        place = sample
        if self._triangles:
            place = mi.Point2f(mi.warp.square_to_uniform_triangle(sample))
            if self._squares:
                place = dr.select(kind == SQUARE, sample, place)
        if not self._divided:
            return place
        part = dr.gather(mi.Vector4f, self._place, element, active)
        return mi.Point2f(dr.fma(place.x, part.z, part.x), dr.fma(place.y, part.z, part.y))

    def _radiance_at(
        self, prim: mi.UInt32, place: mi.Point2f, ray: mi.Ray3f, distance: mi.Float, active: mi.Bool
    ) -> mi.Color3f:
        shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self._shapes, prim, active))
        triangle = dr.gather(mi.UInt32, self._triangle, prim, active)
        return self._emitter(prim, active).eval(surface(shape, triangle, place, ray, distance), active)

    def _powers(self, primitives: Primitives, prim: Indices, edge: Doubles) -> Doubles:
        """Luminance of the intensity of each element, W/sr."""
        own = primitives.triangle >= 0
        shine = luminances(primitives.radiance)[prim]
        varying = np.flatnonzero(primitives.textured[prim])
        if len(varying):
            mean = self._looked_at(varying, -primitives.normal[prim[varying]])
            emitter = primitives.emitter[prim[varying]]
            total, count = np.bincount(emitter, mean), np.bincount(emitter)
            shine[varying] = np.maximum(mean, LEAST * (total / np.maximum(count, 1))[emitter])
        area = primitives.area[prim] * np.square(edge)
        power = np.where(own[prim], shine * area, primitives.intensity[prim])
        return np.maximum(power, 1e-9 * power.max(initial=1e-20))

    def _looked_at(self, elements: Indices, direction: Doubles) -> Doubles:
        """Mean luminance of some elements, seen from the front."""
        k = np.arange(len(elements) * LOOKS) % LOOKS
        points = np.stack([(k + 0.5) / LOOKS, (k * 0.6180339887 + 0.5) % 1], axis=1).astype(np.float32)
        element = upload(mi.UInt32, np.repeat(elements, LOOKS).astype(np.uint32))
        prim = dr.gather(mi.UInt32, self._prim, element)
        place = self._within(element, mi.Float(1), upload(mi.Point2f, points), mi.Bool(True))
        d = upload(mi.Vector3f, np.repeat(direction, LOOKS, axis=0))
        ray = mi.Ray3f(dr.zeros(mi.Point3f, len(k)), d)
        shine = mi.luminance(self._radiance_at(prim, place, ray, mi.Float(1), mi.Bool(True)))
        mean: Doubles = np.nan_to_num(np.array(shine, np.float64)).reshape(-1, LOOKS).mean(axis=1)
        return mean


def _kind(primitives: Primitives) -> Indices:
    kind = np.where(primitives.triangle >= 0, TRIANGLE, WHOLE)
    kind[primitives.square], kind[primitives.lamp] = SQUARE, LAMP
    return kind


def _divisions(primitives: Primitives, wanted: int) -> Indices:
    """Number of strips along its edges into which each primitive is divided."""
    own = primitives.triangle >= 0
    power = np.where(own, luminances(primitives.radiance) * primitives.area, 0)
    share = power / max(power.sum(), 1e-300)

    def divided(parts: float) -> Indices:
        return np.clip(np.floor(np.sqrt(share * parts)), 1, MOST_DIVISIONS).astype(np.intp)

    division = divided(CROWD * wanted if len(share) > wanted else 0)
    for parts in range(2 * wanted, 0, -1) if len(share) <= wanted else ():
        if (divided(parts) ** 2).sum() <= wanted:
            division = divided(parts)
            break
    textured = int(primitives.textured.sum())
    if textured:
        fine = int(np.clip(np.sqrt(TEXTURED_ELEMENTS / textured), 1, MOST_DIVISIONS))
        division = np.where(primitives.textured, np.maximum(division, fine), division)
    return division


def _parts(division: Indices, square: NDArray[np.bool_]) -> tuple[Indices, Doubles, Doubles]:
    """Parts of primitives: the primitive, (E,), the first corner along its edges, (E, 2), and the edge length, (E,).

    n strips give n² parts. In a triangle, every other part is inverted, with a negative edge.
    """
    count = division**2
    prim = np.repeat(np.arange(len(division)), count)
    k = np.arange(len(prim)) - (np.cumsum(count) - count)[prim]
    n = division[prim]
    # Row j begins with part j (2 n - j).
    j = np.floor(n - np.sqrt(np.maximum(n * n - k, 0)) + 1e-9).astype(np.intp)
    within = k - j * (2 * n - j)
    i, turned = within // 2, within % 2
    corner = np.stack([i + turned, j + turned], axis=1)
    corner = np.where(square[prim, None], np.stack([k % n, k // n], axis=1), corner)
    return prim, corner / n[:, None], np.where(square[prim], 1, 1 - 2 * turned) / n


def _place_of(offset: mi.Vector3f, edge1: mi.Vector3f, edge2: mi.Vector3f, n: mi.Float) -> mi.Point2f:
    """Coordinates of a point in strips along two edges, from its `offset` to their corner; each edge has n strips."""
    a, b, c = dr.dot(edge1, edge1), dr.dot(edge1, edge2), dr.dot(edge2, edge2)
    along1, along2 = dr.dot(offset, edge1), dr.dot(offset, edge2)
    scale = n / dr.maximum(a * c - b * b, 1e-30)
    return mi.Point2f((c * along1 - b * along2) * scale, (a * along2 - b * along1) * scale)


def _part_of_triangle(place: mi.Point2f, n: mi.Float) -> mi.UInt32:
    """Which part of a triangle contains a position, given in strips along its edges, for n strips."""
    x, y = place.x, place.y
    j = dr.clip(dr.floor(y), 0, n - 1)
    i = dr.clip(dr.floor(x), 0, n - 1 - j)
    turned = (x - i + y - j > 1) & (i + j < n - 1)
    return mi.UInt32(j * (2 * n - j) + 2 * i + dr.select(turned, mi.Float(1), 0))


def _outline(
    primitives: Primitives, prim: Indices, corner: Doubles, edge: Doubles, power: Doubles
) -> Outline:
    edges = primitives.edges[prim]
    square = primitives.square[prim]
    middle = corner + edge[:, None] / np.where(square, 2, 3)[:, None]
    centre = primitives.corner[prim] + np.einsum("ek,ekc->ec", middle, edges)
    first, second = edges[:, 0], edges[:, 1]
    medians = np.stack([first + second, first - 2 * second, second - 2 * first]) / 3
    diagonals = np.stack([first + second, first - second]) / 2
    radius = np.where(
        square, np.linalg.norm(diagonals, axis=2).max(axis=0), np.linalg.norm(medians, axis=2).max(axis=0)
    ) * np.abs(edge)
    radius = np.maximum(radius, primitives.radius[prim])
    placed = ~((primitives.triangle[prim] < 0) & (primitives.radius[prim] >= FAR))
    return Outline(primitives.emitter[prim], centre, radius, primitives.normal[prim], power, placed)


def _xyz(row: mi.Vector4f) -> mi.Vector3f:
    return mi.Vector3f(row.x, row.y, row.z)


def _towards(point: mi.Point3f, si: mi.SurfaceInteraction3f) -> tuple[mi.DirectionSample3f, mi.Float]:
    """Direction sample from a surface to a point, without a density yet, and the squared distance."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.d = point, point - si.p
    squared = dr.squared_norm(ds.d)
    ds.dist = dr.sqrt(squared)
    ds.d /= dr.maximum(ds.dist, 1e-20)
    return ds, squared


def _per_steradian(area: mi.Float, squared: mi.Float, cosine: mi.Float) -> mi.Float:
    """Density per solid angle of points uniform on a surface, at a squared distance and cosine."""
    return squared / dr.maximum(area * dr.abs(cosine), 1e-20)
