"""Materials of Wavefront OBJ files (MTL) as surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple

from steadylight.errors import SceneError
from steadylight.scenes.downloads import lacking
from steadylight.scenes.file_names import named
from steadylight.scenes.surface import Number, Surface, Texture, Tint

Tell = Callable[[Literal["converted", "approximated", "left out", "warning"], str, str], None]

GLASS: Final = frozenset({4, 6, 7, 9})
"""Illumination models with refraction, or with transparency and reflection."""

_MAP_OPTIONS = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-mm": 2,
    "-texres": 1,
    "-clamp": 1,
    "-bm": 1,
    "-imfchan": 1,
    "-type": 1,
    "-cc": 1,
}
_VECTORS = ("-o", "-s", "-t")

_READ = frozenset(
    {
        *("ka", "kd", "ks", "ke", "ns", "d", "tr", "tf", "ni", "illum", "pr", "pm"),
        *("map_ka", "map_kd", "map_ke", "map_d"),
    }
)
"""Supported statements; those on ambient light have no effect, since there is none."""

_LEFT_OUT = {
    "map_bump": "bump map",
    "bump": "bump map",
    "norm": "normal map",
    "disp": "displacement",
    "map_ks": "specular map",
    "map_ns": "roughness map",
    "map_pr": "roughness map",
    "map_pm": "metallic map",
    "refl": "reflection map",
    "ps": "sheen",
    "pc": "clear coat",
}

Values = dict[str, list[str]]


class Place(NamedTuple):
    """Where pictures are searched: the folder of a scene, and whether files outside are allowed."""

    folder: Path
    anywhere: bool = False

    def within(self, name: str, user: str) -> Path:
        """The file that a name refers to, whether or not it exists.

        Raises:
            SceneError: it lies outside the folder; the message names its `user`.
        """
        file = named(self.folder, name).resolve()
        if not self.anywhere and not file.is_relative_to(self.folder.resolve()):
            raise SceneError(
                f"{user}: {name} lies outside {self.folder}; copy it there, or give --allow-outside"
            )
        return file

    def file(self, name: str, user: str) -> Path:
        """The file that the name of a picture refers to.

        Raises:
            SceneError: it lies outside the folder, or does not exist; the message names its `user`.
        """
        try:
            file = self.within(name, user)
            there = file.is_file()
        except (OSError, ValueError) as error:
            raise SceneError(f"{user} needs {name[:80]!r}, which is not a valid file name: {error}") from None
        if not there:
            raise SceneError(f"{user} needs {name}; no such file in {self.folder}")
        wrong = lacking(file)
        if wrong is not None:
            raise SceneError(f"{user}: {name} {wrong}")
        return file


def read_mtl(text: str, source: str) -> dict[str, Values]:
    """The statements of each material in a file, by lower-case name."""
    found: dict[str, Values] = {}
    current: Values | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0].lower() == "newmtl":
            current = found.setdefault(line.split(None, 1)[1].strip() if len(words) > 1 else "", {})
        elif current is None:
            raise SceneError(f"{source}: line {number}: `{words[0]}` appears before the first `newmtl NAME`")
        else:
            current[words[0].lower()] = words[1:]
    return found


def surface_of(name: str, values: Values, place: Place, tell: Tell) -> Surface:
    """A material of an MTL file as a surface.

    Args:
        name: name of the material.
        values: statements of the material.
        place: where its pictures are.
        tell: receives notes.

    Raises:
        SceneError: a number is not valid, or a picture is missing.
    """
    read = _Reader(name, values, place, tell)
    model = int(read.number("illum", 2))
    opacity = read.number("d", 1 - read.number("tr", 0.0))
    glass = model in GLASS and opacity < 1
    specular = read.colour("ks", (0.0, 0.0, 0.0))
    rough: Number = math.sqrt(math.sqrt(2 / (2 + max(read.number("ns", 0.0), 0.0))))
    metallic = read.number("pm", 0.0)
    shiny = any(specular) and model >= 2
    if glass:
        rough = 0.0
    if "pr" in values:
        rough, shiny = read.number("pr", 0.5), True
    for key in sorted(values.keys() - _READ):
        tell("left out", f"material {name}", _LEFT_OUT.get(key, f"`{key}`"))
    opacities = read.texture("map_d", srgb=False)
    return Surface(
        name,
        base_color=read.tint("kd", "map_kd", (0.5, 0.5, 0.5)),
        metallic=metallic,
        roughness=rough,
        ior=max(read.number("ni", 1.5), 1.0) if shiny or glass else 1.0,
        transmission=1 - opacity if glass else 0.0,
        transmission_color=read.colour("tf", (1.0, 1.0, 1.0)),
        emission=read.tint("ke", "map_ke", (0.0, 0.0, 0.0)),
        opacity=opacities if opacities is not None else 1.0 if glass else opacity,
    )


class _Reader:
    """Reads the statements of one material."""

    def __init__(self, name: str, values: Values, place: Place, tell: Tell) -> None:
        self.name, self.values, self.tell = name, values, tell
        self.place = place

    def number(self, key: str, default: float) -> float:
        words = self.values.get(key)
        if not words:
            return default
        word = words[-1] if words[0] == "-halo" else words[0]
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise SceneError(f"material {self.name}: `{key} {' '.join(words)[:40]}` is not a number")
        return number

    def colour(self, key: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
        words = self.values.get(key)
        if not words:
            return default
        if words[0] in ("spectral", "xyz"):
            self.tell("left out", f"material {self.name}", f"{key} as {words[0]}: the default colour is used")
            return default
        channels = [self.number_of(key, word) for word in words[:3]]
        channels = channels * 3 if len(channels) == 1 else channels
        if len(channels) != 3:
            raise SceneError(f"material {self.name}: `{key}` has {len(channels)} numbers; a colour has three")
        if key != "ke" and max(channels) > 1:
            self.tell("warning", f"material {self.name}", f"{key} is above 1; it is clipped to 1")
            channels = [min(channel, 1.0) for channel in channels]
        red, green, blue = channels
        return red, green, blue

    def number_of(self, key: str, word: str) -> float:
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or number < 0:
            raise SceneError(f"material {self.name}: `{key} {word[:40]}` is not a number of at least 0")
        return number

    def tint(self, key: str, picture: str, default: tuple[float, float, float]) -> Tint:
        """A colour, or its picture times the colour."""
        colour = self.colour(key, (1.0, 1.0, 1.0) if picture in self.values else default)
        texture = self.texture(picture, srgb=True, gain=colour if any(colour) else (1.0, 1.0, 1.0))
        return colour if texture is None else texture

    def texture(
        self, key: str, *, srgb: bool, gain: tuple[float, float, float] | None = None
    ) -> Texture | None:
        words = list(self.values.get(key, ()))
        while words and words[0].startswith("-"):
            option = words.pop(0)
            count = _MAP_OPTIONS.get(option, 0)
            if option in _VECTORS:
                count = next((i for i, word in enumerate(words[:3]) if not _is_number(word)), 3)
                self.tell(
                    "left out", f"material {self.name}", f"{key} {option}: the image is not transformed"
                )
            del words[:count]
        if not words:
            return None
        file = self.place.file(" ".join(words), f"material {self.name}: {key}")
        channels = "rgb" if srgb else "r"
        return Texture(str(file), channels=channels, srgb=srgb, gain=1.0 if gain is None else gain)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def names_of(materials: Mapping[str, Values]) -> str:
    """A file with the names of these materials and nothing else, for readers that need one."""
    return "".join(f"newmtl {name}\nKd 0.5 0.5 0.5\n" for name in materials)
