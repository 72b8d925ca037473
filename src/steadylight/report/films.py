"""A run directory as pages see it: its frames, settings and numbers, and what is missing or damaged in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.camera import CameraPath, Keyframe, Pose
from steadylight.checksum import parse
from steadylight.errors import CameraError, InputError, SteadylightError
from steadylight.images import exposure_of_files, read_exr
from steadylight.metrics.sequence import FrameSequence, spans
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray


@dataclass(frozen=True)
class Film:
    """A run directory, or a folder of frames, as far as it can be read.

    Attributes:
        path: as given.
        name: name to show.
        record: content of `run.json`; empty without one.
        statistics: content of `stats.json`; empty without one.
        frames: paths by frame number, ascending; empty if there are none.
        notices: a sentence for everything that is missing or damaged; may grow while frames are read.
    """

    path: Path
    name: str
    record: Mapping[str, Any] = field(default_factory=dict)
    statistics: Mapping[str, Any] = field(default_factory=dict)
    frames: Mapping[int, Path] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path) -> Film:
        """Read what exists.

        Raises:
            InputError: there is no such folder, or it has neither run.json nor frames.
        """
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; give a run directory or a folder of EXR frames")
        directory = RunDirectory(path)
        notices: list[str] = []
        record: Mapping[str, Any] = {}
        if directory.run_file.exists():
            try:
                record = directory.read_record()
            except SteadylightError as error:
                notices.append(str(error))
        frames: Mapping[int, Path] = {}
        try:
            frames = FrameSequence.open(path).frames
        except InputError as error:
            if not directory.run_file.exists():
                raise
            notices.append(_first_sentence(error))
        film = cls(path, path.resolve().name, record, _statistics(directory, notices), frames, notices)
        if film.missing:
            notices.append(
                f"{path}: {len(film.missing)} of {len(film.wanted)} frames are missing: {_some(film.missing)}"
            )
        return film

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings of the run; empty if unknown."""
        found = self.record.get("settings")
        return found if isinstance(found, dict) else {}

    @property
    def wanted(self) -> list[int]:
        """Numbers of all frames of the run; if these are unknown, of the existing ones."""
        listed = self.settings.get("frames")
        return sorted(listed) if isinstance(listed, list) else list(self.frames)

    @property
    def missing(self) -> list[int]:
        """Numbers of frames of the run that do not exist."""
        return [number for number in self.wanted if number not in self.frames]

    @property
    def fps(self) -> float | None:
        """Frames per second, if known."""
        rate = self.settings.get("fps")
        return float(rate) if isinstance(rate, int | float) and rate > 0 else None

    @property
    def aovs(self) -> dict[int, Path]:
        """Paths of AOV files by frame number; empty if none were written."""
        paths = ((number, self.path / RunDirectory.aovs_name(number)) for number in self.frames)
        return {number: path for number, path in paths if path.is_file()}

    def frame(self, number: int) -> NDArray[np.float32] | None:
        """A frame; None if it is missing, or if it cannot be read, which adds a notice."""
        if number not in self.frames:
            return None
        try:
            return read_exr(self.frames[number])
        except InputError as error:
            self.notices.append(f"{error}; left out.")
            return None

    def exposure(self) -> float:
        """One exposure for all frames, from a sample of the readable ones; 1 if there is none."""
        return exposure_of_files(list(self.readable(16)))

    def readable(self, most: int) -> Iterator[Path]:
        """Up to `most` readable frames, equally spaced over the film."""
        paths = list(self.frames.values())
        for step in np.linspace(0, len(paths) - 1, min(most, len(paths))).round().astype(int):
            try:
                read_exr(paths[step])
            except InputError:
                continue
            yield paths[step]

    def poses(self) -> dict[int, Pose]:
        """Pose of each frame; empty if the camera is unknown."""
        camera = self.record.get("camera")
        if not isinstance(camera, dict) or self.fps is None or not self.frames:
            return {}
        try:
            path = CameraPath(tuple(Keyframe(**key) for key in camera["keyframes"]), camera["loop"])
            return dict(zip(self.frames, path.frame_poses(list(self.frames), self.fps), strict=True))
        except (KeyError, TypeError, ValueError, CameraError):
            return {}


def _statistics(directory: RunDirectory, notices: list[str]) -> Mapping[str, Any]:
    """Content of `stats.json`."""
    if not directory.run_file.exists():
        return {}
    try:
        return parse(directory.stats_file.read_bytes(), required=False)
    except FileNotFoundError:
        notices.append(f"{directory.root}: the render is not finished (no stats.json yet).")
    except (OSError, ValueError) as error:
        notices.append(
            f"{directory.stats_file}: cannot be read ({error}); run the render command again to rewrite it."
        )
    return {}


def _first_sentence(error: Exception) -> str:
    return str(error).partition(";")[0] + "."


def _some(numbers: Sequence[int]) -> str:
    """Frame numbers as text, shortened."""
    text = spans(list(numbers))
    return text if len(text) <= 60 else text[:60].rpartition(",")[0] + " …"
