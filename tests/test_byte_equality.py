"""Frames and caches have the same bytes whoever renders them, in whatever order."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest

import steadylight
from small_film import FRAMES, PARTS, digests, render, write_film
from steadylight.animation import run as run_module
from steadylight.animation.request import prepare
from steadylight.animation.run import Session
from steadylight.animation.simulation import with_barriers
from steadylight.animation.tasks import perform
from steadylight.engines.in_process import InProcess
from variants import slow

SCENES = ("room.xml", "glazed.xml", "furnace")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    write_film(folder)
    return folder


def alone(folder, output, scene="room.xml", **more):
    """Render the film in this process; returns the run directory."""
    given = {"camera": "walk.toml"} if scene.endswith(".xml") else {"frames": FRAMES, "size": (32, 24)}
    with contextlib.chdir(folder):
        steadylight.render(
            scene, **given, spp=2, quality="draft", cluster="in-process", output=output, **more
        )
    return folder / output


@pytest.fixture(scope="module", params=SCENES)
def film(request, folder):
    """A scene, and the digests of its film as one process renders it."""
    found = digests(alone(folder, f"{request.param}-in-process", scene=request.param))
    assert sum(name.endswith(".exr") for name in found) == FRAMES
    assert "cache/merged.safetensors" in found
    return request.param, found


@pytest.mark.parametrize(
    ("film", "workers"),
    [("room.xml", 1), ("room.xml", 2), ("glazed.xml", 2), slow("furnace", 2)],
    indirect=["film"],
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
    output = alone(folder, f"{scene}-backwards", scene=scene)
    gathered = sorted(output.glob("cache/gather_*"), key=lambda path: path.stat().st_mtime_ns)
    assert gathered == sorted(gathered, reverse=True)
    assert digests(output) == expected


@pytest.fixture(scope="module")
def film_in_parts(folder):
    """The digests of a film whose cache is in four parts, as one process renders it."""
    found = digests(alone(folder, "parts-in-process", cache_parts=4))
    assert sum(name.startswith("cache/smoothed_") for name in found) == 4
    assert "cache/merged.safetensors" in found
    return found


def test_worker_processes_write_the_parts_that_one_process_writes(film_in_parts, folder):
    render(folder, "parts-2", "--workers", "2", *PARTS)
    assert digests(folder / "parts-2") == film_in_parts


@pytest.mark.skipif(find_spec("pyoidn") is None, reason="Open Image Denoise is not installed")
@pytest.mark.parametrize("film", ["room.xml"], indirect=True)
def test_worker_processes_write_the_denoised_frames_that_one_process_writes(film, folder):
    _, plain = film
    render(folder, "denoised-2", "--workers", "2", "--denoise")
    found = digests(alone(folder, "denoised-in-process", denoise=True))
    assert digests(folder / "denoised-2") == found
    assert found.keys() == plain.keys()
    other = {file for file in found if found[file] != plain[file]}
    assert other == {file for file in found if file.startswith("frames/")}


class WithBarriers(InProcess):
    """Lets each pass wait for all of the pass before."""

    def run(self, tasks, perform):
        return super().run(with_barriers(tasks), perform)


@pytest.mark.parametrize("engine", [Backwards, WithBarriers])
def test_to_start_when_its_parts_are_there_changes_no_byte_of_a_task(
    film_in_parts, folder, monkeypatch, engine
):
    monkeypatch.setattr(run_module, "make_engine", lambda *_: engine())
    assert digests(alone(folder, f"parts-{engine.__name__}", cache_parts=4)) == film_in_parts


def perform_alone(task, *, run, cell):
    """Do a task where there is nothing but what its entry in the plan names."""
    for old in (*cell.glob("cache/*"), *cell.glob("frames/*"), *cell.glob("log/results/*")):
        old.unlink()
    reads = (name for kind in ("cache", "inputs", "prepared") for name in task.arguments[kind])
    for name in ("run.json", "scene.zip", *reads):
        (cell / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(run / name, cell / name)
    for name in task.outputs:
        (cell / name).parent.mkdir(parents=True, exist_ok=True)
    result = perform(task, directory=str(cell), threads=None)
    for name in task.outputs:
        shutil.copy(cell / name, run / name)
    return result


def test_a_task_reads_no_more_than_its_entry_in_the_plan_names(film_in_parts, folder, monkeypatch):
    monkeypatch.chdir(folder)
    run = Path("parts-alone").resolve()
    request = prepare(
        "room.xml",
        camera="walk.toml",
        spp=2,
        quality="draft",
        cache_parts=4,
        output=run,
        cluster="in-process",
    )
    work = partial(perform_alone, run=run, cell=folder / "cell")
    with Session(request, perform=work) as session:
        for _ in session:
            pass
        session.finish()
    assert digests(run) == film_in_parts


def test_a_plan_in_parts_looks_along_the_film_and_writes_nothing(folder):
    program = (sys.executable, "-m", "steadylight", "plan", "room.xml", "--camera", "walk.toml", *PARTS)
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "4 parts, of which a window of frames reads" in done.stdout
    assert (
        "1 prepare, 1 look, 16 gather, 4 merge, 1 audit, 4 fill, 4 smooth, 4 shade, 1 concatenate"
        in done.stdout
    )
    assert not (folder / "runs").exists()
