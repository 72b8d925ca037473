"""Every plugin of Mitsuba, alone in a small room: brightness of the two passes over that of the path tracer.

    python benchmarks/plugins.py [NAME ...] [--pictures FOLDER] [--samples 512]

Each row of the table in `steadylight.scenes.mitsuba_plugins` is put into a room that is open in front, and rendered in
this process by both passes (8 bounces) and by `path` (12 bounces: mirrors and glass count as bounces there). Columns:
mean of the picture over that of `path`, less one, in percent, by colour; the same for the pixels that show the thing;
the noise of `path` in that mean; the darkest value; look-ups that no record answered. A plugin that is refused shows
the message. The script ends with exit code 1 if a mean is off by more than 1 % (2 % for roughdielectric), a value is
negative or not finite, or a look-up was missed.
"""

from __future__ import annotations

import argparse
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steadylight.cache.smoothing import smooth
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError
from steadylight.images import tone_map, write_png
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.mitsuba_plugins import PLUGINS, refusals
from steadylight.settings import RenderSettings

Content = dict[str, Any]

SIZE = (64, 64)
CAMERA = CameraPath((Keyframe(0.0, (0, -5.5, 1.7), (0, 0, 1.4), fov=45),))
TOLERANCE = {"roughdielectric": 0.02}
"""Of the mean; 0.01 elsewhere."""

NEGATIVE_LOBES = ("mitchell", "catmullrom", "lanczos")
"""Filters that go below zero beside a bright edge, by either way of rendering."""


def place(
    scale: tuple[float, float, float], at: tuple[float, float, float], about_x: float = 0
) -> np.ndarray:
    """(4, 4) scale, then turn about the x axis by degrees, then move."""
    c, s = np.cos(np.radians(about_x)), np.sin(np.radians(about_x))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.diag(scale)
    matrix[:3, 3] = at
    return matrix


def rgb(*value: float) -> Content:
    """A colour."""
    return {"type": "rgb", "value": list(value)}


def paint(*albedo: float) -> Content:
    """A diffuse BSDF."""
    return {"type": "diffuse", "reflectance": rgb(*albedo)}


def image(data: np.ndarray) -> Content:
    """A texture of raw numbers."""
    return {"type": "bitmap", "data": np.asarray(data, np.float32), "raw": True}


WARM = paint(0.6, 0.3, 0.2)
LAMP = {
    "type": "rectangle",
    "to_world": place((0.7, 0.5, 1), (0, 0.8, 2.95), 180),
    "bsdf": paint(0, 0, 0),
    "emitter": {"type": "area", "radiance": rgb(9, 8, 7)},
}
RIPPLES = np.sin(np.linspace(0, 12 * np.pi, 64))[None, :, None] * np.ones((64, 1, 1))
LEANING = np.broadcast_to([0.65, 0.5, 0.95], (4, 4, 3))
SPOTS = (np.indices((4, 4)).sum(0) % 2 * 1.0)[..., None]
PANEL = {"type": "rectangle", "to_world": place((1.1, 0.9, 1), (0, 0, 1.3), 60)}
BALL = {"type": "sphere", "center": [0, 0, 1], "radius": 0.9}


def room(light: Content | None, **more: Any) -> Content:
    """A room 4 m wide and 3 m high without a front wall; half of its ceiling is open to the sky."""

    def wall(matrix: np.ndarray, material: Content) -> Content:
        return {"type": "rectangle", "to_world": matrix, "bsdf": {"type": "twosided", "bsdf": material}}

    def side(x: float) -> np.ndarray:
        return np.array([[0, 0, -x / 2, x], [0, 2, 0, 0], [x / 2 * 1.5, 0, 0, 1.5], [0, 0, 0, 1]], float)

    white = paint(0.5, 0.5, 0.5)
    content = {
        "floor": wall(place((2, 2, 1), (0, 0, 0)), white),
        "back": wall(place((2, 1.5, 1), (0, 2, 1.5), 90), white),
        "left": wall(side(-2), paint(0.6, 0.2, 0.1)),
        "right": wall(side(2), paint(0.2, 0.5, 0.2)),
        "ceiling": wall(place((2, 1, 1), (0, 1, 3), 180), white),
    }
    return content | ({} if light is None else {"light": light}) | more


