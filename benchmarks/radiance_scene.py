"""A scene of steadylight as Radiance wants it: an octree, with everything in it that Radiance can say.

Radiance counts in W/(m² sr) too, so radiances carry over as they are: its 179 lm/W comes in only where luminance is
asked for. Faceted surfaces without a texture become polygons, which Radiance meets fastest; all others one triangle
mesh, since a ray walks through one octree faster than through one for each material. What differs:

- Pictures (textures, sky) go through RGBE: 8 bits of mantissa, without bias. Same texels, same bilinear filter.
- An area emitter that reflects becomes two sheets a tenth of a millimetre apart, as a `light` reflects nothing: in
  front a `trans` that reflects as much as the emitter and lets the rest through, behind it the `light`, stronger by
  what the sheet keeps back.
- A spot lamp becomes an `illum` sphere of 5 mm that the eye does not see, with Mitsuba's fall-off.
- GGX becomes Ward's lobe of the same roughness: `metal` and `plastic` with the reflectance that Mitsuba's material has
  at 45 degrees. Radiance's rough `plastic` knows no Fresnel: at grazing angles it is darker.
- The sky is a `glow`, which Radiance finds by ambient rays only, so that it costs one of the ambient bounces; the sun
  is a `source` of its irradiance.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes.description import SceneDescription

SHEET = 1e-4
"""Metres between the reflecting and the emitting sheet of an area emitter."""

BULB = 0.005
"""Radius of the sphere that stands for a spot lamp, metres."""

SKY = (1024, 512)
"""Columns and rows of the picture of the sky, over the whole sphere."""

DIRECTIONS = 1 << 16
"""Samples for the reflectance of a material, and for the irradiance of the sun."""

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

RGB = NDArray[np.float64]


@dataclass
class RadianceScene:
    """A scene for Radiance's programs.

    Attributes:
        octree: the file that they read; its other files lie beside it.
        cube: side of the octree, metres: `-ar` counts in it.
        sky: whether light comes from a `glow` around everything, at the cost of an ambient bounce.
    """

    octree: Path
    cube: float = 0.0
    sky: bool = False


def command(program: str, *arguments: object) -> list[str]:
    """A call of one of Radiance's programs as pyradiance brings them."""
    from pyradiance.anci import BINPATH

    return [str(BINPATH / program), *map(str, arguments)]


def environment(folder: Path) -> dict[str, str]:
    """Where the programs find Radiance's files and those of the scene in `folder`."""
    from pyradiance.anci import BINPATH

    return os.environ | {"RAYPATH": os.pathsep.join([str(folder), str(BINPATH.parent / "lib")])}


