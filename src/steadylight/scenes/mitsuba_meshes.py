"""Converts meshes of a Mitsuba scene file that Mitsuba cannot read, reads wrongly, or would crash on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.mitsuba_document import Document
from steadylight.scenes.obj import simplified
from steadylight.scenes.ply import read_ply, write_plain


@dataclass(frozen=True)
class Rewritten:
    """A mesh in a form that Mitsuba reads.

    Attributes:
        path: path of the new file.
        corner_uv: (F, 3, 2) texture coordinates of each corner of a face, which the new file lacks; or None.
        why: why it was rewritten, for the user.
    """

    path: Path
    corner_uv: NDArray[Any] | None
    why: str


def convert_meshes(document: Document, folder: Path) -> dict[str, Rewritten]:
    """Rewrite mesh files that Mitsuba cannot read into a folder, and let their shapes refer to the new files.

    A fault is added for each damaged PLY file: Mitsuba would crash on faces with vertices that do not exist.

    Returns:
        The rewritten meshes, by file name.
    """
    known: dict[str, Rewritten | SceneError | None] = {}
    used: dict[str, Rewritten] = {}
    for element in document.root.walk():
        file, name = element.child("filename"), element.text("filename")
        if element.tag != "shape" or element.kind not in _REWRITE or file is None or not Path(name).is_file():
            continue
        if name not in known:
            try:
                # Keeps the file name, which may appear in Mitsuba's messages.
                target = folder / str(len(known)) / Path(name).name
                target.parent.mkdir()
                known[name] = _REWRITE[element.kind](Path(name), target)
            except SceneError as error:
                known[name] = error
        found = known[name]
        if isinstance(found, SceneError):
            document.fault(file.place, str(found))
        elif found is not None:
            file.attributes["value"] = str(found.path)
            used[str(found.path)] = found
            document.note("converted", element, f"`{element.kind}`: {Path(name).name}: {found.why}")
    return used


def _rewrite_ply(path: Path, target: Path) -> Rewritten | None:
    mesh = read_ply(path)
    if mesh.plain:
        return None
    write_plain(target, mesh)
    why = (
        "its polygons are split into triangles"
        if mesh.corner_uv is None
        else "each polygon corner becomes a vertex"
    )
    if mesh.mended:
        why = "normals of zero length are replaced by face normals"
    return Rewritten(target, mesh.corner_uv, why)


def _rewrite_obj(path: Path, target: Path) -> Rewritten | None:
    try:
        data = simplified(path.read_bytes())
    except OSError:  # Mitsuba reports this
        return None
    if data is None:
        return None
    target.write_bytes(data)
    return Rewritten(target, None, "rewritten, since Mitsuba would not read it correctly")


_REWRITE = {"obj": _rewrite_obj, "ply": _rewrite_ply}


def as_triangles(properties: dict[str, Any], mesh: Rewritten) -> dict[str, Any]:
    """A converted shape as a mesh in memory, as Mitsuba reads it.

    Args:
        properties: properties of the shape, without references.
        mesh: the rewritten mesh.
    """
    import mitsuba as mi

    plain = {
        name: mi.ScalarTransform4d(value) if isinstance(value, np.ndarray) else value
        for name, value in properties.items()
    }
    parameters = mi.traverse(mi.load_dict(plain))
    faces = np.array(parameters["faces"], np.uint32).reshape(-1, 3)
    entry: dict[str, Any] = {"vertices": parameters["vertex_positions"]}
    for name, key in (("normals", "vertex_normals"), ("uv", "vertex_texcoords"), ("colors", "vertex_color")):
        if key in parameters and len(parameters[key]):
            entry[name] = parameters[key]
    count = len(parameters["vertex_positions"]) // 3
    entry = {name: np.array(value, np.float32).reshape(count, -1) for name, value in entry.items()}
    if mesh.corner_uv is not None:  # each corner becomes a vertex
        entry = {name: value[faces.ravel()] for name, value in entry.items()}
        entry["uv"] = mesh.corner_uv.astype(np.float32).reshape(-1, 2)
        if properties.get("flip_tex_coords", False):
            entry["uv"][:, 1] = 1 - entry["uv"][:, 1]
        faces = np.arange(faces.size, dtype=np.uint32).reshape(-1, 3)
    return {"type": "triangles", "faces": faces, **entry}
