"""The second derivative of irradiance over a surface: the occlusion Hessian of what a record's hemisphere saw.

Gradients extrapolate a record's light to first order. Their error is the second derivative, so this determines the
radius (Schwarzhaupt, Jensen & Jarosz 2012, doi:10.1145/2366145.2366212). The centres of the strata, each at the
distance of what it saw, are joined to a mesh of triangles of constant radiance around the record. The irradiance from
such a mesh is a sum over its edges (Lambert), which can be differentiated twice; an edge is weighted by the difference
of radiance across it. A triangle that spans a depth edge takes its radiance from what lies behind: when the record
moves, that is what is uncovered or hidden.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.records.hemisphere import direction

UNCOVERED = 4
"""Exponent of a vertex's distance in its weight for the radiance of a triangle: the farthest dominates."""

FAR = 30.0
"""Maximum distance, in units of the harmonic mean distance: what lies beyond does not move with the record."""

FAINTEST = 0.01
"""Minimum radiance of a triangle, as a fraction of the mean, so that black ones bound the relative error too."""


def second_derivatives(
    radiance: mi.Float, closeness: mi.Float, M: int, N: int
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Second derivatives of relative irradiance by translation in the tangent plane of each record.

    Args:
        radiance: Float, mean of the channels in each stratum, M*N lanes for each record.
        closeness: Float, mean of 1 / distance in each stratum, 1/metres.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        By record, Floats in 1/metres²: E_xx / E, E_xy / E and E_yy / E in the local frame.
    """
    count = M * N
    lane = dr.arange(mi.UInt32, dr.width(radiance))
    record = lane // count
    j = (lane - record * count) // N
    k = lane - record * count - j * N
    beside = dr.select(k + 1 < N, lane + 1, lane + 1 - N)  # k + 1, around
    before = dr.select(k > 0, lane - 1, lane + (N - 1))  # k - 1
    below = dr.select(j + 1 < M, lane + N, lane)  # j + 1; the horizon repeats the lowest ring
    above = dr.select(j > 0, lane - N, lane)  # j - 1

    # Scale lengths by the harmonic mean distance and radiances by their mean, so that no power overflows.
    sums = dr.block_reduce(dr.ReduceOp.Add, closeness, count)
    unit = dr.gather(mi.Float, sums, record) * (1 / count)
    mean = dr.gather(mi.Float, dr.block_reduce(dr.ReduceOp.Add, radiance, count), record) * (1 / count)
    in_cap = dr.gather(mi.Float, dr.block_reduce(dr.ReduceOp.Add, radiance, N), record * M) * (1 / N)

    def relative(value: mi.Float) -> mi.Float:
        return dr.select(mean > 0, FAINTEST + (1 - FAINTEST) * value / mean, 1)

    def distance_of(stratum: mi.UInt32) -> mi.Float:
        distance = dr.minimum(unit / dr.gather(mi.Float, closeness, stratum), FAR)
        return dr.select(unit > 0, distance, FAR)

    # Triangles of the quad that starts at a stratum: (here, below, across) and (here, across, beside). Each lane
    # computes those of its neighbours too, which takes less time than another kernel.
    def triangle(*corners: mi.UInt32) -> mi.Float:
        total, weights = mi.Float(0), mi.Float(0)
        for corner in corners:
            weight = distance_of(corner) ** UNCOVERED
            total += weight * relative(dr.gather(mi.Float, radiance, corner))
            weights += weight
        return total / weights

    across = dr.select(j + 1 < M, beside + N, beside)
    lower, upper = triangle(lane, below, across), triangle(lane, across, beside)
    lower_above = triangle(above, lane, beside)
    upper_before = triangle(before, below, lane)

    def vertex(index: mi.UInt32, ring: mi.UInt32, column: mi.UInt32) -> mi.Vector3f:
        sin2 = dr.select(ring < M, (mi.Float(ring) + 0.5) * (1 / M), 1)
        phi = (2 * dr.pi / N) * (mi.Float(column) + 0.5)
        ray = direction(dr.safe_sqrt(1 - sin2), dr.sqrt(sin2), phi)
        return ray * distance_of(index)

    here, under = vertex(lane, j, k), vertex(below, j + 1, k)
    next_here, next_under = vertex(beside, j, k + 1), vertex(across, j + 1, k + 1)

    # Edges of the quad, each with the radiance difference between its two sides.
    left = dr.select(j > 0, lower_above, relative(in_cap))
    total = _edge(here, next_here, left - upper)
    total += _edge(here, under, lower - upper_before)
    total += _edge(here, next_under, upper - lower)
    total += _edge(under, next_under, dr.select(j + 1 < M, 0, lower))
    dr.eval(total)
    # The mean radiance is 1 and its irradiance pi.
    scale = dr.square(sums * (1 / count)) * dr.inv_pi
    xx, xy, yy = (dr.block_reduce(dr.ReduceOp.Add, part, count) * scale for part in total)
    return xx, xy, yy


def _edge(a: mi.Vector3f, b: mi.Vector3f, light: mi.Float) -> mi.Vector3f:
    """Second derivatives xx, xy, yy of what an edge from a to b adds to the irradiance of a record at the origin.

    With r(s) = a + s c along the edge, c = b - a, Lambert's term is P I, where P = n . (a x c) is linear in the
    position of the record and I is the integral of 1 / r^2. Their derivatives are integrals of s^i / r^4 and s^i / r^6,
    which have closed forms.

    Args:
        a: Vector3f, local frame.
        b: Vector3f.
        light: Float, radiance inside minus radiance outside.
    """
    c = b - a
    A, B, C = dr.dot(a, a), dr.dot(a, c), dr.dot(c, c)
    D = dr.maximum(dr.squared_norm(dr.cross(a, c)), 1e-12 * A * C)
    q0, q1 = A, dr.dot(b, b)
    first, last = B, B + C
    # I_n = integral of r^-2n, by recurrence.
    I1 = dr.atan2(dr.sqrt(D), dr.dot(a, b)) * dr.rsqrt(D)
    I2 = (last / q1 - first / q0) / (2 * D) + C / (2 * D) * I1
    I3 = (last / dr.square(q1) - first / dr.square(q0)) / (4 * D) + 3 * C / (4 * D) * I2
    # ... and with factors s and s^2.
    I2s = (dr.rcp(q0) - dr.rcp(q1)) / (2 * C) - B / C * I2
    I3s = (dr.rcp(dr.square(q0)) - dr.rcp(dr.square(q1))) / (4 * C) - B / C * I3
    I3ss = (I2 - A * I3 - 2 * B * I3s) / C
    P = a.x * c.y - a.y * c.x
    # Gradients of -P and of I.
    m = mi.Vector2f(c.y, -c.x)
    g = 2 * (mi.Vector2f(a.x, a.y) * I2 + mi.Vector2f(c.x, c.y) * I2s)

    def second(i: tuple[mi.Float, ...], k: tuple[mi.Float, ...], same: float) -> mi.Float:
        (ai, ci, m_i, gi), (ak, ck, m_k, gk) = i, k
        curve = 8 * (ai * ak * I3 + (ai * ck + ci * ak) * I3s + ci * ck * I3ss) - 2 * same * I2
        return P * curve - (m_i * gk + gi * m_k)

    x = (a.x, c.x, m.x, g.x)
    y = (a.y, c.y, m.y, g.y)
    return mi.Vector3f(second(x, x, 1), second(x, y, 0), second(y, y, 1)) * (0.5 * light)
