"""Damaged glTF files are one clear error: no traceback, no hang, no memory that the file does not hold."""

from __future__ import annotations

import copy
import json
import tracemalloc

import numpy as np
import pytest
from glb import Glb, rotation
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from steadylight.errors import InputError, SceneError
from steadylight.scenes import load_scene

FUZZ = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
"""The same examples each time: a suite that fails now and then tells little."""


def whole():
    """A file with a bit of everything."""
    glb = Glb()
    image = np.random.default_rng(0).integers(0, 255, (4, 4, 3)).astype(np.uint8)
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    texture = {"index": glb.image(file.getvalue())}
    material = glb.add(
        "materials",
        pbrMetallicRoughness={"baseColorTexture": texture, "metallicRoughnessTexture": texture},
        emissiveTexture=texture,
        emissiveFactor=[1, 1, 1],
        normalTexture=texture,
        extensions={"KHR_materials_transmission": {"transmissionFactor": 0.5}},
    )
    mesh = glb.square(material=material, TEXCOORD_0=np.eye(4)[:, :2], NORMAL=np.tile([0.0, 0, 1], (4, 1)))
    leaf = glb.node(top=False, mesh=mesh)
    eye = glb.node(
        top=False, camera=glb.add("cameras", type="perspective", perspective={"yfov": 1, "znear": 0.1})
    )
    cart = glb.node(children=[leaf, eye], name="cart")
    glb.animate({"node": cart, "path": "translation"}, [0, 1], [[0, 0, 0], [1, 0, 0]])
    glb.animate({"node": cart, "path": "rotation"}, [0, 1], [rotation([0, 1, 0], a) for a in (0.0, 1.0)])
    glb.node(extensions=glb.light(type="spot", spot={"innerConeAngle": 0.1, "outerConeAngle": 0.3}))
    return glb


WHOLE = whole()
FILE = WHOLE.bytes()


def loads_or_says(path):
    """Whether a file loads; if not, it must be said in one clear line."""
    try:
        load_scene(path)
    except InputError as error:
        text = str(error)
        assert str(path) in text
        assert len(text) < 2000
        return False
    return True


