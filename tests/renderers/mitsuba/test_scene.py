"""Descriptions become Mitsuba scenes that look right, and sensors that move without a new kernel."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError
from steadylight.images import write_exr
from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.renderers.mitsuba.scene import build_scene, build_sensor, check_scene, release, set_pose
from steadylight.scenes.description import SceneDescription

CAMERA = CameraPath(
    (Keyframe(0, (0, -5, 3), (0, 0, 0.5), fov=50), Keyframe(2, (2, -5, 3), (0, 0, 0.5), fov=40))
)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
FLOOR = np.diag([3.0, 3.0, 3.0, 1.0])
LAMP = np.diag([0.5, -0.5, -0.5, 1.0])  # faces down, 1.5 m up
LAMP[2, 3] = 1.5
LIGHT = {"type": "area", "radiance": {"type": "rgb", "value": [5.0, 4.0, 3.0]}}
IMAGE = np.random.default_rng(3).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
PAINT = {
    "type": "twosided",
    "bsdf": {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "data": IMAGE, "raw": True, "filter_type": "bilinear"},
    },
}


@pytest.fixture(autouse=True)
def _backend():
    variant = resolve_variant("llvm")
    import mitsuba as mi

    mi.set_variant(variant)


def described(content: dict[str, Any], **more: Any) -> SceneDescription:
    return SceneDescription("test", content, CAMERA, **more)


def test_checks_and_frames_of_a_process_share_the_scene_that_was_built_last() -> None:
    dim, lit = (described({"lamp": {"type": "point", "intensity": each}}) for each in (1.0, 2.0))
    first = build_scene(dim)
    assert build_scene(dim) is first
    other = build_scene(lit)
    assert other is not first
    assert build_scene(dim) is not first
    kept = build_scene(dim)
    release()
    assert build_scene(dim) is not kept


def square(matrix: np.ndarray) -> np.ndarray:
    return (SQUARE @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def with_triangles() -> dict[str, Any]:
    uv = (SQUARE[:, :2] + 1) / 2
    ref = {"type": "ref", "id": "paint"}
    return {
        "paint": PAINT,
        "floor": {"type": "triangles", "vertices": square(FLOOR), "faces": FACES, "uv": uv, "bsdf": ref},
        "lamp": {"type": "triangles", "vertices": square(LAMP), "faces": FACES, "emitter": LIGHT},
    }


def with_rectangles() -> dict[str, Any]:
    return {
        "paint": PAINT,
        "floor": {"type": "rectangle", "to_world": FLOOR, "bsdf": {"type": "ref", "id": "paint"}},
        "lamp": {"type": "rectangle", "to_world": LAMP, "emitter": LIGHT},
    }


def render(description: SceneDescription, spp: int = 64, integrator: str = "path") -> np.ndarray:
    import mitsuba as mi

    scene = build_scene(description, {"type": integrator})
    sensor = build_sensor(description, CAMERA.pose(0), 32, 24)
    return np.array(mi.render(scene, sensor=sensor, spp=spp, seed=1))


def test_meshes_in_memory_look_as_the_same_shapes_of_mitsuba_do():
    meshes, shapes = render(described(with_triangles()), 256), render(described(with_rectangles()), 256)
    assert meshes.shape == (24, 32, 3)
    # Both are unbiased, but sample the lamp differently: 2 % is four times the noise of the mean.
    np.testing.assert_allclose(meshes.mean((0, 1)), shapes.mean((0, 1)), rtol=0.02)
    assert np.abs(meshes - shapes).mean() < 0.03 * shapes.mean()


def test_normals_are_used_where_given_and_faces_are_flat_where_not():
    import mitsuba as mi

    tilted = np.tile(np.float32([0.6, 0, 0.8]), (4, 1))
    flat = {"type": "triangles", "vertices": SQUARE, "faces": FACES}
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 1), mi.Vector3f(0, 0, -1))
    for entry, normal in ((flat, [0, 0, 1]), ({**flat, "normals": tilted}, [0.6, 0, 0.8])):
        hit = build_scene(described({"mesh": entry})).ray_intersect(ray)
        np.testing.assert_allclose(np.ravel(hit.sh_frame.n), normal, atol=1e-6)
        np.testing.assert_allclose(np.ravel(hit.n), [0, 0, 1], atol=1e-6)


def test_a_material_that_is_referred_to_is_one_object():
    content = with_triangles()
    content["second"] = with_rectangles()["floor"]
    scene = build_scene(described(content))
    assert len(scene.shapes()) == 3
    assert scene.shapes()[0].bsdf() is scene.shapes()[2].bsdf()
    assert len(scene.emitters()) == 1


def test_shapes_and_emitters_keep_the_order_of_the_description():
    lamps = {}
    for i in range(12):
        matrix = LAMP.copy()
        matrix[0, 3] = i
        ref = {"type": "ref", "id": "paint"}
        lamps[f"lamp{i}"] = {"type": "rectangle", "to_world": matrix, "bsdf": ref, "emitter": LIGHT}
    scene = build_scene(described({"paint": PAINT, **lamps}))
    assert [float(np.ravel(shape.bbox().center())[0]) for shape in scene.shapes()] == list(range(12))
    assert [emitter.get_shape().id() for emitter in scene.emitters()] == list(lamps)


def test_instances_share_a_group():
    group = {"type": "shapegroup", "sphere": {"type": "sphere"}}
    step = np.eye(4)
    step[0, 3] = 5.0
    content = {
        "group": group,
        "a": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        "b": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": step},
        "sky": {"type": "envmap", "data": np.ones((4, 8, 3), dtype=np.float32)},
    }
    box = build_scene(described(content)).bbox()
    np.testing.assert_allclose(np.ravel(box.max), [6, 1, 1], atol=1e-5)
    check_scene(described(content))


def point(value: float) -> dict[str, Any]:
    return {"type": "point", "position": [0, 0, 3], "intensity": {"type": "rgb", "value": [value] * 3}}


def test_one_emitter_may_be_dark_if_another_is_not():
    check_scene(described({"a": {"type": "sphere"}, "off": point(0), "on": point(1)}))


def test_an_environment_image_gives_its_radiance():
    content = {
        "sky": {"type": "envmap", "data": np.full((4, 8, 3), 0.7, dtype=np.float32)},
        "far": {"type": "sphere", "center": [0, 0, -100], "radius": np.float64(1)},
    }
    np.testing.assert_allclose(render(described(content), 4), 0.7, rtol=1e-4)


ONE_THREAD = """
import sys
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

