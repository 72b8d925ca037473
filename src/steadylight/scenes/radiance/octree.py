"""Read Radiance's scene files for its own programs: `.rad` text and `.oct` octrees become one frozen octree.

Scenes are not rescaled: the camera path uses the same unit of length as the scene. A scene file has no camera. A view
file with the same stem (`office.vf` next to `office.rad`) gives the default camera; without one, the camera sees the
whole scene from outside, as for Mitsuba's files.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from steadylight.errors import RunError, SceneError, SettingsError
from steadylight.scenes.description import SceneDescription
from steadylight.scenes.radiance.commands import Expansion, file_of
from steadylight.scenes.radiance.conversion import LUMENS_PER_WATT
from steadylight.scenes.radiance.grammar import Command, Primitive, primitives_of, read_text, text_of
from steadylight.scenes.radiance.instances import octree_primitives, octree_sources
from steadylight.scenes.radiance.modifiers import surfaces_of
from steadylight.scenes.radiance.programs import output_of
from steadylight.scenes.radiance.view import view_of
from steadylight.scenes.sun import overcast_zenith, sky_file, sun_of
from steadylight.settings import SceneOptions

_WORD = re.compile(rb"[ -~\x80-\xff]{3,1000}")


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
    # The sources of an octree that is not frozen are read like any scene file, which controls the commands in them.
    frozen = path.suffix.lower() == ".oct" and not octree_sources(path)
    primitives = [] if frozen else _primitives(path, sky, options)
    try:
        what = ("-i", path) if frozen else ("-",)
        octree = output_of(folder, "oconv", "-f", "-w", *what, given=text_of(primitives).encode())
        with TemporaryDirectory(prefix="steadylight-") as place:
            written = Path(place) / "scene.oct"
            written.write_bytes(octree)
            *corner, side = (float(word) for word in output_of(folder, "getinfo", "-d", written).split()[-4:])
    except RunError as error:
        raise SceneError(f"{path}: {error}") from error
    glow = frozen or _has_glowing_sky(primitives)
    low = np.array(corner)
    files = _Files(path, [folder, *([sky.parent] if sky else [])], anywhere=options.allow_outside).of(octree)
    return SceneDescription(
        name=path.stem,
        content={
            "octree": np.frombuffer(octree, np.uint8),
            "files": {name: str(file) for name, file in files.items() if _is_beside(name)},
            "sky": glow,
        },
        files={str(file): _digest(file) for file in files.values()},
        about=str(path),
        format="radiance",
        **view_of(path, low, low + side),
    )


def _primitives(path: Path, sky: Path | None, options: SceneOptions) -> list[Primitive]:
    """All primitives of a scene with its sky."""
    found = []
    for file in (sky, path):
        if file is None:
            continue
        expansion = Expansion.of(file, anywhere=options.allow_outside)
        is_octree = file.suffix.lower() == ".oct"
        found += octree_primitives(file, expansion) if is_octree else expansion.file(file)
    return found + _daylight(path, options)


def _check_light(path: Path, options: SceneOptions) -> None:
    """Refuse light that cannot be added.

    Raises:
        SettingsError: an environment map is given, or any light for an octree.
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
    """Sun and sky of Radiance's own model, if the options give a sun; otherwise nothing."""
    sun = sun_of(options)
    if sun is None:
        return []
    # Radiance measures azimuth from south towards west.
    words = f"gensky -ang {sun.altitude!r} {sun.azimuth - 180!r}"
    overcast = options.sky == "overcast"
    kind = f"-c -b {overcast_zenith(sun) / LUMENS_PER_WATT!r}" if overcast else "+s"
    glow = "skyfunc glow daylight 0 0 4 1 1 1 0\ndaylight source daylight 0 0 4 0 0 1 180\n"
    return Expansion.of(path).text(f"!{words} {kind}\n{glow}", "--sun")


def _has_glowing_sky(primitives: list[Primitive]) -> bool:
    """Whether a `glow` surrounds the scene, which uses up one ambient bounce."""
    surfaces = (each for each in surfaces_of(primitives) if each.primitive.kind == "source")
    return any(each.modifier is not None and each.modifier.primitive.kind == "glow" for each in surfaces)


@dataclass
class _Files:
    """Collects the pictures, functions, data, meshes and octrees that an octree refers to.

    Attributes:
        path: path of the scene.
        folders: folders to search.
        anywhere: whether files may lie outside the folders.
        found: files by name.
    """

    path: Path
    folders: list[Path]
    anywhere: bool
    found: dict[str, Path] = field(default_factory=dict)

    def of(self, octree: bytes) -> dict[str, Path]:
        """The files by name.

        Raises:
            SceneError: one lies outside although it may not, or Radiance's programs would run a command in it.
        """
        pending = [(octree, set[str]())]
        while pending:
            data, sources = pending.pop()
            for name in sorted((_names_in(data) | sources) - self.found.keys()):
                places = (file_of(name, folder) for folder in self.folders)
                file = next((place for place in places if place is not None), None)
                if file is None:
                    continue
                self._check(name, file)
                self.found[name] = file
                kind = Path(name).suffix.lower()
                if name in sources:
                    _refuse_commands(file)
                if name in sources or kind in (".oct", ".rtm"):
                    pending.append(
                        (file.read_bytes(), set(octree_sources(file)) if kind == ".oct" else set())
                    )
        return dict(sorted(self.found.items()))

    def _check(self, name: str, file: Path) -> None:
        if not (self.anywhere or any(file.is_relative_to(folder.resolve()) for folder in self.folders)):
            raise SceneError(
                f"{self.path}: refers to {name}, outside {self.folders[0]}; copy it there, or give --allow-outside"
            )


def _refuse_commands(file: Path) -> None:
    """Reject a scene file with commands: Radiance's programs run them wherever an octree names the file."""
    for item in primitives_of(read_text(file), str(file)):
        if isinstance(item, Command):
            raise SceneError(
                f"{item.place}: an octree was made from this file, so its command would be run again for each "
                "frame; freeze the octree with `oconv -f`"
            )


def _names_in(data: bytes) -> set[str]:
    """Possible file names in an octree, a mesh or a scene file."""
    found = set()
    for word in _WORD.findall(data):
        if b"." in word or b"/" in word:
            with suppress(UnicodeDecodeError):
                whole = word.decode()
                found |= {whole, *whole.split()}
    return found


def _is_beside(name: str) -> bool:
    """Whether a name is relative to the scene's folder, and stays inside it."""
    return not name.startswith(("/", "~")) and ".." not in Path(name).parts


def _digest(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}") from None
