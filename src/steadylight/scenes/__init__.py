"""Scenes: every source becomes a plain, picklable scene description with a hash.

Contains the readers of scene files and the procedural bundled animations.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes.bundled import BUNDLED
from steadylight.scenes.downloads import lacking
from steadylight.settings import SKIES, SceneOptions, option_name

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription


@dataclass(frozen=True)
class Reader:
    """How a format of scene files is read.

    Attributes:
        format: name of the format, to show.
        module: module of this package whose function `read(path, options)` makes the description for the Mitsuba
            renderer; imported when needed.
        options: names of the `SceneOptions` that apply to this format.
        modules: modules for renderers that read other descriptions, by `SceneDescription.format`.
        lumens_per_watt: of the radiances in the description; `world.LUMENS_PER_WATT` if None.
        z_up: whether z is always up; otherwise up is the up axis of the scene's first view.
    """

    format: str
    module: str
    options: frozenset[str] = frozenset()
    modules: Mapping[str, str] = field(default_factory=dict)
    lumens_per_watt: float | None = None
    z_up: bool = True

    def module_for(self, formats: Sequence[str]) -> str:
        """The module for a renderer that reads descriptions of these formats, in order of preference."""
        known = {**self.modules, "mitsuba": self.module}
        return next((known[name] for name in formats if name in known), self.module)


LIGHT: Final = frozenset({"sky", "sun", "place", "time", "envmap", "envmap_rotation"})
"""Options that light a scene of any format; see `daylight`."""

_RADIANCE = Reader(
    "Radiance",
    "radiance.conversion",
    frozenset({"sky", "allow_outside"}),
    {"radiance": "radiance.octree"},
    lumens_per_watt=179.0,
)

_MESHES = Reader("OBJ mesh", "models", frozenset({"unit", "up", "allow_outside"}))

READERS: Final[Mapping[str, Reader]] = {
    ".xml": Reader(
        "Mitsuba",
        "mitsuba_xml",
        frozenset({"sensor", "parameters", "allow_outside"}),
        z_up=False,
    ),
    ".gltf": Reader("glTF", "gltf", frozenset({"sensor", "allow_outside"})),
    ".glb": Reader("glTF, binary", "gltf", frozenset({"sensor", "allow_outside"})),
    ".rad": _RADIANCE,
    ".oct": replace(_RADIANCE, format="Radiance octree", options=frozenset({"allow_outside"})),
    ".obj": _MESHES,
    ".ply": replace(_MESHES, format="PLY mesh"),
    ".stl": replace(_MESHES, format="STL mesh"),
    ".ifc": Reader("IFC", "ifc"),
    **dict.fromkeys(
        (".usd", ".usda", ".usdc", ".usdz"),
        Reader("USD", "usd.isolation", frozenset({"sensor", "allow_outside"})),
    ),
    ".blend": Reader("Blender", "blender", frozenset({"sensor", "allow_outside"})),
}
"""Formats of scene files, by file extension."""


def load_scene(
    name_or_path: str | Path, *, formats: Sequence[str] = ("mitsuba",), **options: Any
) -> SceneDescription:
    """Load a bundled scene, or a scene file of one of the formats in `READERS`.

    A bundled name takes precedence over a file of the same name: write `./gallery` for the file.

    Args:
        name_or_path: name of a bundled scene, or path of a scene file.
        formats: accepted formats of the description, the preferred one first; see `Capabilities.scenes`.
        options: see `settings.SceneOptions`.

    Raises:
        SceneError: there is no such scene, or its file is not valid.
        SettingsError: an option is not valid, or does not apply to this format.
    """
    return read_scene(name_or_path, SceneOptions.checked(**options), formats)


def read_scene(
    name_or_path: str | Path, options: SceneOptions, formats: Sequence[str] = ("mitsuba",)
) -> SceneDescription:
    """Implementation of `load_scene`."""
    name = str(name_or_path)
    reader = None if name in BUNDLED else READERS.get(Path(name).suffix.lower())
    if LIGHT & options.given.keys():
        from steadylight.scenes.sun import check_options

        check_options(options)
    if name in BUNDLED or reader is not None:
        _check_options(name, options, LIGHT if reader is None else LIGHT | reader.options)
    if name in BUNDLED:
        module = import_module(f"steadylight.scenes.{name.replace('-', '_')}")
        bundled: SceneDescription = module.describe()
        return _lit(bundled, options, None)
    path = Path(name_or_path)
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        raise SceneError(
            f"{path}: its name, or that of its folder, is not valid UTF-8, which the libraries that read scenes "
            "require; rename it"
        ) from None
    if reader is None:
        raise SceneError(_unknown(name, path))
    wrong = lacking(path, may_be_empty=True)
    if wrong is not None:
        raise SceneError(f"{path}: the scene {wrong}")
    home = f"steadylight.scenes.{reader.module_for(formats)}"
    read: SceneDescription = import_module(home).read(path, options)
    if "sky" in reader.options and options.sky not in SKIES:  # the scene includes it already
        options = options.model_copy(update={"sky": None})
    return _lit(read, options, reader)


def _lit(scene: SceneDescription, options: SceneOptions, reader: Reader | None) -> SceneDescription:
    """A scene with the light that the options ask for."""
    if scene.format != "mitsuba" or not LIGHT & options.given.keys():
        return scene
    from steadylight.scenes.daylight import with_light, z_is_up

    if reader is None:
        return with_light(scene, options)
    return with_light(scene, options, reader.lumens_per_watt, z_up=reader.z_up or z_is_up(scene))


def without_light(description: SceneDescription) -> str:
    """Error message for a scene without light, with ways to add some."""
    where = description.about if Path(description.about).is_file() else f"scene {description.name}"
    return (
        f"{where}: has no emitter, so that every frame would be black; add light with --sun AZIMUTH,ALTITUDE, with "
        "--place LAT,LON --time ISO, with --sky FILE (Radiance) or with --envmap FILE (.exr, .hdr, .pfm), or add a "
        "lamp to the scene"
    )


def _check_options(name: str, options: SceneOptions, allowed: frozenset[str]) -> None:
    """Reject options that do not apply to this scene."""
    for option, value in options.given.items():
        if option not in allowed:
            those = ", ".join(suffix for suffix, reader in READERS.items() if option in reader.options)
            raise SettingsError(
                f"{option_name(option)}: {value}: only for {those} scenes, not for {name}; leave it out"
            )


def _unknown(name: str, path: Path) -> str:
    """Error message for an unknown scene name."""
    kinds = ", ".join(f"{suffix} ({kind.format})" for suffix, kind in READERS.items())
    known = f"bundled scenes: {', '.join(BUNDLED)}; scene files end in {kinds}"
    if path.is_file():
        return f"{name}: is not a supported scene file; {known}"
    near = difflib.get_close_matches(name, BUNDLED, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ";"
    return f"{name}: no such scene{hint} {known}"
