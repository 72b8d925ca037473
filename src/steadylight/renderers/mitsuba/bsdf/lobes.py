"""Properties of the BSDFs of a scene that kernels need: which lobes they have, and how each can be sampled.

The cache serves diffuse lobes, so kernels treat these separately from all others. Two kinds of BSDF get special
treatment. A *specular layer* over a diffuse base (plastic, roughplastic) is sampled alone where the cache and emitter
samples provide all that the base returns. At a *delta dielectric* (dielectric, thindielectric), paths branch into
reflection and transmission, so that the choice is not left to chance.

Some BSDFs cannot evaluate one lobe alone (principled, principledthin). For these, the cache serves a Lambertian part
about as bright as the BSDF in its dimmest directions, and rays collect the rest of the BSDF. The mean is correct for
any such part; the dimmer the rest, the lower the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.renderers.mitsuba.bsdf.base_transmittance import BaseTransmittance
from steadylight.renderers.mitsuba.bsdf.casters import Casters
from steadylight.renderers.mitsuba.bsdf.tables import is_in, table_of
from steadylight.renderers.mitsuba.sampling import Draw, Purpose, VertexSamples

# Bits of mi.BSDFFlags: in a kernel, the flags of a lane are a plain integer.
OTHER_FLAGS = 0x1F9
"""All lobe types except the two diffuse ones."""

GLOSSY_FLAGS = 0x18
"""Glossy reflection and transmission."""

NOT_DIFFUSE_REFLECTION = OTHER_FLAGS | 0x4
"""All lobe types except diffuse reflection."""

REFLECTED, TRANSMITTED = 0x20, 0x41
"""Delta reflection; delta transmission or null."""

PROBES = ((90.0, 55.0), (-90.0, 55.0), (0.0, 40.0))
"""Directions in which a BSDF that cannot evaluate one lobe alone is probed: azimuth from the view direction, and angle
to the normal, degrees. None is near the mirror direction, or so near the horizon that grazing gloss begins."""

FAINT = 1e-3
"""Reflectance below which a Lambertian part is not worth a look-up: the BSDF is left to rays entirely."""

UNEVEN, MIXTURES = ("BumpMap", "NormalMap"), ("MaskBSDF", "BlendBSDF")
"""Mitsuba classes that perturb the normal, and those that choose between BSDFs."""

BREAKING = ("MeshAttribute", "Instance")
"""Mitsuba classes that return NaN in degenerate triangles."""

UPRIGHT = 0.05
"""Minimum cosine between a mapped normal and the surface's own; below it, the diffuse lobe is not turned."""

MOST_DIELECTRICS = 4
"""Maximum number of consecutive delta dielectrics where a path branches: a double-glazed window has four surfaces."""


@dataclass
class DiffuseLobe:
    """The diffuse lobe of the surface at a vertex.

    Attributes:
        active: lanes with a diffuse lobe that a cache can serve: not black, and not `turned`.
        turned: lanes where the interpolated normal of a smooth mesh faces away, although its triangle is visible. As in
            Mitsuba, such a surface scatters what comes from behind this normal. That is partly the inside of the
            object, whose records might be those of something beside it.
        albedo: fraction of the irradiance that is scattered towards the viewer; times E / pi it is radiance.
        normal: unit, world, on the side of the incident irradiance.
        sample: BSDF sample of the diffuse lobe that estimated the albedo.
        whole: lanes whose BSDF cannot evaluate one lobe alone: `albedo` is of a part that rays must not collect again.
        facing: unit, world: normal that a bump map or a normal map gives to the lobe; None without these.
    """

    active: mi.Bool
    turned: mi.Bool
    albedo: mi.Color3f
    normal: mi.Normal3f
    sample: mi.BSDFSample3f
    whole: mi.Bool
    facing: mi.Normal3f | None = None


@dataclass
class Choice:
    """Which lobes to sample, unless the choice is left to the BSDF.

    Attributes:
        layer: only the specular layer.
        base: only the diffuse base under it.
        dielectric: only one of the two lobes of a delta dielectric.
        reflected: ... namely reflection; else transmission.
    """

    layer: mi.Bool
    base: mi.Bool
    dielectric: mi.Bool
    reflected: mi.Bool


