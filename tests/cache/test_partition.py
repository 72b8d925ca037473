"""A merge in parts has the bytes of the plain one, however the parts are cut."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.cache.file import CacheFile, encode_cache
from steadylight.cache.merge import merge_caches
from steadylight.cache.partition import join_parts, merge_part, slabs_of
from steadylight.cache.records import Records


def caches_of(count, each, seed, *, longest=0.3):
    """Caches of the same walls: records crowd, with reaches of very different length, some of them equal."""
    random = np.random.default_rng(seed)
    caches = []
    for _ in range(count):
        position = random.uniform((0, 0, 0), (4, 2, 1), (each, 3)).astype(np.float32)
        position[:, 2] = np.round(position[:, 2])  # floor and ceiling
        normal = np.zeros((each, 3), np.float32)
        normal[:, 2] = 1 - 2 * position[:, 2]
        values = {name: random.random((each, *shape), np.float32) for name, shape in Records.SHAPES.items()}
        reach = np.round(random.uniform(0.02, longest, each), 2)
        caches.append(
            Records(**{**values, "position": position, "normal": normal, "reach": reach.astype("f4")})
        )
    return caches


def in_parts(caches, count):
    longest = max((float(cache.reach.max(initial=0)) for cache in caches), default=0.0)
    slabs = slabs_of([cache.position for cache in caches], longest, count)
    parts = [merge_part(caches, slab) for slab in slabs]
    return join_parts(parts), parts


def content(records):
    return encode_cache(CacheFile(records, "0" * 64, {}))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("seed", [1, 2])
def test_parts_have_the_bytes_of_the_whole(count, seed):
    caches = caches_of(6, 700, seed)
    merged, parts = in_parts(caches, count)
    assert content(merged) == content(merge_caches(caches))
    assert len(merged) < sum(map(len, caches))
    if count == 1:
        assert len(parts[0].undecided) == 0


def test_slabs_thinner_than_the_reach_of_records_leave_more_open_and_are_right_all_the_same():
    caches = caches_of(4, 400, 3, longest=2.0)
    merged, parts = in_parts(caches, 30)
    assert sum(len(part.undecided) for part in parts) > 0
    assert content(merged) == content(merge_caches(caches))


def test_most_records_are_decided_in_their_slab():
    caches = caches_of(6, 2000, 4, longest=0.1)
    _, parts = in_parts(caches, 4)
    undecided = sum(len(part.undecided) for part in parts)
    assert undecided < 0.05 * sum(len(part.kept) for part in parts)


def test_the_order_of_caches_and_twice_the_same_cache_change_nothing():
    caches = caches_of(3, 300, 5)
    assert content(in_parts(caches[::-1], 5)[0]) == content(in_parts(caches, 5)[0])
    assert content(in_parts([*caches, caches[0]], 5)[0]) == content(merge_caches(caches))


def test_nothing_merges_to_nothing():
    assert len(in_parts([], 3)[0]) == 0
    assert len(in_parts([Records.empty()], 3)[0]) == 0
