"""Flicker-free, physically based walkthrough animations with a shared irradiance cache.

```python
import steadylight as sl

run = sl.render("gallery", frames=12, size=(512, 288))
print(run.video, run.statistics["makespan_s"])
```

The public names are those of `__all__`. Each is loaded on first use, so that importing the package is fast and
needs no renderer.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from steadylight.animation.request import Request as Request
    from steadylight.animation.request import prepare as plan
    from steadylight.animation.run import Run as Run
    from steadylight.animation.run import Session as Session
    from steadylight.camera import CameraPath as CameraPath
    from steadylight.camera import Keyframe as Keyframe
    from steadylight.camera import load_camera as load_camera
    from steadylight.errors import InputError as InputError
    from steadylight.errors import RunError as RunError
    from steadylight.errors import SteadylightError as SteadylightError
    from steadylight.interactive import render as render
    from steadylight.metrics.compare import compare_runs as compare
    from steadylight.renderers.mitsuba.backend import use_variant as use_variant
    from steadylight.report import write_report as write_report
    from steadylight.scenes import load_scene as load_scene
    from steadylight.scenes.description import SceneDescription as SceneDescription
    from steadylight.settings import ExecutionSettings as ExecutionSettings
    from steadylight.settings import RenderSettings as RenderSettings

_HOMES = {
    "CameraPath": "steadylight.camera",
    "ExecutionSettings": "steadylight.settings",
    "InputError": "steadylight.errors",
    "Keyframe": "steadylight.camera",
    "RenderSettings": "steadylight.settings",
    "Request": "steadylight.animation.request",
    "Run": "steadylight.animation.run",
    "RunError": "steadylight.errors",
    "SceneDescription": "steadylight.scenes.description",
    "Session": "steadylight.animation.run",
    "SteadylightError": "steadylight.errors",
    "compare": "steadylight.metrics.compare:compare_runs",
    "load_camera": "steadylight.camera",
    "load_scene": "steadylight.scenes",
    "plan": "steadylight.animation.request:prepare",
    "render": "steadylight.interactive",
    "use_variant": "steadylight.renderers.mitsuba.backend",
    "write_report": "steadylight.report",
}

__all__ = [
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


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name == "__version__":
        from importlib.metadata import version

        return version("steadylight")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home, _, other = _HOMES[name].partition(":")
    return getattr(importlib.import_module(home), other or name)


def __dir__() -> list[str]:
    return sorted(__all__)
