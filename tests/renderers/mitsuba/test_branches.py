"""Branches of camera paths: how many there are, and that audit and frame walk the same ones."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import described, lamp, paint, place, renderer, room
from test_misses import CONTENT
from window_scenes import CLEAR, OUTSIDE, window

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.image import pixels
from steadylight.renderers.mitsuba.image.pixels import passes
from steadylight.renderers.mitsuba.paths.audit import Audit, audit
from steadylight.renderers.mitsuba.paths.branches import Branches
from steadylight.renderers.mitsuba.paths.misses import MissList
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.renderers.mitsuba.sampling import samples_of

WHITE = {"type": "twosided", "bsdf": paint(0.7, 0.7, 0.7)}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.02}
LAYERED = {"type": "roughplastic", "alpha": 0.02}
MIXED = {"type": "blendbsdf", "weight": 0.4, "first": paint(0.6, 0.3, 0.2), "second": GOLD}


def panes(count: int, glass: str = "thindielectric") -> dict[str, Any]:
    """Panes close to the camera, wider than what it sees; plates 2 cm thick if they are of solid glass."""
    shape = "rectangle" if glass == "thindielectric" else "cube"
    return {
        f"pane{number}": {
            "type": shape,
            "to_world": place((3, 3, 0.01), (0, -4.5 + 0.1 * number, 1.6), degrees=90),
            "bsdf": {"type": glass},
        }
        for number in range(count)
    }


def closed(wall: dict[str, Any] = WHITE, **more: Any) -> dict[str, Any]:
    """A wall before the camera, and white ones all around: every path ends on one of them."""
    ahead = {"type": "rectangle", "to_world": place((9, 9, 1), (0, 2, 1.5), degrees=90), "bsdf": wall}
    around = {"type": "cube", "to_world": place((9, 9, 9)), "bsdf": WHITE}
    bulb = {"type": "point", "position": [0, -1, 2], "intensity": 5.0}
    return {"ahead": ahead, "around": around, "bulb": bulb, **more}


def both(made: Renderer, records: Records, spp: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Look-ups without an answer on each path: by the audit, and by the frame."""
    made._look_from(1)
    view, cache = made.view, made.load(records)
    audited, shaded = [], []
    for part in passes(view.camera, spp, 0):
        samples, ray, _ = part.rays(view.camera, 7)
        found = MissList(40 * part.lanes(view.camera))
        count = audit(view._unlit, samples, ray, Audit(cache, view.trust(), found, probed=False), view.limits)
        dr.eval(count)
        assert found.count == int(dr.sum(count)[0])
        audited.append(np.array(count))
        seen = view.shade(samples, ray, cache)
        shaded.append(np.array(seen.missed + dr.zeros(mi.UInt32, part.lanes(view.camera))))
    return np.concatenate(audited), np.concatenate(shaded)


def with_faint_paths(made: Renderer) -> Renderer:
    """The same, and no path ends by chance."""
    made.view.limits.negligible = dr.opaque(mi.Float, 1e-6)
    return made


@pytest.mark.parametrize("count", range(5))
def test_every_pane_adds_the_branch_that_it_reflects(count: int) -> None:
    made = renderer(described(closed(**panes(count))), width=12, height=12, depth=60)
    audited, shaded = both(made, Records.empty())
    np.testing.assert_array_equal(audited, count + 1)
    np.testing.assert_array_equal(shaded, count + 1)


def test_beyond_the_fourth_pane_chance_decides() -> None:
    made = renderer(described(closed(**panes(7))), width=12, height=12, depth=60)
    audited, shaded = both(made, Records.empty())
    np.testing.assert_array_equal(audited, 5)
    np.testing.assert_array_equal(shaded, 5)


@pytest.mark.parametrize("count", [0, 2])
def test_a_layered_surface_asks_for_its_base_and_for_what_its_layer_shows(count: int) -> None:
    made = with_faint_paths(
        renderer(described(closed(LAYERED, **panes(count))), width=12, height=12, depth=60)
    )
    audited, shaded = both(made, Records.empty())
    np.testing.assert_array_equal(shaded, audited)
    # What a pane reflects is the white wall behind the camera; few paths meet the layer once more between panes, and
    # few samples of a rough layer go below the horizon.
    assert np.mean(audited == 2 + count) > 0.98


