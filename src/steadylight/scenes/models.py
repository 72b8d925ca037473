"""Plain meshes: OBJ with its materials, PLY with its picture, and STL.

Such files state neither their unit of length nor their up axis, and have no lights or cameras. Without `--unit` and
`--up`, both are guessed and reported.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import Trimesh
from trimesh.resolvers import Resolver

from steadylight.camera import CameraPath
from steadylight.errors import SceneError
from steadylight.scenes.description import Note, SceneDescription
from steadylight.scenes.mtl import Place, Values, names_of, read_mtl, surface_of
from steadylight.scenes.obj import simplified
from steadylight.scenes.pbr import Finish, Materials, unique
from steadylight.scenes.ply import PlyMesh, read_ply
from steadylight.scenes.surface import Surface, Texture, VertexColour
from steadylight.scenes.world import Z_UP, view_from_outside
from steadylight.settings import UNITS, SceneOptions

GREY: Final = (0.5, 0.5, 0.5)
"""Reflectance of surfaces without a material."""

GUESSES: Final = ((100.0, "m"), (2000.0, "cm"), (np.inf, "mm"))
"""Longest side up to which a unit is assumed: a house is smaller than 100 m, a room smaller than 20 m."""

LARGEST_FILE: Final = 4 << 30
"""Bytes."""

_LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
_UP: Final = {".obj": "y", ".ply": "z", ".stl": "z"}
"""Up axis of most files of a format."""


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read an OBJ, PLY or STL file.

    Args:
        path: path of the file.
        options: `unit` and `up`; guessed if None.

    Raises:
        SceneError: the file cannot be read, or has no triangles.
    """
    path = path.absolute()
    model = _Model(path, anywhere=options.allow_outside)
    meshes = model.meshes()
    scale, up = model.units(meshes, options)
    matrix = np.diag([scale, scale, scale, 1.0]) @ (Z_UP if up == "y" else np.eye(4))
    content: dict[str, Any] = {}
    corners = []
    for name, mesh in meshes:
        finish = model.finish(mesh)
        entry = _entry(mesh, matrix, finish)
        corners += [entry["vertices"].min(axis=0), entry["vertices"].max(axis=0)]
        content[name] = entry
    entries: dict[str, Any] = dict(model.materials.entries)
    for name, entry in content.items():
        entries[unique(name, entries)] = entry
    view = view_from_outside(np.min(corners, axis=0), np.max(corners, axis=0))
    return SceneDescription(
        name=path.stem,
        content=entries,
        camera=CameraPath((view,)),
        about=str(path),
        files=model.files(),
        notes=(*model.notes, *model.materials.notes),
    )


