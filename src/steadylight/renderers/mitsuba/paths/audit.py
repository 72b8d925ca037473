"""The coverage audit: follows the paths that will light a frame, in search of points that the cache does not cover.

It collects no light. Since random numbers have addresses, it meets exactly the points at which the frame will look up
the cache, although it traces neither shadow rays nor rays that only look for emitters. Surfaces seen faintly by glossy
reflection are skipped: see `shading`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.cache.lookup import ANSWERED
from steadylight.renderers.mitsuba.bsdf.lobes import NOT_DIFFUSE_REFLECTION, OTHER_FLAGS, Choice
from steadylight.renderers.mitsuba.frozen import frozen
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.paths.branches import Branches, CameraPath, PathLimits
from steadylight.renderers.mitsuba.paths.misses import MissList, Point
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.obstacles import Trust, trusted_radius, wanted_spacing
from steadylight.renderers.mitsuba.sampling import Samples


class Audit:
    """What to audit, and where to record misses. Not a dataclass: kernels read it, but it is not a loop variable.

    Attributes:
        cache: the cache.
        trust: which records are trusted, and the radius that is requested.
        misses: list of misses.
        probed: Bool, whether records must be trusted; if not, any record counts, as in lighting.
        least: Float, sum of weights that counts as a hit.
    """

    def __init__(
        self,
        cache: DeviceCache,
        trust: Trust,
        misses: MissList,
        *,
        probed: mi.Bool | bool,
        least: mi.Float | float = ANSWERED,
    ) -> None:
        self.cache, self.trust, self.misses = cache, trust, misses
        self.probed, self.least = mi.Bool(probed), mi.Float(least)


@dr.syntax
def audit(lighting: Lighting, samples: Samples, ray: mi.Ray3f, what: Audit, limits: PathLimits) -> mi.UInt32:
    """Follow camera paths as `shading.shade` does, and record where the cache misses.

    Args:
        lighting: of the scene; its emitters are not used.
        samples: random numbers of the camera rays.
        ray: camera rays.
        what: what to audit, and where to record misses.
        limits: how far paths are followed.

    Returns:
        Number of misses on each path.
    """
    bsdfs = lighting.bsdfs
    path, branches = CameraPath.begin(ray), Branches.begin()
    number = dr.arange(mi.UInt32, dr.width(ray))  # of the path
    step = mi.UInt32(0)  # surfaces that it has met, over all branches
    travelled = mi.Float(0)  # metres from the camera
    missed = mi.UInt32(0)

    while path.active:
        # Find the next surface.
        si = lighting.scene.ray_intersect(path.ray, mi.RayFlags.All, path.depth == 0, path.active)
        fresh = path.active & branches.fresh()
        primary = branches.primary(path.depth)
        path.active &= si.is_valid() & (path.depth <= limits.depth)
        numbers = branches.numbers(samples, path.depth)
        path.active &= ~path.is_faint(limits)
        # Survivors of the roulette carry the throughput of paths that end, but their surface is no more visible.
        shown = mi.Color3f(path.throughput)
        path.roulette(numbers, limits.negligible)
        travelled += dr.select(path.active, si.t, 0)

        # Look up its diffuse lobe in the cache.
        bsdf = si.bsdf(path.ray)
        flags = bsdf.flags()
        diffuse = bsdfs.diffuse_lobe(si, bsdf, numbers, path.active)
        asks = diffuse.active & fresh
        wanted = wanted_spacing(si, travelled, shown, what.trust)
        radius = trusted_radius(lighting.scene, si, diffuse.normal, wanted, what.trust, asks & what.probed)
        trusted = dr.select(what.probed, radius, dr.inf)
        miss = asks & (what.cache.weight(si.p, diffuse.normal, trusted, asks) < what.least)
        what.misses.note(number, step, Point(si.p, diffuse.normal, trusted, wanted), miss)
        missed += dr.select(miss, mi.UInt32(1), 0)

        # Continue as the frame does, except for rays that only look for emitters.
        layer = path.active & primary & bsdfs.is_layered(bsdf, path.active)
        dielectric, reflected = branches.at_dielectric(bsdfs, bsdf, path.active)
        ways = limits.glossy_branches
        split = branches.at_gloss(bsdfs, flags, ways, path.active & primary & ~layer)
        path.active &= (flags & NOT_DIFFUSE_REFLECTION) != 0
        choice = Choice(layer, mi.Bool(False), dielectric, reflected)
        draw = branches.draw(samples, path.depth, ways, split)
        bs, weight = bsdfs.sample(si, bsdf, draw, choice, path.active)
        directions = dr.select(split, mi.Float(ways), 1)
        weight /= directions
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        others = path.active & ((flags & OTHER_FLAGS) != 0) & ~delta & ~layer
        share = bsdfs.weight_of_others(si, bsdf, bs, directions, diffuse, others)
        path.throughput *= dr.select(delta | layer, weight, share)
        path.ways *= directions
        path.clear = path.clear & delta
        path.ray = si.spawn_ray(si.to_world(bs.wo))
        path.active &= dr.any(path.throughput != 0)
        restart = branches.leave(bsdfs, path, dielectric, reflected)
        travelled = dr.select(restart, mi.Float(0), travelled)
        step += 1
    return missed


def note_misses(lighting: Lighting, samples: Samples, ray: mi.Ray3f, what: Audit, limits: PathLimits) -> None:
    """Do as `audit` does, by one recorded kernel for all audits of a scene.

    Args:
        lighting: of the scene; its emitters are not used.
        samples: random numbers of the camera rays.
        ray: camera rays, of any camera.
        what: what to audit, and where to record misses.
        limits: how far paths are followed.
    """
    # One number for each lane: kernels differ for arrays of a single element.
    none = dr.zeros(mi.UInt32, dr.width(samples.key))
    samples = Samples(samples.key, samples.index + none)
    rays = ray.o, ray.d, ray.maxt + mi.Float(none)
    asked = *what.trust, what.probed, what.least
    dr.make_opaque(samples.key, samples.index, *rays, *asked)
    _frozen_audit(_Met(lighting, limits, what.cache), samples, rays, asked, what.misses.arrays)


class _Met(NamedTuple):
    """What the paths of an audit meet."""

    lighting: Lighting
    limits: PathLimits
    cache: DeviceCache

    def state(self) -> list[object]:
        """All that a kernel reads through these, for `frozen`."""
        return [*self.lighting.arrays(), *self.limits.state(), self.cache.arrays()]


def _note(
    met: _Met,
    samples: Samples,
    rays: tuple[mi.Point3f, mi.Vector3f, mi.Float],
    asked: tuple[Any, ...],
    misses: list[Any],
) -> None:
    """Called through `_frozen_audit`, which takes no named tuples of arrays."""
    origin, direction, reach = rays
    *trust, probed, least = asked
    ray = mi.Ray3f(origin, direction)
    ray.maxt = reach
    what = Audit(met.cache, Trust(*trust), MissList(over=misses), probed=probed, least=least)
    dr.eval(audit(met.lighting, samples, ray, what, met.limits))


def _clear(*given: Any) -> None:
    MissList(over=given[-1]).clear()


_frozen_audit = frozen(_note, _Met.state, _clear)
