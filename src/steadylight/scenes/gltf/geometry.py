"""Triangles of glTF primitives: attributes, indices, Draco, strips and fans, morph targets and skins at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.gltf.document import MOST_VALUES, File, as_numbers
from steadylight.scenes.gltf.schema import Draco, Primitive

Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]

TRIANGLES, STRIP, FAN = 4, 5, 6
_WIDTHS: Final = {"POSITION": 3, "NORMAL": 3, "TANGENT": 4}


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles.

    Attributes:
        vertices: (V, 3) positions.
        faces: (F, 3), counter-clockwise seen from the front.
        normals: (V, 3) unit, or None for flat triangles.
        uv: texture coordinates by set, (V, 2).
        colors: (V, 3) linear RGB, or None.
        alpha: whether the colours had a varying alpha.
    """

    vertices: Floats
    faces: NDArray[np.uint32]
    normals: Floats | None = None
    uv: Mapping[int, Floats] | None = None
    colors: Floats | None = None
    alpha: bool = False

    def placed(self, matrix: Matrix) -> Geometry:
        """The triangles transformed; a reflection reverses their orientation."""
        linear = matrix[:3, :3]
        vertices = (self.vertices @ linear.T + matrix[:3, 3]).astype(np.float32)
        normals = self.normals
        if normals is not None:
            cofactors = np.stack([np.cross(linear[(k + 1) % 3], linear[(k + 2) % 3]) for k in range(3)])
            normals = _unit(normals @ cofactors.T)
        mirrored = np.linalg.det(linear) < 0
        if mirrored and normals is not None:
            normals = -normals
        faces = np.ascontiguousarray(self.faces[:, ::-1]) if mirrored else self.faces
        return replace(self, vertices=vertices, faces=faces, normals=normals)

    def part(self, keep: NDArray[np.bool_]) -> Geometry:
        """The triangles in the mask `keep`, with the vertices that they use."""
        used, faces = np.unique(self.faces[keep], return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[used],
            faces=faces.reshape(-1, 3).astype(np.uint32),
            normals=None if self.normals is None else self.normals[used],
            uv={number: uv[used] for number, uv in (self.uv or {}).items()},
            colors=None if self.colors is None else self.colors[used],
        )

    def turned(self, distance: float) -> Geometry:
        """The same sheet facing the other way, moved back by `distance`."""
        corners = self.vertices[self.faces]
        facing = np.zeros_like(self.vertices)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        for corner in range(3):
            np.add.at(facing, self.faces[:, corner], across)
        back = self.vertices - np.float32(distance) * _unit(facing)
        normals = None if self.normals is None else -self.normals
        return replace(self, vertices=back, faces=np.ascontiguousarray(self.faces[:, ::-1]), normals=normals)


def read_primitive(file: File, primitive: Primitive, weights: list[float], place: str) -> Geometry | None:
    """The triangles of a primitive; None if it has none.

    Args:
        file: the glTF file.
        primitive: primitive of a mesh.
        weights: weights of its morph targets.
        place: place in the document, for messages.

    Raises:
        SceneError: an attribute is missing, damaged, or of another length than the rest.
    """
    attributes, faces = _attributes(file, primitive, place)
    if "POSITION" not in attributes:
        return None
    vertices = attributes["POSITION"]
    for name, values in attributes.items():
        if len(values) != len(vertices):
            raise file.fault(place, f"has {len(vertices)} positions but {len(values)} of {name}")
    if faces is None:
        order = (
            np.arange(len(vertices)) if primitive.indices is None else file.indices(primitive.indices, place)
        )
        if order.size and (order.max() >= len(vertices) or order.min() < 0):
            raise file.fault(
                place, f"its indices go up to {order.max()}, but there are only {len(vertices)} vertices"
            )
        faces = _faces(order, primitive.mode)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    if not len(faces):
        return None
    normals = attributes.get("NORMAL")
    vertices, normals = _morphed(file, primitive, weights, place, (vertices, normals))
    colors = attributes.get("COLOR_0")
    return Geometry(
        np.ascontiguousarray(vertices),
        faces.astype(np.uint32),
        None if normals is None else _unit(normals),
        {int(name[9:]): values for name, values in attributes.items() if name.startswith("TEXCOORD_")},
        None if colors is None else np.maximum(colors[:, :3], 0),
        colors is not None and colors.shape[1] == 4 and bool((colors[:, 3] < 0.999).any()),
    )


def _attributes(
    file: File, primitive: Primitive, place: str
) -> tuple[dict[str, Floats], NDArray[np.int64] | None]:
    """Supported attributes by name, and the faces if they come with them."""
    wanted = {name: index for name, index in primitive.attributes.items() if _is_used(name)}
    if primitive.extensions.draco is not None:
        return _decompressed(file, primitive, primitive.extensions.draco, place)
    found: dict[str, Floats] = {}
    for name, index in wanted.items():
        accessor = file.item("accessors", file.document.accessors, index, f"{place}.{name}")
        width = _WIDTHS.get(name, 2)
        if name == "COLOR_0":
            width = 4 if accessor.type == "VEC4" else 3
        found[name] = file.numbers(index, f"{place}.{name}", width)
    return found, None


