"""Irradiance and its gradients from the strata of a hemisphere (Ward & Heckbert 1992).

When a record moves, the walls between its strata move, each with the nearer of the two surfaces that it separates. A
depth edge seldom runs along a wall: it divides a stratum into a near and a far part, which are treated separately here.
If the mean of both moved with the near part, what lies far behind the edge would move just as fast; where a small
bright patch appears behind the edge, half of the gradient or more would be lost.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from steadylight.renderers.mitsuba.records.hemisphere import Parts, Strata, grey


@dr.syntax
def reduced(strata: Strata, normal: mi.Normal3f, M: mi.UInt32, N: mi.UInt32) -> dict[str, Any]:
    """Sums over the strata of each record, one lane per record, in a fixed order, so that they are reproducible.

    Args:
        strata: radiance and distances, M*N lanes for each record.
        normal: Normal3f of each record.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        By record: `E`, sum of L; `variance`, sum of variances; `horizon`, sum of the channels' mean L in the lowest
        ring of strata; `closeness`, sum of 1/distance; `nearest`, minimum distance above the rim; `headroom`, minimum
        height of what is overhead; and the gradients of channel c in the world frame, `t_c` by translation and `r_c` by
        rotation. The sums still lack the factor pi / (M N).
    """
    record = dr.arange(mi.UInt32, dr.width(normal))
    base = record * (M * N)
    frame = mi.Frame3f(normal)
    # ---- loop state ----------------------------------------------------------------------
    i = mi.UInt32(0)  # stratum j * N + k
    E = mi.Color3f(0)  # sum of radiances
    variance = mi.Float(0)  # of that sum's mean over the channels
    horizon = mi.Float(0)  # sum of the channels' means in the lowest ring
    closeness = mi.Float(0)  # sum of 1 / distance
    nearest = mi.Float(dr.inf)  # minimum distance
    headroom = mi.Float(dr.inf)  # minimum height
    t_r, t_g, t_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # translational gradient, local frame
    r_r, r_g, r_b = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)  # rotational gradient, local frame
    while i < M * N:
        j = i // N
        k = i - j * N
        here = base + i
        L_jk = dr.gather(mi.Color3f, strata.L, here)
        E += L_jk
        variance += dr.gather(mi.Float, strata.variance, here)
        horizon += dr.select(j == M - 1, grey(L_jk), 0)
        closeness += dr.gather(mi.Float, strata.closeness, here)
        nearest = dr.minimum(nearest, dr.gather(mi.Float, strata.nearest, here))
        headroom = dr.minimum(headroom, dr.gather(mi.Float, strata.headroom, here))

        # Directions u_k (azimuth of the stratum's centre), v_k and v_k- (a quarter turn further).
        s, c = dr.sincos((2 * dr.pi / N) * (mi.Float(k) + 0.5))
        s_minus, c_minus = dr.sincos((2 * dr.pi / N) * mi.Float(k))
        v = mi.Vector3f(-s, c, 0)
        v_minus = mi.Vector3f(-s_minus, c_minus, 0)

        # Rotation: tilting the normal towards u adds light by the tangent of the polar angle (eq. 8; our axis is
        # record normal x query normal, theirs the opposite). We take the mean tangent of the stratum: that of a single
        # path near the horizon has infinite variance.
        lean = M * (_tangents(mi.Float(j + 1) / M) - _tangents(mi.Float(j) / M))
        r_r += v * (lean * L_jk.x)
        r_g += v * (lean * L_jk.y)
        r_b += v * (lean * L_jk.z)

        # Translation: the walls between strata move (eq. 11). As the record rises, they sink towards the horizon; that
        # matters where its normal is interpolated, and its surface does not lie at right angles to it.
        above = dr.select(j > 0, here - N, here)  # towards the pole
        beside = dr.select(k > 0, here - 1, here + (N - 1))  # around
        sin2_minus = mi.Float(j) / M
        sin_minus = dr.sqrt(sin2_minus)
        sin_plus = dr.sqrt(mi.Float(j + 1) / M)
        cos_minus = dr.sqrt(1 - sin2_minus)
        polar = (2 * dr.pi / N) * sin_minus * cos_minus * _moved(strata.parts, above, here)
        around = (sin_plus - sin_minus) * _moved(strata.parts, beside, here)
        towards = mi.Vector3f(c * cos_minus, s * cos_minus, -sin_minus)
        t_r += towards * polar.x + v_minus * around.x
        t_g += towards * polar.y + v_minus * around.y
        t_b += towards * polar.z + v_minus * around.z
        i += 1
    return {
        "E": E,
        "variance": variance,
        "horizon": horizon,
        "closeness": closeness,
        "nearest": nearest,
        "headroom": headroom,
        "t_r": frame.to_world(t_r),
        "t_g": frame.to_world(t_g),
        "t_b": frame.to_world(t_b),
        "r_r": frame.to_world(r_r),
        "r_g": frame.to_world(r_g),
        "r_b": frame.to_world(r_b),
    }


def _moved(parts: Parts, a: mi.UInt32, b: mi.UInt32) -> mi.Color3f:
    """Radiance of stratum b minus that of stratum a, times the closeness with which their wall moves, 1/metres.

    Their parts are paired in order of distance, near with near and far with far; the remaining near part of one is
    paired with the remaining far part of the other.
    """

    def at(index: mi.UInt32) -> Parts:
        return Parts(*(dr.gather(type(array), array, index) for array in parts))

    one, other = at(a), at(b)
    near = dr.minimum(1 - one.beyond, 1 - other.beyond) * dr.maximum(one.near_closeness, other.near_closeness)
    far = dr.minimum(one.beyond, other.beyond) * dr.maximum(one.far_closeness, other.far_closeness)
    turned = one.beyond > other.beyond  # the rest of a is far, that of b near
    closer = dr.select(
        turned,
        dr.maximum(one.far_closeness, other.near_closeness),
        dr.maximum(one.near_closeness, other.far_closeness),
    )
    rest = dr.select(turned, other.near_light - one.far_light, other.far_light - one.near_light)
    return (
        near * (other.near_light - one.near_light)
        + far * (other.far_light - one.far_light)
        + dr.abs(one.beyond - other.beyond) * closer * rest
    )


def _tangents(sin2: mi.Float) -> mi.Float:
    """Integral of tan theta over sin² theta, from 0."""
    return dr.safe_asin(dr.safe_sqrt(sin2)) - dr.safe_sqrt(sin2 * (1 - sin2))
