"""Charts of one series over frames, as inline SVG with the colours of the page (light or dark)."""

from __future__ import annotations

import html
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_WIDTH, _HEIGHT = 920.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 12.0, 14.0, 34.0
_MOST_DOTS = 400  # with more, only the line is drawn, which is clearer and keeps the page small


@dataclass(frozen=True)
class Series:
    """One quantity over frames.

    Attributes:
        frames: frame numbers, ascending.
        values: one for each frame, finite.
        unit: unit after the value in tooltips.
        from_zero: whether the value axis starts at 0 or fits the range of values.
    """

    frames: Sequence[int]
    values: Sequence[float]
    unit: str = ""
    from_zero: bool = True


def line_chart(series: Series, marked: Sequence[int] = (), *, title: str = "") -> str:
    """An SVG element with the line, its axes, and a triangle below each marked frame.

    The line joins only neighbouring frames: the values in a gap are unknown.

    Args:
        series: at least one value.
        marked: frame numbers; those outside the series are ignored.
        title: title of the chart, for screen readers.
    """
    bottom, top, ticks = _vertical(series)
    first, last = series.frames[0], series.frames[-1]

    def x(frame: float) -> float:
        return _LEFT + (frame - first) / max(last - first, 1) * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _HEIGHT - _BOTTOM - (value - bottom) / (top - bottom) * (_HEIGHT - _TOP - _BOTTOM)

    base = y(bottom)
    parts = []
    for tick in ticks:
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        )
        parts.append(f'<text class="y" x="{_LEFT - 8}" y="{y(tick) + 4:.1f}">{_number(tick)}</text>')
    parts.extend(
        f'<text class="x" x="{x(frame):.1f}" y="{_HEIGHT - 6}">{frame}</text>'
        for frame in _frame_ticks(first, last)
    )
    for frame in sorted(set(marked)):
        if first <= frame <= last:
            where = f"M{x(frame):.1f} {base + 3:.1f}l4.5 8h-9z"
            parts.append(f'<path class="mark" d="{where}"><title>selected frame {frame}</title></path>')
    points = [(x(frame), y(value)) for frame, value in zip(series.frames, series.values, strict=True)]
    stretches = _stretches(series.frames)
    for stretch in stretches:
        line = " ".join(f"{px:.1f},{py:.1f}" for px, py in points[stretch])
        parts.append(f'<polyline class="line" points="{line}"/>')
    if len(points) <= _MOST_DOTS or len(stretches) > 1:
        for (px, py), frame, value in zip(points, series.frames, series.values, strict=True):
            label = html.escape(f"frame {frame}: {value:.4g} {series.unit}".rstrip())
            parts.append(
                f'<circle class="dot" cx="{px:.1f}" cy="{py:.1f}" r="2.2"><title>{label}</title></circle>'
            )
    low, high = min(series.values), max(series.values)
    said = (
        f"{title}: {_number(low)} to {_number(high)} {series.unit}".rstrip() + f", frames {first} to {last}"
    )
    label = html.escape(said, quote=True)
    size = f"0 0 {_WIDTH:g} {_HEIGHT:g}"
    return f'<svg class="chart" viewBox="{size}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _stretches(frames: Sequence[int]) -> list[slice]:
    """Runs of frames without a gap, as slices."""
    ends = [i for i in range(1, len(frames)) if frames[i] != frames[i - 1] + 1]
    return [slice(begin, end) for begin, end in pairwise([0, *ends, len(frames)])]


def _vertical(series: Series) -> tuple[float, float, list[float]]:
    """Lower and upper end of the value axis, and its ticks."""
    low, high = min(series.values), max(series.values)
    if series.from_zero:
        low = min(low, 0.0)
    if high - low < 1e-9 * max(abs(high), 1.0):  # centre a flat line, or put it on 0
        high = high + (abs(high) * 0.05 or 1.0)
        low = low if series.from_zero else low - abs(low) * 0.05
    ticks = _ticks(low, high)
    return min(low, ticks[0]), max(high, ticks[-1]), ticks


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers that span an interval."""
    from matplotlib.ticker import MaxNLocator

    return [float(tick) for tick in MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)]


def _frame_ticks(first: int, last: int) -> list[int]:
    """Frame numbers to label on the axis."""
    from matplotlib.ticker import MaxNLocator

    if first == last:
        return [first]
    values = MaxNLocator(10, steps=[1, 2, 5, 10], integer=True).tick_values(first, last)
    return [int(value) for value in values if first <= value <= last]


def _number(value: float) -> str:
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"
