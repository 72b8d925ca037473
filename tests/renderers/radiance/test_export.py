"""What the exporter says of shapes, materials and lights, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.errors import SceneError
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.renderers.radiance.export import RadianceScene, Writer, export, split_sky
from steadylight.scenes import load_scene
from steadylight.scenes.radiance.programs import output_of

TRIANGLE = {
    "type": "triangles",
    "vertices": np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], np.float32),
    "faces": np.array([[0, 1, 2]], np.uint32),
}
GREY = {
    "type": "twosided",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
}
PICTURE = {
    "type": "diffuse",
    "reflectance": {"type": "bitmap", "data": np.full((2, 2, 3), 0.5, np.float32), "raw": True},
}


@pytest.fixture(scope="module", autouse=True)
def _variant():
    use_variant(resolve_variant("llvm"))


@pytest.fixture
def written(tmp_path):
    """Writes entries of a scene."""

    def write(**content):
        writer = Writer(load_scene("furnace"), tmp_path, RadianceScene(tmp_path / "scene.oct"))
        for name, entry in content.items():
            writer.add(name, entry)
        return writer

    return write


def figures(text):
    return [float(word) for word in text.split("\n")[3].split()[1:]]


def test_a_plain_triangle_becomes_a_polygon(written):
    writer = written(wall=TRIANGLE | {"bsdf": GREY})
    assert writer.materials == ["void plastic wall\n0 \n0\n5 0.2 0.4 0.6 0 0\n"]
    assert writer.objects == ["wall polygon wall.0\n0 \n0\n9 0 0 0 1 0 0 0 2 0\n"]
    assert writer.mesh == []


def test_smooth_and_textured_triangles_share_a_mesh(written):
    smooth = TRIANGLE | {"bsdf": GREY, "normals": np.tile(np.float32([0, 0, 1]), (3, 1))}
    textured = TRIANGLE | {"bsdf": PICTURE, "uv": np.zeros((3, 2), np.float32)}
    writer = written(smooth=smooth, textured=textured)
    faces = [line for line in writer.mesh if line.startswith(("usemtl", "f "))]
    assert faces == ["usemtl smooth", "f 1//1 2//2 3//3", "usemtl textured", "f 4/1 5/2 6/3"]


def test_shapes_of_mitsuba_become_polygons_spheres_and_rings(written):
    double = np.diag([2.0, 2.0, 2.0, 1.0])
    writer = written(
        floor={"type": "rectangle", "to_world": double},
        ball={"type": "sphere", "center": [1.0, 0.0, 0.0], "radius": 0.5, "to_world": double},
        coin={"type": "disk", "to_world": double},
        box={"type": "cube", "to_world": double},
    )
    kinds = [text.split()[1] for text in writer.objects]
    # The cube is smooth to Mitsuba: it has normals, so it is in the mesh.
    assert kinds == ["polygon", "polygon", "sphere", "ring"]
    assert figures(writer.objects[0]) == [-2, -2, 0, 2, -2, 0, 2, 2, 0]
    assert figures(writer.objects[2]) == [2, 0, 0, 1]
    assert figures(writer.objects[3]) == [0, 0, 0, 0, 0, 1, 0, 2]
    assert sum(line.startswith("f ") for line in writer.mesh) == 12


TINT = {"type": "rgb", "value": [0.9, 0.5, 1.0]}


@pytest.mark.parametrize(
    ("bsdf", "kind", "check"),
    [
        ({"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, "dielectric", [1, 1, 1, 1.5, 0]),
        ({"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}, "glass", [1, 1, 1, 1.5]),
        (
            {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0, "specular_transmittance": TINT},
            "glass",
            [0.9, 0.5, 1, 1.5],
        ),
        ({"type": "glasspane", "transmissivity": TINT, "ior": 1.6}, "glass", [0.9, 0.5, 1, 1.6]),
        ({"type": "conductor", "material": "none"}, "metal", [1, 1, 1, 1, 0]),
    ],
)
def test_glass_and_mirrors_keep_their_numbers(written, bsdf, kind, check):
    (text,) = written(thing=TRIANGLE | {"bsdf": bsdf}).materials
    assert text.startswith(f"void {kind} thing\n")
    assert figures(text) == pytest.approx(check, abs=1e-5)


def test_plastic_sends_back_what_it_does_at_45_degrees(written):
    (text,) = written(thing=TRIANGLE | {"bsdf": {"type": "plastic", "diffuse_reflectance": 0.5}}).materials
    *colour, gloss, roughness = figures(text)
    assert roughness == 0
    assert gloss == pytest.approx(0.05, abs=0.005)  # Fresnel at 45 degrees, index 1.49
    assert colour == pytest.approx([colour[0]] * 3)
    assert 0.35 < colour[0] < 0.55


def test_an_emitter_that_reflects_gives_its_radiance_through_a_sheet(written):
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 4.0, 8.0]}}
    writer = written(lamp=TRIANGLE | {"bsdf": white, "emitter": emitter})
    sheet, light, front, behind = (text.split() for text in writer.objects)
    through = float(sheet[-2])
    assert through == pytest.approx(0.4)  # the rest, 0.6, is reflected
    assert [float(word) * through for word in light[-3:]] == pytest.approx([2.0, 4.0, 8.0])
    assert (front[0], behind[0]) == ("lamp.sheet", "lamp")
    # The polygon's normal is +z: behind is below.
    assert all(-1e-3 < float(z) < 0 for z in behind[-7::3])


def test_lamps_without_size_keep_their_intensity(written):
    intensity = {"type": "rgb", "value": [1.0, 2.0, 3.0]}
    writer = written(lamp={"type": "point", "position": [1.0, 2.0, 3.0], "intensity": intensity})
    light, bulb = writer.objects
    *_, radius = figures(bulb)
    np.testing.assert_allclose(np.array(figures(light)) * np.pi * radius**2, [1, 2, 3], rtol=1e-6)


def test_a_plate_under_a_constant_sky_shows_what_it_reflects(tmp_path):
    scene = load_scene("furnace")
    plate = {"type": "rectangle", "bsdf": GREY}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}
    exported = export(type(scene)("plate", {"plate": plate, "sky": sky}, scene.camera), tmp_path)
    assert exported.sky
    ray = b"0 0 1 0 0 -1\n"
    options = ["-h", "-u-", "-ab", "1", "-ad", "256", "-aa", ".1", "-av", "0", "0", "0"]
    seen = output_of(tmp_path, "rtrace", *options, "scene.oct", given=ray)
    np.testing.assert_allclose([float(word) for word in seen.split()], [0.2, 0.8, 1.8], rtol=0.02)


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        (TRIANGLE | {"bsdf": {"type": "principled"}}, "thing: material `principled`"),
        (TRIANGLE | {"bsdf": {"type": "roughconductor", "alpha_u": 0.1}}, "thing: property `alpha_u`"),
        (
            TRIANGLE | {"bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
            "thing: texture `checkerboard`",
        ),
        ({"type": "homogeneous"}, "thing: `homogeneous`"),
        (
            {"type": "sphere", "to_world": np.diag([1.0, 2.0, 1.0, 1.0])},
            "thing: a sphere or disk with a non-uniform scale",
        ),
        (TRIANGLE | {"emitter": {"type": "directionalarea"}}, "thing: emitter `directionalarea`"),
    ],
)
def test_what_radiance_cannot_say_is_refused_by_name(written, entry, complaint):
    with pytest.raises(SceneError, match=complaint):
        written(thing=entry)


def test_a_scene_without_light_is_refused(tmp_path):
    scene = load_scene("furnace")
    with pytest.raises(SceneError, match="has no emitter"):
        export(type(scene)("dark", {"plate": {"type": "rectangle"}}, scene.camera), tmp_path)


def test_a_scene_without_a_sky_is_not_split():
    scene = load_scene("furnace")
    assert split_sky(scene) == [(scene, False)]