def _is_used(name: str) -> bool:
    return name in {"POSITION", "NORMAL", "COLOR_0"} or (
        name.startswith("TEXCOORD_") and name[9:].isdecimal()
    )


def _decompressed(
    file: File, primitive: Primitive, draco: Draco, place: str
) -> tuple[dict[str, Floats], NDArray[np.int64]]:
    """Attributes and faces of a Draco mesh."""
    import DracoPy

    data, _ = file.view_of(draco.buffer_view, place)
    counts = [
        file.item("accessors", file.document.accessors, index, place).count
        for index in primitive.attributes.values()
    ]
    if max(counts, default=0) * 4 > MOST_VALUES:
        raise file.fault(place, f"claims to have {max(counts):,} vertices; the file is damaged")
    try:
        mesh: Any = DracoPy.decode(data.tobytes())
    except Exception as error:  # noqa: BLE001 - whatever the decoder raises, its input is damaged
        raise file.fault(place, f"its Draco data cannot be decoded ({error})") from None
    if not hasattr(mesh, "faces"):
        raise file.fault(place, "its Draco data are points, not triangles")
    found: dict[str, Floats] = {}
    for name, identifier in draco.attributes.items():
        attribute = mesh.get_attribute_by_unique_id(identifier)
        if not _is_used(name) or attribute is None:
            continue
        raw = np.asarray(attribute["data"])
        declared = primitive.attributes.get(name)
        accessor = None if declared is None else file.document.accessors[declared]
        values = as_numbers(
            raw.reshape(len(raw), -1), normalized=accessor is not None and accessor.normalized
        )
        width = _WIDTHS.get(name, 2)
        if (name != "COLOR_0" and values.shape[1] != width) or not np.isfinite(values).all():
            raise file.fault(place, f"its Draco data of {name} are damaged")
        found[name] = values
    faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    if faces.size and (faces.max() >= len(found.get("POSITION", ())) or faces.min() < 0):
        raise file.fault(place, "its Draco data are damaged: faces refer to vertices that do not exist")
    return found, faces


def _faces(order: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Triangles, (F, 3), of a list, a strip or a fan."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == FAN:
        return np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], axis=1)
    faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def _morphed(
    file: File, primitive: Primitive, weights: list[float], place: str, mesh: tuple[Floats, Floats | None]
) -> tuple[Floats, Floats | None]:
    """Positions and normals with the morph targets at their weights."""
    vertices, normals = mesh
    for number, (target, weight) in enumerate(zip(primitive.targets, weights, strict=False)):
        if not weight:
            continue
        for name, index in target.items():
            if name not in ("POSITION", "NORMAL"):
                continue
            change = file.numbers(index, f"{place}.targets[{number}]", 3)
            if len(change) != len(vertices):
                raise file.fault(
                    place, f"targets[{number}] has {len(change)} displacements for {len(vertices)} positions"
                )
            if name == "POSITION":
                vertices = vertices + np.float32(weight) * change
            elif normals is not None:
                normals = normals + np.float32(weight) * change
    return vertices, normals


def skinned(file: File, primitive: Primitive, geometry: Geometry, joints: Matrix, place: str) -> Geometry:
    """The triangles deformed by a skin.

    Args:
        file: the glTF file.
        primitive: primitive with JOINTS_0 and WEIGHTS_0.
        geometry: geometry of the primitive.
        joints: (J, 4, 4) from the bind pose to the current pose.
        place: place in the document, for messages.
    """
    if "JOINTS_0" not in primitive.attributes or "WEIGHTS_0" not in primitive.attributes:
        return geometry
    which = file.numbers(primitive.attributes["JOINTS_0"], f"{place}.JOINTS_0", 4).astype(np.int64)
    weights = file.numbers(primitive.attributes["WEIGHTS_0"], f"{place}.WEIGHTS_0", 4).astype(np.float64)
    if len(which) != len(geometry.vertices) or len(weights) != len(which):
        raise file.fault(place, "its skin has a different number of vertices")
    if which.size and (which.max() >= len(joints) or which.min() < 0):
        raise file.fault(place, f"its skin refers to joint {which.max()}, but there are only {len(joints)}")
    total = weights.sum(axis=1, keepdims=True)
    weights = np.where(total > 0, weights / np.where(total > 0, total, 1), [1.0, 0.0, 0.0, 0.0])
    vertices = np.zeros((len(which), 3))
    normals = None if geometry.normals is None else np.zeros((len(which), 3))
    for k in range(4):
        matrix = joints[which[:, k]]
        vertices += weights[:, k, None] * (
            np.einsum("nij,nj->ni", matrix[:, :3, :3], geometry.vertices) + matrix[:, :3, 3]
        )
        if normals is not None and geometry.normals is not None:
            normals += weights[:, k, None] * np.einsum("nij,nj->ni", matrix[:, :3, :3], geometry.normals)
    return replace(
        geometry, vertices=vertices.astype(np.float32), normals=None if normals is None else _unit(normals)
    )


def _unit(vectors: NDArray[np.floating[Any]]) -> Floats:
    """Vectors scaled to length 1; those of length zero are unchanged."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1), np.float32)
