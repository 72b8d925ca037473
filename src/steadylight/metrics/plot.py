"""Plot of the comparison of two runs: BFM graphs next to the measured region, and errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.atomic_file import atomic_write
from steadylight.metrics.region import Region

if TYPE_CHECKING:
    from pathlib import Path

    from steadylight.metrics.compare import Comparison, SequenceMeasures

_COLOURS = {"a": "#d1495b", "b": "#0b7a75", "reference": "#3d405b"}
_REGION = "#f2b134"
_GREY = "#5f6368"
_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": "#9aa0a6",
    "axes.labelcolor": _GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": _GREY,
    "ytick.color": _GREY,
    "grid.color": "#e4e6e9",
    "legend.frameon": False,
}


def plot_comparison(comparison: Comparison, path_png: Path) -> None:
    """Draw a comparison as in Figure 3 of the paper: BFM over frames, next to the highlighted region.

    Below, the relative RMSE of each frame and a table of the means. No global state is changed: the figure is drawn
    with Matplotlib's Agg backend without pyplot.

    Args:
        comparison: from `compare.compare_runs`.
        path_png: the PNG file to write; an existing one is replaced.

    Raises:
        StorageError: the file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    labels = _labels(comparison)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(12, 7), dpi=120, layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        picture, graph, table, errors = figure.subplots(
            2, 2, gridspec_kw={"width_ratios": [1, 1.9], "height_ratios": [1.15, 1]}
        ).flat
        _draw_region(picture, comparison)
        _draw_bfm(graph, comparison, labels)
        _draw_table(table, comparison, labels)
        _draw_errors(errors, comparison, labels)
        with atomic_write(path_png) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def _sequences(comparison: Comparison) -> dict[str, SequenceMeasures]:
    sequences = {"a": comparison.a, "b": comparison.b, "reference": comparison.reference}
    return {name: sequence for name, sequence in sequences.items() if sequence is not None}


def _labels(comparison: Comparison) -> dict[str, str]:
    """Short names of the sequences: the folder name, with the parent's name if two are equal."""
    paths = {name: sequence.path.resolve() for name, sequence in _sequences(comparison).items()}
    names = [path.name for path in paths.values()]
    labels = {
        name: path.name if names.count(path.name) == 1 else f"{path.parent.name}/{path.name}"
        for name, path in paths.items()
    }
    return {name: _plain(label) or name for name, label in labels.items()}


def _plain(name: str) -> str:
    """A name that Matplotlib shows unchanged: dollar signs start a formula, and legends omit names starting with _."""
    return name.replace("$", r"\$").lstrip("_")


def _draw_region(axes: Any, comparison: Comparison) -> None:
    """A frame with the region highlighted."""
    from matplotlib.patches import Rectangle

    width, height = comparison.width, comparison.height
    x0, y0, x1, y1 = comparison.region.pixels(width, height)
    axes.imshow(comparison.thumbnail, extent=(0, width, height, 0), interpolation="antialiased")
    whole = (x0, y0, x1, y1) == (0, 0, width, height)
    if not whole:
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color=_REGION, alpha=0.35, linewidth=0))
    axes.add_patch(
        Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=_REGION, linewidth=2, clip_on=False)
    )
    axes.set_axis_off()
    where = "whole image" if whole else f"region {x0},{y0},{x1},{y1} of {width}×{height}"
    axes.set_title(f"Frame {comparison.thumbnail_frame}, {where}")


def _draw_bfm(axes: Any, comparison: Comparison, labels: dict[str, str]) -> None:
    """BFM of each sequence over frames."""
    whole = comparison.region == Region.of(None)
    axes.set_title("Brightness flickering metric" + ("" if whole else " of the region"))
    if not comparison.b.bfm.size:
        _say(axes, "needs neighbouring frames")
        return
    for name in ("reference", "a", "b"):
        sequence = _sequences(comparison).get(name)
        if sequence is None:
            continue
        style = {"linestyle": "--", "linewidth": 1.2} if name == "reference" else {"linewidth": 1.6}
        axes.plot(
            comparison.frames[1:],
            sequence.bfm,
            color=_COLOURS[name],
            label=labels[name],
            marker="o" if sequence.bfm.size <= 60 else None,
            markersize=3,
            **style,
        )
    axes.set_ylabel("BFM(t) = |b(t) − b(t−1)|")
    _finish(axes, comparison)


