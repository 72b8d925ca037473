"""Export of a scene to Radiance: an octree, with everything in the scene that Radiance can represent.

Radiance works in W/(m² sr) too, so radiances are exported unchanged: its 179 lm/W only matters where luminance is
computed. Faceted surfaces without a texture become polygons, which Radiance intersects fastest; all others become one
triangle mesh, since a ray traverses one octree faster than one for each material. Differences, besides materials
(`materials.py`):

- An area emitter that reflects becomes two sheets a tenth of a millimetre apart, as a `light` reflects nothing: in
  front a `trans` that reflects as much as the emitter and transmits the rest, behind it the `light`, made brighter to
  compensate for the sheet.
- A spot or point lamp becomes an `illum` sphere of 5 mm that is invisible to the camera, a spot lamp with Mitsuba's
  fall-off; a directional emitter becomes a `source` of a twentieth of a degree.
- The sky and any other environment becomes a `glow`. Radiance finds it only by ambient rays, so it costs one of the
  ambient bounces, and few of the rays hit a small bright sun in a picture. The sun of `sunsky` becomes a `source` of
  the same irradiance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.renderers.radiance.appearance import (
    Table,
    environment_of,
    mesh_of,
    picture_of,
    sun_of,
)
from steadylight.renderers.radiance.materials import (
    Materials,
    material_of,
    primitive,
    rgb,
    table,
    texture_of,
)
from steadylight.scenes import without_light
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.image_texture import expanded
from steadylight.scenes.mitsuba_plugins import PLUGINS
from steadylight.scenes.radiance.programs import output_of

SHEET = 1e-4
"""Metres between the reflecting and the emitting sheet of an area emitter."""

BULB = 0.005
"""Radius of the sphere that represents a lamp without extent, metres."""

NARROW = 0.05
"""Angular diameter of a directional emitter, degrees."""

FUNCTIONS = """{ Where a picture is looked up. A1, A2: columns and rows without the border of one texel on each side;
  A3, A4: what Radiance calls its width and height. Texel centres are at half numbers, the first row is the top. }
part(x) : x - floor(x);
across(u) : A3 * (part(u) * A1 + .5) / (A1 + 1);
down(v) : A4 * ((1 - part(v)) * A2 + .5) / (A2 + 1);
texture_u = across(Lu);
texture_v = down(Lv);
sky_u = across(atan2(Dy, Dx) / (2 * PI));
sky_v = down(Acos(Dz) / PI);

