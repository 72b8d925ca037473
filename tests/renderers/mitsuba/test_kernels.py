"""What was compiled for one frame serves the next."""

from __future__ import annotations

import gc
import multiprocessing
import weakref
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import EVERY_POSE, described, lamp, place, plain_lighting, renderer, room

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba import frozen as frozen_kernels
from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant
from steadylight.renderers.mitsuba.frame import FrameShader
from steadylight.renderers.mitsuba.frozen import frozen, loaded
from steadylight.renderers.mitsuba.image import pixels
from steadylight.renderers.mitsuba.paths import audit
from steadylight.renderers.mitsuba.quality import RecordQuality
from steadylight.renderers.mitsuba.records import tracing
from steadylight.renderers.mitsuba.records.filling import Points
from steadylight.renderers.mitsuba.records.gather import Gather, Places, gather_records
from steadylight.renderers.mitsuba.records.lookup import DeviceCache
from steadylight.renderers.mitsuba.records.origins import Hemispheres
from steadylight.renderers.mitsuba.records.radius import Bounds
from steadylight.renderers.mitsuba.records.tracing import GatherContext
from steadylight.renderers.mitsuba.scene import build_scene

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


def test_a_recording_that_fails_after_it_ran_is_undone_before_it_is_made_again() -> None:
    tries = []

    def count(_: None, total: Any) -> None:
        dr.scatter_reduce(dr.ReduceOp.Add, total, mi.UInt32(1), mi.UInt32(0))
        dr.eval(total)
        tries.append(None)
        if len(tries) == 1:
            raise RuntimeError("Mitsuba has freed objects")

    def undo(total: Any) -> None:
        dr.scatter(total, mi.UInt32(0), mi.UInt32(0))
        dr.eval(total)

    total = dr.zeros(mi.UInt32, 2)
    dr.make_opaque(total)
    frozen(count, lambda _: [], undo)(None, total)
    assert len(tries) == 2
    assert total[0] == 1


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


def test_whatever_their_strata_and_number_records_are_gathered_with_the_kernels_of_the_first() -> None:
    scene = build_scene(described(room() | {"lamp": lamp(), "sky": {"type": "constant", "radiance": 0.3}}))
    context = GatherContext(plain_lighting(scene))

    def gather(count: int, strata: int) -> None:
        quality = RecordQuality(strata, 4 * strata, ((4 * strata) ** 2,), radii="split-sphere")
        position = np.linspace((-1, -1, 0), (1, 1, 0), count, dtype=np.float32)
        normal = np.broadcast_to(np.float32([0, 0, 1]), (count, 3))
        bounds = Bounds(np.full(count, 0.01, np.float32), np.full(count, 9, np.float32))
        gather_records(Gather(quality, 2, context), Places(position, normal, bounds), seed=1)

    gather(9, 5)
    few = 20  # Dr.Jit's own, for sums of blocks
    assert [compiled(lambda given=given: gather(*given), more_than=few) for given in ((7, 8), (1, 5))] == [
        [],
        [],
    ]


def test_batches_as_wide_as_an_array_of_the_scene_need_no_recording_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    context = GatherContext(plain_lighting(scene))
    recorded = Mock(wraps=tracing.indirect_radiance)
    monkeypatch.setattr(tracing, "indirect_radiance", recorded)

    def gather(count: int) -> np.ndarray:
        position = np.zeros((count, 3), np.float32)
        position[:, 0] = np.linspace(-1, 1, 200)[:count]
        normal = np.broadcast_to(np.float32([0, 0, 1]), (count, 3))
        bounds = Bounds(np.full(count, 0.01, np.float32), np.full(count, 9, np.float32))
        quality = RecordQuality(4, 16, (256,), radii="split-sphere")
        places = Places(position, normal, bounds)
        return gather_records(Gather(quality, 2, context), places, seed=1).irradiance

    taken = sorted(width for width in frozen_kernels.widths(context.state()) if 4 < width < 100)
    assert len(taken) >= 2
    gather(200)
    before = recorded.call_count
    assert before > 0
    found = [gather(width) for width in taken]
    assert recorded.call_count == before
    monkeypatch.setattr(tracing, "_wider", lambda lanes, *_: lanes)
    for width, records in zip(taken, found, strict=True):
        np.testing.assert_array_equal(records, gather(width))
    assert recorded.call_count > before


def test_single_paths_as_wide_as_an_array_of_the_scene_keep_their_numbers_of_bounces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = build_scene(described(room() | {"lamp": lamp()}))
    context = GatherContext(plain_lighting(scene))
    count = max(width for width in frozen_kernels.widths(context.state()) if width < 100)

    def found(bounces: mi.UInt32 | int) -> np.ndarray:
        lane = dr.arange(mi.UInt32, count)
        p = mi.Point3f(dr.linspace(mi.Float, -1, 1, count), 0, 0)
        start = Hemispheres.above(scene, p, mi.Normal3f(0, 0, 1))
        place = mi.Point2f(dr.linspace(mi.Float, 0, 1, count, endpoint=False), 0.5)
        paths = tracing.Paths(lane, dr.zeros(mi.UInt32, count), place, lane + 0)
        return np.array(tracing.single_paths(context, start, paths, 1, 3, bounces))

    number = dr.arange(mi.UInt32, count) % 3
    mixed, expected = found(number), [found(each) for each in range(3)]
    assert mixed.shape == (3, count)
    for each in range(3):
        np.testing.assert_array_equal(mixed[:, each::3], expected[each][:, each::3])
    assert np.any(expected[1] != expected[2])
    monkeypatch.setattr(tracing, "_wider", lambda lanes, *_: lanes)
    np.testing.assert_array_equal(mixed, found(number))


