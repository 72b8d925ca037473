"""TUM files: a pose per line, `timestamp tx ty tz qx qy qz qw`, as trackers and SLAM systems write them.

Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from steadylight.camera.path import CameraPath
from steadylight.camera.rows import Header, Row, finite, path_of, turned
from steadylight.errors import CameraError

_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def read(text: str, first_frame: int | None) -> tuple[CameraPath, float | None]:
    """The path from the text of a TUM file; see `files.load_camera`. The first timestamp becomes time 0."""
    header = Header()
    poses: list[tuple[int, list[float]]] = []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        try:
            if line.lstrip().startswith("#"):
                header = header.with_comment(line)
            elif words:
                poses.append((number, _numbers(words)))
        except CameraError as error:
            raise CameraError(f"line {number}: {error}") from None
    rows = []
    for number, values in poses:
        try:
            rows.append(Row(number, values[0], turned(values[1:4], values[4:], header.axes)))
        except CameraError as error:
            raise CameraError(f"line {number}: {error}") from None
    return path_of(rows, header, first_frame, counts_frames=False)


def _numbers(words: list[str]) -> list[float]:
    if len(words) != len(_COLUMNS):
        count = f"{len(words)} value{'s' * (len(words) != 1)}"
        raise CameraError(f"has {count}; a TUM pose is eight numbers: {' '.join(_COLUMNS)}")
    return [finite(word, name) for word, name in zip(words, _COLUMNS, strict=True)]
