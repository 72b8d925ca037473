"""Reads USD files (`.usd`, `.usda`, `.usdc`, `.usdz`) in a separate process."""

from __future__ import annotations

from pathlib import Path

from steadylight.errors import SceneError
from steadylight.scenes.apart import TIME_LIMIT, Reading, read_apart
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.usd.request import Request
from steadylight.settings import SceneOptions


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a USD file.

    Args:
        path: path of the file.
        options: `sensor`: a camera by its path, name or number; `allow_outside`: whether files outside the scene's
            folder may be read.

    Raises:
        SceneError: the message names the file, the prim, and the fault.
        SettingsError: there is no such camera.
    """
    path = Path(path).absolute()
    if not path.is_file():
        raise SceneError(f"{path}: no such scene file")
    try:
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    sensor = None if options.sensor is None else str(options.sensor)
    return read_stage(Request(path, sensor, outside=bool(options.allow_outside)))


def read_stage(request: Request, time_limit: float = TIME_LIMIT) -> SceneDescription:
    """The scene of a USD file; see `read`."""
    return read_apart(Reading(request.path, "USD", __name__, request), time_limit)


def described(request: Request) -> SceneDescription:
    """The scene of a USD file; runs in the separate process, which may import USD."""
    from pxr import Tf

    from steadylight.scenes.usd.reading import describe
    from steadylight.scenes.usd.stage import explain

    try:
        return describe(request)
    except Tf.ErrorException as error:
        raise SceneError(f"{request.path}: USD cannot read it: {explain(error)}") from None
    except TypeError as error:
        # USD returns an attribute with its declared type, even if its schema requires another one.
        raise SceneError(
            f"{request.path}: an attribute does not have the type that USD prescribes ({error})"
        ) from None
