"""Batch systems and undisturbed films to hold others against."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cheap_film
import grid_engine
import pytest
import slurm as slurm_module
from private_machine import ADDRESS, environment

from small_film import digests

PROGRAM = cheap_film.__file__


@pytest.fixture(scope="session")
def shared_folder():
    """A folder that every user may enter, as all nodes of a cluster see it."""
    folder = Path(tempfile.mkdtemp(prefix="steadylight-grid-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def slurm(shared_folder):
    """A real Slurm, with a site file for it."""
    yield from _machine(slurm_module, slurm_module.Slurm, shared_folder / "slurm", queue="main")


@pytest.fixture(scope="session")
def sge(shared_folder):
    """A real Grid Engine, with a site file for it."""
    yield from _machine(grid_engine, grid_engine.GridEngine, shared_folder / "sge", queue="main.q")


def _machine(module, kind, folder, queue):
    reason = module.why_not()
    if reason:
        pytest.skip(f"{module.__doc__.strip()} {reason}; .ci/run installs what is needed")
    folder.mkdir()
    machine = kind(folder)
    machine.user = getattr(module, "USER", None)
    machine.work = folder / "work"
    machine.work.mkdir(exist_ok=True)
    machine.queue = queue
    yield machine
    machine.close()


@pytest.fixture
def site(request):
    """Writes site files: `site(machine, walltime="00:01:00", faults={...})`."""

    def write(machine, **more):
        path = machine.work / f"{request.node.name.translate({ord('['): '-', ord(']'): None})}.toml"
        values = {
            "queue": machine.queue,
            "cores": 1,
            "memory": "900 MB",
            "walltime": "00:10:00",
            "host": ADDRESS,
        }
        faults = more.pop("faults", {})
        lines = [f"{key} = {value!r}" for key, value in (values | more).items()]
        lines += ["[faults]", *(f"{key} = {value!r}" for key, value in faults.items())]
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


@pytest.fixture(scope="session")
def undisturbed(shared_folder):
    """Digests of a cheap film as one process makes it: `undisturbed(frames)`."""
    known = {}

    def digests_of(frames, size="16x8"):
        if (frames, size) not in known:
            directory = shared_folder / f"undisturbed-{frames}-{size}"
            command = [sys.executable, PROGRAM, directory, "--frames", frames, "--size", size]
            command += ["--seconds", 0, "--cluster", "in-process"]
            subprocess.run(list(map(str, command)), env=environment(), check=True, capture_output=True)
            known[frames, size] = digests(directory)
        return known[frames, size]

    return digests_of


@pytest.fixture
def start():
    """Starts the cheap film's command on a machine, and sees to it that it ends with the test."""
    started = []

    def begin(machine, directory, cluster, *options):
        command = [sys.executable, PROGRAM, directory, "--cluster", cluster, *options]
        process = machine.start(
            *command,
            user=machine.user,
            env=environment() | machine.environment,
            cwd=machine.work,
        )
        started.append(process)
        return process

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()