class BSDFTraits:
    """Properties of the BSDFs of a scene that kernels need before they are compiled.

    Each table is a Bool indexed by BSDF instance; None if the scene has no BSDF of that kind, so that kernels can omit
    the code for it.

    Attributes:
        only_diffuse: whether all BSDFs have diffuse reflection only.
        glossy: whether any BSDF has a rough non-diffuse lobe.
        random_transparency: whether any BSDF other than delta dielectrics transmits light at random.
        layered: table of diffuse bases under a specular layer (plastic, roughplastic).
        base_transmittance: relative transmittance of such layers for incident light; None if there are none.
        dielectric: table of delta dielectrics (dielectric, thindielectric).
        uneven: table of BSDFs that perturb the surface normal (bumpmap, normalmap).
        casters: shapes whose caustics photons carry.
    """

    def __init__(self, scene: mi.Scene) -> None:
        nodes = list(mi.traverse(scene).hierarchy)
        bsdfs = bsdfs_of(nodes)
        self._breaks = any(node.class_name() in BREAKING for node in nodes)

        def some(test: Callable[[mi.BSDF], bool]) -> list[mi.BSDF]:
            return [bsdf for bsdf in bsdfs if test(bsdf)]

        def has_diffuse(bsdf: mi.BSDF) -> bool:
            return bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection))

        not_diffuse = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.DiffuseReflection)
        self.only_diffuse = not some(lambda bsdf: bool(int(bsdf.flags()) & not_diffuse))
        self.glossy = bool(some(lambda bsdf: bool(int(bsdf.flags()) & GLOSSY_FLAGS)))
        self.layered = table_of(bsdfs, some(_is_layered))
        dielectrics = some(_is_delta_dielectric)
        self.dielectric = table_of(bsdfs, dielectrics)
        self.random_transparency = any(
            int(bsdf.flags()) & TRANSMITTED for bsdf in bsdfs if bsdf not in dielectrics
        )
        self.uneven = table_of(bsdfs, some(lambda bsdf: _has_part(bsdf, UNEVEN)))
        inseparable = some(_is_inseparable)
        evaluated = [bsdf for bsdf in some(_is_seen_only) if bsdf not in inseparable]
        self._evaluated = table_of(bsdfs, evaluated)
        self._inseparable = table_of(bsdfs, inseparable)
        under = some(lambda bsdf: has_diffuse(bsdf) and bool(int(bsdf.flags()) & not_diffuse))
        apart = [bsdf for bsdf in under if bsdf not in inseparable and not _has_part(bsdf, UNEVEN)]
        self.base_transmittance = BaseTransmittance.of(apart, diffuse_context())
        self.casters = Casters(scene, nodes, bsdfs)

    def arrays(self) -> list[mi.Bool | mi.Float]:
        """All that a kernel reads through this object, for `drjit.freeze`."""
        tables = (self.layered, self.dielectric, self.uneven, self._evaluated, self._inseparable)
        tables += (self.casters.table, self.base_transmittance and self.base_transmittance.table)
        return [table for table in tables if table is not None]

    @property
    def branching(self) -> bool:
        """Whether camera paths branch at any surface."""
        return self.glossy or self.layered is not None or self.dielectric is not None

    def finite(self, value: mi.Color3f) -> mi.Color3f:
        """A value or weight of a BSDF, with NaN and infinity replaced by black.

        Mitsuba's interpolation of mesh attributes divides by zero in triangles a thousand times as long as wide, and
        instances have no normal where a triangle has no area.
        """
        return dr.select(dr.isfinite(value), value, 0) if self._breaks else value

    def is_layered(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether BSDFs are a diffuse base under a specular layer; False in inactive lanes."""
        return is_in(self.layered, bsdf, active)

    def is_dielectric(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether BSDFs are delta dielectrics; False in inactive lanes."""
        return is_in(self.dielectric, bsdf, active)

    def diffuse_lobe(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, numbers: VertexSamples, active: mi.Bool
    ) -> DiffuseLobe:
        """The diffuse lobe at surface points, on the side from which it scatters light to the viewer.

        Args:
            si: the surface.
            bsdf: `si.bsdf()`.
            numbers: random numbers of the vertex; under a specular layer, the albedo is an estimate.
            active: lanes.
        """
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        lobe, direction = numbers.sample_1d(Purpose.DIFFUSE_CHOICE), numbers.sample_2d(Purpose.DIFFUSE_LOBE)
        sample, albedo = bsdf.sample(diffuse_context(), si, lobe, direction, active)
        side = si.wi.z if self.only_diffuse else sample.wo.z
        upright = dr.mulsign(mi.Vector3f(0, 0, 1), si.wi.z)
        whole, towards = mi.Bool(False), None
        if self.uneven is not None:
            towards, along = self._facing(si, bsdf, lobe, active)
            # A sample below the surface is lost. The look-up accounts for the missing part of the hemisphere.
            albedo = dr.select(dr.any(albedo != 0), albedo, along)
            side = dr.select(is_in(self.uneven, bsdf, active), si.wi.z, side)
        if self._evaluated is not None:
            seen = is_in(self._evaluated, bsdf, active)
            axis = upright if towards is None else towards
            drawn = mi.warp.square_to_cosine_hemisphere(numbers.sample_2d(Purpose.MASK))
            wo = mi.Frame3f(mi.Normal3f(axis)).to_world(drawn)
            wo = dr.select(wo.z * si.wi.z > 0, wo, axis)
            value = bsdf.eval(diffuse_context(), si, wo, seen)
            albedo = dr.select(seen, value * dr.pi / dr.maximum(dr.dot(wo, axis), 1e-6), albedo)
            side = dr.select(seen, si.wi.z, side)
        if self._inseparable is not None:
            whole = is_in(self._inseparable, bsdf, active)
            albedo = dr.select(whole, _lambertian_part(si, bsdf, whole), albedo)
            side = dr.select(whole, si.wi.z, side)
        albedo = self.finite(dr.select(active, albedo, 0))
        normal = mi.Normal3f(si.sh_frame.n * dr.select(side < 0, mi.Float(-1), mi.Float(1)))
        turned = active & (dr.dot(si.n, si.to_world(si.wi)) * si.wi.z < 0)
        facing = None if towards is None else mi.Normal3f(si.to_world(dr.select(whole, upright, towards)))
        lit = (active if self.only_diffuse else active & dr.any(albedo != 0)) & ~turned
        if self._breaks:
            lit &= dr.all(dr.isfinite(normal))
        return DiffuseLobe(lit, turned, albedo, normal, sample, whole, facing)

    def _facing(
        self, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, lobe: mi.Float, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Color3f]:
        """Normal of the diffuse lobe, in the local frame, on the visible side, and the albedo in that direction.

        A cosine-weighted lobe maps the centre of the unit square to its own normal.
        """
        uneven = is_in(self.uneven, bsdf, active)
        middle = mi.Point2f(0.5)
        drawn, albedo = bsdf.sample(diffuse_context(), si, lobe, middle, uneven)
        found = uneven & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.DiffuseReflection)
        towards = drawn.wo
        if self._evaluated is not None:
            # A mask is never sampled by its diffuse lobe alone.
            masked = uneven & ~found
            other, _ = bsdf.sample(mi.BSDFContext(), si, mi.Float(0), middle, masked)
            masked &= mi.has_flag(other.sampled_type, mi.BSDFFlags.DiffuseReflection)
            towards, found = dr.select(masked, other.wo, towards), found | masked
        found &= towards.z * si.wi.z > UPRIGHT * dr.abs(si.wi.z)
        return dr.select(found, towards, dr.mulsign(mi.Vector3f(0, 0, 1), si.wi.z)), albedo

    def weight_of_others(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        sample: mi.BSDFSample3f,
        directions: mi.Float | int,
        diffuse: DiffuseLobe,
        active: mi.Bool,
    ) -> mi.Color3f:
        """The part of a sample's weight due to lobes other than the diffuse one; 0 in inactive lanes.

        Args:
            si: the surface.
            bsdf: `si.bsdf()`.
            sample: of the BSDF.
            directions: number of directions in which the path continues; the sample is one of them.
            diffuse: the diffuse lobe of the surface.
            active: lanes.
        """
        if self.only_diffuse:
            return mi.Color3f(0)
        # If a normal map turns the whole lobe below the surface, no direction was sampled, but the value is not 0.
        drawn = active & (sample.pdf > 0)
        value = self._other_lobes(si, bsdf, sample.wo, diffuse, drawn)
        return dr.select(drawn, value / dr.maximum(sample.pdf * directions, 1e-12), 0)

    def _other_lobes(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        wo: mi.Vector3f,
        diffuse: DiffuseLobe,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Value times cosine of all but the diffuse lobe, for a direction `wo` in the local frame."""
        if self._inseparable is None:
            return self.finite(bsdf.eval(other_context(), si, wo, active))
        value = bsdf.eval(other_context(), si, wo, active & ~diffuse.whole)
        # The Lambertian part is zero on the far side. The rest may be negative: clamping it would bias the mean.
        part = diffuse.albedo * dr.inv_pi * dr.select(si.wi.z * wo.z > 0, dr.abs(wo.z), 0)
        rest = bsdf.eval(mi.BSDFContext(), si, wo, active & diffuse.whole) - part
        return self.finite(dr.select(diffuse.whole, rest, value))

    def sample(
        self,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        draw: Draw,
        choice: Choice,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        """Sample BSDFs: a single lobe where `choice` selects one, else all of them.

        Args:
            si: the surface.
            bsdf: `si.bsdf()`.
            draw: random numbers.
            choice: of lobes.
            active: lanes.

        Returns:
            The sample and its weight, value times cosine over density; for a delta dielectric, the fraction of the
            light that the selected lobe carries, 0 if none.
        """
        lobe, direction = draw
        whole = active if self.layered is None else active & ~choice.layer & ~choice.base
        if self.dielectric is None:
            bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction, whole)
        else:
            # See `_is_delta_dielectric`: the first random number selects the lobe, and its density is the fraction.
            way = dr.select(choice.reflected, mi.Float(0), dr.one_minus_epsilon(mi.Float))
            lobe = dr.select(choice.dielectric, way, lobe)
            bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction, whole)
            as_chosen = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection) == choice.reflected
            weight = dr.select(choice.dielectric, dr.select(as_chosen, weight * bs.pdf, 0), weight)
        if self.layered is not None:
            for context, chosen in ((other_context(), choice.layer), (diffuse_context(), choice.base)):
                bs_one, weight_one = bsdf.sample(context, si, lobe, direction, active & chosen)
                bs, weight = dr.select(chosen, bs_one, bs), dr.select(chosen, weight_one, weight)
        return bs, self.finite(weight)


def _lambertian_part(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Color3f:
    """Reflectance of a Lambertian lobe about as bright as a BSDF in its dimmest directions, on the visible side."""
    across = dr.sqrt(dr.square(si.wi.x) + dr.square(si.wi.y))
    slanted = across > 1e-4
    cos_phi = dr.select(slanted, si.wi.x / across, 1)
    sin_phi = dr.select(slanted, si.wi.y / across, 0)
    least = mi.Color3f(dr.inf)
    for azimuth, polar in PROBES:
        turn, tilt = np.radians(azimuth), np.radians(polar)
        x, y, z = (float(v) for v in (np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
        wo = mi.Vector3f(
            cos_phi * x - sin_phi * y, sin_phi * x + cos_phi * y, dr.mulsign(mi.Float(z), si.wi.z)
        )
        least = dr.minimum(least, bsdf.eval(mi.BSDFContext(), si, wo, active) / z)
    reflectance = least * dr.pi
    return dr.select(active & (dr.max(reflectance) > FAINT), reflectance, 0)


def bsdfs_of(nodes: Iterable[mi.Object]) -> list[mi.BSDF]:
    """The BSDFs of all shapes among the nodes of a scene: `scene.shapes()` lacks those in shape groups."""
    shapes = (node for node in nodes if isinstance(node, mi.Shape))
    return list(dict.fromkeys(bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None))


def _parts(bsdf: mi.BSDF) -> list[mi.BSDF]:
    """A BSDF and all BSDFs nested in it."""
    return [node for node in mi.traverse(bsdf).hierarchy if isinstance(node, mi.BSDF)]


def _has_part(bsdf: mi.BSDF, names: Sequence[str]) -> bool:
    """Whether a BSDF is of, or contains, one of these classes."""
    return any(part.class_name() in names for part in _parts(bsdf))


def _leaves(bsdf: mi.BSDF) -> list[mi.BSDF]:
    """Those of `_parts` without nested BSDFs."""
    return [part for part in _parts(bsdf) if len(_parts(part)) == 1]


def _is_inseparable(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF has a diffuse lobe among others, but cannot evaluate it alone.

    The nested BSDFs are tested, since a texture may mix them where the probe does not sample it.
    """
    flags = int(bsdf.flags())
    diffuse = int(mi.BSDFFlags.DiffuseReflection)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse):
        return False
    transmits = bool(flags & int(mi.BSDFFlags.DiffuseTransmission))
    return transmits or not all(_heeds_mask(leaf) for leaf in _leaves(bsdf))


