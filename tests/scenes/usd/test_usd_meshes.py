"""Meshes, basic shapes and copies of USD stages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from usd_stages import read, texts

from steadylight.errors import SceneError


def mesh(points, counts, indices, *lines, name="M", head=""):
    numbers = ", ".join(f"({x}, {y}, {z})" for x, y, z in points)
    return "\n".join(
        [
            f'def Mesh "{name}" {head} {{',
            'uniform token subdivisionScheme = "none"',
            f"point3f[] points = [{numbers}]",
            f"int[] faceVertexCounts = {counts}",
            f"int[] faceVertexIndices = {indices}",
            *lines,
            "}",
        ]
    )


SQUARE = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))


def crosses(entry):
    """Normals of the triangles, twice as long as their areas."""
    a, b, c = (entry["vertices"][entry["faces"][:, i]].astype(float) for i in range(3))
    return np.cross(b - a, c - a)


def area(entry):
    return float(np.linalg.norm(crosses(entry), axis=1).sum() / 2)


def volume(entry):
    """Positive if its triangles face outward."""
    a, b, c = (entry["vertices"][entry["faces"][:, i]].astype(float) for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def test_a_concave_polygon_is_split_within_its_outline(tmp_path):
    points = ((0, 0, 0), (3, 0, 0), (3, 1, 0), (1, 1, 0), (1, 3, 0), (0, 3, 0))
    entry = read(tmp_path, mesh(points, [6], [0, 1, 2, 3, 4, 5])).content["M"]
    assert len(entry["faces"]) == 4
    assert area(entry) == pytest.approx(5)
    assert (crosses(entry)[:, 2] > 0).all()


def test_a_concave_quadrilateral_is_split_at_its_inner_corner(tmp_path):
    points = ((0, 0, 0), (1, 0.2, 0), (2, 0, 0), (1, 2, 0))
    for first in range(4):
        turned = [(first + i) % 4 for i in range(4)]
        entry = read(tmp_path, mesh(points, [4], turned), name=f"{first}.usda").content["M"]
        assert (crosses(entry)[:, 2] > 0).all()
        assert area(entry) == pytest.approx(2 * 2 / 2 - 2 * 0.2 / 2)


def test_a_left_handed_mesh_faces_the_other_way(tmp_path):
    entry = read(
        tmp_path, mesh(SQUARE, [4], [0, 1, 2, 3], 'uniform token orientation = "leftHanded"')
    ).content["M"]
    assert (crosses(entry)[:, 2] < 0).all()


def test_holes_are_left_open(tmp_path):
    entry = read(tmp_path, mesh(SQUARE, [3, 3], [0, 1, 2, 0, 2, 3], "int[] holeIndices = [1]")).content["M"]
    assert area(entry) == pytest.approx(0.5)


def test_texture_coordinates_of_corners_run_down_from_the_top_of_the_image(tmp_path):
    st = 'texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")'
    entry = read(tmp_path, mesh(SQUARE, [4], [0, 1, 2, 3], st)).content["M"]
    corner = {
        tuple(vertex[:2]): tuple(uv)
        for vertex, uv in zip(entry["vertices"].tolist(), entry["uv"].tolist(), strict=True)
    }
    assert corner == {(0, 0): (0, 1), (1, 0): (1, 1), (1, 1): (1, 0), (0, 1): (0, 0)}


def test_corners_that_are_alike_become_one_vertex(tmp_path):
    points = [(x, y, 0) for y in range(3) for x in range(3)]
    faces = [corner + step for corner in (0, 1, 3, 4) for step in (0, 1, 4, 3)]
    st = ", ".join(str((x % 3 / 2, y / 2)) for y in range(3) for x in range(3))
    indexed = f'texCoord2f[] primvars:st = [{st}] (interpolation = "faceVarying")\nint[] primvars:st:indices = {faces}'
    assert len(read(tmp_path, mesh(points, [4] * 4, faces, indexed)).content["M"]["vertices"]) == 9


@pytest.mark.parametrize("kind", ["constant", "uniform", "vertex", "faceVarying"])
def test_normals_of_every_interpolation_are_taken(tmp_path, kind):
    count = {"constant": 1, "uniform": 1, "vertex": 4, "faceVarying": 4}[kind]
    normals = f'normal3f[] normals = [{", ".join(["(0, 0, 2)"] * count)}] (interpolation = "{kind}")'
    entry = read(tmp_path, mesh(SQUARE, [4], [0, 1, 2, 3], normals)).content["M"]
    assert entry["normals"].tolist() == [[0, 0, 1]] * 4


def test_a_mirrored_object_keeps_its_outside(tmp_path):
    cube = (
        'def Cube "C" { float3 xformOp:scale = (-1, 2, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"] }'
    )
    assert volume(read(tmp_path, cube).content["C"]) == pytest.approx(16)


SHAPES = {
    "Cube": ("double size = 3", 27),
    "Sphere": ("double radius = 2", 4 / 3 * math.pi * 8),
    "Cylinder": ("double radius = 1\ndouble height = 3", 3 * math.pi),
    "Cone": ("double radius = 1\ndouble height = 3", math.pi),
    "Capsule": ("double radius = 1\ndouble height = 3", 3 * math.pi + 4 / 3 * math.pi),
}


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize("kind", SHAPES)
def test_a_basic_shape_has_its_volume_and_lies_along_its_axis(tmp_path, kind, axis):
    lines, expected = SHAPES[kind]
    turn = "" if kind in ("Cube", "Sphere") else f'uniform token axis = "{axis}"'
    entry = read(tmp_path, f'def {kind} "S" {{\n{lines}\n{turn}\n}}').content["S"]
    assert volume(entry) == pytest.approx(expected, rel=4e-3)
    if turn:
        assert np.ptp(entry["vertices"], axis=0).argmax() == "XYZ".index(axis)
    if "normals" in entry:
        facets = crosses(entry)
        shading = entry["normals"][entry["faces"]].sum(axis=1)
        assert ((facets * shading).sum(axis=1) > 0).all()


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_a_plane_faces_along_its_axis(tmp_path, axis):
    entry = read(
        tmp_path, f'def Plane "P" {{\ndouble width = 2\ndouble length = 3\nuniform token axis = "{axis}"\n}}'
    ).content["P"]
    assert area(entry) == pytest.approx(6)
    assert (crosses(entry)[:, "XYZ".index(axis)] > 0).all()


def test_subsets_have_materials_of_their_own(tmp_path):
    body = """