def _draw_errors(axes: Any, comparison: Comparison, labels: dict[str, str]) -> None:
    """Relative RMSE and FLIP of each compared frame."""
    truth = labels.get("reference") or _plain(comparison.truth.resolve().name)
    axes.set_title(f"Error of each frame against {truth}")
    for name in ("a", "b"):
        sequence = _sequences(comparison)[name]
        if sequence.rel_rmse is None or sequence.flip is None:
            continue
        values = np.where(np.isfinite(sequence.rel_rmse), sequence.rel_rmse, np.nan) * 100
        few = len(comparison.compared) <= 60
        axes.plot(
            comparison.compared,
            values,
            color=_COLOURS[name],
            label=f"{labels[name]}: rel. RMSE",
            linewidth=1.6,
            marker="o" if few else None,
            markersize=3,
        )
        seen = np.isfinite(sequence.flip)
        axes.plot(
            np.array(comparison.compared)[seen],
            sequence.flip[seen] * 100,
            color=_COLOURS[name],
            label=f"{labels[name]}: FLIP × 100",
            linestyle=":",
            linewidth=1.2,
        )
    axes.set_ylabel("relative RMSE, %")
    _finish(axes, comparison)


def _finish(axes: Any, comparison: Comparison) -> None:
    """Common format of both graphs."""
    from matplotlib.ticker import MaxNLocator

    first, last = comparison.frames[0], comparison.frames[-1]
    margin = max(0.5, (last - first) * 0.015)
    axes.set_xlim(first - margin, last + margin)
    axes.set_ylim(bottom=0)
    axes.margins(y=0.1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("frame")
    axes.grid(axis="y")
    axes.legend(loc="upper right", ncols=2)
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom, top * 1.25)  # room for the legend


def _draw_table(axes: Any, comparison: Comparison, labels: dict[str, str]) -> None:
    """Means of both runs, and the flicker ratio first / second."""
    axes.set_axis_off()
    axes.set_title(f"Means over {len(comparison.frames)} frames")
    a, b = comparison.a.means(), comparison.b.means()
    rows = [
        ("brightness", "brightness_ratio", "{:.4f}", None),
        ("rel. RMSE", "rel_rmse", "{:.2%}", None),
        ("without 1 % largest", "rel_trimmed", "{:.2%}", None),
        ("rel. bias", "rel_bias", "{:+.2%}", None),
        ("FLIP", "flip", "{:.4f}", None),
        ("BFM", "bfm", "{:.5f}", None),
        ("overshoot", "overshoot", "{:.5f}", comparison.overshoot_ratio),
        ("BFM excess", "bfm_excess", "{:.5f}", comparison.bfm_excess_ratio),
    ]
    cells = [(title, *(_cell(form, m[key]) for m in (a, b)), _ratio(r)) for title, key, form, r in rows]
    columns = (0.0, 0.50, 0.80, 1.0)
    head = ("", labels["a"], labels["b"], "ratio")
    for row, texts in enumerate([head, *cells]):
        y = 0.95 - row * 0.105
        for x, text, key in zip(columns, texts, ("", "a", "b", ""), strict=True):
            colour = _COLOURS.get(key, _GREY) if row == 0 else "#202124" if key else _GREY
            axes.text(
                x,
                y,
                text if row or len(text) < 19 else f"{text[:17]}…",
                transform=axes.transAxes,
                horizontalalignment="left" if x == 0 else "right",
                color=colour,
                fontweight="bold" if row == 0 else "normal",
            )
        axes.plot([0, 1], [y - 0.04, y - 0.04], transform=axes.transAxes, color="#e4e6e9", linewidth=0.8)


def _cell(form: str, value: float | None) -> str:
    return "–" if value is None else form.format(value)


def _ratio(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}×"


def _say(axes: Any, text: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, transform=axes.transAxes, horizontalalignment="center", color=_GREY)