def test_a_scene_has_the_numbers_of_one_that_is_no_longer_used() -> None:
    def numbers(scene: Any) -> list[int]:
        return list(np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr())))

    content = room() | {"lamp": lamp()}
    made = renderer(described(content), width=24, height=24)
    made.first_pass(1)  # kernels that are recorded hold the scene, too
    first = numbers(made.view.scene)
    circle: list[Any] = [made]
    circle.append(circle)
    del made, circle
    assert numbers(build_scene(described(content))) == first


def test_further_frames_are_path_traced_without_a_new_kernel(warm: Any) -> None:
    made, _ = warm
    made.path(1)
    assert [compiled(lambda frame=frame: made.path(frame)) for frame in EVERY_POSE] == [[], [], []]


def compiled_for_the_second_frame() -> list[int]:
    """Called in a process of its own, in which nothing was compiled before."""
    use_variant(resolve_variant("auto"))
    content = room() | {"lamp": lamp(), "sky": {"type": "constant", "radiance": 0.3}}
    made = renderer(described(content), width=24, height=24, spp=4)
    cache = made.load(made.first_pass(1).records)
    made.shade(1, cache)
    return compiled(lambda: made.shade(2, cache))


def test_the_second_frame_is_shaded_with_the_kernels_of_the_first() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(compiled_for_the_second_frame) == []


