"""Radiance's scenes in the Mitsuba renderer have the light of closed forms, and of Radiance's own rtrace."""

from __future__ import annotations

from importlib.util import find_spec

import mitsuba as mi
import numpy as np
import pytest

from steadylight.renderers.mitsuba.scene import build_scene, build_sensor
from steadylight.renderers.radiance.view import View
from steadylight.scenes import load_scene
from steadylight.scenes.radiance.programs import output_of

ROOM = """
void plastic wall 0 0 5 .6 .5 .4 0 0
void plastic shiny 0 0 5 .3 .4 .6 .04 .1
void metal steel 0 0 5 .7 .7 .7 .9 .1
void light lamp 0 0 3 20 20 20
void glass pane 0 0 3 .7 .8 .9
void trans sheet 0 0 7 .8 .8 .8 0 0 .5 .4
!genbox wall room 4 3 2.5 -i
!genbox shiny block .8 .8 1 | xform -t 2.4 1.6 0
steel cylinder post 0 0 7 1 2.5 0 1 2.5 2 .15
steel ring foot 0 0 8 1 2.5 .01 0 0 1 0 .4
pane polygon window 0 0 12 2 2.6 .2 3.8 2.6 .2 3.8 2.6 1.8 2 2.6 1.8
sheet polygon screen 0 0 12 .2 1.2 0 1 1.2 0 1 1.2 1.5 .2 1.2 1.5
lamp polygon panel 0 0 12 1.5 1 2.49 1.5 2 2.49 2.5 2 2.49 2.5 1 2.49
"""
VIEW = "rvu -vtv -vp .3 .3 1.5 -vd .75 .6 -.3 -vu 0 0 1 -vh 75 -vv 50\n"


def pictured(scene, width, height, spp):
    """The first frame by Mitsuba's path tracer, (H, W, 3)."""
    pose = scene.camera.pose(0.0)
    sensor = build_sensor(scene, pose, width, height, {"type": "box"})
    integrator = mi.load_dict({"type": "volpath", "max_depth": 12})
    return np.array(mi.render(build_scene(scene), sensor=sensor, integrator=integrator, spp=spp, seed=3))


@pytest.fixture
def scene_of(tmp_path):
    def read(text, view):
        (tmp_path / "it.rad").write_text(text)
        (tmp_path / "it.vf").write_text(view)
        return load_scene(tmp_path / "it.rad")

    return read


def test_a_square_lamp_over_a_floor_gives_the_light_of_its_form_factor(scene_of):
    text = (
        "void plastic grey 0 0 5 .5 .5 .5 0 0\ngrey ring floor 0 0 8 0 0 0 0 0 1 0 9\n"
        "void light lamp 0 0 3 10 20 40\nlamp polygon panel 0 0 12 -1 -1 2 -1 1 2 1 1 2 1 -1 2\n"
    )
    scene = scene_of(text, "rvu -vtv -vp 0 0 1 -vd 0 0 -1 -vu 0 1 0 -vh 1 -vv 1\n")
    x = 0.5  # half of the side over the height
    root = np.sqrt(1 + x * x)
    form_factor = 4 / (2 * np.pi) * 2 * x / root * np.arctan(x / root)
    seen = pictured(scene, 4, 4, 1024).mean(axis=(0, 1))
    assert seen == pytest.approx(0.5 * form_factor * np.array([10, 20, 40]), rel=0.02)


def test_a_translucent_sheet_under_an_even_sky_shows_what_it_transmits(scene_of):
    text = (
        "void trans sheet 0 0 7 .8 .6 .4 0 0 .5 .25\nsheet ring it 0 0 8 0 0 0 0 0 1 0 9\n"
        "void glow sky 0 0 4 10 10 10 0\nsky source up 0 0 4 0 0 1 180\n"
    )
    scene = scene_of(text, "rvu -vtv -vp 0 0 -1 -vd 0 0 1 -vu 0 1 0 -vh 1 -vv 1\n")
    # Scattered and straight on: colour x transmissivity of what is above, and nothing from below.
    assert pictured(scene, 4, 4, 1024).mean(axis=(0, 1)) == pytest.approx([4, 3, 2], rel=0.02)


@pytest.mark.skipif(find_spec("pyradiance") is None, reason="pyradiance is not installed")
def test_a_room_has_the_light_that_radiance_finds(scene_of, tmp_path):
    scene = scene_of(ROOM, VIEW)
    ours = pictured(scene, 24, 16, 256)
    (tmp_path / "scene.oct").write_bytes(output_of(tmp_path, "oconv", "-w", "it.rad"))
    y, x = np.mgrid[0:16, 0:24]
    points = np.stack([(x + 0.5) / 24, (y + 0.5) / 16], axis=2).reshape(-1, 2)
    jitter = (np.random.default_rng(1).random((6, *points.shape)) - 0.5) / [24, 16]
    rays = View(scene.camera.pose(0.0), 24, 16).rays((points + jitter).reshape(-1, 2))
    words = (
        "-ab",
        10,
        "-aa",
        0,
        "-as",
        0,
        "-ad",
        48,
        "-dt",
        0,
        "-ds",
        0.1,
        "-st",
        0,
        "-ss",
        1,
        "-lr",
        -14,
        "-lw",
        1e-5,
    )
    data = output_of(
        tmp_path, "rtrace", "-h", "-w", "-fff", *words, "scene.oct", given=rays.astype("<f4").tobytes()
    )
    theirs = np.frombuffer(data, "<f4").reshape(6, 16, 24, 3).mean(axis=0)
    assert ours.mean(axis=(0, 1)) == pytest.approx(theirs.mean(axis=(0, 1)), rel=0.03)
    # By quarters of the picture: glass, gloss, metal and the sheet each lie in another.
    quarters = [image.reshape(2, 8, 2, 12, 3).mean(axis=(1, 3)) for image in (ours, theirs)]
    assert quarters[0] == pytest.approx(quarters[1], rel=0.06)
