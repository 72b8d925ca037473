"""The page of a preview: frames, plan, eye heights, and how the scene was understood."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from steadylight.report.charts import Series, line_chart
from steadylight.report.embedding import data_url, jpeg, page_from

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class PreviewPage:
    """What the page shows.

    Attributes:
        title: title of the scene.
        pictures: frames, by caption.
        plan: plan from above; None if there is none.
        plan_says: description of the plan, for screen readers.
        heights: frame numbers, and heights of the eye above the floor, metres.
        facts: what was understood, as sentences without a full stop.
        warnings: what is likely wrong.
        notes: kind, place and text of each note on what was converted, approximated or left out.
    """

    title: str
    pictures: Mapping[str, Pixels]
    plan: Pixels | None
    plan_says: str
    heights: tuple[Sequence[int], Sequence[float]]
    facts: Sequence[str]
    warnings: Sequence[str]
    notes: Sequence[tuple[str, str, str]]


def preview_page(page: PreviewPage) -> str:
    """The page as HTML that needs no other file."""
    frames, heights = page.heights
    chart = line_chart(Series(frames, heights, "m"), title="Height of the eye") if len(frames) > 1 else ""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for kind, where, text in page.notes:
        kinds.setdefault(kind, []).append((where, text))
    return page_from(
        "preview.html",
        title=page.title,
        warnings=page.warnings,
        facts=[fact[:1].upper() + fact[1:] for fact in page.facts],
        pictures=[
            {"caption": caption, "source": data_url("image/jpeg", jpeg(pixels, 90))}
            for caption, pixels in page.pictures.items()
        ],
        plan=None if page.plan is None else data_url("image/png", _png(page.plan)),
        plan_says=page.plan_says,
        chart=chart,
        notes=kinds,
    )


def _png(pixels: Pixels) -> bytes:
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, format="PNG", optimize=True)
    return content.getvalue()
