"""Whatever is in a scene file: a description, or an error that names it; never a crash, nothing from elsewhere."""

from __future__ import annotations

import re
from xml.sax.saxutils import quoteattr

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from steadylight.errors import InputError
from steadylight.scenes import load_scene
from steadylight.scenes.mitsuba_older import PLUGINS as OLDER
from steadylight.scenes.mitsuba_plugins import PLUGINS

SCENE = """<scene version="0.6.0">
  <default name="wide" value="1.5"/>
  <sensor type="perspective"><float name="fov" value="40"/><transform name="toWorld">
    <lookat origin="0,-5,3" target="0,0,0" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="32"/>
      <rfilter type="tent"/></film></sensor>
  <texture type="checkerboard" id="checks"><rgb name="color0" value="0.8,0.1,0.1"/>
    <float name="uscale" value="3"/></texture>
  <bsdf type="twosided" id="floor"><bsdf type="diffuse"><ref name="reflectance" id="checks"/></bsdf></bsdf>
  <bsdf type="phong" id="shiny"><float name="exponent" value="20"/></bsdf>
  <bsdf type="mixturebsdf" id="mix"><string name="weights" value="0.4,0.5"/><bsdf type="diffuse"/>
    <bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.3"/></bsdf></bsdf>
  <shape type="sphere"><point name="center" x="-1" y="0" z="1"/><float name="radius" value="$wide"/>
    <ref id="mix"/></shape>
  <shape type="rectangle"><ref id="floor"/><transform name="toWorld"><scale value="4"/></transform></shape>
  <shape type="ply"><string name="filename" value="none.ply"/><ref id="shiny"/></shape>
  <emitter type="sky"><vector name="sunDirection" x="0" y="1" z="1"/></emitter>
  <emitter type="point"><point name="position" x="1" y="2" z="3"/><srgb name="intensity" value="#ffeedd"/></emitter>
</scene>
"""
WORDS = (
    *(
        "",
        "0",
        "-1",
        "nan",
        "inf",
        "1e400",
        "1e-40",
        "1,2,3",
        "1 2",
        "400:1,700:2",
        "#ffffff",
        "true",
        "$wide",
        "$a",
    ),
    *(
        "\\$",
        "none.ply",
        "../none.ply",
        "/etc/passwd",
        "/dev/zero",
        ".",
        "room.xml",
        "99999999999999999999",
        "ü'\"&<",
    ),
    *(
        "scene",
        "checks",
        "floor",
        "to_world",
        "radius",
        "reflectance",
        "weights",
        "filename",
        "alpha",
        "value",
    ),
    *(row.name for row in (*PLUGINS, *OLDER)),
)
TAGS = (
    *(
        "bsdf",
        "emitter",
        "film",
        "shape",
        "texture",
        "sensor",
        "transform",
        "include",
        "default",
        "ref",
        "alias",
    ),
    *(
        "float",
        "integer",
        "rgb",
        "spectrum",
        "string",
        "point",
        "boolean",
        "matrix",
        "path",
        "medium",
        "blackbody",
    ),
)
PLACES = [match.span() for match in re.finditer(r'"[^"]*"', SCENE)]


@st.composite
def element(draw, depth=2):
    """An element with any attributes."""
    tag = draw(st.sampled_from(TAGS))
    names = st.sampled_from(("name", "type", "value", "id", "x", "filename", "as", "temperature"))
    attributes = draw(st.dictionaries(names, st.sampled_from(WORDS) | st.floats().map(str), max_size=4))
    inside = "".join(draw(st.lists(element(depth - 1), max_size=3))) if depth else ""
    return (
        f"<{tag} {' '.join(f'{key}={quoteattr(word)}' for key, word in attributes.items())}>{inside}</{tag}>"
    )


@st.composite
def changed(draw):
    """The scene above with other values, with elements put in, or damaged."""
    text = SCENE
    for start, end in sorted(draw(st.lists(st.sampled_from(PLACES), max_size=3, unique=True)), reverse=True):
        text = text[:start] + quoteattr(draw(st.sampled_from(WORDS))) + text[end:]
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.sampled_from([match.end() for match in re.finditer(r">", text)]))
        text = text[:at] + draw(element()) + text[at:]
    if draw(st.integers(0, 5)) == 0:
        at = draw(st.integers(0, len(text) - 1))
        text = text[:at] + text[at + draw(st.integers(1, 40)) :]
    return text.encode()


@pytest.fixture
def folder(tmp_path):
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    (tmp_path / "none.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    return tmp_path


@settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(content=changed() | st.binary(max_size=60))
def test_any_file_is_read_or_refused_by_name(folder, content):
    file = folder / "room.xml"
    file.write_bytes(content)
    try:
        description = load_scene(file)
    except InputError as error:
        description, message = None, str(error)
    if description is None:
        assert "room.xml" in message
    else:
        assert set(description.files) <= {str(folder / "none.ply"), str(file)}
        assert description.hash == load_scene(file).hash
