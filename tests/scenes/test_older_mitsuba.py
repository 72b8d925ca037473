"""Files of Mitsuba 0.5 and 0.6 give the light that those versions describe, in the words of Mitsuba 3."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.constants import Boltzmann, Planck, speed_of_light

from steadylight.errors import SceneError
from steadylight.renderers.mitsuba.backend import resolve_variant
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes import load_scene

LIGHT = '<emitter type="point"><rgb name="intensity" value="1"/></emitter>'
SAMPLES = 2**16


@pytest.fixture(autouse=True)
def _backend():
    variant = resolve_variant("llvm")
    import mitsuba as mi

    mi.set_variant(variant)


@pytest.fixture
def read(tmp_path):
    """Reads a scene of lines, of version 0.5."""

    def scene(*lines, version="0.5.0"):
        file = tmp_path / "old.xml"
        file.write_text("\n".join([f'<scene version="{version}">', *lines, "</scene>"]))
        return load_scene(file)

    return scene


@pytest.fixture
def bsdf(read):
    """Reads a BSDF, as Mitsuba's object, and its description's notes."""

    def made(text):
        description = read(f'<shape type="sphere">{text}</shape>', LIGHT)
        return build_scene(description).shapes()[0].bsdf(), description.notes

    return made


def reflected(bsdf, cosine=None):
    """How much a BSDF reflects of the light from an angle, or from everywhere: RGB, by its own samples."""
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, SAMPLES)
    si = dr.zeros(mi.SurfaceInteraction3f, SAMPLES)
    if cosine is None:
        si.wi = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    else:
        si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, float(cosine))
    si.uv = mi.Point2f(0.5)
    _, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return np.array(dr.mean(weight, axis=1)).ravel()


def value(bsdf, from_, to):
    """The BSDF times the cosine for one pair of directions: RGB."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(*map(float, from_))
    return np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*map(float, to)))).ravel()


def test_phong_reflects_what_its_lobes_do(bsdf):
    text = (
        '<bsdf type="phong"><float name="exponent" value="80"/>'
        '<rgb name="diffuseReflectance" value="0.5, 0.3, 0.1"/>'
        '<spectrum name="specularReflectance" value="0.2 0.3 0.2"/></bsdf>'
    )
    converted, notes = bsdf(text)
    # The lobe (n + 2) / 2 pi cos^n a, cut off at the horizon: for uniform light, by plain quadrature.
    z = (np.arange(120) + 0.5) / 120
    azimuth = 2 * np.pi * (np.arange(120) + 0.5) / 120
    incoming, outgoing = z[:, None, None], z[:, None]
    a = incoming * outgoing + np.sqrt((1 - incoming**2) * (1 - outgoing**2)) * np.cos(azimuth)
    lobe = 2 * np.mean(82 * np.maximum(a, 0) ** 80 * outgoing * incoming)
    expected = np.array([0.5, 0.3, 0.1]) + np.array([0.2, 0.3, 0.2]) * lobe
    np.testing.assert_allclose(reflected(converted), expected, rtol=0.02)
    assert [(note.kind, "phong" in note.text) for note in notes] == [("approximated", True)]
    assert notes[0].where == "old.xml: line 2, column 23"
    assert (
        value(converted, [0.6, 0, 0.8], [-0.6, 0, 0.8])[0] > 3 * value(converted, [0.6, 0, 0.8], [0, 0, 1])[0]
    )


def test_ward_keeps_its_reflectances_and_its_two_widths(read, bsdf):
    text = '<bsdf type="ward"><float name="alphaU" value="0.05"/><float name="alphaV" value="0.2"/></bsdf>'
    lobe = read(f'<shape type="sphere">{text}</shape>', LIGHT).content["shape_1"]["bsdf"]["bsdf_2"]
    assert (lobe["alpha_u"], lobe["alpha_v"], lobe["type"]) == (0.05, 0.2, "roughconductor")
    np.testing.assert_allclose(reflected(bsdf(text)[0], 0.95), 0.5 + 0.2, rtol=0.03)


def test_a_ward_that_reflects_more_than_all_light_is_scaled_to_all(bsdf):
    text = (
        '<bsdf type="ward"><float name="alpha" value="0.02"/><rgb name="diffuseReflectance" value="0.9"/>'
        '<rgb name="specularReflectance" value="0.6"/></bsdf>'
    )
    np.testing.assert_allclose(reflected(bsdf(text)[0], 0.9), 1, rtol=0.02)