use_variant(resolve_variant("auto"), threads=1)
import drjit as dr

from steadylight.camera import CameraPath, Keyframe
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes.description import SceneDescription

content = {"sky": {"type": "envmap", "filename": sys.argv[1]}, "far": {"type": "sphere"}}
camera = CameraPath((Keyframe(0, (0, -5, 3), (0, 0, 0.5)),))
print(build_scene(SceneDescription("sky", content, camera)).environment().class_name(), dr.thread_count())
"""


def test_a_worker_with_a_single_thread_reads_openexr_images(tmp_path):
    """Mitsuba by itself would wait for ever: it decodes them on threads that Dr.Jit does not have."""
    image = tmp_path / "sky.exr"
    write_exr(image, np.full((64, 128, 3), 0.7, np.float32))
    done = subprocess.run(
        [sys.executable, "-c", ONE_THREAD, str(image)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert done.stdout.split() == ["EnvironmentMapEmitter", "1"]


SENSORS = [
    {"type": "perspective", "near_clip": 0.05},
    {"type": "perspective", "scale": [-1, 1, 1]},
    {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 5.0},
    {"type": "orthographic", "scale": [3.1, 3.1, 1]},
]
NAMES = ["perspective", "mirrored", "thinlens", "orthographic"]


@pytest.mark.parametrize("kind", SENSORS, ids=NAMES)
def test_moving_a_sensor_compiles_no_new_kernel_and_equals_a_fresh_one(kind):
    import drjit as dr
    import mitsuba as mi

    description = described(with_triangles(), sensor=kind)
    scene = build_scene(description, {"type": "direct"})
    sensor = build_sensor(description, CAMERA.pose(0), 16, 12)
    mi.render(scene, sensor=sensor, spp=4, seed=0)  # also makes what the scene needs once
    kernels, images = [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for time in (0.0, 1.0, 2.0, 0.0):
            set_pose(sensor, CAMERA.pose(time))
            dr.kernel_history_clear()
            images.append(np.array(mi.render(scene, sensor=sensor, spp=4, seed=0)))
            kernels.append(
                [(each["hash"], each["cache_hit"]) for each in dr.kernel_history([dr.KernelType.JIT])]
            )
    # What the process compiled before may be evaluated here too: a kernel is new if it was compiled for the pose.
    assert kernels[0], "no kernel ran"
    assert all(hit for found in kernels[1:] for _, hit in found), kernels
    assert set.intersection(*(set(found) for found in kernels[1:])), kernels
    assert np.abs(images[0] - images[1]).max() > 0
    fresh = build_sensor(description, CAMERA.pose(0.0), 16, 12)
    matrices = [np.array(mi.traverse(each)["to_world"].matrix) for each in (sensor, fresh)]
    np.testing.assert_array_equal(*matrices)  # no pose depends on the ones before
    # Threads add up the samples of Mitsuba's film in any order: the last digits differ.
    np.testing.assert_allclose(images[0], images[3], rtol=1e-4, atol=1e-7)
    moved = np.array(mi.render(scene, sensor=fresh, spp=4, seed=0))
    np.testing.assert_allclose(images[0], moved, rtol=1e-4, atol=1e-7)


def test_the_field_of_view_is_horizontal():
    import mitsuba as mi

    sensor = build_sensor(described({}), CAMERA.pose(0), 40, 20)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.0, 0.5), mi.Point2f(0.5))
    cosine = np.ravel(ray.d) @ CAMERA.pose(0).direction
    assert np.degrees(np.arccos(cosine)) == pytest.approx(25, abs=1e-2)


def test_a_mirrored_sensor_sees_the_picture_the_other_way_round():
    import mitsuba as mi

    pose = CAMERA.pose(1.0)
    centre = mi.Point2f(0.1, 0.5)
    rays = []
    for sensor in SENSORS[:2]:
        made = build_sensor(described({}, sensor=sensor), pose, 16, 12)
        at = centre if "scale" not in sensor else mi.Point2f(0.9, 0.5)
        rays.append(np.ravel(made.sample_ray(0.0, 0.5, at, mi.Point2f(0.5))[0].d))
    np.testing.assert_allclose(rays[0], rays[1], atol=1e-5)


def test_the_film_is_linear_rgb_with_the_filter_of_the_scene():
    description = described({}, film={"type": "tent", "radius": 1.5})
    film = build_sensor(description, CAMERA.pose(0), 20, 10).film()
    assert [int(n) for n in film.size()] == [20, 10]
    assert film.rfilter().radius() == 1.5
    other = build_sensor(description, CAMERA.pose(0), 20, 10, {"type": "box"}).film()
    assert other.rfilter().is_box_filter()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"a": {"type": "spher"}}, "`a`: Mitsuba has no plugin `spher`; did you mean `sphere`"),
        ({"a": {"type": "sphere", "x": 1}}, '`a`: `sphere` does not have the property integer "x"'),
        ({"a": {"type": "sphere"}}, "no emitter"),
        (
            {"a": {"type": "sphere"}, "b": point(-1)},
            "emitter of `b`: intensity.value has the value -1; light must be",
        ),
        (
            {"a": {"type": "sphere"}, "b": point(float("nan"))},
            "emitter of `b`: intensity.value has the value nan",
        ),
        ({"a": {"type": "sphere"}, "b": point(0)}, "all emitters have the value 0"),
        (
            {
                "panel": {
                    "type": "disk",
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, -2, 1]}},
                }
            },
            "emitter of `panel`: radiance.value has the value -2",
        ),
        (
            {"a": {"type": "disk", "bsdf": {"type": "twosided", "b": {"type": "polarizer"}}}},
            "`a.bsdf.b`: BSDF `polarizer` is not supported: .*use null",
        ),
        ({"a": {"type": "constant"}}, "no shapes"),
        ({"a": {"type": "sphere", "bsdf": {"type": "ref", "id": "b"}}}, "reference to `b`"),
        ({"a": {"type": "ply", "filename": "/nowhere/m.ply"}}, "`a`: `ply`: .*m.ply"),
        (
            {"a": {"type": "triangles", "vertices": SQUARE[:2], "faces": FACES}},
            "`a`: a face refers to vertex 3, but there are only 2",
        ),
        (
            {"a": {"type": "triangles", "vertices": SQUARE * np.nan, "faces": FACES}},
            "`a`: vertices must be fin",
        ),
        ({"a": {"type": "triangles", "vertices": SQUARE, "faces": FACES[:0]}}, "`a`: faces must be"),
        ({"a": {"type": "triangles", "vertices": SQUARE, "faces": FACES, "uv": SQUARE}}, "`a`: uv must be"),
        (
            {"a": {"type": "triangles", "vertices": SQUARE, "faces": FACES, "colour": 1}},
            "`a`: triangles have no",
        ),
        (
            {"a": {"type": "triangles", "vertices": SQUARE, "faces": FACES, "bsdf": {"type": "diffus"}}},
            "`a`: .*did you mean `diffuse`",
        ),
    ],
)
def test_a_wrong_description_is_refused_by_entry_and_fault(content, words):
    with pytest.raises(SceneError, match="scene test: .*" + words):
        check_scene(described(content))


def test_a_sensor_that_makes_no_film_is_refused():
    with pytest.raises(SceneError, match=r"sensor `radiancemeter` is not supported: .*use perspective"):
        build_sensor(described({}, sensor={"type": "radiancemeter"}), CAMERA.pose(0), 8, 8)
    with pytest.raises(SceneError, match=r"sensor: .*does not have the property"):
        build_sensor(described({}, sensor={"type": "perspective", "x": 1}), CAMERA.pose(0), 8, 8)


def test_building_does_not_change_the_description():
    description = described(with_triangles())
    before = description.hash
    build_scene(description)
    assert dataclasses.replace(description).hash == before
