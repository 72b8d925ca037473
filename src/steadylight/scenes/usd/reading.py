"""Makes a scene description from a USD stage. Imports USD, so runs in a separate process: see `scenes.usd`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from steadylight.camera import CameraPath
from steadylight.errors import SceneError
from steadylight.scenes.description import WORTH_INSTANCING, Note, SceneDescription
from steadylight.scenes.glow import is_closed
from steadylight.scenes.pbr import Materials, unique
from steadylight.scenes.surface import Texture
from steadylight.scenes.usd import cameras, exported, meshes, shapes
from steadylight.scenes.usd.lights import Lights
from steadylight.scenes.usd.materials import Palette
from steadylight.scenes.usd.pieces import Matrix, Piece
from steadylight.scenes.usd.request import Request
from steadylight.scenes.usd.stage import Assets, Stage, label, matrix_of, open_stage, refuse_outside
from steadylight.scenes.world import box_corners, view_from_outside

_HIDDEN: Final = ("proxy", "guide")
_NO_SURFACE: Final = (
    "BasisCurves",
    "NurbsCurves",
    "HermiteCurves",
    "NurbsPatch",
    "Points",
    "TetMesh",
    "Volume",
)
_FLAT: Final = 1e-30
"""Volume of a transformed unit cube, m³, below which a transform counts as singular."""
_MOST_COPIES: Final = 1_000_000
_STANDS: Final = "its motion: it stays as in the first frame"


def describe(request: Request) -> SceneDescription:
    """Read a stage.

    Raises:
        SceneError: the message names the file, the prim and the fault.
        SettingsError: there is no such camera.
    """
    passing = None if request.stage is None else request.stage.parent
    assets = Assets(request.path, request.outside, passing=passing)
    stage, notes = open_stage(assets, request.stage)
    scene = _Scene(stage)
    world = None if request.stage is None else exported.environment(request.facts, request.stage.parent)
    scene.gather(world)
    refuse_outside(stage)  # again, because value clips are only opened when they are read
    if request.stage is not None:
        seen, more = exported.view(request.path, request.facts, request.sensor)
        more += exported.notes_of(request.facts)
    else:
        seen, more = _seen(stage, scene.cameras, request.sensor)
    assets.refuse_missing()
    found = [*notes, *scene.notes, *scene.palette.notes, *scene.materials.notes, *scene.lights.notes, *more]
    about: dict[str, Any] = {
        "name": request.path.stem,
        "content": {**scene.materials.entries, **scene.shapes, **scene.lights.entries},
        "files": assets.hashes,
        "about": str(request.path),
        "notes": _gathered(found),
    }
    if seen is None:
        return SceneDescription(**about, camera=CameraPath((view_from_outside(*scene.bounds),)))
    return SceneDescription(**about, **vars(seen))


def _seen(stage: Stage, prims: Sequence[Any], wanted: str | None) -> tuple[cameras.View | None, list[Note]]:
    """The requested camera of the stage; None if it has none."""
    camera, notes = cameras.chosen(stage, prims, wanted)
    if camera is None:
        return None, notes
    seen, more = cameras.view(stage, camera)
    return seen, [*notes, *more]


def _gathered(notes: Sequence[Note]) -> tuple[Note, ...]:
    """Merge notes that say the same about several objects."""
    groups: dict[tuple[str, str], list[str]] = {}
    for note in notes:
        groups.setdefault((note.kind, note.text), []).append(note.where)
    made = []
    for (kind, text), where in groups.items():
        names = list(dict.fromkeys(where))
        rest = f" and {len(names) - 5} more" if len(names) > 6 else ""
        shown = names[:5] if rest else names
        made.append(Note(kind, ", ".join(shown) + rest, text))  # type: ignore[arg-type]
    return tuple(made)


@dataclass
class _Scene:
    """Collects the parts of a stage."""

    stage: Stage
    shapes: dict[str, Any] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    cameras: list[Any] = field(default_factory=list)
    materials: Materials = field(default_factory=Materials)

    def __post_init__(self) -> None:
        self.lights = Lights(self.stage, self.materials)
        self.palette = Palette(self.stage, self.materials)
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self._groups: dict[Any, str | list[Piece]] = {}
        self._moving: dict[Any, bool] = {}

    @property
    def bounds(self) -> tuple[Matrix, Matrix]:
        """Lower and upper corner of all shapes."""
        return self.low, self.high

    def gather(self, world: Mapping[str, Any] | None = None) -> None:
        """Collect everything; `world` is the environment if the stage does not have it."""
        instances: dict[Any, list[Any]] = {}
        prims = self._walk(self.stage.stage.GetPseudoRoot(), proxies=False)
        if self.stage.assets.passing is not None:  # Blender's order of objects varies
            prims = iter(sorted(prims, key=lambda prim: str(prim.GetPath())))
        for prim in prims:
            if prim.IsInstance():
                instances.setdefault(self._look(prim), []).append(prim)
            elif prim.GetTypeName() == "PointInstancer":
                self._scatter(prim)
            else:
                self._add(prim)
        for copies in instances.values():
            pieces = list(self._pieces(copies[0]))
            places = [self.stage.world(prim) for prim in copies]
            names = [str(prim.GetPath())[1:] for prim in copies]
            self._place(f"group {names[0]}", pieces, places[0], list(zip(names, places, strict=True)))
            for prim in copies:
                for inner in self._walk(prim, proxies=True):
                    if inner.GetTypeName() == "Camera":
                        self.cameras.append(inner)
                    self._light(inner)
        self.lights.surround(world)

    def _walk(self, root: Any, *, proxies: bool) -> Iterator[Any]:
        """Visible prims from `root` down, except those below instancers; with `proxies`, also those in instances."""
        from pxr import Usd, UsdGeom

        every = (
            Usd.PrimIsActive & Usd.PrimIsLoaded if root.GetPath().IsPrimPath() else Usd.PrimDefaultPredicate
        )
        walk = iter(
            Usd.PrimRange(root, Usd.TraverseInstanceProxies(every) if proxies else Usd.PrimDefaultPredicate)
        )
        for prim in walk:
            if prim.IsPseudoRoot():
                continue
            image = UsdGeom.Imageable(prim)
            if image:
                if image.GetVisibilityAttr().ValueMightBeTimeVarying():
                    self._note("left out", prim, "its changing visibility: it stays as in the first frame")
                hidden = image.GetVisibilityAttr().Get(self.stage.start) == "invisible"
                if hidden or image.GetPurposeAttr().Get() in _HIDDEN:
                    walk.PruneChildren()
                    continue
            yield prim
            if prim.GetTypeName() == "PointInstancer":
                walk.PruneChildren()

    def _look(self, prim: Any) -> tuple[str, str]:
        """Key of a group of instances: the prototype, and the material bound to the instance."""
        from pxr import UsdShade

        bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(UsdShade.Tokens.full)[0]
        return str(prim.GetPrototype().GetPath())[1:], str(bound.GetPath()) if bound else ""

    def _note(self, kind: Any, prim: Any, text: str) -> None:
        self.notes.append(Note(kind, label(prim), text))

    def _moves(self, prim: Any) -> bool:
        """Whether a prim or one of its ancestors moves."""
        from pxr import UsdGeom

        if not prim or prim.IsPseudoRoot():
            return False
        path = prim.GetPath()
        if path not in self._moving:
            own = UsdGeom.Xformable(prim)
            self._moving[path] = bool(own and own.TransformMightBeTimeVarying()) or self._moves(
                prim.GetParent()
            )
        return self._moving[path]

    def _light(self, prim: Any) -> bool:
        """Add a light; False if the prim is not a light."""
        if "Light" not in str(prim.GetTypeName()):
            return False
        try:
            added = self.lights.add(prim, self.stage.world(prim))
        except SceneError as error:
            raise self._located(prim, error) from None
        if added and self._moves(prim):
            self._note("left out", prim, _STANDS)
        return added

    def _located(self, prim: Any, error: SceneError) -> SceneError:
        text = str(error)
        own = str(self.stage.assets.path)
        return error if text.startswith(own) else SceneError(f"{own}: {prim.GetPath()}: {text}")

    def _add(self, prim: Any) -> None:
        """Add a prim that is not an instance."""
        kind = str(prim.GetTypeName())
        if kind == "Camera":
            self.cameras.append(prim)
        elif not self._light(prim):
            for piece in self._pieces_of(prim):
                self._show(piece)

    def _show(self, piece: Piece) -> None:
        made = self._entry(piece, np.eye(4))
        if made is not None:
            self._extend(made["vertices"])
            self.shapes[unique(piece.name, self.shapes)] = made

    def _extend(self, vertices: Any) -> None:
        self.low = np.minimum(self.low, vertices.min(axis=0))
        self.high = np.maximum(self.high, vertices.max(axis=0))

    def _entry(self, piece: Piece, to_frame: Matrix) -> dict[str, Any] | None:
        try:
            return piece.entry(to_frame)
        except SceneError as error:
            raise SceneError(f"{self.stage.assets.path}: /{piece.name}: {error}") from None

    def _pieces(self, root: Any) -> Iterator[Piece]:
        """All triangles below a prim, with instances and instancers expanded."""
        for prim in self._walk(root, proxies=True):
            if prim.GetTypeName() != "PointInstancer":
                yield from self._pieces_of(prim)
                continue
            for pieces, origin, places in self._scattered(prim):
                for name, place in places:
                    for piece in pieces:
                        moved = place @ np.linalg.inv(origin) @ piece.to_world
                        yield Piece(f"{name}/{piece.name}", piece.geometry, piece.faces, piece.painted, moved)

    def _scatter(self, prim: Any) -> None:
        """Add the copies of a point instancer."""
        for number, (pieces, origin, places) in enumerate(self._scattered(prim), 1):
            self._place(f"group {str(prim.GetPath())[1:]} {number}", pieces, origin, places)

    def _scattered(self, prim: Any) -> Iterator[tuple[list[Piece], Matrix, list[tuple[str, Matrix]]]]:
        """For each prototype: its triangles, its transform to the world, and names and transforms of its copies."""
        from pxr import UsdGeom

        instancer, time = UsdGeom.PointInstancer(prim), self.stage.start
        prototypes = [
            self.stage.stage.GetPrimAtPath(path)
            for path in instancer.GetPrototypesRel().GetForwardedTargets()
        ]
        indices = np.array(instancer.GetProtoIndicesAttr().Get(time) or (), dtype=np.int64)
        if len(indices) > _MOST_COPIES:
            raise SceneError(
                f"{self.stage.assets.path}: {prim.GetPath()}: has more than {_MOST_COPIES:,} copies"
            )
        if len(indices) and (indices.min() < 0 or indices.max() >= len(prototypes)):
            raise SceneError(
                f"{self.stage.assets.path}: {prim.GetPath()}: refers to prototype {indices.max()}, but there are "
                f"{len(prototypes)}"
            )
        moves = instancer.ComputeInstanceTransformsAtTime(
            time, time, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        if len(moves) != len(indices):
            raise SceneError(
                f"{self.stage.assets.path}: {prim.GetPath()}: has too few positions for its copies"
            )
        mask = np.array(instancer.ComputeMaskAtTime(time) or [True] * len(indices), dtype=bool)
        if any(
            attribute.ValueMightBeTimeVarying()
            for attribute in (instancer.GetPositionsAttr(), instancer.GetOrientationsAttr())
        ):
            self._note("left out", prim, _STANDS)
        world = self.stage.world(prim)
        for number, prototype in enumerate(prototypes):
            chosen = np.flatnonzero((indices == number) & mask)
            if not prototype or not len(chosen):
                continue
            places = [(f"{str(prim.GetPath())[1:]}/{i}", world @ matrix_of(moves[int(i)])) for i in chosen]
            yield list(self._pieces(prototype)), self.stage.world(prototype), places

    def _place(
        self, name: str, pieces: Sequence[Piece], origin: Matrix, places: Sequence[tuple[str, Matrix]]
    ) -> None:
        """Add copies of pieces: as shapes if they emit or instances would save little, else as instances of a group."""
        if not pieces:
            return
        flat = abs(np.linalg.det(origin[:3, :3])) < _FLAT
        back = np.asarray(np.linalg.pinv(origin) if flat else np.linalg.inv(origin), dtype=np.float64)
        saved = sum(piece.triangles for piece in pieces) * (len(places) - 1)
        if saved < WORTH_INSTANCING or any(piece.painted.finish.emitter is not None for piece in pieces):
            for own, place in places:
                for piece in pieces:
                    self._show(piece.copied(own, place @ back @ piece.to_world))
            return
        group: dict[str, Any] = {"type": "shapegroup"}
        corners = []
        for piece in pieces:
            made = self._entry(piece, back)
            if made is not None:
                group[unique(piece.name.rsplit("/", 1)[-1], group)] = made
                corners.append(made["vertices"])
        if not corners:
            return
        every = np.concatenate(corners).astype(np.float64)
        eight = box_corners(every.min(axis=0), every.max(axis=0))
        key = unique(name, self.shapes)
        self.shapes[key] = group
        for own, place in places:
            if abs(np.linalg.det(place[:3, :3])) < _FLAT:
                continue
            self._extend(eight @ place[:3, :3].T + place[:3, 3])
            reference = {"type": "ref", "id": key}
            self.shapes[unique(own, self.shapes)] = {
                "type": "instance",
                "to_world": place,
                "shapegroup": reference,
            }

    def _pieces_of(self, prim: Any) -> Iterator[Piece]:
        """The triangles of one prim."""
        kind = str(prim.GetTypeName())
        if kind in _NO_SURFACE:
            self._note(
                "left out", prim, f"{kind}: only meshes and basic shapes are read; convert it to a mesh"
            )
        elif kind == "SkelRoot":
            self._note("left out", prim, "its skeleton: meshes stay as modelled")
        elif kind == "Mesh" or kind in shapes.KINDS:
            if self._moves(prim):
                self._note("left out", prim, _STANDS)
            try:
                geometry = (
                    meshes.mesh(prim, self.stage.start)
                    if kind == "Mesh"
                    else shapes.shape(prim, self.stage.start)
                )
                if geometry is not None:
                    yield from self._parts(prim, geometry)
            except SceneError as error:
                raise self._located(prim, error) from None

    def _parts(self, prim: Any, geometry: meshes.Geometry) -> Iterator[Piece]:
        """The pieces of a mesh: one for each subset with its own material, and one for the rest."""
        from pxr import UsdGeom, UsdLux, UsdShade

        is_mesh = prim.GetTypeName() == "Mesh"
        if is_mesh:
            self._mention(prim, UsdGeom.Mesh(prim))
        glow = self.lights.emission(prim) if prim.HasAPI(UsdLux.MeshLightAPI) else None
        colored = geometry.colors is not None
        name, to_world = str(prim.GetPath())[1:], self.stage.world(prim)
        left = np.ones(len(geometry.triangles), dtype=bool)
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets() if is_mesh else ():
            polygons = np.array(subset.GetIndicesAttr().Get(self.stage.start) or (), dtype=np.int64)
            faces = np.isin(geometry.face, polygons) & left
            left &= ~faces
            if faces.any():
                painted = self.palette.of(subset.GetPrim(), colored=colored, glow=glow)
                yield self._checked(
                    prim, Piece(f"{name}/{subset.GetPrim().GetName()}", geometry, faces, painted, to_world)
                )
        if left.any():
            painted = self.palette.of(prim, colored=colored, glow=glow)
            yield self._checked(prim, Piece(name, geometry, None if left.all() else left, painted, to_world))

    def _checked(self, prim: Any, piece: Piece) -> Piece:
        """Note what the material of a piece needs and the mesh lacks; returns the piece."""
        geometry = piece.geometry
        textured = any(isinstance(value, Texture) for value in vars(piece.painted.surface).values())
        sets: Mapping[str, Any] = geometry.uv
        if textured and not sets:
            self._note("warning", prim, "has no texture coordinates for its textures")
        elif textured and piece.painted.uv is not None and piece.painted.uv not in sets:
            first = next(iter(sets))
            self._note("warning", prim, f"has no texture coordinates {piece.painted.uv}; {first} are used")
        if piece.painted.finish.emitter is not None and not is_closed(
            geometry.points, geometry.corners[geometry.triangles]
        ):
            self._note("approximated", prim, "an open emissive mesh: emits from its front only")
        return piece

    def _mention(self, prim: Any, mesh: Any) -> None:
        """Note what is left out of a mesh."""
        if mesh.GetSubdivisionSchemeAttr().Get() not in (None, "none"):
            text = "its subdivision: its polygons are rendered as they are; subdivide before the export"
            self._note("left out", prim, text)
        if mesh.GetPointsAttr().ValueMightBeTimeVarying():
            self._note("left out", prim, "its deformation: it stays as in the first frame")