@dataclass
class _Model:
    """One file and what it refers to; `picture` is the image of a PLY file."""

    path: Path
    anywhere: bool
    materials: Materials = field(default_factory=Materials)
    notes: list[Note] = field(default_factory=list)
    library: dict[str, Values] = field(default_factory=dict)
    finishes: dict[str, Finish] = field(default_factory=dict)
    picture: str = ""

    @property
    def place(self) -> Place:
        """Where referenced files are searched."""
        return Place(self.path.parent, self.anywhere)

    def tell(
        self, kind: Literal["converted", "approximated", "left out", "warning"], where: str, text: str
    ) -> None:
        """Note what became of something."""
        self.notes.append(Note(kind, where, text))

    def meshes(self) -> list[tuple[str, Trimesh]]:
        """The meshes of the file, with their names."""
        if not self.path.is_file():
            raise SceneError(f"{self.path}: no such scene file")
        if self.path.stat().st_size > LARGEST_FILE:
            raise SceneError(f"{self.path}: is larger than {LARGEST_FILE >> 30} GiB")
        if self.path.suffix.lower() == ".ply":
            mesh = read_ply(self.path)
            self.picture = self._picture_of(mesh)
            found = [(self.path.stem, _of_ply(mesh, textured=bool(self.picture)))]
        else:
            found = self._read_by_trimesh()
        solid = [(name, mesh) for name, mesh in found if isinstance(mesh, Trimesh) and len(mesh.faces)]
        _check(self.path, [mesh for _, mesh in solid])
        return sorted(solid, key=lambda pair: pair[0])

    def _read_by_trimesh(self) -> list[tuple[str, Any]]:
        """The meshes of an OBJ or STL file."""
        try:
            data = self.path.read_bytes()
            if self.path.suffix.lower() == ".obj":
                self._read_libraries(data)
                data = simplified(data) or data
            scene: Any = trimesh.load_scene(
                BytesIO(data),
                file_type=self.path.suffix[1:].lower(),
                resolver=_Library(self),
                process=False,
                maintain_order=True,
            )
            return [(str(name), mesh) for name, mesh in scene.geometry.items()]
        except SceneError:
            raise
        except OSError as error:
            raise SceneError(
                f"{self.path}: cannot be read: {(error.strerror or str(error)).lower()}"
            ) from None
        except MemoryError:
            raise SceneError(f"{self.path}: needs more memory than is available") from None
        except Exception as error:  # noqa: BLE001 - whatever its parser meets in a damaged file
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise SceneError(
                f"{self.path}: is not a valid {self.path.suffix[1:].upper()} file: {said[:200]}"
            ) from None

    def _picture_of(self, mesh: PlyMesh) -> str:
        """Path of the picture of a PLY file; empty if there is none, or, with a note, if it cannot be used."""
        if not mesh.pictures:
            return ""
        if mesh.uv is None and mesh.corner_uv is None:
            self.tell("left out", self.path.name, "TextureFile: the mesh has no texture coordinates")
            return ""
        if len(mesh.pictures) > 1:
            self.tell(
                "approximated", self.path.name, "the first of several TextureFiles is used on all faces"
            )
        try:
            return str(self.place.file(mesh.pictures[0], self.path.name))
        except SceneError as error:
            self.tell("left out", self.path.name, f"TextureFile: {error}")
            return ""

    def _read_libraries(self, data: bytes) -> None:
        """Read the materials of an OBJ file; trimesh would hide faults in them."""
        for line in _LIBRARIES.findall(data):
            word = line.decode(errors="replace").strip()
            file = self.place.within(word, str(self.path))
            if file.is_file():
                self.library.update(read_mtl(file.read_text(errors="replace"), str(file)))
            else:
                self.tell("left out", word, f"materials: no such file in {self.path.parent}")

    def units(self, meshes: list[tuple[str, Trimesh]], options: SceneOptions) -> tuple[float, str]:
        """Metres per unit of the file, and the up axis."""
        low = np.min([mesh.vertices.min(axis=0) for _, mesh in meshes], axis=0)
        high = np.max([mesh.vertices.max(axis=0) for _, mesh in meshes], axis=0)
        longest = float((high - low).max())
        unit: str = options.unit or next(name for most, name in GUESSES if longest <= most)
        up = options.up or _UP[self.path.suffix.lower()]
        said = [
            f"{what} {value}{'' if given else ' (guessed; set it with ' + option + ')'}"
            for what, value, given, option in (
                ("lengths in", unit, options.unit, "--unit"),
                ("up is", up, options.up, "--up"),
            )
        ]
        size = " x ".join(f"{side * UNITS[unit]:.3g}" for side in high - low)
        self.tell("converted", self.path.name, f"{', '.join(said)}: the scene measures {size} m")
        return UNITS[unit], up

    def finish(self, mesh: Trimesh) -> Finish:
        """The material of a mesh."""
        visual: Any = mesh.visual
        coloured = visual.kind == "vertex"
        name = (
            Path(self.picture).name
            or ("vertex colours" if coloured else None)
            or getattr(getattr(visual, "material", None), "name", None)
            or "grey"
        )
        if name not in self.finishes:
            if name in self.library:
                surface = surface_of(name, self.library[name], self.place, self.tell)
            elif self.picture:
                surface = Surface(name, base_color=Texture(self.picture, srgb=True), ior=1.0)
            else:
                surface = Surface(name, base_color=VertexColour() if coloured else GREY, ior=1.0)
                if not coloured:
                    self.tell(
                        "converted",
                        self.path.name,
                        f"surfaces without a material get reflectance {GREY[0]:g}",
                    )
            self.finishes[name] = self.materials.finish(surface)
        return self.finishes[name]

    def files(self) -> dict[str, str]:
        """SHA-256 of the pictures, by path."""
        found = {}
        for entry in self.materials.entries.values():
            if entry.get("type") == "image" and "filename" in entry:
                with Path(entry["filename"]).open("rb") as stream:
                    found[entry["filename"]] = hashlib.file_digest(stream, "sha256").hexdigest()
        return found


