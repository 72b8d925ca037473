from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.file import CacheFile, encode_cache
from steadylight.cache.lookup import look_up
from steadylight.cache.merge import REDUNDANT, canonical_order, merge_caches
from steadylight.cache.records import Records


def changed(records: Records, **changes: np.ndarray) -> Records:
    arrays = {name: getattr(records, name) for name in Records.SHAPES}
    return Records(**(arrays | changes))


@pytest.fixture(scope="module")
def caches(records_of: Any) -> list[Records]:
    """Four frames' caches; the last repeats part of the first, as frames that see the same wall would."""
    parts = [records_of(seed, 150) for seed in (1, 2, 3)]
    return [*parts, parts[0].take(np.arange(0, 150, 2))]


def encoded(records: Records) -> bytes:
    return encode_cache(CacheFile(records, "0" * 64, {}))


def test_the_order_of_the_caches_and_of_their_records_does_not_change_a_byte(caches: list[Records]) -> None:
    expected = encoded(merge_caches(caches))
    rng = np.random.default_rng(1)
    for _ in range(4):
        shuffled = [caches[i] for i in rng.permutation(len(caches))]
        shuffled = [cache.take(rng.permutation(len(cache))) for cache in shuffled]
        assert encoded(merge_caches(shuffled)) == expected


def test_records_that_differ_in_their_gradients_alone_have_an_order_too(records_of: Any) -> None:
    record = records_of(1, 1)
    other = changed(record, translation=record.translation + 1)
    assert encoded(merge_caches([record, other])) == encoded(merge_caches([other, record]))


def test_merging_again_changes_nothing(caches: list[Records]) -> None:
    merged = merge_caches(caches)
    assert encoded(merge_caches([merged, merged])) == encoded(merged)


def test_duplicates_are_dropped_and_records_apart_are_kept(records_of: Any) -> None:
    apart = records_of(1, 8, radius=(0.01, 0.02))
    assert len(merge_caches([apart, apart, apart])) == len(merge_caches([apart])) == 8


def pair(offset: float, radius: float, normal: Any = (0, 0, 1)) -> Records:
    """A record of radius 1 m that faces up, and one `offset` away with another radius and normal."""
    count = 2
    return Records.undivided(
        position=np.float32([[0.1, 0.1, 0.1], [0.1 + offset, 0.1, 0.1]]),
        normal=np.float32([[0, 0, 1], normal]),
        irradiance=np.ones((count, 1, 3), np.float32),
        translation=np.zeros((count, 1, 3, 3), np.float32),
        rotation=np.zeros((count, 1, 3, 3), np.float32),
        curvature=np.zeros((count, 1), np.float32),
        radius=np.float32([1, radius]),
        standard_error=np.zeros((count, 1), np.float32),
    )


def test_the_record_of_smaller_radius_survives() -> None:
    merged = merge_caches([pair(0.9 * REDUNDANT, 1.5)])
    np.testing.assert_array_equal(merged.radius, [1])


@pytest.mark.parametrize(
    ("offset", "radius", "normal"),
    [
        (1.1 * REDUNDANT, 1.5, (0, 0, 1)),  # too far away
        (0.1, 2.5, (0, 0, 1)),  # answers much farther off, where points still need it
        (0.1, 1.5, (0.6, 0, 0.8)),  # faces elsewhere
    ],
    ids=["distance", "radius", "normal"],
)
def test_records_that_no_other_stands_in_for_are_kept(
    offset: float, radius: float, normal: tuple[float, ...]
) -> None:
    assert len(merge_caches([pair(offset, radius, normal)])) == 2


def test_most_dropped_records_are_answered_by_those_that_were_kept(caches: list[Records]) -> None:
    merged = merge_caches(caches)
    everything = Records.concatenate(*caches)
    assert len(merged) < len(everything)
    # Not all: a neighbour straight above or below is near, but its ellipsoid is flat.
    weight = look_up(everything.position, everything.normal, merged).weight
    assert (weight > 0).mean() > 0.97


def test_nothing_merges_to_nothing() -> None:
    assert len(merge_caches([])) == len(merge_caches([Records.empty(), Records.empty()])) == 0
    assert len(canonical_order(Records.empty())) == 0


def test_adding_a_record_does_not_reorder_the_others(caches: list[Records]) -> None:
    order = canonical_order(caches[0])
    far = changed(caches[1].take(np.array([0])), position=np.float32([[-70, 300, 12]]))
    both = canonical_order(Records.concatenate(caches[0], far))
    np.testing.assert_array_equal(both[both < len(caches[0])], order)


def test_neighbours_in_memory_are_neighbours_in_space(caches: list[Records]) -> None:
    ordered = caches[0].take(canonical_order(caches[0]))
    steps = np.linalg.norm(np.diff(ordered.position, axis=0), axis=1).mean()
    assert steps < 0.5 * np.linalg.norm(np.diff(caches[0].position, axis=0), axis=1).mean()
