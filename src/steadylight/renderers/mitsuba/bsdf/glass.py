"""Radiance's `glass`: a thin absorbing pane, as a BSDF plugin of Mitsuba.

Mitsuba's `thindielectric` absorbs the same fraction of the light at all angles. In an absorbing pane, oblique light has
a longer path, and light reflected between the faces is absorbed on each pass: towards grazing angles, a grey pane
transmits a quarter less than a clear one with the same mean. Where the sun grazes a facade, this determines the
brightness of the room.
"""

from __future__ import annotations

from typing import Any, Final

NAME: Final = "glasspane"
"""Name of the plugin: `{"type": "glasspane", "transmissivity": rgb, "ior": 1.52}`."""

_registered: set[str] = set()


def register() -> None:
    """Register the plugin under the current variant, which its class belongs to."""
    import drjit as dr
    import mitsuba as mi

    variant = mi.variant() or ""
    if variant in _registered:
        return

    class GlassPane(mi.BSDF):
        """Two faces with absorption in between; light passes straight through or is mirrored.

        As for Mitsuba's dielectrics, the first random number selects the lobe: small numbers reflect.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.transmissivity = props.get_texture("transmissivity", 1.0)
            self.ior = float(props.get("ior", 1.52))
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DeltaReflection | sides, mi.BSDFFlags.Null | sides]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: Any) -> None:
            """Expose the colour."""
            callback.put("transmissivity", self.transmissivity, mi.ParamFlags.Differentiable)

        def parts(self, si: Any, active: Any) -> tuple[Any, Any]:
            """Reflectance and transmittance, mean of both polarisations, (Color3f, Color3f)."""
            outside = dr.abs(mi.Frame3f.cos_theta(si.wi))
            within = dr.sqrt(1 - (1 - dr.square(outside)) / self.ior**2)
            passed = dr.power(dr.maximum(self.transmissivity.eval(si, active), 1e-12), dr.rcp(within))
            reflected, transmitted = mi.Color3f(0), mi.Color3f(0)
            for a, b in ((1.0, self.ior), (self.ior, 1.0)):
                face = dr.square((a * outside - b * within) / (a * outside + b * within))
                left = 1 / (1 - dr.square(face * passed))  # series of all interreflections
                reflected += 0.5 * face * (1 + dr.square((1 - face) * passed) * left)
                transmitted += 0.5 * dr.square(1 - face) * passed * left
            return reflected, transmitted

        def sample(
            self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
        ) -> tuple[Any, Any]:
            """Reflect or transmit, with probabilities proportional to the means of the channels."""
            del sample2
            reflected, transmitted = self.parts(si, active)
            reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0)
            transmits = ctx.is_enabled(mi.BSDFFlags.Null, 1)
            share = dr.mean(reflected) / dr.maximum(dr.mean(reflected) + dr.mean(transmitted), 1e-12)
            chance = share if reflects and transmits else mi.Float(1.0 if reflects else 0.0)
            chosen = sample1 <= chance
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(chosen, mi.reflect(si.wi), -si.wi)
            bs.eta = mi.Float(1)
            bs.pdf = dr.select(chosen, chance, 1 - chance)
            bs.sampled_component = dr.select(chosen, mi.UInt32(0), mi.UInt32(1))
            mirror, straight = mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.Null)
            bs.sampled_type = dr.select(chosen, mirror, straight)
            found = mi.Bool(active) & (reflects or transmits) & (bs.pdf > 0)
            return bs, dr.select(found, dr.select(chosen, reflected, transmitted) / bs.pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Zero: all lobes are delta."""
            del ctx, si, wo, active
            return mi.Color3f(0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Zero: all lobes are delta."""
            del ctx, si, wo, active
            return mi.Float(0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            """Zero: all lobes are delta."""
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            """Fraction of light that passes straight through."""
            return dr.select(active, self.parts(si, active)[1], 0)

        def to_string(self) -> str:
            """Human-readable summary."""
            return f"GlassPane[ior={self.ior:g}]"

    mi.register_bsdf(NAME, GlassPane)
    _registered.add(variant)
