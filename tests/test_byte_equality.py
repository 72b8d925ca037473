"""Frames and caches have the same bytes whoever renders them, in whatever order."""

from __future__ import annotations

import pytest

import steadylight
from small_film import FRAMES, digests, render, write_film
from steadylight.animation import run as run_module
from steadylight.engines.in_process import InProcess

SCENES = ("room.xml", "furnace")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    write_film(folder)
    return folder


@pytest.fixture(scope="module", params=SCENES)
def film(request, folder):
    """A scene, and the digests of its film as one process renders it."""
    output = folder / f"{request.param}-in-process"
    render(folder, output, "--cluster", "in-process", scene=request.param)
    found = digests(output)
    assert sum(name.endswith(".exr") for name in found) == FRAMES
    assert "cache/merged.safetensors" in found
    return request.param, found


@pytest.mark.parametrize(
    ("film", "workers"), [("room.xml", 1), ("room.xml", 2), ("furnace", 2)], indirect=["film"]
)
def test_worker_processes_write_the_bytes_that_one_process_writes(film, folder, workers):
    scene, expected = film
    output = folder / f"{scene}-{workers}"
    render(folder, output, "--workers", str(workers), scene=scene)
    assert digests(output) == expected


class Backwards(InProcess):
    """Takes the last task that may start, where every other engine takes the first; has three threads."""

    def __init__(self):
        super().__init__()
        self.threads_per_worker = 3

    def run(self, tasks, perform):
        return super().run(tasks[::-1], perform)


def test_neither_the_order_of_tasks_nor_the_number_of_threads_matters(film, folder, monkeypatch):
    scene, expected = film
    monkeypatch.setattr(run_module, "make_engine", lambda *_: Backwards())
    monkeypatch.chdir(folder)
    given = {"camera": "walk.toml"} if scene == "room.xml" else {"frames": FRAMES, "size": (32, 24)}
    output = folder / f"{scene}-backwards"
    steadylight.render(scene, **given, spp=2, quality="draft", output=output)
    gathered = sorted(output.glob("cache/gather_*"), key=lambda path: path.stat().st_mtime_ns)
    assert gathered == sorted(gathered, reverse=True)
    assert digests(output) == expected
