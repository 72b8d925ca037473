"""Options that belong to a scene file: light, units, camera, parameters."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, ConfigDict, Field, SkipValidation

from steadylight.settings.option import SCENE, CheckedSettings, Option

SKIES: Final = ("clear", "overcast")
"""Words that `--sky` takes instead of a file."""


UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length that `--unit` takes, in metres."""


def checked_parameters(value: object) -> object:
    """A mapping of names to text, also from `name=value` items; raises a ValueError for anything else."""
    if isinstance(value, Mapping):
        return {str(name): str(item) for name, item in value.items()}
    pairs = [str(item).partition("=") for item in (value if isinstance(value, list | tuple) else [value])]
    if not all(re.fullmatch(r"\w+", name) and sign for name, sign, _ in pairs):
        raise ValueError("give name=value")
    return {name: item for name, _, item in pairs}


class SceneOptions(CheckedSettings):
    """Options that belong to a scene file; `scenes.READERS` says which format takes which of them.

    Attributes:
        sky: a Radiance file with sky and sun, or `clear` or `overcast` for a sky with the given sun.
        sun: azimuth (from north towards east) and altitude, degrees; `daylight` says where north is.
        place: latitude and longitude, degrees, north and east positive.
        time: date and time (ISO 8601) with offset from UTC, which together with `place` gives the sun.
        envmap: latitude-longitude picture of the environment, as EXR, HDR or PFM.
        envmap_rotation: azimuth of the middle of `envmap`, degrees; north if None.
        unit: unit of length of a mesh file, whose format has none; guessed from its size if None.
        up: up axis of a mesh file, whose format has none; the usual one if None.
        sensor: id or name of a sensor or camera of the scene, or its number, counted from 1; the first if None.
        parameters: values for an .xml scene's parameters, by name, instead of its defaults; `name=value` items are
            accepted too.
        allow_outside: whether a scene may refer to files outside its folder.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    sky: Annotated[
        SkipValidation[str | Path | None],
        Option(
            "Radiance file with sky and sun. With the sun given: clear or overcast.",
            SCENE,
            "FILE|clear|overcast",
            "none",
        ),
    ] = None
    sun: Annotated[
        str | None,
        Option(
            "Sun and clear sky: azimuth (0 north, 90 east) and altitude of the sun, degrees.",
            SCENE,
            "AZIMUTH,ALTITUDE",
            "none",
        ),
    ] = None
    place: Annotated[
        str | None,
        Option(
            "Sun and clear sky at a place: degrees north and east. Needs --time.", SCENE, "LAT,LON", "none"
        ),
    ] = None
    time: Annotated[
        str | None,
        Option("Time for --place, such as 2026-06-21T12:00+02:00.", SCENE, "ISO", "none"),
    ] = None
    envmap: Annotated[
        SkipValidation[str | Path | None],
        Option("Environment map (latitude-longitude; .exr, .hdr, .pfm).", SCENE, "FILE", "none"),
    ] = None
    envmap_rotation: Annotated[
        float | None,
        Field(allow_inf_nan=False),
        Option("Azimuth of the middle of --envmap, degrees from north towards east.", SCENE, "DEGREES", "0"),
    ] = None
    unit: Annotated[
        Literal["m", "cm", "mm", "in", "ft"] | None,
        Option("Unit of length of an .obj, .ply or .stl scene.", SCENE, "m|cm|mm|in|ft", "by its size"),
    ] = None
    up: Annotated[
        Literal["y", "z"] | None,
        Option("Up axis of an .obj, .ply or .stl scene.", SCENE, "y|z", "y in .obj, z otherwise"),
    ] = None
    sensor: Annotated[
        SkipValidation[str | int | None],
        Option(
            "Sensor or camera of the scene, by id or name, or by number from 1.", SCENE, "ID|N", "the first"
        ),
    ] = None

    parameters: Annotated[
        Mapping[str, str],
        BeforeValidator(checked_parameters),
        Option(
            "Value of a parameter of an .xml scene, instead of its default; may be repeated.",
            SCENE,
            "NAME=VALUE",
            "the scene's own",
            names=("-D",),
        ),
    ] = {}
    allow_outside: Annotated[
        bool, Option("Let a scene refer to files outside its folder.", SCENE, shown="no")
    ] = False

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {name: value for name, value in self if value}