def test_a_mixture_weighs_each_part_and_is_black_for_the_rest(bsdf):
    parts = "".join(
        f'<bsdf type="diffuse"><rgb name="reflectance" value="{colour}"/></bsdf>'
        for colour in ("0.9, 0, 0", "0, 0.8, 0", "0, 0, 0.5")
    )
    mixed, notes = bsdf(
        f'<bsdf type="mixturebsdf"><string name="weights" value="0.2, 0.3, 0.4"/>{parts}</bsdf>'
    )
    np.testing.assert_allclose(reflected(mixed, 0.7), [0.18, 0.24, 0.2], rtol=0.02)
    assert [note.kind for note in notes] == ["converted"]


def test_a_coat_lets_the_light_in_and_out_once(bsdf):
    text = (
        '<bsdf type="coating"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.6"/></bsdf></bsdf>'
    )
    coated, notes = bsdf(text)

    def transmitted(cosine):
        inner = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
        across = ((cosine - 1.5 * inner) / (cosine + 1.5 * inner)) ** 2
        along = ((1.5 * cosine - inner) / (1.5 * cosine + inner)) ** 2
        return 1 - (across + along) / 2

    for cosine in (0.3, 0.9):
        to = np.array([0, np.sqrt(1 - 0.8**2), 0.8])
        from_ = [np.sqrt(1 - cosine**2), 0, cosine]
        expected = transmitted(cosine) * transmitted(0.8) / 1.5**2 * 0.6 / np.pi * 0.8
        np.testing.assert_allclose(value(coated, from_, to), expected, rtol=0.01)
    assert [note.kind for note in notes] == ["converted"]


def test_what_surrounds_a_metal_divides_its_index(read):
    text = '<bsdf type="conductor"><rgb name="eta" value="3,2,1"/><rgb name="k" value="4,4,2"/>'
    inside = f'{text}<float name="extEta" value="2"/></bsdf>'
    metal = read(f'<shape type="sphere">{inside}</shape>', LIGHT).content["shape_1"]["bsdf"]
    assert (metal["eta"]["value"], metal["k"]["value"]) == ([1.5, 1, 0.5], [2, 2, 1])
    assert "ext_eta" not in metal


@pytest.mark.parametrize(
    ("written", "rgb"),
    [
        ('<rgb name="intensity" value="#ff8000"/>', [1, 128 / 255, 0]),
        ('<srgb name="intensity" value="#ff8000"/>', [1, ((128 / 255 + 0.055) / 1.055) ** 2.4, 0]),
        ('<srgb name="intensity" value="0.02"/>', [0.02 / 12.92] * 3),
        ('<spectrum name="intensity" value="3, 2 1"/>', [3, 2, 1]),
        ('<rgb name="intensity" intent="illuminant" value="3, 2, 1"/>', [3, 2, 1]),
    ],
)
def test_colours_are_linear_rgb(read, written, rgb):
    content = read('<shape type="sphere"/>', f'<emitter type="point">{written}</emitter>').content
    np.testing.assert_allclose(np.broadcast_to(content["emitter_1"]["intensity"]["value"], 3), rgb, rtol=1e-6)


def test_a_black_body_has_the_luminance_of_plancks_law(read):
    import mitsuba as mi

    black = '<blackbody name="intensity" temperature="3000K" scale="2"/>'
    scene = build_scene(read('<shape type="sphere"/>', f'<emitter type="point">{black}</emitter>'))
    rgb = np.array(mi.traverse(scene.emitters()[0])["intensity.value"]).ravel()
    metres = np.arange(360, 831) * 1e-9
    radiance = 2 * Planck * speed_of_light**2 / metres**5
    radiance /= np.expm1(Planck * speed_of_light / (Boltzmann * 3000 * metres)) * 1e9
    observer = np.array(mi.cie1931_xyz(mi.Float(metres * 1e9))[1])
    assert rgb @ [0.2126, 0.7152, 0.0722] == pytest.approx(
        2 * (radiance * observer).sum() / observer.sum(), rel=2e-3
    )


