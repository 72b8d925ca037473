"""Larger pictures are filtered down as Mitsuba would."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.errors import SceneError
from steadylight.renderers.radiance.appearance import write_rgbe
from steadylight.renderers.radiance.picture import filtered
from steadylight.scenes.radiance.programs import output_of


@pytest.mark.parametrize("film", ["gaussian", "box", "tent", "mitchell", "catmullrom"])
@pytest.mark.parametrize("oversampling", [1, 2, 3, 4])
def test_filtering_down_keeps_constants_and_ramps(oversampling, film):
    size = 12
    rendered = (np.arange(size * oversampling) + 0.5) / oversampling
    ramp = np.broadcast_to(rendered[None, :, None], (size * oversampling, size * oversampling, 3))
    kind = {"type": film}
    assert np.allclose(filtered(np.ones_like(ramp), oversampling, kind), 1.0, atol=1e-6)
    inside = slice(2, -2)
    # Beside the border a half of the filter is missing.
    expected = np.arange(size)[inside] + 0.5
    assert np.allclose(filtered(ramp, oversampling, kind)[:, inside, 0], expected, atol=1e-5)
    upright = filtered(ramp.transpose(1, 0, 2), oversampling, kind)
    assert np.allclose(upright[inside, :, 0], expected[:, None], atol=1e-5)


def test_an_unknown_filter_is_refused_by_name():
    with pytest.raises(SceneError, match="filter `lanczos`"):
        filtered(np.ones((2, 2, 3)), 1, {"type": "lanczos"})


def test_pictures_of_textures_keep_their_value_within_half_a_step(tmp_path):
    image = np.random.default_rng(0).random((4, 5, 3)) * np.float64([[[1e-3]], [[1.0]], [[7.0]], [[300.0]]])
    write_rgbe(tmp_path / "picture.hdr", image)
    values = output_of(tmp_path, "pvalue", "-h", "-H", "-df", "picture.hdr")
    read = np.frombuffer(values, np.float32).reshape(image.shape)
    assert np.all(np.abs(read - image) <= image.max(axis=2, keepdims=True) / 200)
