"""Radiance's distant sources: skies become an environment map, suns discs in it or parallel light.

A sky with patterns is evaluated with Radiance's own `rtrace`, so that every pattern has its values. Radiances are kept
unchanged: luminance is Radiance's, 179 lm/W.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import RunError, SceneError
from steadylight.scenes.environment import SIZE, Sun, texels_of, with_suns
from steadylight.scenes.radiance.grammar import VOID, Primitive, text_of
from steadylight.scenes.radiance.materials import LIGHTS, RGB, Tell, material_of
from steadylight.scenes.radiance.modifiers import Surface, renamed
from steadylight.scenes.radiance.programs import output_of
from steadylight.scenes.radiance.surfaces import fault
from steadylight.scenes.world import Z_UP

Floats = NDArray[np.float64]

SUN: Final = 5.0
"""Maximum angle of a sun, degrees across: a disc in the environment map, or parallel light if it is too narrow."""

LONGEST: Final = 600.0
"""Maximum time to evaluate a sky or a pattern, seconds: mixtures of mixtures may never end."""


@dataclass(frozen=True)
class Source:
    """A distant source.

    Attributes:
        surface: primitive and modifiers.
        direction: (3,) unit vector towards it.
        angle: angle across, degrees, at most 360.
        radiance: radiance without patterns, RGB.
    """

    surface: Surface
    direction: Floats
    angle: float
    radiance: RGB

    @property
    def patterned(self) -> bool:
        """Whether a pattern changes it."""
        return self.surface.modifier is not None and self.surface.modifier.below is not None

    @property
    def solid_angle(self) -> float:
        """Solid angle, steradians."""
        return float(2 * np.pi * (1 - np.cos(np.radians(self.angle) / 2)))


def sources_of(surfaces: Sequence[Surface], tell: Tell) -> list[Source]:
    """The distant sources among the surfaces that emit light."""
    found = []
    for surface in surfaces:
        given, modifier = surface.primitive, surface.modifier
        if given.kind != "source":
            continue
        if len(given.numbers) != 4:
            raise fault(given, f"has {len(given.numbers)} numbers where 4 are expected")
        direction, angle = np.array(given.numbers[:3], np.float64), given.numbers[3]
        length = float(np.linalg.norm(direction))
        if not length > 0 or angle <= 0:
            raise fault(given, "has no direction, or no angle above 0")
        if modifier is None or modifier.primitive.kind not in LIGHTS:
            tell("left out", given.name, "a distant source that emits no light")
            continue
        radiance = material_of(modifier.primitive, tell).radiance
        assert radiance is not None
        found.append(Source(surface, direction / length, min(angle, 360.0), radiance))
    return found


def emitters_of(sources: Sequence[Source], folder: Path, tell: Tell) -> dict[str, Any]:
    """Entries of a scene description: an environment for skies and wide suns, and parallel light for other suns.

    Args:
        sources: distant sources of the scene.
        folder: folder of the scene, where functions and pictures are searched.
        tell: receives notes.
    """
    skies = [source for source in sources if source.angle > SUN]
    entries: dict[str, Any] = {}
    if skies and max(max(source.radiance) for source in skies) > 0:
        entries["sky"] = _environment(skies, folder, tell)
    suns = [_sun(source, folder) for source in sources if source.angle <= SUN and max(source.radiance) > 0]
    sky, narrow = with_suns(entries.get("sky"), suns)
    if sky is not None:
        entries["sky"] = sky
    for number, sun in enumerate(narrow, 1):
        entries["sun" if number == 1 else f"sun_{number}"] = sun.parallel
        tell(
            "converted", sun.name, f"a sun of {sun.angle:g} degrees becomes parallel light: shadows are sharp"
        )
    for sun in suns:
        if sun not in narrow:
            tell("converted", sun.name, f"a sun of {sun.angle:g} degrees becomes a disc in the environment")
    return entries


def _sun(source: Source, folder: Path) -> Sun:
    """A source as a sun."""
    radiance = np.array(source.radiance)
    if source.patterned:
        radiance = looked_at([source], source.direction[None, :], folder)[0]
    name = source.surface.primitive.name
    return Sun(name, source.direction, source.angle, radiance * source.solid_angle)


def _environment(skies: Sequence[Source], folder: Path, tell: Tell) -> dict[str, Any]:
    names = ", ".join(source.surface.primitive.name for source in skies)
    if len(skies) == 1 and skies[0].angle >= 360 and not skies[0].patterned:
        return {"type": "constant", "radiance": {"type": "rgb", "value": list(skies[0].radiance)}}
    width, height = SIZE
    tell("converted", names, f"the sky becomes an environment map of {width}x{height} texels")
    directions = directions_of(width, height)
    if any(source.patterned for source in skies):
        seen = looked_at(skies, directions, folder)
    else:
        seen = _plain(skies, directions)
    picture = seen.reshape(height, width, 3).astype(np.float32)
    if not np.isfinite(picture).all() or (picture < 0).any():
        raise SceneError(f"sky ({names}): has radiance that is negative or not finite")
    return {"type": "envmap", "data": picture, "to_world": Z_UP}


def directions_of(width: int, height: int) -> Floats:
    """Directions of the texels of an environment turned by `Z_UP`, (H W, 3), row by row from the zenith."""
    directions, _ = texels_of(width, height)
    return np.asarray(directions.reshape(-1, 3) @ Z_UP[:3, :3].T)


def _plain(skies: Sequence[Source], directions: Floats) -> Floats:
    """Radiance of sources without patterns, (N, 3); where they overlap, the narrowest one counts, as in Radiance."""
    seen = np.zeros((len(directions), 3))
    for source in sorted(skies, key=lambda each: -each.angle):
        within = directions @ source.direction >= np.cos(np.radians(source.angle) / 2) - 1e-9
        seen[within] = source.radiance
    return seen


def looked_at(sources: Sequence[Source], directions: Floats, folder: Path) -> Floats:
    """Radiance of sources in given directions, (N, 3), evaluated with `rtrace`.

    Raises:
        SceneError: Radiance rejects them.
        BackendError: pyradiance is not installed.
    """
    modifiers = [source.surface.modifier for source in sources]
    lines, names = renamed(
        each for modifier in modifiers if modifier is not None for each in modifier.chain()
    )
    for number, (source, modifier) in enumerate(zip(sources, modifiers, strict=True)):
        top = VOID if modifier is None else names[modifier]
        lines.append(Primitive(top, "source", f"s{number}", (), source.surface.primitive.numbers))
    return traced(lines, np.zeros_like(directions), directions, folder)


def traced(primitives: Sequence[Primitive], origins: Floats, directions: Floats, folder: Path) -> Floats:
    """Radiance along rays, (N, 3), from `rtrace`, without reflections.

    Raises:
        SceneError: Radiance rejects the primitives.
        BackendError: pyradiance is not installed.
    """
    rays = np.hstack([origins, directions]).astype("<f4")
    try:
        with TemporaryDirectory(prefix="steadylight-") as place:
            octree = Path(place) / "looked-at.oct"
            octree.write_bytes(
                output_of(
                    folder, "oconv", "-w", "-f", "-", given=text_of(primitives).encode(), seconds=LONGEST
                )
            )
            words = ("-h", "-w", "-fff", "-ab", 0, "-dv+", "-lr", 4)
            data = output_of(folder, "rtrace", *words, octree, given=rays.tobytes(), seconds=LONGEST)
    except RunError as error:
        raise SceneError(f"Radiance cannot show its light or patterns: {error}") from error
    return np.frombuffer(data, "<f4").reshape(-1, 3).astype(np.float64)
