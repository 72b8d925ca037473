"""What a kernel must know about the BSDFs of a scene: which lobes they have, and how each can be sampled.

The cache answers for diffuse lobes, so kernels treat these apart from all others. Two more kinds of BSDF are worth
knowing. A *specular layer* over a diffuse base (plastic, roughplastic) is sampled alone where the cache and emitter
samples know all that the base returns. A *delta dielectric* (dielectric, thindielectric) is left both ways, by what it
reflects and what it transmits, so that neither is left to chance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.sampling import Purpose, VertexSamples

# Bits of mi.BSDFFlags: the flags of a lane are a plain integer.
OTHER_FLAGS = 0x1F9
"""All lobe types but the two diffuse ones."""

GLOSSY_FLAGS = 0x18
"""Glossy reflection and transmission."""

NOT_DIFFUSE_REFLECTION = OTHER_FLAGS | 0x4
"""All lobe types but diffuse reflection."""

REFLECTED, TRANSMITTED = 0x20, 0x41
"""Delta reflection; delta transmission or null."""

MOST_DIELECTRICS = 4
"""So many delta dielectrics, one behind the other, are left both ways: a double-glazed window has four surfaces."""


@dataclass
class DiffuseLobe:
    """The diffuse lobe of the surface at a vertex.

    Attributes:
        active: lanes that have one which is not black.
        albedo: fraction of the irradiance that leaves towards the viewer; times E / pi it is radiance.
        normal: unit, world, on the side where the irradiance arrives.
        sample: what drew the albedo: a BSDF sample of the diffuse lobe.
        inseparable: reflectance, where the BSDF cannot evaluate one lobe alone; 0 elsewhere.
    """

    active: mi.Bool
    albedo: mi.Color3f
    normal: mi.Normal3f
    sample: mi.BSDFSample3f
    inseparable: mi.Color3f


@dataclass
class Choice:
    """Which lobes are sampled, where it is not left to the BSDF.

    Attributes:
        layer: only the specular layer.
        base: only the diffuse base under it.
        dielectric: a delta dielectric, which is left one way.
        reflected: ... by reflection; else by transmission.
    """

    layer: mi.Bool
    base: mi.Bool
    dielectric: mi.Bool
    reflected: mi.Bool


class BSDFTraits:
    """What a kernel must know about the BSDFs of a scene before it is compiled.

    Each table is a Bool by number of the BSDF instance; None where no BSDF of the scene is of that kind, so that
    kernels can leave out what serves it.

    Attributes:
        only_diffuse: no BSDF has another lobe than diffuse reflection.
        glossy: whether some BSDF has a rough lobe that is not diffuse.
        random_transparency: whether some BSDF other than delta dielectrics lets light through, or not, by chance.
        layered: table of diffuse bases under a specular layer (plastic, roughplastic).
        dielectric: table of delta dielectrics (dielectric, thindielectric).
    """

    def __init__(self, scene: mi.Scene) -> None:
        bsdfs = {shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}

        def some(test: Callable[[mi.BSDF], bool]) -> list[mi.BSDF]:
            return [bsdf for bsdf in bsdfs if test(bsdf)]

        not_diffuse = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
        self.only_diffuse = not some(lambda bsdf: bool(int(bsdf.flags()) & not_diffuse))
        self.glossy = bool(some(lambda bsdf: bool(int(bsdf.flags()) & GLOSSY_FLAGS)))
        self.layered = _table(bsdfs, some(_is_layered))
        dielectrics = some(_is_delta_dielectric)
        self.dielectric = _table(bsdfs, dielectrics)
        self.random_transparency = any(
            int(bsdf.flags()) & TRANSMITTED for bsdf in bsdfs if bsdf not in dielectrics
        )
        # BSDFs that do not heed the mask of lobes: a mask can evaluate one lobe alone, but not sample it; principled
        # can do neither, and nothing tells how much diffuse light principledthin transmits: that is left to rays.
        strays = some(lambda bsdf: not _separates_lobes(bsdf))
        masks = [bsdf for bsdf in strays if int(bsdf.flags()) & int(mi.BSDFFlags.Null)]
        inseparable = [bsdf for bsdf in strays if bsdf not in masks]
        through = int(mi.BSDFFlags.DiffuseTransmission)
        self._masks = _table(bsdfs, masks)
        self._inseparable = _table(bsdfs, inseparable)
        self._transmitting = _table(bsdfs, [bsdf for bsdf in inseparable if int(bsdf.flags()) & through])

    @property
    def branching(self) -> bool:
        """Whether camera paths are left in several directions at some surface."""
        return self.glossy or self.layered is not None or self.dielectric is not None

    def is_layered(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether BSDFs are a diffuse base under a specular layer; False where not active."""
        return _is_one(self.layered, bsdf, active)

    def is_dielectric(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether BSDFs are delta dielectrics; False where not active."""
        return _is_one(self.dielectric, bsdf, active)

    def diffuse_lobe(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, numbers: VertexSamples, active: mi.Bool
    ) -> DiffuseLobe:
        """The diffuse lobe at surface points, on the side from which light reaches the viewer.

        Args:
            si: where.
            bsdf: `si.bsdf()`.
            numbers: random numbers of the vertex; albedo under a specular layer is an estimate.
            active: lanes.
        """
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        lobe, direction = numbers.sample_1d(Purpose.DIFFUSE_CHOICE), numbers.sample_2d(Purpose.DIFFUSE_LOBE)
        sample, albedo = bsdf.sample(diffuse_context(), si, lobe, direction, active)
        side = si.wi.z if self.only_diffuse else sample.wo.z
        inseparable = mi.Color3f(0)
        if self._masks is not None:
            masked = _is_one(self._masks, bsdf, active)
            wo = mi.warp.square_to_cosine_hemisphere(numbers.sample_2d(Purpose.MASK))
            wo.z = dr.mulsign(wo.z, si.wi.z)
            value = bsdf.eval(diffuse_context(), si, wo, masked)
            albedo = dr.select(masked, value * dr.pi / dr.maximum(dr.abs(wo.z), 1e-6), albedo)
            side = dr.select(masked, si.wi.z, side)
        if self._inseparable is not None:
            whole = _is_one(self._inseparable, bsdf, active)
            rho = bsdf.eval_diffuse_reflectance(si, whole)
            rho = dr.select(_is_one(self._transmitting, bsdf, active), 0, rho)
            inseparable = dr.select(whole, rho, inseparable)
            albedo = dr.select(whole, rho, albedo)
            side = dr.select(whole, si.wi.z, side)
        albedo = dr.select(active, albedo, 0)
        normal = mi.Normal3f(si.sh_frame.n * dr.select(side < 0, mi.Float(-1), mi.Float(1)))
        lit = active if self.only_diffuse else active & dr.any(albedo != 0)
        return DiffuseLobe(lit, albedo, normal, sample, inseparable)

    def other_lobes(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        wo: mi.Vector3f,
        diffuse: DiffuseLobe,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Value times cosine of all but the diffuse lobe, for a direction `wo` in the local frame."""
        value = bsdf.eval(other_context(), si, wo, active)
        if self._inseparable is None:
            return value
        return value - diffuse.inseparable * dr.inv_pi * dr.abs(wo.z)

    def sample(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        numbers: VertexSamples,
        choice: Choice,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        """Sample BSDFs: one lobe where that is chosen, else all of them.

        Args:
            si: where.
            bsdf: `si.bsdf()`.
            numbers: random numbers of the vertex.
            choice: of lobes.
            active: lanes.

        Returns:
            The sample and its weight, value times cosine over density; for a delta dielectric, the fraction of the
            light that goes the chosen way, 0 if none does.
        """
        lobe, direction = numbers.sample_1d(Purpose.LOBE), numbers.sample_2d(Purpose.DIRECTION)
        whole = active if self.layered is None else active & ~choice.layer & ~choice.base
        if self.dielectric is None:
            bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction, whole)
        else:
            # See `_is_delta_dielectric`: the first random number decides, and the density is the fraction.
            way = dr.select(choice.reflected, mi.Float(0), dr.one_minus_epsilon(mi.Float))
            lobe = dr.select(choice.dielectric, way, lobe)
            bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction, whole)
            as_chosen = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection) == choice.reflected
            weight = dr.select(choice.dielectric, dr.select(as_chosen, weight * bs.pdf, 0), weight)
        if self.layered is not None:
            for context, chosen in ((other_context(), choice.layer), (diffuse_context(), choice.base)):
                bs_one, weight_one = bsdf.sample(context, si, lobe, direction, active & chosen)
                bs, weight = dr.select(chosen, bs_one, bs), dr.select(chosen, weight_one, weight)
        return bs, weight


