"""Many emitter elements in few patches: within a patch, one is chosen by power, distance and orientation.

The patches and the choice within them form a tree of bounding spheres with many children (Walter et al. 2005,
"Lightcuts"; the choice follows Conty Estevez & Kulla 2018, "Importance sampling of many lights with adaptive tree
splitting", doi:10.1145/3233305, with a mean normal in place of their cones). All children of a node are compared with
each other: if they are small lamps, the choice is as good as if each lamp were listed separately. Occlusion is known
only for a patch as a whole, from the records.
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
"""Minimum fraction of its power that counts for a node that faces away or lies behind the surface: shading normals may
differ from those of the bounds."""

WIDTH = 16
"""Children of a node, a power of two: about the number of lamps per patch if a scene has a thousand in 64 patches.
Every sample evaluates each child."""

POINT = 1e-6
"""Minimum radius of a node, metres: bounds the weight of a point lamp at its own position."""

ROOT = 0xFFFFFFFF
"""Parent of a node that is a patch."""


class Clusters:
    """Patches of elements.

    Attributes:
        count: number of patches.
        patch_of: (E,) patch of each element.
        single: whether each patch is a single element, of the same number.
    """

    def __init__(self, outline: Outline, patches: int) -> None:
        """Divide the elements.

        Args:
            outline: of E elements.
            patches: maximum number of patches; more than 2.
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
        """Divide the groups level by level; the children of a node are consecutive."""
        order = np.concatenate(groups)
        end = np.cumsum([len(group) for group in groups])
        begin = np.concatenate([[0], end[:-1]])
        parent = np.full(len(groups), ROOT, np.int64)
        bounds, parents, firsts, counts = [], [], [], []
        leaf = np.zeros(len(order), np.int64)
        total = 0  # nodes of the previous levels
        while len(begin):
            nodes = total + np.arange(len(begin))
            total += len(begin)
            bounds.append(_bounds(outline, order, begin, end))
            parents.append(parent)
            single = end - begin == 1
            leaf[order[begin[single]]] = nodes[single]
            # A leaf has no children; the number of its element takes the place of its first child.
            first, count = np.where(single, order[begin], 0), np.zeros(len(begin), np.int64)
            order, owner, begin, end = _children(outline, order, begin[~single], end[~single])
            count[~single] = np.bincount(owner, minlength=int((~single).sum()))
            first[~single] = total + np.cumsum(count[~single]) - count[~single]
            parent = nodes[~single][owner]
            firsts.append(first)
            counts.append(count)
        tables = np.concatenate(bounds)
        self._sphere = upload(mi.Float, tables[:, :4].astype(np.float32).ravel())
        self._power = upload(mi.Float, tables[:, 4:].astype(np.float32).ravel())
        numbers = (
            np.concatenate(firsts),
            np.concatenate(counts),
            np.concatenate(parents),
            leaf,
            self.patch_of,
        )
        self._first, self._count, self._parent, self._leaf, self._patch = (
            upload(mi.UInt32, number.astype(np.uint32)) for number in numbers
        )

    def arrays(self) -> list[mi.Float]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        if self.single:
            return []
        return [self._sphere, self._power, self._first, self._count, self._parent, self._leaf, self._patch]

    @dr.syntax
    def choose(
        self, patch: mi.UInt32, si: mi.SurfaceInteraction3f, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Choose an element of a patch.

        Args:
            patch: number of the patch.
            si: the surface to be lit.
            sample: in [0, 1).
            active: lanes.

        Returns:
            The element, the probability of choosing it, and the sample, rescaled for reuse.
        """
        if dr.hint(self.single, mode="scalar"):
            return patch, mi.Float(1), sample
        p, n = si.p, mi.Vector3f(facing_normal(si))
        sample, share = mi.Float(sample), mi.Float(1)
        first = dr.gather(mi.UInt32, self._first, patch, active)
        count = dr.gather(mi.UInt32, self._count, patch, active)
        while count > 0:
            child, end, node = mi.UInt32(first), first + count, mi.UInt32(first)
            total, chosen = mi.Float(0), mi.Float(1)
            while child < end:
                # Reservoir sampling: a child replaces the earlier ones with probability weight / total.
                weight = self._importance(child, p, n, child < end)
                before, total = total, total + weight
                sample = sample * total
                taken = sample < weight
                sample = dr.select(taken, sample, sample - weight) / dr.select(taken, weight, before)
                sample = dr.clip(sample, 0, 1 - 2**-24)
                node = dr.select(taken, child, node)
                chosen = dr.select(taken, weight, chosen)
                child += 1
            # Descend to the children of the chosen one.
            share *= chosen / total
            first = dr.gather(mi.UInt32, self._first, node, count > 0)
            count = dr.gather(mi.UInt32, self._count, node, count > 0)
        return first, share, sample

    @dr.syntax
    def probability(
        self, element: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Float]:
        """The patch of an element, and the probability of choosing it there; see `choose`."""
        if dr.hint(self.single, mode="scalar"):
            return element, mi.Float(1)
        p, n = si.p, mi.Vector3f(facing_normal(si))
        share = mi.Float(1)
        node = dr.gather(mi.UInt32, self._leaf, element, active)
        parent = dr.gather(mi.UInt32, self._parent, node, active)
        going = active & (parent != ROOT)
        while going:
            child = dr.gather(mi.UInt32, self._first, parent, going)
            end = child + dr.gather(mi.UInt32, self._count, parent, going)
            total, chosen = mi.Float(0), mi.Float(0)
            while child < end:
                weight = self._importance(child, p, n, child < end)
                total += weight
                chosen = dr.select(child == node, weight, chosen)
                child += 1
            share *= chosen / total
            node = parent
            parent = dr.gather(mi.UInt32, self._parent, node, going)
            going &= parent != ROOT
        return dr.gather(mi.UInt32, self._patch, element, active), share

    def _importance(self, node: mi.UInt32, p: mi.Point3f, n: mi.Vector3f, active: mi.Bool) -> mi.Float:
        sphere = dr.gather(mi.Vector4f, self._sphere, node, active)
        power = dr.gather(mi.Vector4f, self._power, node, active)
        offset = mi.Vector3f(sphere.x - p.x, sphere.y - p.y, sphere.z - p.z)
        squared = dr.squared_norm(offset)
        within = squared < dr.square(sphere.w)
        # Distances are at least the radius of the sphere. Within the sphere, neither the orientation of the emitters
        # nor what lies behind the surface is known.
        closeness = dr.rcp(dr.maximum(squared, dr.square(sphere.w)))
        near = dr.sqrt(closeness)
        facing = mi.Vector3f(power.x, power.y, power.z)
        ahead = dr.select(within, dr.norm(facing), dr.maximum(-dr.dot(facing, offset) * near, 0)) + power.w
        cosine = dr.clip(dr.maximum(dr.dot(n, offset) * near, 0) + sphere.w * near + ASIDE, 0, 1)
        return ahead * cosine * closeness


def facing_normal(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """The shading normal on the side from which a surface was hit."""
    return mi.Normal3f(dr.select(si.wi.z < 0, -si.sh_frame.n, si.sh_frame.n))


def _children(
    outline: Outline, order: Indices, begin: Indices, end: Indices
) -> tuple[Indices, Indices, Indices, Indices]:
    """Divide groups from `begin` to `end` into single elements or into WIDTH parts.

    Returns:
        The order of the elements; for each child, the group that it belongs to, and where it begins and ends.
    """
    owner = np.arange(len(begin))
    few = end - begin <= WIDTH
    for _ in range(WIDTH.bit_length() - 1):
        order = _sorted(outline, order, begin[~few[owner]], end[~few[owner]])
        middle = np.where(few[owner], end, (begin + end) // 2)
        begin, end = (np.stack(pair, axis=1).ravel() for pair in ((begin, middle), (middle, end)))
        owner = np.repeat(owner, 2)
        kept = end > begin
        owner, begin, end = owner[kept], begin[kept], end[kept]
    count = np.where(few[owner], end - begin, 1)
    single = few[owner]
    owner, single = np.repeat(owner, count), np.repeat(single, count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    begin, end = np.repeat(begin, count) + number, np.repeat(end, count)
    return order, owner, begin, np.where(single, begin + 1, end)


def _groups(outline: Outline, patches: int) -> list[Indices]:
    """Patches: the group with the largest gain is halved until there are enough. Emitters at infinity are separate."""
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
    """Gain of dividing a group: power times width."""
    if len(group) < 2:
        return -1.0
    width = np.linalg.norm(np.ptp(outline.centre[group], axis=0)) + outline.radius[group].max()
    return float(outline.power[group].sum() * width)


def _middle(power: Doubles) -> int:
    """Number of leading elements that have half of the power; at least one, and not all."""
    total = np.cumsum(power)
    return int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(power) - 1))


def _sorted(outline: Outline, order: Indices, begin: Indices, end: Indices) -> Indices:
    """The elements, sorted within each group from `begin` to `end` along the group's longest axis."""
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
    """Of each group, (G, 8): centre, radius, intensity along its mean normal, and in all directions, W/sr."""
    rows = np.concatenate([np.arange(*pair) for pair in zip(begin, end, strict=True)])
    starts = np.cumsum(end - begin) - (end - begin)
    group = np.repeat(np.arange(len(begin)), end - begin)
    chosen = order[rows]
    power = outline.power[chosen]
    total = np.add.reduceat(power, starts)
    centre = np.add.reduceat(outline.centre[chosen] * power[:, None], starts) / total[:, None]
    reach = np.linalg.norm(outline.centre[chosen] - centre[group], axis=1) + outline.radius[chosen]
    radius = np.maximum(np.maximum.reduceat(reach, starts), POINT)
    axis = np.add.reduceat(outline.axis[chosen] * power[:, None], starts)
    around = total - np.linalg.norm(axis, axis=1) + ASIDE * total
    return np.column_stack([centre, radius, axis, around])
