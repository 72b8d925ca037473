"""The page of a preview in a browser: whole, accessible, in light and dark, on a wide and on a narrow screen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from steadylight.report.preview import PreviewPage, preview_page

if TYPE_CHECKING:
    from collections.abc import Callable

    from visits import Visit


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with everything: pictures, a plan, heights, warnings, and notes with long names."""
    rng = np.random.default_rng(5)
    pictures = {
        f"frame {n}, {n / 25:.1f} s": rng.integers(0, 255, (90, 160, 3), np.uint8) for n in (1, 90, 180)
    }
    made = PreviewPage(
        title="a folder with a very long name/scene of a house with an unusually_long_name_without_any_spaces",
        pictures=pictures,
        plan=rng.integers(0, 255, (400, 600, 3), np.uint8),
        plan_says="Plan from above, cut above eye height, 12.0 m wide, with the camera path and the lights",
        heights=(list(range(1, 200)), (1.6 + 0.1 * np.sin(np.arange(199) / 9)).tolist()),
        facts=("the room at frame 1 is 6.2 x 4.1 x 2.7 m", "the eye is 1.50 to 1.70 m above the floor"),
        warnings=("camera path: frames 13-14: the camera passes through a surface (`wall_3`) between them",),
        notes=[
            ("left out", "Material_with_a_long_name_" * 4, "sheen has no counterpart"),
            ("approximated", "glass", "thin glass"),
        ],
    )
    place = tmp_path_factory.mktemp("preview") / "house-preview.html"
    place.write_text(preview_page(made), encoding="utf-8")
    return place


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_and_nothing_is_wider_than_the_screen(
    page: Path, visit: Callable[..., Visit], width: int, scheme: str
) -> None:
    visited = visit(page.as_uri(), width=width, scheme=scheme)
    assert visited.findings() == []
    assert visited.overflow() == 0
    assert visited.complaints == []
    assert visited.asked == [page.as_uri()]
