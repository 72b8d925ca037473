"""The page about the records of a frame: drawn over it and from above, in four colourings."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from steadylight.atomic_file import atomic_write
from steadylight.images import animation_exposure, tone_map
from steadylight.metrics.reprojection import project
from steadylight.report.embedding import data_url, page_from

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from steadylight.camera import Pose
    from steadylight.renderers.base import RecordTable, Surfaces

NEAR = 3.0
"""Pixel footprints by which a record may be off the surface that its pixel sees and still count as visible."""


@dataclass(frozen=True)
class Scenery:
    """The frame that records are drawn over.

    Attributes:
        number: frame number.
        image: (height, width, 3) scene-linear RGB.
        pose: pose of the camera.
        surfaces: what the pixels see.
    """

    number: int
    image: NDArray[np.float32]
    pose: Pose
    surfaces: Surfaces


def write_records_page(
    output: Path, title: str, scenery: Scenery, table: RecordTable, groups: dict[str, NDArray[np.int64]]
) -> Path:
    """Write the page, which needs no other file.

    Args:
        output: the page; an existing file is replaced.
        title: title of the page.
        scenery: the frame.
        table: R records.
        groups: further colourings by name, each (R,) with a number for each record.

    Raises:
        StorageError: the page cannot be written.
    """
    x, y, seen = _seen(scenery, table)
    mean = table.irradiance.mean(axis=1)
    colourings: list[tuple[str, str, NDArray[Any], bool]] = [
        ("radius", "metres; small near other surfaces", table.radius, False),
        ("noise", "standard error over irradiance; large: blotches", table.noise, False),
        *((name, "", values, True) for name, values in groups.items()),
        ("irradiance", "W/m², mean of the channels; blotches are differences in it", mean, False),
    ]
    drawn = []
    for number, (name, about, values, named) in enumerate(colourings):
        over = _over(scenery, (x[seen], y[seen]), values[seen], (name, named))
        above = _above(scenery, table, values, (name, named))
        drawn.append({"id": f"by{number}", "name": name, "about": about, "over": over, "above": above})
    known = np.isfinite(table.noise)
    facts = [
        ("records that the frame reads", f"{len(table.position):,}"),
        ("seen in it", f"{int(seen.sum()):,}"),
        ("median radius", f"{np.median(table.radius):.3g} m" if len(table.radius) else "none"),
        ("median noise", f"{np.median(table.noise[known]):.2%}" if known.any() else "not known"),
    ]
    page = page_from("records.html", title=title, number=scenery.number, drawn=drawn, facts=facts)
    with atomic_write(output) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return output


def _seen(
    scenery: Scenery, table: RecordTable
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.bool_]]:
    """Where records are in the frame, and which of them are visible."""
    height, width = scenery.image.shape[:2]
    x, y, depth = project(table.position.astype(np.float64), scenery.pose, (width, height))
    inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    columns, rows = (np.where(inside, value, 0).astype(np.intp) for value in (x, y))
    off = np.linalg.norm(scenery.surfaces.position[rows, columns] - table.position, axis=1)
    footprint = np.abs(depth) * 2 * np.tan(np.radians(scenery.pose.fov) / 2) / width
    there = np.isfinite(scenery.surfaces.depth[rows, columns])
    return x, y, inside & there & (off < NEAR * footprint + 0.1 * table.radius)


def _over(
    scenery: Scenery,
    places: tuple[NDArray[np.floating], NDArray[np.floating]],
    values: NDArray[Any],
    colouring: tuple[str, bool],
) -> str:
    """Picture of the records over the frame, which is grey so that only the records have colours."""
    height, width = scenery.image.shape[:2]
    grey = tone_map(scenery.image, animation_exposure([scenery.image])).mean(axis=2)
    figure, axes = _figure(10, 10 * height / width)
    axes.imshow(0.3 * grey + 25, cmap="gray", vmin=0, vmax=255, extent=(0, width, height, 0), aspect="auto")
    _scatter(figure, axes, places, values, colouring, 14 if len(values) < 5000 else 5)
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    return _picture(figure)


def _above(scenery: Scenery, table: RecordTable, values: NDArray[Any], colouring: tuple[str, bool]) -> str:
    """Picture of the records from above, with the camera."""
    up = int(np.abs(scenery.pose.to_world[:3, 1]).argmax())
    across, along = (axis for axis in range(3) if axis != up)
    figure, axes = _figure(10, 6)
    places = table.position[:, across], table.position[:, along]
    _scatter(figure, axes, places, values, colouring, 4 if len(values) < 20000 else 1)
    eye, ahead = scenery.pose.origin, scenery.pose.direction
    axes.plot(eye[across], eye[along], "o", color="#f2b134", markersize=8)
    length = 0.1 * np.ptp(table.position, axis=0).max() if len(values) else 1.0
    step = length * np.array([ahead[across], ahead[along]])
    axes.annotate(
        "",
        (eye[across] + step[0], eye[along] + step[1]),
        (eye[across], eye[along]),
        arrowprops={"arrowstyle": "-|>", "color": "#f2b134", "lw": 2},
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[across]}, metres", ylabel=f"{'xyz'[along]}, metres")
    axes.tick_params(colors="#bbb")
    axes.xaxis.label.set_color("#bbb")
    axes.yaxis.label.set_color("#bbb")
    return _picture(figure)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=110, layout="constrained", facecolor="#16181b")
    axes = figure.add_subplot(facecolor="#16181b")
    return figure, axes


def _scatter(
    figure: Any,
    axes: Any,
    places: tuple[Any, Any],
    values: NDArray[Any],
    colouring: tuple[str, bool],
    size: float,
) -> None:
    """Draw dots in the colours of their values: on a scale for quantities, one colour each for a few kinds."""
    from matplotlib.colors import LogNorm, Normalize

    name, named = colouring
    x, y = places
    kinds = np.unique(values)
    if named and len(kinds) <= 10:
        for colour, kind in enumerate(kinds):
            chosen = values == kind
            label = f"{name} {kind}" if kind >= 0 else f"audit round {-kind}"
            axes.scatter(x[chosen], y[chosen], size, f"C{colour}", linewidths=0, label=label)
        if len(kinds):
            axes.legend(loc="upper right", markerscale=2, fontsize=8)
        return
    finite = values[np.isfinite(values)] if not named else values
    low, high = np.percentile(finite, [2, 98]) if len(finite) else (0.0, 1.0)
    norm = LogNorm(low, high) if not named and 0 < low < high else Normalize(low, max(high, low + 1e-9))
    dots = axes.scatter(x, y, size, values, cmap="turbo", norm=norm, linewidths=0)
    bar = figure.colorbar(dots, ax=axes, fraction=0.03, pad=0.01)
    bar.ax.tick_params(which="both", colors="#bbb", labelsize=8)


def _picture(figure: Any) -> str:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return data_url("image/png", content.getvalue())
