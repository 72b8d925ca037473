"""IFC building models, by ifcopenshell (extra `ifc`): their geometry in metres, z up, with the colours of their styles.

IFC describes surfaces by colour and transparency only: opaque surfaces become diffuse, transparent ones panes.
"""

from __future__ import annotations

import math
import os
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from steadylight.camera import CameraPath
from steadylight.errors import BackendError, SceneError
from steadylight.scenes.apart import TIME_LIMIT, Reading, read_apart
from steadylight.scenes.description import Note, SceneDescription
from steadylight.scenes.pbr import Materials, unique
from steadylight.scenes.surface import Surface
from steadylight.scenes.world import view_from_outside
from steadylight.settings import SceneOptions

GREY: Final = (0.5, 0.5, 0.5)
"""Reflectance of surfaces without a style."""

FAR: Final = 200.0
"""Metres from the origin beyond which a model is moved there: up to here, rays start less than 2 cm off surfaces."""

APART: Final = 2.0
"""... unless it is larger than the distance over this, so that moving it would bring little."""

LEAST_SECONDS, SLOWEST = 300.0, 5000.0
"""Time limit: seconds for any file, plus its size at this many bytes per second. On some damaged files, the library
never returns."""

_LEFT_OUT = ("IfcSpace", "IfcOpeningElement", "IfcAnnotation", "IfcGrid")


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read an IFC file.

    Args:
        path: path of the file.
        options: only those that add light apply to this format.

    Raises:
        SceneError: the file cannot be read, or has no geometry.
        BackendError: ifcopenshell is not installed; the message says how to install it.
    """
    del options
    path = path.absolute()
    if not path.is_file():
        raise SceneError(f"{path}: no such scene file")
    if find_spec("ifcopenshell") is None:
        install = shlex.join([sys.executable, "-m", "pip", "install", "ifcopenshell"])
        raise BackendError(f"{path}: IFC files need ifcopenshell; install it with `{install}`")
    limit = min(TIME_LIMIT, LEAST_SECONDS + path.stat().st_size / SLOWEST)
    return read_apart(Reading(path, "IfcOpenShell", __name__, path), limit)


def described(path: Path) -> SceneDescription:
    """The scene of an IFC file; runs in a separate process, which the library may crash."""
    shapes = _shapes(path)
    materials, notes = Materials(), []
    parts: dict[tuple[Any, ...], list[np.ndarray]] = {}
    for vertices, faces, styles, chosen in shapes:
        for number in np.unique(chosen):
            style = styles[number] if 0 <= number < len(styles) else ("grey", GREY, 0.0)
            parts.setdefault(style, []).append(vertices[faces[chosen == number]])
    corners = np.concatenate([triangle.reshape(-1, 3) for group in parts.values() for triangle in group])
    low, high = corners.min(axis=0), corners.max(axis=0)
    offset = np.zeros(3)
    if np.abs([low, high]).max() > max(FAR, APART * (high - low).max()):
        offset = np.round((low + high) / 2)
        moved = ", ".join(f"{value:.0f}" for value in offset)
        notes.append(Note("converted", path.name, f"moved by -({moved}) m: it lies far from the origin"))
    size = " x ".join(f"{side:.3g}" for side in high - low)
    notes.append(
        Note("converted", path.name, f"spaces and openings are left out; the model measures {size} m")
    )
    content: dict[str, Any] = {}
    meshes: dict[str, Any] = {}
    for (name, colour, transparency), groups in sorted(parts.items()):
        finish = materials.finish(_surface(name, colour, transparency))
        points = np.concatenate(groups).reshape(-1, 3) - offset
        meshes[unique(name, meshes)] = {
            "type": "triangles",
            "vertices": points.astype(np.float32),
            "faces": np.arange(len(points), dtype=np.uint32).reshape(-1, 3),
            "bsdf": finish.bsdf,
        }
    content |= materials.entries
    for name, mesh in meshes.items():
        content[unique(name, content)] = mesh
    return SceneDescription(
        name=path.stem,
        content=content,
        camera=CameraPath((view_from_outside(low - offset, high - offset),)),
        about=str(path),
        notes=(*notes, *materials.notes),
    )


def _surface(name: str, colour: tuple[float, float, float], transparency: float) -> Surface:
    """A style as a surface: Lambertian, or a pane whose opaque part has the colour of the style."""
    if transparency > 0:
        clear = (1.0, 1.0, 1.0)
        return Surface(name, colour, roughness=0.0, transmission=transparency, transmission_color=clear)
    return Surface(name, base_color=colour, ior=1.0)


def _shapes(path: Path) -> list[tuple[Any, Any, list[tuple[Any, ...]], Any]]:
    """Vertices, faces, styles and the number of the style of each face, of every product."""
    import ifcopenshell
    import ifcopenshell.geom

    try:
        model: Any = ifcopenshell.open(str(path))
        settings: Any = ifcopenshell.geom.settings()
        settings.set("use-world-coords", True)
        left_out = [kind for kind in _LEFT_OUT if _has(model, kind)]
        given = {"exclude": left_out} if left_out else {}
        iterator: Any = ifcopenshell.geom.iterator(settings, model, os.cpu_count() or 1, **given)
        found = []
        if iterator.initialize():
            while True:
                found.append(_shape(iterator.get()))
                if not iterator.next():
                    break
    except Exception as error:  # noqa: BLE001 - whatever its parser meets in a damaged file
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{path}: is not a valid IFC file: {said[:200]}") from None
    found = [(guid, shape) for guid, shape in found if len(shape[1])]
    if not found:
        raise SceneError(f"{path}: has no geometry")
    return [shape for _, shape in sorted(found, key=lambda pair: pair[0])]  # threads finish in any order


def _has(model: Any, kind: str) -> bool:
    """Whether the schema has elements of this kind, and the model contains some."""
    try:
        return bool(model.by_type(kind))
    except RuntimeError:
        return False


def _shape(element: Any) -> tuple[str, tuple[Any, Any, list[tuple[Any, ...]], Any]]:
    geometry = element.geometry
    vertices = np.array(geometry.verts, np.float64).reshape(-1, 3)
    faces = np.array(geometry.faces, np.int64).reshape(-1, 3)
    chosen = np.array(geometry.material_ids, np.int64)
    chosen = chosen if len(chosen) == len(faces) else np.full(len(faces), -1)
    return element.guid, (vertices, faces, [_style(each) for each in geometry.materials], chosen)


def _style(material: Any) -> tuple[str, tuple[float, float, float], float]:
    """Name, colour and transparency."""
    diffuse = material.diffuse
    channels = [getattr(diffuse, channel) for channel in "rgb"]
    values = [float(channel() if callable(channel) else channel) for channel in channels]
    red, green, blue = (min(max(value, 0.0), 1.0) if math.isfinite(value) else 0.5 for value in values)
    transparency = float(material.transparency)
    transparency = min(max(transparency, 0.0), 1.0) if math.isfinite(transparency) else 0.0
    return str(material.name) or "style", (red, green, blue), round(transparency, 6)
