"""WHAT is rendered: every source becomes one plain, picklable, hashed scene description.

Readers of scene files live here, and the bundled animations, which are made by procedures.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.errors import SceneError, SettingsError

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription

BUNDLED = ("temple-walk", "temple-rotation", "gallery", "corridor", "furnace")
EXTENSIONS = {".xml": "Mitsuba", ".rad": "Radiance", ".oct": "Radiance octree"}
"""Of scene files, and what they are."""


def load_scene(name_or_path: str | Path, sky: str | Path | None = None) -> SceneDescription:
    """A scene by its bundled name, or from a file of Mitsuba (.xml) or Radiance (.rad, .oct).

    A bundled name wins over a file of the same name: write `./gallery` for the file.

    Args:
        name_or_path: of the scene.
        sky: a .rad file with sky and sun, for a scene in a .rad file.

    Raises:
        SceneError: there is no such scene, or its file is wrong.
        SettingsError: a sky for another scene.
    """
    name = str(name_or_path)
    suffix = "" if name in BUNDLED else Path(name).suffix.lower()
    if sky is not None and suffix != ".rad":
        raise SettingsError(
            f"--sky: {sky}: a sky is added to a scene in a .rad file, not to {name}; leave it out"
        )
    if name in BUNDLED:
        module = import_module(f"steadylight.scenes.{name.replace('-', '_')}")
        description: SceneDescription = module.describe()
        return description
    path = Path(name_or_path)
    if suffix == ".xml":
        from steadylight.scenes.mitsuba_xml import read_mitsuba_xml

        return read_mitsuba_xml(path)
    if suffix in EXTENSIONS:
        from steadylight.scenes.radiance import read_radiance

        return read_radiance(path, None if sky is None else Path(sky))
    raise SceneError(_unknown(name, path))


def _unknown(name: str, path: Path) -> str:
    """What is wrong with a name that is no scene, and what would be right."""
    kinds = ", ".join(f"{suffix} ({kind})" for suffix, kind in EXTENSIONS.items())
    known = f"bundled scenes: {', '.join(BUNDLED)}; scene files end in {kinds}"
    if path.is_file():
        return f"{name}: is not a kind of scene file that can be read; {known}"
    near = difflib.get_close_matches(name, BUNDLED, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ";"
    return f"{name}: no such scene{hint} {known}"
