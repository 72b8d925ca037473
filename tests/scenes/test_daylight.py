"""Sun, sky and environment from options: where they stand, and how bright they are."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError, SettingsError
from steadylight.images import write_exr
from steadylight.scenes import load_scene
from steadylight.scenes.daylight import with_light, z_is_up
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.sun import sun_of
from steadylight.settings import SceneOptions

PLATE = (
    "void plastic grey 0 0 5 .5 .5 .5 0 0\ngrey polygon plate 0 0 9 0 0 0 4 0 0 0 4 0\n"
    "void light bright 0 0 3 1 1 1\nbright polygon panel 0 0 9 0 0 3 1 0 3 0 1 3\n"
)
Z_UP = CameraPath((Keyframe(0.0, (0, -9, 1), (0, 0, 1)),))
Y_UP = CameraPath((Keyframe(0.0, (0, 1, 9), (0, 1, 0), (0, 1, 0)),))


@pytest.fixture
def plate(tmp_path):
    (tmp_path / "plate.rad").write_text(PLATE)
    return tmp_path / "plate.rad"


def lit(camera=Z_UP, content=None, **options):
    scene = SceneDescription("scene", content or {}, camera)
    return with_light(scene, SceneOptions.checked(**options), z_up=z_is_up(scene))


@pytest.fixture(scope="module")
def mitsuba():
    from steadylight.renderers.mitsuba.backend import use_variant

    use_variant("llvm_ad_rgb")
    import mitsuba as mi

    return mi


def emitter_of(scene, mi):
    """The scene's daylight as Mitsuba has it."""
    from steadylight.renderers.mitsuba.scene import build_scene

    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    speck = {"type": "triangles", "vertices": corners, "faces": np.array([[0, 1, 2]], np.uint32)}
    content = {**scene.content, "speck": speck}
    return build_scene(SceneDescription("scene", content, scene.camera, files=scene.files)).environment()


def radiance(scene, mi, *directions):
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    d = np.array(directions, np.float32)
    si.wi = -mi.Vector3f((d / np.linalg.norm(d, axis=1, keepdims=True)).T)
    return np.array(emitter_of(scene, mi).eval(si)).reshape(3, -1).T


def luminous_flux(scene, mi, axis):
    """Illuminance on a surface that faces an axis, lx, at 683 lm/W."""
    import drjit as dr

    count = 1 << 16
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    ds, weight = emitter_of(scene, mi).sample_direction(dr.zeros(mi.Interaction3f, count), sampler.next_2d())
    cosine = dr.maximum(dr.dot(ds.d, mi.Vector3f(*map(float, axis))), 0)
    return 683 * float(np.array(mi.luminance(weight) * cosine).mean())


def test_azimuth_goes_from_north_over_east():
    for azimuth, direction in ((0, (0, 1, 0)), (90, (1, 0, 0)), (180, (0, -1, 0)), (-90, (-1, 0, 0))):
        sun = sun_of(SceneOptions.checked(sun=f"{azimuth},1e-9"))
        assert sun.direction == pytest.approx(direction, abs=1e-9)


@pytest.mark.parametrize(
    ("place", "time", "azimuth", "altitude"),
    [
        # Noon of the sun at a solstice: 90 degrees less latitude, plus 23.4.
        ("48,0", "2026-06-21T12:02Z", 180, 65.4),
        ("48,0", "2026-12-21T11:58+00:00", 180, 18.6),
        # The same moment in another zone, and the same sun from the southern side.
        ("48,0", "2026-06-21T14:02+02:00", 180, 65.4),
        ("-48,0", "2026-12-21T11:58Z", 0, 65.4),
        # Sunrise of an equinox is due east.
        ("0,0", "2026-03-20T06:20Z", 90, 3.3),
    ],
)
def test_the_sun_follows_from_place_and_time(place, time, azimuth, altitude):
    sun = sun_of(SceneOptions.checked(place=place, time=time))
    assert (sun.azimuth - azimuth + 180) % 360 - 180 == pytest.approx(0, abs=0.6)
    assert sun.altitude == pytest.approx(altitude, abs=0.3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sun": "180"}, "--sun: '180' is not valid"),
        ({"sun": "180,-3"}, "above the horizon"),
        ({"sun": "nan,3"}, "is not valid"),
        ({"place": "48,11"}, "needs --time"),
        ({"time": "2026-06-21T12:00Z"}, "needs --place"),
        ({"place": "98,11", "time": "2026-06-21T12:00Z"}, "is not on Earth"),
        ({"place": "48,11", "time": "2026-06-21T12:00"}, "has no time zone"),
        ({"place": "48,11", "time": "noon"}, "is not valid"),
        ({"place": "48,11", "time": "2026-06-21T23:30+02:00"}, "below the horizon"),
        ({"sun": "180,45", "place": "48,11", "time": "2026-06-21T12:00Z"}, "give one or the other"),
        ({"sky": "overcast"}, "needs the sun"),
        ({"sky": "sky.rad", "sun": "180,45"}, "has its own sun"),
        ({"envmap": "a.exr", "sun": "180,45"}, "give one or the other"),
        ({"envmap_rotation": 3.0}, "which is missing"),
    ],
)
def test_options_that_say_nothing_or_contradict_each_other_are_refused(plate, options, words):
    with pytest.raises(SettingsError, match=words):
        load_scene(plate, **options)


