"""First-pass work: sample the hemisphere over surface points and make irradiance records of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from steadylight.cache.records import Floats, Records
from steadylight.rendering.lights import GridLights
from steadylight.rendering.lookup import NO_RECORD, DeviceCache
from steadylight.rendering.sky import Sky
from steadylight.settings import CacheSettings

OTHER_FLAGS = 0x1F9
"""All lobe types of mi.BSDFFlags but the two diffuse ones, as bits: the flags of a lane are a plain integer."""

RIM = 5.67
"""Tangent of the elevation angle (80 degrees off the normal) beyond which a hit is no obstacle but the floor itself."""

LANES = 1 << 21
"""Paths traced at once; bounds memory, and fixes batches so that bytes do not depend on the machine."""


class Aids(NamedTuple):
    """What makes the gather quieter without changing what it measures."""

    sky: Sky  # divides the surroundings into cached and direct light
    lights: GridLights | None = None  # chooses emitters at the hits; as Mitsuba does if None
    secondary: DeviceCache | None = (
        None  # indirect irradiance, one bounce less, at surfaces that rays may hit
    )


class Bounds(NamedTuple):
    """Smallest and largest reach at each point, metres; the same whatever frame looks."""

    smallest: Floats  # (P,)
    largest: float


def gather_records(
    scene: Any,
    position: Floats,
    normal: Floats,
    bounds: Bounds,
    settings: CacheSettings,
    *,
    bounces: int,
    seed: int,
    aids: Aids | None = None,
) -> Records:
    """Make one record at each point.

    Ward, Rubinstein & Clear 1988 (doi:10.1145/54852.378490) for the record, Ward & Heckbert 1992 for the strata
    and gradients. Each record's M x N paths share a low-discrepancy point set for what happens after the first
    hit.

    Args:
        scene: mi.Scene.
        position: (P, 3) surface points, metres.
        normal: (P, 3) unit normals on the lit side.
        bounds: limits of the reach.
        settings: strata and accuracy.
        bounces: indirect diffuse bounces; at least 1 (0 gives black records).
        seed: decides all random numbers together with the order of the points.
        aids: none but the sky's division if None.

    Returns:
        P records in the same order.
    """
    M, N = settings.polar_strata, settings.azimuth_strata
    batch = max(1, LANES // (M * N))
    parts = []
    for begin in range(0, len(position), batch):
        rows = slice(begin, begin + batch)
        limits = Bounds(bounds.smallest[rows], bounds.largest)
        parts.append(
            _gather_batch(
                scene,
                position[rows],
                normal[rows],
                limits,
                settings,
                bounces,
                seed + 0x9E3779B9 * begin,
                aids or Aids(Sky(scene)),
            )
        )
    return Records.joined(*parts)


def _gather_batch(
    scene: Any,
    position: Floats,
    normal: Floats,
    bounds: Bounds,
    settings: CacheSettings,
    bounces: int,
    seed: int,
    aids: Aids,
) -> Records:
    M, N = settings.polar_strata, settings.azimuth_strata
    count, strata = len(position), M * N
    p = mi.Point3f(np.ascontiguousarray(position.T))
    n = mi.Normal3f(np.ascontiguousarray(normal.T))
    dr.make_opaque(p, n)
    # Rays start just off the surface, as far as Mitsuba's own; the record itself stays on it.
    far = dr.maximum(dr.abs(p.x), dr.maximum(dr.abs(p.y), dr.abs(p.z)))
    origin = mi.Point3f(p + mi.Vector3f(n) * ((1 + far) * mi.math.RayEpsilon))
    dr.eval(origin)

    # Trace: lane = record * M*N + j * N + k, elevation stratum j and azimuth stratum k.
    lanes = dr.arange(mi.UInt32, count * strata)
    record = lanes // strata
    stratum = lanes - record * strata
    sampler = mi.load_dict({"type": "multijitter", "sample_count": strata})
    sampler.set_samples_per_wavefront(strata)
    opaque_seed = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
    sampler.seed(opaque_seed, count * strata)
    # The cells of the hemisphere are ours; the sampler's shuffled strata serve the vertices after.
    jitter = mi.PCG32(size=count * strata, initstate=mi.UInt64(opaque_seed))
    theta_phi = _angles(stratum, mi.Point2f(jitter.next_float32(), jitter.next_float32()), M, N)
    direction = mi.Frame3f(dr.gather(mi.Normal3f, n, record)).to_world(_direction(*theta_phi))
    ray = mi.Ray3f(dr.gather(mi.Point3f, origin, record), direction)
    L, distance = indirect_radiance(scene, sampler, ray, bounces, aids)
    # One path that hit a singularity must not end a film.
    L = dr.select(dr.all(dr.isfinite(L)), L, 0)
    tangent = theta_phi[1] / dr.maximum(theta_phi[0], 1e-4)
    dr.eval(L, distance, tangent)

    # Reduce: one lane per record walks its strata in a fixed order (no atomics: the same bytes every time).
    sums = _reduce(L, distance, tangent, n, count, M, N)
    dr.eval(sums)
    arrays = {name: np.array(value).T for name, value in sums.items()}
    return _limited(position, normal, bounds, settings.accuracy, strata, arrays)


def _angles(stratum: Any, jitter: Any, M: int, N: int) -> tuple[Any, Any, Any]:
    """Cos theta, sin theta and phi of a jittered direction in each stratum, cosine-distributed."""
    j = stratum // N
    k = stratum - j * N
    sin2 = (mi.Float(j) + jitter.x) / M
    phi = 2 * dr.pi * (mi.Float(k) + jitter.y) / N
    return dr.safe_sqrt(1 - sin2), dr.safe_sqrt(sin2), phi


def _direction(cos_theta: Any, sin_theta: Any, phi: Any) -> Any:
    sin_phi, cos_phi = dr.sincos(phi)
    return mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)


@dr.syntax
def indirect_radiance(scene: Any, sampler: Any, ray: Any, bounces: int, aids: Aids) -> Any:
    """Radiance that arrives along a ray from surfaces and soft sky, without what the first surface hit emits.

    A path tracer with emitter and BSDF sampling and multiple importance sampling (Veach 1997, power heuristic). What
    the first hit emits, and the bright part of the surroundings, is direct light and is left to the second pass.
    Where the first hit is diffuse and the secondary cache knows its indirect light, the path ends there; it is
    followed one ray further only for emitters that BSDF sampling finds.

    Args:
        scene: mi.Scene.
        sampler: a seeded wavefront sampler.
        ray: Ray3f.
        bounces: scattering events, the first hit included.
        aids: sky, emitter choice and secondary cache.

    Returns:
        radiance (Color3f) and distance to the first hit (Float, infinite if there is none).
    """
    ctx = mi.BSDFContext()
    sky, lights, secondary = aids
    # ---- loop state ----------------------------------------------------------------------
    ray = mi.Ray3f(ray)
    L = mi.Color3f(0)  # radiance so far
    beta = mi.Color3f(1)  # path throughput
    depth = mi.UInt32(0)  # surfaces met so far
    distance = mi.Float(dr.inf)  # to the first hit
    known = mi.Bool(False)  # the secondary cache spoke at the last surface: only hard emission is left
    prev_si = dr.zeros(mi.SurfaceInteraction3f)  # where the current ray starts
    prev_row = mi.UInt32(NO_RECORD)  # what `lights` knows there
    prev_pdf = mi.Float(1)  # density of its direction
    prev_delta = mi.Bool(True)  # ... unless it was the only one possible
    active = mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        distance = dr.select(depth == 0, si.t, distance)

        # Add what an emitter hit by BSDF sampling gives, weighted against emitter sampling.
        emitter = si.emitter(scene)
        lit = active & (emitter != None)  # noqa: E711 - element-wise
        Le = emitter.eval(si, lit)
        if dr.hint(sky.soft, mode="scalar"):
            # From the surface itself only the soft part of the surroundings counts; where the secondary cache
            # spoke, only the rest.
            soft = dr.select(si.is_valid(), 0, sky.soft_part(Le))
            Le = dr.select(depth == 0, Le * soft, dr.select(known, Le * (1 - soft), Le))
            lit &= (depth > 0) | ~si.is_valid()
        else:
            lit &= depth > 0
        ds = mi.DirectionSample3f(scene, si, prev_si)
        if dr.hint(lights is None, mode="scalar"):
            pdf_em = scene.pdf_emitter_direction(prev_si, ds, lit & ~prev_delta)
        else:
            pdf_em = lights.pdf(prev_si, ds, emitter, prev_row, lit & ~prev_delta)
        L = dr.select(lit, L + beta * Le * mis_weight(prev_pdf, pdf_em), L)

        # Stop after the last bounce.
        active &= si.is_valid() & (depth < bounces) & ~known

        # Ask the secondary cache at a first hit that is diffuse and nothing else.
        bsdf = si.bsdf(ray)
        flags = bsdf.flags()
        E = mi.Color3f(0)
        if dr.hint(secondary is not None, mode="scalar"):
            asks = active & (depth == 0) & ((flags & OTHER_FLAGS) == 0)
            n = mi.Normal3f(si.sh_frame.n * dr.select(si.wi.z < 0, mi.Float(-1), mi.Float(1)))
            look = secondary.look_up_near(si.p, n, asks)
            known = asks & (look.weight > 0)
            E = dr.select(known, look.irradiance, 0)

        # Sample an emitter.
        smooth = active & mi.has_flag(flags, mi.BSDFFlags.Smooth)
        row = mi.UInt32(NO_RECORD)
        if dr.hint(lights is None, mode="scalar"):
            ds, em_weight = scene.sample_emitter_direction(si, sampler.next_2d(smooth), True, smooth)
        else:
            row = lights.row_at(si, smooth)
            ds, em_weight = lights.sample(si, sampler.next_2d(smooth), row, smooth)
        if dr.hint(sky.soft, mode="scalar"):
            soft = dr.select(known & ds.emitter.is_environment(), sky.soft_part(em_weight * ds.pdf), 0)
            em_weight *= 1 - soft
        smooth &= ds.pdf != 0
        wo = si.to_local(ds.d)
        value, pdf, bs, weight = bsdf.eval_pdf_sample(
            ctx, si, wo, sampler.next_1d(active), sampler.next_2d(active), active
        )
        mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
        L = dr.select(smooth, L + beta * value * em_weight * mis_em, L)
        L = dr.select(known, L + beta * weight * E * dr.inv_pi, L)

        # Go on in a direction of the BSDF's choice.
        beta *= weight
        prev_si = si
        prev_row = row
        prev_pdf = bs.pdf
        prev_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        active &= dr.any(beta != 0)
        depth += 1
    return L, distance


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Power heuristic: weight of a sample drawn with density `pdf_a` that could have come from b."""
    a2 = dr.square(pdf_a)
    weight = a2 / (a2 + dr.square(pdf_b))
    # Zero over zero, and infinity over infinity where a path lands on the emitter that it samples.
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))