def test_the_whole_file_loads(tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(FILE)
    scene = load_scene(path)
    assert scene.frames == 26


@FUZZ
@given(cut=st.integers(0, len(FILE) - 1))
@example(cut=0)
@example(cut=12)
def test_a_file_that_is_cut_off_is_an_error(cut, tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(FILE[:cut])
    assert not loads_or_says(path)


@FUZZ
@given(
    changes=st.lists(st.tuples(st.integers(0, len(FILE) - 1), st.integers(0, 255)), min_size=1, max_size=8)
)
def test_flipped_bytes_load_or_are_an_error(changes, tmp_path):
    data = bytearray(FILE)
    for at, value in changes:
        data[at] = value
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    loads_or_says(path)


def places(value, at=()):
    """Paths of all values of a document."""
    yield at
    if isinstance(value, dict):
        for key, item in value.items():
            yield from places(item, (*at, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from places(item, (*at, index))


PLACES = [place for place in places(WHOLE.document | {"buffers": [{"byteLength": 1}]}) if place]
ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from(
        [0, 1, 2, 3, 5, 2**31 - 1, 2**32, 10**15, -1, 5121, 5126, "VEC3", "MAT4", "STEP", "CUBICSPLINE"]
    ),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.integers(0, 9), max_size=4),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
)


@FUZZ
@given(changes=st.lists(st.tuples(st.sampled_from(PLACES), ODD), min_size=1, max_size=3))
@example(changes=[(("accessors", 0, "count"), 10**15)])
@example(changes=[(("nodes", 2, "children"), [2])])
@example(changes=[(("nodes", 2, "children"), [0, 0])])
@example(changes=[(("nodes", 0, "children"), [2])])
@example(changes=[(("scene",), 7)])
@example(changes=[(("cameras", 0, "perspective", "yfov"), 1e-300)])
@example(changes=[(("nodes", 2, "scale"), [1e300, 1e300, 1e300])])
@example(changes=[(("nodes", 2, "scale"), [0, 0, 0])])
def test_wrong_values_in_the_document_load_or_are_an_error(changes, tmp_path):
    glb = copy.deepcopy(WHOLE)
    document = glb.document
    for place, value in changes:
        at = document
        try:
            for step in place[:-1]:
                at = at[step]
            at[place[-1]] = value
        except (KeyError, IndexError, TypeError):
            continue
    path = tmp_path / "a.glb"
    glb.write(path)
    loads_or_says(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not valid JSON"),
        ("[" * 200_000, "is not valid JSON"),
        ('{"asset": {"version": "1.0"}}', "is glTF 1.0"),
        ('{"asset": {}}', "asset.version: field required"),
        ('{"asset": {"version": "2.0"}, "nodes": 3}', "nodes ('3'): input should be a valid array"),
        (
            '{"asset": {"version": "2.0"}, "nodes": [{"mesh": 4}]}',
            "nodes[0].mesh: refers to meshes[4]; the file has 0",
        ),
        ('{"asset": {"version": "2.0"}}', "has no visible triangles"),
        ("\xff\xfe", "is not valid JSON"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(text, said, tmp_path):
    path = tmp_path / "a.gltf"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert said in str(caught.value)


@pytest.mark.parametrize("where", ["count", "sparse", "instances", "image", "draco"])
def test_huge_counts_take_no_memory(where, tmp_path):
    glb = Glb()
    glb.node(extensions=glb.light(type="point"))
    mesh = glb.square()
    glb.node(mesh=mesh)
    if where == "count":
        glb.document["accessors"][0]["count"] = 10**12
    elif where == "sparse":
        del glb.document["accessors"][0]["bufferView"]
        glb.document["accessors"][0]["count"] = 10**12
    elif where == "instances":
        zeros = glb.add("accessors", componentType=5126, count=10**11, type="VEC3")
        glb.node(mesh=mesh, extensions={"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": zeros}}})
    elif where == "image":
        header = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\x01\x86\xa0\x00\x01\x86\xa0\x08\x02\x00\x00\x00"
        import zlib

        header += zlib.crc32(header[12:]).to_bytes(4, "big")
        texture = glb.image(header + b"\x00" * 32)
        material = glb.add("materials", pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
        glb.node(mesh=glb.square(material=material, TEXCOORD_0=np.zeros((4, 2))))
    else:
        position = glb.add("accessors", componentType=5126, count=10**11, type="VEC3")
        draco = {"bufferView": glb.view(b"DRACO" + bytes(64)), "attributes": {"POSITION": 0}}
        primitive = {
            "attributes": {"POSITION": position},
            "extensions": {"KHR_draco_mesh_compression": draco},
        }
        glb.node(mesh=glb.add("meshes", primitives=[primitive]))
    path = glb.write(tmp_path / "a.glb")
    tracemalloc.start()
    try:
        with pytest.raises(SceneError):
            load_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_deep_trees_of_nodes_are_no_trouble(tmp_path):
    glb = Glb()
    glb.node(extensions=glb.light(type="point"))
    mesh = glb.square()
    below = glb.node(top=False, mesh=mesh)
    for _ in range(3000):
        below = glb.node(top=False, children=[below], mesh=mesh)
    glb.document["scenes"][0]["nodes"].append(below)
    assert loads_or_says(glb.write(tmp_path / "a.glb"))


def test_nan_is_refused(tmp_path):
    glb = copy.deepcopy(WHOLE)
    text = json.dumps(glb.document).replace('"yfov": 1', '"yfov": NaN')
    path = tmp_path / "a.gltf"
    path.write_text(text)
    with pytest.raises(SceneError, match=r"cameras\[0\].perspective.yfov"):
        load_scene(path)