def _of_ply(mesh: PlyMesh, *, textured: bool) -> Trimesh:
    """The mesh for trimesh; with texture coordinates per corner, each corner becomes a vertex."""
    kept = np.arange(len(mesh.vertices)) if mesh.corner_uv is None else mesh.faces.ravel()
    faces = mesh.faces if mesh.corner_uv is None else np.arange(mesh.faces.size).reshape(-1, 3)
    uv = mesh.uv if mesh.corner_uv is None else mesh.corner_uv.reshape(-1, 2)
    colors = None if mesh.colors is None or textured else mesh.colors[kept]
    found = Trimesh(
        mesh.vertices[kept],
        faces,
        vertex_normals=None if mesh.normals is None else mesh.normals[kept],
        vertex_colors=colors,
        process=False,
    )
    if colors is None and uv is not None:
        found.visual = trimesh.visual.TextureVisuals(uv=uv)
    return found


def _check(path: Path, meshes: list[Trimesh]) -> None:
    """Check that there are meshes, and that they are not damaged."""
    if not meshes:
        raise SceneError(f"{path}: has no triangles")
    for mesh in meshes:
        vertices = np.asarray(mesh.vertices)
        if not np.isfinite(vertices).all():
            raise SceneError(f"{path}: a vertex is not finite")
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(vertices):
            raise SceneError(f"{path}: a face refers to a vertex that does not exist")


class _Library(Resolver):  # type: ignore[misc]
    """Gives trimesh only the names of the materials, whose content and pictures are read here."""

    def __init__(self, model: _Model) -> None:
        self.model = model

    def get(self, name: str) -> bytes:
        """The names of all materials, whichever library is requested."""
        del name
        return names_of(self.model.library).encode()

    def keys(self) -> list[str]:
        """List nothing."""
        return []

    def namespaced(self, namespace: str) -> _Library:
        """Return this resolver."""
        del namespace
        return self

    def write(self, name: str, data: bytes) -> None:
        """Do nothing."""


def _entry(mesh: Trimesh, matrix: NDArray[np.float64], finish: Finish) -> dict[str, Any]:
    """A mesh as an entry of a scene description."""
    vertices = np.asarray(mesh.vertices) @ matrix[:3, :3].T
    entry: dict[str, Any] = {
        "type": "triangles",
        "vertices": vertices.astype(np.float32),
        "faces": np.asarray(mesh.faces).astype(np.uint32),
    }
    if "vertex_normals" in mesh._cache:  # noqa: SLF001 - those of the file; others would be computed
        normals = np.asarray(mesh.vertex_normals) @ matrix[:3, :3].T / np.cbrt(np.linalg.det(matrix[:3, :3]))
        entry["normals"] = normals.astype(np.float32)
    visual: Any = mesh.visual
    if getattr(visual, "uv", None) is not None:
        entry["uv"] = np.asarray(visual.uv, np.float32)
    if visual.kind == "vertex":
        encoded = np.asarray(visual.vertex_colors)[:, :3] / 255
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        entry["colors"] = linear.astype(np.float32)
    entry["bsdf"] = finish.bsdf
    return entry if finish.emitter is None else entry | {"emitter": finish.emitter}
