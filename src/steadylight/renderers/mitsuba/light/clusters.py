"""Many elements of emitters in few patches: within a patch, one is chosen by its power and how near it is.

The patches and the choice within them are one tree of bounding spheres (Walter et al. 2005, "Lightcuts"; the choice by
power, distance and facing is after Conty Estevez & Kulla 2018, "Importance sampling of many lights with adaptive tree
splitting", doi:10.1145/3233305, with a mean normal in place of their cones). What shadows hide is known for a patch
as a whole, from the records.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from steadylight.renderers.mitsuba.light.elements import Outline
from steadylight.renderers.mitsuba.upload import upload

Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]

ASIDE = 0.05
"""Least part of its power with which what faces away is chosen: shading normals may differ from the bounds' own."""

LEAF = 1 << 31
"""Bit of a node that is an element."""

ROOT = 0xFFFFFFFF
"""Parent of a node that is a patch."""


class Clusters:
    """Patches of elements.

    Attributes:
        count: of patches.
        patch_of: (E,) patch of each element.
        single: whether each patch is one element, by the same number.
    """

    def __init__(self, outline: Outline, patches: int) -> None:
        """Divide the elements.

        Args:
            outline: of E elements.
            patches: at most; more than 2.
        """
        elements = len(outline.power)
        self.single = elements <= patches
        if self.single:
            self.count, self.patch_of = elements, np.arange(elements)
            return
        groups = _groups(outline, patches)
        self.count = len(groups)
        self.patch_of = np.zeros(elements, np.intp)
        for number, group in enumerate(groups):
            self.patch_of[group] = number
        self._build(outline, groups)

    def _build(self, outline: Outline, groups: list[Indices]) -> None:
        """Halve the groups level by level; children stand side by side, the first at an even number."""
        order = np.concatenate(groups)
        begin = np.cumsum([0] + [len(group) for group in groups])
        begin, end = begin[:-1], begin[1:]
        node = np.arange(len(groups))
        number = len(groups) + len(groups) % 2  # of nodes so far
        bounds = np.zeros((2 * len(order) + number, 8))
        child = np.full(len(bounds), LEAF, np.int64)
        parent = np.full(len(bounds), ROOT, np.int64)
        leaf = np.zeros(len(order), np.int64)
        while len(node):
            bounds[node] = _bounds(outline, order, begin, end)
            inner = end - begin > 1
            child[node[~inner]] = LEAF + order[begin[~inner]]
            leaf[order[begin[~inner]]] = node[~inner]
            node, begin, end = node[inner], begin[inner], end[inner]
            order = _sorted(outline, order, begin, end)
            middle = (begin + end) // 2
            first = number + 2 * np.arange(len(node))
            number += 2 * len(node)
            child[node] = first
            parent[first] = parent[first + 1] = node
            node = np.stack([first, first + 1], axis=1).ravel()
            begin, end = (np.stack(pair, axis=1).ravel() for pair in ((begin, middle), (middle, end)))
        bounds, child, parent = bounds[:number], child[:number], parent[:number]
        self._sphere = upload(mi.Float, bounds[:, :4].astype(np.float32).ravel())
        self._power = upload(mi.Float, bounds[:, 4:].astype(np.float32).ravel())
        self._child = upload(mi.UInt32, child.astype(np.uint32))
        self._parent = upload(mi.UInt32, parent.astype(np.uint32))
        self._leaf = upload(mi.UInt32, leaf.astype(np.uint32))
        self._patch = upload(mi.UInt32, self.patch_of.astype(np.uint32))

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this, for `drjit.freeze`."""
        if self.single:
            return []
        return [self._sphere, self._power, self._child, self._parent, self._leaf, self._patch]

    @dr.syntax
    def choose(
        self, patch: mi.UInt32, p: mi.Point3f, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Choose an element of a patch.

        Args:
            patch: which.
            p: where its light is wanted.
            sample: in [0, 1).
            active: lanes.

        Returns:
            The element, the probability with which it is chosen, and the sample, made new.
        """
        if dr.hint(self.single, mode="scalar"):
            return patch, mi.Float(1), sample
        sample = mi.Float(sample)
        share = mi.Float(1)
        child = dr.gather(mi.UInt32, self._child, patch, active)
        going = mi.Bool(active)
        while going & (child < LEAF):
            first, second = self._importance(child, p, going), self._importance(child + 1, p, going)
            left = first / (first + second)
            right = sample >= left
            part = dr.select(right, 1 - left, left)
            sample = dr.clip(dr.select(right, sample - left, sample) / part, 0, 1 - 2**-24)
            share *= part
            child = dr.gather(mi.UInt32, self._child, child + dr.select(right, mi.UInt32(1), 0), going)
        return child & (LEAF - 1), share, sample

    @dr.syntax
    def probability(
        self, element: mi.UInt32, p: mi.Point3f, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Float]:
        """The patch of an element, and the probability with which it is chosen there; see `choose`."""
        if dr.hint(self.single, mode="scalar"):
            return element, mi.Float(1)
        share = mi.Float(1)
        node = dr.gather(mi.UInt32, self._leaf, element, active)
        parent = dr.gather(mi.UInt32, self._parent, node, active)
        going = mi.Bool(active)
        while going & (parent != ROOT):
            own, other = self._importance(node, p, going), self._importance(node ^ 1, p, going)
            share *= own / (own + other)
            node = parent
            parent = dr.gather(mi.UInt32, self._parent, node, going)
        return dr.gather(mi.UInt32, self._patch, element, active), share

    def _importance(self, node: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> mi.Float:
        sphere = dr.gather(mi.Vector4f, self._sphere, node, active)
        power = dr.gather(mi.Vector4f, self._power, node, active)
        offset = mi.Vector3f(p.x - sphere.x, p.y - sphere.y, p.z - sphere.z)
        squared = dr.squared_norm(offset)
        # From within the sphere, what faces where cannot be told.
        facing = mi.Vector3f(power.x, power.y, power.z)
        ahead = dr.maximum(dr.dot(facing, offset) * dr.rsqrt(dr.maximum(squared, 1e-20)), 0)
        ahead = dr.select(squared < sphere.w, dr.norm(facing), ahead)
        return (ahead + power.w) / dr.maximum(squared, dr.maximum(sphere.w, 1e-12))


def _groups(outline: Outline, patches: int) -> list[Indices]:
    """Patches: what gains most is halved, until there are enough; what is far for all stays apart."""
    groups = [np.flatnonzero(outline.placed == placed) for placed in (True, False)]
    groups = [group for group in groups if len(group)]
    worth = [_worth(outline, group) for group in groups]
    while len(groups) < patches:
        widest = int(np.argmax(worth))
        group = groups[widest]
        bounds = np.array([0]), np.array([len(group)])
        group = _sorted(outline, group, *bounds)
        middle = _middle(outline.power[group])
        groups[widest : widest + 1] = [group[:middle], group[middle:]]
        worth[widest : widest + 1] = [_worth(outline, group[:middle]), _worth(outline, group[middle:])]
    return groups


def _worth(outline: Outline, group: Indices) -> float:
    """How much is gained by division: power times width."""
    if len(group) < 2:
        return -1.0
    width = np.linalg.norm(np.ptp(outline.centre[group], axis=0)) + outline.radius[group].max()
    return float(outline.power[group].sum() * width)


def _middle(power: Doubles) -> int:
    """How many of these elements have half of the power; at least one, and not all."""
    total = np.cumsum(power)
    return int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(power) - 1))