def test_a_frame_of_recorded_kernels_has_the_bytes_of_one_that_is_traced_anew(
    warm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, cache = warm
    recorded = [made.shade(frame, cache).image for frame in EVERY_POSE]
    monkeypatch.setattr(pixels, "frozen", lambda trace, _state: trace)
    monkeypatch.setattr(made, "_shader", FrameShader(made.view, 4, denoise=False))
    for frame, image in zip(EVERY_POSE, recorded, strict=True):
        np.testing.assert_array_equal(made.shade(frame, cache).image, image)


@pytest.mark.parametrize(
    ("sky", "variant", "recorded"),
    [("envmap", "cuda_ad_rgb", False), ("envmap", "llvm_ad_rgb", True), ("constant", "cuda_ad_rgb", True)],
)
def test_kernels_that_look_at_an_environment_map_are_not_recorded_on_a_gpu(
    sky: str, variant: str, recorded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Dr.Jit would end the process. What Mitsuba runs here is LLVM all the same.
    content = {"type": sky, "data": np.ones((4, 8, 3), np.float32)} if sky == "envmap" else {"type": sky}
    scene = build_scene(described({"floor": {"type": "rectangle"}, "sky": content}))
    monkeypatch.setattr(frozen_kernels, "mi", SimpleNamespace(Scene=mi.Scene, variant=lambda: variant))
    traced = Mock()  # no list: a recording knows what its function can see, and ends when that changes

    def trace(_: None, x: mi.Float) -> mi.Float:
        traced()
        y = x + 1
        dr.eval(y)
        return y

    for state in ([scene], [1, [[scene]]]):
        call = frozen(trace, lambda _, state=state: state)
        traced.reset_mock()
        for first in range(3):
            x = dr.arange(mi.Float, 5) + dr.opaque(mi.Float, first)
            dr.eval(x)
            np.testing.assert_array_equal(call(None, x), np.arange(5) + first + 1)
        assert (traced.call_count < 3) == recorded


def recorded_with(bulbs: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Called in a process of its own: other scenes would make recordings look at all.

    Returns:
        Variables of the scene that a recording of a frame looks at, the frame, and one whose recording looked at all.
    """
    use_variant(resolve_variant("auto"))
    bulb = {"type": "point", "intensity": 0.05}
    row = {f"bulb{i}": {**bulb, "position": [3 * i / bulbs - 1.5, 0.4, 2.0]} for i in range(bulbs)}
    made = renderer(described(room() | {"lamp": lamp()} | row), width=24, height=24, spp=4)
    cache = made.load(made.first_pass(1).records)

    def picture() -> np.ndarray:
        made._shader = FrameShader(made.view, 4, denoise=False)
        return [made.shade(frame, cache).image for frame in (1, 2)][-1]

    image, [seen] = picture(), loaded(made.view.scene)
    variables = len(seen._variables)
    seen.whole = True
    return variables, image, picture()


def test_a_recording_looks_at_no_bulb_and_its_frame_has_the_bytes_of_one_that_looks_at_all() -> None:
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        few, many = pool.map(recorded_with, [3, 40], chunksize=1)
    assert few[0] == many[0]
    for _, image, of_all in (few, many):
        np.testing.assert_array_equal(image, of_all)
    assert many[1].mean() > 1.1 * few[1].mean()


def test_what_a_kernel_reads_and_a_recording_does_not_see_makes_it_look_at_the_whole_scene() -> None:
    """Two scenes at once: kernels have the code of the BSDFs of both."""
    both = [build_scene(described(room() | {"lamp": lamp(), "ball": {"type": "sphere"}})) for _ in range(2)]
    known = SimpleNamespace(scene=both[0])  # not by itself: a recording looks at what its function can see

    def trace(_: None, x: mi.Float) -> mi.Color3f:
        si = known.scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 1.5), mi.Vector3f(x, 0, 1)))
        found = si.bsdf().eval_diffuse_reflectance(si)
        dr.eval(found)
        return found

    call = frozen(trace, lambda _: loaded(known.scene))
    x = dr.arange(mi.Float, 5) + dr.opaque(mi.Float, 0)
    dr.eval(x)
    np.testing.assert_array_equal(call(None, x), trace(None, x))
    assert loaded(known.scene) == [known.scene]


def test_a_recording_serves_another_cache_of_the_same_form_and_keeps_none_alive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = renderer(described(room() | {"lamp": lamp()}), width=24, height=24)
    found = made.first_pass(1).records
    made._look_from(1)
    traced = Mock(wraps=audit._note)
    monkeypatch.setattr(audit, "_frozen_audit", frozen(traced, audit._Met.state, audit._clear))
    caches, missed = [], []
    for count in (len(found), len(found) // 2, len(found) // 3):
        cache = DeviceCache(found.take(np.arange(count)))
        missed.append(made.view.missed_in_pixels(cache, 1).missed)
        caches.append(weakref.ref(cache))
    assert traced.call_count <= 2  # a second time if other tests have left scenes behind
    assert missed[0] < missed[1] < missed[2]
    traced.reset_mock()  # it keeps its arguments
    del cache
    gc.collect()
    assert [kept() for kept in caches] == [None] * 3


def test_all_audits_of_a_scene_have_one_kernel() -> None:
    made = renderer(described(room() | {"lamp": lamp()}), width=24, height=24, spp=4)
    found = made.first_pass(1).records
    some = found.take(np.arange(0, len(found), 2))

    def audit_all() -> None:
        made.look([1])
        for cache in (made.load(Records.empty()), made.load(some)):
            for last in (False, True):
                assert made.audit([1], cache, last=last).missed > 0

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        audit_all()
        launched = [
            kernel for kernel in dr.kernel_history([dr.KernelType.JIT]) if kernel["operation_count"] > 500
        ]
    assert len(launched) >= 5
    assert len({kernel["hash"] for kernel in launched}) == 1


def test_no_garbage_is_collected_while_a_kernel_is_recorded() -> None:
    seen: list[bool] = []

    def trace(_: None, x: mi.Float) -> mi.Float:
        seen.append(gc.isenabled())
        return x + 1

    call = frozen(trace, lambda _: [])
    for width in (3, 5):
        x = dr.arange(mi.Float, width) + dr.opaque(mi.Float, 1)
        dr.eval(x)
        np.testing.assert_array_equal(call(None, x), np.arange(width) + 2)
    assert set(seen) == {False}
    assert gc.isenabled()


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


def furnished() -> dict[str, Any]:
    """A room with a lamp, a sky, a table top at the back wall, a mirror and varnish: most kinds of paths."""
    varnish = {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.1}}
    top = {"type": "cube", "to_world": place((2, 0.5, 0.02), (0, 1.5, 0.7)), "bsdf": varnish}
    mirror = {"type": "sphere", "center": [1.2, -0.5, 0.5], "radius": 0.4, "bsdf": {"type": "conductor"}}
    sky = {"type": "constant", "radiance": 0.3}
    return room() | {"lamp": lamp(), "sky": sky, "top": top, "mirror": mirror}


@pytest.mark.slow  # kernels in debug mode take long to compile
@pytest.mark.parametrize("chosen", [{"bounces": "auto", "denoise": True}, {"bounces": 2}])
def test_no_kernel_reads_or_writes_beyond_its_arrays(chosen: dict[str, Any], capfd: Any) -> None:
    # Where an index is out of bounds, LLVM's kernels read what happens to lie there; CUDA's end the process, but for
    # this flag. A frozen function is checked when it is recorded, which is once here.
    with dr.scoped_set_flag(dr.JitFlag.Debug):
        dr.eval(dr.gather(mi.Float, mi.Float([1, 2, 3, 4]), mi.UInt32([0, 9])))
        assert "out-of-bounds" in "".join(capfd.readouterr())  # it would be told
        made = renderer(described(furnished()), width=24, height=24, spp=4, **chosen)
        made.prepare()
        cache = made.load(made.first_pass(1).records)
        made.audit([1], cache, last=True)
        made.shade(1, cache.with_fallback())
    assert "out-of-bounds" not in "".join(capfd.readouterr())