def seen(scene, direction):
    """Radiance of the environment in a direction: RGB."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(*map(float, direction))
    return np.array(scene.environment().eval(si)).ravel()


def test_the_sky_has_its_zenith_at_y_and_the_ground_albedo_of_its_time(read):
    here = '<vector name="sunDirection" x="0" y="0.8" z="0.6"/><float name="turbidity" value="4"/>'
    old = read(
        '<shape type="sphere"/>', f'<emitter type="sky">{here}<float name="scale" value="3"/></emitter>'
    )
    today = (
        '<emitter type="sunsky"><vector name="sun_direction" x="0" y="-0.6" z="0.8"/>'
        '<float name="turbidity" value="4"/><float name="albedo" value="0.2"/>'
        '<float name="sky_scale" value="3"/><float name="sun_scale" value="0"/></emitter>'
    )
    new = build_scene(read('<shape type="sphere"/>', today, version="3.0.0"))
    for x, y, z in ((0, 1, 0), (0.6, 0.64, -0.48), (0.1, 0.3, 0.95)):
        expected = seen(new, (x, -z, y))
        assert expected.min() > 0
        np.testing.assert_allclose(seen(build_scene(old), (x, y, z)), expected, rtol=1e-4)
    assert [note.kind for note in old.notes] == ["converted"]


def test_a_wider_sun_sends_the_same_light(read):
    towards = np.array([0.6, 0.8, 0])
    sent = []
    for scale in (1, 20):
        sun = (
            f'<emitter type="sun"><vector name="sunDirection" x="0.6" y="0.8" z="0"/>'
            f'<float name="sunRadiusScale" value="{scale}"/></emitter>'
        )
        scene = build_scene(read('<shape type="sphere"/>', sun))
        edge = np.cos(np.radians(0.5358 / 2 * scale))
        sent.append(seen(scene, towards) * 2 * np.pi * (1 - edge))
        assert seen(scene, (-0.6, 0.8, 0)).max() == 0
    assert sent[0].min() > 0
    np.testing.assert_allclose(sent[0], sent[1], rtol=5e-3)  # 1 - cos in single precision


def test_a_sun_by_place_and_time_stands_where_it_stood(read):
    # On the equator at an equinox, at 9 in the morning by the sun: in the east (+x; north is -z), 45 degrees up.
    when = {"latitude": 0, "longitude": 0, "timezone": 0, "year": 2010, "month": 3, "day": 20, "hour": 9.125}
    lines = "".join(
        f'<{"integer" if name in {"year", "month", "day"} else "float"} name="{name}" value="{item}"/>'
        for name, item in when.items()
    )
    sun = f'<emitter type="sun">{lines}<float name="sunRadiusScale" value="4"/></emitter>'
    scene = build_scene(read('<shape type="sphere"/>', sun))
    assert seen(scene, (np.sqrt(0.5), np.sqrt(0.5), 0)).min() > 0
    for x, z in ((-1, 0), (0, 1), (0, -1)):
        assert seen(scene, (x * np.sqrt(0.5), np.sqrt(0.5), z * np.sqrt(0.5))).max() == 0


def test_a_sky_of_today_in_a_file_of_an_older_version_is_left_alone(read):
    today = '<emitter type="sunsky"><float name="sun_aperture" value="2"/></emitter>'
    assert read('<shape type="sphere"/>', today).content["emitter_1"] == {
        "type": "sunsky",
        "sun_aperture": 2.0,
    }


def test_texture_coordinates_are_scaled_before_they_are_moved(read, bsdf):
    import drjit as dr
    import mitsuba as mi

    checks = (
        '<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><float name="uscale" value="2"/>'
        '<float name="uoffset" value="0.25"/><rgb name="color0" value="1"/><rgb name="color1" value="0"/>'
        "</texture></bsdf>"
    )
    texture = bsdf(checks)[0]
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    for u in (0.05, 0.2, 0.3, 0.45):
        si.uv = mi.Point2f(u, 0.2)
        bright = (2 * u + 0.25) % 1 < 0.5
        assert (np.array(texture.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))).max() > 0) == bright


def test_scaled_textures_have_their_values_multiplied(read, bsdf, tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 2), (188, 188, 188)).save(tmp_path / "grey.png")  # half of all light
    picture = '<texture type="bitmap" id="grey"><string name="filename" value="grey.png"/></texture>'
    checks = '<texture type="checkerboard"><rgb name="color0" value="0.8"/><rgb name="color1" value="0.8"/></texture>'
    for inner, scale, expected in (
        (picture, '<float name="scale" value="0.5"/>', [0.25] * 3),
        (picture, '<rgb name="scale" value="1, 0.5, 0.1"/>', [0.5, 0.25, 0.05]),
        (f'<texture type="scale"><float name="scale" value="0.2"/>{picture}</texture>', "", [0.1] * 3),
        (checks, '<float name="scale" value="0.5"/>', [0.4] * 3),
        ('<rgb value="0.4, 0.2, 0.1"/>', '<float name="scale" value="2"/>', [0.8, 0.4, 0.2]),
    ):
        text = (
            f'<bsdf type="diffuse"><texture type="scale" name="reflectance">{scale}{inner}</texture></bsdf>'
        )
        np.testing.assert_allclose(reflected(bsdf(text)[0]), expected, rtol=0.01)


def test_a_picture_is_scaled_for_one_material_and_not_for_another(read, tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 2), (188, 188, 188)).save(tmp_path / "grey.png")
    description = read(
        '<texture type="bitmap" id="grey"><string name="filename" value="grey.png"/></texture>',
        '<texture type="scale" id="dark"><float name="scale" value="0.5"/><ref id="grey"/></texture>',
        *(
            f'<shape type="sphere"><bsdf type="diffuse"><ref name="reflectance" id="{texture}"/></bsdf></shape>'
            for texture in ("grey", "dark")
        ),
        LIGHT,
    )
    grey, dark = (reflected(shape.bsdf())[0] for shape in build_scene(description).shapes())
    assert (grey, dark) == pytest.approx((0.503, 0.252), rel=0.01)
    assert list(description.files) == [str(tmp_path / "grey.png")]


def test_pictures_and_films_are_read_as_nearly_as_can_be_with_a_note_for_each_difference(read, tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 2), (188, 188, 188)).save(tmp_path / "grey.png")
    picture = (
        '<string name="filename" value="grey.png"/><string name="filterType" value="ewa"/>'
        '<float name="gamma" value="1"/><string name="wrapModeU" value="clamp"/>'
    )
    description = read(
        '<sensor type="perspective"><film type="ldrfilm"><integer name="width" value="20"/>',
        '<integer name="height" value="10"/><float name="gamma" value="2.2"/><boolean name="banner" value="false"/>',
        '</film><sampler type="halton"/></sensor><integrator type="sppm"/>',
        '<shape type="sphere"><bsdf type="diffuse"><texture name="diffuseReflectance" type="bitmap">',
        picture,
        "</texture></bsdf></shape>",
        LIGHT,
    )
    bitmap = description.content["shape_1"]["bsdf"]["reflectance"]
    assert (bitmap["raw"], bitmap["filter_type"], bitmap["wrap_mode"]) == (True, "bilinear", "clamp")
    assert (description.width, description.height) == (20, 10)
    assert [(note.kind, note.where.rpartition("line ")[2].split(",")[0]) for note in description.notes] == [
        ("converted", "2"),
        ("approximated", "6"),
        ("approximated", "5"),
        ("left out", "3"),
    ]
    assert any("`hdrfilm` has no property `gamma`" in note.text for note in description.notes)


@pytest.mark.parametrize(
    ("film", "picture", "pixels"),
    [
        ("ldrfilm", "png", "rgb"),
        ("ldrfilm", "jpeg", "luminanceAlpha"),
        ("hdrfilm", "openexr", "spectrum"),
        ("hdrfilm", "rgbe", "rgb"),
        ("mfilm", "numpy", "rgb"),
    ],
)
def test_films_are_read_whatever_their_formats(read, film, picture, pixels):
    description = read(
        f'<sensor type="perspective"><film type="{film}"><integer name="width" value="20"/>',
        '<integer name="height" value="10"/>',
        f'<string name="fileFormat" value="{picture}"/><string name="pixelFormat" value="{pixels}"/>',
        '</film></sensor><shape type="sphere"/>',
        LIGHT,
    )
    assert (description.width, description.height) == (20, 10)
    assert [note.kind for note in description.notes] == ["converted"] * (film != "hdrfilm")


def test_all_that_cannot_be_converted_is_refused_by_name_at_once(read):
    lines = [
        '<shape type="sphere"><bsdf type="irawan"/></shape>',
        '<shape type="hair"><string name="filename" value="x.hair"/></shape>',
        '<shape type="sphere"><subsurface type="dipole"/></shape>',
        '<shape type="sphere"><medium name="interior" type="homogeneous"/></shape>',
        '<bsdf type="mixturebsdf"><string name="weights" value="1, 2"/><bsdf type="diffuse"/></bsdf>',
        '<bsdf type="coating"><bsdf type="conductor"/></bsdf>',
        '<bsdf type="phong"><float name="exponent" value="-1"/></bsdf>',
        '<texture type="scale" id="x"><float name="scale" value="2"/></texture>',
        '<emitter type="collimated"/>',
        '<shape type="sphere"><animation name="toWorld"/></shape>',
    ]
    with pytest.raises(SceneError) as caught:
        read(*lines)
    message = str(caught.value)
    for number, words in enumerate(
        (
            "BSDF `irawan` is not supported: woven cloth",
            "shape `hair` is not supported",
            "subsurface `dipole` is not supported",
            "medium `homogeneous` is not supported",
            "`mixturebsdf`: give a weight of at least 0 for each of its 1 BSDFs",
            "bsdf `coating` is supported only over diffuse",
            "`phong`: the exponent must be a number of at least 0",
            "texture `scale` is supported only in bumpmap",
            "emitter `collimated` is not supported",
            "<animation> is not supported",
        ),
        2,
    ):
        (line,) = (line for line in message.splitlines() if words in line)
        assert f": line {number}, " in line
