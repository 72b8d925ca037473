"""A sequence on disk: the numbered EXR frames of a run directory or of any other folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from steadylight.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_NUMBERED = re.compile(r"([^.].*?)?(\d+)\.exr", re.IGNORECASE)


@dataclass(frozen=True)
class FrameSequence:
    """The frames of one sequence, by number.

    Attributes:
        path: the folder as given.
        frames: paths of EXR files by frame number, ascending.
    """

    path: Path
    frames: Mapping[int, Path]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Find the frames of a run directory (`frames/frame_00001.exr` ...) or of a folder of EXR files.

        In a plain folder, the digits at the end of a file name are the frame number; other files are ignored.

        Raises:
            InputError: the folder does not exist or is not named in UTF-8, has no frames, or has two files with the
                same number.
        """
        try:
            str(path).encode()
        except UnicodeEncodeError:
            raise InputError(
                f"{path}: its name is not valid UTF-8, which reading EXR files requires; rename it"
            ) from None
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; give a run directory or a folder of EXR frames")
        folder = path / "frames" if (path / "frames").is_dir() else path
        frames: dict[int, Path] = {}
        for file in sorted(folder.iterdir()):
            match = _NUMBERED.fullmatch(file.name)
            if match is None:
                continue
            number = int(match[2])
            if number in frames:
                raise InputError(
                    f"{folder}: {frames[number].name} and {file.name} are both frame {number}; "
                    "give a folder with one sequence"
                )
            frames[number] = file
        if not frames:
            raise InputError(
                f"{folder}: contains no frames; expected EXR files whose names end in the frame number"
            )
        return cls(path, dict(sorted(frames.items())))

    def shared_with(self, other: FrameSequence) -> tuple[int, ...]:
        """Frame numbers that both sequences have, ascending.

        A shorter sequence may be compared to a part of a longer one, but both must have every frame of that part.

        Raises:
            InputError: the sequences share no frame, or one has a gap where the other has a frame.
        """
        shared = sorted(self.frames.keys() & other.frames.keys())
        if not shared:
            raise InputError(
                f"{self.path} (frames {spans(self.frames)}) and {other.path} (frames {spans(other.frames)}) "
                "have no frame in common"
            )
        for sequence, fuller in ((self, other), (other, self)):
            holes = [n for n in fuller.frames if shared[0] <= n <= shared[-1] and n not in sequence.frames]
            if holes:
                raise InputError(
                    f"{sequence.path}: has no frame {spans(holes)}, but {fuller.path} has; both need every frame "
                    f"from {shared[0]} to {shared[-1]}"
                )
        return tuple(shared)


def spans(numbers: Mapping[int, object] | list[int]) -> str:
    """Frame numbers in short form: `1-24, 30`."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ", ".join("-".join(map(str, part)) for part in parts)
