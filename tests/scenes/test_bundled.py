"""Scenes are found by their bundled name or their file; anything else is refused with what would be right."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest

from steadylight import scenes
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import SceneError
from steadylight.scenes.description import SceneDescription


def test_a_bundled_name_describes_its_module(monkeypatch):
    made = SceneDescription("corridor", {}, CameraPath((Keyframe(0, (0, 0, 0), (0, 1, 0)),)))
    module = ModuleType("steadylight.scenes.temple_walk")
    module.describe = lambda: made
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert scenes.load_scene("temple-walk") is made


@pytest.mark.parametrize("name", scenes.BUNDLED)
def test_every_bundled_scene_carries_its_own_name_and_a_line_about_it(name):
    description = scenes.load_scene(name)
    assert description.name == name
    assert description.about
    assert "\n" not in description.about
    assert description.camera.frame_count(description.fps) >= description.frames


@pytest.mark.parametrize("name", scenes.BUNDLED)
def test_a_bundled_scene_is_built_only_when_its_content_is_read(name):
    description = scenes.load_scene(name)
    assert "_content" not in vars(description.content)
    content = description.content["type"]
    assert content == "scene"
    assert "_content" in vars(description.content)


def test_an_unknown_name_lists_the_scenes_and_suggests_one():
    with pytest.raises(SceneError) as caught:
        scenes.load_scene("galery")
    message = str(caught.value)
    assert message.startswith("galery: no such scene; did you mean `gallery`?")
    assert "temple-walk, temple-rotation, gallery, corridor, furnace" in message
    assert ".xml" in message


def test_another_kind_of_file_is_refused_with_the_kinds_that_can_be_read(tmp_path):
    file = tmp_path / "chair.skp"
    file.write_text("solid")
    with pytest.raises(SceneError, match=r"chair\.skp: is not a supported scene file;.*\.xml"):
        scenes.load_scene(file)
