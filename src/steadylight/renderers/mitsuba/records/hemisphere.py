"""The hemisphere over a record: its strata, pilot samples that tell where light comes from, and refinement samples.

A record's hemisphere is divided into M x N cosine-weighted strata (Ward & Heckbert 1992). Indoors nearly all light
arrives through few of them: sunlit patches, openings, lamps' pools. Pilot samples take one path in each stratum; the
refinement samples then go where these saw light, at least one to each stratum. How many a stratum gets depends on the
pilot samples alone, so the mean of the refinement samples is unbiased whatever the pilot samples saw.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

RIM = 5.67
"""Tangent of the elevation angle (80 degrees off the normal) beyond which a hit is no obstacle but the floor itself."""

EVEN = 0.35
"""Part of the refinement samples that is spread evenly, for light that the pilot samples did not see."""

PILOT_SHARE = 0.1
"""Weight of the pilot sample in a stratum's mean; fixed, since a weight that knew the outcome would be biased."""

# Steps of the R2 sequence, 1/g and 1/g² of the plastic number g: paths in one stratum keep apart.
_R2 = (0.7548776662466927, 0.5698402909980532)


class Strata(NamedTuple):
    """What arrives in each stratum of each record; lane = record * M*N + j * N + k, elevation j and azimuth k."""

    L: mi.Color3f  # mean radiance
    variance: mi.Float  # estimated variance of that mean's mean over the channels
    closeness: mi.Float  # mean of 1 / distance, 1/metres
    closest: mi.Float  # greatest 1 / distance, 1/metres
    nearest: mi.Float  # least distance of a hit above the rim, metres


def angles(stratum: mi.UInt32, jitter: mi.Point2f, M: int, N: int) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Cos theta, sin theta and phi of a direction in each stratum, cosine-distributed.

    Args:
        stratum: UInt32, j * N + k.
        jitter: Point2f in [0, 1)², place within the stratum.
        M: strata in elevation.
        N: strata in azimuth.
    """
    j = stratum // N
    k = stratum - j * N
    sin2 = (mi.Float(j) + jitter.x) / M
    phi = 2 * dr.pi * (mi.Float(k) + jitter.y) / N
    return dr.safe_sqrt(1 - sin2), dr.safe_sqrt(sin2), phi


def direction(cos_theta: mi.Float, sin_theta: mi.Float, phi: mi.Float) -> mi.Vector3f:
    """Unit vector in the local frame, normal along z."""
    sin_phi, cos_phi = dr.sincos(phi)
    return mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)


def jittered(lane: mi.UInt32, number: mi.UInt32, seed: mi.UInt32) -> mi.Point2f:
    """Place in the stratum of path `number` of stratum `lane`: an R2 sequence with a random start."""
    x, y = mi.sample_tea_32(lane, seed)
    scale = 2.0**-32
    x = mi.Float(x) * scale + mi.Float(number) * _R2[0]
    y = mi.Float(y) * scale + mi.Float(number) * _R2[1]
    return mi.Point2f(x - dr.floor(x), y - dr.floor(y))


def brightness(L: mi.Color3f, count: int, M: int, N: int) -> mi.Float:
    """Luminance of each stratum, blurred: a single path sees whether its stratum is bright; its neighbours may be too.

    Args:
        L: Color3f, radiance that the pilot samples saw in each stratum.
        count: records.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        Float, by stratum.
    """
    strata = M * N
    lane = dr.arange(mi.UInt32, count * strata)
    base = (lane // strata) * strata
    stratum = lane - base
    j = stratum // N
    k = stratum - j * N
    # Below zero where rays make up for what the cache gave to a BSDF that shows no lobe alone; shares cannot be.
    seen = dr.maximum(mi.luminance(L), 0)
    dr.eval(seen)
    bright = mi.Float(0)
    for dj in (-1, 0, 1):
        row = dr.select((dj < 0) & (j == 0), j, dr.minimum(mi.UInt32(mi.Int32(j) + dj), M - 1))
        for dk in (-1, 0, 1):
            column = (k + (N + dk)) % N
            share = 4.0 / (16 * 2 ** (abs(dj) + abs(dk)))
            bright += share * dr.gather(mi.Float, seen, base + row * N + column)
    dr.eval(bright)
    return bright


@dr.syntax
def error_of_one_path(L: mi.Color3f, bright: mi.Float, count: int, M: int, N: int) -> mi.Float:
    """Relative standard error of one refinement path, as far as the pilot samples can tell.

    The variance within a stratum is taken to be that between it and the two before it: too much at edges, and nothing
    where all light comes from a spot that the pilot samples missed.

    Args:
        L: Color3f, radiance that the pilot samples saw in each stratum.
        bright: from `brightness`.
        count: records.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        Float, by record; over the square root of a number of paths it is the relative standard error of their mean. 0
        for a record that saw nothing.
    """
    strata = M * N
    seen = mi.luminance(L)
    dr.eval(seen)
    record = dr.arange(mi.UInt32, count)
    base = record * strata
    even, guided = _shares(bright, record, strata)
    # ---- loop state ----------------------------------------------------------------------
    i = mi.UInt32(0)  # stratum j * N + k
    total = mi.Float(0)  # sum of the luminances
    variance = mi.Float(0)  # of that sum, for one path
    while i < strata:
        here = base + i
        k = i - (i // N) * N
        L_jk = dr.gather(mi.Float, seen, here)
        above = dr.gather(mi.Float, seen, dr.select(i >= N, here - N, here + N))
        beside = dr.gather(mi.Float, seen, dr.select(k > 0, here - 1, here + (N - 1)))
        within = (dr.square(L_jk - above) + dr.square(L_jk - beside)) / 4
        variance += within / (even + guided * dr.gather(mi.Float, bright, here))
        total += L_jk
        i += 1
    return dr.select(total > 0, dr.sqrt(variance) / total, 0)


@dr.syntax
def _shares(bright: mi.Float, record: mi.UInt32, strata: int) -> tuple[mi.Float, mi.Float]:
    """Part of a record's paths that goes to a stratum: the first number, plus the second times its brightness."""
    i = mi.UInt32(0)
    total = mi.Float(0)
    while i < strata:
        total += dr.gather(mi.Float, bright, record * strata + i)
        i += 1
    even = dr.select(total > 0, mi.Float(EVEN), 1) / strata
    return even, dr.select(total > 0, (1 - EVEN) / total, 0)