BSDFS: dict[str, Content] = {
    "diffuse": WARM,
    "plastic": {"type": "plastic", "diffuse_reflectance": rgb(0.1, 0.3, 0.5)},
    "roughplastic": {"type": "roughplastic", "alpha": 0.15, "diffuse_reflectance": rgb(0.1, 0.3, 0.5)},
    "pplastic": {"type": "pplastic", "alpha": 0.15, "diffuse_reflectance": rgb(0.1, 0.3, 0.5)},
    "principled": {
        "type": "principled",
        "base_color": rgb(0.6, 0.4, 0.2),
        "roughness": 0.3,
        "metallic": 0.2,
        "specular": 0.6,
        "clearcoat": 0.4,
    },
    "principled: metal": {
        "type": "principled",
        "base_color": rgb(0.9, 0.7, 0.5),
        "metallic": 1.0,
        "roughness": 0.3,
    },
    "principled: spec_trans": {
        "type": "principled",
        "base_color": rgb(0.9, 0.9, 0.95),
        "spec_trans": 1.0,
        "roughness": 0.1,
        "eta": 1.5,
    },
    "principled: spec_trans 0.5": {
        "type": "principled",
        "base_color": rgb(0.9, 0.5, 0.5),
        "spec_trans": 0.5,
        "roughness": 0.3,
    },
    "principled: sheen, flatness": {
        "type": "principled",
        "base_color": rgb(0.8, 0.7, 0.5),
        "roughness": 1.0,
        "sheen": 1.0,
        "flatness": 0.5,
    },
    "principledthin": {
        "type": "principledthin",
        "base_color": rgb(0.7, 0.6, 0.4),
        "roughness": 0.5,
        "diff_trans": 1.2,
        "spec_trans": 0.2,
    },
    "principledthin: diff_trans": {
        "type": "principledthin",
        "base_color": rgb(0.7, 0.6, 0.4),
        "diff_trans": 1.2,
    },
    "conductor": {"type": "conductor", "material": "Au"},
    "roughconductor": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "dielectric": {"type": "dielectric"},
    "thindielectric": {"type": "thindielectric"},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    "hair": {"type": "hair"},
    "null": {"type": "null"},
    "twosided": {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.2}},
    "mask": {"type": "mask", "opacity": 0.4, "bsdf": WARM},
    "mask: texture": {"type": "mask", "opacity": image(SPOTS), "bsdf": WARM},
    "mask: principled": {
        "type": "mask",
        "opacity": 0.6,
        "bsdf": {"type": "twosided", "bsdf": {"type": "principled", "base_color": rgb(0.6, 0.5, 0.4)}},
    },
    "blendbsdf": {
        "type": "blendbsdf",
        "weight": 0.4,
        "first": WARM,
        "second": {"type": "roughconductor", "alpha": 0.2},
    },
    "blendbsdf: principled": {
        "type": "blendbsdf",
        "weight": 0.5,
        "first": {"type": "principled", "base_color": rgb(0.6, 0.5, 0.4), "roughness": 0.4},
        "second": {"type": "roughdielectric", "alpha": 0.3},
    },
    "bumpmap": {
        "type": "twosided",
        "bsdf": {"type": "bumpmap", "bump": image(RIPPLES), "scale": 0.02, "bsdf": WARM},
    },
    "normalmap": {
        "type": "twosided",
        "bsdf": {"type": "normalmap", "normalmap": image(LEANING), "bsdf": WARM},
    },
    "normalmap: roughplastic": {
        "type": "twosided",
        "bsdf": {
            "type": "normalmap",
            "normalmap": image(LEANING),
            "bsdf": {"type": "roughplastic", "alpha": 0.2},
        },
    },
    "normalmap: principled": {
        "type": "twosided",
        "bsdf": {
            "type": "normalmap",
            "normalmap": image(LEANING),
            "bsdf": {"type": "principled", "base_color": rgb(0.6, 0.5, 0.4), "roughness": 0.4},
        },
    },
    "measured_polarized": {"type": "measured_polarized", "filename": "none.pbsdf"},
    "polarizer": {"type": "polarizer"},
    "retarder": {"type": "retarder"},
    "circular": {"type": "circular"},
}
SOLID = (
    "dielectric",
    "roughdielectric",
    "principled: spec_trans",
    "principled: spec_trans 0.5",
    "blendbsdf: principled",
)