def export(description: SceneDescription, folder: Path) -> RadianceScene:
    """Write a scene for Radiance into `folder`; Mitsuba's variant must be set.

    Raises:
        ValueError: something in the scene has no counterpart here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    result = RadianceScene(folder / "scene.oct")
    (folder / "scene.cal").write_text(FUNCTIONS)
    writer = _Writer(description, folder, result)
    for name, entry in description.content.items():
        if isinstance(entry, Mapping) and entry.get("type") not in (None, "ref"):
            writer.add(name, entry)
    if writer.mesh:
        writer.objects.append("void mesh everything 1 scene.rtm 0 0")
    (folder / "materials.rad").write_text("\n".join(writer.materials) + "\n")
    (folder / "scene.rad").write_text("\n".join(writer.materials + writer.objects) + "\n")
    if writer.mesh:
        (folder / "scene.obj").write_text("\n".join(writer.mesh) + "\n")
        mesh = _output(folder, "obj2mesh", "-w", "-a", "materials.rad", "scene.obj")
        (folder / "scene.rtm").write_bytes(mesh)
    result.octree.write_bytes(_output(folder, "oconv", "-f", "-w", "scene.rad"))
    result.cube = float(_output(folder, "getinfo", "-d", "scene.oct").split()[-1])
    return result


def _output(folder: Path, program: str, *arguments: str) -> bytes:
    """What a program of Radiance says of the files in `folder`."""
    call = command(program, *arguments)
    return subprocess.run(
        call, cwd=folder, env=environment(folder), check=True, stdout=subprocess.PIPE
    ).stdout


def split_sky(description: SceneDescription) -> list[tuple[SceneDescription, bool]]:
    """The scene under each of its lights that Radiance follows for a different number of bounces.

    Returns:
        Scenes whose light adds up to that of the whole, and whether each is the light of the sky.
    """
    sky = {
        k: e for k, e in description.content.items() if _kind(e) in ("sunsky", "envmap", "constant", "sky")
    }
    if not sky:
        return [(description, False)]
    (name, entry), *more = sky.items()
    if more or entry["type"] != "sunsky":
        raise ValueError(f"{name}: of skies only one `sunsky` is known here, not `{entry['type']}`")
    dark = {name: entry | {"sky_scale": 0.0}}
    lit = {name: entry | {"sun_scale": 0.0}}
    lamps = {
        k for k, e in description.content.items() if _kind(e) in ("spot", "point") or "emitter" in _table(e)
    }
    if lamps:
        raise ValueError(f"{min(lamps)}: lamps under a sky are not known here")
    return [
        (replace(description, content=description.content | dark), False),
        (replace(description, content=description.content | lit), True),
    ]


class _Writer:
    """Gathers what the files of a scene will hold."""

    def __init__(self, description: SceneDescription, folder: Path, result: RadianceScene) -> None:
        self.description, self.folder, self.result = description, folder, result
        self.materials: list[str] = []
        self.objects: list[str] = []
        self.mesh: list[str] = []
        self.counts = {"v": 0, "vt": 0, "vn": 0}

    def add(self, name: str, entry: Mapping[str, Any]) -> None:
        """A shape or an emitter of the scene."""
        kind = entry["type"]
        if kind == "triangles" and "emitter" in entry:
            self.area_emitter(name, entry)
        elif kind == "triangles":
            self.materials += self.material(name, _material_of(entry, self.description.content))
            self.triangles(name, entry)
        elif kind == "spot":
            self.spot(name, entry)
        elif kind == "sunsky":
            self.sun_and_sky(name, entry)
        else:
            raise ValueError(f"{name}: `{kind}` is not known to the export to Radiance")

    def triangles(self, name: str, entry: Mapping[str, Any]) -> None:
        """A mesh: as polygons, or as a group of the OBJ file if it is smooth or has texture coordinates."""
        if entry.get("normals") is None and entry.get("uv") is None:
            polygons = np.asarray(entry["vertices"], np.float64)[entry["faces"]]
            self.objects += [
                _primitive(name, "polygon", f"{name}.{number}", numbers=polygon.ravel())
                for number, polygon in enumerate(polygons)
            ]
            return
        corners = []
        for label, key in (("v", "vertices"), ("vt", "uv"), ("vn", "normals")):
            values = entry.get(key)
            if values is None:
                corners.append(None)
                continue
            self.mesh += _rows(label, values)
            corners.append(np.asarray(entry["faces"], np.int64) + self.counts[label] + 1)
            self.counts[label] += len(values)
        self.mesh.append(f"usemtl {name}")
        self.mesh += _faces(*corners)

    def material(self, name: str, bsdf: Mapping[str, Any]) -> list[str]:
        """The primitives of a material."""
        kind = bsdf["type"]
        if kind == "diffuse":
            pattern, colour, lines = self.colour(name, bsdf.get("reflectance", 0.5))
            return [*lines, _primitive(pattern, "plastic", name, numbers=(*colour, 0, 0))]
        if kind == "roughplastic":
            pattern, colour, lines = self.colour(name, bsdf.get("diffuse_reflectance", 0.5))
            white = {k: v for k, v in bsdf.items() if k != "diffuse_reflectance"}
            gloss = float(reflectance(white | {"diffuse_reflectance": 0.0}).mean())
            under = float(reflectance(white | {"diffuse_reflectance": 1.0}).mean()) - gloss
            numbers = (*(under * colour / (1 - gloss)), gloss, bsdf.get("alpha", 0.1))
            return [*lines, _primitive(pattern, "plastic", name, numbers=numbers)]
        if kind == "roughconductor":
            numbers = (*reflectance(bsdf), 1, bsdf.get("alpha", 0.1))
            return [_primitive("void", "metal", name, numbers=numbers)]
        if kind == "thindielectric":
            return [_primitive("void", "glass", name, numbers=(1, 1, 1, bsdf.get("int_ior", 1.5046)))]
        raise ValueError(f"{name}: material `{kind}` is not known to the export to Radiance")

    def colour(self, name: str, value: Any) -> tuple[str, RGB, list[str]]:
        """A reflectance as a pattern (`void` if it is plain) and a factor, and the pattern's primitives."""
        if not isinstance(value, Mapping) or value["type"] == "rgb":
            return "void", _rgb(value), []
        if value["type"] != "bitmap" or "data" not in value:
            raise ValueError(f"{name}: texture `{value['type']}` is not known to the export to Radiance")
        return f"{name}.picture", np.ones(3), [self.picture(name, value["data"], "texture")]

    def picture(self, name: str, image: NDArray[np.floating], coordinates: str) -> str:
        """Write a repeating picture, (H, W, 3); the pattern that looks it up."""
        padded = np.pad(np.asarray(image, np.float64), ((1, 1), (1, 1), (0, 0)), mode="wrap")
        write_rgbe(self.folder / f"{name}.hdr", padded)
        height, width = padded.shape[:2]
        sides = max(1.0, width / height), max(1.0, height / width)
        words = ("red", "green", "blue", f"{name}.hdr", "scene.cal", f"{coordinates}_u", f"{coordinates}_v")
        return _primitive("void", "colorpict", f"{name}.picture", words, (width - 2, height - 2, *sides))

    def area_emitter(self, name: str, entry: Mapping[str, Any]) -> None:
        """A sheet that reflects, and behind it one that shines."""
        if entry["emitter"]["type"] != "area":
            raise ValueError(f"{name}: emitter `{entry['emitter']['type']}` is not known here")
        bsdf = _material_of(entry, self.description.content)
        if bsdf["type"] != "diffuse":
            raise ValueError(f"{name}: an emitter that is not diffuse is not known here")
        rho, radiance = _rgb(bsdf.get("reflectance", 0.5)), _rgb(entry["emitter"]["radiance"])
        through = 1 - float(rho.max())
        tint = rho / rho.max() if rho.max() else np.ones(3)
        self.objects += [
            _primitive("void", "trans", f"{name}.sheet", numbers=(*tint, 0, 0, through, 1)),
            _primitive("void", "light", name, numbers=radiance / (through * tint)),
        ]
        for number, polygon in enumerate(_polygons(entry)):
            normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
            behind = polygon - SHEET * normal / np.linalg.norm(normal)
            for kind, corners in ((f"{name}.sheet", polygon), (name, behind)):
                self.objects.append(_primitive(kind, "polygon", f"{kind}.{number}", numbers=corners.ravel()))

    def spot(self, name: str, entry: Mapping[str, Any]) -> None:
        """A small sphere that lights a cone."""
        matrix = np.asarray(entry["to_world"], np.float64)
        axis, place = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]), matrix[:3, 3]
        cutoff = entry.get("cutoff_angle", 20.0)
        numbers = (*axis, entry.get("beam_width", 0.75 * cutoff), cutoff)
        radiance = _rgb(entry["intensity"]) / (np.pi * BULB**2)
        self.objects += [
            _primitive("void", "brightfunc", f"{name}.beam", ("beam", "scene.cal"), numbers),
            _primitive(f"{name}.beam", "illum", name, numbers=radiance),
            _primitive(name, "sphere", f"{name}.bulb", numbers=(*place, BULB)),
        ]

    def sun_and_sky(self, name: str, entry: Mapping[str, Any]) -> None:
        """The sun as a distant source, the sky as a picture around everything."""
        sun, sky = (_emitter(name, entry | {dark: 0.0}) for dark in ("sky_scale", "sun_scale"))
        direction, irradiance = _sun(sun)
        angle = entry.get("sun_aperture", 0.5358)
        solid = 2 * np.pi * (1 - np.cos(np.radians(angle) / 2))
        self.objects += [
            _primitive("void", "light", f"{name}.sun", numbers=irradiance / solid),
            _primitive(f"{name}.sun", "source", f"{name}.disc", numbers=(*direction, angle)),
            self.picture(name, _picture_of(sky), "sky"),
            _primitive(f"{name}.picture", "glow", name, numbers=(1, 1, 1, 0)),
            _primitive(name, "source", f"{name}.dome", numbers=(0, 0, 1, 360)),
        ]
        self.result.sky = True


