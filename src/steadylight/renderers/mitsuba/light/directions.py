"""Directions of an environment, sampled by a table: the sun separately, the rest in cells of equal solid angle.

Mitsuba's environments sample all that they emit, and some of them sample the sun too seldom. Here, each cell belongs to
a patch, so that records can distinguish the parts of the sky that they see, and the cached part of the environment can
be left out. Two hemispheres and the sun are caps of the sphere, each mapped to a square of cells (Shirley & Chiu 1997,
"A low distortion map between disk and square", on the disc of Lambert's equal-area projection of a cap).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.search import first_above
from steadylight.renderers.mitsuba.upload import upload

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]

CELLS = 512
"""Cells along an edge of a hemisphere's square: a quarter of a degree, finer than what a window shows of a sky."""

SUN_CELLS = 64
"""Cells along an edge of the sun's square: at this size, the few pixels of a sun in an environment map are smooth."""

LOOKS = 2
"""Evaluations of a cell along each of its edges: finer than the pixels of most environment maps."""

SUN_EDGE = 0.25
"""Fraction of the highest radiance at which the sun ends: its limb is darker than its centre."""

SUN_RADIUS = 12.0
"""Degrees. Brightness over a wider circle is not a sun, and is sampled by cells of the sky."""

SUN_SHARE = 0.05
"""Fraction of the energy that the sun must have to be sampled separately."""

SUN_LOOKS = 384
"""Evaluations along the diameter of the sun: they locate its centre to about a percent of its radius."""

LIMB_LOOKS = 256
"""Directions around the sun, and evaluations along each of them. Samples between the limb of the sun and the edge of
its circle are wasted: a circle one percent too wide caused half of the noise on a floor in the sun."""

SPREAD = 0.1
"""Minimum density of a cell, relative to its brightest neighbour: what the evaluations missed still gets samples."""

DARK = 0.02
"""Minimum density of any cell if the whole environment is sampled, relative to the mean."""

FINEST = 2e-3
"""Steradians. Smaller patches are not divided further: 2.5 degrees, a few sash bars of a window."""

LEAST_WORTH = 1e-3
"""Nor are patches whose energy times width is less than this fraction of that of the whole environment."""