SKY = np.concatenate([np.full((8, 32, 3), [0.3, 0.5, 0.9]), np.full((8, 32, 3), [0.2, 0.15, 0.1])])
SKY[3, 4:8] = [30, 28, 20]
DOWN = place((1, 1, 1), (0.5, -0.5, 2.8), 160)
EMITTERS: dict[str, Content] = {
    "area": LAMP,
    "area: texture": {
        **LAMP,
        "emitter": {"type": "area", "radiance": image(np.random.default_rng(0).random((4, 4, 3)) * 16)},
    },
    "point": {"type": "point", "position": [1.2, -0.8, 2.2], "intensity": rgb(8, 7, 6)},
    "spot": {"type": "spot", "to_world": DOWN, "intensity": rgb(30, 27, 20), "cutoff_angle": 40},
    "projector": {
        "type": "projector",
        "to_world": DOWN,
        "irradiance": image(np.random.default_rng(1).random((4, 4, 3)) * 6),
        "fov": 60.0,
    },
    "directional": {"type": "directional", "direction": [-0.4, 0.5, -0.7], "irradiance": rgb(5, 5, 4)},
    "directionalarea": {
        **LAMP,
        "emitter": {"type": "directionalarea", "radiance": rgb(9, 8, 7)},
    },
    "constant": {"type": "constant", "radiance": rgb(0.6, 0.8, 1)},
    "envmap": {"type": "envmap", "data": SKY.astype(np.float32), "to_world": place((1, 1, 1), (0, 0, 0), 90)},
    "sunsky": {"type": "sunsky", "sun_direction": [0.5, -0.6, 0.7], "turbidity": 3.0, "sun_aperture": 5.0},
    "timed_sunsky": {"type": "timed_sunsky"},
}

RED = image(np.array([[[0.7, 0.2, 0.1], [0.2, 0.6, 0.3]], [[0.2, 0.3, 0.7], [0.6, 0.6, 0.2]]]))
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")
SENSORS: dict[str, Content] = {
    "perspective": {"type": "perspective"},
    "thinlens": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 5.5},
    "orthographic": {"type": "orthographic", "scale": [1.8, 1.8, 1.0]},
    "radiancemeter": {"type": "radiancemeter"},
    "irradiancemeter": {"type": "irradiancemeter"},
    "distant": {"type": "distant"},
    "batch": {"type": "batch"},
}


class Entry(NamedTuple):
    """A row of the table."""

    kind: str
    name: str
    scene: SceneDescription


def entries(folder: Path) -> Iterator[Entry]:
    """Every plugin in a room of its own; `folder` takes the files that shapes and textures need."""

    def scene(content: Content, **more: Any) -> SceneDescription:
        return SceneDescription("room", content, CAMERA, width=SIZE[0], height=SIZE[1], **more)

    for name, bsdf in BSDFS.items():
        yield Entry(
            "BSDF", name, scene(room(LAMP, thing={**(BALL if name in SOLID else PANEL), "bsdf": bsdf}))
        )
    for name, emitter in EMITTERS.items():
        yield Entry("emitter", name, scene(room(emitter, thing={**BALL, "bsdf": WARM})))
    for name, shape in shapes(folder).items():
        yield Entry("shape", name, scene(room(LAMP, **shape)))
    for name, texture in textures(folder).items():
        yield Entry("texture", name, scene(room(LAMP, thing=texture)))
    plain = room(LAMP, thing={**BALL, "bsdf": WARM})
    for name, sensor in SENSORS.items():
        yield Entry("sensor", name, scene(plain, sensor=sensor))
    for name in FILTERS:
        yield Entry("filter", name, scene(plain, film={"type": name}))


