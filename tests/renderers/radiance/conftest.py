"""Scenes and jobs for Radiance's programs; all is skipped where pyradiance is not installed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from radiance_scenes import PLATE, PLATE_CAMERA, ROOM, ROOM_CAMERA

from steadylight.animation.request import prepare
from steadylight.renderers.radiance.passes import ScenePasses


def pytest_collection_modifyitems(items):
    if find_spec("pyradiance") is None:
        for item in items:
            if "renderers/radiance" in item.nodeid:
                item.add_marker(pytest.mark.skip(reason="pyradiance is not installed"))


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """A folder with the small scenes and their cameras."""
    folder = tmp_path_factory.mktemp("radiance")
    for name, scene, camera in (("plate", PLATE, PLATE_CAMERA), ("room", ROOM, ROOM_CAMERA)):
        (folder / f"{name}.rad").write_text(scene)
        (folder / f"{name}.toml").write_text(camera)
    return folder


@pytest.fixture(scope="session")
def job_of(scenes):
    """Makes the job of a small scene."""

    def make(name, **options):
        given = {"size": "16x12", "spp": 4, "quality": "draft", "frames": 2, "bounces": 1} | options
        request = prepare(
            scenes / f"{name}.rad", renderer="radiance", camera=scenes / f"{name}.toml", **given
        )
        return request.job("rpict")

    return make


@pytest.fixture(scope="session")
def passes_of(job_of):
    """Opens a small scene."""
    return lambda name, **options: ScenePasses(job_of(name, **options))


@pytest.fixture(scope="session")
def gathered(passes_of, tmp_path_factory):
    """The room opened, and the caches of its two frames."""
    passes, folder = passes_of("room"), tmp_path_factory.mktemp("gathered")
    paths = [folder / f"{frame}.amb" for frame in (1, 2)]
    for frame, path in enumerate(paths, 1):
        passes.gather(frame, path)
    return passes, paths
