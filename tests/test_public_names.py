"""What users may rely on: the names of the package, and that they are what they say."""

from __future__ import annotations

import inspect

import pytest

import steadylight

NAMES = [
    "CameraPath",
    "ExecutionSettings",
    "InputError",
    "Keyframe",
    "RenderSettings",
    "Request",
    "Run",
    "RunError",
    "SceneDescription",
    "Session",
    "SteadylightError",
    "__version__",
    "compare",
    "load_camera",
    "load_scene",
    "plan",
    "render",
    "use_variant",
    "write_report",
]

RENDER_OPTIONS = {
    "camera": None,
    "first_frame": None,
    "orbit": None,
    "sky": None,
    "sun": None,
    "place": None,
    "time": None,
    "envmap": None,
    "envmap_rotation": None,
    "unit": None,
    "up": None,
    "sensor": None,
    "parameters": {},
    "allow_outside": False,
    "frames": None,
    "size": None,
    "fps": None,
    "aovs": False,
    "spp": 16,
    "quality": 1.0,
    "mode": "two-pass",
    "first_pass": None,
    "selected_frames": "auto",
    "threshold": 10.0,
    "base_rays": 128,
    "bounces": "auto",
    "radii": "occlusion-hessian",
    "panes": "refract",
    "coverage": "full",
    "cache_parts": "auto",
    "denoise": False,
    "seed": 0,
    "exposure": "auto",
    "tone": "srgb",
    "frames_as": "exr",
    "video_crf": 17,
    "output": None,
    "workers": 1,
    "cluster": "local",
    "site": None,
    "variant": "auto",
    "renderer": "mitsuba",
}


def test_the_public_names_are_these():
    assert steadylight.__all__ == NAMES
    assert dir(steadylight) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there_and_documented(name):
    value = getattr(steadylight, name)
    assert isinstance(value, str) or inspect.getdoc(value)


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = steadylight.nonsense


@pytest.mark.parametrize("function", ["render", "plan"])
def test_render_and_plan_take_these_options_with_the_papers_defaults(function):
    parameters = inspect.signature(getattr(steadylight, function)).parameters
    assert {name: p.default for name, p in parameters.items() if name != "scene"} == RENDER_OPTIONS
