"""Radiance's scenes for the Mitsuba renderer: surfaces, materials, lights, skies, views and commands."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from steadylight.errors import SceneError
from steadylight.scenes import load_scene
from steadylight.scenes.radiance import instances, patterns, sources
from steadylight.scenes.radiance.grammar import Primitive, primitives_of
from steadylight.scenes.radiance.materials import material_of
from steadylight.scenes.radiance.modifiers import renamed, surfaces_of
from steadylight.scenes.radiance.programs import output_of
from steadylight.scenes.radiance.surfaces import triangles_of

needs_radiance = pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")

GREY = "void plastic grey 0 0 5 .5 .5 .5 0 0\n"
LIGHT = "void light bright 0 0 3 10 20 30\nbright polygon panel 0 0 9 0 0 3 1 0 3 0 1 3\n"
PLATE = GREY + "grey polygon plate 0 0 9 0 0 0 4 0 0 0 4 0\n"


@pytest.fixture
def scene_of(tmp_path):
    """Reads a text as a scene."""

    def read(text, name="scene.rad", **options):
        (tmp_path / name).write_text(text)
        return load_scene(tmp_path / name, **options)

    return read


def surface(kind, *numbers):
    return triangles_of(Primitive("void", kind, "it", (), tuple(map(float, numbers)), "x.rad: line 1"))


def normal_volume(triangles):
    """Enclosed volume, positive if the triangles face outward."""
    a, b, c = (triangles.vertices[triangles.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_polygons_keep_area_and_front_with_corners_that_point_inward_and_holes():
    arrow = surface("polygon", 0, 0, 0, 4, 0, 0, 1, 1, 0, 0, 4, 0)
    assert arrow.area == pytest.approx(4)
    hole = (0, 0, 0, 4, 0, 0, 4, 4, 0, 0, 4, 0, 0, 0, 0, 1, 1, 0, 1, 3, 0, 3, 3, 0, 3, 1, 0, 1, 1, 0)
    framed = surface("polygon", *hole)
    assert framed.area == pytest.approx(12)
    a, b, c = (framed.vertices[framed.faces[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("kind", "numbers", "area", "volume"),
    [
        ("sphere", (0, 0, 0, 2), 16 * np.pi, 32 / 3 * np.pi),
        ("bubble", (0, 0, 0, 2), 16 * np.pi, -32 / 3 * np.pi),
        ("cylinder", (0, 0, -1, 0, 0, 1, 2), 8 * np.pi, 16 / 3 * np.pi),
        ("tube", (0, 0, -1, 0, 0, 1, 2), 8 * np.pi, -16 / 3 * np.pi),
        ("cone", (0, 0, 0, 0, 0, 3, 4, 0), 20 * np.pi, 16 * np.pi),
        ("cup", (0, 0, 0, 0, 0, 3, 4, 0), 20 * np.pi, -16 * np.pi),
        ("ring", (0, 0, 1, 0, 0, 1, 1, 2), 3 * np.pi, np.pi),
    ],
)
def test_curved_surfaces_have_their_area_and_face_their_way(kind, numbers, area, volume):
    triangles = surface(kind, *numbers)
    assert triangles.area == pytest.approx(area, rel=0.005)
    assert normal_volume(triangles) == pytest.approx(volume, rel=0.01)
    if triangles.normals is not None:
        assert (np.sign((triangles.normals * triangles.vertices).sum(axis=1)) == np.sign(volume))[:-64].all()


def test_a_material_is_one_mesh_and_lamps_stay_apart(scene_of):
    scene = scene_of(PLATE + "grey polygon b 0 0 12 0 0 1 1 0 1 1 1 1 0 1 1\n" + LIGHT)
    assert len(scene.content["grey_surfaces"]["faces"]) == 3
    assert scene.content["panel"]["emitter"]["radiance"]["value"] == [10, 20, 30]
    assert scene.format == "mitsuba"
    assert np.array_equal(scene.content["panel"]["vertices"][:, 2], [3, 3, 3])


def test_aliases_and_later_definitions_of_a_name_count_from_there_on(scene_of):
    red = "void plastic grey 0 0 5 .9 .1 .1 0 0\nvoid alias paint grey\npaint sphere ball 0 0 4 0 0 2 1\n"
    scene = scene_of(PLATE + red + LIGHT)
    colours = [
        entry["bsdf"]["reflectance"]["value"]
        for entry in scene.content.values()
        if entry["type"] == "twosided"
    ]
    assert [0.5, 0.5, 0.5] in colours
    assert [0.9, 0.1, 0.1] in colours


def bsdf_of(kind, *numbers):
    notes = []
    given = Primitive("void", kind, "it", (), tuple(map(float, numbers)), "x.rad: line 1")
    return material_of(given, lambda *note: notes.append(note)).bsdf, notes


def test_specularity_becomes_the_refractive_index_of_a_layer_with_that_reflectance():
    bsdf, notes = bsdf_of("plastic", 0.4, 0.3, 0.2, 0.04, 0.1)
    layer = bsdf["bsdf"]
    assert layer["type"] == "roughplastic"
    assert layer["alpha"] == 0.1
    index = layer["int_ior"]
    assert ((index - 1) / (index + 1)) ** 2 == pytest.approx(0.04)
    assert notes[0][0] == "approximated"
    assert bsdf_of("plastic", 0.4, 0.3, 0.2, 0, 0)[0]["bsdf"]["type"] == "diffuse"
    assert bsdf_of("metal", 0.4, 0.3, 0.2, 1, 0.1)[0]["bsdf"]["type"] == "roughconductor"


def test_glass_keeps_its_transmissivity_and_index():
    bsdf = bsdf_of("glass", 0.9, 0.8, 0.7, 1.6)[0]
    assert bsdf == {
        "type": "glasspane",
        "transmissivity": {"type": "rgb", "value": [0.9, 0.8, 0.7]},
        "ior": 1.6,
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grey polygon x 0 0 9 0 0 0 1 0 0 0 1 0", "refers to `grey`, which is not defined"),
        (GREY + "grey polygon x 0 0 8 0 0 0 1 0 0 0 1", "has 8 numbers"),
        (GREY + "grey polygon x 0 0 9 0 0 0 1 0 0 0 nan 0", "'nan' stands where a number"),
        (GREY + "grey polygon x 0 0 nine", "'nine' stands where the number of its numbers"),
        (
            "void antimatter hole 1 void 0 0\nhole sphere x 0 0 4 0 0 0 1",
            "antimatter `hole` cannot be rendered",
        ),
        ("void mist fog 0 0 0\nfog sphere x 0 0 4 0 0 0 1", "media"),
        ("void plastik a 0 0 0", "`plastik` is not a Radiance type"),
        ("void plastic a 0 0 4 1 1 1 0\na sphere x 0 0 4 0 0 0 1", "has 4 numbers where 5 are expected"),
        ("!rm -rf x", "`rm` is not run"),
        ("!genbox a b 1 1 1 > out", "the shell operator `>`"),
        ("!genbox a b 1 1 1; ls", "the shell operator `;`"),
        ("!xform '!ls'", "nested commands"),
        ("!cat /etc/passwd", "outside"),
        ("!xform ../x.rad", "outside"),
        ("!cat scene.rad", "include itself"),
        ("!genbox 'a", "no closing quotation"),
    ],
)
def test_faults_are_told_with_file_and_line(scene_of, text, words):
    with pytest.raises(
        SceneError, match=r"scene\.rad: (line [12]|files and commands are nested more than)"
    ) as error:
        scene_of(text + "\n")
    assert words in str(error.value)


@needs_radiance
def test_commands_are_run_in_pipelines_and_within_files(scene_of, tmp_path):
    (tmp_path / "box.rad").write_text("!genbox grey box 1 2 3\n")
    scene = scene_of(GREY + "!xform -t 10 0 0 box.rad | xform -s 2\n" + LIGHT)
    vertices = scene.content["grey_surfaces"]["vertices"]
    assert vertices.min(axis=0).tolist() == [20, 0, 0]
    assert vertices.max(axis=0).tolist() == [22, 4, 6]


@needs_radiance
def test_a_sky_finds_its_data_beside_itself(scene_of, tmp_path):
    skies = tmp_path / "skies"
    skies.mkdir()
    (skies / "low.dat").write_text("1\n-1 1 2\n.25 .25\n")
    pattern = "void brightdata low 4 noop low.dat . Dz\n0\n0\n"
    (skies / "low.rad").write_text(f"{pattern}low glow dome 0 0 4 4 4 4 0\ndome source up 0 0 4 0 0 1 180\n")
    scene = scene_of(PLATE, sky=skies / "low.rad")
    assert scene.content["sky"]["data"][100] == pytest.approx(1.0, rel=1e-3)


@needs_radiance
def test_a_pattern_that_rests_on_a_thousand_others_is_read_like_any_other(scene_of):
    chain = "".join(f"p{i} brightfunc p{i + 1} 2 1 . 0 0\n" for i in range(1200))
    floor = "p1200 plastic floor 0 0 5 .5 .5 .5 0 0\nfloor polygon f 0 0 12 0 0 0 1 0 0 1 .002 0 0 .002 0\n"
    scene = scene_of(f"void brightfunc p0 2 .5 . 0 0\n{chain}{floor}")
    texels = scene.content["floor_material"]["bsdf"]["reflectance"]["data"]
    assert texels == pytest.approx(0.25, rel=1e-5)
    assert "p1200, p1199, p1198, p1197, p1196 and 1196 more" in scene.notes[0].text


def test_a_mixture_of_mixtures_names_each_once():
    mixtures = "".join(f"void mixfunc m{i} 4 m{i - 1} m{i - 1} .5 . 0 0\n" for i in range(1, 60))
    text = f"void brightfunc m0 2 .5 . 0 0\n{mixtures}m59 glow g 0 0 4 1 1 1 0\ng source s 0 0 4 0 0 1 180\n"
    (source,) = surfaces_of(primitives_of(text, "sky.rad"))
    lines, names = renamed(source.modifier.chain())
    assert len(lines) == len(names) == 61
    assert lines[1].words == ("m0", "m0", ".5", ".")


def test_an_even_sky_is_an_even_environment(scene_of):
    glow = "void glow light 0 0 4 1 2 3 0\nlight source sky 0 0 4 0 0 1 360\n"
    assert scene_of(PLATE + glow).content["sky"] == {
        "type": "constant",
        "radiance": {"type": "rgb", "value": [1, 2, 3]},
    }


def test_half_a_sky_is_a_picture_with_the_zenith_at_its_top(scene_of):
    glow = "void glow light 0 0 4 1 2 3 0\nlight source sky 0 0 4 0 0 1 180\n"
    picture = scene_of(PLATE + glow).content["sky"]["data"]
    assert (picture[:256] == [1, 2, 3]).all()
    assert not picture[256:].any()


def test_a_sun_shines_with_the_irradiance_of_its_disc(scene_of):
    scene = scene_of(PLATE + "void light solar 0 0 3 1e6 1e6 1e6\nsolar source sun 0 0 4 0 3 4 .5\n")
    sun = scene.content["sun"]
    assert sun["direction"] == pytest.approx([0, -0.6, -0.8])
    assert sun["irradiance"]["value"][0] == pytest.approx(1e6 * np.pi * np.radians(0.25) ** 2, rel=1e-5)


@needs_radiance
def test_a_clear_sky_is_seen_as_radiance_sees_it_with_its_sun(scene_of, tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "SIZE", (512, 256))
    (tmp_path / "sky.rad").write_text(
        "!gensky -ang 40 -30 +s\nskyfunc glow dome 0 0 4 1 1 1.2 0\ndome source up 0 0 4 0 0 1 180\n"
    )
    scene = scene_of(PLATE, sky=tmp_path / "sky.rad")
    picture = scene.content["sky"]["data"].astype(float)
    # Altitude 40 degrees, 30 degrees east of south: brightest there.
    row, column = np.unravel_index(picture[..., 0].argmax(), picture.shape[:2])
    assert (row + 0.5) / 256 * 180 == pytest.approx(50, abs=0.5)
    assert (column + 0.5) / 512 * 360 == pytest.approx(150, abs=0.5)
    assert picture[..., 2] == pytest.approx(1.2 * picture[..., 0], rel=1e-4)
    assert scene.content["sun"]["direction"][2] == pytest.approx(-np.sin(np.radians(40)), abs=1e-5)


def test_a_wide_sun_is_a_disc_in_the_sky_and_a_narrow_one_is_parallel_light(scene_of):
    sky = "void glow light 0 0 4 1 2 3 0\nlight source sky 0 0 4 0 0 1 360\n"
    sun = "void light bright 0 0 3 500 400 300\nbright source disc 0 0 4 1 0 1 4\n"
    content = scene_of(PLATE + sky + sun).content
    assert "sun" not in content
    picture = content["sky"]["data"]
    # Azimuth 90 degrees from north over east, altitude 45; the sky behind it is added.
    assert picture[128, 256] == pytest.approx([501, 402, 303], rel=0.05)
    assert picture[128, 270] == pytest.approx([1, 2, 3])
    assert "sun" in scene_of(PLATE + sky + sun.replace("1 4\n", "1 1\n")).content


def test_views_beside_a_scene_are_its_frames(scene_of, tmp_path):
    (tmp_path / "scene.vf").write_text(
        "rvu -vtv -vp 1 2 3 -vd 0 0 -1 -vu 0 1 0 -vh 90 -vv 45\nVIEW= -vp 1 2 4\nrvu -vp 1 2 5 -vd 0 1 -1\n"
    )
    scene = scene_of(PLATE + LIGHT)
    assert scene.frames == 3
    assert [key.origin for key in scene.camera.keyframes] == [(1, 2, 3), (1, 2, 4), (1, 2, 5)]
    assert scene.camera.frame_poses([2], scene.fps)[0].origin.tolist() == [1, 2, 4]
    (tmp_path / "scene.vf").write_text("rvu -vth -vp 1 2 3\n")
    with pytest.raises(SceneError, match=r"scene\.vf: line 1: `-vth`"):
        scene_of(PLATE + LIGHT)


def test_names_with_marks_and_old_encodings_are_read(scene_of, tmp_path):
    text = PLATE.replace("grey", '"grün 1.5"') + LIGHT
    assert "grün_1_5_surfaces" in scene_of(text).content
    (tmp_path / "büro 2.rad").write_bytes(text.encode("latin-1"))
    assert "grün_1_5_surfaces" in load_scene(tmp_path / "büro 2.rad").content


@needs_radiance
def test_octrees_frozen_or_not_are_read_and_instances_are_moved(scene_of, tmp_path):
    alias = "void alias paint grey\n" + PLATE.replace("grey polygon", "paint polygon") + LIGHT
    (tmp_path / "in.rad").write_text(GREY + alias)
    (tmp_path / "frozen.oct").write_bytes(output_of(tmp_path, "oconv", "-f", "in.rad"))
    (tmp_path / "named.oct").write_bytes(output_of(tmp_path, "oconv", "in.rad"))
    frozen, named = (load_scene(tmp_path / name) for name in ("frozen.oct", "named.oct"))
    text = load_scene(tmp_path / "in.rad")
    for name in ("grey_surfaces", "panel"):
        for scene in (frozen, named):
            assert scene.content[name]["vertices"] == pytest.approx(text.content[name]["vertices"])
    moved = scene_of("void instance it 5 frozen.oct -t 10 0 0\n0\n0\n")
    assert moved.content["grey_surfaces"]["vertices"].min(axis=0).tolist() == [10, 0, 0]
    (tmp_path / "frozen.oct").write_bytes((tmp_path / "frozen.oct").read_bytes()[:-30])
    with pytest.raises(SceneError, match=r"frozen\.oct: is not a complete octree"):
        load_scene(tmp_path / "frozen.oct")


@needs_radiance
def test_octrees_that_are_nested_too_deep_are_refused(scene_of, tmp_path, monkeypatch):
    (tmp_path / "in.rad").write_text(GREY + PLATE)
    (tmp_path / "inner.oct").write_bytes(output_of(tmp_path, "oconv", "in.rad"))
    (tmp_path / "around.rad").write_text("void instance inner 1 inner.oct\n0\n0\n")
    (tmp_path / "outer.oct").write_bytes(output_of(tmp_path, "oconv", "around.rad"))
    text = "void instance outer 1 outer.oct\n0\n0\n" + LIGHT
    monkeypatch.setattr(instances, "DEEPEST", 2)
    assert "grey_surfaces" in scene_of(text).content
    monkeypatch.setattr(instances, "DEEPEST", 1)
    with pytest.raises(SceneError, match=r"inner.*is nested in too many octrees"):
        scene_of(text)


@needs_radiance
def test_a_compiled_mesh_is_read_from_the_file_beside_it(scene_of, tmp_path):
    text = GREY + "grey mesh it 5 chair.rtm -rz 90 -s 2\n0\n0\n" + LIGHT
    with pytest.raises(SceneError, match=r"needs chair\.obj beside chair\.rtm"):
        scene_of(text)
    (tmp_path / "chair.obj").write_text("v 1 0 0\nv 2 0 0\nv 1 1 0\nf 1 2 3\n")
    vertices = scene_of(text).content["grey_surfaces"]["vertices"]
    assert vertices == pytest.approx(np.array([[0, 2, 0], [0, 4, 0], [-2, 2, 0]]), abs=1e-6)


@needs_radiance
def test_a_pattern_becomes_a_picture_on_a_polygon_and_a_mean_elsewhere(scene_of, tmp_path, monkeypatch):
    monkeypatch.setattr(patterns, "SIDE", 128)
    (tmp_path / "half.cal").write_text("dark = if(Px - 2, 1, .25);\n")
    text = "void brightfunc half 2 dark half.cal 0 0\nhalf plastic wall 0 0 5 .8 .4 .2 0 0\n"
    floor = "wall polygon floor 0 0 12 0 0 0 4 0 0 4 2 0 0 2 0\n"
    scene = scene_of(text + floor + LIGHT)
    picture = scene.content["wall_material"]["bsdf"]["reflectance"]["data"]
    assert picture[:, :62] == pytest.approx(np.broadcast_to([0.2, 0.1, 0.05], (64, 62, 3)), rel=1e-3)
    assert picture[:, -62:] == pytest.approx(np.broadcast_to([0.8, 0.4, 0.2], (64, 62, 3)), rel=1e-3)
    assert scene.content["wall_surfaces"]["uv"].tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    ball = scene_of(text + "wall sphere ball 0 0 4 2 1 1 .3\n" + LIGHT)
    mean = ball.content["wall_material"]["bsdf"]["reflectance"]["value"]
    assert mean == pytest.approx([0.5, 0.25, 0.125], rel=0.06)


@needs_radiance
def test_a_lamp_with_a_distribution_keeps_its_light(scene_of, tmp_path):
    # Radiance 10 cos²: half of the light of 10 in all directions.
    (tmp_path / "beam.cal").write_text("beam = Rdot * Rdot;\n")
    text = "void brightfunc it 2 beam beam.cal 0 0\nit light lamp 0 0 3 10 10 10\n"
    scene = scene_of(text + "lamp polygon panel 0 0 9 0 0 0 4 0 0 4 2 0\n")
    assert scene.content["panel"]["emitter"]["radiance"]["value"] == pytest.approx([5] * 3, rel=0.03)
    assert [note.kind for note in scene.notes] == ["approximated"]