@dr.syntax
def allocate(bright: mi.Float, count: int, strata: int, paths: int) -> mi.UInt32:
    """First refinement path of each stratum.

    Args:
        bright: from `brightness`.
        count: records.
        strata: M*N.
        paths: of each record, at least M*N.

    Returns:
        UInt32, by stratum: paths [begin, begin of the next) of the record go there, at least one.
    """
    # One lane per record walks its strata twice, first for the sum, then to hand out the paths.
    record = dr.arange(mi.UInt32, count)
    base = record * strata
    even, guided = _shares(bright, record, strata)
    begin = dr.zeros(mi.UInt32, count * strata)
    i = mi.UInt32(0)
    before = mi.Float(0)  # share of the paths that the strata before this one get
    while i < strata:
        spread = mi.UInt32(dr.minimum(before, 1) * (paths - strata))
        dr.scatter(begin, i + dr.minimum(spread, paths - strata), base + i)
        before += even + guided * dr.gather(mi.Float, bright, base + i)
        i += 1
    return begin


def stratum_of(begin: mi.UInt32, record: mi.UInt32, number: mi.UInt32, strata: int) -> mi.UInt32:
    """Stratum to which path `number` of a record goes."""
    base = record * strata
    after = dr.binary_search(0, strata, lambda i: dr.gather(mi.UInt32, begin, base + i, i < strata) <= number)
    return after - 1


class PathSamples(NamedTuple):
    """What paths saw; one lane a path."""

    L: mi.Color3f  # radiance
    distance: mi.Float  # to the first hit, metres; infinite if there is none
    tangent: mi.Float  # tangent of the elevation angle


def _grey(L: mi.Color3f) -> mi.Float:
    """Mean of the channels. Dr.Jit's own puts the number of lanes into the kernel as a constant."""
    return dr.sum(L) * (1 / 3)


@dr.syntax
def combined(
    pilot: PathSamples, refinement: PathSamples, begin: mi.UInt32, strata: int, paths: int
) -> Strata:
    """Means over the pilot and refinement samples of each stratum.

    Args:
        pilot: one path in each stratum.
        refinement: `paths` for each record, in the order of their strata.
        begin: what `allocate` returned.
        strata: M*N.
        paths: refinement samples of each record.
    """
    lane = dr.arange(mi.UInt32, dr.width(begin))
    record = lane // strata
    last = lane - record * strata == strata - 1
    following = dr.gather(mi.UInt32, begin, dr.select(last, lane, lane + 1))
    i = record * paths + begin
    end = record * paths + dr.select(last, paths, following)
    taken = mi.Float(end - i)
    # ---- loop state ----------------------------------------------------------------------
    L = mi.Color3f(0)  # sum of the refinement samples' radiances
    grey = _grey(pilot.L)  # sum of the channels' means, over all samples
    squares = dr.square(grey)  # sum of their squares
    closeness = dr.rcp(pilot.distance)
    closest = dr.rcp(pilot.distance)
    nearest = dr.select(pilot.tangent < RIM, pilot.distance, mi.Float(dr.inf))
    while i < end:
        distance = dr.gather(mi.Float, refinement.distance, i)
        seen = dr.gather(mi.Color3f, refinement.L, i)
        L += seen
        grey += _grey(seen)
        squares += dr.square(_grey(seen))
        closeness += dr.rcp(distance)
        closest = dr.maximum(closest, dr.rcp(distance))
        above = dr.gather(mi.Float, refinement.tangent, i) < RIM
        nearest = dr.select(above, dr.minimum(nearest, distance), nearest)
        i += 1
    L = PILOT_SHARE * pilot.L + (1 - PILOT_SHARE) * L / taken
    # Of one path, from all in the stratum; then of the weighted mean. Paths spread evenly do better than that.
    variance = dr.maximum(squares - dr.square(grey) / (taken + 1), 0) / taken
    variance *= PILOT_SHARE**2 + (1 - PILOT_SHARE) ** 2 / taken
    return Strata(L, variance, closeness / (taken + 1), closest, nearest)


