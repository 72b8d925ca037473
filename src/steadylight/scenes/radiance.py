"""Read Radiance's scene files: `.rad` text and `.oct` octrees become one frozen octree.

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

from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import CameraError, RunError, SceneError
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance_programs import output_of
from steadylight.settings import SceneOptions

_FOV = 60.0
_WORD = re.compile(rb"[!-~]{3,255}")
_SKIES = re.compile(r"^\s*(\S+)\s+source\s+\S+", re.MULTILINE)
_GLOWS = re.compile(r"^\s*\S+\s+glow\s+(\S+)", re.MULTILINE)
_VIEW_OPTIONS = {"-vp": 3, "-vd": 3, "-vu": 3, "-vh": 1}


def read(path: Path, options: SceneOptions) -> SceneDescription:
    """Read a scene from a Radiance scene file or octree.

    Args:
        path: a `.rad` file, whose commands (`!gensky` and others) are run, or an `.oct` octree.
        options: `sky`: a `.rad` file that is added to the scene, such as one with the sky.

    Raises:
        BackendError: pyradiance is not installed.
        SceneError: a file cannot be read, or Radiance rejects it.
    """
    path = Path(path).absolute()
    sky = None if options.sky is None else Path(options.sky).absolute()
    for file in (path, sky):
        if file is not None and not file.is_file():
            raise SceneError(f"{file}: no such scene file")
    folder = path.parent
    is_octree = path.suffix.lower() == ".oct"
    more = [] if sky is None else [sky]
    try:
        if is_octree and not more:
            octree = _frozen(path)
        else:
            before = ["-i", path] if is_octree else [path]
            octree = output_of(folder, "oconv", "-f", "-w", *before, *more)
        with TemporaryDirectory(prefix="steadylight-") as place:
            written = Path(place) / "scene.oct"
            written.write_bytes(octree)
            cube = [float(word) for word in output_of(folder, "getinfo", "-d", written).split()[-4:]]
        glow = is_octree or _has_glowing_sky(folder, [path, *more])
    except RunError as error:
        raise SceneError(f"{path}: {error}") from error
    files = _files_of(octree, [folder, *([sky.parent] if sky else [])])
    return SceneDescription(
        name=path.stem,
        content={
            "octree": np.frombuffer(octree, np.uint8),
            "files": {name: str(file) for name, file in files.items()},
            "sky": glow,
        },
        camera=CameraPath((_view_beside(path) or _outside(cube),)),
        files={str(file): _digest(file) for file in files.values()},
        about=str(path),
        format="radiance",
    )


def _frozen(path: Path) -> bytes:
    """A frozen octree, independent of the scene files it was made from."""
    return output_of(path.parent, "oconv", "-f", "-w", "-i", path)


def _has_glowing_sky(folder: Path, files: list[Path]) -> bool:
    """Whether a `glow` surrounds the scene, which takes up an ambient bounce."""
    text = output_of(folder, "xform", *files).decode(errors="replace")
    return bool(set(_SKIES.findall(text)) & set(_GLOWS.findall(text)))


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


def _view_beside(path: Path) -> Keyframe | None:
    """The first view of the view file next to a scene, if any."""
    file = path.with_suffix(".vf")
    if not file.is_file():
        return None
    line = next((line for line in file.read_text().splitlines() if "-vp" in line), "")
    words = line.split()
    values: dict[str, list[float]] = {}
    try:
        for option, count in _VIEW_OPTIONS.items():
            if option in words:
                first = words.index(option) + 1
                values[option] = [float(word) for word in words[first : first + count]]
        origin, direction = np.array(values["-vp"]), np.array(values["-vd"])
        x, y, z = values.get("-vu", [0.0, 0.0, 1.0])
        fov = values.get("-vh", [45.0])[0]
        return Keyframe(0.0, tuple(origin.tolist()), tuple((origin + direction).tolist()), (x, y, z), fov)
    except (KeyError, ValueError, CameraError) as error:
        raise SceneError(
            f"{file}: contains no usable view ({error}); it needs a line such as "
            "`rvu -vtv -vp 0 0 1.6 -vd 0 1 0 -vu 0 0 1 -vh 60 -vv 40`"
        ) from error


def _outside(cube: list[float]) -> Keyframe:
    """A view of the whole scene from outside, slightly from above, z up; `cube` is its lower corner and side."""
    *corner, side = cube
    centre = np.array(corner) + side / 2
    away = np.array([0.5, -1.0, 0.5]) / np.sqrt(1.5)
    origin = centre + away * side * np.sqrt(3) / 2 / np.sin(np.radians(_FOV / 3))
    return Keyframe(0.0, tuple(origin.tolist()), tuple(centre.tolist()), fov=_FOV)
