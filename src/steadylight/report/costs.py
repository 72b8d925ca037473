"""The table of times and costs on the comparison page."""

from __future__ import annotations

import itertools
import os
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from steadylight.report.tables import duration

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from steadylight.report.films import Film


def costs_of(film: Film, truth: Film, folder: Path) -> dict[str, Any]:
    """A column of the table of times and costs: text by row.

    Args:
        film: film of the column.
        truth: film against which the errors are measured.
        folder: folder of the page, from which it links to the video.
    """
    settings, statistics = film.settings, film.statistics
    second = statistics.get("second_pass") or {}
    first, audit = statistics.get("first_pass") or {}, statistics.get("coverage") or {}
    merged = statistics.get("merge") or {}
    frames = statistics.get("frames") or len(film.frames)
    makespan = statistics.get("makespan_s")
    cpu = [part.get("seconds_cpu") for part in (first, merged, audit, second) if part]
    values: dict[str, Any] = {
        "frames": f"{len(film.frames)} of {len(film.wanted)}" if film.missing else str(len(film.frames)),
        "mode": settings.get("mode"),
        "size": f"{settings['width']}x{settings['height']}" if "width" in settings else None,
        "samples per pixel": settings.get("spp"),
        "denoised": None if "denoise" not in settings else ("yes" if settings["denoise"] else "no"),
        "makespan": None if makespan is None else duration(makespan),
        "time per frame": None if makespan is None or not frames else duration(makespan / frames),
        "first pass": None if "seconds" not in first else duration(first["seconds"]),
        "coverage audit": None if "seconds" not in audit else duration(audit["seconds"]),
        "second pass": None if "seconds" not in second else duration(second["seconds"]),
        # Runs of older versions lack the processor time of some passes.
        "processor time": None if None in cpu or not cpu else duration(sum(float(each or 0) for each in cpu)),
        "records": None
        if "records_out" not in merged
        else f"{merged['records_out'] + audit.get('records', 0):,}",
        "workers": statistics.get("workers"),
    }
    return {
        "name": film.name,
        "is_reference": film is truth,
        "video": _video(film, folder),
        "values": {name: str(value) for name, value in values.items() if value is not None},
    }


def _video(film: Film, folder: Path) -> str | None:
    """Relative link to the video, if there is one, so that page and runs can be moved together."""
    path = film.path / "animation.mp4"
    return quote(os.path.relpath(path.resolve(), folder.resolve())) if path.is_file() else None


def rows_of(films: Sequence[Film]) -> list[str]:
    """Rows of the table that at least one film has, in order."""
    found = [list(costs_of(film, film, film.path)["values"]) for film in films]
    return list(dict.fromkeys(itertools.chain.from_iterable(found)))