def Material "Red" { token outputs:surface.connect = </Red/S.outputs:surface>
  def Shader "S" { uniform token info:id = "UsdPreviewSurface"
    color3f inputs:diffuseColor = (1, 0, 0)
    token outputs:surface } }
"""
    subset = """
def GeomSubset "half" (prepend apiSchemas = ["MaterialBindingAPI"]) {
  uniform token elementType = "face"
  uniform token familyName = "materialBind"
  int[] indices = [1]
  rel material:binding = </Red>
}"""
    found = read(tmp_path, body + mesh(SQUARE, [3, 3], [0, 1, 2, 0, 2, 3], subset)).content
    assert area(found["M"]) == area(found["M/half"]) == pytest.approx(0.5)
    assert found["M/half"]["bsdf"]["id"] == "material Red"
    assert found["M"]["bsdf"]["id"] == "material without a material"


def test_subdivision_is_left_out_with_a_note(tmp_path):
    body = mesh(SQUARE, [4], [0, 1, 2, 3]).replace('"none"', '"catmullClark"')
    assert "subdivision" in texts(read(tmp_path, body))


def test_colours_of_vertices_are_kept(tmp_path):
    each = "[(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]"
    colours = f'color3f[] primvars:displayColor = {each} (interpolation = "vertex")'
    found = read(tmp_path, mesh(SQUARE, [4], [0, 1, 2, 3], colours)).content
    assert found["M"]["colors"].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    assert found["material without a material"]["bsdf"]["reflectance"]["type"] == "mesh_attribute"


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        (mesh(SQUARE, [4], [0, 1, 2, 9]), "refers to point 9, but there are 4 points"),
        (mesh(SQUARE, [4], [0, 1, 2]), "3 corners, but its polygons need 4"),
        (
            mesh(SQUARE, [4], [0, 1, 2, 3]).replace("int[] faceVertexI", "odd[] faceVertexI"),
            "does not have the type that USD prescribes",
        ),
        (mesh(((0, 0, 0), (1, 0, "inf"), (1, 1, 0)), [3], [0, 1, 2]), "not finite"),
        (
            mesh(SQUARE, [4], [0, 1, 2, 3], 'normal3f[] normals = [(0, 0, 1)] (interpolation = "vertex")'),
            "1 values of normals",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_the_name_of_the_mesh(tmp_path, body, fault):
    with pytest.raises(SceneError, match=fault) as error:
        read(tmp_path, body)
    assert "/M: " in str(error.value)


INSTANCES = """
class "Chair" { def Mesh "Seat" {
  uniform token subdivisionScheme = "none"
  point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
  int[] faceVertexCounts = [4]
  int[] faceVertexIndices = [0, 1, 2, 3] } }
def Xform "A" (instanceable = true
  references = </Chair>) { double3 xformOp:translate = (5, 0, 0)
  uniform token[] xformOpOrder = ["xformOp:translate"] }
