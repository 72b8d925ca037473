"""Scenes: every source becomes a plain, picklable scene description with a hash.

Contains the readers of scene files and the procedural bundled animations.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes.bundled import BUNDLED

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription

EXTENSIONS = {".xml": "Mitsuba", ".rad": "Radiance", ".oct": "Radiance octree"}
"""File extensions of scene files, and their formats."""


def load_scene(
    name_or_path: str | Path, sky: str | Path | None = None, sensor: str | None = None
) -> SceneDescription:
    """Load a bundled scene, or a scene file of Mitsuba (.xml) or Radiance (.rad, .oct).

    A bundled name takes precedence over a file of the same name: write `./gallery` for the file.

    Args:
        name_or_path: of the scene.
        sky: a .rad file with sky and sun, for a .rad scene.
        sensor: id or number, from 1, of the sensor of an .xml scene; its first if None.

    Raises:
        SceneError: there is no such scene, or its file is not valid.
        SettingsError: a sky or a sensor is given for another kind of scene, or there is no such sensor.
    """
    name = str(name_or_path)
    suffix = "" if name in BUNDLED else Path(name).suffix.lower()
    if sky is not None and suffix != ".rad":
        raise SettingsError(f"--sky: {sky}: only for .rad scenes, not for {name}; leave it out")
    if sensor is not None and suffix != ".xml":
        raise SettingsError(f"--sensor: {sensor}: only for .xml scenes, not for {name}; leave it out")
    if name in BUNDLED:
        module = import_module(f"steadylight.scenes.{name.replace('-', '_')}")
        description: SceneDescription = module.describe()
        return description
    path = Path(name_or_path)
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise SceneError(
            f"{path}: its name, or that of its folder, is not UTF-8, as the libraries that read scenes need; rename it"
        ) from None
    if suffix == ".xml":
        from steadylight.scenes.mitsuba_xml import read_mitsuba_xml

        return read_mitsuba_xml(path, sensor)
    if suffix in EXTENSIONS:
        from steadylight.scenes.radiance import read_radiance

        return read_radiance(path, None if sky is None else Path(sky))
    raise SceneError(_unknown(name, path))


def _unknown(name: str, path: Path) -> str:
    """Error message for an unknown scene name."""
    kinds = ", ".join(f"{suffix} ({kind})" for suffix, kind in EXTENSIONS.items())
    known = f"bundled scenes: {', '.join(BUNDLED)}; scene files end in {kinds}"
    if path.is_file():
        return f"{name}: is not a supported scene file; {known}"
    near = difflib.get_close_matches(name, BUNDLED, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ";"
    return f"{name}: no such scene{hint} {known}"