@pytest.mark.parametrize(("camera", "towards"), [(Z_UP, (1, 0, 1)), (Y_UP, (1, 1, 0))])
def test_a_sun_in_the_east_stands_there_whatever_axis_is_up(mitsuba, camera, towards):
    scene = lit(camera, sun="90,45")
    at_sun, beside = radiance(scene, mitsuba, towards, (towards[0], 0.2, 0.2))
    assert at_sun.min() > 100 * beside.max()


def test_sun_and_clear_sky_are_as_bright_as_measured_ones(mitsuba):
    # Illuminances of a clear day with the sun at 45 degrees: sun on the ground 60 to 75 klx, sky 12 to 20 klx.
    scene = lit(sun="180,45")
    both = luminous_flux(scene, mitsuba, (0, 0, 1))
    (name,) = scene.content
    sky = SceneDescription("sky", {"sky": {**scene.content[name], "sun_scale": 0.0}}, Z_UP)
    diffuse = luminous_flux(sky, mitsuba, (0, 0, 1))
    assert 12e3 < diffuse < 20e3
    assert 60e3 < both - diffuse < 75e3


def test_an_overcast_sky_gives_the_illuminance_of_its_formula(mitsuba):
    # Krochmann and Seidl: 0.3 + 21 sin(altitude) klx.
    scene = lit(sun="70,30", sky="overcast")
    assert luminous_flux(scene, mitsuba, (0, 0, 1)) == pytest.approx(10.8e3, rel=0.01)
    zenith, horizon, below = radiance(scene, mitsuba, (0, 0, 1), (1, 0, 0.02), (1, 0, -0.2))
    assert zenith == pytest.approx(3 * horizon, rel=0.05)
    assert not below.any()


def test_the_middle_of_a_picture_is_north_or_where_it_is_turned(mitsuba, tmp_path):
    picture = np.zeros((16, 32, 3), np.float32)
    picture[6:10, 14:18] = 1  # the middle
    picture[6:10, 22:26, 0] = 5  # a quarter further right
    write_exr(tmp_path / "around.exr", picture)
    north, east, west = ((0, 1, 0), (1, 0, 0), (-1, 0, 0))
    straight = radiance(lit(envmap=tmp_path / "around.exr"), mitsuba, north, east, west)
    assert straight == pytest.approx(np.array([[1, 1, 1], [5, 0, 0], [0, 0, 0]]), abs=1e-3)
    turned = lit(envmap=tmp_path / "around.exr", envmap_rotation=90.0)
    assert radiance(turned, mitsuba, east)[0] == pytest.approx(1, abs=1e-3)
    y_up = lit(Y_UP, envmap=tmp_path / "around.exr")
    assert radiance(y_up, mitsuba, (0, 0, -1))[0] == pytest.approx(1, abs=1e-3)
    assert list(y_up.files) == [str(tmp_path / "around.exr")]
    with pytest.raises(SceneError, match=r"missing\.exr: cannot be read"):
        lit(envmap=tmp_path / "missing.exr")
    for name in ("noise.exr", "noise.hdr", "noise.pfm"):
        (tmp_path / name).write_bytes(b"\x17 noise")
        with pytest.raises(
            SceneError, match=rf"{name}: does not begin like a {name[5:]} image; is it damaged"
        ):
            lit(envmap=tmp_path / name)


def test_daylight_of_the_scene_is_replaced_and_lamps_stay():
    content = {"sky": {"type": "constant"}, "lamp": {"type": "point"}, "sun": {"type": "directional"}}
    scene = lit(content=content, sun="180,45")
    assert list(scene.content) == ["lamp", "daylight_sunsky"]
    assert [note.where for note in scene.notes if note.kind == "left out"] == ["sky", "sun"]


@pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")
def test_a_radiance_sky_lights_other_scenes_in_their_units(tmp_path):
    (tmp_path / "sky.rad").write_text(
        "void light solar 0 0 3 1e6 1e6 1e6\nsolar source sun 0 0 4 0 3 4 .5\n"
        "void glow g 0 0 4 6.83 6.83 6.83 0\ng source sky 0 0 4 0 0 1 360\n"
    )
    scene = lit(Y_UP, sky=tmp_path / "sky.rad")
    assert scene.content["daylight_sky"]["radiance"]["value"] == pytest.approx([1.79] * 3)
    assert scene.content["daylight_sun"]["direction"] == pytest.approx([0, -0.8, 0.6])


@pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")
def test_a_radiance_sky_may_read_files_elsewhere_if_that_is_allowed(tmp_path):
    folder = tmp_path / "skies"
    folder.mkdir()
    (tmp_path / "even.rad").write_text("void glow g 0 0 4 6.83 6.83 6.83 0\ng source sky 0 0 4 0 0 1 360\n")
    (folder / "sky.rad").write_text("!cat ../even.rad\n")
    with pytest.raises(SceneError, match="--allow-outside"):
        lit(sky=folder / "sky.rad")
    scene = lit(sky=folder / "sky.rad", allow_outside=True)
    assert scene.content["daylight_sky"]["radiance"]["value"] == pytest.approx([1.79] * 3)


def test_bundled_scenes_take_daylight():
    assert load_scene("furnace", sun="180,45").hash != load_scene("furnace").hash


@pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")
def test_radiance_gets_the_same_sun(plate):
    scene = load_scene(plate, formats=("radiance",), sun="90,30")
    assert scene.content["sky"]
    assert scene.hash != load_scene(plate, formats=("radiance",), sun="91,30").hash
    with pytest.raises(SettingsError, match="--envmap"):
        load_scene(plate, formats=("radiance",), envmap="a.exr")