def _table(bsdfs: Iterable[mi.BSDF], some: Sequence[mi.BSDF]) -> mi.Bool | None:
    """For each BSDF instance, by its number, whether it is one of some; None if there are none."""
    if not some:
        return None
    numbers = {bsdf: int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs}
    table = [False] * (max(numbers.values()) + 1)
    for bsdf in some:
        table[numbers[bsdf]] = True
    return mi.Bool(table)


def _is_one(table: mi.Bool | None, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
    """What a table says of BSDFs; False where not active."""
    if table is None:
        return mi.Bool(False)
    return dr.gather(mi.Bool, table, dr.reinterpret_array(mi.UInt32, bsdf), active)


def _separates_lobes(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF with a diffuse lobe heeds the mask of lobes: tested by sampling its diffuse lobe alone."""
    flags = int(bsdf.flags())
    diffuse = int(mi.BSDFFlags.Diffuse)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse):
        return True
    si, samples, squares = _probe()
    drawn, weight = bsdf.sample(diffuse_context(), si, samples, squares)
    strayed = dr.any(weight != 0) & ~mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Diffuse)
    return not dr.any(strayed)


def _is_layered(bsdf: mi.BSDF) -> bool:
    """Whether the other lobes of a BSDF with a diffuse one can be sampled alone: tested by doing so.

    Mixtures (blendbsdf, mask) choose between what they mix first, and are left to that.
    """
    flags = int(bsdf.flags())
    diffuse, through = int(mi.BSDFFlags.DiffuseReflection), int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse) or flags & through:
        return False
    si, samples, squares = _probe()
    base, _ = bsdf.sample(diffuse_context(), si, samples, squares)
    drawn, weight = bsdf.sample(other_context(), si, samples, squares)
    strayed = (drawn.sampled_type == 0) | mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Diffuse)
    if dr.any(strayed) or not dr.allclose(base.pdf, cosine_pdf(si.wi, base.wo), rtol=0.01):
        return False
    if dr.all(mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)):
        return True
    value, pdf = bsdf.eval_pdf(other_context(), si, drawn.wo)
    same = (dr.abs(pdf - drawn.pdf) <= 0.01 * drawn.pdf) & dr.all(
        dr.abs(value - weight * pdf) <= 0.01 * value
    )
    return bool(dr.all(same | dr.all(weight == 0)))  # no light from below the horizon


def _is_delta_dielectric(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF only reflects and transmits without scattering, as its first random number says: 0 to reflect.

    The fraction of the light that goes either way must then be the weight times the density: tested by sampling either
    lobe alone.
    """
    lobes = int(bsdf.flags()) & int(mi.BSDFFlags.All)
    if not (lobes & REFLECTED and lobes & TRANSMITTED) or lobes & ~(REFLECTED | TRANSMITTED):
        return False
    si, samples, squares = _probe()
    for lobe, chosen in ((REFLECTED, mi.Float(0)), (TRANSMITTED, dr.one_minus_epsilon(mi.Float))):
        context = mi.BSDFContext()
        drawn, weight = bsdf.sample(context, si, dr.repeat(mi.Float(chosen), 64), squares)
        context.type_mask = lobe
        alone, part = bsdf.sample(context, si, samples, squares)
        same = dr.all(drawn.sampled_type == alone.sampled_type) & dr.allclose(drawn.wo, alone.wo)
        if not same or not dr.allclose(weight * drawn.pdf, part, rtol=1e-3):
            return False
    return True


def _probe() -> tuple[mi.SurfaceInteraction3f, mi.Float, mi.Point2f]:
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


def diffuse_context() -> mi.BSDFContext:
    """Context in which a BSDF shows its diffuse lobe alone."""
    context = mi.BSDFContext()
    context.type_mask = int(mi.BSDFFlags.Diffuse)
    return context


def other_context() -> mi.BSDFContext:
    """Context in which a BSDF shows all but its diffuse lobe."""
    context = mi.BSDFContext()
    context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    return context


def cosine_pdf(wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Float:
    """Density of a direction that is drawn from a diffuse lobe which reflects, 1/sr; local frame."""
    return dr.select(wi.z * wo.z > 0, dr.abs(wo.z) * dr.inv_pi, 0)