@pytest.mark.parametrize("directions", [1, 4])
@pytest.mark.parametrize("count", [0, 2])
def test_a_glossy_surface_is_left_in_so_many_directions(directions: int, count: int) -> None:
    made = with_faint_paths(renderer(described(closed(GOLD, **panes(count))), width=12, height=12, depth=60))
    made.view.limits.glossy_branches = directions
    audited, shaded = both(made, Records.empty())
    np.testing.assert_array_equal(shaded, audited)
    assert np.mean(audited == directions + count) > 0.95
    assert audited.max() == directions + count


def test_what_a_layer_shows_is_followed_by_chance_and_panes_by_all_paths() -> None:
    made = renderer(described(closed(LAYERED, **panes(2))), width=48, height=48, depth=60)
    made.view.limits.negligible = dr.opaque(mi.Float, 0.1)  # at a right angle, plastic reflects 0.039
    audited, shaded = both(made, Records.empty())
    np.testing.assert_array_equal(shaded, audited)
    assert audited.min() == 3  # the base, and what each pane reflects
    assert np.mean(audited == 4) == pytest.approx(0.39 * 0.92**2, abs=0.03)


MORE = {
    "five plates of glass": room(GOLD) | panes(5, "dielectric") | {"lamp": lamp()},
    "a mixture behind a pane": room(MIXED) | panes(1) | {"lamp": lamp()},
    "a mask behind a pane": (
        room({"type": "mask", "opacity": 0.5, "bsdf": GOLD}) | panes(1) | {"lamp": lamp()}
    ),
    "two panes in the window of a closed room": window(CLEAR, CLEAR) | {"sun": OUTSIDE["directional"]},
    "principled": room({"type": "principled", "roughness": 0.2, "metallic": 0.5}) | {"lamp": lamp()},
}


EVERY = CONTENT | MORE


@pytest.mark.parametrize("passed", [0, 2])
def test_the_ways_that_leave_a_glossy_surface_are_drawn_from_a_part_of_the_square_each(passed: int) -> None:
    ways, samples = 4, samples_of(mi.UInt32(5), mi.UInt32(9), dr.arange(mi.UInt32, 16))
    parts = []
    # Behind delta dielectrics, branches that these reflect come between the first and the others.
    for number in (0, *range(passed + 1, passed + ways)):
        branches = Branches.begin()
        branches.number, branches.shared = mi.UInt32(number), mi.UInt32(passed)
        draw = branches.draw(samples, mi.UInt32(passed), mi.UInt32(ways), mi.Bool(True))
        parts.append(np.array(draw.place).T)
    for way, part in enumerate(parts):
        np.testing.assert_array_equal(np.floor(part[:, 0] * ways), way)
        # Its sixteen samples are stratified there, too.
        assert len(set(np.floor(part[:, 0] * ways * 16))) == 16


@pytest.mark.parametrize("content", EVERY.values(), ids=EVERY)
def test_the_audit_meets_on_every_path_what_the_frame_meets(content: dict[str, Any]) -> None:
    made = renderer(described(content), width=24, height=24, bounces=1)
    audited, shaded = both(made, Records.empty())
    assert audited.sum() > 1000
    np.testing.assert_array_equal(shaded, audited)


@pytest.mark.parametrize(
    ("size", "spp", "sensor"),
    [((1, 1), 1, "perspective"), ((7, 5), 100, "thinlens"), ((33, 2), 65, "perspective")],
)
def test_audit_and_frame_agree_for_any_size_and_number_of_samples(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], spp: int, sensor: str
) -> None:
    lens = {"aperture_radius": 0.1, "focus_distance": 5.0} if sensor == "thinlens" else {}
    content = described(CONTENT["a coat beside a lamp behind two panes"], sensor={"type": sensor, **lens})
    made = renderer(content, width=size[0], height=size[1], spp=spp, bounces=1)
    cache = made.load(Records.empty())
    for lanes in (1 << 24, size[0] * 2 * spp):
        monkeypatch.setattr(pixels, "SAMPLES_AT_ONCE", lanes)
        found = made.audit([1], cache, last=True)
        assert found.looked_up == size[0] * size[1] * spp
        assert found.missed == made._shader.shade(cache, made._shade_seed(1)).missed >= found.looked_up
