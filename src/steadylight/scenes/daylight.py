"""Sun, sky and environment for any scene, from the options.

North is +y and east +x where z is up; where y is up, north is -z. Azimuth is measured from north towards east, as on a
compass. Photometric quantities become W at the scene's own rate: 179 lm/W in Radiance's scenes, 683 elsewhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SceneError
from steadylight.scenes.description import Deferred, Note, SceneDescription
from steadylight.scenes.image_texture import ENVIRONMENTS, check_environment
from steadylight.scenes.radiance.conversion import sky_entries
from steadylight.scenes.sun import Sun, overcast_zenith, sky_file, sun_of
from steadylight.scenes.world import LUMENS_PER_WATT, Z_UP
from steadylight.settings import SceneOptions

SUNSKY: Final = 683.0 * 106.857
"""Luminance, cd/m², for a radiance of 1 from Mitsuba's `sunsky`, which averages spectral radiance, W/(m² sr nm), over
the CIE's luminosity function, whose integral is 106.857 nm."""

TURBIDITY: Final = 3.0
"""Turbidity of a clear day."""

_ENVIRONMENTS = ("constant", "envmap", "sunsky")
_ROWS = 256
_COMPASS = np.diag([-1.0, -1.0, 1.0, 1.0]) @ Z_UP


def with_light(
    scene: SceneDescription,
    options: SceneOptions,
    lumens_per_watt: float | None = None,
    *,
    z_up: bool = True,
) -> SceneDescription:
    """A scene under the sun, sky or environment that the options ask for, in place of its own.

    Args:
        scene: a scene in format `mitsuba`.
        options: checked by `sun.check_options`.
        lumens_per_watt: rate of the scene's radiances; `world.LUMENS_PER_WATT` if None.
        z_up: whether z is up in the scene; otherwise y is.

    Raises:
        SceneError: a file cannot be read.
        BackendError: a Radiance sky needs pyradiance, which is not installed.
    """
    rate = LUMENS_PER_WATT if lumens_per_watt is None else lumens_per_watt
    notes: list[Note] = []
    files: dict[str, str] = {}
    up = np.eye(4) if z_up else Z_UP.T
    sun, file = sun_of(options), sky_file(options)
    if options.envmap is not None:
        entries, files = _picture(Path(options.envmap), options.envmap_rotation or 0.0, up)
    elif file is not None:
        entries, told = sky_entries(file, rate, up, anywhere=options.allow_outside)
        notes += told
    elif sun is not None:
        make = _overcast if options.sky == "overcast" else _clear
        entries = make(sun, rate, up)
        kind = options.sky or "clear"
        text = f"{kind} sky with the sun at azimuth {sun.azimuth:.1f}, altitude {sun.altitude:.1f} degrees"
        notes.append(Note("converted", "daylight", f"{text}; {rate:g} lm equal 1 W"))
    else:
        return scene
    content, told = _replaced(scene.content, entries)
    return replace(
        scene, content=content, files={**scene.files, **files}, notes=(*scene.notes, *notes, *told)
    )


def z_is_up(scene: SceneDescription) -> bool:
    """Whether z is up, not y, in the first view of the scene's camera."""
    up = np.abs(scene.camera.keyframes[0].up)
    return bool(up[2] >= up[1])


def _replaced(content: Mapping[str, Any], entries: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Note]]:
    """The content with its sun, sky and environment replaced, and notes on what was left out."""
    if isinstance(content, Deferred):  # a bundled scene, built when needed
        return Deferred(lambda: _replaced(dict(content), entries)[0]), []
    old = [name for name, entry in content.items() if _is_daylight(entry)]
    kept = {name: entry for name, entry in content.items() if name not in old}
    new = {f"daylight_{name}": entry for name, entry in entries.items()}
    notes = [Note("left out", name, "the file's daylight: replaced by the daylight given") for name in old]
    return kept | new, notes


def _is_daylight(entry: Any) -> bool:
    return isinstance(entry, Mapping) and entry.get("type") in (*_ENVIRONMENTS, "directional")


def _clear(sun: Sun, lumens_per_watt: float, up: NDArray[np.float64]) -> dict[str, Any]:
    """Mitsuba's sun and sky, in the scene's units."""
    scale = SUNSKY / lumens_per_watt
    sky = {"sun_scale": scale, "sky_scale": scale, "turbidity": TURBIDITY}
    direction = up[:3, :3] @ sun.direction
    return {"sunsky": {"type": "sunsky", "sun_direction": direction.tolist(), **sky, "to_world": up}}


def _overcast(sun: Sun, lumens_per_watt: float, up: NDArray[np.float64]) -> dict[str, Any]:
    """The CIE's overcast sky: three times as bright at the zenith as at the horizon, the same at all azimuths."""
    zenith = overcast_zenith(sun) / lumens_per_watt
    sine = np.cos((np.arange(_ROWS) + 0.5) / _ROWS * np.pi)
    rows = np.where(sine > 0, zenith * (1 + 2 * sine) / 3, 0.0)
    picture = np.broadcast_to(rows[:, None, None], (_ROWS, 2 * _ROWS, 3)).astype(np.float32)
    return {"overcast": {"type": "envmap", "data": picture, "to_world": up @ _COMPASS}}


def _picture(path: Path, rotation: float, up: NDArray[np.float64]) -> tuple[dict[str, Any], dict[str, str]]:
    """An environment map whose middle is `rotation` degrees east of north."""
    file = path.absolute()
    if file.suffix.lower() not in ENVIRONMENTS:
        raise SceneError(
            f"{file}: does not have the extension of an environment map; give a file that ends in "
            f"{', '.join(ENVIRONMENTS)}"
        )
    check_environment(file)
    try:
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {(error.strerror or str(error)).lower()}") from None
    angle = -np.radians(rotation)  # clockwise from above
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return {"envmap": {"type": "envmap", "filename": str(file), "to_world": up @ turn @ _COMPASS}}, {
        str(file): digest
    }
