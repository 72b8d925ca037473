"""The hemisphere above a record: its strata, pilot samples that find where light comes from, and refinement samples.

A record's hemisphere is divided into M x N cosine-weighted strata (Ward & Heckbert 1992). Indoors, nearly all light
arrives through few of them: sunlit patches, openings, pools of lamp light. Pilot samples take one path per stratum. The
refinement samples are then sent to strata where pilot samples found light, where emitter samples found the sky (`sky`),
or where paths towards bright hits of other records found light (`reuse`); each stratum gets at least one. The number
per stratum does not depend on the refinement samples, so their mean is unbiased whatever was seen before.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.sampling import stepped
from steadylight.renderers.mitsuba.search import first_above

RIM = 5.67
"""Tangent of the polar angle (80 degrees) beyond which a hit is not an obstacle but the floor itself."""

OVERHEAD = 0.5
"""Tangent of the polar angle (27 degrees) within which a hit is above the record rather than beside it."""

BEYOND = 2.0
"""A hit at more than this many times its stratum's least distance lies beyond a depth edge. A single surface spans such
a ratio only at the horizon, or if it is a wall beside the record seen at a grazing angle; its parts then move as it
would."""

EVEN = 0.35
"""Fraction of the refinement samples that is distributed evenly, for light that nothing has seen before."""


class Parts(NamedTuple):
    """The near and the far part of each stratum, divided by a depth edge; each part moves at its own speed.

    Estimated from refinement samples alone, or from a pilot sample (`undivided`). Without an edge, all are near.
    """

    beyond: mi.Float  # fraction of the samples that are far: beyond the edge, in [0, 1)
    near_light: mi.Color3f  # mean radiance of the near samples
    far_light: mi.Color3f  # mean radiance of the far samples; zero if there are none
    near_closeness: mi.Float  # maximum 1 / distance of the near samples, 1/metres
    far_closeness: mi.Float  # maximum 1 / distance of the far samples, 1/metres; zero if there are none


class Strata(NamedTuple):
    """Radiance and distances of each stratum; lane = record * M*N + j * N + k, elevation j and azimuth k."""

    L: mi.Color3f  # mean radiance
    variance: mi.Float  # estimated variance of that mean's mean over the channels
    closeness: mi.Float  # mean of 1 / distance, 1/metres
    nearest: mi.Float  # minimum distance of a hit above the rim, metres
    headroom: mi.Float  # minimum height of a hit that is overhead, metres
    parts: Parts


class Guide(NamedTuple):
    """Estimate of each stratum, mean of the channels, from half of the refinement samples."""

    L: mi.Float
    variance: mi.Float  # estimated variance of that mean
    near_light: mi.Float  # of the near part; from all refinement samples if this half has none there
    far_light: mi.Float  # of the far part; likewise


class Halves(NamedTuple):
    """Comparison of two halves of the refinement samples of each stratum, which take alternate samples.

    Where a stratum has a single refinement sample, both halves consist of that sample, and both guides use the pilot
    sample instead.
    """

    difference: mi.Color3f  # half the difference between the two means
    brightest: tuple[mi.Float, mi.Float]  # largest contribution of one sample to each mean
    guides: tuple[Guide, Guide]


def split(lane: mi.UInt32, each: int | mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """The record that a lane belongs to, and the lane's number within it, for `each` consecutive lanes per record."""
    record = lane // each
    return record, lane - record * each


def angles(
    stratum: mi.UInt32, jitter: mi.Point2f, M: mi.UInt32, N: mi.UInt32
) -> tuple[mi.Float, mi.Float, mi.Float]:
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


def stratum_towards(d: mi.Vector3f, M: mi.UInt32, N: mi.UInt32) -> mi.UInt32:
    """The stratum, j * N + k, of a unit vector in the local frame; see `angles`."""
    return place_towards(d, M, N)[0]