def write_rgbe(path: Path, image: NDArray[np.floating]) -> None:
    """An (H, W, 3) picture as Radiance's RGBE; readers take the middle of what a byte stands for."""
    brightest = np.maximum(image.max(axis=2), 1e-30)
    exponent = np.frexp(brightest)[1]
    mantissa = np.clip(np.floor(image * np.exp2(8.0 - exponent)[..., None]), 0, 255)
    stored = np.concatenate([mantissa, (exponent + 128)[..., None]], axis=2)
    stored[brightest <= 1e-30] = 0
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {image.shape[0]} +X {image.shape[1]}\n"
    path.write_bytes(head.encode() + stored.astype(np.uint8).tobytes())


def reflectance(bsdf: Mapping[str, Any]) -> RGB:
    """What Mitsuba's material sends back of light from 45 degrees, (3,)."""
    import drjit as dr
    import mitsuba as mi

    material = mi.load_dict(dict(bsdf))
    si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS)
    si.wi = mi.Vector3f(0.5**0.5, 0, 0.5**0.5)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, DIRECTIONS)
    _, weight = material.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return np.array(weight, np.float64).reshape(3, -1).mean(axis=1)


def _emitter(name: str, entry: Mapping[str, Any]) -> Any:
    """Mitsuba's emitter of an entry around a small scene."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    speck = {"type": "triangles", "vertices": corners, "faces": np.array([[0, 1, 2]], np.uint32)}
    camera = CameraPath((Keyframe(0.0, (0.0, 0.0, 5.0), (0.0, 1.0, 0.0)),))
    return build_scene(SceneDescription(name, {name: entry, "speck": speck}, camera)).environment()


def _sun(emitter: Any) -> tuple[RGB, RGB]:
    """Direction towards the sun, and its irradiance on a surface that faces it, W/m² RGB."""
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, DIRECTIONS)
    towards, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, DIRECTIONS), sampler.next_2d())
    direction = np.array(towards.d, np.float64).reshape(3, -1).mean(axis=1)
    return direction / np.linalg.norm(direction), np.array(weight, np.float64).reshape(3, -1).mean(axis=1)


def _picture_of(emitter: Any) -> NDArray[np.float64]:
    """Radiance from all directions, (H, W, 3): azimuth from +x by columns, angle from the zenith by rows."""
    import drjit as dr
    import mitsuba as mi

    width, height = SKY
    azimuth, polar = np.meshgrid(
        (np.arange(width) + 0.5) / width * 2 * np.pi, (np.arange(height) + 0.5) / height * np.pi
    )
    d = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    si = dr.zeros(mi.SurfaceInteraction3f, width * height)
    si.wi = -mi.Vector3f(d.reshape(3, -1).astype(np.float32))
    seen = np.array(emitter.eval(si), np.float64).reshape(3, height, width)
    return np.moveaxis(seen, 0, 2)


def _polygons(entry: Mapping[str, Any]) -> Iterable[NDArray[np.float64]]:
    """The faces of an emitter, (3 or 4, 3); a quadrilateral in one piece, which Radiance samples better."""
    vertices, faces = np.asarray(entry["vertices"], np.float64), np.asarray(entry["faces"])
    if np.array_equal(faces, [[0, 1, 2], [0, 2, 3]]) and np.allclose(
        vertices[0] + vertices[2], vertices[1] + vertices[3], atol=1e-5
    ):
        return [vertices[:4]]
    return vertices[faces]


def _material_of(entry: Mapping[str, Any], content: Mapping[str, Any]) -> Mapping[str, Any]:
    """The material of a shape, looked through references and `twosided`: Radiance's materials all are."""
    bsdf: Mapping[str, Any] = entry.get("bsdf", {"type": "diffuse"})
    while bsdf["type"] in ("ref", "twosided"):
        bsdf = content[bsdf["id"]] if bsdf["type"] == "ref" else next(v for v in bsdf.values() if _table(v))
    return bsdf


def _primitive(
    modifier: str, kind: str, name: str, words: Sequence[str] = (), numbers: Iterable[float] = ()
) -> str:
    """One primitive in Radiance's grammar."""
    values = [f"{float(number):.9g}" for number in numbers]
    return f"{modifier} {kind} {name}\n{len(words)} {' '.join(words)}\n0\n{len(values)} {' '.join(values)}\n"


def _rows(label: str, values: NDArray[np.floating]) -> list[str]:
    """Lines of an OBJ file."""
    return [f"{label} " + " ".join(f"{number:.7g}" for number in row) for row in values.tolist()]


def _faces(
    vertices: NDArray[np.int64], uv: NDArray[np.int64] | None, normals: NDArray[np.int64] | None
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
    return [line.format(*row) for row in np.stack(columns, axis=2).reshape(len(vertices), -1).tolist()]


def _rgb(value: Any) -> RGB:
    """A plain colour, (3,)."""
    if isinstance(value, Mapping):
        value = value["value"]
    return np.broadcast_to(np.asarray(value, np.float64), 3)


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _kind(value: Any) -> str:
    return str(_table(value).get("type", ""))
