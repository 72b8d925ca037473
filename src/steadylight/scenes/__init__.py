"""Scenes: every source becomes a plain, picklable scene description with a hash.

Contains the readers of scene files and the procedural bundled animations.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from steadylight.errors import SceneError, SettingsError
from steadylight.scenes.bundled import BUNDLED
from steadylight.settings import SceneOptions, option_name

if TYPE_CHECKING:
    from steadylight.scenes.description import SceneDescription


@dataclass(frozen=True)
class Reader:
    """How a format of scene files is read.

    Attributes:
        format: its name for people.
        module: of this package, whose function `read(path, options)` gives the description for the Mitsuba renderer;
            imported when needed.
        options: names of those `SceneOptions` that have a meaning in this format.
        modules: the same for renderers that read other descriptions, by `SceneDescription.format`.
    """

    format: str
    module: str
    options: frozenset[str] = frozenset()
    modules: Mapping[str, str] = field(default_factory=dict)

    def module_for(self, formats: Sequence[str]) -> str:
        """The module for a renderer that reads such descriptions, the first of them best."""
        known = {**self.modules, "mitsuba": self.module}
        return next((known[name] for name in formats if name in known), self.module)


READERS: Final[Mapping[str, Reader]] = {
    ".xml": Reader(
        "Mitsuba", "mitsuba_xml", frozenset({"sensor", "parameters", "allow_outside", "skip_missing"})
    ),
    ".gltf": Reader("glTF", "gltf", frozenset({"sensor"})),
    ".glb": Reader("glTF, binary", "gltf", frozenset({"sensor"})),
    ".rad": Reader("Radiance", "radiance.conversion", frozenset({"sky"}), {"radiance": "radiance.octree"}),
    ".oct": Reader("Radiance octree", "radiance.conversion", modules={"radiance": "radiance.octree"}),
    **dict.fromkeys(
        (".usd", ".usda", ".usdc", ".usdz"),
        Reader("USD", "usd.isolation", frozenset({"sensor", "allow_outside"})),
    ),
}
"""Formats of scene files, by file extension."""


def load_scene(
    name_or_path: str | Path, *, formats: Sequence[str] = ("mitsuba",), **options: Any
) -> SceneDescription:
    """Load a bundled scene, or a scene file of one of the formats in `READERS`.

    A bundled name takes precedence over a file of the same name: write `./gallery` for the file.

    Args:
        name_or_path: of the scene.
        formats: of descriptions that are wanted, the best first: what a renderer reads (`Capabilities.scenes`).
        options: see `settings.SceneOptions`.

    Raises:
        SceneError: there is no such scene, or its file is not valid.
        SettingsError: an option is not valid, or has no meaning in this format.
    """
    return read_scene(name_or_path, SceneOptions.checked(**options), formats)


def read_scene(
    name_or_path: str | Path, options: SceneOptions, formats: Sequence[str] = ("mitsuba",)
) -> SceneDescription:
    """Implementation of `load_scene`."""
    name = str(name_or_path)
    reader = None if name in BUNDLED else READERS.get(Path(name).suffix.lower())
    if name in BUNDLED or reader is not None:
        _check_options(name, options, frozenset() if reader is None else reader.options)
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
    if reader is None:
        raise SceneError(_unknown(name, path))
    home = f"steadylight.scenes.{reader.module_for(formats)}"
    read: SceneDescription = import_module(home).read(path, options)
    return read


LIGHTS: Final = ("sun", "sky", "envmap")
"""Options that light a scene, as far as `SceneOptions` has them."""


def light_options(description: SceneDescription) -> list[str]:
    """Options that would give light to a scene, as typed; none for a bundled one or a description of one's own."""
    reader = READERS.get(Path(description.about).suffix.lower())
    known = frozenset() if reader is None else reader.options
    return [option_name(name) for name in LIGHTS if name in known]


def without_light(description: SceneDescription) -> str:
    """Error message for a scene without light, with what would give it some."""
    options = [f"{option} ..." for option in light_options(description)]
    remedy = f"give it light by {' or '.join(options)}, or add" if options else "add"
    where = description.about if Path(description.about).is_file() else f"scene {description.name}"
    return f"{where}: has no emitter, so that every frame would be black; {remedy} a lamp to it"


def _check_options(name: str, options: SceneOptions, allowed: frozenset[str]) -> None:
    """Reject options without a meaning for this scene."""
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
