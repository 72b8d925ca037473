"""Makes a scene description from a glTF file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from steadylight.camera import CameraPath
from steadylight.errors import SceneError
from steadylight.scenes.description import Note, SceneDescription
from steadylight.scenes.gltf.cameras import LARGER_SIDE, view_of
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.lights import read_lights
from steadylight.scenes.gltf.materials import MaterialReader
from steadylight.scenes.gltf.meshes import MeshReader
from steadylight.scenes.gltf.schema import SUPPORTED, Node
from steadylight.scenes.gltf.tree import Tree
from steadylight.scenes.pbr import unique
from steadylight.scenes.world import view_from_outside
from steadylight.settings import SceneOptions

_NOTED = frozenset({"KHR_materials_sheen", "KHR_materials_iridescence", "KHR_materials_anisotropy"})
"""Extensions that materials report in notes."""


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a glTF 2.0 file (`.gltf`, with separate buffers and images) or a GLB file.

    The scene is turned so that z is up. A camera that moves, by itself or with its parents, becomes a path; a file
    without a camera gets a view of the whole scene from outside.

    Args:
        path: path of the file.
        options: `sensor`: name of a camera or of its node, or its number, counted from 1. `allow_outside`: whether
            buffers and images may lie outside the file's folder.

    Raises:
        SceneError: the file is damaged, or has nothing to render; the message names the place.
        SettingsError: there is no such camera.
    """
    file = File(Path(path).absolute(), outside=options.allow_outside)
    try:
        with np.errstate(all="ignore"):  # overflow gives non-finite values, which are refused
            return _read(file, options)
    except SceneError as error:
        if str(file.path) in str(error):
            raise
        raise SceneError(f"{file.path}: {error}") from None


def _read(file: File, options: SceneOptions) -> SceneDescription:
    """Implementation of `read`."""
    tree = Tree(file)
    materials = MaterialReader(file)
    meshes = MeshReader(file, tree, materials)
    meshes.read()
    if not meshes.entries:
        raise SceneError(f"{file.path}: has no visible triangles in its scene")
    lights, light_notes = read_lights(file, tree)
    view = view_of(file, tree, None if options.sensor is None else str(options.sensor))
    notes = [*_general(file, tree), *light_notes, *materials.all_notes(), *meshes.notes]
    content: dict[str, Any] = {**materials.materials.entries}
    for entries in (meshes.entries, lights):
        for name, entry in entries.items():
            content[unique(name, content)] = entry  # never renames groups, which others refer to
    if view is None:
        notes.append(
            Note("converted", "camera", "there is none: the whole scene is seen from outside; see --camera")
        )
        seen: dict[str, Any] = {
            "camera": CameraPath((view_from_outside(meshes.low, meshes.high),)),
            "width": LARGER_SIDE,
            "height": LARGER_SIDE * 9 // 16,
        }
    else:
        notes = [*view.notes, *notes]
        seen = {
            name: getattr(view, name) for name in ("camera", "sensor", "width", "height", "frames", "fps")
        }
    return SceneDescription(
        name=file.path.stem,
        content=content,
        files=file.files,
        about=str(file.path),
        notes=tuple(notes),
        **seen,
    )


def _is_empty(node: Node) -> bool:
    """Whether a node has no content: one of Blender's area lights, or a mere marker."""
    nothing = node.mesh is None and node.camera is None and node.extensions.light is None
    return nothing and not node.children


def _general(file: File, tree: Tree) -> list[Note]:
    """Notes on the file as a whole."""
    notes = [Note("converted", "axes", "y up to z up: (x, y, z) became (x, -z, y)")]
    unknown = sorted(set(file.document.extensions_used) - SUPPORTED - _NOTED)
    if unknown:
        notes.append(Note("left out", "extensions", ", ".join(unknown)))
    if "blender" in file.document.asset.generator.lower():
        empty = [tree.name(index) for index in tree.order if _is_empty(tree.node(index))]
        names = (
            f"; without content: {', '.join(empty[:5])}{' ...' if len(empty) > 5 else ''}" if empty else ""
        )
        text = f"area lights and the world's light are not in its glTF files, but in its USD files{names}"
        notes.append(Note("left out", "Blender", text))
    if tree.unread:
        notes.append(Note("left out", "animation", f"of {', '.join(sorted(tree.unread))}"))
    if len(file.document.scenes) > 1:
        number = file.document.scene or 0
        name = file.document.scenes[number].name or f"scene {number}"
        notes.append(
            Note(
                "warning", "scenes", f"of {len(file.document.scenes)} scenes, the default one is read: {name}"
            )
        )
    return notes
