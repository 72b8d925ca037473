"""Mitsuba behind the renderer interface: what its methods write, and what they refuse to write."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from small_scenes import described, lamp, random_records, room

from steadylight.cache.file import CacheFile, encode_cache, encode_points, read_cache, read_points
from steadylight.cache.lookup import pair_weights
from steadylight.cache.octree import Cube
from steadylight.cache.partition import Partition
from steadylight.cache.records import Records
from steadylight.camera import CameraPath, Keyframe
from steadylight.errors import BackendError, CacheFileError, RunError, SceneError
from steadylight.metrics.reprojection import View, project
from steadylight.renderers.base import Box, Job, Survey
from steadylight.renderers.mitsuba import plugin
from steadylight.renderers.mitsuba.plugin import RENDERER, partition_of, survey_of
from steadylight.renderers.mitsuba.records.filling import Points
from steadylight.settings import RenderSettings

SPLIT = Partition(((0, 0.0),), 0.1, Cube((-4.0, -4.0, -4.0), 9.0), ((0,), (0, 1)))


@pytest.fixture
def job():
    scene = described(room() | {"lamp": lamp()})
    settings = RenderSettings.checked(
        frames=(1, 2), width=16, height=12, spp=2, quality="draft", bounces=1, base_rays=16
    )
    poses = dict(zip(settings.frames, scene.camera.frame_poses(settings.frames, settings.fps), strict=True))
    return Job(scene, settings, "llvm_ad_rgb", poses, ((1, 2),), (1,), Survey.undivided(1))


def write_cache(path, job, records):
    path.write_bytes(encode_cache(CacheFile(records, job.scene.hash, {})))
    return path


def test_a_partition_survives_the_way_through_run_json():
    survey = survey_of(SPLIT)
    assert survey.windows == SPLIT.windows
    assert survey.neighbours == ((1,), (0,))
    plain = json.loads(json.dumps(dataclasses.asdict(survey)))
    assert partition_of(Survey(survey.windows, survey.neighbours, plain["details"])) == SPLIT


def test_one_part_is_the_whole_cache():
    assert partition_of(Survey.undivided(3)) == Partition.whole(3)


def test_surfaces_are_where_the_camera_of_the_frame_sees_them(job):
    seen = RENDERER.open(job, None).surfaces(2)
    view = View(job.poses[2], (16, 12), seen.position, seen.normal)
    rows, columns = np.mgrid[0:12, 0:16] + 0.5
    x, y, depth = project(view.position, view.pose, view.size)
    hit = np.isfinite(seen.depth)
    assert hit.any()
    assert np.hypot(x - columns, y - rows)[hit].max() < 0.01
    assert depth[hit] == pytest.approx(seen.depth[hit], rel=1e-4)
    towards = np.einsum("...i,...i", seen.position - view.pose.origin, seen.normal)
    assert (towards[hit] < 0).all()
    assert np.linalg.norm(seen.normal, axis=-1) == pytest.approx(hit.astype(float), abs=1e-5)


def two_rooms():
    """Two rooms side by side, of which a wall of a centimetre divides x < 0 from x > 0, seen from within the first."""
    wall = {"type": "cube", "to_world": np.diag([0.005, 2.0, 1.5, 1.0])}
    floor = {
        "type": "rectangle",
        "to_world": np.array([[4.0, 0, 0, 0], [0, 4, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]]),
    }
    return described({"floor": floor, "wall": wall, "lamp": lamp()})


def test_why_names_a_record_that_leaks_through_a_thin_wall(tmp_path):
    # On the floors of two rooms, dark and bright; by hand, a bright record is moved through the wall.
    scene_of = two_rooms()
    settings = RenderSettings.checked(frames=(1,), width=32, height=24, spp=1, quality="draft")
    pose = CameraPath((Keyframe(0.0, (-2.0, 0.01, 1.0), (-0.5, 0, -1.0), fov=70.0),)).pose(0.0)
    job = Job(scene_of, settings, "llvm_ad_rgb", {1: pose}, ((1,),), (1,), Survey.undivided(1))
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-3.9, 4, 0.2), np.arange(-1.5, 1.6, 0.2)))
    count = len(x)
    records = dataclasses.replace(
        random_records(0, count),
        position=np.stack([x, y, np.full(count, -1.0)], axis=1).astype(np.float32),
        normal=np.tile(np.float32([0, 0, 1]), (count, 1)),
        irradiance=np.repeat(np.where(x < 0, 0.1, 10.0).astype(np.float32), 3).reshape(count, 1, 3),
        translation=np.zeros((count, 1, 3, 3), np.float32),
        rotation=np.zeros((count, 1, 3, 3), np.float32),
        radius=np.full(count, 0.3, np.float32),
        headroom=np.full(count, np.inf, np.float32),
        barriers=np.zeros((count, 2, 3), np.float32),
    )
    renderer = RENDERER.open(job, None)
    column, row = 16, 12
    cache = write_cache(tmp_path / "smoothed.safetensors", job, records)
    (before,) = renderer.questions(1, (column, row), [cache])
    assert before.position[0] < 0
    assert before.irradiance == pytest.approx((0.1, 0.1, 0.1), rel=1e-4)

    leak = int(np.flatnonzero(x > 1)[0])
    records.position[leak] = np.float32(before.position) + np.float32([0.02, 0, 0])
    cache = write_cache(tmp_path / "leaking.safetensors", job, records)
    (after,) = renderer.questions(1, (column, row), [cache])
    assert after.irradiance[0] > 1.0
    assert after.rows[0] == leak
    assert after.value[0] == pytest.approx((10.0, 10.0, 10.0))
    assert after.distance[0] == pytest.approx(0.02, rel=1e-3)
    assert sum(after.share) == pytest.approx(1.0)
    table = renderer.records([cache])
    assert table.irradiance[after.rows[0]] == pytest.approx([10.0, 10.0, 10.0])
    assert all(table.irradiance[other] == pytest.approx([0.1, 0.1, 0.1]) for other in after.rows[1:])


def test_the_two_passes_leave_whole_files_and_count_what_they_did(job, tmp_path):
    scene = RENDERER.open(job, None)
    gathered, merged, misses, filled, smoothed = (tmp_path / f"{n}.safetensors" for n in range(5))
    misses = misses.with_suffix(".points")
    counts = scene.gather(1, gathered)
    assert counts["records"] == len(read_cache(gathered, scene_hash=job.scene.hash).records) > 0
    assert counts["rays"] == counts["hits"] + counts["misses"] + counts["left"]
    assert scene.merge([gathered], 0, merged)["records_in"] == counts["records"]
    assert scene.audit((1, 2), [merged], 1, misses)["looked_up"] > 0
    for path in (gathered, merged, misses):
        RENDERER.validate(path, job.scene.hash)
    missed = len(read_points(misses)[0])
    added = scene.fill(merged, {0: misses}, 0, 1, filled)["records"]
    assert (added > 0) == (missed > 0)
    scene.smooth(filled, [], smoothed)
    frame = scene.shade(1, [smoothed])
    assert frame.image.shape == (12, 16, 3)
    assert frame.new_records == 0
    assert frame.seconds > 0
    assert scene.shade(1, None).new_records > 0
    assert scene.trace(1).image.mean() == pytest.approx(frame.image.mean(), rel=0.1)


def test_by_surfaces_all_frames_are_looked_along_and_the_second_pass_misses_nothing(job, tmp_path):
    settings = job.settings.model_copy(update={"first_pass": "surface", "width": 32, "height": 24})
    job = dataclasses.replace(job, settings=settings)
    scene = RENDERER.open(job, None)
    prepared, seen, missed = tmp_path / "a.prepared", tmp_path / "a.points", tmp_path / "b.points"
    boxes = [tmp_path / f"box{number}.safetensors" for number in range(2)]
    merged, filled, smoothed = (tmp_path / f"{name}.safetensors" for name in "mfs")
    scene.prepare(prepared)
    assert scene.look((1, 2), seen)["rays"] == 2 * 32 * 24
    scene.use(prepared)
    counted = [scene.gather_box({0: seen}, Box(0, number, 2), box) for number, box in enumerate(boxes)]
    points = sum(count["hits"] + count["misses"] for count in counted)
    assert len(read_points(seen)[0]) >= points > sum(count["records"] for count in counted) > 0
    scene.merge(boxes, 0, merged)
    scene.audit((1, 2), [merged], 1, missed)
    scene.fill(merged, {0: missed}, 0, 1, filled)
    scene.smooth_and_stretch(filled, [], {0: missed}, 0, smoothed)
    for path in (prepared, seen, *boxes, merged, missed, filled, smoothed):
        RENDERER.validate(path, job.scene.hash)
    frame = scene.shade(1, [smoothed])
    assert (frame.missed, frame.new_records) == (0, 0)
    assert scene.trace(1).image.mean() == pytest.approx(frame.image.mean(), rel=0.1)


def test_what_was_prepared_elsewhere_makes_the_same_records(job, tmp_path):
    here, there = RENDERER.open(job, None), RENDERER.open(job, None)
    here.prepare(tmp_path / "a.prepared")
    there.use(tmp_path / "a.prepared")
    outputs = [tmp_path / f"{name}.safetensors" for name in "ab"]
    for scene, output in zip((here, there), outputs, strict=True):
        scene.gather(1, output)
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


def test_what_few_look_ups_miss_is_not_worth_a_record(job):
    scene = RENDERER.open(job, None)._renderer
    records = random_records(1, 400)
    place = np.repeat(records.position[:3], (7, 2, 1), axis=0)
    facing = np.repeat(records.normal[:3], (7, 2, 1), axis=0)
    found = Points.of_look_ups(place, facing, np.full(10, np.inf, np.float32), np.full(10, 1e-3, np.float32))
    # Seven look-ups at one place, two at another, one at a third: the first is worth one whatever is left.
    assert len(scene.worth_records([found], records, 10**6).position) == 7
    # Of a thousand samples one may be stretched to; where nothing answers, all need records.
    assert len(scene.worth_records([found], records, 1000).position) == 9
    assert len(scene.worth_records([found], Records.empty(), 10**6).position) == 10


def test_an_answer_from_further_off_changes_nothing_that_measured_records_answer(job):
    job = dataclasses.replace(job, settings=job.settings.model_copy(update={"width": 640, "height": 480}))
    scene = RENDERER.open(job, None)._renderer
    one = random_records(1, 1, radius=(0.2, 0.2))
    flat = dataclasses.replace(one, position=np.zeros((1, 3), np.float32), normal=np.float32([[0, 0, 1]]))
    # A reflection misses a point half a metre off, and would be content with records 40 cm apart.
    missed = Points.of_look_ups(*(np.float32([each]) for each in ((0.5, 0, 0), (0, 0, 1), np.inf, 0.4)))
    whole, count = scene.stretch([missed], flat)
    assert (len(whole), count) == (2, 1)
    ahead = np.float32([[x, 0, 0] for x in np.linspace(0, 0.19, 8)])
    up = np.tile(np.float32([0, 0, 1]), (len(ahead), 1))
    weights = pair_weights(ahead[:, None], up[:, None], whole)
    np.testing.assert_array_equal((weights > 0).sum(axis=1), 1)
    assert (pair_weights(missed.position[:, None], missed.normal[:, None], whole) > 0).sum() == 1


def test_merge_counts_the_records_of_its_own_part(job, tmp_path):
    records = random_records(1, 50)
    records = dataclasses.replace(records, position=records.position - records.position.mean(axis=0))
    gathered = write_cache(tmp_path / "a.safetensors", job, records)
    job = dataclasses.replace(job, survey=survey_of(SPLIT))
    scene = RENDERER.open(job, None)
    outputs = [tmp_path / f"part{part}.safetensors" for part in range(2)]
    counts = [scene.merge([gathered], part, output) for part, output in enumerate(outputs)]
    below = int((records.position[:, 0] < 0).sum())
    assert [count["records_in"] for count in counts] == [below, 50 - below]
    whole = tmp_path / "whole.safetensors"
    scene.concatenate(outputs, whole)
    assert len(read_cache(whole).records) == sum(count["records_out"] for count in counts)


@pytest.mark.parametrize(
    "field", ["irradiance", "curvature", "standard_error", "radius", "headroom", "guide"]
)
def test_records_that_are_not_finite_are_not_written(job, tmp_path, monkeypatch, field):
    spoiled = {name: np.ones((1, *shape), np.float32) for name, shape in Records.SHAPES.items()}
    spoiled[field] = spoiled[field] * np.float32(np.nan)
    monkeypatch.setattr(plugin, "merge_part", lambda *_: Records(**spoiled))
    with pytest.raises(RunError, match="not finite"):
        RENDERER.open(job, None).merge([], 0, tmp_path / "merged.safetensors")
    assert not list(tmp_path.iterdir())


def test_files_of_another_scene_are_not_valid(job, tmp_path):
    cache = write_cache(tmp_path / "a.safetensors", job, Records.empty())
    points = tmp_path / "a.points"
    points.write_bytes(
        encode_points(*np.zeros((2, 0, 3), np.float32), *np.zeros((3, 0), np.float32), job.scene.hash)
    )
    for path in (cache, points):
        RENDERER.validate(path, job.scene.hash)
        with pytest.raises(CacheFileError, match="another scene"):
            RENDERER.validate(path, "f" * 64)


def test_check_tells_backend_versions_and_what_quality_stands_for(job):
    backend = RENDERER.check(job.scene, job.settings, "llvm", build=True)
    assert backend.variant == "llvm_ad_rgb"
    assert backend.versions.keys() == {"mitsuba", "drjit"}
    denoised = job.settings.model_copy(update={"denoise": True})
    assert "pyoidn" in RENDERER.check(job.scene, denoised, "llvm", build=False).versions
    high = RENDERER.check(job.scene, job.settings.model_copy(update={"quality": 2.0}), "llvm", build=False)
    assert high.constants != backend.constants


def test_a_scene_without_light_is_refused_before_anything_starts(job):
    with pytest.raises(SceneError, match="no emitter"):
        RENDERER.check(described(room()), job.settings, "llvm", build=True)


def test_a_missing_backend_is_told(job, monkeypatch):
    import drjit as dr

    monkeypatch.setattr(dr, "has_backend", lambda _: False)
    with pytest.raises(BackendError, match="no CUDA device"):
        RENDERER.check(job.scene, job.settings, "cuda", build=False)
