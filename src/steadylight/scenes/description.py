"""A scene as plain data: picklable, hashable, and independent of the renderer.

Conventions (whole package): right-handed world frame, metres, scene-linear RGB, radiance in W/(m² sr).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np

from steadylight.camera import CameraPath

WORTH_INSTANCING: Final = 20_000
"""Minimum number of triangles that instancing a mesh must save. Fewer copies need little memory and trace faster, all
copies of one material can be one shape, and photons carry the caustics of copies, but not those of instances."""


class Deferred(Mapping[str, Any]):
    """Content of a scene, built when first read: for a bundled scene, that takes seconds."""

    def __init__(self, build: Callable[[], Mapping[str, Any]]) -> None:
        """Keep the function; nothing is built yet."""
        self._build = build

    @cached_property
    def _content(self) -> Mapping[str, Any]:
        return self._build()

    def __getitem__(self, key: str) -> Any:
        return self._content[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)


@dataclass(frozen=True)
class Note:
    """What became of something in a scene file that is not used as it stands.

    Attributes:
        kind: `converted` (gives the same light in another form), `approximated`, `left out`, or `warning` (kept, but
            probably not what was meant).
        where: the element, as the file or the modelling program names it.
        text: what was done, and why: one sentence without a full stop.
    """

    kind: Literal["converted", "approximated", "left out", "warning"]
    where: str
    text: str


@dataclass(frozen=True)
class SceneDescription:
    """Everything that determines how a scene looks, as plain data.

    Attributes:
        name: bundled name, or the stem of the file it came from.
        content: the scene without sensor and integrator, in the syntax of `format`. For `mitsuba` that is Mitsuba's
            dictionary syntax, with plain values only: str, bool, int, float, lists, NumPy arrays and nested dicts.
            A 4x4 array is a transform. `{"type": "ref", "id": name}` points at an earlier entry. A mesh held in memory
            is `{"type": "triangles", "vertices": (V, 3) float32, "faces": (F, 3) uint32,
            "normals": (V, 3) float32 or absent, "uv": (V, 2) float32 or absent, "colors": (V, 3) float32, linear RGB
            for a `mesh_attribute` named `vertex_color`, or absent, "bsdf": ..., "emitter": ...}`. A texture from an
            image file is an entry of its own that materials refer to: see `image_texture`. File names are absolute.
        camera: the default camera path (a single keyframe for a still view).
        film: Mitsuba reconstruction filter as a plain dict, for example `{"type": "gaussian"}`.
        sensor: further properties of the scene's own sensor (type, near_clip, aperture_radius ...), without
            to_world, fov, film and sampler. By default `{"type": "perspective"}`.
        width: default image width, pixels.
        height: default image height, pixels.
        frames: default number of frames.
        fps: default frames per second of the animation.
        files: SHA-256 of every file that the scene refers to, by absolute path.
        about: one-line description for `steadylight scenes`.
        format: format of the content: `mitsuba`, or `radiance`, whose content is `{"octree": (N,) uint8 array}`, a
            frozen octree.
        notes: notes on what was converted, approximated or left out while the file was read; not part of the hash.
    """

    name: str
    content: Mapping[str, Any]
    camera: CameraPath
    film: Mapping[str, Any] = field(default_factory=lambda: {"type": "gaussian"})
    sensor: Mapping[str, Any] = field(default_factory=lambda: {"type": "perspective"})
    width: int = 1280
    height: int = 720
    frames: int = 1
    fps: float = 25.0
    files: Mapping[str, str] = field(default_factory=dict)
    about: str = ""
    format: str = "mitsuba"
    notes: tuple[Note, ...] = ()

    @cached_property
    def hash(self) -> str:
        """SHA-256 of format, content, film and sensor; files contribute their content, not their path."""
        digest = hashlib.sha256()
        parts = {"format": self.format, "content": self.content, "film": self.film, "sensor": self.sensor}
        _feed(digest, parts, self.files)
        return digest.hexdigest()


def _feed(digest: Any, value: Any, files: Mapping[str, str]) -> None:
    """Add a plain value to the digest: type, length and bytes, so that different values give different input."""
    if isinstance(value, Mapping):
        digest.update(f"{{{len(value)}".encode())
        for key, item in value.items():  # order matters: a reference must follow its target
            _feed(digest, key, files)
            _feed(digest, item, files)
    elif isinstance(value, list | tuple):
        digest.update(f"[{len(value)}".encode())
        for item in value:
            _feed(digest, item, files)
    elif isinstance(value, np.ndarray):
        digest.update(f"a{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, str) and value in files:
        digest.update(f"f{files[value]}".encode())
    else:
        digest.update(f"v{json.dumps(value)}".encode())
