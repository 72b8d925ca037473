"""Meshes of a glTF scene as entries of a scene description: copies in the world, or instances of a group."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.scenes.description import WORTH_INSTANCING, Note
from steadylight.scenes.glow import glowing_faces, is_closed
from steadylight.scenes.gltf.document import File
from steadylight.scenes.gltf.geometry import FAN, STRIP, TRIANGLES, Geometry, read_primitive, skinned
from steadylight.scenes.gltf.materials import Look, MaterialReader
from steadylight.scenes.gltf.schema import Instancing, Mesh
from steadylight.scenes.gltf.tree import Tree, composed
from steadylight.scenes.pbr import unique
from steadylight.scenes.surface import Texture
from steadylight.scenes.world import Z_UP, box_corners

Matrix = NDArray[np.float64]

MOST_TRIANGLES: Final = 300_000_000
"""Maximum number of triangles in memory: 30 GB in every worker. Instances share those of their mesh."""

_SHEET: Final = 1e-4
"""Distance between the two sheets of a mesh that emits from both sides, as a fraction of its size."""


class MeshReader:
    """Reads the meshes of visible nodes.

    Attributes:
        entries: entries of the description.
        notes: notes on what was converted or left out.
        low: (3,) lowest corner of the box around all meshes, z up.
        high: (3,) highest corner.
        triangles: number of triangles in memory: those of an instanced mesh count once.
    """

    def __init__(self, file: File, tree: Tree, materials: MaterialReader) -> None:
        """Read nothing yet."""
        self._file, self._tree, self._materials = file, tree, materials
        self.entries: dict[str, Any] = {}
        self.notes: list[Note] = []
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.triangles = 0
        self._geometry: dict[tuple[int, int, tuple[float, ...]], Geometry | None] = {}
        self._groups: dict[int, str | None] = {}
        self._looks: dict[int, Look] = {}

    def read(self) -> None:
        """Add all meshes.

        Raises:
            SceneError: one of them is damaged.
        """
        nodes = self._tree.visible(
            i for i, node in enumerate(self._file.document.nodes) if node.mesh is not None
        )
        placed = {index: self._places(index) for index in nodes}
        uses: Counter[int] = Counter()
        for index in nodes:
            uses[self._mesh_of(index)[0]] += len(placed[index])
        for index in nodes:
            self._add(index, placed[index], uses[self._mesh_of(index)[0]])
        moving = [index for index in nodes if index in self._tree.moved]
        if moving:
            names = ", ".join(self._tree.name(index) for index in moving[:3])
            more = f" and {len(moving) - 3} more" if len(moving) > 3 else ""
            self._note("left out", "animation", f"only the camera moves: {names}{more} stay as in the file")

    def _note(self, kind: Any, where: str, text: str) -> None:
        note = Note(kind, where, text)
        if note not in self.notes:
            self.notes.append(note)

    def _mesh_of(self, index: int) -> tuple[int, Mesh]:
        number = self._tree.node(index).mesh
        assert number is not None
        return number, self._file.item("meshes", self._file.document.meshes, number, f"nodes[{index}].mesh")

    def _places(self, index: int) -> Matrix:
        """Placements of a node's mesh, (N, 4, 4), z up."""
        world = Z_UP @ self._tree.world(index)
        instancing = self._tree.node(index).extensions.instancing
        if instancing is None:
            return np.asarray(world[None])
        return np.asarray(world @ self._instances(instancing, f"nodes[{index}].EXT_mesh_gpu_instancing"))

    def _instances(self, instancing: Instancing, place: str) -> Matrix:
        """Matrices of instances, (N, 4, 4)."""
        parts: dict[str, Matrix] = {}
        for name, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3)):
            if name in instancing.attributes:
                parts[name] = self._file.numbers(instancing.attributes[name], place, width).astype(np.float64)
        lengths = {len(values) for values in parts.values()}
        if len(lengths) != 1:
            raise self._file.fault(place, "its attributes must have the same number of elements")
        count = lengths.pop()
        still = {"TRANSLATION": [0.0, 0.0, 0.0], "ROTATION": [0.0, 0.0, 0.0, 1.0], "SCALE": [1.0, 1.0, 1.0]}
        place_, turn, size = (
            parts.get(name, np.broadcast_to(np.array(value), (count, len(value))))
            for name, value in still.items()
        )
        return composed(place_, turn, size)

    def _add(self, index: int, places: Matrix, uses: int) -> None:
        """Add the mesh of a node at all its places."""
        number, mesh = self._mesh_of(index)
        node, name = self._tree.node(index), self._tree.name(index)
        skin = node.skin is not None
        weights = tuple(node.weights or mesh.weights)
        group = None if skin or node.weights else self._group(number, mesh, uses)
        for matrix in places:
            size = np.linalg.norm(matrix[:3, :3], axis=0)
            if not skin and (size == 0).any():
                self._note("left out", name, "has no size: its scale is zero")
                continue
            if group is not None and np.linalg.det(matrix[:3, :3]) > 0:
                self._instance(name, group, number, matrix)
                continue
            for part in range(len(mesh.primitives)):
                geometry = self._part(number, part, weights)
                if geometry is None:
                    continue
                if skin:
                    geometry = skinned(
                        self._file, mesh.primitives[part], geometry, self._joints(index), f"meshes[{number}]"
                    )
                    self._note("converted", name, "is deformed by a skeleton: stays as in the file")
                self._place(name, number, part, geometry.placed(Z_UP if skin else matrix))

    def _joints(self, index: int) -> Matrix:
        """Matrices of the joints of a node's skin, (J, 4, 4)."""
        number = self._tree.node(index).skin
        assert number is not None
        skin = self._file.item("skins", self._file.document.skins, number, f"nodes[{index}].skin")
        bind = np.broadcast_to(np.eye(4), (len(skin.joints), 4, 4))
        if skin.inverse_bind_matrices is not None:
            raw = self._file.numbers(skin.inverse_bind_matrices, f"skins[{number}]", 16).astype(np.float64)
            if len(raw) < len(skin.joints):
                raise self._file.fault(
                    f"skins[{number}]", f"has {len(raw)} matrices for {len(skin.joints)} joints"
                )
            bind = raw[: len(skin.joints)].reshape(-1, 4, 4).swapaxes(1, 2)
        for joint in skin.joints:
            if joint not in self._tree.parents:
                raise self._file.fault(f"skins[{number}]", f"joint nodes[{joint}] is not in the scene")
        return np.asarray(np.stack([self._tree.world(joint) for joint in skin.joints]) @ bind)

    def _part(self, number: int, part: int, weights: tuple[float, ...]) -> Geometry | None:
        """Triangles of a primitive, in the frame of its mesh; read once."""
        key = (number, part, weights)
        if key not in self._geometry:
            mesh = self._file.document.meshes[number]
            primitive, place = mesh.primitives[part], f"meshes[{number}].primitives[{part}]"
            if primitive.mode not in (TRIANGLES, STRIP, FAN):
                self._note("left out", mesh.name or f"mesh {number}", "points and lines have no surface")
                self._geometry[key] = None
            else:
                self._geometry[key] = read_primitive(self._file, primitive, list(weights), place)
        return self._geometry[key]

    def _look(self, number: int, part: int, geometry: Geometry) -> tuple[Look, Geometry]:
        """Material of a primitive, and its triangles with the colours that the material needs."""
        mesh = self._file.document.meshes[number]
        material, place = mesh.primitives[part].material, f"meshes[{number}].primitives[{part}].material"
        if geometry.colors is None:
            return self._materials.look(material, (1.0, 1.0, 1.0), place), geometry
        where = mesh.name or f"mesh {number}"
        if geometry.alpha:
            self._note("left out", where, "opacity of its vertex colours")
        varies = np.ptp(geometry.colors, axis=0).max() > 0.01
        if varies and not self._materials.has_base_texture(material):
            factor = np.array(self._materials.base_factor(material), np.float32)
            return self._materials.look(material, None, place), replace(
                geometry, colors=geometry.colors * factor
            )
        if varies:
            self._note("approximated", where, "vertex colours under a texture: replaced by their mean")
        r, g, b = (round(float(part), 4) for part in geometry.colors.mean(axis=0))
        return self._materials.look(material, (r, g, b), place), replace(geometry, colors=None)

    def _place(self, name: str, number: int, part: int, geometry: Geometry) -> None:
        """Add triangles in world coordinates."""
        if not np.isfinite(geometry.vertices).all():
            raise self._file.fault(f"meshes[{number}]", "has vertices whose world positions are not finite")
        self._count(len(geometry.faces))
        self._enclose(geometry.vertices)
        look, geometry = self._look(number, part, geometry)
        for shines, piece in self._pieces(look, geometry):
            entry = self._entry(look, piece, shines=shines)
            self.entries[unique(name, self.entries)] = entry
            if shines and look.both_sides and not is_closed(piece.vertices, piece.faces):
                self._note(
                    "converted", name, "emits from both sides: becomes two sheets, one behind the other"
                )
                size = float(np.ptp(piece.vertices, axis=0).max())
                behind = self._entry(look, piece.turned(_SHEET * size), shines=True)
                self.entries[unique(name, self.entries)] = behind

    def _pieces(self, look: Look, geometry: Geometry) -> list[tuple[bool, Geometry]]:
        """The triangles that emit, and the others."""
        emission = look.surface.emission
        if look.finish.emitter is None:
            return [(False, geometry)]
        uv = None if look.uv_set is None else (geometry.uv or {}).get(look.uv_set)
        if not isinstance(emission, Texture) or uv is None:
            return [(True, geometry)]
        bright = glowing_faces(emission, uv, geometry.faces)
        pieces = [(True, bright), (False, ~bright)]
        return [(shines, geometry.part(which)) for shines, which in pieces if which.any()]

    def _entry(self, look: Look, geometry: Geometry, *, shines: bool) -> dict[str, Any]:
        """Triangles as an entry of the description."""
        entry: dict[str, Any] = {"type": "triangles", "vertices": geometry.vertices, "faces": geometry.faces}
        if geometry.normals is not None:
            entry["normals"] = geometry.normals
        uv = None if look.uv_set is None else (geometry.uv or {}).get(look.uv_set)
        if uv is not None:
            entry["uv"] = uv
        if geometry.colors is not None:
            entry["colors"] = geometry.colors
        entry["bsdf"] = look.finish.bsdf
        if shines and look.finish.emitter is not None:
            entry["emitter"] = look.finish.emitter
        return entry

    def _group(self, number: int, mesh: Mesh, uses: int) -> str | None:
        """Name of the group of a mesh that is worth instancing."""
        if number not in self._groups:
            self._groups[number] = None
            if uses > 1:
                self._groups[number] = self._grouped(number, mesh, uses)
        return self._groups[number]

    def _grouped(self, number: int, mesh: Mesh, uses: int) -> str | None:
        """Add a group for a mesh, unless it is small or emits: Mitsuba cannot instance emitters."""
        parts: dict[str, Any] = {}
        total = 0
        for part in range(len(mesh.primitives)):
            geometry = self._part(number, part, tuple(mesh.weights))
            if geometry is None:
                continue
            look, coloured = self._look(number, part, geometry)
            if look.finish.emitter is not None:
                return None
            total += len(geometry.faces)
            parts[f"part_{part}"] = self._entry(look, coloured, shines=False)
        if total * (uses - 1) < WORTH_INSTANCING:
            return None
        self._count(total)
        group = unique(f"group {mesh.name or number}", self.entries)
        self.entries[group] = {"type": "shapegroup", **parts}
        return group

    def _instance(self, name: str, group: str, number: int, matrix: Matrix) -> None:
        """Add an instance of a group."""
        entry = {"type": "instance", "group": {"type": "ref", "id": group}, "to_world": matrix}
        self.entries[unique(name, self.entries)] = entry
        for part in range(len(self._file.document.meshes[number].primitives)):
            geometry = self._part(number, part, tuple(self._file.document.meshes[number].weights))
            if geometry is not None:
                low, high = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
                self._enclose(box_corners(low, high) @ matrix[:3, :3].T + matrix[:3, 3])

    def _count(self, number: int) -> None:
        """Count triangles."""
        self.triangles += number
        if self.triangles > MOST_TRIANGLES:
            raise self._file.fault(
                "meshes", f"have more than {MOST_TRIANGLES:,} triangles, counting each copy but not instances"
            )

    def _enclose(self, vertices: NDArray[Any]) -> None:
        """Widen the box around all meshes."""
        self.low = np.minimum(self.low, vertices.min(axis=0))
        self.high = np.maximum(self.high, vertices.max(axis=0))