def Xform "B" (instanceable = true
  references = </Chair>) { double3 xformOp:translate = (0, 7, 0)
  uniform token[] xformOpOrder = ["xformOp:translate"] }
"""


def test_copies_of_few_triangles_are_meshes_of_their_own(tmp_path):
    found = read(tmp_path, INSTANCES).content
    assert not any(entry["type"] in ("shapegroup", "instance") for entry in found.values())
    corner = {name: entry["vertices"][0].tolist() for name, entry in found.items() if "vertices" in entry}
    assert corner == {"A/Seat": [5, 0, 0], "B/Seat": [0, 7, 0]}


@pytest.fixture
def always_instanced(monkeypatch):
    monkeypatch.setattr("steadylight.scenes.usd.reading.WORTH_INSTANCING", 1)


@pytest.mark.usefixtures("always_instanced")
def test_instances_share_their_meshes(tmp_path):
    found = read(tmp_path, INSTANCES).content
    groups = [entry for entry in found.values() if entry["type"] == "shapegroup"]
    copies = {name: entry for name, entry in found.items() if entry["type"] == "instance"}
    assert len(groups) == 1
    corner = {
        name: (entry["to_world"] @ np.append(groups[0]["Seat"]["vertices"][0], 1))[:3].round(9).tolist()
        for name, entry in copies.items()
    }
    assert corner == {"A": [5, 0, 0], "B": [0, 7, 0]}


@pytest.mark.parametrize("worth", [1, 20_000])
def test_a_view_from_outside_sees_all_instances(tmp_path, monkeypatch, worth):
    monkeypatch.setattr("steadylight.scenes.usd.reading.WORTH_INSTANCING", worth)
    from_outside = read(tmp_path, INSTANCES).camera.keyframes[0]
    assert np.linalg.norm(np.subtract(from_outside.origin, (3, 4, 0))) > 6


@pytest.mark.usefixtures("always_instanced")
def test_a_point_instancer_places_its_prototypes(tmp_path):
    body = """
def PointInstancer "Trees" {
  rel prototypes = [</Trees/Protos/Cube>, </Trees/Protos/Ball>]
  int[] protoIndices = [0, 1, 0, 0]
  point3f[] positions = [(10, 0, 0), (20, 0, 0), (30, 0, 0), (40, 0, 0)]
  quath[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0), (0.7071, 0, 0, 0.7071), (1, 0, 0, 0)]
  float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1), (1, 1, 1)]
  int64[] invisibleIds = [3]
  def Scope "Protos" { def Cube "Cube" { double3 xformOp:translate = (1, 0, 0)
      uniform token[] xformOpOrder = ["xformOp:translate"] }
    def Sphere "Ball" { double radius = 1 } }
}"""
    found = read(tmp_path, body).content
    copies = {name: entry for name, entry in found.items() if entry["type"] == "instance"}
    group = next(entry for entry in found.values() if entry["type"] == "shapegroup")
    middle = group["Cube"]["vertices"].mean(axis=0)
    places = [(entry["to_world"] @ np.append(middle, 1))[:3] for entry in copies.values()]
    np.testing.assert_allclose(places, [(11, 0, 0), (30, 1, 0)], atol=2e-3)
    ball = found["Trees/1/Ball"]["vertices"]
    np.testing.assert_allclose([ball.min(axis=0), ball.max(axis=0)], [(18, -2, -2), (22, 2, 2)], atol=1e-4)


def test_instances_that_shine_are_shapes_of_their_own(tmp_path):
    shining = INSTANCES.replace(
        'def Mesh "Seat" {', 'def Mesh "Seat" (prepend apiSchemas = ["MeshLightAPI"]) {'
    )
    found = read(tmp_path, shining).content
    assert [name for name, entry in found.items() if "emitter" in entry] == ["A/Seat", "B/Seat"]


def test_what_is_hidden_or_only_a_guide_is_not_there(tmp_path):
    body = """
def Xform "Off" { token visibility = "invisible"
  def Cube "Inner" {} }
def Cube "Guide" { uniform token purpose = "guide" }
def Cube "Proxy" { uniform token purpose = "proxy" }
def Cube "Render" { uniform token purpose = "render" }
def BasisCurves "Hair" {}
"""
    found = read(tmp_path, body)
    assert [name for name in found.content if not name.startswith("material")] == ["Render"]
    assert "left out: /Hair: BasisCurves" in texts(found)


def test_what_moves_stands_still_with_a_note(tmp_path):
    body = """
def Xform "Door" { double3 xformOp:translate.timeSamples = { 1: (0, 0, 0), 2: (1, 0, 0) }
  uniform token[] xformOpOrder = ["xformOp:translate"]
  def Cube "Leaf" {} }"""
    assert "left out: /Door/Leaf: its motion" in texts(read(tmp_path, body))
