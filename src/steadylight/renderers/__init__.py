"""The renderers, by name: Mitsuba and Radiance here, others through the entry points `steadylight.renderers`.

`base` is all that the rest of the package knows of them.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from steadylight.errors import SettingsError

if TYPE_CHECKING:
    from steadylight.renderers.base import Renderer

GROUP = "steadylight.renderers"


def renderer_names() -> list[str]:
    """Names that `find_renderer` knows, in alphabetical order."""
    return sorted({entry.name for entry in entry_points(group=GROUP)})


def find_renderer(name: str) -> Renderer:
    """The renderer of that name.

    Raises:
        SettingsError: there is none.
    """
    for entry in entry_points(group=GROUP, name=name):
        renderer: Renderer = entry.load()
        return renderer
    raise SettingsError(f"--renderer: there is no {name!r}; installed: {', '.join(renderer_names())}")
