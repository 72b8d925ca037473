"""Makes `report.html` from a run directory: collects numbers and thumbnails, and fills the template."""

from __future__ import annotations

import io
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from steadylight.atomic_file import atomic_write
from steadylight.images import tone_map
from steadylight.metrics.temporal import bfm, mean_luminance, normalised
from steadylight.report.charts import Series, line_chart
from steadylight.report.embedding import data_url, page_from
from steadylight.report.films import Film
from steadylight.report.tables import duration, key_figures, settings_tables, statistics_tables
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

LARGEST_EMBEDDED_VIDEO = 8 * 2**20
"""Bytes; a larger video is linked, so that the page opens quickly."""

THUMBNAILS = 12
"""Number of thumbnails, equally spaced over the animation."""

_THUMBNAIL_SIZE = (320, 320)


def write_report(run_directory_path: Path | str) -> Path:
    """Write `report.html` into a run directory: settings, thumbnails, video, statistics and charts on one page.

    The page needs no other file and no network, except that a video larger than 8 MiB is played from
    `animation.mp4` next to it. For an unfinished or damaged run, the page names what is missing and shows the rest.
    Frames are read one at a time.

    Args:
        run_directory_path: a folder written by `steadylight render --output`.

    Returns:
        The path of the page.

    Raises:
        InputError: not a run directory.
        StorageError: the page cannot be written.
    """
    directory = RunDirectory(run_directory_path)
    if not directory.run_file.exists():
        directory.read_record()  # reports that this is not a run
    film = Film.open(directory.root)
    record, statistics = film.record, film.statistics
    numbers, brightness, pictures = _look_at(film)
    selected = statistics.get("selected_frames") or record.get("selected") or []
    page = page_from(
        "report.html",
        title=_title(record, directory.root),
        film=_film(record, len(film.frames)),
        made=_made(statistics),
        method=_method(record),
        notices=film.notices,
        figures=key_figures(statistics),
        pictures=pictures,
        selected=set(selected),
        video=_video(directory.video_file),
        charts=_charts(numbers, brightness, statistics, record, selected),
        settings=settings_tables(record),
        statistics=statistics_tables(statistics),
    )
    with atomic_write(directory.report_file) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return directory.report_file


def _look_at(film: Film) -> tuple[list[int], NDArray[np.float64], list[dict[str, Any]]]:
    """Read every frame once; returns numbers and brightness, (T,), of readable frames, and the thumbnails."""
    numbers = list(film.frames)
    steps = np.linspace(0, len(numbers) - 1, min(THUMBNAILS, len(numbers))).round().astype(int)
    shown = {numbers[step] for step in steps}
    tone = (film.statistics.get("display") or {}).get("tone", "srgb")
    exposure = film.statistics.get("exposure") or film.exposure()
    read, luminances, pictures = [], [], []
    for number in numbers:
        image = film.frame(number)
        if image is None:
            continue
        read.append(number)
        luminances.append(mean_luminance(image))
        if number in shown:
            pictures.append({"frame": number, "source": _picture(tone_map(image, exposure, tone))})
    return read, normalised(luminances), pictures


def _picture(pixels: NDArray[np.uint8]) -> str:
    """A small JPEG as a data URL."""
    picture = Image.fromarray(pixels)
    picture.thumbnail(_THUMBNAIL_SIZE)
    content = io.BytesIO()
    picture.save(content, format="JPEG", quality=88)
    return data_url("image/jpeg", content.getvalue())


def _video(path: Path) -> dict[str, Any] | None:
    """Source of the video: embedded if it is small, otherwise a file next to the page; None without a video."""
    if not path.is_file():
        return None
    size = path.stat().st_size
    embedded = size < LARGEST_EMBEDDED_VIDEO
    source = data_url("video/mp4", path.read_bytes()) if embedded else path.name
    return {"source": source, "embedded": embedded, "name": path.name, "megabytes": f"{size / 1e6:.1f}"}


def _title(record: Mapping[str, Any], root: Path) -> str:
    scene = record.get("scene")
    name = scene.get("title", scene.get("name")) if isinstance(scene, dict) else scene
    return str(name or root.resolve().name)


def _film(record: Mapping[str, Any], frames: int) -> str:
    """The film in one line: length, frames and size."""
    found = _settings(record)
    parts = [f"{frames} frame{'s' * (frames != 1)}"]
    if fps := found.get("fps"):
        parts[0] += f", {duration(frames / fps)} at {fps:g} frames per second"
    if {"width", "height"} <= found.keys():
        parts.append(f"{found['width']}×{found['height']}")
    return " · ".join(parts)


def _made(statistics: Mapping[str, Any]) -> str:
    """When and where the film was rendered, and how long that took; empty if unknown."""
    sessions = statistics.get("sessions") or []
    if not sessions:
        return ""
    days = [datetime.fromisoformat(session["started"]).strftime("%-d %B %Y") for session in sessions]
    hosts = dict.fromkeys(str(session["host"]) for session in sessions if session.get("host"))
    when = days[0] if days[0] == days[-1] else f"{days[0]} to {days[-1]}"
    where = f" on {', '.join(hosts)}" if hosts else ""
    return f"Rendered {when}{where} in {duration(statistics['makespan_s'])}"


def _settings(record: Mapping[str, Any]) -> Mapping[str, Any]:
    settings = record.get("settings")
    return settings if isinstance(settings, dict) else {}


def _method(record: Mapping[str, Any]) -> str:
    """The main settings of the renderer in one line."""
    found = _settings(record)
    parts = [str(found["mode"])] if "mode" in found else []
    if "spp" in found:
        parts.append(f"{found['spp']} samples per pixel")
    if "quality" in found:
        parts.append(f"quality {found['quality']}")
    return " · ".join(parts)


def _charts(
    numbers: Sequence[int],
    brightness: NDArray[np.float64],
    statistics: Mapping[str, Any],
    record: Mapping[str, Any],
    selected: Sequence[int],
) -> list[dict[str, str]]:
    """Title, explanation and SVG of each chart with data."""
    charts = []
    times = (statistics.get("second_pass") or {}).get("frame_seconds") or []
    settings = record.get("settings")
    listed = settings.get("frames") if isinstance(settings, dict) else None
    timed = sorted(listed) if isinstance(listed, list) else numbers
    if times and len(times) == len(timed):
        charts.append(
            {
                "title": "Seconds per frame",
                "about": "Second pass, wall-clock time of each frame on its worker.",
                "svg": line_chart(Series(timed, times, "s"), selected, title="Seconds per frame"),
            }
        )
    if not numbers:
        return charts
    charts.append(
        {
            "title": "Brightness",
            "about": "b(t): mean luminance of the whole frame, divided by its mean over the animation.",
            "svg": line_chart(
                Series(numbers, brightness.tolist(), from_zero=False), selected, title="Brightness"
            ),
        }
    )
    steps = np.diff(numbers) == 1  # over a gap, the view changes, which is not flicker
    if steps.any():
        values = bfm(brightness)[steps].tolist()
        charts.append(
            {
                "title": "Brightness flickering metric",
                "about": "BFM(t) = |b(t) − b(t−1)| over the whole frame, per frame step; "
                "it includes the trend caused by the camera.",
                "svg": line_chart(
                    Series(np.array(numbers)[1:][steps].tolist(), values),
                    selected,
                    title="Brightness flickering metric",
                ),
            }
        )
    return charts
