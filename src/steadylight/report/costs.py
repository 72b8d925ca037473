"""The table of times and costs on the comparison page."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from steadylight.report.tables import duration

if TYPE_CHECKING:
    from collections.abc import Sequence

    from steadylight.report.films import Film


def costs_of(film: Film, truth: Film) -> dict[str, Any]:
    """A column of the table of times and costs: text by row."""
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
        # Runs of older versions lack that of some passes.
        "processor time": None if None in cpu or not cpu else duration(sum(float(each or 0) for each in cpu)),
        "records": None
        if "records_out" not in merged
        else f"{merged['records_out'] + audit.get('records', 0):,}",
        "workers": statistics.get("workers"),
    }
    return {
        "name": film.name,
        "is_reference": film is truth,
        "video": _video(film),
        "values": {name: str(value) for name, value in values.items() if value is not None},
    }


def _video(film: Film) -> str | None:
    """Address of the film in full size, if there is one."""
    path = film.path / "animation.mp4"
    return path.resolve().as_uri() if path.is_file() else None


def rows_of(films: Sequence[Film]) -> list[str]:
    """Rows of the table that any film has, in order."""
    found = [list(costs_of(film, film)["values"]) for film in films]
    return list(dict.fromkeys(itertools.chain.from_iterable(found)))