@dr.syntax
def reduced(strata: Strata, normal: mi.Normal3f, M: int, N: int) -> dict[str, Any]:
    """Sums over the strata of each record, one lane a record, in a fixed order: the same bytes every time.

    Args:
        strata: what arrives, M*N lanes for each record.
        normal: Normal3f of each record.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        By record: `E`, sum of L; `variance`, its own sum; `horizon`, sum of the channels' mean L in the strata of the
        lowest elevation; `closeness`, sum of 1/distance; `nearest`, least distance above the rim; and the gradients of
        channel c in the world frame, `t_c` by translation and `r_c` by rotation. The sums still lack the factor
        pi / (M N).
    """
    record = dr.arange(mi.UInt32, dr.width(normal))
    base = record * (M * N)
    frame = mi.Frame3f(normal)
    # ---- loop state ----------------------------------------------------------------------
    i = mi.UInt32(0)  # stratum j * N + k
    E = mi.Color3f(0)  # sum of radiances
    variance = mi.Float(0)  # of that sum's mean over the channels
    horizon = mi.Float(0)  # sum of the channels' means in the lowest strata
    closeness = mi.Float(0)  # sum of 1 / distance
    nearest = mi.Float(dr.inf)  # least distance
    t_r, t_g, t_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # translational gradient, local frame
    r_r, r_g, r_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # rotational gradient, local frame
    while i < M * N:
        j = i // N
        k = i - j * N
        here = base + i
        L_jk = dr.gather(mi.Color3f, strata.L, here)
        c_jk = dr.gather(mi.Float, strata.closest, here)
        E += L_jk
        variance += dr.gather(mi.Float, strata.variance, here)
        horizon += dr.select(j == M - 1, _grey(L_jk), 0)
        closeness += dr.gather(mi.Float, strata.closeness, here)
        nearest = dr.minimum(nearest, dr.gather(mi.Float, strata.nearest, here))

        # Directions u_k (azimuth of the stratum's middle), v_k and v_k- (a quarter turn on).
        s, c = dr.sincos((2 * dr.pi / N) * (mi.Float(k) + 0.5))
        s_minus, c_minus = dr.sincos((2 * dr.pi / N) * mi.Float(k))
        u = mi.Vector3f(c, s, 0)
        v = mi.Vector3f(-s, c, 0)
        v_minus = mi.Vector3f(-s_minus, c_minus, 0)

        # Rotation: turning the normal towards u gains with the tangent of the elevation angle (eq. 8; our axis is
        # record normal x query normal, theirs the opposite). We take the tangent's mean over the stratum: that of a
        # single path near the horizon has no finite variance.
        lean = M * (_tangents(mi.Float(j + 1) / M) - _tangents(mi.Float(j) / M))
        r_r += v * (lean * L_jk.x)
        r_g += v * (lean * L_jk.y)
        r_b += v * (lean * L_jk.z)

        # Translation: the walls between strata move with the nearer of the two surfaces (eq. 11), and within a
        # stratum with its nearest: a mean with what lies far behind an edge would be too slow.
        above = dr.select(j > 0, here - N, here)  # towards the pole
        beside = dr.select(k > 0, here - 1, here + (N - 1))  # around
        sin2_minus = mi.Float(j) / M
        sin_minus = dr.sqrt(sin2_minus)
        sin_plus = dr.sqrt(mi.Float(j + 1) / M)
        near_above = dr.maximum(c_jk, dr.gather(mi.Float, strata.closest, above))
        near_beside = dr.maximum(c_jk, dr.gather(mi.Float, strata.closest, beside))
        polar = (2 * dr.pi / N) * sin_minus * (1 - sin2_minus) * near_above
        around = (sin_plus - sin_minus) * near_beside
        d_above = L_jk - dr.gather(mi.Color3f, strata.L, above)
        d_beside = L_jk - dr.gather(mi.Color3f, strata.L, beside)
        t_r += u * (polar * d_above.x) + v_minus * (around * d_beside.x)
        t_g += u * (polar * d_above.y) + v_minus * (around * d_beside.y)
        t_b += u * (polar * d_above.z) + v_minus * (around * d_beside.z)
        i += 1
    return {
        "E": E,
        "variance": variance,
        "horizon": horizon,
        "closeness": closeness,
        "nearest": nearest,
        "t_r": frame.to_world(t_r),
        "t_g": frame.to_world(t_g),
        "t_b": frame.to_world(t_b),
        "r_r": frame.to_world(r_r),
        "r_g": frame.to_world(r_g),
        "r_b": frame.to_world(r_b),
    }


def _tangents(sin2: mi.Float) -> mi.Float:
    """Integral of tan theta over sin² theta, from 0."""
    return dr.safe_asin(dr.safe_sqrt(sin2)) - dr.safe_sqrt(sin2 * (1 - sin2))
