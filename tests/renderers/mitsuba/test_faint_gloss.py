"""What gloss shows faintly is answered by the secondary cache: it asks for no records, and is as bright.

So is what gloss shows in pixels that get more samples than the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import adapt, described, lamp, renderer, room, sample_again

from steadylight.cache.octree import Cube
from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.image import picture
from steadylight.renderers.mitsuba.image.adaptive import estimates
from steadylight.renderers.mitsuba.image.pixels import Sampling
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


@pytest.fixture(scope="module")
def rough_gold() -> Iterator[tuple[Renderer, DeviceCache]]:
    """Few samples of a sphere of gold, whose light is `rest`; and the cache of a frame. All of it may be noisy."""
    content = room(GOLD | {"alpha": 0.5}) | {"lamp": lamp()}
    made = renderer(described(content), spp=8, bounces=4, first_pass="surface")
    sample_again(made, "direct", threshold=0.0, pixels=1.0, rays=64.0)
    adapt(made, worth_rest=0.0)
    _ = made.filler
    found = made.audit([1], made.load(Records.empty()), last=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(picture, "PROMINENT", 0.0)
        yield made, made.load(made.fill([found.points], Records.empty(), 1)).with_fallback()


def frames_of(made: Renderer, cache: DeviceCache, count: int) -> np.ndarray:
    return np.stack([made._shader.shade(cache, seed).image for seed in range(count)])


def test_pixels_whose_gloss_is_noisy_get_more_samples_and_the_mean_stays(
    rough_gold: tuple[Renderer, DeviceCache],
) -> None:
    made, cache = rough_gold
    sample_again(made, "rest", threshold=np.inf)
    plain = frames_of(made, cache, 24)
    sample_again(made, "rest", threshold=0.0, pixels=1.0, rays=16.0)
    finer = frames_of(made, cache, 24)
    assert finer[:, 14:34, 14:34].mean() == pytest.approx(plain[:, 14:34, 14:34].mean(), rel=0.005)
    # Of the median pixel: at the silhouette, there is the noise of what the camera sees, too.
    noise, without = (np.median(each.var(axis=0, ddof=1)[MIDDLE]) for each in (finer, plain))
    assert noise < 0.6 * without


def test_a_picture_with_little_noise_of_gloss_gets_no_more_samples_of_it(
    rough_gold: tuple[Renderer, DeviceCache],
) -> None:
    made, cache = rough_gold
    sample_again(made, "rest", threshold=np.inf)
    plain = frames_of(made, cache, 1)
    sample_again(made, "rest", threshold=0.0, pixels=1 / 4)
    finer = frames_of(made, cache, 1)
    try:
        adapt(made, worth_rest=1.0)
        quiet = frames_of(made, cache, 1)
    finally:
        adapt(made, worth_rest=0.0)
    assert finer.tobytes() != plain.tobytes()
    assert quiet.tobytes() == plain.tobytes()


def test_many_samples_that_go_on_in_one_direction_have_the_mean_of_few_that_go_on_in_several(
    rough_gold: tuple[Renderer, DeviceCache],
) -> None:
    made, _ = rough_gold
    width, height = made.view.camera.size
    pixels = np.arange(width * height).reshape(height, width)[MIDDLE].ravel()
    box = mi.load_dict({"type": "box"})
    few, many = (estimates(look, box, Sampling(256, 1), pixels).mean for look in made._shader._rest_seen)
    assert 0 < few.mean() == pytest.approx(many.mean(), rel=0.005)
    assert np.abs(few - many).mean() < 0.1 * few.mean()


def test_a_frame_with_noisy_gloss_has_the_same_bytes_on_any_number_of_threads(
    rough_gold: tuple[Renderer, DeviceCache],
) -> None:
    made, cache = rough_gold
    sample_again(made, "rest", threshold=0.0, pixels=1 / 4)
    first = frames_of(made, cache, 1)
    threads = dr.thread_count()
    try:
        for number in (1, 3):
            dr.set_thread_count(number)
            assert frames_of(made, cache, 1).tobytes() == first.tobytes()
    finally:
        dr.set_thread_count(threads)
