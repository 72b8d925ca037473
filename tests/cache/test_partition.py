"""A cache in parts has the bytes of the whole one, and every record is in exactly one part."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from steadylight.cache.file import CacheFile, encode_cache
from steadylight.cache.merge import canonical_order, merge_caches
from steadylight.cache.partition import (
    MARGIN,
    Partition,
    concatenate_parts,
    divide_space,
    merge_part,
    smooth_part,
)
from steadylight.cache.records import Records
from steadylight.cache.smoothing import smooth

HALL = np.array([[0.0, 0, 0], [40, 20, 10]])


def caches_of(count, each, seed, *, longest=0.3, size=(4, 2, 1)):
    """Caches of the same walls: records crowd, with reaches of very different length, some of them equal."""
    random = np.random.default_rng(seed)
    caches = []
    for _ in range(count):
        position = random.uniform((0, 0, 0), size, (each, 3)).astype(np.float32)
        position[:, 2] = size[2] * np.round(position[:, 2] / size[2])  # floor and ceiling
        normal = np.zeros((each, 3), np.float32)
        normal[:, 2] = 1 - 2 * position[:, 2] / size[2]
        values = {name: random.random((each, *shape), np.float32) for name, shape in Records.SHAPES.items()}
        radius = np.round(random.uniform(0.02, longest, each), 2)
        caches.append(
            Records(**{**values, "position": position, "normal": normal, "radius": radius.astype("f4")})
        )
    return caches


def divided(caches, count):
    longest = max((float(cache.radius.max(initial=0)) for cache in caches), default=0.1)
    return divide_space(
        [cache.position for cache in caches], count, longest, np.array([[0, 0, 0], [4, 2, 1]])
    )


def content(records):
    return encode_cache(CacheFile(records, "0" * 64, {}))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("seed", [1, 2])
def test_merged_parts_have_the_bytes_of_the_whole(count, seed):
    caches = caches_of(6, 700, seed)
    partition = divided(caches, count)
    parts = [merge_part(caches, partition, part) for part in range(count)]
    assert content(concatenate_parts(parts)) == content(merge_caches(caches))
    assert sum(map(len, parts)) < sum(map(len, caches))


def test_the_order_of_caches_and_twice_the_same_cache_change_nothing():
    caches = caches_of(3, 300, 5)
    partition = divided(caches, 5)
    for part in range(5):
        expected = content(merge_part(caches, partition, part))
        assert content(merge_part(caches[::-1], partition, part)) == expected
        assert content(merge_part([*caches, caches[0]], partition, part)) == expected


def test_nothing_merges_to_nothing():
    partition = divide_space([], 3, 0.1, HALL)
    assert len(concatenate_parts([merge_part([], partition, part) for part in range(3)])) == 0
    assert len(merge_part([Records.empty()], partition, 1)) == 0


ROW = (4, 0.4, 0.3)
"""A long row of narrow parts: what a neighbour's gradient is worth is told by its neighbours, two parts further on."""


@pytest.mark.parametrize(
    ("count", "each", "size", "parts"), [(4, 900, (4, 2, 1), 6), (1, 900, ROW, 24)], ids=["hall", "row"]
)
def test_parts_smoothed_with_their_neighbours_have_the_bytes_of_the_whole_smoothed(count, each, size, parts):
    merged = merge_caches(caches_of(count, each, 7, longest=0.1, size=size))
    partition = divide_space([merged.position], parts, 0.1, np.array([np.zeros(3), size]))
    assert any(len(partition.around([part])) < parts for part in range(parts))
    part_of = partition.part_of(merged.position)
    own = [merged.take(part_of == part) for part in range(parts)]
    finished = []
    for part in range(parts):
        others = [own[other] for other in partition.around([part]) if other != part]
        finished.append(smooth_part(own[part], others, 0.1))
    assert content(concatenate_parts(finished)) == content(smooth(merged, longest=0.1))


@pytest.mark.parametrize("count", [1, 2, 5, 16])
def test_every_position_lies_in_exactly_one_part(count):
    random = np.random.default_rng(1)
    points = random.uniform(*HALL, (5000, 3)).astype(np.float32)
    partition = divide_space([points], count, 0.2, HALL)
    assert partition.count == count
    far = np.float32([[1e6, -1e6, 0], [-1e6, 0, 1e6]])
    on_planes = points[:500].copy()
    for number, (axis, value) in enumerate(partition.splits):
        on_planes[number::count, axis] = value
    everywhere = np.concatenate([points, far, on_planes])
    inside = [((everywhere >= low) & (everywhere < high)).all(axis=1) for low, high in partition.boxes]
    assert (np.sum(inside, axis=0) == 1).all()
    np.testing.assert_array_equal(np.argmax(inside, axis=0), partition.part_of(everywhere))
    sizes = np.bincount(partition.part_of(points), minlength=count)
    assert sizes.min() > 0.4 * len(points) / count


