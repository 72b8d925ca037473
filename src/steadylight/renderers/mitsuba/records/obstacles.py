"""Which records may answer at a point, when the cache is filled: none whose radius passes over what stands nearby.

A record far from a picture frame does not see how thick it is, and would answer right up to its edge, where half of
the hemisphere is frame: contact shadows would be lost wherever no record happened to be made. Neighbour clamping
(Krivanek et al. 2006) cures this among records that exist. We ask the geometry instead, by a few short rays from each
point that is looked up, so that the outcome depends on no order. The last round of the audit sends no such rays.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

OBSTACLE = 2.0
"""A record answers only if its radius is at most this many times the distance to what stands beside the point."""

PROBES = 8
PROBE_HEIGHTS = (0.15, 0.5)
"""Short rays around a point, and the sines of their elevation by turns: for low ledges and for near walls."""


class Trust(NamedTuple):
    """How near a record must have been made to be trusted at a point, when the cache is filled."""

    eye: mi.Point3f  # camera position
    detail: mi.Float  # smallest radius asked for, metres per metre of distance from the camera
    smallest: mi.Float  # smallest radius that any record has, metres
    farthest: mi.Float  # largest radius, metres
    weakest: mi.Float  # throughput below which a path asks for no larger radius; 1 if all ask alike


def wanted_spacing(
    si: mi.SurfaceInteraction3f, travelled: mi.Float, throughput: mi.Color3f, trust: Trust
) -> mi.Float:
    """Smallest radius that a record at `si` need have for this path, metres.

    What a faint mirror shows is a small part of the picture. The error within a record's radius grows with the square
    of the radius, so that the radius may grow with one over the root of the throughput.

    Args:
        si: the point.
        travelled: Float, length of the path from the camera, metres.
        throughput: Color3f, of the path.
        trust: of this view.
    """
    # A record's lower bound goes by the straight way from the camera, and a camera ray starts at the near clip plane.
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
    """Largest radius of a record that may answer at `si`, metres; never less than a record made here would have.

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
    """Distance to the nearest surface that stands up from the one at `si`, by a few short rays, metres.

    A distant record may not have seen a ledge that fills much of the hemisphere of a point beside it.

    Args:
        scene: mi.Scene.
        si: the point.
        normal: Normal3f, its normal on the lit side.
        farthest: Float, what is returned where nothing is nearer.
        active: lanes.
    """
    frame = mi.Frame3f(normal)
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
