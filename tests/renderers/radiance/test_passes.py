"""Both passes with Radiance's programs: known light, counts, and no new records in the end."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight import render
from steadylight.errors import CacheFileError
from steadylight.images import read_exr
from steadylight.renderers.radiance.ambient import encode_ambient, read_ambient


def test_a_plate_under_light_from_everywhere_has_half_of_it(passes_of, tmp_path):
    passes = passes_of("plate", bounces=0)  # and one for the sky, which is a glow
    counts = passes.gather(1, tmp_path / "cache.amb")
    assert counts["hits"] + counts["misses"] == counts["rays"]
    assert counts["misses"] >= 1
    frame = passes.shade(1, [tmp_path / "cache.amb"])
    np.testing.assert_allclose(frame.image, np.broadcast_to([0.5, 1.0, 2.0], frame.image.shape), rtol=0.02)
    assert frame.image.shape == (12, 16, 3)


def test_the_same_plate_by_single_pass_and_without_a_cache(passes_of):
    passes = passes_of("plate", bounces=0)
    alone = passes.shade(1, None)
    assert alone.new_records >= alone.missed >= 1
    np.testing.assert_allclose(alone.image, np.broadcast_to([0.5, 1.0, 2.0], alone.image.shape), rtol=0.02)
    traced = passes.trace(1)
    assert traced.new_records == 0
    np.testing.assert_allclose(traced.image, np.broadcast_to([0.5, 1.0, 2.0], traced.image.shape), rtol=0.02)


def test_a_gather_is_the_same_bytes_each_time(gathered, tmp_path):
    passes, paths = gathered
    counts = passes.gather(1, tmp_path / "again.amb")
    assert (tmp_path / "again.amb").read_bytes() == paths[0].read_bytes()
    assert counts["rays"] == 192 or counts["hits"] >= 10 * counts["misses"]
    assert counts["records"] == len(read_ambient(paths[0]).records)


def test_the_merge_does_not_depend_on_the_order_and_keeps_records_only(gathered, tmp_path):
    passes, paths = gathered
    one = passes.merge(paths, 0, tmp_path / "one.amb")
    other = passes.merge(paths[::-1], 0, tmp_path / "other.amb")
    assert one == other
    assert (tmp_path / "one.amb").read_bytes() == (tmp_path / "other.amb").read_bytes()
    assert one["records_out"] <= one["records_in"]


def test_the_order_of_records_in_a_file_does_not_change_the_picture(gathered):
    passes, paths = gathered
    cache = read_ambient(paths[0])
    shuffled = paths[0].with_name("shuffled.amb")
    order = np.random.default_rng(0).permutation(len(cache.records))
    shuffled.write_bytes(encode_ambient(cache.with_records(cache.records[order])))
    images = [passes.shade(1, [path]).image for path in (paths[0], shuffled)]
    np.testing.assert_allclose(images[0], images[1], rtol=0.02)


def test_audited_frames_need_no_record_and_are_left_out_of_later_rounds(gathered, tmp_path):
    passes, paths = gathered
    cache = tmp_path / "0.amb"
    passes.merge(paths, 0, cache)
    found = []
    for audit_round in range(1, 4):
        misses, filled = (tmp_path / f"{what}{audit_round}.amb" for what in ("misses", "filled"))
        found.append(passes.audit([1, 2], [cache], audit_round, misses))
        passes.fill(cache, {0: misses}, 0, audit_round, filled)
        cache = filled
    assert read_ambient(cache).clean == {1, 2}
    assert found[-1]["looked_up"] == 0
    for frame in (1, 2):
        shaded = passes.shade(frame, [cache])
        assert (shaded.missed, shaded.new_records) == (0, 0)


def test_a_cache_of_other_options_is_refused(gathered, passes_of):
    _, paths = gathered
    with pytest.raises(CacheFileError, match="other options"):
        passes_of("room", bounces=2).shade(1, [paths[0]])


def test_an_animation_through_the_whole_machine_has_no_new_records(scenes, tmp_path):
    runs = [
        render(
            scenes / "room.rad",
            renderer="radiance",
            camera=scenes / "room.toml",
            frames=3,
            size="24x18",
            spp=4,
            quality="draft",
            bounces=1,
            output=tmp_path / name,
            **more,
        )
        for name, more in (("one", {"cluster": "in-process"}), ("two", {"workers": 2}))
    ]
    assert runs[0].statistics["second_pass"]["new_records"] == 0
    assert runs[0].statistics["second_pass"]["missed"] == 0
    for one, two in zip(*(run.frames for run in runs), strict=True):
        assert one.read_bytes() == two.read_bytes()
    assert read_exr(runs[0].frames[0]).mean() > 0.05