def place_towards(d: mi.Vector3f, M: mi.UInt32, N: mi.UInt32) -> tuple[mi.UInt32, mi.Point2f]:
    """The stratum of a unit vector in the local frame, and the position within it, [0, 1)²; see `angles`."""
    turn = dr.atan2(d.y, d.x) * (0.5 * dr.inv_pi)
    x, y = (1 - dr.square(d.z)) * M, (turn - dr.floor(turn)) * N
    j, k = dr.minimum(mi.UInt32(x), M - 1), dr.minimum(mi.UInt32(y), N - 1)
    below_one = dr.one_minus_epsilon(mi.Float)
    return j * N + k, mi.Point2f(
        dr.clip(x - mi.Float(j), 0, below_one), dr.clip(y - mi.Float(k), 0, below_one)
    )


def jittered(lane: mi.UInt32, number: mi.UInt32, seed: mi.UInt32) -> mi.Point2f:
    """Position in stratum `lane` of its path `number`: an R2 sequence with a random start keeps paths apart."""
    x, y = mi.sample_tea_32(lane, seed)
    scale = 2.0**-32
    return stepped(mi.Point2f(mi.Float(x) * scale, mi.Float(y) * scale), mi.Float(number))


def brightness(seen: mi.Float, M: mi.UInt32, N: mi.UInt32) -> mi.Float:
    """Luminance of each stratum, blurred: where a single path saw light, neighbouring strata may be bright too.

    Args:
        seen: Float, luminance seen in each stratum.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        Float, by stratum.
    """
    strata = M * N
    lane = dr.arange(mi.UInt32, dr.width(seen))
    base = (lane // strata) * strata
    stratum = lane - base
    j = stratum // N
    k = stratum - j * N
    bright = mi.Float(0)
    for dj in (-1, 0, 1):
        row = dr.select((dj < 0) & (j == 0), j, dr.minimum(mi.UInt32(mi.Int32(j) + dj), M - 1))
        for dk in (-1, 0, 1):
            column = mi.UInt32(mi.Int32(k + N) + dk) % N
            share = 4.0 / (16 * 2 ** (abs(dj) + abs(dk)))
            # Negative where rays subtract the excess of a BSDF's Lambertian part (see `lobes`); fractions of paths
            # cannot be.
            bright += share * dr.maximum(dr.gather(mi.Float, seen, base + row * N + column), 0)
    dr.eval(bright)
    return bright


@dr.syntax
def error_of_one_path(
    seen: mi.Float, bright: mi.Float, count: int, strata: tuple[mi.UInt32, mi.UInt32], faint: mi.Float
) -> mi.Float:
    """Relative standard error of one refinement path, as estimated beforehand.

    The variance within a stratum is taken from the differences to two of its neighbours. It is too large at edges, and
    zero if all light comes from a spot that no sample saw.

    Args:
        seen: Float, luminance seen in each stratum, at least 0.
        bright: from `brightness`.
        count: number of records.
        strata: M in elevation, N in azimuth.
        faint: Float, irradiance, W/m², added to that of the record in the denominator.

    Returns:
        Float, by record; divided by the square root of a number of paths, it is the relative standard error of their
        mean. 0 for a record that saw no light.
    """
    M, N = strata
    record = dr.arange(mi.UInt32, count)
    base = record * (M * N)
    even, guided = _shares(bright, record, M * N)
    # ---- loop state ----------------------------------------------------------------------
    i = mi.UInt32(0)  # stratum j * N + k
    total = mi.Float(0)  # sum of the luminances
    variance = mi.Float(0)  # of that sum, for one path
    while i < M * N:
        here = base + i
        k = i - (i // N) * N
        L_jk = dr.gather(mi.Float, seen, here)
        above = dr.gather(mi.Float, seen, dr.select(i >= N, here - N, here + N))
        beside = dr.gather(mi.Float, seen, dr.select(k > 0, here - 1, here + (N - 1)))
        within = (dr.square(L_jk - above) + dr.square(L_jk - beside)) / 4
        variance += within / (even + guided * dr.gather(mi.Float, bright, here))
        total += L_jk
        i += 1
    return dr.select(total > 0, dr.sqrt(variance) / (total + faint * (M * N * dr.inv_pi)), 0)


@dr.syntax
def _shares(bright: mi.Float, record: mi.UInt32, strata: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Fraction of a record's paths that a stratum gets: the first number, plus the second times its brightness."""
    i = mi.UInt32(0)
    total = mi.Float(0)
    while i < strata:
        total += dr.gather(mi.Float, bright, record * strata + i)
        i += 1
    even = dr.select(total > 0, mi.Float(EVEN), 1) / strata
    return even, dr.select(total > 0, (1 - EVEN) / total, 0)


@dr.syntax
def allocate(bright: mi.Float, count: int, strata: mi.UInt32, paths: mi.UInt32) -> mi.UInt32:
    """First refinement path of each stratum.

    Args:
        bright: from `brightness`.
        count: number of records.
        strata: M*N.
        paths: number per record, at least M*N.

    Returns:
        UInt32, by stratum: it gets paths [begin, begin of the next stratum) of the record, at least one.
    """
    # One lane per record loops over its strata twice, first for the sum, then to assign the paths.
    record = dr.arange(mi.UInt32, count)
    base = record * strata
    even, guided = _shares(bright, record, strata)
    begin = dr.zeros(mi.UInt32, dr.width(bright))
    i = mi.UInt32(0)
    before = mi.Float(0)  # fraction of the paths of all strata before this one
    while i < strata:
        spread = mi.UInt32(dr.minimum(before, 1) * mi.Float(paths - strata))
        dr.scatter(begin, i + dr.minimum(spread, paths - strata), base + i)
        before += even + guided * dr.gather(mi.Float, bright, base + i)
        i += 1
    return begin


def stratum_of(begin: mi.UInt32, record: mi.UInt32, number: mi.UInt32, strata: mi.UInt32) -> mi.UInt32:
    """Stratum of path `number` of a record: the last that does not begin after it."""
    base = record * strata
    return first_above(begin, number, base, base + strata, mi.Bool(True)) - base - 1


class PathSamples(NamedTuple):
    """Results of paths; one lane per path."""

    L: mi.Color3f  # radiance
    distance: mi.Float  # to the first hit, metres; infinite if there is none
    tangent: mi.Float  # tangent of the polar angle, from the normal


def undivided(samples: PathSamples) -> Parts:
    """The parts of strata that a single path each has sampled."""
    none = dr.zeros(mi.Float, dr.width(samples.distance))
    return Parts(none, samples.L, mi.Color3f(none, none, none), dr.rcp(samples.distance), none)


def grey(L: mi.Color3f) -> mi.Float:
    """Mean of the channels. Dr.Jit's own compiles the number of lanes into the kernel as a literal."""
    return dr.sum(L) * (1 / 3)


def combined(
    pilot: PathSamples,
    refinement: PathSamples,
    begin: mi.UInt32,
    M: mi.UInt32,
    N: mi.UInt32,
    paths: mi.UInt32,
) -> tuple[Strata, Halves]:
    """Means over the samples of each stratum: light and parts from refinement samples, distances from pilot ones too.

    The pilot samples determine how many refinement samples a stratum gets, and they are part of the guides. They are
    not part of the means, because a guide must be independent of what it weights.

    Args:
        pilot: one path per stratum.
        refinement: `paths` for each record, ordered by stratum.
        begin: result of `allocate`.
        M: strata in elevation.
        N: strata in azimuth.
        paths: number of refinement samples per record.
    """
    strata = M * N
    lane = dr.arange(mi.UInt32, dr.width(begin))
    record, stratum = split(lane, strata)
    last = stratum == strata - 1
    following = dr.gather(mi.UInt32, begin, dr.select(last, lane, lane + 1))
    i = record * paths + begin
    end = record * paths + dr.select(last, paths, following)
    taken = mi.Float(end - i)
    first, second, near = _summed(pilot, refinement, i, end)

    # The second half is empty if there is only one sample.
    alone = end - i == 1
    count = mi.Vector2f(mi.Float((end - i + 1) // 2), mi.Float((end - i) // 2))
    mean = first.L / count.x
    other = dr.select(alone, mean, second.L / dr.maximum(count.y, 1))

    # Variance of one path, from all samples of the stratum; then that of the mean of both means.
    light = grey(pilot.L)
    total = light + grey(first.L) + grey(second.L)
    squares = dr.square(light) + first.squares + second.squares
    variance = dr.maximum(squares - dr.square(total) / (taken + 1), 0) / taken
    variance *= dr.select(alone, 1, (dr.rcp(count.x) + dr.rcp(dr.maximum(count.y, 1))) / 4)

    # A single pilot sample: take its variance from its differences to neighbours.
    k = stratum - stratum // N * N
    above = grey(dr.gather(mi.Color3f, pilot.L, dr.select(stratum >= N, lane - N, lane + N)))
    beside = grey(dr.gather(mi.Color3f, pilot.L, dr.select(k > 0, lane - 1, lane + (N - 1))))
    unknown = (dr.square(light - above) + dr.square(light - beside)) / 4

    one_far, other_far, far_closeness = _beyond(refinement, near.closest, i, end)

    beyond = one_far.count + other_far.count
    far_light = one_far.L + other_far.L
    parts = Parts(
        beyond / taken,
        (first.L + second.L - far_light) / (taken - beyond),
        far_light / dr.maximum(beyond, 1),
        near.closest,
        far_closeness,
    )

    def guide(half: _Half, far: _Far, n: mi.Float) -> Guide:
        n = dr.maximum(n, 1)
        sum_of_half, sum_of_far = grey(half.L), grey(far.L)
        spread = dr.square(light) + half.squares - dr.square(light + sum_of_half) / (n + 1)
        variance = dr.select(alone, unknown, dr.maximum(spread, 0) / dr.square(n))
        whole = dr.select(alone, light, sum_of_half / n)
        near_light = dr.select(
            far.count == n, grey(parts.near_light), (sum_of_half - sum_of_far) / (n - far.count)
        )
        near_light = dr.select(alone, light, near_light)
        far_light = dr.select(far.count == 0, grey(parts.far_light), sum_of_far / far.count)
        return Guide(whole, variance, near_light, far_light)

    greatest = first.greatest / count.x
    brightest = greatest, dr.select(alone, greatest, second.greatest / dr.maximum(count.y, 1))
    halves = Halves(
        (mean - other) / 2, brightest, (guide(first, one_far, count.x), guide(second, other_far, count.y))
    )
    closeness = near.closeness / (taken + 1)
    return Strata((mean + other) / 2, variance, closeness, near.nearest, near.headroom, parts), halves


class _Half(NamedTuple):
    """Sums over half of the refinement samples of each stratum."""

    L: mi.Color3f
    squares: mi.Float  # of the channels' mean
    greatest: mi.Float  # of the channels' mean


class _Far(NamedTuple):
    """Sums over the samples in half of the refinement samples of each stratum that lie beyond a depth edge."""

    count: mi.Float
    L: mi.Color3f


class _Near(NamedTuple):
    """Distances of the hits of a stratum, from all samples except for `closest`; see `Strata` and `Parts`."""

    closeness: mi.Float  # sum of 1 / distance
    closest: mi.Float  # maximum 1 / distance of the refinement samples, 1/metres
    nearest: mi.Float
    headroom: mi.Float


def _overhead(distance: mi.Float, tangent: mi.Float) -> mi.Float:
    """Height of a hit, metres; infinite if it is not overhead."""
    return dr.select(tangent < OVERHEAD, distance * dr.rsqrt(1 + dr.square(tangent)), dr.inf)


@dr.syntax
def _summed(
    pilot: PathSamples, refinement: PathSamples, i: mi.UInt32, end: mi.UInt32
) -> tuple[_Half, _Half, _Near]:
    """Sums over the refinement samples [i, end) of each stratum, by halves, and distances over all its samples."""
    i = mi.UInt32(i)
    # ---- loop state ----------------------------------------------------------------------
    L, L_other = mi.Color3f(0), mi.Color3f(0)  # sums of radiances, of the half that is next and of the other
    squares, squares_other = mi.Float(0), mi.Float(0)  # of the channels' means
    greatest, greatest_other = mi.Float(0), mi.Float(0)  # of the channels' means
    turned = mi.Bool(False)  # whether the half that is next is the second
    closeness = dr.rcp(pilot.distance)
    closest = mi.Float(0)
    nearest = dr.select(pilot.tangent < RIM, pilot.distance, mi.Float(dr.inf))
    headroom = _overhead(pilot.distance, pilot.tangent)
    while i < end:
        distance = dr.gather(mi.Float, refinement.distance, i)
        seen = dr.gather(mi.Color3f, refinement.L, i)
        grown, grown_squares = L + seen, squares + dr.square(grey(seen))
        grown_greatest = dr.maximum(greatest, grey(seen))
        L, squares, greatest = mi.Color3f(L_other), mi.Float(squares_other), mi.Float(greatest_other)
        L_other, squares_other, greatest_other = grown, grown_squares, grown_greatest
        turned = ~turned
        closeness += dr.rcp(distance)
        closest = dr.maximum(closest, dr.rcp(distance))
        tangent = dr.gather(mi.Float, refinement.tangent, i)
        nearest = dr.select(tangent < RIM, dr.minimum(nearest, distance), nearest)
        headroom = dr.minimum(headroom, _overhead(distance, tangent))
        i += 1
    one, other = _Half(L, squares, greatest), _Half(L_other, squares_other, greatest_other)
    near = _Near(closeness, closest, nearest, headroom)
    return _select(turned, other, one), _select(turned, one, other), near


def _select(mask: mi.Bool, this: _Half, that: _Half) -> _Half:
    return _Half(*(dr.select(mask, a, b) for a, b in zip(this, that, strict=True)))


@dr.syntax
def _beyond(
    refinement: PathSamples, closest: mi.Float, i: mi.UInt32, end: mi.UInt32
) -> tuple[_Far, _Far, mi.Float]:
    """Refinement samples [i, end) of each stratum that lie beyond a depth edge, by halves, and how near they come.

    Args:
        refinement: all samples.
        closest: maximum 1 / distance in each stratum, 1/metres.
        i: index of the first sample.
        end: index after the last.

    Returns:
        Sums over samples 1, 3, ..., sums over samples 2, 4, ..., and the maximum 1 / distance.
    """
    i = mi.UInt32(i)
    # ---- loop state ----------------------------------------------------------------------
    count, count_other = mi.Float(0), mi.Float(0)
    L, L_other = mi.Color3f(0), mi.Color3f(0)
    closeness = mi.Float(0)
    second = mi.Bool(False)  # whether the sample belongs to the second half
    while i < end:
        near = dr.rcp(dr.gather(mi.Float, refinement.distance, i))
        seen = dr.gather(mi.Color3f, refinement.L, i)
        beyond = near * BEYOND < closest
        count += dr.select(beyond & ~second, 1, 0)
        count_other += dr.select(beyond & second, 1, 0)
        L += dr.select(beyond & ~second, seen, 0)
        L_other += dr.select(beyond & second, seen, 0)
        closeness = dr.select(beyond, dr.maximum(closeness, near), closeness)
        second = ~second
        i += 1
    return _Far(count, L), _Far(count_other, L_other), closeness
