"""The closed furnace: a lit room with exactly known radiance, to test every rendering method.

Every surface emits the radiance Le and reflects diffusely with the albedo rho, so that the radiance is the
same everywhere and in every direction: L = Le + rho L, hence L = Le / (1 - rho). A renderer with n indirect bounces
gets the truncated geometric series: emission, direct light, then one power of rho per bounce.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.description import Deferred, SceneDescription

EMISSION = 1.0
"""Le: radiance that every surface emits, in every channel, W/(m² sr)."""

ALBEDO = 0.5
"""rho: diffuse albedo of every surface, in every channel."""

SIDE = 2.0
"""Edge length of the room, metres; the room is [0, SIDE]³."""

ANIMATION = BUNDLED["furnace"]
FRAMES, FPS = ANIMATION.frames, ANIMATION.fps


def expected_radiance(bounces: int | None = None) -> float:
    """Radiance that every pixel must show.

    Args:
        bounces: number of indirect bounces, n >= 0; None for infinitely many.

    Returns:
        Le (1 + rho + ... + rho^(n+1)), where rho^1 is the direct light; Le / (1 - rho) for all bounces.
    """
    if bounces is None:
        return EMISSION / (1.0 - ALBEDO)
    return EMISSION * (1.0 - ALBEDO ** (bounces + 2)) / (1.0 - ALBEDO)


def describe() -> SceneDescription:
    """The furnace with a faceted ball and a block in it, so that distances and angles vary."""
    return SceneDescription(
        name="furnace",
        content=Deferred(_content),
        camera=_camera(),
        **dataclasses.asdict(ANIMATION),
    )


def _content() -> dict[str, Any]:
    """The room, the ball and the block."""
    import trimesh

    room = trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [SIDE, SIDE, SIDE]])
    room.invert()  # the room is seen from inside
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.35)
    ball.apply_translation([1.25, 1.3, 0.9])
    block = trimesh.creation.box(extents=[0.4, 0.5, 0.7])
    block.apply_transform(trimesh.transformations.rotation_matrix(0.5, [0.3, 0.2, 1.0]))
    block.apply_translation([0.5, 1.45, 0.5])
    return {"type": "scene", "room": _glowing(room), "ball": _glowing(ball), "block": _glowing(block)}


def _glowing(mesh: Any) -> dict[str, Any]:
    """A mesh that emits and reflects on the side its triangles face; faceted, so that energy is conserved."""
    return {
        "type": "triangles",
        "vertices": np.ascontiguousarray(mesh.vertices, dtype=np.float32),
        "faces": np.ascontiguousarray(mesh.faces, dtype=np.uint32),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [EMISSION] * 3}},
    }


def _camera() -> CameraPath:
    """From a corner past the ball, turning by about 25 degrees."""
    last = (FRAMES - 1) / FPS
    return CameraPath(
        keyframes=(
            Keyframe(time=0.0, origin=(0.5, 0.4, 1.2), target=(1.3, 1.4, 0.8), up=(0.0, 0.0, 1.0), fov=70.0),
            Keyframe(
                time=last / 2, origin=(0.6, 0.4, 1.2), target=(1.1, 1.4, 0.8), up=(0.0, 0.0, 1.0), fov=70.0
            ),
            Keyframe(
                time=last, origin=(0.7, 0.45, 1.25), target=(0.9, 1.5, 0.9), up=(0.0, 0.0, 1.0), fov=70.0
            ),
        ),
        loop=False,
    )