@dr.syntax
def _reduce(L: Any, distance: Any, tangent: Any, normal: Any, count: int, M: int, N: int) -> dict[str, Any]:
    """Sums over the strata of each record; twin: `reduce_strata` in NumPy.

    Args:
        L: Color3f, M*N radiances for each record.
        distance: Float, hit distances, metres.
        tangent: Float, tan of the elevation angle of each sample.
        normal: Normal3f of each record.
        count: records.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        sum of L, sum of 1/distance, least distance above the rim, and the two gradients in the world frame, by
        channel.
    """
    record = dr.arange(mi.UInt32, count)
    base = record * (M * N)
    frame = mi.Frame3f(normal)
    # ---- loop state ----------------------------------------------------------------------
    i = mi.UInt32(0)  # stratum j * N + k
    E = mi.Color3f(0)  # sum of radiances
    closeness = mi.Float(0)  # sum of 1 / distance
    nearest = mi.Float(dr.inf)  # least distance, the rim of the hemisphere left out
    t_r, t_g, t_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # translational gradient, local frame
    r_r, r_g, r_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # rotational gradient, local frame
    while i < M * N:
        j = i // N
        k = i - j * N
        here = base + i
        L_jk = dr.gather(mi.Color3f, L, here)
        r_jk = dr.gather(mi.Float, distance, here)
        E += L_jk
        closeness += dr.rcp(r_jk)
        nearest = dr.select(dr.gather(mi.Float, tangent, here) < RIM, dr.minimum(nearest, r_jk), nearest)

        # Directions u_k (azimuth of the stratum's middle), v_k and v_k- (a quarter turn on).
        s, c = dr.sincos((2 * dr.pi / N) * (mi.Float(k) + 0.5))
        s_minus, c_minus = dr.sincos((2 * dr.pi / N) * mi.Float(k))
        u = mi.Vector3f(c, s, 0)
        v = mi.Vector3f(-s, c, 0)
        v_minus = mi.Vector3f(-s_minus, c_minus, 0)

        # Rotation: turning the normal towards u gains with the tangent of the elevation angle (eq. 8; our axis is
        # record normal x query normal, theirs the opposite).
        lean = dr.gather(mi.Float, tangent, here)
        r_r += v * (lean * L_jk.x)
        r_g += v * (lean * L_jk.y)
        r_b += v * (lean * L_jk.z)

        # Translation: the walls between strata move with the nearer of the two surfaces (eq. 11).
        above = dr.select(j > 0, here - N, here)  # towards the pole
        beside = dr.select(k > 0, here - 1, here + (N - 1))  # around
        sin2_minus = mi.Float(j) / M
        sin_minus = dr.sqrt(sin2_minus)
        sin_plus = dr.sqrt(mi.Float(j + 1) / M)
        near_above = dr.minimum(r_jk, dr.gather(mi.Float, distance, above))
        near_beside = dr.minimum(r_jk, dr.gather(mi.Float, distance, beside))
        polar = (2 * dr.pi / N) * sin_minus * (1 - sin2_minus) / near_above
        around = (sin_plus - sin_minus) / near_beside
        d_above = L_jk - dr.gather(mi.Color3f, L, above)
        d_beside = L_jk - dr.gather(mi.Color3f, L, beside)
        t_r += u * (polar * d_above.x) + v_minus * (around * d_beside.x)
        t_g += u * (polar * d_above.y) + v_minus * (around * d_beside.y)
        t_b += u * (polar * d_above.z) + v_minus * (around * d_beside.z)
        i += 1
    return {
        "E": E,
        "closeness": closeness,
        "nearest": nearest,
        "t_r": frame.to_world(t_r),
        "t_g": frame.to_world(t_g),
        "t_b": frame.to_world(t_b),
        "r_r": frame.to_world(r_r),
        "r_g": frame.to_world(r_g),
        "r_b": frame.to_world(r_b),
    }


