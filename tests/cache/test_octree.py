from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from steadylight.cache.compatibility import NORMAL_TOLERANCE
from steadylight.cache.lookup import pair_weights
from steadylight.cache.octree import Cube, Octree, build_octree, spread_bits
from steadylight.cache.records import Records


def listed(tree: Octree, position: np.ndarray, normal: np.ndarray) -> list[int]:
    """Rows on a query's way down, as a kernel would go."""
    axis = int(np.abs(normal).argmax())
    node = 2 * axis + int(normal[axis] < 0)
    cell = (position.astype(np.float64) - tree.origin) / tree.size
    rows: list[int] = []
    while (cell >= 0).all() and (cell < 1).all():
        child, begin, end, _ = (int(number) for number in tree.nodes[node])
        rows += tree.references[begin:end].tolist()
        if child == 0:
            break
        cell = 2 * cell
        octant = int((cell >= 1) @ [1, 2, 4])
        cell -= cell >= 1
        node = child + octant
    return rows


@pytest.mark.parametrize(
    ("radius", "count"), [((0.05, 0.8), 300), ((1e-3, 50), 300), ((1e-3, 2e-3), 200), ((0.3, 0.3001), 5)]
)
@pytest.mark.parametrize("stretch", [1.0, 3.0])
@pytest.mark.parametrize("finer", [0, 2])
def test_every_record_with_weight_is_listed_on_the_way_of_the_query(
    records_of: Any, queries_about: Any, radius: tuple[float, float], count: int, stretch: float, finer: int
) -> None:
    records = records_of(5, count, radius=radius)
    tree = build_octree(records, stretch=stretch, finer=finer)
    arrays = {name: getattr(records, name) for name in Records.SHAPES}
    stretched = Records(**{**arrays, "radius": records.radius * np.float32(stretch)})
    position, normal = queries_about(6, stretched, 8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("steadylight.cache.lookup.NORMAL_TOLERANCE", stretch * NORMAL_TOLERANCE)
        weights = pair_weights(position[:, None], normal[:, None], stretched)
    assert (weights > 0).sum() >= count  # the queries do meet records
    for p, n, weight in zip(position, normal, weights, strict=True):
        # Rounding of a position may pass over what has next to no weight: one part in 10^4 of full.
        missing = set(np.flatnonzero(weight > 1e-4)) - set(listed(tree, p, n))
        assert not missing


def test_a_query_reads_a_small_part_of_many_small_records(records_of: Any, queries_about: Any) -> None:
    records = records_of(7, 4000, radius=(0.02, 0.05))
    tree = build_octree(records)
    position, normal = queries_about(8, records.take(np.arange(200)), 1)
    read = [len(listed(tree, p, n)) for p, n in zip(position, normal, strict=True)]
    assert np.mean(read) < 0.01 * len(records)
    assert len(tree.references) < 40 * len(records)


def test_a_finer_tree_lists_fewer_records_that_do_not_answer(records_of: Any, queries_about: Any) -> None:
    # Crowded: they face all ways, and each reaches many others.
    records = records_of(7, 1000, radius=(0.2, 0.3))
    position, normal = queries_about(8, records.take(np.arange(200)), 1)
    met = []
    for finer in range(3):
        tree = build_octree(records, finer=finer)
        met.append(np.mean([len(listed(tree, p, n)) for p, n in zip(position, normal, strict=True)]))
    assert met[1] < 0.75 * met[0]
    assert met[2] < 0.75 * met[1]


def test_lists_hold_each_record_once_in_ascending_order(records_of: Any) -> None:
    tree = build_octree(records_of(9, 500))
    for _, begin, end, unused in tree.nodes:
        rows = tree.references[begin:end].astype(int)
        assert (np.diff(rows) > 0).all()
        assert unused == 0
    assert tree.nodes[-1, 2] == len(tree.references)


def test_an_empty_cache_has_six_empty_roots() -> None:
    tree = build_octree(Records.empty())
    np.testing.assert_array_equal(tree.nodes, np.zeros((6, 4)))
    assert listed(tree, np.float32([0.5, 0.5, 0.5]), np.float32([0, 0, 1])) == []


def test_the_same_records_make_the_same_tree(records_of: Any) -> None:
    first, second = build_octree(records_of(4, 200)), build_octree(records_of(4, 200))
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.references, second.references)


def test_a_single_record_is_found_where_it_is(records_of: Any) -> None:
    records = records_of(11, 1)
    assert listed(build_octree(records), records.position[0], records.normal[0]) == [0]


def test_spread_bits_leave_two_zeros_after_each_bit() -> None:
    value = 0b1_0000_0000_0110_1001_0011
    (spread,) = spread_bits(np.array([value]))
    bits = f"{value:b}"
    assert int(spread) == int("00".join(bits), 2)
    assert int(spread_bits(np.array([-5]))[0]) == 0


def test_in_a_fixed_cube_a_query_meets_its_records_in_the_same_order_whatever_else_is_there(
    records_of: Any, queries_about: Any
) -> None:
    cube = Cube((-2.0, -3.0, -2.0), 7.0)
    records = records_of(12, 400, radius=(0.01, 0.2))
    few = np.flatnonzero(records.position[:, 0] < 0.5)
    whole, part = build_octree(records, cube=cube), build_octree(records.take(few), cube=cube)
    near = np.flatnonzero(records.position[:, 0] < 0.2)
    position, normal = queries_about(13, records.take(near), 2)
    for p, n in zip(position, normal, strict=True):
        everything = [row for row in listed(whole, p, n) if row in few]
        assert everything == few[listed(part, p, n)].tolist()


def test_what_lies_outside_a_fixed_cube_is_not_listed(records_of: Any) -> None:
    tree = build_octree(records_of(14, 50), cube=Cube((5.0, 5.0, 5.0), 1.0))
    assert len(tree.references) == 0
