"""What a probe foretells of a run, before it begins."""

from __future__ import annotations

from typing import Any

import pytest
from small_scenes import CAMERA, described, lamp, paint, place, renderer, room

from steadylight.camera import Pose
from steadylight.renderers.base import Box
from steadylight.renderers.mitsuba import probe
from steadylight.renderers.mitsuba.probe import expected_records, probed_seconds
from steadylight.renderers.mitsuba.scene import build_scene
from steadylight.scenes.description import SceneDescription
from steadylight.settings import RenderSettings

FRAMES = (1, 2, 3, 4)
SIZE = {"width": 64, "height": 48}


def full_of_things() -> SceneDescription:
    """The room with 64 small boxes that hang in its middle."""
    things = {
        f"box {k}": {
            "type": "cube",
            "to_world": place((0.08, 0.08, 0.08), (-1.4 + 0.4 * (k % 8), 0, 0.3 + 0.3 * (k // 8))),
            "bsdf": paint(0.6, 0.6, 0.6),
        }
        for k in range(64)
    }
    return described(room() | {"lamp": lamp()} | things)


def settings(**more: Any) -> RenderSettings:
    return RenderSettings.checked(**({"frames": FRAMES, "spp": 2, "bounces": 1} | SIZE | more))


def poses() -> list[Pose]:
    return list(CAMERA.frame_poses(FRAMES, 8.0))


def foretold(scene: SceneDescription, **more: Any) -> float:
    return expected_records(build_scene(scene), scene, poses(), settings(**more))


@pytest.mark.parametrize(
    "scene", [described(room() | {"lamp": lamp()}), full_of_things()], ids=["plain", "full"]
)
def test_the_records_of_a_film_are_foretold_within_a_factor_of_three(scene: SceneDescription) -> None:
    made = renderer(scene, frames=FRAMES, spp=2, bounces=1, quality="normal", first_pass="surface", **SIZE)
    records, _ = made.fill_box([made.look(FRAMES).points], Box(0, 0, 1))
    assert len(records) / 3 < foretold(scene) < 3 * len(records)


def test_where_each_frame_makes_its_own_cache_records_are_made_again_for_each() -> None:
    scene = full_of_things()
    assert foretold(scene, mode="single-pass") > 2 * foretold(scene)


def test_time_is_that_of_a_path_times_what_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_seconds_of_path", lambda *_: 1e-6)
    scene = described(room() | {"lamp": lamp()})
    samples = 64 * 48 * 2 * len(FRAMES)
    assert probed_seconds(scene, poses(), settings(mode="path")) == pytest.approx(1e-6 * samples)
    direct = probed_seconds(scene, poses(), settings(bounces=0))
    assert direct == pytest.approx(probe.OF_A_SAMPLE * 1e-6 * samples)
    of_records = probed_seconds(scene, poses(), settings()) - direct
    assert of_records == pytest.approx(1e-6 * probe.OF_A_RECORD * 800 * foretold(scene))


def test_a_path_takes_some_time() -> None:
    scene = described(room() | {"lamp": lamp()})
    assert 1e-8 < probed_seconds(scene, poses(), settings(mode="path")) / (64 * 48 * 2 * len(FRAMES)) < 1e-3


def test_looks_are_spread_over_the_film() -> None:
    many = CAMERA.frame_poses(range(1, 101), 100.0)
    chosen = probe._spread(many, 4)
    rows = [next(k for k, pose in enumerate(many) if pose is some) for some in chosen]
    assert rows == [12, 37, 62, 87]
    assert probe._spread(many[:3], 4) == many[:3]
