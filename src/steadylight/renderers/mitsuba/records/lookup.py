"""The irradiance cache on the device, and its look-up in kernels: the fast twin of `cache/lookup.py`."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import BEHIND, FLATNESS, HEADROOM, ROUNDING, STEP, STRETCHED
from steadylight.cache.octree import Cube, build_octree
from steadylight.cache.records import Floats, Records
from steadylight.renderers.mitsuba.light.emitters import NO_ROW, EmitterTable
from steadylight.renderers.mitsuba.records.origins import ray_offset
from steadylight.renderers.mitsuba.sampling import numbers_from
from steadylight.renderers.mitsuba.upload import upload

AWAY = 1e18
"""Where hidden records are moved, metres: so far away that their weight is zero everywhere."""

LIFT = 0.1
"""Fraction of the distance between record and point by which both ends of the visibility ray are lifted off their
surfaces, so that curved or panelled surfaces do not occlude themselves."""

DRAWS = 8
"""Number of records that `draw_in_sight` draws in one visit of the octree; the first visible one is used. In the open,
that is the very first; if none is visible, the path continues. With 16, hardly more look-ups find a record: 0.2 % more
of those of gathers, 0.5 % more of those of the exchange (living-room, classroom)."""

PLACE, VALUE = 20, 24
"""Floats per record of what determines its weight, and floats per value of what determines that value. Multiples of
four let Dr.Jit fetch them as packets."""


@dataclass(eq=False)
class Part:
    """Records that were uploaded together, and data derived from them once.

    Attributes:
        records: R records.
        emitters: emitter table with a row per record; None until measured.
    """

    records: Records
    emitters: EmitterTable | None = None


class DeviceAnswer(NamedTuple):
    """Result of a look-up in a kernel."""

    irradiance: mi.Color3f  # W/m², sum of all values; zero on a miss
    weight: mi.Float  # sum of weights at normal radius
    row: mi.UInt32  # the record of the largest weight, or the one that was drawn; NO_ROW on a miss


class _Query(NamedTuple):
    """Query points."""

    position: mi.Point3f
    normal: mi.Normal3f
    active: mi.Bool
    facing: mi.Normal3f | None = (
        None  # normal of the diffuse lobe, where a normal map turns it; None without normal maps
    )


class _Visit(NamedTuple):
    """A record that an octree lists for a query point."""

    row: mi.UInt32
    weight: mi.Float
    inverse_radius: mi.Float  # 1/m
    offset: mi.Vector3f  # from the record to the query point, metres
    normal: mi.Normal3f

    @property
    def share(self) -> mi.Float:
        """The weight times 1 / radius²: a shorter radius means that light changes faster there."""
        return self.weight * dr.square(self.inverse_radius)


@dataclass
class _Mean:
    """Weighted mean irradiance of the records visited, and the record of the largest weight: variables of a loop."""

    total: mi.Color3f
    share: mi.Float
    weight: mi.Float
    best: mi.Float
    row: mi.UInt32

    @classmethod
    def begin(cls) -> _Mean:
        """No record yet."""
        return cls(mi.Color3f(0), mi.Float(0), mi.Float(0), mi.Float(0), mi.UInt32(NO_ROW))

    @dr.syntax
    def add(self, cache: DeviceCache, visit: _Visit, query: _Query) -> None:
        """Add a record."""
        self.weight += visit.weight
        self.row = dr.select(visit.weight > self.best, visit.row, self.row)
        self.best = dr.maximum(visit.weight, self.best)
        if visit.weight > 0:
            self.share += visit.share
            said = cache.expected(visit.row, visit.offset, visit.normal, query.normal, query.facing)
            self.total += visit.share * said


@dataclass
class _Coverage:
    """Sum of the weights of records whose radius is at most `longest` (metres): variables of a loop."""

    longest: mi.Float
    weight: mi.Float

    def add(self, cache: DeviceCache, visit: _Visit, query: _Query) -> None:
        """Add a record."""
        del cache, query
        self.weight += dr.select(self.longest * visit.inverse_radius < 1 - ROUNDING, 0, visit.weight)


@dataclass
class _Draws:
    """Records drawn in proportion to their share, independent of each other: variables of a loop.

    Each is a reservoir of size one (Chao 1982, doi:10.1093/biomet/69.3.653), whose number is rescaled for reuse.
    """

    numbers: list[mi.Float]
    rows: list[mi.UInt32]
    share: mi.Float
    weight: mi.Float

    @classmethod
    def begin(cls, numbers: list[mi.Float]) -> _Draws:
        """No record yet; a number in [0, 1) for each draw."""
        return cls(numbers, [mi.UInt32(NO_ROW) for _ in numbers], mi.Float(0), mi.Float(0))

    @dr.syntax
    def add(self, cache: DeviceCache, visit: _Visit, query: _Query) -> None:
        """Add a record."""
        del cache, query
        self.weight += visit.weight
        if visit.weight > 0:
            self.share += visit.share
            part = visit.share / self.share
            scale, other = dr.rcp(part), dr.rcp(1 - part)
            for k in range(len(self.rows)):
                takes = self.numbers[k] < part
                number = dr.select(takes, self.numbers[k] * scale, (self.numbers[k] - part) * other)
                self.numbers[k] = dr.clip(number, 0, 1 - 2**-24)
                self.rows[k] = dr.select(takes, visit.row, self.rows[k])


class Index:
    """One octree over the records, as device arrays."""

    def __init__(
        self, records: Records, *, stretch: float = 1.0, cube: Cube | None = None, finer: int = 0
    ) -> None:
        tree = build_octree(records, stretch=stretch, cube=cube, finer=finer)
        self.origin = mi.Point3f(tree.origin.tolist())
        self.cells_per_metre = mi.Float(1 / float(tree.size))
        dr.make_opaque(self.origin, self.cells_per_metre)
        self.nodes = upload(mi.UInt32, tree.nodes.ravel())
        self.references = upload(
            mi.UInt32, _never_read(np.uint32) if len(tree.references) == 0 else tree.references
        )

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        return [self.origin, self.cells_per_metre, self.nodes, self.references]


class DeviceCache:
    """Records and their indices on the device; read-only.

    Attributes:
        records: the same records on the host.
        parts: the same records, grouped by upload.
        reach: distance up to which each record may be drawn, metres; None if unbounded.
        cube: root of the octrees; None for a cube around the records.
        relaxed: index of the records at STRETCHED times their radius; None without fallback.
    """

    def __init__(
        self, records: Records, reach: Floats | None = None, *, cube: Cube | None = None, finer: int = 0
    ) -> None:
        """Upload, without fallback.

        Args:
            records: R records.
            reach: (R,) distance up to which each record may be drawn, metres; None if unbounded.
            cube: root of the octrees; around the records if None.
            finer: of the first index, as in `build_octree`.
        """
        self.records = records
        self.parts: tuple[Part, ...] = (Part(records),)
        self.decide = upload(mi.Float, _decisions(records).ravel())
        self.light = upload(mi.Float, _light(records).ravel())
        self.reach = (
            None if reach is None else upload(mi.Float, reach if len(reach) else _never_read(np.float32))
        )
        self.cube = cube
        self.index = Index(records, cube=cube, finer=finer)
        self.relaxed: Index | None = None

    def with_fallback(self) -> Self:
        """The same cache, but where no record is within its radius, more distant ones are interpolated.

        This takes a second index: twice the work and memory, wasted if the cache never misses.
        """
        cache = copy.copy(self)
        cache.relaxed = Index(self.records, stretch=STRETCHED, cube=self.cube)
        return cache

    def arrays(self) -> list[Any]:
        """All that a kernel reads through this object, or that is compiled into it, for `frozen`."""
        indices = [index for index in (self.index, self.relaxed) if index is not None]
        reach = [] if self.reach is None else [self.reach]
        return [self.records.values, self.decide, self.light, reach, [index.arrays() for index in indices]]

    def look_up(
        self,
        position: mi.Point3f,
        normal: mi.Normal3f,
        active: mi.Bool,
        facing: mi.Normal3f | None = None,
    ) -> DeviceAnswer:
        """Interpolated irradiance at surface points; on a miss, from more distant records if there is a fallback.

        Args:
            position: Point3f, world, metres.
            normal: Normal3f, unit, on the lit side.
            active: lanes to look up.
            facing: normal of the cosine that weights the light above the surface: a bump map turns the lobe, not the
                surface. The weights of records depend on `normal` alone.
        """
        mean = _Mean.begin()
        weight = self._visit_with_fallback(_Query(position, normal, active, facing), mean)
        return DeviceAnswer(mean.total / dr.maximum(mean.share, 1e-30), weight, mean.row)

    def _visit_with_fallback(self, query: _Query, sums: _Mean | _Draws) -> mi.Float:
        """Visit the records that contribute; on a miss, more distant ones if there is a fallback.

        Returns:
            The sum of weights, zero on a miss.
        """
        self._visit(self.index, query, sums)
        weight = mi.Float(sums.weight)
        if self.relaxed is not None:
            far = query._replace(active=query.active & (weight <= 0))
            self._visit(self.relaxed, far, sums, 1 / STRETCHED)
        return weight

    @dr.syntax
    def draw_in_sight(
        self,
        scene: mi.Scene,
        position: mi.Point3f,
        normal: mi.Normal3f,
        number: mi.Float,
        active: mi.Bool,
        facing: mi.Normal3f | None = None,
    ) -> DeviceAnswer:
        """Irradiance at surface points from a single visible record, drawn in proportion to its share in `look_up`.

        Secondary records are coarse: one above a table top may reach the wall below it. So several are drawn,
        independently of each other. If something stands between the point and one of them, a pane or a wall, the next
        is tried. But if one is further away than its reach, no other replaces it. More distant records are used only
        where no near one contributes, and if there is a fallback.

        Args:
            scene: for visibility.
            position: world, metres.
            normal: unit, on the lit side.
            number: in [0, 1).
            active: lanes to look up.
            facing: as in `look_up`.

        Returns:
            Irradiance and row of the record; zero and NO_ROW if no record contributes, if none of those drawn is
            visible, or if one out of reach comes before any visible one. The weight is the sum over all contributing
            records.
        """
        draws = _Draws.begin(numbers_from(number, DRAWS))
        weight = self._visit_with_fallback(_Query(position, normal, active), draws)
        found, k = mi.UInt32(NO_ROW), mi.UInt32(0)
        while active & (found == NO_ROW) & (k < DRAWS):
            row = draws.rows[0]
            for j in range(1, DRAWS):
                row = dr.select(k == j, draws.rows[j], row)
            some = row != NO_ROW
            if dr.hint(self.reach is not None, mode="scalar"):
                some &= self._within_reach(row, position, some)
            seen = some & ~self._hidden(scene, position, normal, row, some)
            found = dr.select(seen, row, found)
            k = dr.select(some, k + 1, mi.UInt32(DRAWS))
        return DeviceAnswer(self._said(found, position, normal, facing), weight, found)

    def _within_reach(self, row: mi.UInt32, position: mi.Point3f, active: mi.Bool) -> mi.Bool:
        """Whether surface points are within the reach of records."""
        p0, _ = self._place(row, active)
        offset = position - mi.Point3f(p0.x, p0.y, p0.z)
        return dr.norm(offset) <= dr.gather(mi.Float, self.reach, row, active)

    def _hidden(
        self, scene: mi.Scene, position: mi.Point3f, normal: mi.Normal3f, row: mi.UInt32, active: mi.Bool
    ) -> mi.Bool:
        """Whether something occludes records from surface points."""
        p0, n0 = self._place(row, active)
        offset = mi.Vector3f(p0.x, p0.y, p0.z) - position
        lift = dr.maximum(LIFT * dr.norm(offset), ray_offset(position))
        away = offset + lift * (mi.Vector3f(n0.x, n0.y, n0.z) - normal)
        distance = dr.norm(away)
        ray = mi.Ray3f(position + lift * normal, away / dr.maximum(distance, 1e-20))
        ray.maxt = distance
        return scene.ray_test(ray, active & (distance > 0))

    def _said(
        self, row: mi.UInt32, position: mi.Point3f, normal: mi.Normal3f, facing: mi.Normal3f | None
    ) -> mi.Color3f:
        """Irradiance that single records extrapolate to surface points; zero for NO_ROW."""
        some = row != NO_ROW
        row = dr.select(some, row, 0)
        p0, n0 = self._place(row, some)
        n_i = mi.Normal3f(n0.x, n0.y, n0.z)
        offset = position - mi.Point3f(p0.x, p0.y, p0.z)
        return dr.select(some, self.expected(row, offset, n_i, normal, facing), 0)

    def _place(self, row: mi.UInt32, active: mi.Bool) -> tuple[mi.Vector4f, mi.Vector4f]:
        """What determines the weight of records: position and 1 / radius, normal and height; see `_decisions`."""
        return (
            dr.gather(mi.Vector4f, self.decide, PLACE // 4 * row, active),
            dr.gather(mi.Vector4f, self.decide, PLACE // 4 * row + 1, active),
        )

    def radius_of(self, row: mi.UInt32) -> mi.Float:
        """Radius of a record, metres; infinite for NO_ROW."""
        return dr.rcp(dr.gather(mi.Float, self.decide, PLACE * row + 3, row != NO_ROW))

    def change(self, answer: DeviceAnswer) -> mi.Color3f:
        """Difference between a record's extrapolation in `draw_in_sight` and the irradiance at its own position.

        At most that irradiance, so that noise in the gradients brightens no more than it darkens.
        """
        some = answer.row != NO_ROW
        first = self.records.values * dr.select(some, answer.row, 0)
        own = mi.Color3f(0)
        for k in range(self.records.values):
            q = dr.gather(mi.Vector4f, self.light, VALUE // 4 * (first + k), some)
            own += mi.Color3f(q.x, q.y, q.z)
        return dr.minimum(answer.irradiance - own, own)

    def weight(
        self, position: mi.Point3f, normal: mi.Normal3f, longest: mi.Float, active: mi.Bool
    ) -> mi.Float:
        """Sum of the weights of records whose radius is at most `longest` (metres): whether it is a hit."""
        coverage = _Coverage(longest, mi.Float(0))
        self._visit(self.index, _Query(position, normal, active), coverage)
        return coverage.weight

    @dr.syntax
    def _visit(
        self, index: Index, query: _Query, sums: _Mean | _Coverage | _Draws, inverse_stretch: float = 1.0
    ) -> None:
        """Add the records that one index lists for a query point to the sums."""
        position, normal = query.position, query.normal
        # Choose the tree of the normal's dominant axis.
        UInt4 = dr.replace_type_t(mi.Vector4f, dr.VarType.UInt32)
        a = dr.abs(normal)
        axis = dr.select(
            (a.x >= a.y) & (a.x >= a.z), mi.UInt32(0), dr.select(a.y >= a.z, mi.UInt32(1), mi.UInt32(2))
        )
        along = dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z))
        node = 2 * axis + dr.select(along < 0, mi.UInt32(1), mi.UInt32(0))

        # Descend: the cube is [0, 1)³, doubled at each level; each level has a list of records for the current cell.
        cell = (position - index.origin) * index.cells_per_metre
        inside = query.active & dr.all((cell >= 0) & (cell < 1))
        while inside:
            head = dr.gather(UInt4, index.nodes, node)
            i = head[1]
            end = head[2]
            while i < end:
                row = dr.gather(mi.UInt32, index.references, i)
                first = PLACE // 4 * row
                p0 = dr.gather(mi.Vector4f, self.decide, first)
                n0 = dr.gather(mi.Vector4f, self.decide, first + 1)
                s0 = dr.gather(mi.Vector4f, self.decide, first + 2)
                n_i = mi.Normal3f(n0.x, n0.y, n0.z)
                offset = mi.Vector3f(position.x - p0.x, position.y - p0.y, position.z - p0.z)
                inverse_radius = p0.w * inverse_stretch
                curved, flat = dr.dot(offset, n_i), dr.abs(dr.dot(offset, mi.Normal3f(s0.x, s0.y, s0.z)))
                height = dr.minimum(dr.abs(curved), flat)
                lean = 1 - dr.dot(normal, n_i)
                error = (dr.squared_norm(offset) + (FLATNESS**2 - 1) * dr.square(height)) * dr.square(
                    inverse_radius
                ) + lean * (inverse_stretch / NORMAL_TOLERANCE)
                w = dr.square(dr.maximum(0, 1 - error))
                step = dr.minimum(0.5 * dr.abs(curved + dr.dot(offset, normal)), flat)
                w = dr.select((step * inverse_radius > STEP) | (height > n0.w), 0, w)
                if dr.hint(not isinstance(sums, _Draws), mode="scalar"):  # those are tested by a ray
                    for j in range(2):
                        b = dr.gather(mi.Vector4f, self.decide, first + 3 + j, w > 0)
                        w = dr.select(dr.dot(offset, mi.Vector3f(b.x, b.y, b.z)) > BEHIND, 0, w)
                sums.add(self, _Visit(row, w, p0.w, offset, n_i), query)
                i += 1
            cell = 2 * cell
            upper = cell >= 1
            octant = (
                dr.select(upper.x, mi.UInt32(1), 0)
                + dr.select(upper.y, mi.UInt32(2), 0)
                + dr.select(upper.z, mi.UInt32(4), 0)
            )
            cell = dr.select(upper, cell - 1, cell)
            node = head[0] + octant
            inside &= head[0] > 0

    def expected(
        self,
        row: mi.UInt32,
        offset: mi.Vector3f,
        n_i: mi.Normal3f,
        normal: mi.Normal3f,
        facing: mi.Normal3f | None,
    ) -> mi.Color3f:
        """Irradiance that a record extrapolates to an offset from it, the sum of its values."""
        lean = 1 - dr.dot(normal, n_i)
        turn = dr.cross(n_i, normal if facing is None else facing)
        bend = None if facing is None else 1 - dr.dot(normal, facing)
        values = self.records.values
        E = mi.Color3f(0)
        for k in range(values):
            E += self._extrapolated(values * row + k, offset, turn, lean, bend)
        return E

    def _extrapolated(
        self,
        value: mi.UInt32,
        offset: mi.Vector3f,
        turn: mi.Vector3f,
        lean: mi.Float,
        bend: mi.Float | None = None,
    ) -> mi.Color3f:
        """One value of a record, extrapolated: see `cache.lookup.extrapolated`; clamped to be non-negative.

        Where the lobe's normal differs from that of its surface, `bend` is one minus the cosine between the two. When a
        surface turns, light rises over the horizon on one side and sets on the other; the rotational curvature c
        contains both. When only the lobe turns, the surface hides what would rise: half of the horizon's part is
        missing, so the curvature is (1 + c) / 2.
        """
        base = VALUE // 4 * value
        q = [dr.gather(mi.Vector4f, self.light, base + i) for i in range(VALUE // 4)]
        s = [component for v in q for component in (v.x, v.y, v.z, v.w)]
        fall = s[3] * lean if bend is None else s[3] * lean + 0.5 * (1 + s[3]) * bend
        E = mi.Color3f(
            *(
                s[c] * (1 - fall)
                + s[4 + 3 * c] * offset.x
                + s[5 + 3 * c] * offset.y
                + s[6 + 3 * c] * offset.z
                + s[13 + 3 * c] * turn.x
                + s[14 + 3 * c] * turn.y
                + s[15 + 3 * c] * turn.z
                for c in range(3)
            )
        )
        return dr.maximum(E, 0)


class PartedCache(DeviceCache):
    """A cache in named parts, which can be shown or hidden: hidden parts do not change a bit of any look-up.

    The octrees have a fixed root and records are ordered by the names of their parts, so the order of sums does not
    depend on which parts are loaded.
    """

    def __init__(self, parts: Mapping[str, Part], *, cube: Cube | None) -> None:
        """Upload, without fallback; all parts are shown.

        Args:
            parts: by name.
            cube: root of the octrees. None only if there is a single part.
        """
        self._named = dict(sorted(parts.items()))
        super().__init__(Records.concatenate(*(part.records for part in self._named.values())), cube=cube)
        self.parts = tuple(self._named.values())
        self._shown = set(self._named)

    @property
    def names(self) -> Collection[str]:
        """Names of the parts that are loaded."""
        return self._named.keys()

    def with_parts(self, more: Mapping[str, Records]) -> PartedCache:
        """This cache with further parts, all shown."""
        parts = self._named | {name: Part(records) for name, records in more.items()}
        return PartedCache(parts, cube=self.cube)

    def show(self, names: Collection[str]) -> None:
        """Show these parts and hide all others."""
        if self._shown == set(names):
            return
        self._shown = set(names)
        hidden = np.repeat(
            [name not in self._shown for name in self._named],
            [len(part.records) for part in self._named.values()],
        )
        decide = _decisions(self.records)
        decide[: len(hidden)][hidden, 0] = AWAY
        self.decide = upload(mi.Float, decide.ravel())


def _never_read(kind: type[np.generic]) -> NDArray[Any]:
    """In place of an empty array. With a single element, a kernel would differ from that for longer arrays."""
    return np.zeros(2, kind)


def _decisions(records: Records) -> Floats:
    """(R, 20) what determines a record's weight; one row if there are no records.

    Position, 1 / radius, normal, bound on the height, surface, 0, barriers, each with a 0.
    """
    decide = np.zeros((max(len(records), 1), PLACE), np.float32)
    if len(records):
        decide[:, 0:3] = records.position
        decide[:, 3] = 1 / records.radius
        decide[:, 4:7] = records.normal
        decide[:, 7] = HEADROOM * records.headroom
        decide[:, 8:11] = records.surface
        decide[:, 12:15] = records.barriers[:, 0]
        decide[:, 16:19] = records.barriers[:, 1]
    return decide


def _light(records: Records) -> Floats:
    """(R, K, 24) irradiance, curvature and gradients of each value; one row if there are no records."""
    values = records.values
    light = np.zeros((max(len(records), 1), values, VALUE), np.float32)
    if len(records):
        light[..., 0:3] = records.irradiance
        light[..., 3] = records.curvature
        light[..., 4:13] = records.translation.reshape(-1, values, 9)
        light[..., 13:22] = records.rotation.reshape(-1, values, 9)
    return light