{ Fall-off of a spot lamp. A1-A3: where it points; A4, A5: where its beam ends and where its light ends, degrees. }
away = Acos(-(Dx * A1 + Dy * A2 + Dz * A3)) * 180 / PI;
beam = if(A5 - away, if(away - A4, (A5 - away) / (A5 - A4), 1), 0);
"""

Floats = NDArray[np.float64]

_MESHES = ("ply", "obj", "serialized", "cube")
_ENVIRONMENTS = ("constant", "envmap")
_EMITTERS = ("spot", "point", "directional", "sunsky", *_ENVIRONMENTS)


@dataclass
class RadianceScene:
    """A scene for Radiance's programs.

    Attributes:
        octree: the file that they read; it refers to other files beside it.
        cube: side of the octree, metres; `-ar` is relative to it.
        sky: whether there is light from a `glow` all around, which costs an ambient bounce.
    """

    octree: Path
    cube: float = 0.0
    sky: bool = False


def export(description: SceneDescription, folder: Path) -> RadianceScene:
    """Write a scene for Radiance into `folder`; Mitsuba's variant must be set.

    Raises:
        SceneError: something in the scene has no counterpart in Radiance; names it.
    """
    description = replace(description, content=expanded(description.content))
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    result = RadianceScene(folder / "scene.oct")
    (folder / "scene.cal").write_text(FUNCTIONS)
    writer = Writer(description, folder, result)
    for name, entry in description.content.items():
        if is_object(entry):
            writer.add(name, entry)
    if not writer.lights:
        raise SceneError(without_light(description))
    if writer.mesh:
        writer.objects.append("void mesh everything 1 scene.rtm 0 0")
    (folder / "materials.rad").write_text("\n".join(writer.materials) + "\n")
    (folder / "scene.rad").write_text("\n".join(writer.materials + writer.objects) + "\n")
    if writer.mesh:
        (folder / "scene.obj").write_text("\n".join(writer.mesh) + "\n")
        mesh = output_of(folder, "obj2mesh", "-w", "-a", "materials.rad", "scene.obj")
        (folder / "scene.rtm").write_bytes(mesh)
    result.octree.write_bytes(output_of(folder, "oconv", "-f", "-w", "scene.rad"))
    result.cube = float(output_of(folder, "getinfo", "-d", "scene.oct").split()[-1])
    return result


def is_object(entry: Any) -> bool:
    """Whether an entry of a scene is a shape or an emitter, rather than a material that others refer to."""
    kind = table(entry).get("type")
    if kind is None or kind == "ref":
        return False
    return kind not in _BSDFS


_BSDFS = {row.name for row in PLUGINS if row.kind in ("BSDF", "texture")} | {"rgb", "uniform", "spectrum"}
"""Materials and textures: they are exported with the shapes that use them."""


def split_sky(description: SceneDescription) -> list[tuple[SceneDescription, bool]]:
    """The scene with the sun alone and with the sky alone, which Radiance follows for different numbers of bounces.

    A scene without a sky is returned as it is.

    Returns:
        Scenes whose light sums to that of the whole, and whether each contains the light of the sky.

    Raises:
        SceneError: it has other environment light than a single `sunsky`, or additional lamps.
    """
    sky = {
        name: entry
        for name, entry in description.content.items()
        if table(entry).get("type") in ("sunsky", *_ENVIRONMENTS)
    }
    if not sky:
        return [(description, False)]
    (name, entry), *more = sky.items()
    if more or entry["type"] != "sunsky":
        raise SceneError(
            f"{name}: the export to Radiance supports only a single `sunsky` as a sky, not `{entry['type']}`"
        )
    dark = {name: entry | {"sky_scale": 0.0}}
    lit = {name: entry | {"sun_scale": 0.0}}
    lamps = {
        name
        for name, entry in description.content.items()
        if table(entry).get("type") in ("spot", "point") or "emitter" in table(entry)
    }
    if lamps:
        raise SceneError(
            f"{min(lamps)}: lamps together with a sky are not supported by the export to Radiance"
        )
    return [
        (replace(description, content={**description.content, **dark}), False),
        (replace(description, content={**description.content, **lit}), True),
    ]


class Writer:
    """Collects the contents of the files of a scene."""

    def __init__(self, description: SceneDescription, folder: Path, result: RadianceScene) -> None:
        self.description, self.result = description, result
        self.paint = Materials(folder)
        self.materials: list[str] = []
        self.objects: list[str] = []
        self.mesh: list[str] = []
        self.lights = 0
        self._counts = {"v": 0, "vt": 0, "vn": 0}

    def add(self, name: str, entry: Table) -> None:
        """Add a shape or an emitter of the scene.

        Raises:
            SceneError: Radiance has no counterpart.
        """
        kind = entry["type"]
        name = name.replace(" ", "_")
        if kind in _EMITTERS:
            self.lights += 1
            self._emitter(name, entry)
        elif kind == "triangles":
            self._triangles(name, entry)
        elif kind in _MESHES:
            self._triangles(name, {**entry, **mesh_of(entry), "type": "triangles"})
        elif kind == "rectangle":
            self._triangles(name, {**entry, **_rectangle(entry)})
        elif kind in ("sphere", "disk"):
            self._round(name, entry)
        else:
            raise SceneError(f"{name}: `{kind}` is not supported by the export to Radiance")

    def _triangles(self, name: str, entry: Table) -> None:
        """A mesh, or an area emitter of that shape."""
        bsdf = material_of(entry, self.description.content)
        if "emitter" in entry:
            polygons = _polygons(entry)
            self._area_emitter(name, entry, [("polygon", p.ravel(), _behind(p).ravel()) for p in polygons])
            return
        self.materials += self.paint.material(name, bsdf)
        if entry.get("normals") is None and not texture_of(bsdf):
            polygons = np.asarray(entry["vertices"], np.float64)[entry["faces"]]
            self.objects += [
                primitive(name, "polygon", f"{name}.{number}", figures=polygon.ravel())
                for number, polygon in enumerate(polygons)
            ]
            return
        corners: list[NDArray[np.int64] | None] = []
        looked_up = {**entry, "uv": _texture_coordinates(name, entry, texture_of(bsdf))}
        for label, key in (("v", "vertices"), ("vt", "uv"), ("vn", "normals")):
            values = looked_up.get(key)
            if values is None:
                corners.append(None)
                continue
            self.mesh += _rows(label, values)
            corners.append(np.asarray(entry["faces"], np.int64) + self._counts[label] + 1)
            self._counts[label] += len(values)
        self.mesh.append(f"usemtl {name}")
        self.mesh += _faces(*corners)

    def _round(self, name: str, entry: Table) -> None:
        """A sphere or a disk."""
        bsdf = material_of(entry, self.description.content)
        if texture_of(bsdf):
            raise SceneError(
                f"{name}: a texture on a `{entry['type']}` is not supported by the export to Radiance"
            )
        kind, figures, behind = (_sphere if entry["type"] == "sphere" else _disk)(name, entry)
        if "emitter" in entry:
            self._area_emitter(name, entry, [(kind, figures, behind)])
            return
        self.materials += self.paint.material(name, bsdf)
        self.objects.append(primitive(name, kind, f"{name}.0", figures=figures))

    def _area_emitter(self, name: str, entry: Table, shapes: list[tuple[str, Floats, Floats]]) -> None:
        """Reflecting sheets, and emitting ones behind them."""
        if entry["emitter"]["type"] != "area":
            raise SceneError(
                f"{name}: emitter `{entry['emitter']['type']}` is not supported by the export to Radiance"
            )
        bsdf = material_of(entry, self.description.content)
        if bsdf["type"] != "diffuse" or texture_of(bsdf):
            raise SceneError(
                f"{name}: an emitter with a BSDF other than untextured `diffuse` is not supported by the export to "
                "Radiance"
            )
        self.lights += 1
        rho = rgb(name, bsdf.get("reflectance", 0.5))
        radiance = rgb(name, entry["emitter"]["radiance"])
        if not rho.any():
            self.objects.append(primitive("void", "light", name, figures=radiance))
            self.objects += [
                primitive(name, kind, f"{name}.{number}", figures=front)
                for number, (kind, front, _) in enumerate(shapes)
            ]
            return
        through = 1 - float(rho.max())
        tint = rho / rho.max()
        self.objects += [
            primitive("void", "trans", f"{name}.sheet", figures=(*tint, 0, 0, through, 1)),
            primitive("void", "light", name, figures=radiance / (through * tint)),
        ]
        for number, (kind, front, behind) in enumerate(shapes):
            for material, figures in ((f"{name}.sheet", front), (name, behind)):
                self.objects.append(primitive(material, kind, f"{material}.{number}", figures=figures))

    def _emitter(self, name: str, entry: Table) -> None:
        """An emitter that is not a shape."""
        kind = entry["type"]
        if kind == "spot" and "texture" not in entry:
            matrix = np.asarray(entry["to_world"], np.float64)
            axis = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
            cutoff = entry.get("cutoff_angle", 20.0)
            figures = (*axis, entry.get("beam_width", 0.75 * cutoff), cutoff)
            beam = primitive("void", "brightfunc", f"{name}.beam", ("beam", "scene.cal"), figures)
            self.objects.append(beam)
            self._bulb(name, f"{name}.beam", entry, matrix[:3, 3])
        elif kind == "point":
            matrix = np.asarray(entry.get("to_world", np.eye(4)), np.float64)
            self._bulb(name, "void", entry, np.asarray(entry.get("position", matrix[:3, 3]), np.float64))
        elif kind == "directional":
            matrix = np.asarray(entry.get("to_world", np.eye(4)), np.float64)
            along = np.asarray(entry.get("direction", matrix[:3, 2]), np.float64)
            self._source(name, -along / np.linalg.norm(along), rgb(name, entry["irradiance"]), NARROW)
        elif kind == "constant":
            self._dome(name, "void", rgb(name, entry["radiance"]))
        elif kind == "envmap":
            self.objects.append(self.paint.picture(name, picture_of(environment_of(name, entry)), "sky"))
            self._dome(name, f"{name}.picture", np.ones(3))
        elif kind == "sunsky":
            self._sun_and_sky(name, entry)
        else:
            raise SceneError(f"{name}: a textured `{kind}` is not supported by the export to Radiance")

    def _bulb(self, name: str, modifier: str, entry: Table, place: Floats) -> None:
        """A small sphere that is invisible to the camera."""
        radiance = rgb(name, entry["intensity"]) / (np.pi * BULB**2)
        self.objects += [
            primitive(modifier, "illum", name, figures=radiance),
            primitive(name, "sphere", f"{name}.bulb", figures=(*place, BULB)),
        ]

    def _source(self, name: str, towards: Floats, irradiance: Floats, angle: float) -> None:
        """A distant source with an angular diameter of `angle` degrees."""
        solid = 2 * np.pi * (1 - np.cos(np.radians(angle) / 2))
        self.objects += [
            primitive("void", "light", f"{name}.sun", figures=irradiance / solid),
            primitive(f"{name}.sun", "source", f"{name}.disc", figures=(*towards, angle)),
        ]

    def _dome(self, name: str, modifier: str, radiance: Floats) -> None:
        """Light from all directions."""
        self.objects += [
            primitive(modifier, "glow", name, figures=(*radiance, 0)),
            primitive(name, "source", f"{name}.dome", figures=(0, 0, 1, 360)),
        ]
        self.result.sky = True

    def _sun_and_sky(self, name: str, entry: Table) -> None:
        """The sun as a distant source, the sky as a picture over all directions."""
        dark = [{**entry, key: 0.0} for key in ("sky_scale", "sun_scale")]
        sun, sky = (environment_of(name, each) for each in dark)
        if entry.get("sun_scale", 1.0) > 0:
            self._source(name, *sun_of(sun), entry.get("sun_aperture", 0.5358))
        if entry.get("sky_scale", 1.0) > 0:
            self.objects.append(self.paint.picture(name, picture_of(sky), "sky"))
            self._dome(name, f"{name}.picture", np.ones(3))


def _rectangle(entry: Table) -> dict[str, Any]:
    """Mitsuba's rectangle, which extends from -1 to 1, as triangles."""
    corners = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]], np.float64)
    matrix = np.asarray(entry.get("to_world", np.eye(4)), np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return {
        "vertices": (corners @ matrix.T)[:, :3],
        "faces": faces[:, ::-1] if _is_turned(entry) else faces,
        "uv": (corners[:, :2] + 1) / 2,
    }


def _sphere(name: str, entry: Table) -> tuple[str, Floats, Floats]:
    """A sphere's primitive and arguments, and the arguments of one just inside."""
    matrix = np.asarray(entry.get("to_world", np.eye(4)), np.float64)
    scale = _uniform_scale(name, matrix[:3, :3])
    if _is_turned(entry):
        raise SceneError(f"{name}: a sphere with inward normals is not supported by the export to Radiance")
    centre = matrix @ np.array([*entry.get("center", (0.0, 0.0, 0.0)), 1.0])
    radius = float(entry.get("radius", 1.0)) * scale
    return (
        "sphere",
        np.array([*centre[:3], radius]),
        np.array([*centre[:3], radius - min(SHEET, radius / 100)]),
    )


def _disk(name: str, entry: Table) -> tuple[str, Floats, Floats]:
    """A disk's primitive and arguments, and the arguments of one just behind."""
    matrix = np.asarray(entry.get("to_world", np.eye(4)), np.float64)
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    normal /= np.linalg.norm(normal) * (-1 if _is_turned(entry) else 1)
    radius = _uniform_scale(name, matrix[:3, :2])
    centre = matrix[:3, 3]
    return (
        "ring",
        np.array([*centre, *normal, 0.0, radius]),
        np.array([*(centre - SHEET * normal), *normal, 0.0, radius]),
    )


def _uniform_scale(name: str, columns: Floats) -> float:
    """The common length of the columns of a matrix, which must be perpendicular."""
    lengths = np.linalg.norm(columns, axis=0)
    products = columns.T @ columns
    if not np.allclose(products, np.eye(len(lengths)) * lengths[0] ** 2, atol=1e-4 * lengths[0] ** 2):
        raise SceneError(
            f"{name}: a sphere or disk with a non-uniform scale is not supported by the export to Radiance"
        )
    return float(lengths[0])


def _is_turned(entry: Table) -> bool:
    return bool(entry.get("flip_normals", False))


def _behind(polygon: Floats) -> Floats:
    """A copy of a polygon, displaced backwards by the distance between sheets."""
    normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
    behind: Floats = polygon - SHEET * normal / np.linalg.norm(normal)
    return behind


def _texture_coordinates(name: str, entry: Table, texture: Table) -> NDArray[np.floating[Any]] | None:
    """Texture coordinates of a shape, transformed by its texture; None if it has none."""
    uv = entry.get("uv")
    if uv is None:
        if texture:
            raise SceneError(f"{name}: has a texture but no texture coordinates")
        return None
    matrix = np.asarray(texture.get("to_uv", np.eye(3)), np.float64)
    if matrix.shape == (4, 4):
        matrix = matrix[np.ix_((0, 1, 3), (0, 1, 3))]
    uv = np.asarray(uv, np.float64)
    moved: NDArray[np.floating[Any]] = uv @ matrix[:2, :2].T + matrix[:2, 2]
    return moved


def _polygons(entry: Table) -> Iterable[Floats]:
    """The faces of an emitter, (3 or 4, 3); quadrilaterals are not split, as Radiance samples them better whole."""
    vertices, faces = np.asarray(entry["vertices"], np.float64), np.asarray(entry["faces"])
    whole = [[0, 1, 2], [0, 2, 3]]
    if len(vertices) == 4 and np.allclose(vertices[0] + vertices[2], vertices[1] + vertices[3], atol=1e-5):
        if np.array_equal(faces, whole):
            return [vertices]
        if np.array_equal(faces[:, ::-1], whole):
            return [vertices[::-1]]
    return list(vertices[faces])


def _rows(label: str, values: NDArray[np.floating[Any]]) -> list[str]:
    """Lines of an OBJ file."""
    return [f"{label} " + " ".join(f"{number:.7g}" for number in row) for row in np.asarray(values).tolist()]


def _faces(
    vertices: NDArray[np.int64] | None, uv: NDArray[np.int64] | None, normals: NDArray[np.int64] | None
) -> list[str]:
    """Face lines of an OBJ file."""
    columns = [array for array in (vertices, uv, normals) if array is not None]
    corner = (
        "{}"
        if uv is None and normals is None
        else "{}//{}"
        if uv is None
        else "/".join(["{}"] * len(columns))
    )
    line = "f " + " ".join([corner] * 3)
    return [line.format(*row) for row in np.stack(columns, axis=2).reshape(len(columns[0]), -1).tolist()]