def _sorted(outline: Outline, order: Indices, begin: Indices, end: Indices) -> Indices:
    """The same elements, in the groups from `begin` to `end` along the side on which each is longest."""
    if not len(begin):
        return order
    rows = np.concatenate([np.arange(*pair) for pair in zip(begin, end, strict=True)])
    group = np.repeat(np.arange(len(begin)), end - begin)
    centre = outline.centre[order[rows]]
    starts = np.cumsum(end - begin) - (end - begin)
    extent = np.maximum.reduceat(centre, starts) - np.minimum.reduceat(centre, starts)
    along = centre[np.arange(len(rows)), extent.argmax(axis=1)[group]]
    order = order.copy()
    order[rows] = order[rows][np.lexsort((along, group))]
    return order


def _bounds(outline: Outline, order: Indices, begin: Indices, end: Indices) -> Doubles:
    """Of each group, (G, 8): centre, squared radius, intensity along its mean normal, and to all sides, W/sr."""
    rows = np.concatenate([np.arange(*pair) for pair in zip(begin, end, strict=True)])
    starts = np.cumsum(end - begin) - (end - begin)
    group = np.repeat(np.arange(len(begin)), end - begin)
    chosen = order[rows]
    power = outline.power[chosen]
    total = np.add.reduceat(power, starts)
    centre = np.add.reduceat(outline.centre[chosen] * power[:, None], starts) / total[:, None]
    reach = np.linalg.norm(outline.centre[chosen] - centre[group], axis=1) + outline.radius[chosen]
    radius = np.maximum.reduceat(reach, starts)
    axis = np.add.reduceat(outline.axis[chosen] * power[:, None], starts)
    around = total - np.linalg.norm(axis, axis=1) + ASIDE * total
    return np.column_stack([centre, np.square(radius), axis, around])
