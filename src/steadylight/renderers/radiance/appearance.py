"""Properties of Mitsuba's materials, textures, emitters and shapes, as plain numbers.

The current Mitsuba variant must be a vectorised one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.scene import build_scene, reading_images
from steadylight.scenes.description import SceneDescription

RGB = NDArray[np.float64]
Table = Mapping[str, Any]

SKY = (1024, 512)
"""Columns and rows of the picture of the sky, over the whole sphere."""

DIRECTIONS = 1 << 16
"""Number of samples of the reflectance of a material, and of the irradiance of the sun."""

_DIGITS = 6
"""Significant digits of sampled numbers: differences between CPUs are smaller."""


def _loaded(entry: Table) -> Any:
    """Mitsuba's object of an entry, with the image files that it refers to."""
    import mitsuba as mi

    with reading_images():
        return mi.load_dict(dict(entry))


def reflectance(bsdf: Table) -> RGB:
    """Reflectance of a Mitsuba material for light at 45 degrees, (3,)."""
    import drjit as dr
    import mitsuba as mi

    material = _loaded(bsdf)
    si: Any = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.wi = mi.Vector3f(0.5**0.5, 0, 0.5**0.5)
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(0, DIRECTIONS)
    _, weight = material.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return _rounded(np.array(weight, np.float64).reshape(3, -1).mean(axis=1))


def refractive_index(bsdf: Table) -> float:
    """Relative index of refraction of a smooth dielectric, inside over outside."""
    import mitsuba as mi

    return float(np.ravel(np.array(mi.traverse(_loaded(bsdf))["eta"]))[0])


def texels(texture: Table) -> NDArray[np.float64]:
    """The picture of a bitmap texture as Mitsuba evaluates it, (H, W, 3) linear RGB."""
    import mitsuba as mi

    if "data" in texture:
        image = np.asarray(texture["data"], np.float64)
    else:
        image = np.array(mi.traverse(_loaded(texture))["data"], np.float64)
    image = image[..., None] if image.ndim == 2 else image
    return np.broadcast_to(image, (*image.shape[:2], 3)) if image.shape[2] == 1 else image[..., :3]


def environment_of(name: str, entry: Table) -> Any:
    """Mitsuba's environment emitter of an entry, in a minimal scene."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    speck = {"type": "triangles", "vertices": corners, "faces": np.array([[0, 1, 2]], np.uint32)}
    camera = CameraPath((Keyframe(0.0, (0.0, 0.0, 5.0), (0.0, 1.0, 0.0)),))
    return build_scene(SceneDescription(name, {name: entry, "speck": speck}, camera)).environment()


def sun_of(emitter: Any) -> tuple[RGB, RGB]:
    """Direction towards the sun, and its irradiance at normal incidence, W/m² RGB."""
    import drjit as dr
    import mitsuba as mi

    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(0, DIRECTIONS)
    towards, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, DIRECTIONS), sampler.next_2d())
    direction = np.array(towards.d, np.float64).reshape(3, -1).mean(axis=1)
    irradiance = np.array(weight, np.float64).reshape(3, -1).mean(axis=1)
    return _rounded(direction / np.linalg.norm(direction)), _rounded(irradiance)


def picture_of(emitter: Any) -> NDArray[np.float64]:
    """Radiance from all directions, (H, W, 3): columns by azimuth from +x, rows by angle from the zenith."""
    import drjit as dr
    import mitsuba as mi

    width, height = SKY
    azimuth, polar = np.meshgrid(
        (np.arange(width) + 0.5) / width * 2 * np.pi, (np.arange(height) + 0.5) / height * np.pi
    )
    d = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    si: Any = dr.zeros(mi.SurfaceInteraction3f, width * height)
    si.wi = -mi.Vector3f(d.reshape(3, -1).astype(np.float32))
    seen = np.array(emitter.eval(si), np.float64).reshape(3, height, width)
    return np.moveaxis(seen, 0, 2)


def mesh_of(entry: Table) -> dict[str, Any]:
    """A Mitsuba mesh (from a file, or a cube) as the vertices, faces, normals and uv of `triangles`."""
    import mitsuba as mi

    properties = {
        key: mi.ScalarTransform4f(value) if isinstance(value, np.ndarray) else value
        for key, value in entry.items()
        if not isinstance(value, Mapping)
    }
    mesh: Any = mi.load_dict(properties)
    held = mi.traverse(mesh)
    found = {
        "vertices": np.array(held["vertex_positions"], np.float32).reshape(-1, 3),
        "faces": np.array(held["faces"], np.uint32).reshape(-1, 3),
    }
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        found["normals"] = np.array(held["vertex_normals"], np.float32).reshape(-1, 3)
    if mesh.has_vertex_texcoords():
        found["uv"] = np.array(held["vertex_texcoords"], np.float32).reshape(-1, 2)
    return found


def write_rgbe(path: Path, image: NDArray[np.floating[Any]]) -> None:
    """Write an (H, W, 3) picture as Radiance's RGBE; mantissas are floored, since readers add half a unit."""
    brightest = np.maximum(image.max(axis=2), 1e-30)
    exponent = np.frexp(brightest)[1]
    mantissa = np.clip(np.floor(image * np.exp2(8.0 - exponent)[..., None]), 0, 255)
    stored = np.concatenate([mantissa, (exponent + 128)[..., None]], axis=2)
    stored[brightest <= 1e-30] = 0
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {image.shape[0]} +X {image.shape[1]}\n"
    path.write_bytes(head.encode() + stored.astype(np.uint8).tobytes())


def _rounded(sampled: RGB) -> RGB:
    return np.array([float(f"{value:.{_DIGITS}g}") for value in sampled])