def _limited(
    position: Floats, normal: Floats, bounds: Bounds, accuracy: float, strata: int, sums: dict[str, Any]
) -> Records:
    """Turn sums into records: scale, then choose the reach and keep the gradients within it.

    The reach is `accuracy` times the harmonic mean distance, no longer than irradiance over gradient (there the
    first-order extrapolation would reach zero) nor than the way to the nearest surface (a thin ledge hardly changes
    the mean, but what lies under it is dark), and within bounds that do not depend on the frame.
    """
    E = sums["E"] * np.float32(np.pi / strata)
    translation = np.stack([sums["t_r"], sums["t_g"], sums["t_b"]], axis=1)
    rotation = np.stack([sums["r_r"], sums["r_g"], sums["r_b"]], axis=1) * np.float32(np.pi / strata)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_distance = np.where(sums["closeness"] > 0, strata / sums["closeness"], np.inf)
        steepness = np.linalg.norm(translation, axis=2).sum(axis=1) / E.sum(axis=1)
        wanted = accuracy * np.minimum(mean_distance, np.where(steepness > 0, 1 / steepness, np.inf))
    wanted = np.minimum(wanted, sums["nearest"])
    reach = np.clip(wanted, bounds.smallest, np.maximum(bounds.largest, bounds.smallest)).astype(np.float32)
    # Where the lower bound made the reach longer than the gradient is good for, flatten the gradient.
    trust = np.minimum(1, wanted / reach).astype(np.float32)
    translation *= trust[:, None, None]
    arrays = (position, normal, E, translation, rotation, reach)
    return Records(*(np.ascontiguousarray(a, np.float32) for a in arrays))
