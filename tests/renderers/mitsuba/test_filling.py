"""The secondary cache, which ends the paths of a gather, against paths that it does not end."""

from __future__ import annotations

import numpy as np
import pytest

from steadylight.cache.records import Records
from steadylight.renderers.mitsuba.records.gather import Bounds, gather_records
from steadylight.renderers.mitsuba.renderer import Renderer
from steadylight.scenes import load_scene
from steadylight.settings import RenderSettings

FRAMES = (40, 80)
SETTINGS = RenderSettings(frames=FRAMES, width=256, height=144)


@pytest.fixture(scope="module")
def corridor() -> Renderer:
    scene = load_scene("corridor")
    poses = dict(zip(FRAMES, scene.camera.frame_poses(FRAMES, scene.fps), strict=True))
    return Renderer(scene, poses, SETTINGS)


def test_the_secondary_cache_takes_hardly_any_light_and_adds_none(corridor: Renderer) -> None:
    # Lamps in slots of the ceiling, recesses and doors: light that coarse records could lose, or spread too far. It
    # takes 0.4 %; with records twice as far apart it took 1.6 %.
    context = corridor.filler.context
    assert context.secondary is not None
    seen, _ = corridor.view.missed_through(
        np.random.default_rng(0).random((1500, 2), np.float32), corridor.load(Records.empty()), 1
    )
    bounds = Bounds(np.full(len(seen.position), 1e-3, np.float32), np.ones(len(seen.position), np.float32))
    with_it, without = (
        gather_records(
            corridor.view.scene,
            seen.position,
            seen.normal,
            bounds,
            SETTINGS.cache.model_copy(update={"paths": (1600,)}),
            bounces=2,
            seed=3,
            context=each,
        ).irradiance.mean(axis=1)
        for each in (context, context._replace(secondary=None))
    )
    scale = without + 0.1 * without.mean()
    assert abs(((with_it - without) / scale).mean()) < 0.008
    assert abs(with_it.mean() / without.mean() - 1) < 0.008
