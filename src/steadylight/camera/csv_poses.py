"""CSV files: a row of column names, then a pose per row, as spreadsheets and trackers write them.

Columns are separated by commas, semicolons or tabs. With semicolons or tabs, decimal commas are read too.
"""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from steadylight.camera.path import CameraPath
from steadylight.camera.rows import Header, Row, finite, path_of, turned
from steadylight.errors import CameraError


def _triple(*stems: str) -> tuple[tuple[str, ...], ...]:
    """Names of the x, y and z columns of a quantity with several names; `_` stands for the letter."""
    return tuple(tuple(stem.replace("_", letter) for stem in stems) for letter in "xyz")


_QUANTITIES: Final[Mapping[str, tuple[tuple[str, ...], ...]]] = {
    "time": (("time", "t", "seconds", "timestamp"),),
    "frame": (("frame", "framenumber"),),
    "origin": _triple("origin_", "_", "position_", "pos_", "p_", "eye_", "t_"),
    "target": _triple("target_", "lookat_"),
    "direction": _triple("direction_", "dir_", "d_", "view_"),
    "quaternion": (("qx",), ("qy",), ("qz",), ("qw",)),
    "up": _triple("up_", "u_"),
    "fov": (("fov", "hfov", "fovx"),),
}
"""Column names of each quantity, compared without case, spaces, `_`, `-`, `.` and units in brackets."""

_NOT_READ: Final = {
    "roll": "give the up direction as `up_x`, `up_y` and `up_z`",
    **dict.fromkeys(("fovy", "vfov", "yfov"), "give the horizontal angle as `fov`"),
    **dict.fromkeys(("focal", "focallength", "zoom"), "give the horizontal angle of view as `fov`"),
}
"""Unsupported columns that would change the picture, by plain name, and what to give instead."""

_VIEWS: Final = ("target", "direction", "quaternion")
_EXAMPLE: Final = "time,origin_x,origin_y,origin_z,target_x,target_y,target_z,fov"
_NAME = re.compile(r"\[.*?\]|\(.*?\)|[\s_.\-]+")


@dataclass(frozen=True)
class _Columns:
    """Where each quantity is in the file.

    Attributes:
        count: number of columns.
        places: column numbers of each quantity, from 0.
        names: names of all columns, as the file has them.
        decimal_comma: whether numbers may be written `1,5`.
    """

    count: int
    places: Mapping[str, tuple[int, ...]]
    names: tuple[str, ...]
    decimal_comma: bool

    def row(self, line: int, cells: Sequence[str], header: Header) -> Row:
        """Parse the pose in a row.

        Raises:
            CameraError: a number is missing or not valid.
        """
        if len(cells) != self.count:
            raise CameraError(f"has {len(cells)} cells; the first row names {self.count} columns")
        found = {
            name: [self._number(cells, place) for place in places] for name, places in self.places.items()
        }
        (moment,) = found.pop("frame", None) or found.pop("time")
        origin = found.pop("origin")
        values: dict[str, Any] = {name: found[name] for name in ("target", "up") if name in found}
        if "fov" in found:
            (values["fov"],) = found["fov"]
        if "quaternion" in found:
            return Row(line, moment, turned(origin, found["quaternion"], header.axes) | values)
        if "direction" in found:
            values["target"] = [a + b for a, b in zip(origin, found["direction"], strict=True)]
        return Row(line, moment, {"origin": origin, **values})

    def _number(self, cells: Sequence[str], place: int) -> float:
        text = cells[place].strip()
        if not text:
            raise CameraError(f"column {place + 1} (`{self.names[place]}`) is empty; it must be a number")
        if self.decimal_comma:
            text = text.replace(",", ".")
        return finite(text, f"{self.names[place]}")