def test_the_longest_side_is_divided_first():
    points = np.random.default_rng(2).uniform(*HALL, (4000, 3)).astype(np.float32)
    partition = divide_space([points], 4, 0.2, HALL)
    assert partition.splits[0][0] == 0
    assert partition.splits[0][1] == pytest.approx(20, abs=4)


def test_where_the_work_is_told_it_is_halved_and_not_what_is_seen():
    random = np.random.default_rng(6)
    seen = random.uniform(*HALL, (4000, 3)).astype(np.float32)
    crowd = seen[seen[:, 0] > 30]
    partition = divide_space([seen], 2, 0.2, HALL, crowd)
    assert np.bincount(partition.part_of(crowd)) == pytest.approx([len(crowd) / 2] * 2, rel=0.2)
    assert partition.windows == ((0, 1),)


def test_no_wall_is_divided_along_itself():
    wall = np.random.default_rng(8).uniform(*HALL, (4000, 3)).astype(np.float32)
    wall[1000:3000, 0] = 20 + 1e-6 * np.arange(2000)
    (axis, _), *_ = divide_space([wall], 2, 0.2, HALL).splits
    assert axis == 1  # across it


def test_parts_of_rooms_whose_walls_lie_along_the_axes_hold_about_as_much_each():
    random = np.random.default_rng(9)
    points = random.uniform(*HALL, (20_000, 3)).astype(np.float32)
    for axis, values in enumerate([(0, 13, 26, 40), (0, 20), (0, 10)]):
        rows = np.arange(len(points)) % 3 == axis
        points[rows, axis] = random.choice(np.float32(values), np.count_nonzero(rows))
    for count in (8, 64):
        sizes = np.bincount(divide_space([points], count, 0.2, HALL).part_of(points), minlength=count)
        assert sizes.max() < 1.3 * len(points) / count


def test_a_window_sees_the_parts_that_its_points_are_near():
    left, right = np.float32([[1, 1, 0]]), np.float32([[39, 1, 0]])
    rest = np.random.default_rng(3).uniform(*HALL, (4000, 3)).astype(np.float32)
    partition = divide_space([left, right, rest, np.zeros((0, 3), np.float32)], 8, 0.5, HALL)
    first, last = partition.part_of(np.concatenate([left, right]))
    assert partition.windows == ((first,), (last,), tuple(range(8)), ())
    along = np.linspace(15, 25, 101)
    looks = [np.float32([[x, 0, 0], [x, 20, 10]]) for x in along]
    partition = divide_space(looks, 2, 0.5, HALL, rest)
    ((axis, plane),) = partition.splits
    assert axis == 0
    expected = [(0, 1) if abs(x - plane) <= 0.5 else (int(x > plane),) for x in along]
    assert list(partition.windows) == expected
    assert len(set(expected)) == 3


def test_rooms_that_windows_see_one_at_a_time_are_parts():
    random = np.random.default_rng(10)
    rooms = [random.uniform((10 * k, 0, 0), (10 * k + 8, 20, 10), (500 + 40 * k, 3)) for k in range(4)]
    partition = divide_space([room.astype(np.float32) for room in rooms], 4, 0.3, HALL)
    assert partition.windows == ((0,), (1,), (2,), (3,))


@pytest.mark.parametrize("count", [2, 7, 64])
def test_with_fewer_points_than_parts_boxes_still_fill_space_once(count):
    few = np.random.default_rng(11).uniform(5, 10, (10, 3)).astype(np.float32)
    partition = divide_space([few], count, 0.2, HALL)
    everywhere = np.random.default_rng(12).uniform(-20, 60, (5000, 3)).astype(np.float32)
    inside = [((everywhere >= low) & (everywhere < high)).all(axis=1) for low, high in partition.boxes]
    assert (np.sum(inside, axis=0) == 1).all()
    assert (partition.boxes[:, 0] <= partition.boxes[:, 1]).all()
    assert Partition.from_plain(json.loads(json.dumps(partition.plain()))) == partition


