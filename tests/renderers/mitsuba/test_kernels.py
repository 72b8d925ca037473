"""What was compiled for one frame serves the next."""

from __future__ import annotations

import multiprocessing
from typing import TYPE_CHECKING, Any

import drjit as dr
import pytest
from small_scenes import EVERY_POSE, described, lamp, renderer, room

from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.renderers.mitsuba.records.filling import Points

if TYPE_CHECKING:
    from collections.abc import Callable


def compiled(work: Callable[[], Any], *, more_than: int = 0) -> list[int]:
    """Sizes of the kernels of more operations that had to be compiled, or fetched from disk, for this work."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        return [
            k["size"]
            for k in dr.kernel_history([dr.KernelType.JIT])
            if (not k["cache_hit"] or k["cache_disk"]) and k["operation_count"] > more_than
        ]


@pytest.fixture(scope="module")
def warm() -> tuple[Any, Any]:
    """A renderer that has shaded one frame, and its cache."""
    content = room() | {"lamp": lamp(), "sky": {"type": "constant", "radiance": 0.3}}
    made = renderer(described(content), width=24, height=24, spp=4)
    cache = made.load(made.first_pass(1).records)
    made.audit([1], cache, last=False)
    cache = made.load(cache.records)
    made.shade(1, cache)
    made.path(1)
    return made, cache


def test_further_frames_of_a_film_are_shaded_without_a_new_kernel(warm: Any) -> None:
    made, cache = warm
    made.shade(1, cache)
    made.shade(2, cache)
    assert [compiled(lambda frame=frame: made.shade(frame, cache)) for frame in EVERY_POSE] == [[], [], []]


def test_another_cache_is_read_with_the_kernels_of_the_first(warm: Any) -> None:
    made, cache = warm
    made.shade(1, made.load(cache.records))
    others = [made.load(cache.records) for _ in range(3)]  # wherever NumPy put their arrays
    assert [compiled(lambda other=other: made.shade(2, other)) for other in others] == [[], [], []]


def test_the_second_frame_is_shaded_with_the_kernels_of_the_first(warm: Any) -> None:
    made, _ = warm
    cache = made.load(warm[1].records)
    dr.flush_kernel_cache()  # whatever tests before have left
    made.shade(1, cache)
    assert compiled(lambda: made.shade(2, cache)) == []


def test_further_frames_are_path_traced_without_a_new_kernel(warm: Any) -> None:
    made, _ = warm
    made.path(1)
    assert [compiled(lambda frame=frame: made.path(frame)) for frame in EVERY_POSE] == [[], [], []]


def compiled_for_another_number_of_records() -> list[int]:
    """Called in a process of its own: what other tests have left behind changes Mitsuba's dispatch when it goes."""
    use_variant(resolve_variant("auto"))
    made = renderer(described(room() | {"lamp": lamp()}), width=24, height=24)
    found = made.first_pass(1).records
    assert len(found) > 60

    def gather(count: int) -> None:
        points = Points.anywhere(found.position[:count], found.normal[:count])
        made.filler.fill(points, 1)

    gather(20)
    gather(60)
    # What moves rows to and from NumPy is Dr.Jit's own, a few operations, and made for each size.
    return compiled(lambda: gather(41), more_than=30)


def test_another_number_of_records_is_gathered_with_the_kernels_of_the_first() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(compiled_for_another_number_of_records) == []
