"""What gloss shows faintly is answered by the secondary cache: it asks for no records, and is as bright."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_scenes import described, lamp, renderer, room

from steadylight.cache.octree import Cube
from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.records.lookup import DeviceCache, Part, PartedCache
from steadylight.renderers.mitsuba.renderer import Renderer

GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
MIDDLE = np.s_[14:34, 14:34]


def golden(first_pass: str, faint: float) -> Renderer:
    """Looks at a golden sphere in a lit room; what it shows with a share of a sample below `faint` is faint."""
    content = room(GOLD) | {"lamp": lamp()}
    made = renderer(described(content), spp=64, bounces=4, first_pass=first_pass, denoise=False)
    made.view.limits = made.view.limits.asking(faint)
    return made


def asked_and_seen(made: Renderer) -> tuple[int, Any]:
    """How many points the frame asks records for, and the frame from a cache that has these."""
    _ = made.filler
    found = made.audit([1], made.load(Records.empty()), last=True)
    records = made.fill([found.points], Records.empty(), 1)
    return found.missed, made.shade(1, made.load(records))


@pytest.fixture(scope="module")
def exact() -> tuple[int, Any]:
    return asked_and_seen(golden("frames", 0.0))


def test_faint_gloss_asks_for_no_records_and_is_as_bright(exact: tuple[int, Any]) -> None:
    asked, seen = asked_and_seen(golden("surface", 10.0))
    assert asked < 0.8 * exact[0]
    assert seen.missed == exact[1].missed == 0
    assert seen.image[MIDDLE].mean() == pytest.approx(exact[1].image[MIDDLE].mean(), rel=0.02)


def test_where_the_secondary_cache_has_no_answer_either_the_path_goes_on(exact: tuple[int, Any]) -> None:
    made = golden("surface", 10.0)
    _ = made.filler
    made.view.answer_faint(DeviceCache(Records.empty()))
    asked, seen = asked_and_seen(made)
    assert asked < 0.8 * exact[0]
    assert seen.missed == 0
    assert seen.image[MIDDLE].mean() == pytest.approx(exact[1].image[MIDDLE].mean(), rel=0.03)


def test_bright_gloss_asks_for_records(exact: tuple[int, Any]) -> None:
    """Gold reflects some nine tenths, in several directions with a part of them each."""
    made = golden("surface", 0.7)
    assert made.view.limits.glossy_branches > 1
    asked, seen = asked_and_seen(made)
    assert asked > 0.95 * exact[0]
    assert seen.missed == 0


def test_one_bounce_is_exact(exact: tuple[int, Any]) -> None:
    """The secondary cache would have none."""
    content = room(GOLD) | {"lamp": lamp()}
    made = renderer(described(content), spp=64, bounces=1, first_pass="surface")
    assert made.view.limits.faint[0] == 0
    assert asked_and_seen(made)[0] == pytest.approx(exact[0], rel=0.05)


def test_what_is_loaded_besides_changes_no_bit() -> None:
    made = golden("surface", 10.0)
    _ = made.filler
    records = made.fill([made.audit([1], made.load(Records.empty()), last=True).points], Records.empty(), 1)
    left = records.position[:, 0] < 0
    halves = {"left": records.take(np.flatnonzero(left)), "right": records.take(np.flatnonzero(~left))}
    cube = Cube((-4.0, -4.0, -4.0), 9.0)
    both = PartedCache({name: Part(half) for name, half in halves.items()}, cube=cube)
    both.show(["left"])
    alone = PartedCache({"left": Part(halves["left"])}, cube=cube)
    images = [made._shader.shade(cache, 7).image for cache in (both, alone)]
    assert images[0].mean() > 0
    np.testing.assert_array_equal(*images)
