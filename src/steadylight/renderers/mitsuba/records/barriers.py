"""The nearest walls beside a record, from what its paths saw low above its surface.

What stands on a surface divides it: the floor on both sides of a partition, the jamb of a window on both sides of the
pane. A record on one side says nothing about the other, however near that is. It may still have a radius that extends
there, since no radius is smaller than some pixels.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def nearest_barriers(
    closeness: mi.Float, normal: mi.Normal3f, M: mi.UInt32, N: mi.UInt32
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The two walls that block most of what each record sees along its surface, one lane per record.

    A wall at distance d and azimuth a is seen by a horizontal ray of azimuth phi at 1 / distance = cos(phi - a) / d,
    which is linear in the direction of the ray. So a wall is fitted by least squares to the 1 / distance within 30
    degrees of each azimuth. The nearest one is taken, and the nearest of those at right angles to it or opposite: a
    record may lie in a corner or in a slot. If a table leg or a plant fills only part of the 60 degrees, the fitted
    wall is further away than it, or beyond the record's radius.

    The second lowest ring of strata is used: the lowest one also sees the surface itself, where it is not quite flat.

    Args:
        closeness: Float, 1 / distance of each stratum, 1/metres, M*N lanes for each record.
        normal: Normal3f of each record, unit.
        M: strata in elevation.
        N: strata in azimuth.

    Returns:
        Two Vector3f, world, 1/metres: towards a wall, 1 / its distance along the surface; zero if there is none. The
        wall is where the dot product of this with the offset from the record is one.
    """
    # Rescaled by the ratio of distance to horizontal distance.
    j = dr.maximum(M, 2) - 2
    ring = dr.arange(mi.UInt32, dr.width(normal)) * (M * N) + j * N
    horizontal = dr.rsqrt((mi.Float(j) + 0.5) / M)
    first = _nearest(closeness, ring, N, dr.zeros(mi.Vector2f, dr.width(normal)))
    second = _nearest(closeness, ring, N, first)
    frame = mi.Frame3f(normal)

    def in_world(wall: mi.Vector2f) -> mi.Vector3f:
        return frame.to_world(horizontal * mi.Vector3f(wall.x, wall.y, 0))

    return in_world(first), in_world(second)


@dr.syntax
def _nearest(closeness: mi.Float, ring: mi.UInt32, N: mi.UInt32, taken: mi.Vector2f) -> mi.Vector2f:
    """The nearest wall in a ring of strata, seen from each record, local frame, 1/metres.

    Args:
        closeness: Float, of all strata.
        ring: UInt32, first stratum of the ring.
        N: strata in the ring.
        taken: Vector2f, direction of a wall that is known already; zero if none is.
    """
    step = 2 * dr.pi / N
    aside = N // 12
    # ---- loop state ----------------------------------------------------------------------
    k = mi.UInt32(0)  # azimuth
    nearest = mi.Float(0)  # 1 / distance of the nearest wall so far
    wall = mi.Vector2f(0)  # it
    while k < N:
        s, c = dr.sincos((mi.Float(k) + 0.5) * step)
        centre = mi.Vector2f(c, s)
        i = mi.UInt32(0)
        # Sums of 1 / distance, by the cosine and the sine of the azimuth, and the same for a wall at 1 m.
        along, across = mi.Float(0), mi.Float(0)
        along_unit, across_unit = mi.Float(0), mi.Float(1e-6)
        while i <= 2 * aside:
            seen = dr.gather(mi.Float, closeness, ring + (k + i + N - aside) % N)
            sine, cosine = dr.sincos((mi.Float(i) - mi.Float(aside)) * step)
            along += seen * cosine
            across += seen * sine
            along_unit += dr.square(cosine)
            across_unit += dr.square(sine)
            i += 1
        along /= along_unit
        across /= across_unit
        counts = (along > nearest) & (dr.dot(centre, taken) <= 0)
        wall = dr.select(counts, along * centre + across * mi.Vector2f(-s, c), wall)
        nearest = dr.select(counts, along, nearest)
        k += 1
    return wall
