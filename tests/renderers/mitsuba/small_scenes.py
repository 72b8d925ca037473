"""Scenes of a few shapes, and random records, for the tests of the renderer."""

from __future__ import annotations

import dataclasses
from typing import Any

import mitsuba as mi
import numpy as np

from steadylight.cache.records import Records
from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.bsdf.lobes import BSDFTraits
from steadylight.renderers.mitsuba.light.emitters import EmitterSampling
from steadylight.renderers.mitsuba.light.environment import Environment
from steadylight.renderers.mitsuba.light.vertex import Lighting
from steadylight.renderers.mitsuba.paths.branches import PathLimits
from steadylight.renderers.mitsuba.quality import ShadingQuality
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

CAMERA = CameraPath(
    (
        Keyframe(0.0, (0, -5.5, 1.7), (0, 0, 1.4), fov=45),
        Keyframe(1.0, (0.6, -5.2, 1.9), (0.1, 0, 1.3), fov=45),
    )
)
EVERY_POSE = (1, 2, 3)
LAMP = {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 7.0]}}


def place(
    scale: tuple[float, float, float] = (1, 1, 1),
    at: tuple[float, float, float] = (0, 0, 0),
    *,
    about: tuple[float, float, float] = (1, 0, 0),
    degrees: float = 0,
) -> np.ndarray:
    """(4, 4) scale, then turn about an axis through the origin, then move."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(about, float)).as_matrix()
    matrix[:3, :3] = turn @ np.diag(scale)
    matrix[:3, 3] = at
    return matrix


def paint(*albedo: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}


def room(bsdf: dict[str, Any] | None = None, shape: str = "sphere") -> dict[str, Any]:
    """A room 4 m wide and 3 m high without a front wall; half of its ceiling is open to the sky.

    Args:
        bsdf: of a thing in the middle; white paint if None.
        shape: of that thing: `sphere`, or `panel` (a rectangle that leans).
    """
    thing = (
        {"type": "sphere", "center": [0, 0, 1], "radius": 0.9}
        if shape == "sphere"
        else {"type": "rectangle", "to_world": place((1.1, 0.9, 1), (0, 0, 1.3), degrees=60)}
    )
    white = paint(0.5, 0.5, 0.5)

    def wall(matrix: np.ndarray, material: dict[str, Any]) -> dict[str, Any]:
        return {"type": "rectangle", "to_world": matrix, "bsdf": {"type": "twosided", "bsdf": material}}

    return {
        "floor": wall(place((2, 2, 1)), white),
        "back": wall(place((2, 1.5, 1), (0, 2, 1.5), degrees=90), white),
        "left": wall(place((1.5, 2, 1), (-2, 0, 1.5), about=(0, 1, 0), degrees=90), paint(0.6, 0.2, 0.1)),
        "right": wall(place((1.5, 2, 1), (2, 0, 1.5), about=(0, 1, 0), degrees=-90), paint(0.2, 0.5, 0.2)),
        "ceiling": wall(place((2, 1, 1), (0, 1, 3), degrees=180), white),
        "thing": {**thing, "bsdf": bsdf or white},
    }


def lamp() -> dict[str, Any]:
    """A large lamp under the ceiling, facing down, without rounding."""
    matrix = np.diag([0.7, -0.5, -1, 1])
    matrix[:3, 3] = 0, 0.8, 2.95
    return {
        "type": "rectangle",
        "to_world": matrix,
        "bsdf": paint(0, 0, 0),
        "emitter": LAMP,
    }


def described(content: dict[str, Any], **more: Any) -> SceneDescription:
    return SceneDescription("test", content, CAMERA, **more)


def renderer(description: SceneDescription, **settings: Any) -> Renderer:
    """For frames 1 to 3 of a second, small and of draft quality unless told otherwise."""
    chosen = {"frames": (1, 2, 3), "width": 48, "height": 48, "spp": 64, "quality": "draft"} | settings
    render_settings = RenderSettings.checked(**chosen)
    poses = description.camera.frame_poses(range(1, 9), 8.0)
    return Renderer(description, dict(enumerate(poses, 1)), render_settings)


class Identity:
    """A denoiser that finds no noise."""

    def clean(self, color: np.ndarray, *_: Any, **__: Any) -> np.ndarray:
        return color


def sample_again(made: Renderer, light: str, **changes: Any) -> None:
    """Change which pixels get more samples of `direct` light, `indirect` or the `rest`: `AdaptiveSamples`."""
    adapt(made, **{light: dataclasses.replace(getattr(made.view.quality.adaptive, light), **changes)})


def adapt(made: Renderer, **changes: Any) -> None:
    """Change how noisy pixels get more samples: fields of `AdaptiveQuality`."""
    quality = made.view.quality
    made.view.quality = dataclasses.replace(
        quality, adaptive=dataclasses.replace(quality.adaptive, **changes)
    )


def shade_as_normal(made: Renderer) -> None:
    """Let paths from the camera be of normal quality, whatever the records are of."""
    made.view.quality = dataclasses.replace(made.view.quality, shading=ShadingQuality())
    made.view.limits = PathLimits(made._settings.depth, ShadingQuality())


def plain_lighting(scene: mi.Scene, samples: int = 2) -> Lighting:
    """Light of a scene whose emitters are chosen as Mitsuba does."""
    return Lighting(
        scene,
        BSDFTraits(scene),
        Environment(scene),
        EmitterSampling(scene, Environment(scene), whole=True),
        samples,
    )


def random_records(
    seed: int, count: int, *, radius: tuple[float, float] = (0.1, 0.8), values: int = 1
) -> Records:
    """Records on the walls of the unit cube, normals inward up to a few degrees; the radius is log-uniform.

    The surface of every other one is the wall's, of the others its own.
    """
    rng = np.random.default_rng(seed)
    axis, side = rng.integers(3, size=count), rng.integers(2, size=count)
    rows = np.arange(count)
    position = rng.random((count, 3))
    position[rows, axis] = side
    flat = np.zeros((count, 3))
    flat[rows, axis] = 1 - 2 * side
    normal = flat + 0.08 * rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    arrays = {
        "position": position,
        "normal": normal,
        "surface": np.where(rows[:, None] % 2, flat, normal),
        "irradiance": 0.5 + rng.random((count, values, 3)),
        "translation": 0.3 * rng.standard_normal((count, values, 3, 3)),
        "rotation": 0.3 * rng.standard_normal((count, values, 3, 3)),
        "curvature": rng.uniform(-1, 1, (count, values)),
        "radius": np.exp(rng.uniform(*np.log(radius), count)),
        "standard_error": np.zeros((count, values)),
    }
    return Records.undivided(
        **{name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
    )