def read(text: str, first_frame: int | None) -> tuple[CameraPath, float | None]:
    """The path from the text of a CSV file; see `files.load_camera`."""
    delimiter = _delimiter(text)
    header = Header()
    columns: _Columns | None = None
    pending: list[tuple[int, list[str]]] = []
    for line, cells in _cells(text, delimiter):
        try:
            if cells[0].lstrip().startswith("#"):
                header = header.with_comment(delimiter.join(cells).rstrip(delimiter + " "))
            elif columns is None:
                columns = _columns(cells, decimal_comma=delimiter != ",")
            else:
                pending.append((line, cells))
        except CameraError as error:
            raise CameraError(f"line {line}: {error}") from None
    if columns is None:
        raise CameraError(f"is empty; its first row names the columns, for example {_EXAMPLE}")
    rows = []
    for line, cells in pending:
        try:
            rows.append(columns.row(line, cells, header))
        except CameraError as error:
            raise CameraError(f"line {line}: {error}") from None
    return path_of(rows, header, first_frame, counts_frames="frame" in columns.places)


def _delimiter(text: str) -> str:
    """The separator that is most frequent in the first row."""
    first = next(
        (line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")), ""
    )
    return max(",;\t", key=first.count)


def _cells(text: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Non-empty rows, each with the number of its last line.

    Raises:
        CameraError: the text is not valid CSV, for example because a quote is never closed.
    """
    reader = csv.reader(text.split("\n"), delimiter=delimiter, strict=True, skipinitialspace=True)
    while True:
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise CameraError(f"line {reader.line_num}: is not valid CSV: {error}") from None
        if cells is None:
            return
        if any(cell.strip() for cell in cells):
            yield reader.line_num, cells


def _columns(names: Sequence[str], *, decimal_comma: bool) -> _Columns:
    """Which column holds what, from the first row.

    Raises:
        CameraError: columns are missing, not supported, or give the same quantity twice.
    """
    plain = [_NAME.sub("", name.strip().lower()) for name in names]
    if any(_is_number(name) for name in names):
        raise CameraError(f"the first row must name the columns, for example {_EXAMPLE}")
    for given, name in zip(names, plain, strict=True):
        if name in _NOT_READ:
            raise CameraError(f"column `{given}` is not read; {_NOT_READ[name]}, or leave it out")
    places: dict[str, tuple[int, ...]] = {}
    for quantity, parts in _QUANTITIES.items():
        at = [[place for place, name in enumerate(plain) if name in part] for part in parts]
        for part, found in zip(parts, at, strict=True):
            if len(found) > 1:
                both = " and ".join(f"`{names[place]}`" for place in found)
                raise CameraError(f"columns {both} both give {_shown(quantity, part[0])}; keep only one")
        if all(at):
            places[quantity] = tuple(found[0] for found in at)
        elif any(at):
            lacking = ", ".join(
                _shown(quantity, part[0]) for part, found in zip(parts, at, strict=True) if not found
            )
            raise CameraError(f"column {lacking} is missing{_near(lacking, names)}")
    _check_quantities(places, names)
    return _Columns(len(names), places, tuple(names), decimal_comma)


def _check_quantities(places: Mapping[str, object], names: Sequence[str]) -> None:
    """Check that time, origin and view are each given exactly once."""
    if not {"time", "frame"} & places.keys():
        raise CameraError(
            f"a column `time` (seconds) or `frame` (counted from 1) is missing{_near('time', names)}"
        )
    if {"time", "frame"} <= places.keys():
        raise CameraError("has columns for both `time` and `frame`; keep only one of them")
    if "origin" not in places:
        raise CameraError(
            f"columns `origin_x`, `origin_y` and `origin_z` are missing{_near('origin_x', names)}; for example "
            f"{_EXAMPLE}"
        )
    views = [view for view in _VIEWS if view in places]
    if len(views) != 1:
        fault = "has no columns for the view" if not views else f"has columns for both {' and '.join(views)}"
        raise CameraError(
            f"{fault}; give one of: target_x target_y target_z, direction_x direction_y direction_z, qx qy qz qw"
        )
    if "quaternion" in places and "up" in places:
        raise CameraError(
            "has columns for both a quaternion and up; the quaternion already sets the up direction, so leave up out"
        )


def _shown(quantity: str, name: str) -> str:
    """The name of a column as messages and the documentation write it."""
    return f"`{name}`" if name in {quantity, "qx", "qy", "qz", "qw"} else f"`{name[:-1]}_{name[-1]}`"


def _near(wanted: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(wanted.strip("`"), names, n=1)
    return f" (is it `{near[0]}`?)" if near else ""


def _is_number(text: str) -> bool:
    try:
        float(text.strip().replace(",", "."))
    except ValueError:
        return False
    return True