def shapes(folder: Path) -> dict[str, Content]:
    """Entries of a scene with a thing of each shape."""
    import mitsuba as mi

    def sphere() -> tuple[np.ndarray, np.ndarray]:
        """An octahedron, divided thrice and blown up."""
        v = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
        signs = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
        faces = [(x, y, z) if (x + y + z) % 2 == 0 else (x, z, y) for x, y, z in signs]
        points = [np.array(p, float) for p in v]
        for _ in range(3):
            finer = []
            for a, b, c in faces:
                ab, bc, ca = (len(points) + k for k in range(3))
                points += [points[i] + points[j] for i, j in ((a, b), (b, c), (c, a))]
                finer += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            faces = finer
        vertices = np.array([p / np.linalg.norm(p) * 0.9 + [0, 0, 1] for p in points])
        return vertices.astype(np.float32), np.array(faces, np.uint32)

    vertices, triangles = sphere()
    mesh = mi.Mesh("ball", len(vertices), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), triangles.ravel()
    parameters.update()
    mesh.write_ply(str(folder / "ball.ply"))
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    (folder / "ball.obj").write_text("\n".join(lines))
    data = struct.pack("<I", 0x1000) + b"ball\0" + struct.pack("<QQ", len(vertices), len(triangles))
    data += vertices.tobytes() + triangles.tobytes()
    packed = struct.pack("<HH", 0x041C, 4) + zlib.compress(data)
    (folder / "ball.serialized").write_bytes(packed + struct.pack("<QI", 0, 1))
    turns = np.linspace(0, 4 * np.pi, 40)
    curve = np.stack([0.8 * np.cos(turns), 0.8 * np.sin(turns), turns / 6 + 0.2, np.full(40, 0.12)], axis=1)
    np.savetxt(folder / "curve.txt", curve)
    k = (np.indices((24, 24, 24)).transpose(1, 2, 3, 0) + 0.5) / 24 - 0.5
    distance = (np.linalg.norm(k, axis=-1) - 0.4).astype(np.float32)[..., None]
    mi.VolumeGrid(distance).write(str(folder / "ball.vol"))

    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.9, "bsdf": BSDFS["roughconductor"]}}
    instance = {
        "type": "instance",
        "shapegroup": {"type": "ref", "id": "group"},
        "to_world": place((1, 1, 1), (0, 0, 1)),
    }
    standing = place((0.8, 0.8, 1.6), (0, 0, 0))
    bent = {"filename": str(folder / "curve.txt"), "bsdf": {"type": "twosided", "bsdf": WARM}}
    things: dict[str, Content] = {
        "obj": {"type": "obj", "filename": str(folder / "ball.obj")},
        "ply": {"type": "ply", "filename": str(folder / "ball.ply")},
        "serialized": {"type": "serialized", "filename": str(folder / "ball.serialized")},
        "cube": {"type": "cube", "to_world": place((0.6, 0.6, 0.6), (0, 0, 0.7))},
        "rectangle": PANEL,
        "sphere": BALL,
        "disk": {"type": "disk", "to_world": place((0.9, 0.9, 1), (0, 0, 1.3), 60)},
        "cylinder": {
            "type": "cylinder",
            "to_world": standing,
            "bsdf": {"type": "twosided", "bsdf": WARM},
        },
        "linearcurve": {"type": "linearcurve", **bent},
        "bsplinecurve": {"type": "bsplinecurve", **bent},
        "sdfgrid": {
            "type": "sdfgrid",
            "filename": str(folder / "ball.vol"),
            "to_world": place((2, 2, 2), (-1, -1, 0)),
        },
        "blender": {"type": "blender"},
        "merge": {"type": "merge"},
        "ellipsoids": {"type": "ellipsoids"},
        "ellipsoidsmesh": {"type": "ellipsoidsmesh"},
    }
    made = {name: {"thing": {"bsdf": WARM, **thing}} for name, thing in things.items()}
    return made | {"shapegroup, instance": {"group": group, "thing": instance}}


def textures(folder: Path) -> dict[str, Content]:
    """Things with each texture."""
    import mitsuba as mi

    ball = mi.load_dict({"type": "ply", "filename": str(folder / "ball.ply")})
    count = ball.vertex_count()
    colour = np.random.default_rng(2).uniform(0.2, 0.7, (count, 3)).astype(np.float32)
    ball.add_attribute("vertex_color", 3, colour.ravel())
    ball.write_ply(str(folder / "coloured.ply"))
    mi.VolumeGrid(np.random.default_rng(3).random((4, 4, 4, 3)).astype(np.float32)).write(
        str(folder / "colours.vol")
    )
    grid = {
        "type": "gridvolume",
        "filename": str(folder / "colours.vol"),
        "to_world": place((4, 4, 3), (-2, -2, 0)),
    }

    def of(texture: Content) -> Content:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}

    return {
        "bitmap": {**PANEL, "bsdf": of(RED)},
        "checkerboard": {**PANEL, "bsdf": of({"type": "checkerboard", "to_uv": np.diag([4.0, 4, 1, 1])})},
        "mesh_attribute": {
            "type": "ply",
            "filename": str(folder / "coloured.ply"),
            "bsdf": of({"type": "mesh_attribute", "name": "vertex_color"}),
        },
        "volume": {**BALL, "bsdf": of({"type": "volume", "volume": grid})},
    }


class Result(NamedTuple):
    """What is measured of an entry."""

    whole: np.ndarray  # (3,) mean over that of path, less one
    thing: np.ndarray | None  # the same where the thing is seen
    noise: float  # of path, in the mean of the thing
    darkest: float
    finite: bool
    missed: int
    pictures: np.ndarray  # (height, 2 width, 3)


