"""Suns in pictures of the environment: where they are, and how much they give."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.scenes.environment import Sun, texels_of, with_suns

ABOVE = np.array([0.6, 0.0, 0.8])
ONE = np.ones(3)
UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
CONSTANT = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}


def test_texels_are_unit_directions_of_the_whole_sphere():
    directions, solid_angle = texels_of(64, 32)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1)
    assert solid_angle.sum() == pytest.approx(4 * np.pi)
    np.testing.assert_allclose((directions * solid_angle[..., None]).sum(axis=(0, 1)), 0, atol=1e-12)


@pytest.mark.parametrize(
    "entry",
    [None, CONSTANT, {"type": "envmap", "data": np.ones((256, 512, 3), np.float32), "to_world": UP}],
    ids=["dark", "even", "picture"],
)
@pytest.mark.parametrize("angle", [5.0, 40.0])
def test_a_wide_sun_is_a_disc_that_gives_its_irradiance_from_its_direction(entry, angle):
    sun = Sun("sun", ABOVE, angle, np.array([2.0, 1.0, 0.5]))
    made, narrow = with_suns(entry, [sun])
    assert narrow == []
    bare, _ = with_suns(entry, [Sun("dark", ABOVE, angle, 0 * ONE)])
    added = made["data"].astype(float) - bare["data"]
    directions, solid_angle = texels_of(added.shape[1], added.shape[0])
    world = directions @ made["to_world"][:3, :3].T
    vector = (world[..., None] * (solid_angle[..., None] * added)[..., None, :]).sum(axis=(0, 1))
    np.testing.assert_allclose(ABOVE @ vector, sun.irradiance, rtol=1e-4)
    np.testing.assert_allclose(vector[:, 0] / np.linalg.norm(vector[:, 0]), ABOVE, atol=0.003)
    assert np.degrees(np.arccos((world @ ABOVE)[added[..., 0] > 0].min())) == pytest.approx(
        angle / 2, abs=0.6
    )


def test_a_narrow_sun_and_one_beside_a_picture_in_a_file_stay_parallel():
    narrow, wide = Sun("narrow", ABOVE, 0.5, ONE), Sun("wide", ABOVE, 8.0, ONE)
    made, left = with_suns(None, [narrow, wide])
    assert (made["type"], left) == ("envmap", [narrow])
    assert narrow.parallel["direction"] == pytest.approx((-ABOVE).tolist())
    assert with_suns(None, [narrow]) == (None, [narrow])
    file = {"type": "envmap", "filename": "sky.hdr"}
    assert with_suns(file, [wide]) == (file, [wide])
