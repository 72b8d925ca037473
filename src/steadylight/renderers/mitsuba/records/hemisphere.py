"""The hemisphere over a record: its strata, a first look that tells where light comes from, and where to look again.

A record's hemisphere is divided into M x N cosine-weighted strata (Ward & Heckbert 1992). Indoors nearly all light
arrives through few of them: sunlit patches, openings, lamps' pools. A first look takes one path in each stratum;
the rest of the paths then go where it saw light, at least one to each stratum. How many a stratum gets depends on
the first look alone, so the mean of the second is unbiased whatever the first saw.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr

import mitsuba as mi

RIM = 5.67
"""Tangent of the elevation angle (80 degrees off the normal) beyond which a hit is no obstacle but the floor itself."""

EVEN = 0.35
"""Part of the second look that is spread evenly, for light that the first did not see."""

FIRST_SHARE = 0.1
"""Weight of the first look in a stratum's mean; fixed, since a weight that knew the outcome would be biased."""

# Steps of the R2 sequence, 1/g and 1/g² of the plastic number g: paths in one stratum keep apart.
_R2 = (0.7548776662466927, 0.5698402909980532)


class Strata(NamedTuple):
    """What arrives in each stratum of each record; lane = record * M*N + j * N + k, elevation j and azimuth k."""

    L: Any  # Color3f, mean radiance
    variance: Any  # Float, estimated variance of that mean's mean over the channels
    closeness: Any  # Float, mean of 1 / distance, 1/metres
    closest: Any  # Float, greatest 1 / distance, 1/metres
    nearest: Any  # Float, least distance of a hit above the rim, metres


def angles(stratum: Any, jitter: Any, M: int, N: int) -> tuple[Any, Any, Any]:
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


def direction(cos_theta: Any, sin_theta: Any, phi: Any) -> Any:
    """Unit vector in the local frame, normal along z."""
    sin_phi, cos_phi = dr.sincos(phi)
    return mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)


def jittered(lane: Any, number: Any, seed: Any) -> Any:
    """Place in the stratum of path `number` of stratum `lane`: an R2 sequence with a random start."""
    x, y = mi.sample_tea_32(lane, seed)
    scale = 2.0**-32
    x = mi.Float(x) * scale + mi.Float(number) * _R2[0]
    y = mi.Float(y) * scale + mi.Float(number) * _R2[1]
    return mi.Point2f(x - dr.floor(x), y - dr.floor(y))


def brightness(L: Any, count: int, M: int, N: int) -> Any:
    """Luminance of each stratum, blurred: a single path sees whether its stratum is bright; its neighbours may be too.

    Args:
        L: Color3f, radiance that the first look saw in each stratum.
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
    seen = mi.luminance(L)
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
def deviation_of_a_path(L: Any, bright: Any, count: int, M: int, N: int) -> Any:
    """Relative standard deviation of one path of the second look, as far as the first can tell.

    The variance within a stratum is taken to be that between it and the two before it: too much at edges, and nothing
    where all light comes from a spot that the first look missed.

    Args:
        L: Color3f, radiance that the first look saw in each stratum.
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
def _shares(bright: Any, record: Any, strata: int) -> tuple[Any, Any]:
    """Part of a record's paths that goes to a stratum: the first number, plus the second times its brightness."""
    i = mi.UInt32(0)
    total = mi.Float(0)
    while i < strata:
        total += dr.gather(mi.Float, bright, record * strata + i)
        i += 1
    even = dr.select(total > 0, mi.Float(EVEN), 1) / strata
    return even, dr.select(total > 0, (1 - EVEN) / total, 0)


@dr.syntax
def allocate(bright: Any, count: int, strata: int, paths: int) -> Any:
    """First path of each stratum in the second look.

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


def stratum_of(begin: Any, record: Any, number: Any, strata: int) -> Any:
    """Stratum to which path `number` of a record goes."""
    base = record * strata
    after = dr.binary_search(0, strata, lambda i: dr.gather(mi.UInt32, begin, base + i, i < strata) <= number)
    return after - 1


class Look(NamedTuple):
    """What one path saw; one lane a path."""

    L: Any  # Color3f, radiance
    distance: Any  # Float, to the first hit, metres; infinite if there is none
    tangent: Any  # Float, tangent of the elevation angle


def _grey(L: Any) -> Any:
    """Mean of the channels. Dr.Jit's own puts the number of lanes into the kernel as a constant."""
    return dr.sum(L) * (1 / 3)


@dr.syntax
def joined(first: Look, again: Look, begin: Any, strata: int, paths: int) -> Strata:
    """Means over the paths of both looks in each stratum.

    Args:
        first: one path in each stratum.
        again: `paths` for each record, in the order of their strata.
        begin: what `allocate` returned.
        strata: M*N.
        paths: of each record in the second look.
    """
    lane = dr.arange(mi.UInt32, dr.width(begin))
    record = lane // strata
    last = lane - record * strata == strata - 1
    following = dr.gather(mi.UInt32, begin, dr.select(last, lane, lane + 1))
    i = record * paths + begin
    end = record * paths + dr.select(last, paths, following)
    taken = mi.Float(end - i)
    # ---- loop state ----------------------------------------------------------------------
    L = mi.Color3f(0)  # sum of the second look's radiances
    grey = _grey(first.L)  # sum of the channels' means, over both looks
    squares = dr.square(grey)  # sum of their squares
    closeness = dr.rcp(first.distance)
    closest = dr.rcp(first.distance)
    nearest = dr.select(first.tangent < RIM, first.distance, mi.Float(dr.inf))
    while i < end:
        distance = dr.gather(mi.Float, again.distance, i)
        seen = dr.gather(mi.Color3f, again.L, i)
        L += seen
        grey += _grey(seen)
        squares += dr.square(_grey(seen))
        closeness += dr.rcp(distance)
        closest = dr.maximum(closest, dr.rcp(distance))
        above = dr.gather(mi.Float, again.tangent, i) < RIM
        nearest = dr.select(above, dr.minimum(nearest, distance), nearest)
        i += 1
    L = FIRST_SHARE * first.L + (1 - FIRST_SHARE) * L / taken
    # Of one path, from all in the stratum; then of the weighted mean. Paths spread evenly do better than that.
    variance = dr.maximum(squares - dr.square(grey) / (taken + 1), 0) / taken
    variance *= FIRST_SHARE**2 + (1 - FIRST_SHARE) ** 2 / taken
    return Strata(L, variance, closeness / (taken + 1), closest, nearest)


@dr.syntax
def reduced(strata: Strata, normal: Any, M: int, N: int) -> dict[str, Any]:
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


def _tangents(sin2: Any) -> Any:
    """Integral of tan theta over sin² theta, from 0."""
    return dr.safe_asin(dr.safe_sqrt(sin2)) - dr.safe_sqrt(sin2 * (1 - sin2))
