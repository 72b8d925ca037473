"""Real batch systems: what they render has the bytes that one process renders."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from cheap_film import performed
from private_machine import environment

from small_film import digests, journal


@pytest.fixture(params=["slurm", "sge"])
def system(request):
    """Name and machine of each batch system that is installed."""
    return request.param, request.getfixturevalue(request.param)


def test_a_film_on_a_batch_system_has_the_bytes_of_a_local_one(system, site, start, undisturbed):
    name, machine = system
    directory = machine.work / "cheap"
    # Long enough that the second job has come before the first has done all.
    process = start(machine, directory, name, "--site", site(machine), "--seconds", 1, "--frames", 12)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert said.startswith("http://127.0.0.1:")
    assert digests(directory) == undisturbed(12)
    entries = journal(directory)
    assert {entry["outcome"] for entry in entries} == {"done"}
    assert len({entry["worker"] for entry in entries}) == 2
    assert len(performed(directory)) == len(entries)
    # Certificates and the sign for waiting jobs end with the command; logs stay.
    left = sorted(path.name for path in (directory / "log/batch").iterdir())
    assert not [file for file in left if file.startswith(("tls-", "wanted-"))]
    assert left


def test_a_run_directory_may_have_any_name(system, site, start, undisturbed):
    name, machine = system
    directory = machine.work / 'a "film"; it\'s $HOME & `more`'
    process = start(machine, directory, name, "--site", site(machine), "--seconds", 0, "--frames", 4)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert digests(directory) == undisturbed(4)


def test_the_batch_systems_refusal_is_told_in_its_words_and_leaves_the_run_as_it_is(slurm, site, start):
    directory = slurm.work / "refused"
    process = start(slurm, directory, "slurm", "--site", site(slurm, queue="midnight"))
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 2
    assert "invalid partition specified: midnight" in said
    assert not journal(directory)


@pytest.mark.slow
def test_jobs_that_cannot_start_a_worker_end_the_run_with_their_words(slurm, site, start):
    prologue = ["echo no such module: python", "exit 1"]
    process = start(slurm, slurm.work / "false-start", "slurm", "--site", site(slurm, prologue=prologue))
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 1
    assert "3 jobs ended before their worker could connect to this machine" in said
    assert "no such module: python" in said


@pytest.mark.slow
def test_the_gallery_on_a_batch_system_has_the_bytes_of_a_local_run(system, site, shared_folder):
    name, machine = system
    film = ["gallery", "--frames", "12", "--size", "32x24", "--spp", "1", "--quality", "draft"]
    film += ["--selected-frames", "2"]
    command = [sys.executable, "-m", "steadylight", "render", *film, "--output"]
    local = shared_folder / "gallery-local"
    if not (local / "stats.json").exists():
        subprocess.run([*command, local], env=environment(), check=True, capture_output=True, timeout=900)
    directory = machine.work / "gallery"
    words = [*command, str(directory), "--cluster", name, "--site", str(site(machine, memory="3 GB"))]
    words += ["--workers", "1"]
    machine.run(
        *words, user=machine.user, env=environment() | machine.environment, cwd=machine.work, timeout=900
    )
    assert digests(directory) == digests(local)
    statistics = json.loads((directory / "stats.json").read_text())
    assert statistics["frames"] == 12
    assert statistics["workers"] == 1
    assert (directory / "animation.mp4").stat().st_size > 0
