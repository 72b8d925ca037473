"""Real frames on real batch systems: what befalls the machines changes no byte, and costs no finished task."""

from __future__ import annotations

import subprocess

import pytest
from disturbing import check, disturb
from private_machine import environment

from small_film import command, digests, journal, write_film

pytestmark = pytest.mark.slow

FILM = ("--fps", "12", "--spp", "1024")  # long enough to be under way when something happens
FRAMES = 13


@pytest.fixture(scope="module")
def whole(shared_folder):
    """Digests of the film as one process renders it."""
    folder = shared_folder / "whole"
    folder.mkdir()
    write_film(folder)
    words = command(folder / "run", *FILM, "--cluster", "in-process")
    subprocess.run(words, cwd=folder, env=environment(), check=True, capture_output=True, timeout=600)
    found = digests(folder / "run")
    assert sum(name.endswith(".exr") for name in found) == FRAMES
    return found


@pytest.mark.parametrize(
    ("name", "fault", "seed"),
    [
        ("slurm", "kill_worker", 51),
        ("slurm", "kill_command", 52),
        ("sge", "cancel_job", 53),
        ("sge", "stop_worker", 54),
    ],
)
def test_a_film_has_its_bytes_whatever_befalls_it(request, site, whole, name, fault, seed):
    machine = request.getfixturevalue(name)
    folder = machine.work / f"{fault}-rendering"
    folder.mkdir()
    folder.chmod(0o777)
    write_film(folder)
    site_file = site(machine, memory="2 GB", faults={"stalled_after": 30.0})
    words = command(folder / "run", *FILM, "--cluster", name, "--site", str(site_file), "--workers", "2")
    # The way into the machine's name spaces ends at their root folder.
    words = [str(folder / word) if (folder / word).is_file() else word for word in words]
    started = []

    def start():
        started.append(
            machine.start(*words, user=machine.user, env=environment() | machine.environment, cwd=folder)
        )
        return started[-1]

    try:
        said = disturb(machine, start, folder / "run", fault=fault, seed=seed, between=(2, 16), pause=0.3)
        assert len(said) == (2 if fault == "kill_command" else 1), "\n".join(said)
        check(folder / "run", whole)
        assert len([entry for entry in journal(folder / "run") if entry["outcome"] == "done"]) >= FRAMES
        assert "Traceback" not in "".join(said)
    finally:
        for process in started:
            process.kill()
            process.wait()
            process.stdout.close()
        machine.clear()
