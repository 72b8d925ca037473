"""Read Radiance's scene files for its own programs: `.rad` text and `.oct` octrees become one frozen octree.

Scenes are not rescaled: the camera path uses the same unit of length as the scene. A scene file has
no camera. A view file with the same stem (`office.vf` next to `office.rad`) gives the default camera; without one,
the camera sees the whole scene from outside, as for Mitsuba's files.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from steadylight.errors import RunError, SceneError, SettingsError
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance.commands import Expansion
from steadylight.scenes.radiance.conversion import LUMENS_PER_WATT
from steadylight.scenes.radiance.grammar import Primitive, text_of
from steadylight.scenes.radiance.instances import refuse_commands
from steadylight.scenes.radiance.modifiers import surfaces_of
from steadylight.scenes.radiance.programs import output_of
from steadylight.scenes.radiance.view import view_of
from steadylight.scenes.sun import overcast_zenith, sky_file, sun_of
from steadylight.settings import SceneOptions

_WORD = re.compile(rb"[!-~]{3,255}")


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a Radiance scene file or octree.

    Args:
        path: a `.rad` file, whose commands (see `commands.PROGRAMS`) are run, or an `.oct` octree.
        options: `sky`: a `.rad` file that is added to the scene, such as one with the sky.

    Raises:
        BackendError: pyradiance is not installed.
        SceneError: a file cannot be read, or Radiance rejects it.
    """
    path = Path(path).absolute()
    _check_light(path, options)
    sky = sky_file(options)
    for file in (path, sky):
        if file is not None and not file.is_file():
            raise SceneError(f"{file}: no such scene file")
    folder = path.parent
    is_octree = path.suffix.lower() == ".oct"
    if is_octree:
        refuse_commands(path)
    primitives = []
    for file in () if is_octree else (sky, path):
        primitives += [] if file is None else Expansion.of(file, anywhere=options.allow_outside).file(file)
    primitives += _daylight(path, options)
    try:
        what = ("-i", path) if is_octree else ("-",)
        octree = output_of(folder, "oconv", "-f", "-w", *what, given=text_of(primitives).encode())
        with TemporaryDirectory(prefix="steadylight-") as place:
            written = Path(place) / "scene.oct"
            written.write_bytes(octree)
            *corner, side = (float(word) for word in output_of(folder, "getinfo", "-d", written).split()[-4:])
    except RunError as error:
        raise SceneError(f"{path}: {error}") from error
    glow = is_octree or _has_glowing_sky(primitives)
    low = np.array(corner)
    files = _files_of(octree, [folder, *([sky.parent] if sky else [])])
    for file in files.values():
        if file.suffix.lower() == ".oct":  # of instances
            refuse_commands(file)
    return SceneDescription(
        name=path.stem,
        content={
            "octree": np.frombuffer(octree, np.uint8),
            "files": {name: str(file) for name, file in files.items()},
            "sky": glow,
        },
        files={str(file): _digest(file) for file in files.values()},
        about=str(path),
        format="radiance",
        **view_of(path, low, low + side),
    )


def _check_light(path: Path, options: SceneOptions) -> None:
    """Refuse light that cannot be added.

    Raises:
        SettingsError: see there.
    """
    if options.envmap is not None:
        raise SettingsError(
            "--envmap: not available with --renderer radiance for Radiance scenes; give --sky FILE"
        )
    if path.suffix.lower() == ".oct" and (options.sky is not None or sun_of(options) is not None):
        raise SettingsError(
            f"--sky, --sun, --place: {path} is an octree, which takes no more light; give its .rad file"
        )


def _daylight(path: Path, options: SceneOptions) -> list[Primitive]:
    """Sun and sky of Radiance's own model, where only the sun is given."""
    sun = sun_of(options)
    if sun is None:
        return []
    # Radiance counts azimuth from south over west.
    words = f"gensky -ang {sun.altitude!r} {sun.azimuth - 180!r}"
    overcast = options.sky == "overcast"
    kind = f"-c -b {overcast_zenith(sun) / LUMENS_PER_WATT!r}" if overcast else "+s"
    glow = "skyfunc glow daylight 0 0 4 1 1 1 0\ndaylight source daylight 0 0 4 0 0 1 180\n"
    return Expansion.of(path).text(f"!{words} {kind}\n{glow}", "--sun")


def _has_glowing_sky(primitives: list[Primitive]) -> bool:
    """Whether a `glow` surrounds the scene, which takes up an ambient bounce."""
    surfaces = (each for each in surfaces_of(primitives) if each.primitive.kind == "source")
    return any(each.modifier is not None and each.modifier.primitive.kind == "glow" for each in surfaces)


def _files_of(octree: bytes, folders: list[Path]) -> dict[str, Path]:
    """Pictures, functions, data and meshes that an octree refers to, by their names in it."""
    found: dict[str, Path] = {}
    pending = [octree]
    while pending:
        words = {word.decode() for word in _WORD.findall(pending.pop()) if b"." in word}
        for name in sorted(words - found.keys()):
            if name.startswith("/") or ".." in Path(name).parts:
                continue
            file = next((folder / name for folder in folders if (folder / name).is_file()), None)
            if file is not None:
                found[name] = file
                if file.suffix.lower() in (".oct", ".rtm"):
                    pending.append(file.read_bytes())
    return dict(sorted(found.items()))


def _digest(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}") from None
