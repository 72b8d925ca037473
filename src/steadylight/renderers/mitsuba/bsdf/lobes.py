"""What a kernel must know about the BSDFs of a scene: which lobes they have, and how each can be sampled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr

import mitsuba as mi

OTHER_FLAGS = 0x1F9
"""All lobe types of mi.BSDFFlags but the two diffuse ones, as bits: the flags of a lane are a plain integer."""

GLOSSY_FLAGS = 0x18
"""mi.BSDFFlags.Glossy, as bits."""

NOT_REFLECTED = OTHER_FLAGS | 0x4
"""All lobe types but diffuse reflection: OTHER_FLAGS and mi.BSDFFlags.DiffuseTransmission."""

MIRRORED, CLEAR = 0x20, 0x41
"""mi.BSDFFlags.DeltaReflection; DeltaTransmission or Null; as bits."""

PANES = 4
"""So many surfaces of clear glass, one behind the other, are left both ways: by what they let through, and mirror."""

LEFT = 0xFFFFFFFF
"""Counts of surfaces that visits share end with this, where their paths have parted."""


class BSDFTraits:
    """What a kernel must know about the BSDFs of a scene before it is compiled.

    Attributes:
        only_diffuse: no BSDF has another lobe than diffuse reflection, so that the kernel can leave out all that
            serves the others.
        some_whole: some BSDFs (principled) cannot evaluate one lobe alone.
        whole: Bool table over BSDF instances: which ones.
        through: Bool table: which of these (principledthin) let diffuse light through; nothing tells how much, so
            that they are followed by rays, without the cache.
        some_glossy: some BSDFs have a rough lobe that is not diffuse.
        some_coated: some BSDFs are a diffuse base under a coat (plastic, roughplastic).
        coated: Bool table over BSDF instances: which ones.
        some_panes: some BSDFs do nothing but mirror, and let through without scattering (dielectric, thindielectric).
        panes: Bool table: which ones.
        some_chance: some BSDFs other than panes let light through without scattering it, or not, by chance.
        some_masks: some BSDFs (mask) evaluate one lobe alone, but cannot sample it.
        masks: Bool table: which ones.
    """

    def __init__(self, scene: Any) -> None:
        bsdfs = {shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}
        lobes = int(mi.BSDFFlags.All)
        self.only_diffuse = all(
            (int(bsdf.flags()) & lobes & ~int(mi.BSDFFlags.DiffuseReflection)) == 0 for bsdf in bsdfs
        )
        self.some_glossy = any(int(bsdf.flags()) & GLOSSY_FLAGS for bsdf in bsdfs)
        coated = [bsdf for bsdf in bsdfs if _has_coat(bsdf)]
        self.some_coated = bool(coated)
        if coated:
            self.coated = _table(bsdfs, coated)
        panes = [bsdf for bsdf in bsdfs if _is_pane(bsdf)]
        self.some_panes = bool(panes)
        if panes:
            self.panes = _table(bsdfs, panes)
        self.some_chance = any(int(bsdf.flags()) & CLEAR for bsdf in bsdfs if bsdf not in panes)
        strays = [bsdf for bsdf in bsdfs if not _separates_lobes(bsdf)]
        masks = [bsdf for bsdf in strays if int(bsdf.flags()) & int(mi.BSDFFlags.Null)]
        whole = [bsdf for bsdf in strays if bsdf not in masks]
        through = [bsdf for bsdf in whole if int(bsdf.flags()) & int(mi.BSDFFlags.DiffuseTransmission)]
        self.some_whole, self.some_masks = bool(whole), bool(masks)
        if strays:
            self.whole, self.through, self.masks = (_table(bsdfs, some) for some in (whole, through, masks))

    def pane(self, bsdf: Any, visit: Any, met: Any, active: Any) -> tuple[Any, Any]:
        """Whether a surface is one of the first PANES panes on a way, and which of both ways a visit leaves it.

        The first visit passes through all of them, the next is mirrored by the first, the one after that by the second.

        Args:
            bsdf: BSDFPtr.
            visit: UInt32, number of the visit.
            met: UInt32, panes that it has passed through; LEFT once it has been mirrored, or met something else.
            active: Bool.

        Returns:
            Bool, whether it is such a pane, and Bool, whether this visit is the one that it mirrors.
        """
        pane = active & (met < PANES) & _is_one(self.panes, bsdf, active)
        return pane, pane & (visit == met + 1)

    def coat(self, bsdf: Any, active: Any) -> Any:
        """Bool, whether BSDFs (BSDFPtr) are a base under a coat; False where not active."""
        return _is_one(self.coated, bsdf, active)

    def sample(
        self,
        bsdf: Any,
        si: Any,
        lobe: Any,
        direction: Any,
        active: Any,
        coated: Any,
        pane: Any,
        mirrored: Any,
    ) -> tuple[Any, Any]:
        """Sample BSDFs: a coat apart from its base, a pane in one of its two ways, any other among all its lobes.

        Args:
            bsdf: BSDFPtr.
            si: SurfaceInteraction3f.
            lobe: Float, random number in [0, 1).
            direction: Point2f, two more.
            active: Bool, which lanes to sample.
            coated: Bool, lanes where only the coat is to be sampled.
            pane: Bool, lanes where it is decided what a pane does.
            mirrored: Bool, what: it mirrors; else it lets through.

        Returns:
            BSDFSample3f, and Color3f, its weight: value times cosine over density; for a pane, the part of the light
            that goes this way, 0 if none does.
        """
        ctx = mi.BSDFContext()
        if not self.some_panes:
            bs, weight = bsdf.sample(ctx, si, lobe, direction, active & ~coated)
        else:
            # See `_is_pane`: the first random number decides, and the density is the part.
            lobe = dr.select(pane, dr.select(mirrored, mi.Float(0), dr.one_minus_epsilon(mi.Float)), lobe)
            bs, weight = bsdf.sample(ctx, si, lobe, direction, active & ~coated)
            as_asked = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection) == mirrored
            weight = dr.select(pane, dr.select(as_asked, weight * bs.pdf, 0), weight)
        if self.some_coated:
            bs_coat, of_coat = bsdf.sample(other_lobes(), si, lobe, direction, active & coated)
            bs, weight = dr.select(coated, bs_coat, bs), dr.select(coated, of_coat, weight)
        return bs, weight


def _table(bsdfs: Iterable[Any], some: Sequence[Any]) -> Any:
    """Bool for each BSDF instance, by its number: whether it is one of some."""
    numbers = {bsdf: int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs}
    table = [False] * (max(numbers.values()) + 1)
    for bsdf in some:
        table[numbers[bsdf]] = True
    return mi.Bool(table)


def _is_one(table: Any, bsdf: Any, active: Any) -> Any:
    """Bool, what such a table says of BSDFs (BSDFPtr); False where not active."""
    return dr.gather(mi.Bool, table, dr.reinterpret_array(mi.UInt32, bsdf), active)


def _separates_lobes(bsdf: Any) -> bool:
    """Whether a BSDF with a diffuse lobe heeds the lobe mask: asked by sampling its diffuse lobe alone."""
    flags = int(bsdf.flags())
    diffuse = int(mi.BSDFFlags.Diffuse)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse):
        return True
    si, samples, squares = _probe()
    drawn, weight = bsdf.sample(diffuse_lobe(), si, samples, squares)
    strayed = dr.any(weight != 0) & ~mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Diffuse)
    return not dr.any(strayed)


def _has_coat(bsdf: Any) -> bool:
    """Whether the other lobes of a BSDF with a diffuse one can be sampled alone: asked by doing so.

    Mixtures (blendbsdf, mask) choose between what they mix first, and are left to that.
    """
    flags = int(bsdf.flags())
    diffuse, through = int(mi.BSDFFlags.DiffuseReflection), int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse) or flags & through:
        return False
    si, samples, squares = _probe()
    base, _ = bsdf.sample(diffuse_lobe(), si, samples, squares)
    drawn, weight = bsdf.sample(other_lobes(), si, samples, squares)
    strayed = (drawn.sampled_type == 0) | mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Diffuse)
    if dr.any(strayed) or not dr.allclose(base.pdf, cosine_pdf(si.wi, base.wo), rtol=0.01):
        return False
    if dr.all(mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)):
        return True
    value, pdf = bsdf.eval_pdf(other_lobes(), si, drawn.wo)
    same = (dr.abs(pdf - drawn.pdf) <= 0.01 * drawn.pdf) & dr.all(
        dr.abs(value - weight * pdf) <= 0.01 * value
    )
    return bool(dr.all(same | dr.all(weight == 0)))  # no light from below the horizon


def _is_pane(bsdf: Any) -> bool:
    """Whether a BSDF only mirrors and lets through, and its first random number chooses: 0 to mirror, 1 to let through.

    The part of the light that goes either way must then be the weight times the density: asked by sampling either lobe
    alone.
    """
    lobes = int(bsdf.flags()) & int(mi.BSDFFlags.All)
    if not (lobes & MIRRORED and lobes & CLEAR) or lobes & ~(MIRRORED | CLEAR):
        return False
    si, samples, squares = _probe()
    for lobe, chosen in ((MIRRORED, mi.Float(0)), (CLEAR, dr.one_minus_epsilon(mi.Float))):
        ctx = mi.BSDFContext()
        drawn, weight = bsdf.sample(ctx, si, dr.repeat(mi.Float(chosen), 64), squares)
        ctx.type_mask = lobe
        alone, part = bsdf.sample(ctx, si, samples, squares)
        same = dr.all(drawn.sampled_type == alone.sampled_type) & dr.allclose(drawn.wo, alone.wo)
        if not same or not dr.allclose(weight * drawn.pdf, part, rtol=1e-3):
            return False
    return True


def _probe() -> tuple[Any, Any, Any]:
    """A place on a surface, seen obliquely 64 times, and the random numbers to sample its BSDF with."""
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.t = mi.Float(1)
    si.wi = dr.normalize(mi.Vector3f(0.3, 0.2, 0.9))
    samples = (dr.arange(mi.Float, 64) + 0.5) / 64
    si.uv = mi.Point2f(samples, 0.37)  # a texture may mix what is alike in one place only
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    return si, samples, mi.Point2f(samples, 0.37)


def diffuse_lobe() -> Any:
    """Context in which a BSDF shows its diffuse lobe alone."""
    ctx = mi.BSDFContext()
    ctx.type_mask = int(mi.BSDFFlags.Diffuse)
    return ctx


def other_lobes() -> Any:
    """Context in which a BSDF shows all but its diffuse lobe."""
    ctx = mi.BSDFContext()
    ctx.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    return ctx


def cosine_pdf(wi: Any, wo: Any) -> Any:
    """Density of a direction that is drawn from a diffuse lobe which reflects, 1/sr; local frame."""
    return dr.select(wi.z * wo.z > 0, dr.abs(wo.z) * dr.inv_pi, 0)
