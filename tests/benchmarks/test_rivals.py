"""What the comparison with other renderers computes by itself; none of them is needed."""

import itertools

import numpy as np
import pytest
from radiance_film import QUALITIES, filtered
from radiance_scene import RadianceScene, _Writer, write_rgbe
from rivals import Crossing, time_at

from steadylight.scenes import load_scene


def test_time_at_equal_error_lies_on_the_line_between_logarithms():
    # Error falls with the square root of time, as a path tracer's.
    curve = [(4.0, 0.1), (1.0, 0.2), (16.0, 0.05)]
    crossing = time_at(0.1 / np.sqrt(2), curve)
    assert crossing.sign == "="
    assert crossing.seconds == pytest.approx(8.0)


def test_time_at_equal_error_takes_a_setting_that_has_it():
    assert time_at(0.1, [(1.0, 0.2), (4.0, 0.1)]) == Crossing("=", 4.0)


def test_an_error_beyond_what_was_measured_gives_a_bound():
    curve = [(1.0, 0.2), (4.0, 0.1)]
    assert time_at(0.05, curve) == Crossing(">", 4.0)
    assert time_at(0.3, curve) == Crossing("<", 1.0)


def test_a_slower_setting_that_is_worse_does_not_count():
    assert time_at(0.1, [(1.0, 0.2), (2.0, 0.3), (4.0, 0.1)]) == Crossing("=", 4.0)


@pytest.mark.parametrize("oversampling", [1, 2, 3, 4])
def test_filtering_down_keeps_constants_and_ramps(oversampling):
    size = 12
    rendered = (np.arange(size * oversampling) + 0.5) / oversampling
    ramp = np.broadcast_to(rendered[None, :, None], (size * oversampling, size * oversampling, 3))
    assert np.allclose(filtered(np.ones_like(ramp), oversampling), 1.0, atol=1e-6)
    inside = slice(2, -2)
    # Beside the border a half of the filter is missing.
    assert np.allclose(filtered(ramp, oversampling)[:, inside, 0], np.arange(size)[inside] + 0.5, atol=1e-5)
    upright = ramp.transpose(1, 0, 2)
    assert np.allclose(
        filtered(upright, oversampling)[inside, :, 0], np.arange(size)[inside, None] + 0.5, atol=1e-5
    )


def test_pictures_keep_their_value_within_half_a_step(tmp_path):
    image = np.random.default_rng(0).random((3, 5, 3)) * [[[1e-3], [1.0], [7.0], [300.0], [0.0]]]
    write_rgbe(tmp_path / "picture.hdr", image)
    content = (tmp_path / "picture.hdr").read_bytes()
    head = b"-Y 3 +X 5\n"
    stored = np.frombuffer(content[content.index(head) + len(head) :], np.uint8).reshape(3, 5, 4).astype(int)
    read = np.where(stored[..., 3:] > 0, (stored[..., :3] + 0.5) * np.exp2(stored[..., 3:] - 136.0), 0.0)
    assert np.all(np.abs(read - image) <= image.max(axis=2, keepdims=True) / 256)


def writer_of(tmp_path, **content):
    scene = load_scene("furnace")
    writer = _Writer(scene, tmp_path, RadianceScene(tmp_path / "scene.oct"))
    for name, entry in content.items():
        writer.add(name, entry)
    return writer


TRIANGLE = {
    "type": "triangles",
    "vertices": np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], np.float32),
    "faces": np.array([[0, 1, 2]], np.uint32),
}
GREY = {
    "type": "twosided",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
}


def test_a_plain_triangle_becomes_a_polygon(tmp_path):
    writer = writer_of(tmp_path, wall=TRIANGLE | {"bsdf": GREY})
    assert writer.materials == ["void plastic wall\n0 \n0\n5 0.2 0.4 0.6 0 0\n"]
    assert writer.objects == ["wall polygon wall.0\n0 \n0\n9 0 0 0 1 0 0 0 2 0\n"]
    assert writer.mesh == []


def test_smooth_and_textured_triangles_share_a_mesh(tmp_path):
    smooth = TRIANGLE | {"bsdf": GREY, "normals": np.tile(np.float32([0, 0, 1]), (3, 1))}
    textured = TRIANGLE | {"bsdf": GREY, "uv": np.zeros((3, 2), np.float32)}
    writer = writer_of(tmp_path, smooth=smooth, textured=textured)
    faces = [line for line in writer.mesh if line.startswith(("usemtl", "f "))]
    assert faces == ["usemtl smooth", "f 1//1 2//2 3//3", "usemtl textured", "f 4/1 5/2 6/3"]


def test_an_emitter_that_reflects_gives_its_radiance_through_a_sheet(tmp_path):
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 4.0, 8.0]}}
    writer = writer_of(tmp_path, lamp=TRIANGLE | {"bsdf": white, "emitter": emitter})
    sheet, light, front, behind = (text.split() for text in writer.objects)
    through = float(sheet[-2])
    assert through == pytest.approx(0.4)  # the rest, 0.6, is reflected
    assert [float(word) * through for word in light[-3:]] == pytest.approx([2.0, 4.0, 8.0])
    assert (front[0], behind[0]) == ("lamp.sheet", "lamp")
    # The polygon's normal is +z: behind is below.
    assert all(-1e-3 < float(z) < 0 for z in behind[-7::3])


def test_what_radiance_cannot_say_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match="wall: material `principled`"):
        writer_of(tmp_path, wall=TRIANGLE | {"bsdf": {"type": "principled"}})
    with pytest.raises(ValueError, match="haze: `homogeneous`"):
        writer_of(tmp_path, haze={"type": "homogeneous"})


def test_each_quality_of_rpict_asks_for_more_than_the_one_before():
    for coarse, fine in itertools.pairwise(QUALITIES):
        assert fine.divisions > coarse.divisions
        assert fine.accuracy < coarse.accuracy
        assert fine.spacing < coarse.spacing
