"""WHAT is rendered: every source becomes one plain, picklable, hashed scene description."""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.errors import SceneError

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription

BUNDLED = ("temple-walk", "temple-rotation", "gallery", "corridor", "furnace")
EXTENSIONS = (".xml",)


def load_scene(name_or_path: str | Path) -> SceneDescription:
    """A scene by its bundled name, or from a Mitsuba XML file.

    A bundled name wins over a file of the same name: write `./gallery` for the file.

    Raises:
        SceneError: there is no such scene, or its file is wrong.
    """
    name = str(name_or_path)
    if name in BUNDLED:
        module = import_module(f"steadylight.scenes.{name.replace('-', '_')}")
        description: SceneDescription = module.describe()
        return description
    path = Path(name_or_path)
    if path.suffix.lower() in EXTENSIONS:
        from steadylight.scenes.mitsuba_xml import read_mitsuba_xml

        return read_mitsuba_xml(path)
    raise SceneError(_unknown(name, path))


def _unknown(name: str, path: Path) -> str:
    """What is wrong with a name that is no scene, and what would be right."""
    known = f"bundled scenes: {', '.join(BUNDLED)}; scene files end in {', '.join(EXTENSIONS)} (Mitsuba)"
    if path.is_file():
        return f"{name}: is not a kind of scene file that can be read; {known}"
    near = difflib.get_close_matches(name, BUNDLED, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ";"
    return f"{name}: no such scene{hint} {known}"
