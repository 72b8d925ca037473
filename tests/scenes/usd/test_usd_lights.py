"""Lights of USD stages: what they give to a floor, in closed form."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from usd_stages import FLOOR, light, read, texts, usda

from steadylight.errors import SceneError
from steadylight.images import write_exr
from steadylight.scenes.usd.reading import describe
from steadylight.scenes.usd.request import Request

FOUR = 4  # metres above the floor

ABOVE = (0, 0, FOUR)
AROUND_X = 'uniform token[] xformOpOrder = ["xformOp:rotateX"]'

STAGES = {
    "rect": (light("RectLight", at=ABOVE, width=0.2, height=0.1, intensity=50), 50 * 0.02 / FOUR**2),
    "rect, normalized, scaled, two stops brighter": (
        light(
            "RectLight",
            width=0.1,
            height=0.1,
            intensity=50,
            normalize=True,
            exposure=2,
            lines=(
                "double3 xformOp:translate = (0, 0, 4)",
                "float3 xformOp:scale = (2, 3, 1)",
                'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]',
            ),
        ),
        50 * 4 / FOUR**2,
    ),
    "a large rect": (
        light("RectLight", at=ABOVE, width=8, height=8, intensity=3),
        # View factor of a square seen from below its middle: four quarters, each as wide and long as it is high.
        3 * 4 * (1 / math.sqrt(2)) * math.atan(1 / math.sqrt(2)),
    ),
    "disk": (light("DiskLight", at=ABOVE, radius=3, intensity=5), 5 * math.pi * 9 / (9 + 16)),
    "sphere": (light("SphereLight", at=ABOVE, radius=1, intensity=5), 5 * math.pi / 16),
    "sphere, normalized": (
        light("SphereLight", at=ABOVE, radius=0.5, intensity=64, normalize=True),
        64 / 4 / FOUR**2,
    ),
    "a point": (
        light(
            "SphereLight", at=ABOVE, radius=0, intensity=64, normalize=True, lines=("bool treatAsPoint = 1",)
        ),
        64 / 4 / FOUR**2,
    ),
    "spot": (
        light(
            "SphereLight",
            api="ShapingAPI",
            at=ABOVE,
            radius=0.01,
            intensity=64,
            normalize=True,
            shaping__cone__angle=20,
        ),
        64 / 4 / FOUR**2,
    ),
    "a spot that looks away": (
        light(
            "SphereLight",
            api="ShapingAPI",
            radius=0.01,
            intensity=64,
            normalize=True,
            shaping__cone__angle=20,
            lines=(
                "double3 xformOp:translate = (0, 0, 4)",
                "float xformOp:rotateX = 180",
                'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]',
            ),
        ),
        0.0,
    ),
    "a thin cylinder": (
        light("CylinderLight", at=ABOVE, length=0.2, radius=0.01, intensity=500),
        500 * 0.2 * 0.02 / FOUR**2,
    ),
    "distant, normalized": (
        light("DistantLight", intensity=3, normalize=True, lines=("float xformOp:rotateX = 60", AROUND_X)),
        3 * 0.5,
    ),
    "distant, half a degree wide": (
        light("DistantLight", intensity=50000, angle=0.53),
        50000 * math.pi * math.sin(math.radians(0.265)) ** 2,
    ),
    "distant, eight degrees wide, under a dome": (
        light(
            "DistantLight",
            intensity=3,
            normalize=True,
            angle=8,
            lines=("float xformOp:rotateX = 60", AROUND_X),
        )
        + light("DomeLight", intensity=2).replace('"L"', '"Dome"'),
        3 * 0.5 + 2 * math.pi,
    ),
    "dome, as in a furnace": (light("DomeLight", intensity=2), 2 * math.pi),
    "a mesh that is a light": (
        light(
            "Mesh",
            api="MeshLightAPI",
            intensity=50,
            lines=(
                'uniform token subdivisionScheme = "none"',
                "point3f[] points = [(-0.1, -0.05, 4), (0.1, -0.05, 4), (0.1, 0.05, 4), (-0.1, 0.05, 4)]",
                "int[] faceVertexCounts = [4]",
                "int[] faceVertexIndices = [3, 2, 1, 0]",
            ),
        ),
        50 * 0.02 / FOUR**2,
    ),
    "a dome with an image that shines from above": (
        light("DomeLight", texture__file="@sky.exr@", lines=("float xformOp:rotateX = 90", AROUND_X)),
        7 * math.pi,
    ),
}


@pytest.fixture(scope="module")
def received(tmp_path_factory) -> dict[str, list[float]]:
    """Irradiance of the floor below each light."""
    folder = tmp_path_factory.mktemp("lights")
    write_exr(
        folder / "sky.exr",
        np.repeat([[[7.0] * 3], [[1.0] * 3]], 64, axis=1).repeat(16, axis=0).astype(np.float32),
    )
    paths = []
    for number, (body, _) in enumerate(STAGES.values()):
        path = folder / f"{number}.usda"
        path.write_text(usda(FLOOR + body))
        paths.append(str(path))
    script = Path(__file__).with_name("irradiance.py")
    done = subprocess.run([sys.executable, str(script), *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(zip(STAGES, json.loads(done.stdout.splitlines()[-1]), strict=True))


@pytest.mark.parametrize("name", STAGES)
def test_a_light_gives_what_its_formula_says(received, name):
    expected = STAGES[name][1]
    assert received[name] == pytest.approx([expected] * 3, rel=0.01, abs=1e-6)


def test_a_light_of_6500_kelvin_is_white_and_one_of_3000_is_not(tmp_path):
    def colour(**inputs) -> list[float]:
        lamp = light("RectLight", enableColorTemperature=True, **inputs)
        return read(tmp_path, lamp, name=f"{len(inputs)}.usda").content["light /L"]["emitter"]["radiance"][
            "value"
        ]

    assert colour() == pytest.approx([1, 1, 1])
    red, green, blue = colour(colorTemperature=3000)
    assert red > green > blue


def test_brightness_does_not_depend_on_the_unit_of_length(tmp_path):
    metres = read(tmp_path, light("SphereLight", radius=0.5), name="m.usda").content["light /L"]
    inches = read(tmp_path, light("SphereLight", radius=0.5 / 0.0254), name="i.usda", metres=0.0254).content[
        "light /L"
    ]
    assert metres["radius"] == pytest.approx(inches["radius"])
    assert metres["emitter"] == inches["emitter"]


def test_what_no_light_of_ours_has_is_noted(tmp_path):
    (tmp_path / "lamp.ies").write_text("IESNA:LM-63-2002\n")
    lamp = light(
        "RectLight",
        api="ShapingAPI",
        shaping__ies__file="@lamp.ies@",
        shaping__focus=2,
        diffuse=0.5,
        shadow__enable=False,
    )
    notes = texts(read(tmp_path, lamp + '\ndef PortalLight "P" {}'))
    for word in ("IES profile", "focus", "0.5 for diffuse", "cast no shadows", "PortalLight"):
        assert word in notes


def test_a_wide_sun_is_noted(tmp_path):
    found = read(tmp_path, light("DistantLight", angle=5))
    assert "5° wide: becomes a visible disc in the environment" in texts(found)
    assert found.content["light environment"]["type"] == "envmap"
    assert "1.5° wide: becomes parallel light" in texts(
        read(tmp_path, light("DistantLight", angle=1.5), name="b.usda")
    )


def test_light_that_is_negative_is_refused(tmp_path):
    with pytest.raises(SceneError, match="/L: emits"):
        read(tmp_path, light("RectLight", intensity=-5))


def test_a_dome_turns_with_the_pole_that_its_schema_says(tmp_path):
    write_exr(tmp_path / "sky.exr", np.random.default_rng(1).uniform(size=(8, 16, 3)).astype(np.float32))

    def pole(kind: str, up: str) -> list[float]:
        dome = light(kind, texture__file="@sky.exr@")
        found = read(tmp_path, dome, up=up, name=f"{kind}{up}.usda").content["light /L"]
        return (found["to_world"] @ [0, 1, 0, 0])[:3].round(9).tolist()

    assert pole("DomeLight", "Y") == pole("DomeLight_1", "Y") == pole("DomeLight_1", "Z") == [0, 0, 1]
    assert pole("DomeLight", "Z") == [0, 1, 0]


def test_a_dome_of_a_radiance_picture_is_left_to_mitsuba(tmp_path):
    (tmp_path / "sky.hdr").write_bytes(b"#?RADIANCE\n")
    found = read(
        tmp_path,
        light("DomeLight", texture__file="@sky.hdr@", intensity=2, color="(1, 0.5, 1)").replace(
            "asset inputs:color", "color3f inputs:color"
        ),
    )
    made = found.content["light /L"]
    assert (made["type"], made["filename"]) == ("envmap", str(tmp_path / "sky.hdr"))
    assert made["scale"] == pytest.approx(2 * (1 - 0.7152 / 2))
    assert set(found.files) == {made["filename"]}
    assert "approximated: /L: its colour" in texts(found)


def test_a_dome_of_blender_without_a_parent_turns_as_blender_means_it(tmp_path):
    write_exr(tmp_path / "sky.exr", np.random.default_rng(1).uniform(size=(8, 16, 3)).astype(np.float32))
    path = tmp_path / "scene.usda"
    text = usda(light("DomeLight", texture__file="@sky.exr@")).replace(
        "(\n upAxis", '(\n doc = "Blender v5.0.1"\n upAxis'
    )
    path.write_text(text)
    turned = describe(Request(path)).content["light /L"]["to_world"]
    np.testing.assert_allclose(turned @ [0, 1, 0, 0], [0, 0, 1, 0], atol=1e-9)  # the pole is up
    np.testing.assert_allclose(
        turned @ [0, 0, 1, 0], [1, 0, 0, 0], atol=1e-9
    )  # the middle of the image lies along x
