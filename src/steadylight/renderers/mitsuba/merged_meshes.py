"""One mesh for all meshes of one material.

Wherever a kernel asks what a ray meets, Dr.Jit traces the code of each shape: 0.1 ms for each, ten times and more a
kernel. Rooms that were modelled by hand have several hundred meshes, but a few dozen materials.

Mitsuba can do the same, but orders the results by memory addresses, so emitter sampling would differ between processes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class Parts(NamedTuple):
    """What a mesh was merged from.

    Attributes:
        names: (P,) of the meshes.
        first: (P,) the first face of each.
    """

    names: Sequence[str]
    first: NDArray[np.int64]


class _Kind(NamedTuple):
    """What meshes have in common that are merged."""

    bsdf: mi.BSDF
    normals: bool
    uv: bool
    faceted: bool


def merge_meshes(entries: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Parts]]:
    """Merge the meshes of one BSDF, each group at the place of its first mesh.

    Meshes stay as they are if they emit light, or have attributes, flipped normals or a medium.

    Args:
        entries: of a scene's dictionary; meshes are objects.

    Returns:
        The entries, and the parts of each merged mesh by its name.
    """
    kept: dict[str, Any] = {}
    groups: dict[_Kind, dict[str, mi.Mesh]] = {}
    for name, entry in entries.items():
        kind = _kind(entry) if isinstance(entry, mi.Mesh) else None
        if kind is None:
            kept[name] = entry
            continue
        group = groups.setdefault(kind, {})
        if not group:
            kept[name] = entry
        group[name] = entry
    parts = {}
    for kind, group in groups.items():
        if len(group) > 1:
            name = next(iter(group))
            kept[name] = _merged(name, kind, list(group.values()))
            counts = [mesh.face_count() for mesh in group.values()]
            parts[name] = Parts(list(group), np.cumsum([0, *counts[:-1]], dtype=np.int64))
    return kept, parts


def _kind(mesh: mi.Mesh) -> _Kind | None:
    """None for a mesh that is not merged."""
    if mesh.is_emitter() or mesh.is_sensor() or mesh.is_medium_transition():
        return None
    if mesh.has_mesh_attributes() or mesh.has_flipped_normals():
        return None
    return _Kind(mesh.bsdf(), mesh.has_vertex_normals(), mesh.has_vertex_texcoords(), mesh.has_face_normals())


def _merged(name: str, kind: _Kind, meshes: Sequence[mi.Mesh]) -> mi.Mesh:
    properties = mi.Properties()
    properties["bsdf"] = kind.bsdf
    properties["face_normals"] = kind.faceted
    vertices = np.cumsum([0, *(mesh.vertex_count() for mesh in meshes)])
    faces = sum(mesh.face_count() for mesh in meshes)
    merged = mi.Mesh(name, int(vertices[-1]), faces, properties, kind.normals, kind.uv)
    parameters = mi.traverse(merged)
    parameters["vertex_positions"] = _joined(mesh.vertex_positions_buffer() for mesh in meshes)
    if kind.normals:
        parameters["vertex_normals"] = _joined(mesh.vertex_normals_buffer() for mesh in meshes)
    if kind.uv:
        parameters["vertex_texcoords"] = _joined(mesh.vertex_texcoords_buffer() for mesh in meshes)
    numbers = (np.array(mesh.faces_buffer()) for mesh in meshes)
    first = vertices[:-1].astype(np.uint32)
    parameters["faces"] = np.concatenate([each + start for each, start in zip(numbers, first, strict=True)])
    parameters.update()
    return merged


def _joined(buffers: Iterable[mi.Float]) -> NDArray[np.float32]:
    return np.concatenate([np.array(buffer) for buffer in buffers])
