"""Options of `steadylight walk`: where to walk, and how."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field, PositiveFloat

from steadylight.errors import CameraError, SettingsError
from steadylight.settings import WALK, CheckedSettings, FrameRate, Option

if TYPE_CHECKING:
    from steadylight.camera.values import Vector  # loads NumPy, too slow for `--help`

AXES: Final = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Axes by the names that `--upright` takes."""


class WalkOptions(CheckedSettings):
    """How a person walks through a scene.

    Attributes:
        rooms: visit all rooms that are connected to the start.
        start: where such a tour begins; at the scene's own camera if None.
        upright: axis of the world that is up; that of the scene's own camera if None.
        eye: height of the eyes above the floor, metres.
        clearance: free space that the walk needs on either side, metres.
        speed: walking speed, m/s.
        look_ahead: metres along the path over which the direction of view is averaged.
        pitch: pitch of the view on level ground, degrees; negative looks down.
        fov: horizontal field of view, degrees; that of the scene's own camera if None.
        fps: frames per second; the scene's if None.
    """

    rooms: Annotated[bool, Option("Visit all rooms that are connected to the start.", WALK)] = False
    start: Annotated[str | None, Option("Where --rooms begins.", WALK, "X,Y,Z", "the scene's own camera")] = (
        None
    )
    upright: Annotated[
        str | None,
        Option("Up axis: x, y, z, -x, -y or -z.", WALK, "AXIS", "that of the scene's camera"),
    ] = None
    eye: Annotated[
        float, Field(gt=0.3, le=20), Option("Height of the eyes above the floor, metres.", WALK, "M")
    ] = 1.6
    clearance: Annotated[
        float,
        Field(ge=0.1, le=0.9),
        Option("Clearance that the walk must have on either side, metres.", WALK, "M"),
    ] = 0.25
    speed: Annotated[PositiveFloat, Field(le=20), Option("Walking speed, m/s.", WALK, "V")] = 1.0
    look_ahead: Annotated[
        float,
        Field(ge=0.1, le=20),
        Option("How far along the route the camera looks ahead, metres.", WALK, "M"),
    ] = 1.5
    pitch: Annotated[
        float, Field(gt=-60, lt=60), Option("Tilt of the view, degrees; negative looks down.", WALK, "DEG")
    ] = -3.0
    fov: Annotated[
        float | None,
        Field(gt=0, lt=180),
        Option("Horizontal field of view, degrees.", WALK, "DEG", "that of the scene's camera"),
    ] = None
    fps: Annotated[FrameRate | None, Option("Frames per second.", WALK, "F", "the scene's")] = None


def point_of(text: str, option: str) -> Vector:
    """A point from `x,y,z`.

    Raises:
        SettingsError: the text is not a point.
    """
    from steadylight.camera.rows import finite

    words = text.split(",")
    try:
        if len(words) == 3:
            x, y, z = (finite(word.strip(), option) for word in words)
            return x, y, z
    except CameraError as error:
        raise SettingsError(f"{option}: {text!r} is not a point: {error}") from None
    raise SettingsError(f"{option}: {text!r} is not a point; give x,y,z in metres, such as 1.5,-2,0")


def axis_of(name: str) -> Vector:
    """An axis of the world by its name.

    Raises:
        SettingsError: there is no axis of that name.
    """
    if name not in AXES:
        raise SettingsError(f"--upright: {name!r} is not valid; give {', '.join(AXES)}")
    return AXES[name]