class Cap(NamedTuple):
    """A circle of directions, mapped to a square.

    Attributes:
        frame: (3, 3) rows are two directions perpendicular to the axis, and the axis.
        height: 1 - cos of its angular radius.
    """

    frame: Doubles
    height: float

    def outside(self, direction: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which of (..., 3) unit directions lie outside. By the chord: the cosine of half a degree has few digits."""
        return np.asarray(np.sum(np.square(direction - self.frame[2]), axis=-1) > 2 * self.height)

    def looks(self, cells: int) -> NDArray[np.float32]:
        """(cells², LOOKS², 3) directions spread over the cells of the square."""
        fine = cells * LOOKS
        place = (np.arange(fine) + 0.5) / fine
        v, u = np.meshgrid(place, place, indexing="ij")
        order = np.arange(fine * fine).reshape(cells, LOOKS, cells, LOOKS).transpose(0, 2, 1, 3).ravel()
        points = np.stack([u.ravel(), v.ravel()], axis=1)[order]
        disc = mi.warp.square_to_uniform_disk_concentric(upload(mi.Point2f, points))
        # Not a matrix product, which is no faster and whose last bits depend on the machine.
        x, y, z = np.array(_on_cap(disc, mi.Float(self.height)))[..., None]
        s, t, n = self.frame.astype(np.float32)
        directions: NDArray[np.float32] = x * s + y * t + z * n
        return directions.reshape(cells * cells, LOOKS * LOOKS, 3)


_UPPER = Cap(np.eye(3), 1.0)
_LOWER = Cap(np.diag([1.0, 1.0, -1.0]), 1.0)


@dataclass
class _Cells:
    """The cells of a square, C rows.

    Attributes:
        weight: (C,) density before normalisation; luminance, W/(m² sr).
        bright: (C,) whether the cache does not hold all of it.
        edge: number of cells along an edge.
        solid_angle: of each cell, steradians.
    """

    weight: Doubles
    bright: NDArray[np.bool_]
    edge: int
    solid_angle: float


class DirectionTable:
    """The patches of an environment: groups of cells.

    Attributes:
        count: number of patches; may be 0.
        energy: (count,) luminance times solid angle of each.
        sun: a circle that is sampled separately; None if there is none.
    """

    def __init__(self, environment: Environment, patches: int, *, whole: bool) -> None:
        """Evaluate the environment, and divide it.

        Args:
            environment: of a scene that has one.
            patches: maximum number of patches; 8 or more.
            whole: sample all of it, not only what the cache does not hold.
        """
        self._environment = environment
        directions = [cap.looks(CELLS) for cap in (_UPPER, _LOWER)]
        looks = [(seen_from, *_luminances(environment, seen_from)) for seen_from in directions]
        self.sun = _find_sun(environment, looks, whole=whole)
        squares = [_cells_of_sky(*look, self.sun, whole=whole) for look in looks]
        if whole:
            mean = np.mean([square.weight.mean() for square in squares])
            for square in squares:
                square.weight = np.maximum(square.weight, DARK * mean)
        if self.sun is not None:
            squares.append(_cells_of_sun(environment, self.sun, whole=whole))
            self._frame = [mi.Vector3f(*row) for row in self.sun.frame.tolist()]
            self._height = dr.opaque(mi.Float, self.sun.height)
            dr.make_opaque(self._frame)
        solid_angle = np.repeat(
            [square.solid_angle for square in squares], [square.edge**2 for square in squares]
        )
        energy = np.concatenate([square.weight for square in squares]) * solid_angle
        groups = _divided(squares, energy, patches)
        self.count = len(groups)
        self.energy = np.array([energy[group].sum() for group in groups])
        if groups:
            self._tabulate(energy, solid_angle, groups)

    def _tabulate(self, energy: Doubles, solid_angle: Doubles, groups: list[Indices]) -> None:
        """Upload tables: cells in the order of the patches, and each cell's share of its patch."""
        ends = np.cumsum([0] + [len(group) for group in groups])
        cells = np.concatenate(groups)
        cumulative = np.concatenate([np.cumsum(energy[group]) / energy[group].sum() for group in groups])
        cumulative = cumulative.astype(np.float32)
        cumulative[ends[1:] - 1] = 1
        # The density must be that of the rounded numbers by which cells are chosen.
        exact = cumulative.astype(np.float64)
        share = np.diff(exact, prepend=0.0)
        share[ends[:-1]] = exact[ends[:-1]]
        density = np.zeros(len(energy))
        density[cells] = share / solid_angle[cells]
        patch = np.zeros(len(energy), np.uint32)
        patch[cells] = np.repeat(np.arange(len(groups)), np.diff(ends))
        self._cumulative = upload(mi.Float, cumulative)
        self._guide = upload(mi.UInt32, search_guide(cumulative, ends))
        self._cells = upload(mi.UInt32, cells.astype(np.uint32))
        self._ends = upload(mi.UInt32, ends.astype(np.uint32))
        self._density = upload(mi.Float, density.astype(np.float32))
        self._patch = upload(mi.UInt32, patch)

    def arrays(self) -> list[object]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        if self.count == 0:
            return []
        sun = [] if self.sun is None else [self._frame, self._height]
        tables = [self._cumulative, self._guide, self._cells, self._ends, self._density, self._patch]
        return [*self._environment.arrays(), *sun, *tables]

    def sample(
        self, patch: mi.UInt32, si: mi.SurfaceInteraction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction in a patch, with its density within the patch, and the environment's radiance from there.

        Args:
            patch: from 0.
            si: where.
            sample: point in [0, 1)².
            active: lanes.
        """
        begin = dr.gather(mi.UInt32, self._ends, patch, active)
        last = dr.gather(mi.UInt32, self._ends, patch + 1, active) - 1
        # y selects the cell: x, which selected the patch, has too few digits left for it.
        found = guided_search(self._cumulative, self._guide, (begin, last), sample.y, active)
        upper = dr.gather(mi.Float, self._cumulative, found, active)
        lower = dr.gather(mi.Float, self._cumulative, found - 1, active & (found > begin))
        y = dr.clip((sample.y - lower) / dr.maximum(upper - lower, 1e-12), 0, 1 - 2**-24)
        cell = dr.gather(mi.UInt32, self._cells, found, active)
        d, pdf = (
            self._direction(cell, mi.Point2f(sample.x, y)),
            dr.gather(mi.Float, self._density, cell, active),
        )
        if self.sun is not None:
            # Of cells on the limb of the sun, only the part outside counts.
            pdf = dr.select((cell < 2 * CELLS**2) & self._in_sun(d), 0, pdf)
        ds, radiance = self._environment.towards(si, d, active)
        ds.pdf = dr.select(active, pdf, 0)
        return ds, radiance

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        """The patch of a direction, and the density with which it would be sampled within the patch, 1/sr."""
        height = 1 - dr.abs(d.z)
        edge, before = mi.UInt32(CELLS), dr.select(d.z < 0, mi.UInt32(CELLS**2), 0)
        across, radius = mi.Vector2f(d.x, d.y), dr.sqrt(2 - height)
        if self.sun is not None:
            inside = self._in_sun(d)
            height = dr.squared_norm(d - self._frame[2]) / 2
            of_sun = mi.Vector2f(dr.dot(d, self._frame[0]), dr.dot(d, self._frame[1]))
            across = dr.select(inside, of_sun, across)
            radius = dr.select(inside, dr.sqrt(self._height * (2 - height)), radius)
            edge = dr.select(inside, mi.UInt32(SUN_CELLS), edge)
            before = dr.select(inside, mi.UInt32(2 * CELLS**2), before)
        uv = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(across / radius))
        place = mi.Point2u(dr.clip(uv * mi.Float(edge), 0, mi.Float(edge) - 1))
        cell = before + place.y * edge + place.x
        return dr.gather(mi.UInt32, self._patch, cell, active), dr.gather(
            mi.Float, self._density, cell, active
        )

    def _direction(self, cell: mi.UInt32, within: mi.Point2f) -> mi.Vector3f:
        """A direction in a cell."""
        below = cell >= CELLS**2
        of_sun = cell >= 2 * CELLS**2
        local = cell - dr.select(below, mi.UInt32(CELLS**2), 0)
        edge, height = mi.UInt32(CELLS), mi.Float(1)
        if self.sun is not None:
            local = local - dr.select(of_sun, mi.UInt32(CELLS**2), 0)
            edge = dr.select(of_sun, mi.UInt32(SUN_CELLS), edge)
            height = dr.select(of_sun, self._height, height)
        row = local // edge
        uv = mi.Point2f(mi.Float(local - row * edge) + within.x, mi.Float(row) + within.y) / mi.Float(edge)
        d = _on_cap(mi.warp.square_to_uniform_disk_concentric(uv), height)
        # Keep it on the cell's side of the horizon.
        up = dr.maximum(d.z, 1e-7)
        sky = mi.Vector3f(d.x, d.y, dr.select(below, -up, up))
        if self.sun is None:
            return sky
        s, t, n = self._frame
        return dr.select(of_sun, d.x * s + d.y * t + d.z * n, sky)

    def _in_sun(self, d: mi.Vector3f) -> mi.Bool:
        return dr.squared_norm(d - self._frame[2]) <= 2 * self._height


def search_guide(cumulative: NDArray[np.float32], ends: Indices) -> NDArray[np.uint32]:
    """(C,) start rows of `guided_search`: for n cells of a patch, how many end before each of n equal steps in [0, 1).

    Chen & Asau 1974, "On generating random variates from an empirical distribution".

    Args:
        cumulative: (C,) cumulative shares of the cells, by patch; the last of each is 1.
        ends: (P + 1,) where each of P patches begins, and where the last ends.
    """
    guide = np.zeros(len(cumulative), np.uint32)
    for begin, end in itertools.pairwise(ends):
        count = end - begin
        # The same product as in the kernel, to the last bit.
        step = np.minimum((cumulative[begin:end] * np.float32(count)).astype(np.intp), count - 1)
        guide[begin:end] = np.searchsorted(step, np.arange(count))
    return guide


def guided_search(
    cumulative: mi.Float,
    guide: mi.UInt32,
    patch: tuple[mi.UInt32, mi.UInt32],
    number: mi.Float,
    active: mi.Bool,
) -> mi.UInt32:
    """The row of the cell that a number selects: the first of its patch whose cumulative share is greater.

    The guide leaves few rows to search; a binary search of all would wait for memory at each of up to 19 steps.

    Args:
        cumulative: as in `search_guide`.
        guide: result of `search_guide`.
        patch: first and last row of its cells.
        number: in [0, 1).
        active: lanes.
    """
    begin, last = patch
    count = last - begin + 1
    step = dr.minimum(mi.UInt32(number * mi.Float(count)), count - 1)
    next_step = begin + step + 1
    low = begin + dr.gather(mi.UInt32, guide, begin + step, active)
    high = begin + dr.gather(mi.UInt32, guide, next_step, active & (next_step <= last))
    high = dr.select(next_step <= last, high, last)
    return first_above(cumulative, number, low, high, active)


def _on_cap(disc: mi.Point2f, height: mi.Float) -> mi.Vector3f:
    """The direction of a point on the unit disc, on a cap of this height around z."""
    h = dr.squared_norm(disc) * height
    across = dr.sqrt(height * (2 - h))
    return mi.Vector3f(disc.x * across, disc.y * across, 1 - h)


def _luminances(environment: Environment, direction: NDArray[np.float32]) -> tuple[Doubles, Doubles]:
    """Luminance of the environment in (..., 3) directions, and that of the part that the cache does not hold."""
    shape = direction.shape[:-1]
    si = dr.zeros(mi.SurfaceInteraction3f, int(np.prod(shape)))
    si.wi = -upload(mi.Vector3f, direction.reshape(-1, 3))
    radiance = environment.emitter.eval(si)
    whole = mi.luminance(radiance) + dr.zeros(mi.Float, dr.width(si))
    rest = whole * (1 - environment.cached_fraction(radiance))
    dr.eval(whole, rest)
    seen, left = (np.nan_to_num(np.array(values, np.float64)).reshape(shape) for values in (whole, rest))
    return seen, left


def _find_sun(
    environment: Environment, looks: list[tuple[NDArray[np.float32], Doubles, Doubles]], *, whole: bool
) -> Cap | None:
    """The circle around the brightest direction, if it is worth separate samples."""
    direction, seen, rest = (np.concatenate(parts) for parts in zip(*looks, strict=True))
    direction, seen, rest = direction.reshape(-1, 3), seen.ravel(), rest.ravel()
    top = int(seen.argmax())
    if rest[top] <= 0:
        return None
    widest = 2 * np.sin(np.radians(SUN_RADIUS) / 2)
    near = np.flatnonzero(np.sum(np.square(direction - direction[top]), axis=1) < np.square(2 * widest))
    bright = near[seen[near] > SUN_EDGE * seen[top]]
    axis, chord = _circle(direction[bright].astype(np.float64))
    spacing = np.sqrt(2 * np.pi) / (CELLS * LOOKS)
    if chord + spacing > widest:
        return None
    # Refine: the sun may be smaller than the spacing of the evaluations.
    for _ in range(2):
        wide = 1.2 * chord + 2 * spacing
        fine = _around(_frame(axis), wide)
        spacing = 2 * wide / SUN_LOOKS
        radiance, _ = _luminances(environment, fine.astype(np.float32))
        axis, chord = _circle(fine[radiance > SUN_EDGE * radiance.max()])
    edge, between = SUN_EDGE * float(radiance.max()), (chord - 2 * spacing, chord + 2 * spacing)
    for _ in range(2):
        limb, around = _limb(environment, _frame(axis), between, edge)
        # A circle seen off-centre: its edge is as much nearer on one side as it is farther on the other.
        axis = axis + 2 * (limb[:, None] * around).mean(axis=0)
        axis /= np.linalg.norm(axis)
    limb, _ = _limb(environment, _frame(axis), between, edge)
    sun = Cap(_frame(axis), float(limb.max() ** 2 / 2))
    others = seen if whole else rest
    energy = radiance[~sun.outside(fine)].mean() * 2 * np.pi * sun.height
    left = others.sum() - others[near[~sun.outside(direction[near])]].sum()
    enough = energy >= SUN_SHARE * (energy + left * 4 * np.pi / len(seen))
    return sun if enough else None


def _limb(
    environment: Environment, frame: Doubles, between: tuple[float, float], edge: float
) -> tuple[Doubles, Doubles]:
    """Edge of the sun on all sides.

    Args:
        environment: with the sun.
        frame: its last row is the axis.
        between: bounds of the distance of the edge from the axis.
        edge: luminance at the edge.

    Returns:
        (LIMB_LOOKS,) distance from the axis; and (LIMB_LOOKS, 3) unit vectors in these directions.
    """
    distance = np.linspace(*between, LIMB_LOOKS)
    turn = 2 * np.pi * np.arange(LIMB_LOOKS) / LIMB_LOOKS
    s, t, n = frame
    height = distance**2 / 2
    around = np.cos(turn)[:, None] * s + np.sin(turn)[:, None] * t
    looks = (1 - height)[:, None] * n + np.sqrt(height * (2 - height))[:, None] * around[:, None]
    radiance, _ = _luminances(environment, looks.astype(np.float32))
    # One step beyond the last bright one.
    bright = np.arange(1, LIMB_LOOKS + 1) * (radiance > edge)
    return distance[np.minimum(bright.max(axis=1), LIMB_LOOKS - 1)], around


def _circle(direction: Doubles) -> tuple[Doubles, float]:
    """Centre of (D, 3) unit directions, and their largest distance from it."""
    middle = direction.mean(axis=0)
    middle /= np.linalg.norm(middle)
    return middle, float(np.linalg.norm(direction - middle, axis=1).max())


def _frame(axis: Doubles) -> Doubles:
    """(3, 3) an orthonormal frame; the last row is the axis."""
    s = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    s /= np.linalg.norm(s)
    return np.stack([s, np.cross(axis, s), axis])


def _around(frame: Doubles, wide: float) -> Doubles:
    """(SUN_LOOKS², 3) directions in a grid around an axis, out to a distance of `wide`."""
    place = wide * (2 * (np.arange(SUN_LOOKS) + 0.5) / SUN_LOOKS - 1)
    y, x = np.meshgrid(place, place, indexing="ij")
    made: Doubles = frame[2] + x.reshape(-1, 1) * frame[0] + y.reshape(-1, 1) * frame[1]
    return made / np.linalg.norm(made, axis=1, keepdims=True)


def _cells_of_sky(
    direction: NDArray[np.float32], seen: Doubles, rest: Doubles, sun: Cap | None, *, whole: bool
) -> _Cells:
    """Cells of a hemisphere, without the sun."""
    if sun is not None:
        outside = sun.outside(direction)
        seen, rest = np.where(outside, seen, 0), np.where(outside, rest, 0)
    values = seen if whole else rest
    weight = np.maximum(values.mean(axis=1), SPREAD * _highest_around(values.max(axis=1), CELLS))
    bright = _highest_around(rest.max(axis=1), CELLS) > 0
    return _Cells(weight, bright, CELLS, 2 * np.pi / CELLS**2)


def _cells_of_sun(environment: Environment, sun: Cap, *, whole: bool) -> _Cells:
    seen, rest = _luminances(environment, sun.looks(SUN_CELLS))
    values = seen if whole else rest
    weight = np.maximum(values.mean(axis=1), SPREAD * _highest_around(values.max(axis=1), SUN_CELLS))
    weight = np.maximum(weight, DARK * weight.mean())
    return _Cells(weight, np.ones(len(weight), bool), SUN_CELLS, 2 * np.pi * sun.height / SUN_CELLS**2)


def _highest_around(values: Doubles, edge: int) -> Doubles:
    """Maximum of each cell of a square and its neighbours."""
    highest: Doubles = maximum_filter(values.reshape(edge, edge), 3, mode="nearest")
    return highest.ravel()


def _divided(squares: list[_Cells], energy: Doubles, patches: int) -> list[Indices]:
    """Compact groups of cells; cells held entirely by the cache are grouped separately."""
    groups: list[Indices] = []
    first = 0
    for square in squares:
        order = first + np.argsort(_morton(square.edge), kind="stable")
        for bright in (False, True):
            chosen = order[(square.bright[order - first] == bright) & (energy[order] > 0)]
            groups += [chosen] if len(chosen) else []
        first += square.edge**2
    edges = np.repeat([square.edge for square in squares], [square.edge**2 for square in squares])
    starts = np.cumsum([0] + [square.edge**2 for square in squares])
    local = np.arange(first) - np.repeat(starts[:-1], np.diff(starts))
    place = np.stack([local % edges, local // edges])
    solid_angle = np.repeat([square.solid_angle for square in squares], np.diff(starts))
    least = LEAST_WORTH * float(energy.sum()) * np.sqrt(4 * np.pi)

    def worth(group: Indices) -> float:
        """Gain of dividing a group: energy times width."""
        size = float(solid_angle[group].sum())
        value = float(energy[group].sum()) * np.sqrt(size)
        return value if len(group) > 1 and size > FINEST and value > least else 0.0

    gains = [worth(group) for group in groups]
    while len(groups) < patches and max(gains, default=0) > 0:
        widest = int(np.argmax(gains))
        parts = _halves(energy, place, groups[widest])
        groups[widest : widest + 1] = parts
        gains[widest : widest + 1] = [worth(part) for part in parts]
    return groups


def _halves(energy: Doubles, place: Indices, group: Indices) -> list[Indices]:
    """A group divided across its longer side, where about half of its energy lies on either side."""
    where = place[:, group]
    along = where[int(np.ptp(where, axis=1).argmax())]
    low = int(along.min())
    total = np.cumsum(np.bincount(along - low, energy[group]))
    cut = low + int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(total) - 1))
    return [group[along < cut], group[along >= cut]]


def _morton(edge: int) -> Indices:
    """Morton codes of the cells of a square: in their order, neighbouring cells are mostly adjacent."""
    cell = np.arange(edge * edge)
    x, y = cell % edge, cell // edge
    code = np.zeros(len(cell), np.intp)
    for bit in range(edge.bit_length()):
        code |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    return code
