"""IFC building models: geometry in metres, and the colours of their styles."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from steadylight.errors import SceneError
from steadylight.scenes import load_scene

pytestmark = pytest.mark.skipif(find_spec("ifcopenshell") is None, reason="ifcopenshell is not installed")

WALL = """ISO-10303-21;
HEADER;FILE_DESCRIPTION((''),'2;1');FILE_NAME('','',(''),(''),'','','');FILE_SCHEMA(('IFC4'));ENDSEC;
DATA;
#1=IFCSIUNIT(*,.LENGTHUNIT.,.MILLI.,.METRE.);
#2=IFCUNITASSIGNMENT((#1));
#3=IFCCARTESIANPOINT((0.,0.,0.));
#4=IFCAXIS2PLACEMENT3D(#3,$,$);
#5=IFCGEOMETRICREPRESENTATIONCONTEXT($,'Model',3,1.E-05,#4,$);
#6=IFCPROJECT('0000000000000000000001',$,'P',$,$,$,$,(#5),#2);
#7=IFCLOCALPLACEMENT($,#4);
#8=IFCCARTESIANPOINT((2500.,100.));
#9=IFCAXIS2PLACEMENT2D(#8,$);
#10=IFCRECTANGLEPROFILEDEF(.AREA.,$,#9,5000.,200.);
#11=IFCDIRECTION((0.,0.,1.));
#12=IFCEXTRUDEDAREASOLID(#10,#4,#11,3000.);
#13=IFCSHAPEREPRESENTATION(#5,'Body','SweptSolid',(#12));
#14=IFCPRODUCTDEFINITIONSHAPE($,$,(#13));
#15=IFCWALL('0000000000000000000002',$,'W',$,$,#7,#14,$,$);
#16=IFCCOLOURRGB($,0.6,0.3,0.2);
#17=IFCSURFACESTYLESHADING(#16,TRANSPARENCY);
#18=IFCSURFACESTYLE('brick',.BOTH.,(#17));
#19=IFCSTYLEDITEM(#12,(#18),$);
ENDSEC;
END-ISO-10303-21;
"""


@pytest.fixture
def scene_of(tmp_path):
    """Reads a wall of 5 x 0.2 x 3 m."""

    def read(transparency="0.", east=0):
        text = WALL.replace("TRANSPARENCY", transparency).replace("((0.,0.,0.))", f"(({east}.,0.,0.))")
        (tmp_path / "wall.ifc").write_text(text)
        return load_scene(tmp_path / "wall.ifc", sun="180,40")

    return read


def test_a_model_in_the_coordinates_of_a_map_is_moved_to_the_origin_and_that_is_said(scene_of):
    for east, moved in ((10_000, False), (345_678_000, True)):
        scene = scene_of(east=east)
        (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
        assert (abs(mesh["vertices"][:, 0]).max() < 10) == moved
        assert any("moved by" in note.text for note in scene.notes) == moved


def test_a_wall_in_millimetres_is_one_in_metres_with_its_colour(scene_of):
    scene = scene_of()
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert mesh["vertices"].max(axis=0) == pytest.approx([5, 0.2, 3])
    bsdf = scene.content[mesh["bsdf"]["id"]]["bsdf"]
    assert bsdf["reflectance"]["value"] == pytest.approx([0.6, 0.3, 0.2])
    assert any("5 x 0.2 x 3 m" in note.text for note in scene.notes)
    assert scene.content["daylight_sunsky"]["type"] == "sunsky"
    assert scene.hash == scene_of().hash


def test_what_is_transparent_is_a_pane(scene_of):
    scene = scene_of("1.")
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    assert scene.content[mesh["bsdf"]["id"]]["type"] == "thindielectric"


def test_what_a_pane_does_not_let_through_has_its_colour(scene_of):
    scene = scene_of("0.75")
    (mesh,) = (entry for entry in scene.content.values() if entry["type"] == "triangles")
    pane = scene.content[mesh["bsdf"]["id"]]
    assert (pane["type"], pane["weight"]) == ("blendbsdf", 0.75)
    assert pane["first"]["diffuse_reflectance"]["value"] == pytest.approx([0.6, 0.3, 0.2])
    assert "specular_transmittance" not in pane["second"]


def test_a_library_that_crashes_takes_nothing_with_it(tmp_path, monkeypatch):
    # As damaged files have made it do: the other process dies of a signal.
    (tmp_path / "ifcopenshell.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    (tmp_path / "wall.ifc").write_text(WALL)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        SceneError, match=r"wall.ifc: IfcOpenShell cannot read it \(its library crashed: SIGSEGV"
    ):
        load_scene(tmp_path / "wall.ifc")


def test_damaged_files_are_refused_with_their_name(tmp_path):
    for text in (
        "",
        "ISO-10303-21;",
        WALL[:600],
        WALL.split("#15", maxsplit=1)[0] + "ENDSEC;\nEND-ISO-10303-21;\n",
    ):
        (tmp_path / "bad.ifc").write_text(text)
        with pytest.raises(SceneError, match=r"bad\.ifc"):
            load_scene(tmp_path / "bad.ifc")
