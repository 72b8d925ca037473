"""Settings of a render: what the user may choose, with defaults, units and checks, a module for each group.

Every option is declared here once, as a field with an `Option`: the command line, the functions `steadylight.plan` and
`steadylight.render`, and the checks follow. `Options` is what the user writes. `RenderSettings`, derived from it,
determines the bytes of the frames and is recorded in `run.json`. `ExecutionSettings` says where the work runs and does
not affect the result.
"""

from __future__ import annotations

from steadylight.settings.camera import CameraOptions, CameraSource, FrameRate
from steadylight.settings.display import DisplaySettings, Exposure, FramesAs, Tone
from steadylight.settings.machine import ExecutionSettings, MachineSettings, SimulationOptions, Variant
from steadylight.settings.method import (
    MOST_PIXELS,
    Bounces,
    Coverage,
    FirstPass,
    MethodSettings,
    Mode,
    Radii,
    RenderSettings,
    SolidPanes,
)
from steadylight.settings.option import (
    ANIMATION,
    DISPLAY,
    IMAGE,
    MACHINE,
    METHOD,
    PANELS,
    SCENE,
    SIMULATION,
    WALK,
    CheckedSettings,
    Option,
    option_name,
)
from steadylight.settings.options import Frames, Options
from steadylight.settings.scene import SKIES, UNITS, SceneOptions

__all__ = [
    "ANIMATION",
    "DISPLAY",
    "IMAGE",
    "MACHINE",
    "METHOD",
    "MOST_PIXELS",
    "PANELS",
    "SCENE",
    "SIMULATION",
    "SKIES",
    "UNITS",
    "WALK",
    "Bounces",
    "CameraOptions",
    "CameraSource",
    "CheckedSettings",
    "Coverage",
    "DisplaySettings",
    "ExecutionSettings",
    "Exposure",
    "FirstPass",
    "FrameRate",
    "Frames",
    "FramesAs",
    "MachineSettings",
    "MethodSettings",
    "Mode",
    "Option",
    "Options",
    "Radii",
    "RenderSettings",
    "SceneOptions",
    "SimulationOptions",
    "SolidPanes",
    "Tone",
    "Variant",
    "option_name",
]
