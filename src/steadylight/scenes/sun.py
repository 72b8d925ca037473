"""The sun that the options ask for: its position, and whether the options for light are compatible.

Azimuth is measured from north towards east, as on a compass; north is +y where z is up.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from steadylight.errors import SettingsError
from steadylight.settings import SKIES, SceneOptions

OVERCAST: Final = (123.0, 8600.0)
"""Luminance of the zenith of an overcast sky, cd/m²: the first plus the second times the sine of the sun's altitude
(Krochmann and Seidl 1974)."""


@dataclass(frozen=True)
class Sun:
    """Position of the sun.

    Attributes:
        azimuth: degrees from north towards east.
        altitude: degrees above the horizon.
    """

    azimuth: float
    altitude: float

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector towards the sun, with z up, (3,)."""
        azimuth, altitude = np.radians(self.azimuth), np.radians(self.altitude)
        across = np.cos(altitude)
        return np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.sin(altitude)])


def sky_file(options: SceneOptions) -> Path | None:
    """The Radiance file that gives the sky, if there is one."""
    return None if options.sky is None or options.sky in SKIES else Path(options.sky).absolute()


def sun_of(options: SceneOptions) -> Sun | None:
    """The sun that the options ask for.

    Raises:
        SettingsError: the options are not valid or not compatible, or the sun has set.
    """
    if options.sun is not None and (options.place is not None or options.time is not None):
        raise SettingsError("--sun: the sun already follows from --place and --time; give one or the other")
    if options.sun is not None:
        azimuth, altitude = _pair("--sun", options.sun, "AZIMUTH,ALTITUDE in degrees, such as 180,45")
        if not 0 < altitude <= 90:
            raise SettingsError(
                f"--sun: the altitude is {altitude:g} degrees; give one above the horizon, up to 90"
            )
        return Sun(azimuth % 360, altitude)
    if options.place is None and options.time is None:
        return None
    if options.place is None or options.time is None:
        given, missing = ("--time", "--place LAT,LON") if options.place is None else ("--place", "--time ISO")
        raise SettingsError(f"{given}: the sun's position needs {missing}, too")
    latitude, longitude = _pair(
        "--place", options.place, "LAT,LON in degrees, north and east positive, such as 48.1,11.6"
    )
    if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
        raise SettingsError(
            f"--place: {options.place!r} is not on Earth; latitude is -90 to 90, longitude -180 to 180"
        )
    return _sun_at(latitude, longitude, options.time)


def _sun_at(latitude: float, longitude: float, time: str) -> Sun:
    right = "a date and time with its offset from UTC, such as 2026-06-21T12:00+02:00 or 2026-06-21T10:00Z"
    try:
        moment = datetime.fromisoformat(time.strip())
    except ValueError:
        raise SettingsError(f"--time: {time!r} is not valid; give {right}") from None
    if moment.tzinfo is None:
        raise SettingsError(f"--time: {time!r} has no time zone; give {right}")
    from astral import Observer
    from astral.sun import azimuth, elevation

    observer = Observer(latitude, longitude)
    sun = Sun(float(azimuth(observer, moment)), float(elevation(observer, moment)))
    if sun.altitude <= 0:
        raise SettingsError(
            f"--time: the sun is below the horizon of {latitude:g},{longitude:g} at {moment.isoformat()} (altitude "
            f"{sun.altitude:.1f} degrees); give a time when the sun is up"
        )
    return sun


def _pair(option: str, text: str, right: str) -> tuple[float, float]:
    try:
        first, second = (float(word) for word in str(text).split(","))
    except ValueError:
        first = second = np.nan
    if not np.isfinite([first, second]).all():
        raise SettingsError(f"{option}: {text!r} is not valid; give {right}")
    return first, second


def check_options(options: SceneOptions) -> None:
    """Check that the options for light are compatible.

    Raises:
        SettingsError: they are not.
    """
    sun = sun_of(options)
    if options.envmap is None and options.envmap_rotation is not None:
        raise SettingsError("--envmap-rotation: rotates the image of --envmap, which is missing")
    if options.envmap is not None and (sun is not None or options.sky is not None):
        raise SettingsError("--envmap: an environment map replaces sun and sky; give one or the other")
    if sky_file(options) is not None and sun is not None:
        raise SettingsError("--sky: a file has its own sun; leave out --sun, --place and --time")
    if options.sky in SKIES and sun is None:
        raise SettingsError(
            f"--sky: {options.sky} needs the sun: give --sun AZIMUTH,ALTITUDE, or --place LAT,LON and --time ISO"
        )


def overcast_zenith(sun: Sun) -> float:
    """Luminance of the zenith under clouds, cd/m²."""
    return float(OVERCAST[0] + OVERCAST[1] * np.sin(np.radians(sun.altitude)))