def _heeds_mask(bsdf: mi.BSDF) -> bool:
    """Whether the diffuse lobe of a BSDF and its other lobes, each evaluated alone, sum to the whole BSDF."""
    si, samples, squares = _probe()
    directions = [bsdf.sample(mi.BSDFContext(), si, samples, squares)[0].wo]
    turned = mi.Point2f(samples, (np.arange(64) * 0.6180339887) % 1)
    directions.append(mi.warp.square_to_uniform_sphere(turned))
    heeded = mi.Bool(True)
    for wo in directions:
        value = bsdf.eval(mi.BSDFContext(), si, wo)
        base = bsdf.eval(diffuse_context(), si, wo)
        rest = bsdf.eval(other_context(), si, wo)
        # Black at the probe proves nothing; but no BSDF of Mitsuba that ignores the mask is black everywhere.
        heeded &= dr.all(dr.abs(base + rest - value) <= 1e-3 * value + 1e-7)
    return bool(dr.all(heeded))


def _is_seen_only(bsdf: mi.BSDF) -> bool:
    """Whether the diffuse lobe of a BSDF should be evaluated rather than sampled alone.

    Sampled by its diffuse lobe alone, a mask transmits all light, a mixture first chooses a BSDF, and pplastic reports
    a density other than its own.
    """
    if not int(bsdf.flags()) & int(mi.BSDFFlags.DiffuseReflection):
        return False
    return _has_part(bsdf, MIXTURES) or not all(_samples_diffusely(leaf) for leaf in _leaves(bsdf))


