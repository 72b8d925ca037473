"""Figures for a paper from runs: the change measure with the selected frames, BFM of regions, and the task timeline.

They follow the figures of Aggarwal, Chalmers and Debattista (2008), as vector graphics.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.atomic_file import atomic_write
from steadylight.camera import change_measure
from steadylight.errors import InputError, StorageError
from steadylight.metrics.temporal import bfm, brightness_series
from steadylight.report.films import Film
from steadylight.storage import RunDirectory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from steadylight.metrics.region import Region

COLOURS = ("#d1495b", "#0b7a75", "#3f6fb5", "#b5791c", "#7a4fa3", "#5c6268")
"""Colours of films in the order given, repeated if there are more; the same as on the comparison page."""

STAGES = {
    "prepare": "#8f5b34",
    "look": "#d9a441",
    "gather": "#b5791c",
    "merge": "#7a4fa3",
    "audit": "#3f6fb5",
    "fill": "#58a0d0",
    "smooth": "#8a93a0",
    "shade": "#0b7a75",
    "aovs": "#9aa83a",
    "concatenate": "#c3a6d8",
}
"""Colours of the stages of tasks; the same as on the live page."""

_FAILED = "#d13b2e"
_MOST_WORKERS = 64


def write_figures(
    runs: Sequence[Path], folder: Path, regions: Sequence[Region], kind: str = "pdf"
) -> dict[str, Path | str]:
    """Write every figure that the runs have the data for.

    Args:
        runs: run directories of one animation, such as a single-pass and a two-pass run; change measure and timeline
            are those of the last one.
        folder: folder of the figures; created if needed.
        regions: regions of the BFM graphs.
        kind: format of the files: pdf, svg or png.

    Returns:
        For each figure by name, the file, or the reason why there is none.

    Raises:
        InputError: a folder is not a run.
        StorageError: a figure cannot be written.
    """
    films = [Film.open(path) for path in runs]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
    makers: dict[str, Callable[[], Figure]] = {
        "change-measure": lambda: change_figure(films[-1]),
        "bfm": lambda: bfm_figure(films, regions),
        "timeline": lambda: timeline_figure(films[-1]),
    }
    made: dict[str, Path | str] = {}
    for name, maker in makers.items():
        try:
            figure = maker()
        except InputError as error:
            made[name] = str(error)
            continue
        path = folder / f"{name}.{kind}"
        with atomic_write(path) as temporary:
            # Without a date, the same run gives the same bytes.
            figure.savefig(str(temporary), format=kind, metadata=_WITHOUT_DATE.get(kind))
        made[name] = path
    return made


_WITHOUT_DATE: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def change_figure(film: Film) -> Figure:
    """The change measure along the path, with the frames selected for the first pass.

    Raises:
        InputError: the camera is not known, or there is only one frame.
    """
    poses = film.poses()
    if len(poses) < 2:
        raise InputError(f"{film.path}: the change measure needs two frames and the camera in run.json")
    gamma = change_measure(list(poses.values()))
    numbers = list(poses)
    figure, axes = _axes(1)
    whole = np.concatenate([[0.0], np.cumsum(gamma)])
    below = axes[0].twinx()
    below.fill_between(numbers[1:], gamma, step="mid", color="#c9ccd1", linewidth=0)
    below.set_ylabel("γ of a step")
    below.set_ylim(0, max(float(gamma.max()), 1e-9) * 3)
    axes[0].set_zorder(below.get_zorder() + 1)
    axes[0].patch.set_visible(False)
    axes[0].plot(numbers, whole, color=COLOURS[1])
    chosen = [n for n in film.record.get("selected") or () if n in poses]
    heights = [whole[numbers.index(n)] for n in chosen]
    axes[0].plot(chosen, heights, "v", color=COLOURS[0], markersize=6, label="selected frames")
    axes[0].vlines(chosen, 0, heights, color=COLOURS[0], linewidth=0.6)
    axes[0].set(xlabel="frame", ylabel="cumulative change γ", xlim=(numbers[0], numbers[-1]), ylim=(0, None))
    if chosen:
        axes[0].legend(frameon=False, loc="upper left")
    return figure


def bfm_figure(films: Sequence[Film], regions: Sequence[Region]) -> Figure:
    """BFM of each region in each film.

    Raises:
        InputError: no film has two neighbouring frames, or a frame cannot be read.
    """
    figure, axes = _axes(len(regions))
    drawn = 0
    for place, region in zip(axes, regions, strict=True):
        for film, colour in zip(films, itertools.cycle(COLOURS), strict=False):
            numbers = np.array(list(film.frames))
            if len(numbers) < 2:
                continue
            values = bfm(brightness_series(film.frames.values(), region))
            steps = np.diff(numbers) == 1
            if not steps.any():
                continue
            values = np.where(steps, values, np.nan)  # over a gap, the view changes too
            mode = str(film.settings.get("mode", film.name)).replace("$", r"\$")  # not a formula
            place.plot(numbers[1:], values, color=colour, label=f"{mode}: mean {np.nanmean(values):.2g}")
            drawn += 1
        place.set(ylabel=f"BFM of {region}", ylim=(0, None))
        if drawn:
            place.legend(frameon=False)
    axes[-1].set_xlabel("frame")
    if not drawn:
        raise InputError(f"{', '.join(str(f.path) for f in films)}: BFM needs two neighbouring frames")
    return figure


def timeline_figure(film: Film) -> Figure:
    """Timeline of the tasks: which worker did what when.

    Raises:
        InputError: the journal has no attempts, or cannot be read.
    """
    try:
        entries = RunDirectory(film.path).read_journal()
    except StorageError as error:
        raise InputError(str(error)) from error
    entries = [e for e in entries if {"time", "seconds", "worker", "stage"} <= e.keys()]
    if not entries:
        raise InputError(f"{film.path}: log/tasks.jsonl records no task attempts")
    workers = list(dict.fromkeys(str(entry["worker"]) for entry in entries))[:_MOST_WORKERS]
    at = _without_pauses((float(e["time"]) - float(e["seconds"]), float(e["time"])) for e in entries)
    figure, (axes,) = _axes(1, max(1.4, 0.7 + 0.22 * len(workers)), frames=False)
    begin = min(at(float(e["time"]) - float(e["seconds"])) for e in entries)
    for stage in dict.fromkeys(str(entry["stage"]) for entry in entries):
        _bars(axes, [e for e in entries if e["stage"] == stage], workers, (at, begin), stage)
    failed = [e for e in entries if e.get("outcome") != "done"]
    if failed:
        _bars(axes, failed, workers, (at, begin), "failed or lost", _FAILED)
    axes.set_yticks(range(len(workers)), [f"worker {number}" for number in range(1, len(workers) + 1)])
    axes.invert_yaxis()
    axes.set_xlabel("seconds")
    figure.legend(frameon=False, ncols=5, loc="outside upper left", fontsize=8)
    return figure


def _bars(
    axes: Axes,
    entries: Iterable[Mapping[str, Any]],
    workers: Sequence[str],
    clock: tuple[Any, float],
    label: str,
    colour: str | None = None,
) -> None:
    """One bar for each attempt, in the row of its worker."""
    at, begin = clock
    shown = [e for e in entries if str(e["worker"]) in workers]
    starts = [at(float(e["time"]) - float(e["seconds"])) - begin for e in shown]
    lengths = [float(e["seconds"]) for e in shown]
    rows = [workers.index(str(e["worker"])) for e in shown]
    axes.barh(rows, lengths, 0.8, starts, color=colour or STAGES.get(label, "#888"), label=label, linewidth=0)


def _without_pauses(spans: Iterable[tuple[float, float]]) -> Any:
    """A clock that shortens pauses of more than two minutes, in which no attempt ran, to ten seconds."""
    cuts: list[tuple[float, float]] = []
    until, shift = None, 0.0
    for start, end in sorted(spans):
        if until is not None and start - until > 120:
            shift += start - until - 10
            cuts.append((start, shift))
        until = end if until is None else max(until, end)
    return lambda time: time - max((by for start, by in cuts if time >= start), default=0.0)


def _axes(count: int, height: float = 1.9, *, frames: bool = True) -> tuple[Figure, list[Axes]]:
    """Axes below each other, as wide as a page of two columns; with `frames`, ticks are whole frame numbers."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    mpl.rcParams["svg.hashsalt"] = "steadylight"
    figure = Figure((6.3, 0.5 + height * count), layout="constrained")
    axes = figure.subplots(count, sharex=True, squeeze=False)[:, 0]
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.tick_params(labelsize=8)
    if frames:
        axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure, list(axes)