def measure(scene: SceneDescription, samples: int) -> Result:
    """Render a scene both ways."""
    from steadylight.renderers.mitsuba.renderer import Renderer

    settings = RenderSettings(frames=(1,), width=SIZE[0], height=SIZE[1], spp=16, bounces=8)
    poses = {1: scene.camera.pose(0.0)}
    renderer = Renderer(scene, poses, settings)
    records = renderer.first_pass(1, [1]).records
    for audit_round in (1, 2):
        found = renderer.audit([1], renderer.load(records), last=audit_round == 2)
        records = renderer.fill([tuple(found.points)], records, audit_round)
    records = smooth(records, smoothing=renderer.view.quality.smoothing)
    frame = renderer.shade(1, renderer.load(records))
    paths = [
        Renderer(scene, poses, settings.model_copy(update={"bounces": 12, "spp": samples // 2, "seed": seed}))
        .path(1)
        .image
        for seed in (1, 2)
    ]
    path = (paths[0] + paths[1]) / 2
    shown = seen(renderer)
    thing, noise = None, float("nan")
    if shown.sum() >= 30:
        thing = frame.image[shown].mean(axis=0) / path[shown].mean(axis=0) - 1
        noise = float(np.abs(paths[0][shown].mean() - paths[1][shown].mean()) / 2 / path[shown].mean())
    return Result(
        frame.image.mean(axis=(0, 1)) / path.mean(axis=(0, 1)) - 1,
        thing,
        noise,
        float(frame.image.min()),
        bool(np.isfinite(frame.image).all()),
        frame.missed,
        np.concatenate([frame.image, path], axis=1),
    )


def seen(renderer: Any) -> np.ndarray:
    """(height, width) pixels in whose middle the thing is seen."""
    import mitsuba as mi

    width, height = SIZE
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1).astype(np.float32)
    position = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    ray, _ = renderer.view.camera.sensor.sample_ray(0.0, 0.5, position, 0.5)
    si = renderer.view.scene.ray_intersect(ray)
    things = [shape for shape in renderer.view.scene.shapes() if shape.id() == "thing"]
    shown = np.zeros(width * height, bool)
    for thing in things:
        shown |= np.array((si.shape == mi.ShapePtr(thing)) | (si.instance == mi.ShapePtr(thing)))
    return shown.reshape(height, width)


def refused(scene: SceneDescription) -> str | None:
    """Why a scene is refused, before it is built; None if it is not."""
    parts: Mapping[str, Any] = {**scene.content, "sensor": scene.sensor, "film": scene.film}
    return next(refusals(parts), None)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="plugins; all if none")
    parser.add_argument("--pictures", type=Path, help="folder for a PNG of each: two passes, path")
    parser.add_argument("--samples", type=int, default=512, help="of path, per pixel")
    options = parser.parse_args()
    use_variant(resolve_variant("auto"))
    faults = []
    tested = set()
    print("| Kind | Plugin | Picture, % | Thing, % | Noise, % | Darkest | Missed |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for kind, name, scene in entries(Path(folder)):
            tested |= {part.split(":")[0] for part in name.split(", ")}
            if options.names and name.split(":")[0] not in options.names and name not in options.names:
                continue
            reason = refused(scene)
            if reason is not None:
                print(f"| {kind} | {name} | refused: {reason.split(': ', 1)[-1]} | | | | |", flush=True)
                continue
            try:
                result = measure(scene, options.samples)
            except SceneError as error:
                print(f"| {kind} | {name} | FAILS: {error} | | | | |", flush=True)
                faults.append(name)
                continue
            whole, thing = (
                "-" if part is None else " ".join(f"{100 * value:+.2f}" for value in part)
                for part in (result.whole, result.thing)
            )
            noise = "-" if result.thing is None else f"{100 * result.noise:.2f}"
            print(
                f"| {kind} | {name} | {whole} | {thing} | {noise} | {result.darkest:.2g} | {result.missed} |",
                flush=True,
            )
            off = np.abs(result.whole).max() > TOLERANCE.get(name.split(":")[0], 0.01)
            negative = result.darkest < 0 and name not in NEGATIVE_LOBES
            if off or negative or not result.finite or result.missed:
                faults.append(name)
            if options.pictures:
                options.pictures.mkdir(parents=True, exist_ok=True)
                exposure = float(0.35 / np.median(result.pictures))
                file = options.pictures / f"{kind}-{name.replace(': ', '-').replace(' ', '')}.png"
                write_png(file, tone_map(result.pictures, exposure))
    if not options.names:
        rows = {
            row.name
            for row in PLUGINS
            if row.kind in ("BSDF", "emitter", "shape", "texture", "sensor", "filter")
        }
        print("not tested:", ", ".join(sorted(rows - tested)) or "nothing")
    print("outside the bounds:", ", ".join(faults) or "none")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
