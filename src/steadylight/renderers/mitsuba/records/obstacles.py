"""Which records are trusted at a point while the cache is filled: none whose radius extends over a nearby obstacle.

A record far from a picture frame does not see its thickness, but would contribute right up to its edge, where the frame
covers half of the hemisphere: contact shadows would be lost wherever no record happened to be made. Neighbour clamping
(Krivanek et al. 2006) solves this among existing records. We query the geometry instead, with a few short rays from
each look-up point, so that the result depends on no order. The last round of the audit traces no such rays.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

OBSTACLE = 2.0
"""A record is trusted only if its radius is at most this many times the distance from the point to an obstacle."""

PROBES = 8
PROBE_HEIGHTS = (0.15, 0.5)
"""Number of short rays around a point, and the alternating sines of their elevation: for low ledges and near walls."""


class Trust(NamedTuple):
    """Bounds on the radius of records that are trusted or requested at a point, while the cache is filled."""

    eye: mi.Point3f  # camera position
    detail: mi.Float  # smallest radius requested, metres per metre of distance from the camera
    smallest: mi.Float  # smallest radius of any record, metres
    farthest: mi.Float  # largest radius, metres
    weakest: mi.Float  # throughput below which the requested radius stops growing; 1 if it is constant


def wanted_spacing(
    si: mi.SurfaceInteraction3f, travelled: mi.Float, throughput: mi.Color3f, trust: Trust
) -> mi.Float:
    """Lower bound of the radius that this path needs at `si`, metres.

    What a faint mirror shows is a small part of the picture. Since the error within a record's radius grows with the
    square of the radius, the radius may grow with the inverse square root of the throughput.

    Args:
        si: the point.
        travelled: Float, length of the path from the camera, metres.
        throughput: Color3f, of the path.
        trust: of this view.
    """
    # A record's lower bound uses the straight distance to the camera, and a camera ray starts at the near clip plane.
    distance = dr.maximum(travelled, dr.norm(si.p - trust.eye))
    worth = dr.clip(dr.max(dr.abs(throughput)), trust.weakest, 1)
    return dr.maximum(distance * trust.detail * dr.rsqrt(worth), trust.smallest)


def trusted_radius(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    normal: mi.Normal3f,
    wanted: mi.Float,
    trust: Trust,
    active: mi.Bool,
) -> mi.Float:
    """Largest radius of records that are trusted at `si`, metres; never less than that of a record made here.

    Args:
        scene: mi.Scene.
        si: the point.
        normal: Normal3f, its normal on the lit side.
        wanted: from `wanted_spacing`.
        trust: of this view.
        active: lanes.
    """
    beside = obstacle_distance(scene, si, normal, trust.farthest, active)
    return dr.maximum(OBSTACLE * beside, wanted)


@dr.syntax
def obstacle_distance(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, normal: mi.Normal3f, farthest: mi.Float, active: mi.Bool
) -> mi.Float:
    """Distance to the nearest surface that rises above the one at `si`, by a few short rays, metres.

    A distant record may not have seen a ledge that covers much of the hemisphere of a point beside it.

    Args:
        scene: mi.Scene.
        si: the point.
        normal: Normal3f, its normal on the lit side, which may be interpolated.
        farthest: Float, result if nothing is nearer.
        active: lanes.
    """
    frame = mi.Frame3f(mi.Normal3f(dr.mulsign(si.n, dr.dot(si.n, normal))))
    bits = [dr.reinterpret_array(mi.UInt32, coordinate) for coordinate in (si.p.x, si.p.y, si.p.z)]
    turn = mi.sample_tea_float32(bits[0] ^ bits[1], bits[2])
    nearest = mi.Float(farthest)
    i = mi.UInt32(0)
    while active & (i < PROBES):
        sin_phi, cos_phi = dr.sincos((mi.Float(i) + turn) * (2 * dr.pi / PROBES))
        up = dr.select((i & 1) == 0, mi.Float(PROBE_HEIGHTS[0]), PROBE_HEIGHTS[1])
        out = dr.sqrt(1 - up * up)
        ray = si.spawn_ray(frame.to_world(mi.Vector3f(out * cos_phi, out * sin_phi, up)))
        ray.maxt = nearest
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        nearest = dr.select(hit.is_valid(), dr.minimum(nearest, hit.t), nearest)
        i += 1
    return nearest