def test_neighbours_are_all_parts_with_records_that_may_concern_a_part():
    points = np.random.default_rng(4).uniform(*HALL, (4000, 3)).astype(np.float32)
    partition = divide_space([points], 16, 0.5, HALL)
    owner = partition.part_of(points)
    for part in range(16):
        near = partition.around([part])
        assert part in near
        own = points[owner == part]
        distance = np.linalg.norm(points[:, None] - own[None, ::10], axis=2).min(axis=1)
        assert set(owner[distance < MARGIN * 0.5]) <= set(near)
    assert len(partition.around([0])) < 16
    assert partition.around([]) == []
    assert partition.around([0, 5]) == sorted({*partition.around([0]), *partition.around([5])})


def test_what_nobody_foresaw_belongs_to_the_nearest_part_that_the_window_reads():
    points = np.random.default_rng(5).uniform(*HALL, (4000, 3)).astype(np.float32)
    partition = divide_space([points], 8, 0.5, HALL)
    part = partition.part_of(points)
    np.testing.assert_array_equal(partition.owner_of(points, range(8)), part)
    seen = [0, 1]
    owner = partition.owner_of(points, seen)
    assert set(owner) == {0, 1}
    kept = np.isin(part, seen)
    np.testing.assert_array_equal(owner[kept], part[kept])


def test_a_partition_survives_json():
    points = np.random.default_rng(6).uniform(*HALL, (400, 3)).astype(np.float32)
    partition = divide_space([points[:9], points], 6, 0.25, HALL)
    assert Partition.from_plain(json.loads(json.dumps(partition.plain()))) == partition
    assert partition.cube is not None
    low = np.array(partition.cube.origin)
    assert (low <= HALL[0] - MARGIN * 0.25).all()
    assert (low + partition.cube.size >= HALL[1] + MARGIN * 0.25).all()


def test_one_part_is_the_whole_cache():
    whole = Partition.whole(3)
    caches = caches_of(3, 200, 8)
    assert content(merge_part(caches, whole, 0)) == content(merge_caches(caches))
    assert whole.windows == ((0,), (0,), (0,))
    assert whole.around([0]) == [0]
    assert dataclasses.replace(whole).count == 1


def test_the_rows_of_a_part_keep_the_order_of_the_whole():
    merged = merge_caches(caches_of(3, 500, 9))
    partition = divided([merged], 4)
    for part in range(4):
        rows = np.flatnonzero(partition.part_of(merged.position) == part)
        np.testing.assert_array_equal(canonical_order(merged.take(rows)), np.arange(len(rows)))


@pytest.mark.parametrize("seed", [84, 100, 114, 124])
def test_parts_have_those_bytes_where_single_paths_light_what_is_dark(seed):
    # Few records have light of many paths; most of the others have all theirs by one, and nobody to share it with.
    rng = np.random.default_rng(seed)
    (records,) = caches_of(1, int(rng.integers(40, 400)), seed, longest=0.1, size=ROW)
    count = len(records)
    lit = rng.random(count) < rng.uniform(0.02, 0.3)
    one = ~lit & (rng.random(count) < 0.7)
    E, brightest = np.zeros((count, 1, 3), np.float32), np.zeros((count, 1, 2), np.float32)
    E[lit] = 1
    E[one] = rng.choice([1, 2, 4], one.sum())[:, None, None]
    brightest[one] = E[one][:, :, :2]
    records = dataclasses.replace(
        records,
        irradiance=E,
        difference=np.zeros_like(E),
        brightest=brightest,
        guide=np.repeat(E.mean(axis=2)[:, :, None], 2, axis=2),
        radius=rng.uniform(0.06, 0.1, count).astype(np.float32),
        standard_error=np.full((count, 1), 0.5, np.float32),
        guide_error=np.full((count, 1, 2), 0.5, np.float32),
        headroom=np.full(count, np.inf, np.float32),
        barriers=np.zeros((count, 2, 3), np.float32),
    )
    merged = merge_caches([records])
    partition = divide_space([merged.position], 24, 0.1, np.array([np.zeros(3), ROW]))
    part_of = partition.part_of(merged.position)
    own = [merged.take(part_of == part) for part in range(24)]
    finished = [
        smooth_part(own[part], [own[n] for n in partition.around([part]) if n != part], 0.1)
        for part in range(24)
    ]
    assert content(concatenate_parts(finished)) == content(smooth(merged, longest=0.1))