def _samples_diffusely(bsdf: mi.BSDF) -> bool:
    """Whether the diffuse lobe of a BSDF, if any, is sampled with a cosine density."""
    if not int(bsdf.flags()) & int(mi.BSDFFlags.DiffuseReflection):
        return True
    si, samples, squares = _probe()
    base, _ = bsdf.sample(diffuse_context(), si, samples, squares)
    return bool(dr.all(_is_cosine(si, base)))


def _is_layered(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF with a diffuse lobe can sample its other lobes alone: tested by doing so.

    Mixtures (blendbsdf, mask) choose between their BSDFs first, and are excluded by the test. Under a bump map or a
    normal map, the density of the base is not the cosine of the surface, although the probe may hit a flat place.
    """
    flags = int(bsdf.flags())
    diffuse, through = int(mi.BSDFFlags.DiffuseReflection), int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null)
    if not (flags & diffuse) or not (flags & int(mi.BSDFFlags.All) & ~diffuse) or flags & through:
        return False
    if _has_part(bsdf, UNEVEN):
        return False
    si, samples, squares = _probe()
    base, _ = bsdf.sample(diffuse_context(), si, samples, squares)
    drawn, weight = bsdf.sample(other_context(), si, samples, squares)
    strayed = (drawn.sampled_type == 0) | mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Diffuse)
    apart = _is_cosine(si, base) & ~strayed
    delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
    value, pdf = bsdf.eval_pdf(other_context(), si, drawn.wo)
    same = (dr.abs(pdf - drawn.pdf) <= 0.01 * drawn.pdf) & dr.all(
        dr.abs(value - weight * pdf) <= 0.01 * value
    )
    same |= dr.all(weight == 0)  # no light below the horizon
    dr.eval(apart, delta, same)  # in one kernel
    return bool(dr.all(apart)) and bool(dr.all(delta) or dr.all(same))


def _is_delta_dielectric(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF only reflects and transmits without scattering, selected by its first random number: 0 reflects.

    The fraction of the light in either lobe must then be the weight times the density: tested by sampling either lobe
    alone.
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
    """A point on a surface, viewed obliquely 64 times, and random numbers to sample its BSDF."""
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.t = mi.Float(1)
    si.wi = dr.normalize(mi.Vector3f(0.3, 0.2, 0.9))
    samples = (dr.arange(mi.Float, 64) + 0.5) / 64
    si.uv = mi.Point2f(samples, 0.37)  # varied, as a texture may mix BSDFs that agree at one point only
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    return si, samples, mi.Point2f(samples, 0.37)


def diffuse_context() -> mi.BSDFContext:
    """Context that restricts a BSDF to its diffuse lobe."""
    context = mi.BSDFContext()
    context.type_mask = int(mi.BSDFFlags.Diffuse)
    return context


def other_context() -> mi.BSDFContext:
    """Context that restricts a BSDF to all but its diffuse lobe."""
    context = mi.BSDFContext()
    context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
    return context


def _is_cosine(si: mi.SurfaceInteraction3f, base: mi.BSDFSample3f) -> mi.Bool:
    """Whether samples of a diffuse lobe have the density of the cosine, within 1 %."""
    expected = cosine_pdf(si.wi, base.wo)
    return dr.abs(base.pdf - expected) <= 1e-6 + 0.01 * expected


def cosine_pdf(wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Float:
    """Density of a direction sampled from a diffuse reflection lobe, 1/sr; local frame."""
    return dr.select(wi.z * wo.z > 0, dr.abs(wo.z) * dr.inv_pi, 0)
