"""The meshes of one material are one shape, and rays meet what they would meet without that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers import geometry_of
from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes.description import SceneDescription

VIEW = CameraPath((Keyframe(0, (0, -5, 3), (0, 0, 0.5)),))
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.1, 0.1]}}
CHECKED = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
PAINT = {"type": "ref", "id": "paint"}
LIGHT = {"type": "area", "radiance": {"type": "rgb", "value": [5.0, 4.0, 3.0]}}
LAMP = {"type": "point", "position": [0.0, 0.0, 9.0], "intensity": 1.0}


@pytest.fixture(autouse=True)
def _backend():
    variant = resolve_variant("llvm")
    import mitsuba as mi

    mi.set_variant(variant)


def described(**content: Any) -> SceneDescription:
    return SceneDescription("test", {"paint": RED, "lamp": LAMP, **content}, VIEW)


def placed(x: float, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[0, 3] = x
    return matrix


def cube(x: float, **more: Any) -> dict[str, Any]:
    return {"type": "cube", "to_world": placed(x), "bsdf": PAINT, **more}


def names(scene) -> list[str]:
    return [shape.id() for shape in scene.shapes()]


def furniture() -> dict[str, Any]:
    """Meshes with and without normals and texture coordinates, of two materials, and a sphere."""
    tilted = np.tile(np.float32([0.6, 0, 0.8]), (4, 1))
    sheet = {"type": "triangles", "vertices": SQUARE + np.float32([0, 0, 2]), "faces": FACES, "bsdf": PAINT}
    checked = {"type": "ref", "id": "checked"}
    return {
        "checked": CHECKED,
        "one": cube(0),
        "two": cube(3, bsdf=checked),
        "three": cube(6),
        "four": cube(9, bsdf=checked, face_normals=True),
        "five": cube(12, bsdf=checked),
        "sheet": sheet,
        "tilted": {**sheet, "vertices": SQUARE + np.float32([3, 0, 2]), "normals": tilted},
        "ball": {"type": "sphere", "to_world": placed(15), "bsdf": PAINT},
        "flat": {**sheet, "vertices": SQUARE + np.float32([6, 0, 2])},
    }


def test_meshes_of_one_material_and_form_are_one_shape_where_the_first_was() -> None:
    scene = build_scene(described(**furniture()))
    assert names(scene) == ["one", "two", "four", "sheet", "tilted", "ball"]
    assert [shape.face_count() for shape in scene.shapes() if shape.is_mesh()] == [24, 24, 12, 4, 2]


def test_rays_meet_what_they_meet_without_it() -> None:
    import mitsuba as mi

    description = described(**furniture())
    merged = build_scene(description)
    paint, checked = mi.load_dict(RED), mi.load_dict(CHECKED)
    separate = {"type": "scene"}
    for name, entry in furniture().items():
        if name == "checked":
            continue
        bsdf = paint if entry["bsdf"] == PAINT else checked
        if entry["type"] == "triangles":
            only = {key: value for key, value in entry.items() if key != "bsdf"}
            mesh = build_scene(described(mesh={**only, "bsdf": RED})).shapes()[0]
            mesh.set_bsdf(bsdf)
            separate[name] = mesh
        else:
            separate[name] = {**entry, "bsdf": bsdf, "to_world": mi.ScalarTransform4d(entry["to_world"])}
    apart = mi.load_dict(separate, parallel=False, optimize=False)
    assert len(apart.shapes()) == 9
    rng = np.random.default_rng(1)
    origin = rng.uniform([-2, -4, -3], [17, 4, 4], (4000, 3))
    towards = rng.uniform([-1, -1, -1], [16, 1, 2], (4000, 3)) - origin
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(np.float32(origin.T)), mi.Vector3f(np.float32(towards.T)))
    found, wanted = (scene.ray_intersect(ray) for scene in (merged, apart))
    valid = np.array(wanted.is_valid())
    assert valid.mean() > 0.5
    np.testing.assert_array_equal(np.array(found.is_valid()), valid)
    for part in ("t", "p", "n", "uv", "dp_du"):
        np.testing.assert_array_equal(np.array(getattr(found, part)), np.array(getattr(wanted, part)), part)
    np.testing.assert_array_equal(np.array(found.sh_frame.n), np.array(wanted.sh_frame.n))
    colours = [np.array(si.bsdf().eval_diffuse_reflectance(si, si.is_valid())) for si in (found, wanted)]
    np.testing.assert_array_equal(*colours)
    assert len(np.unique(colours[0].T, axis=0)) == 4  # red, two of the board, none


def test_lamps_coloured_and_turned_meshes_stay_alone() -> None:
    coloured = {
        "type": "triangles",
        "vertices": SQUARE,
        "faces": FACES,
        "colors": np.full((4, 3), 0.5, np.float32),
        "bsdf": PAINT,
    }
    content = {
        "one": cube(0),
        "lit": cube(3, emitter=LIGHT),
        "turned": cube(6, flip_normals=True),
        "coloured": coloured,
        "coloured_too": coloured,
        "two": cube(9),
    }
    scene = build_scene(described(**content))
    assert names(scene) == ["one", "lit", "turned", "coloured", "coloured_too"]


def test_meshes_in_files_are_merged_and_their_parts_keep_their_names(tmp_path: Path) -> None:
    import mitsuba as mi

    for x in (0, 3, 6):
        mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4d(placed(x, 0.5))}).write_ply(
            str(tmp_path / f"{x}.ply")
        )
    files = {
        f"box_{x}": {"type": "ply", "filename": str(tmp_path / f"{x}.ply"), "bsdf": PAINT} for x in (0, 6)
    }
    own = {"type": "ply", "filename": str(tmp_path / "3.ply"), "bsdf": RED}
    description = described(box_0=files["box_0"], box_3=own, box_6=files["box_6"])
    assert names(build_scene(description)) == ["box_0", "box_3"]
    geometry = geometry_of(description, "mitsuba", "llvm")
    above = np.array([[6.2, 0.1, 5], [0.1, 0.2, 5], [3.1, 0.2, 5], [9.0, 0, 5]])
    hits = geometry.cast(above, np.tile([0.0, 0.0, -1.0], (4, 1)))
    assert [geometry.shapes[shape] for shape in hits.shape[:3]] == ["box_6", "box_0", "box_3"]
    assert hits.shape[3] == -1
